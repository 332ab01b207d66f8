"""What the relay's core tells its shell, and what it keeps of each stream."""

from typing import Protocol

from sern_core.fragments import InStream
from sern_core.link import Link
from sern_core.message import Message, StreamInfo
from sern_core.queues import OutChannel
from sern_core.replay import ReplayStore
from sern_core.types import ClientName


class HubEvents(Protocol):
    """What the relay's shell is told."""

    def client_up(self, client: ClientName, *, resumed: bool) -> None: ...

    def client_down(self, client: ClientName, reason: str) -> None: ...

    def stream_added(self, stream: StreamInfo) -> None: ...

    def stream_removed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """For the plain feed. Tombstones are not reported."""

    def refused(self, client: ClientName, code: str, text: str) -> None: ...

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None:
        """A client would use a datagram lane: open a session for it and call `Hub.offer_lane`, or do nothing."""

    def lane_closed(self, client: ClientName) -> None:
        """The client's datagram lane ended with its session."""


class Relayed:
    """One stream at the relay: where it comes from (None: the relay itself), where it goes, what is kept of it."""

    __slots__ = ("cache", "outs", "source", "stream")

    def __init__(self, source: Link | None, stream: InStream, replays: ReplayStore) -> None:
        self.source = source
        self.stream = stream
        self.outs: dict[ClientName, tuple[Link, OutChannel]] = {}
        spec = stream.stream.spec
        self.cache = replays.open(spec.depth) if spec.latched else None
