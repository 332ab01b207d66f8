"""Streams of the relay itself: what its feed takes in, published under a name of its own like any client's. Pure."""

from collections.abc import Callable, Container

from sern_core.relay.forwarding import Forwarding
from sern_core.relay.hub_events import Relayed
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import RoutingTable
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire.numbering import Numbering


class LocalStreams:
    """The publishing half of a relay. `owners` are the names under which it publishes; no client may have one of them,
    and `clients` are those that do have names. `boot` is the relay's own. `owned` is told before it publishes."""

    def __init__(
        self,
        boot: int,
        owners: set[ClientName],
        clients: Container[ClientName],
        routing: RoutingTable,
        numbering: Numbering,
        streams: RelayedStreams,
        forwarding: Forwarding,
        *,
        owned: Callable[[float], None],
    ) -> None:
        self._boot = boot
        self._owners = owners
        self._clients = clients
        self._routing = routing
        self._numbering = numbering
        self._streams = streams
        self._forwarding = forwarding
        self._owned = owned

    def open(self, info: TopicInfo, spec: TopicSpec, owner: ClientName, *, now: float) -> Relayed:
        """Publish a topic from here, under the name of `owner`, who then owns the topic's name like any client.

        The answer is the handle for `inject` and `close`; opening again gives the same. Raises RefusedError like
        `RoutingTable.announce`: the access rules must let `owner` publish it.
        """
        if owner in self._clients:
            raise RefusedError("name_taken", f"{owner} is the name of a client; give the feed's role another name")
        self._owners.add(owner)
        self._owned(now)
        identity = StreamId(owner, self._boot, info.name)
        held = self._streams.by_id.get(identity)
        stream = InStream(
            StreamInfo(identity, info, spec),
            Reassembly(0),
            lambda _stream, _message: None,
            lambda _stream, _reason, _nbytes, _seq, _reported: None,
            first=self._numbering.last(identity) + 1,
        )
        if held is not None:
            stream.delivered = held.stream.delivered
        return self._streams.take(None, stream, now)

    def close(self, handle: Relayed, *, now: float) -> None:
        """End a local stream; nothing happens when it has ended already."""
        if self.is_open(handle):
            self._streams.apply(self._routing.withdraw(handle.stream.stream.id), now)

    def is_open(self, handle: Relayed) -> bool:
        """Whether a local stream still is; access rules may have ended it."""
        return self._streams.by_id.get(handle.stream.stream.id) is handle

    def inject(self, handle: Relayed, body: bytes, stamp_ns: int, *, now: float, age_s: float = 0.0) -> bool:
        """A message of a local stream, `age_s` old. False: too old, refused (a reliable queue is full), or ended."""
        if not self.is_open(handle):
            return False
        stream = handle.stream
        spec = stream.stream.spec
        counters = self._forwarding.received.of(stream.stream)
        if spec.lifespan_s is not None and age_s > spec.lifespan_s:
            counters.drop_arrived(DropReason.LIFESPAN)
            return False
        if spec.reliable and not all(channel.has_room(len(body)) for _link, channel in handle.outs.values()):
            counters.drop_arrived(DropReason.REFUSED)
            return False
        stream.delivered += 1
        stream.confirmed = stream.delivered
        counters.arrived(len(body), age_s, now)
        self._forwarding.forward(handle, Message(stream.stream.id, stream.delivered, body, stamp_ns, now - age_s), now)
        return True
