"""What a client's core tells its shell, and how what the shell raises is kept out of the core."""

from collections.abc import Callable
from contextlib import suppress
from typing import ParamSpec, Protocol

from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing

P = ParamSpec("P")


class ClientEvents(Protocol):
    """What the shell is told."""

    def link_up(self, *, resumed: bool) -> None: ...

    def link_down(self, reason: str) -> None: ...

    def rejected(self, code: str, text: str) -> None:
        """The relay refused the session."""

    def lane_offered(self, parameters: framing.Envelope) -> None:
        """The relay has opened a datagram session for us; open the socket, then call `ClientCore.link.open_lane`."""

    def lane_closed(self) -> None:
        """The datagram lane ended with its session: close its socket."""

    def keys_told(self, keys: RelayKeys) -> None:
        """The relay tells of its keys, and what became of the one that it was offered."""

    def stream_opened(self, stream: StreamInfo) -> None:
        """A stream from elsewhere, definition included. Raises ConfigError if this site cannot publish it."""

    def stream_closed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> DropReason | None:
        """A message of an open stream has its turn. Returns why it was not taken; None: it was."""

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        """A reliable message of a stream from elsewhere was dropped on its way; it is reported in its turn."""

    def skipped(self, stream: StreamInfo, count: int) -> None:
        """`count` messages of a reliable stream were given up before this site was told of it again."""

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        """Messages of ours, `count` from seq `first` on, were dropped: here (`where` is empty), or further on for the
        client `where`. There may be 100,000 of them: nothing is to be done for each. Where they lie in very
        many runs, one run has them all, and what lies between them, which was told before."""

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        """Whether anybody at the far side wants a stream of ours; said again after every change."""

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None: ...

    def subscription_refused(self, code: str, text: str) -> None:
        """Something that this site named is not ours to have, or the relay takes none of our patterns."""

    def object_refused(self, object_id: str, code: str, why: str) -> None:
        """The relay did not take an object of ours. Of many at once some are told."""

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        """The body of a message could not be decoded: it is dropped. Said once for each topic."""

    def fault(self, error: Exception) -> None:
        """Something raised what nobody expects, in the core or in one of these methods: log it with its traceback and
        count it. What it was about is given up, everything else goes on."""


class ClientShell:
    """Tells the shell what happens; what it raises stops nothing in the core."""

    def __init__(self, events: ClientEvents) -> None:
        self.events = events
        self.faults = 0
        """Errors of ours so far that nobody expects."""

    def fault(self, error: Exception) -> None:
        """Tell the shell of an error that nobody expects."""
        self.faults += 1
        with suppress(Exception):  # counted above; there is nobody left to tell
            self.events.fault(error)

    def tell(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> None:
        """Call one of its methods, and of whoever else listens outside the core."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001  (the shell's, and no reason to leave our own work half done)
            self.fault(error)
