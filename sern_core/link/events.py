"""What the parts of a link tell its owner. Pure."""

from collections.abc import Sequence
from typing import Protocol

from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Announcement


class Events(Protocol):
    """`LinkHandler`, of one link. Only `announce`, `message`, `up` and `control` raise; the others report what was
    raised, and go on. (`Fates` do not raise.)"""

    def fault(self, error: Exception) -> None:
        """Something raised what nobody expects. What it was about is given up by the caller."""

    def up(self, *, now: float) -> None: ...

    def down(self, reason: str, *, now: float) -> None: ...

    def lane_closed(self) -> None: ...

    def rejected(self, code: str, text: str, *, now: float) -> None: ...

    def announce(self, announcement: Announcement, *, now: float) -> bool | None: ...

    def retract(self, stream: InStream, *, now: float) -> None: ...

    def message(self, stream: InStream, message: Message, *, now: float) -> None: ...

    def discarded(self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int]) -> None:
        """Messages on their way in are dropped, and no drop marker follows."""

    def skipped(self, stream: InStream, count: int, *, now: float) -> None: ...

    def dropped(self, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None: ...

    def delivered(self, channel: OutChannel, *, now: float) -> None: ...

    def wanted(self, channel: OutChannel, *, now: float) -> None: ...

    def refused(self, channel: OutChannel, code: str, text: str, *, now: float) -> None: ...

    def definition(self, digest: str, *, now: float) -> None: ...

    def control(self, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None: ...
