"""What the owner of a link is told, and how: its errors go no further. Pure."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Generic, ParamSpec, Protocol, TypeVar

from sern_core.link.end import End
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Announcement

P = ParamSpec("P")
L = TypeVar("L")
"""The link, which comes above this module."""
L_contra = TypeVar("L_contra", contravariant=True)


class LinkHandler(Protocol[L_contra]):
    """What the owner of a link is told. Calls happen inside whatever the owner calls on the link or its parts.

    What they raise unexpectedly goes to `on_fault` and stops nothing that is under way here. News is told once more, as
    it does not come again; a message is given up (`fault`), counted and, of a reliable stream, reported; a stream that
    cannot be announced is refused. Only `on_up` and `on_control` end the session, for the next one tells it all anew.
    """

    def on_fault(self, link: L_contra, error: Exception, *, now: float) -> None:
        """Something raised what nobody expects, here or in the owner: to be logged with its traceback, and counted."""

    def on_up(self, link: L_contra, *, resumed: bool, now: float) -> None:
        """A session exists. `resumed`: the peer is the same process as before."""

    def on_down(self, link: L_contra, reason: str, *, now: float) -> None: ...

    def on_lane_closed(self, link: L_contra) -> None:
        """The datagram lane ended with the session: close its transport; its keys are of no more use."""

    def on_rejected(self, link: L_contra, code: str, text: str, *, now: float) -> None:
        """The peer refused the session itself."""

    def on_announce(self, link: L_contra, announcement: Announcement, *, now: float) -> bool | None:
        """The peer has a stream: is it wanted? None: `Link.answers` is told later. Raises RefusedError to refuse."""

    def on_retract(self, link: L_contra, stream: InStream, *, now: float) -> None: ...

    def on_message(self, link: L_contra, stream: InStream, message: Message, *, now: float) -> None:
        """A message (or drop marker) has its turn."""

    def on_in_drop(self, link: L_contra, stream: InStream, reason: DropReason, nbytes: int, count: int) -> None: ...

    def on_out_drop(self, link: L_contra, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        """These messages are dropped, in the order of their seqs. Of a reliable stream what lies between two of them
        was dropped before, or never comes."""

    def on_delivered(self, link: L_contra, channel: OutChannel, *, now: float) -> None:
        """The peer's watermark of a reliable channel moved to `channel.watermark`."""

    def on_wanted(self, link: L_contra, channel: OutChannel, *, now: float) -> None:
        """The peer has said whether it wants the stream: `channel.wanted`. Said again after every change."""

    def on_refused(self, link: L_contra, channel: OutChannel, code: str, text: str, *, now: float) -> None: ...

    def on_skipped(self, link: L_contra, stream: InStream, count: int, *, now: float) -> None:
        """`count` messages of the stream will not come; they were reported where they were dropped."""

    def on_definition(self, link: L_contra, digest: str, *, now: float) -> None:
        """`Link.definitions` has a new text."""

    def on_control(self, link: L_contra, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        """A control message that is not the link's own business. Raises WireError if it is nobody's."""


class Owner(Generic[L]):
    """Tells the owner of a link (`Events`). What it raises goes no further, but where `Events` says so."""

    def __init__(self, link: L, handler: LinkHandler[L], end: End) -> None:
        self._link = link
        self._handler = handler
        self._end = end
        self.faults = 0
        """Errors of ours on this link so far."""

    def _tell(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> None:
        """Tell the owner what it is not told again: once more if that raises."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001  (the owner's, and no reason to leave our own work half done)
            self.fault(error)
            try:
                call(*args, **kwargs)
            except Exception as again:  # noqa: BLE001
                self.fault(again)

    def fault(self, error: Exception) -> None:
        self.faults += 1
        with suppress(Exception):  # counted above; there is nobody left to tell
            self._handler.on_fault(self._link, error, now=self._end.now)

    def up(self, *, now: float) -> None:
        self._handler.on_up(self._link, resumed=self._end.resumed, now=now)

    def down(self, reason: str, *, now: float) -> None:
        self._tell(self._handler.on_down, self._link, reason, now=now)

    def lane_closed(self) -> None:
        self._tell(self._handler.on_lane_closed, self._link)

    def rejected(self, code: str, text: str, *, now: float) -> None:
        self._tell(self._handler.on_rejected, self._link, code, text, now=now)

    def announce(self, announcement: Announcement, *, now: float) -> bool | None:
        return self._handler.on_announce(self._link, announcement, now=now)

    def retract(self, stream: InStream, *, now: float) -> None:
        self._tell(self._handler.on_retract, self._link, stream, now=now)

    def message(self, stream: InStream, message: Message, *, now: float) -> None:
        self._handler.on_message(self._link, stream, message, now=now)

    def discarded(self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int]) -> None:
        self._tell(self._handler.on_in_drop, self._link, stream, reason, nbytes, len(seqs))
        fates = self._end.fates
        if fates is not None and reason is not DropReason.DUPLICATE:
            for seq in seqs:
                fates.discarded(stream.stream, seq, reason, self._end.peer)

    def skipped(self, stream: InStream, count: int, *, now: float) -> None:
        self._tell(self._handler.on_skipped, self._link, stream, count, now=now)

    def dropped(self, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        self._tell(self._handler.on_out_drop, self._link, channel, outs, reason)

    def delivered(self, channel: OutChannel, *, now: float) -> None:
        self._tell(self._handler.on_delivered, self._link, channel, now=now)

    def wanted(self, channel: OutChannel, *, now: float) -> None:
        self._tell(self._handler.on_wanted, self._link, channel, now=now)

    def refused(self, channel: OutChannel, code: str, text: str, *, now: float) -> None:
        self._tell(self._handler.on_refused, self._link, channel, code, text, now=now)

    def definition(self, digest: str, *, now: float) -> None:
        self._tell(self._handler.on_definition, self._link, digest, now=now)

    def control(self, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        self._handler.on_control(self._link, envelope, attachment, now=now)
