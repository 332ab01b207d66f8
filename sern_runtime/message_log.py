"""The message log of a daemon: one CSV line for everything that happens to a message there.

Of a client: offered, refused, delivered, and `expired` for a reliable message that was dropped on its way here. Of a
relay: `received`, a message that had its turn there. Of both: `dropped` on the way to `peer`; `discarded`, a message
from `peer` of which at least a part arrived and that went no further; and `held`, what waits for `peer` when the daemon
ends (the reason `unconfirmed` is of one that was sent whole), or at a relay for whoever comes (no peer). With the logs
of all daemons on its way every message can be followed, by its topic and seq.

For trials and audits; it grows without end. Lines are gathered and written every 64 KiB and at each `flush`, so that
the file never holds up the event loop for long.
"""

import logging
import time
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final, TextIO

from sern_core.link.link import Link
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import CLASS_LABELS, ClientName, DropReason
from sern_runtime.optional import OptionalParts

HEADER: Final = ("event", "wall_ns", "topic", "class", "seq", "bytes", "stamp_ns", "crc32", "age_s", "reason", "peer")
FLUSH_BYTES: Final = 64 * 1024

_log = logging.getLogger(__name__)


class MessageLog:
    """Raises ConfigError when the file cannot be opened. A full disk ends the log, in one line that `on_end` gets, not
    the forwarding."""

    def __init__(self, path: Path, on_end: Callable[[str], None] = _log.error) -> None:
        self.path = path
        self._on_end = on_end
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

    def received(self, stream: StreamInfo, message: Message, peer: ClientName) -> None:
        self._line("received", stream, message.seq, b"", message.stamp_ns, "", "", peer)

    def fate(self, event: str, stream: StreamInfo, seq: int, reason: str, peer: ClientName) -> None:
        self._line(event, stream, seq, b"", 0, "", reason, peer)

    def _line(
        self, event: str, stream: StreamInfo, seq: int, body: bytes, stamp_ns: int, age_s: str, reason: str,
        peer: str = "",
    ) -> None:  # fmt: skip
        if self._file is None:
            return
        line = (
            f"{event},{time.time_ns()},{stream.id.topic},{CLASS_LABELS[stream.spec.priority]},{seq},{len(body)},"
            f"{stamp_ns},{zlib.crc32(body)},{age_s},{reason},{peer}"
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
            with suppress(OSError):
                self._file.close()
            self._file = None
            self._on_end(self.problem)

    def close(self) -> None:
        self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None


class LoggedFates:
    """`Fates` that go into a message log; what fails there is that part's alone."""

    def __init__(self, log: MessageLog, parts: OptionalParts) -> None:
        self._log = log
        self._parts = parts

    def dropped(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        with self._parts.survive("message_log"):
            self._log.fate("dropped", stream, seq, reason, peer)

    def discarded(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        with self._parts.survive("message_log"):
            self._log.fate("discarded", stream, seq, reason, peer)

    def received(self, stream: StreamInfo, message: Message, peer: ClientName) -> None:
        with self._parts.survive("message_log"):
            self._log.received(stream, message, peer)

    def held(self, stream: StreamInfo, seq: int, peer: ClientName, *, exposed: bool) -> None:
        with self._parts.survive("message_log"):
            self._log.fate("held", stream, seq, DropReason.UNCONFIRMED if exposed else "", peer)

    def all_held(self, links: Iterable[Link]) -> None:
        """What waits on these links now."""
        for link in links:
            for message in link.undelivered():
                self.held(message.stream, message.seq, link.peer, exposed=message.exposed)
