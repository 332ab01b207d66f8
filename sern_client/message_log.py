"""The message log of a client: one CSV line for every message offered, refused, delivered or expired.

For trials and audits; it grows without end. Lines are gathered and written every 64 KiB and at each `flush`, so that
the file never holds up the event loop for long.
"""

import logging
import time
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Final, TextIO

from sern_core.errors import ConfigError
from sern_core.message import Message, StreamInfo
from sern_core.types import CLASS_LABELS, DropReason

HEADER: Final = ("event", "wall_ns", "topic", "class", "seq", "bytes", "stamp_ns", "crc32", "age_s", "reason")
FLUSH_BYTES: Final = 64 * 1024

_log = logging.getLogger(__name__)


class MessageLog:
    """Raises ConfigError when the file cannot be opened. A full disk ends the log, in one line, not the bridge."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problem: str | None = None
        self._lines: list[str] = [",".join(HEADER)]
        self._size_bytes = 0
        try:
            self._file: TextIO | None = path.open("w", encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"cannot write the message log: {error.strerror}", file=str(path)) from error

    def offered(self, stream: StreamInfo, seq: int, body: bytes, stamp_ns: int, *, accepted: bool) -> None:
        self._line("offered" if accepted else "refused", stream, seq, body, stamp_ns, "", "")

    def delivered(self, stream: StreamInfo, message: Message, age_s: float) -> None:
        self._line("delivered", stream, message.seq, message.body, message.stamp_ns, f"{age_s:.6f}", "")

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        self._line("expired", stream, seq, b"", 0, "", reason)

    def _line(
        self, event: str, stream: StreamInfo, seq: int, body: bytes, stamp_ns: int, age_s: str, reason: str
    ) -> None:
        if self._file is None:
            return
        line = (
            f"{event},{time.time_ns()},{stream.id.topic},{CLASS_LABELS[stream.spec.priority]},{seq},{len(body)},"
            f"{stamp_ns},{zlib.crc32(body)},{age_s},{reason}"
        )
        self._lines.append(line)
        self._size_bytes += len(line)
        if self._size_bytes >= FLUSH_BYTES:
            self.flush()

    def flush(self) -> None:
        if self._file is None or not self._lines:
            return
        text = "\n".join(self._lines) + "\n"
        self._lines.clear()
        self._size_bytes = 0
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            self.problem = f"{self.path}: the message log ends here: {error.strerror}"
            _log.error("%s", self.problem)
            with suppress(OSError):
                self._file.close()
            self._file = None

    def close(self) -> None:
        self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None
