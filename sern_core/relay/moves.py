"""Clients that go over from one relay to another: what was held for them goes with them. Pure.

Who serves a stream to a client is its *home*, and of a reliable stream the home keeps what the client has not
confirmed. The relay of the stream's origin (its *source*) keeps it as well, for the home does not confirm before its
client has. So when a client comes to another home, the source has everything that the client lacks, whether its last
home still lives or not:

    client -> new home: hello, subscribe         new home: holds the stream back for the client, asks for it,
                                                 and names the client in its `want`
    source: knows how far the last home was (f)  goes back to f on the new home's channel if that was further on
                                                 (`again`), and says `go`
    new home: begins the client's channel        at f, or where it was when the client came
    source -> last home: `released`              which forgets what it held

A channel that goes back carries some messages again that the home has had for other clients: these do not get them
twice, as each has a channel of its own whose numbers go on.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import Relayed
from sern_core.relay.routing import RouteChange, RoutingTable
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import Message, StreamId
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName, DropReason, TopicName

PATIENCE_S: Final = 5.0
"""A home waits so long for `go`. A source that does not answer for so long has died: whoever takes its place knows
from the origin for whom the stream is."""
MAX_HELD_BACK: Final = 1000
"""Messages of one stream that are held back for a client meanwhile; with more it begins behind them."""


class MovingStreams(Protocol):
    """What is needed of the streams of a relay."""

    by_id: dict[StreamId, Relayed]

    def offer(self, client: ClientName, identity: StreamId, now: float, *, first: int | None = None) -> None: ...

    def close(self, client: ClientName, identity: StreamId, reason: DropReason, now: float) -> None: ...

    def apply(self, change: RouteChange, now: float) -> None: ...

    def told(self, relayed: Relayed, now: float) -> None: ...


@dataclass(slots=True)
class _HeldBack:
    """A stream that waits for `go`: from seq `first` on, until `due_s` at the latest."""

    first: int
    due_s: float
    messages: list[Message] = field(default_factory=list)


class Moves:
    """`home` names the peer that a client is at, None: here, or nowhere; `moved` says whether a client has come here
    from a peer just now."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        streams: MovingStreams,
        *,
        home: Callable[[ClientName], ClientName | None],
        moved: Callable[[ClientName, float], bool],
    ) -> None:
        self._clients = clients
        self._routing = routing
        self._streams = streams
        self._home = home
        self._moved = moved
        self._held_back: dict[StreamId, dict[ClientName, _HeldBack]] = {}
        self._again: set[StreamId] = set()  # streams whose channel is about to begin again
        self._sure: dict[StreamId, set[tuple[ClientName, ClientName]]] = {}  # (peer, client): gets all that it lacks
        self._said: dict[StreamId, set[tuple[ClientName, ClientName]]] = {}  # and was told to go on

    # --- the new home -----------------------------------------------------------------------------------------------

    def holds_back(self, client: ClientName, relayed: Relayed, *, now: float) -> bool:
        """A client is to get a stream: whether it has to wait for `go`."""
        identity = relayed.stream.stream.id
        if is_peer(client) or not relayed.stream.reliable or self._routing.via(identity) is None:
            return False
        waiting = self._held_back.get(identity, {})
        if client not in waiting and not self._moved(client, now):
            return False
        if client not in waiting:
            held = _HeldBack(relayed.stream.delivered + 1, now + PATIENCE_S)
            self._held_back.setdefault(identity, {})[client] = held
        return True

    def waiting(self, identity: StreamId) -> list[ClientName]:
        """Clients that wait for `go`: they are required."""
        return list(self._held_back.get(identity, ()))

    def confirms_below(self, identity: StreamId) -> int | None:
        """The first message that somebody has not been handed; None: there is none."""
        waiting = self._held_back.get(identity)
        return None if not waiting else min(held.first for held in waiting.values())

    def message(self, identity: StreamId, message: Message) -> None:
        """A message has gone to all others."""
        for held in self._held_back.get(identity, {}).values():
            if message.seq >= held.first and len(held.messages) < MAX_HELD_BACK:
                held.messages.append(message)

    def expect_again(self, identity: StreamId) -> None:
        """The source is about to go back: it ends the channel and begins another one."""
        if identity in self._streams.by_id:
            self._again.add(identity)

    def ends_for_good(self, identity: StreamId) -> bool:
        """A peer has ended a channel: whether the stream ends with it."""
        return identity not in self._again

    def came_again(self, relayed: Relayed) -> None:
        """The source has announced a stream."""
        identity = relayed.stream.stream.id
        if identity in self._again:
            self._again.discard(identity)
            for held in self._held_back.get(identity, {}).values():
                held.first = min(held.first, relayed.stream.delivered + 1)
                held.messages.clear()  # they come again

    def go(self, client: ClientName, topic: TopicName, *, now: float) -> None:
        """The client gets from now on what it lacks."""
        for identity in [
            each for each, waiting in self._held_back.items() if each.topic == topic and client in waiting
        ]:
            self._begin(identity, client, now)

    def sweep(self, *, now: float) -> None:
        """Call about once a second."""
        for identity, waiting in list(self._held_back.items()):
            for client in [client for client, held in waiting.items() if now >= held.due_s]:
                self._begin(identity, client, now)

    def leave(self, client: ClientName, identity: StreamId) -> _HeldBack | None:
        """The client wants the stream no more, or is gone."""
        waiting = self._held_back.get(identity)
        held = None if waiting is None else waiting.pop(client, None)
        if waiting is not None and not waiting:
            del self._held_back[identity]
        return held

    def _begin(self, identity: StreamId, client: ClientName, now: float) -> None:
        held = self.leave(client, identity)
        relayed = self._streams.by_id.get(identity)
        if held is None or relayed is None:
            return
        self._streams.offer(client, identity, now, first=held.first)
        pair = relayed.outs.get(client)
        if pair is not None:
            _submit(held.messages, *pair, now)
        self._streams.told(relayed, now)

    # --- the source -------------------------------------------------------------------------------------------------

    def named(self, link: Link, channel: OutChannel, *, now: float) -> None:
        """A peer has said for whom a stream is that has its source here."""
        identity = channel.stream.id
        relayed = self._streams.by_id.get(identity)
        if relayed is None or not channel.reliable or self._routing.via(identity) is not None:
            return
        peer, sure = link.peer, self._sure.setdefault(identity, set())
        names = [ClientName(name) for name in channel.required]
        said = self._said[identity] = {
            pair for pair in self._said.get(identity, ()) if pair[0] != peer or pair[1] in names
        }
        lacking: OutChannel | None = None
        for name in names:
            if (peer, name) in said or (peer, name) in sure or self._home(name) != peer:
                continue
            held = self._held(relayed, name, peer)
            sure.add((peer, name))
            lacks = held is not None and held.watermark + 1 < channel.next_seq
            if held is not None and lacks and (lacking is None or held.watermark < lacking.watermark):
                lacking = held
        if lacking is not None:
            self._go_back(relayed, link, channel, lacking, now)
            return  # the peer says again for whom it is
        for name in names:
            if self._home(name) == peer and (peer, name) not in said:
                said.add((peer, name))
                sure.discard((peer, name))
                self._clients.tell(peer, {"t": "go", "client": name, "topic": identity.topic}, now)
                self._release(relayed, name, peer, now)

    def _held(self, relayed: Relayed, client: ClientName, but: ClientName) -> OutChannel | None:
        """The channel with what a client has not confirmed that was elsewhere before; None: there is none."""
        for name, (_link, channel) in relayed.outs.items():
            if name != but and (name == client or (is_peer(name) and client in channel.required)):
                return channel
        return None

    def _go_back(self, relayed: Relayed, link: Link, channel: OutChannel, held: OutChannel, now: float) -> None:
        identity, required = channel.stream.id, channel.required
        said = {"t": "again", "origin": identity.origin, "boot": identity.boot, "topic": identity.topic}
        self._clients.tell(link.peer, said, now)
        retained = [out.message for out in held.retained]
        self._streams.close(link.peer, identity, DropReason.UNWANTED, now)
        self._streams.offer(link.peer, identity, now, first=held.watermark + 1)
        pair = relayed.outs.get(link.peer)
        if pair is not None:
            pair[1].required = required
            _submit(retained, *pair, now)

    def _release(self, relayed: Relayed, client: ClientName, but: ClientName, now: float) -> None:
        """Nobody else needs to keep anything for the client any more."""
        identity = relayed.stream.stream.id
        for name, (_link, channel) in list(relayed.outs.items()):
            if name != but and is_peer(name) and client in channel.required:
                self._clients.tell(name, {"t": "released", "client": client, "topic": identity.topic}, now)
        if client in relayed.outs:
            self.released(client, identity.topic, now=now)

    def begin_for(self, peer: ClientName, relayed: Relayed) -> OutChannel | None:
        """A peer, or a client of this relay, is to get a stream: the channel with what a client has not confirmed that
        has come there; None: there is none."""
        if not relayed.stream.reliable or self._routing.via(relayed.stream.stream.id) is not None:
            return None
        held: OutChannel | None = None
        for name, (_link, channel) in relayed.outs.items():
            behind = map(ClientName, channel.required) if is_peer(name) else (name,)
            if is_peer(peer):
                come = name != peer and any(self._home(client) == peer for client in behind)
            else:
                come = is_peer(name) and peer in behind
            if come and (held is None or channel.watermark < held.watermark):
                held = channel
        return held

    def go_on_with(self, held: OutChannel, link: Link, channel: OutChannel, now: float) -> None:
        """Hand over what is held."""
        _submit([out.message for out in held.retained], link, channel, now)

    # --- the last home ----------------------------------------------------------------------------------------------

    def went(self, client: ClientName, peer: ClientName, *, now: float) -> None:
        """A client of this relay is at a peer: what it has not confirmed is kept until it is seen to there."""
        kept: list[TopicName] = []
        for identity in self._routing.received_by(client):
            relayed = self._streams.by_id[identity]
            if client in relayed.outs and relayed.outs[client][1].reliable:
                kept.append(identity.topic)
        self._streams.apply(self._routing.subscribe(client, exact=kept), now)

    def released(self, client: ClientName, topic: TopicName, *, now: float) -> None:
        """The client gets the topic at its home: what is held of it here may go."""
        left = {identity.topic for identity in self._routing.received_by(client)} - {topic}
        self._streams.apply(self._routing.subscribe(client, exact=left), now)

    def ended(self, identity: StreamId) -> None:
        """The stream is gone."""
        for table in (self._held_back, self._sure, self._said):
            table.pop(identity, None)
        self._again.discard(identity)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        for table in (self._held_back, self._sure, self._said):
            assert table.keys() <= self._streams.by_id.keys(), "moves of streams that are gone"
        assert self._again <= self._streams.by_id.keys(), "streams are expected again that are gone"


def _submit(messages: list[Message], link: Link, channel: OutChannel, now: float) -> None:
    for message in messages:
        if message.replay or message.seq < channel.next_seq:
            continue
        if message.seq > channel.next_seq:
            link.outgoing.skip(channel, message.seq, now=now)
        link.sender.submit(channel, message, now=now, forced=True)
