"""The part of HTTP/1.1 (RFC 9112) that XML-RPC between ROS nodes uses, as a parser without sockets.

Messages carry a Content-Length; an answer without one ends with its connection. Nothing else (chunks, upgrades,
continuation lines) is spoken by ROS nodes, and it is refused.
"""

from typing import Final, NamedTuple

from sern_core.vocabulary.errors import WireError

MAX_HEAD_BYTES: Final = 16 * 1024


class HttpMessage(NamedTuple):
    """`start` is the first line; names of `headers` are in lower case."""

    start: str
    headers: dict[str, str]
    body: bytes

    @property
    def keep_alive(self) -> bool:
        """Whether the sender goes on with this connection: HTTP/1.1 unless it says no, HTTP/1.0 only if it says so."""
        word = self.headers.get("connection", "").lower()
        return "keep-alive" in word if "HTTP/1.0" in self.start else "close" not in word


class HttpReader:
    """Bytes in, messages out, of one direction of one connection. WireError ends it for good."""

    def __init__(self, *, max_body_bytes: int, answers: bool) -> None:
        self._max_body_bytes = max_body_bytes
        self._answers = answers
        self._buffer = bytearray()
        self._start = ""
        self._headers: dict[str, str] | None = None
        self._length: int | None = None

    @property
    def pending(self) -> bool:
        """A message has begun and is not complete."""
        return bool(self._buffer) or self._headers is not None

    def feed(self, data: bytes) -> HttpMessage | None:
        """The next message if it is complete now; ask again with `b""` for one that came along with it."""
        self._buffer += data
        if self._headers is None and not self._read_head():
            return None
        if self._length is None:
            if len(self._buffer) > self._max_body_bytes:
                raise WireError(f"HTTP body above {self._max_body_bytes} bytes")
            return None
        return self._take(self._length) if len(self._buffer) >= self._length else None

    def finish(self) -> HttpMessage | None:
        """The answer that only the end of the connection ends, if there is one; call this at that end."""
        if self._answers and self._headers is not None and self._length is None:
            return self._take(len(self._buffer))
        return None

    def _take(self, length: int) -> HttpMessage:
        assert self._headers is not None
        message = HttpMessage(self._start, self._headers, bytes(self._buffer[:length]))
        del self._buffer[:length]
        self._headers = self._length = None
        return message

    def _read_head(self) -> bool:
        end = self._buffer.find(b"\r\n\r\n")
        if end < 0:
            if len(self._buffer) > MAX_HEAD_BYTES:
                raise WireError(f"HTTP head above {MAX_HEAD_BYTES} bytes")
            return False
        if end > MAX_HEAD_BYTES:
            raise WireError(f"HTTP head above {MAX_HEAD_BYTES} bytes")
        self._start, *lines = self._buffer[:end].decode("latin-1").split("\r\n")
        del self._buffer[: end + 4]
        headers: dict[str, str] = {}
        for line in lines:
            name, separator, value = line.partition(":")
            if not separator:
                raise WireError("HTTP head: a line without a colon")
            headers[name.strip().lower()] = value.strip()
        self._length = self._content_length(headers)
        self._headers = headers
        return True

    def _content_length(self, headers: dict[str, str]) -> int | None:
        if "transfer-encoding" in headers:
            raise WireError("HTTP transfer-encoding is not spoken here")
        text = headers.get("content-length")
        if text is None:
            if self._answers:
                return None
            raise WireError("HTTP request without Content-Length")
        if not text.isascii() or not text.isdigit() or len(text) > 12 or int(text) > self._max_body_bytes:
            raise WireError(f"HTTP Content-Length {text[:20]!r} is not a number up to {self._max_body_bytes}")
        return int(text)
