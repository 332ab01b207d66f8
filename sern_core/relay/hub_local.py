"""Streams of the relay itself: what its feed takes in, published under a name of its own like any client's. Pure."""

from abc import ABC, abstractmethod

from sern_core.link.link import Link
from sern_core.relay.hub_events import Relayed
from sern_core.relay.routing import RouteChange, RoutingTable
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.stream.latched import ReplayStore
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire.numbering import Numbering


class LocalStreams(ABC):
    """The publishing half of a relay; `Hub` gives it routes and takers."""

    boot: int
    routing: RoutingTable
    links: dict[ClientName, Link]
    relayed: dict[StreamId, Relayed]
    received: ReceiveLedger
    replays: ReplayStore

    def __init__(self) -> None:
        self.local_owners: set[ClientName] = set()
        """Names under which the relay itself publishes; no client may have one of them."""
        self._numbering = Numbering()  # of local streams that were closed

    @abstractmethod
    def _take(self, source: Link | None, stream: InStream, now: float) -> Relayed: ...

    @abstractmethod
    def _apply(self, change: RouteChange, now: float, *, reason: DropReason = DropReason.UNWANTED) -> None: ...

    @abstractmethod
    def _forward(self, relayed: Relayed, message: Message, now: float) -> bool: ...

    def _closed_local(self, relayed: Relayed, now: float) -> None:
        """A local stream has ended: should it come again, it counts on."""
        self._numbering.ended(relayed.stream.stream.id, relayed.stream.delivered, now=now)

    def open_local(self, info: TopicInfo, spec: TopicSpec, owner: ClientName, *, now: float) -> Relayed:
        """Publish a topic from here, under the name of `owner`, who then owns the topic's name like any client.

        The answer is the handle for `inject` and `close_local`; opening again gives the same. Raises RefusedError like
        `RoutingTable.announce`: the access rules must let `owner` publish it.
        """
        if owner in self.links:
            raise RefusedError("name_taken", f"{owner} is the name of a client; give the feed's role another name")
        self.local_owners.add(owner)
        identity = StreamId(owner, self.boot, info.name)
        held = self.relayed.get(identity)
        stream = InStream(
            StreamInfo(identity, info, spec),
            Reassembly(0),
            lambda _stream, _message: None,
            lambda _stream, _reason, _nbytes, _seq, _reported: None,
            first=self._numbering.last(identity) + 1,
        )
        if held is not None:
            stream.delivered = held.stream.delivered
        return self._take(None, stream, now)

    def close_local(self, handle: Relayed, *, now: float) -> None:
        """End a local stream; nothing happens when it has ended already."""
        if self.is_open(handle):
            self._apply(self.routing.withdraw(handle.stream.stream.id), now)

    def is_open(self, handle: Relayed) -> bool:
        """Whether a local stream still is; access rules may have ended it."""
        return self.relayed.get(handle.stream.stream.id) is handle

    def inject(self, handle: Relayed, body: bytes, stamp_ns: int, *, now: float, age_s: float = 0.0) -> bool:
        """A message of a local stream, `age_s` old. False: too old, refused (a reliable queue is full), or ended."""
        if not self.is_open(handle):
            return False
        stream = handle.stream
        spec = stream.stream.spec
        counters = self.received.of(stream.stream)
        if spec.lifespan_s is not None and age_s > spec.lifespan_s:
            counters.drop_arrived(DropReason.LIFESPAN)
            return False
        if spec.reliable and not all(channel.has_room(len(body)) for _link, channel in handle.outs.values()):
            counters.drop_arrived(DropReason.REFUSED)
            return False
        stream.delivered += 1
        stream.confirmed = stream.delivered
        counters.arrived(len(body), age_s, now)
        self._forward(handle, Message(stream.stream.id, stream.delivered, body, stamp_ns, now - age_s), now)
        return True
