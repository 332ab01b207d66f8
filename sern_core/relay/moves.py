"""Clients that go over from one relay to another: what was held for them goes with them. Pure.

Who serves a stream to a client is its *home*. The relay of the stream's origin is its *source*: it alone decides who
has what. Of a reliable stream it keeps for each client that needs it what that client has not confirmed, in one place
at a time, and confirms nothing to the origin that is still kept:

- in a channel to the peer that is the client's home, where the peer has named the client in its `want`; or
- in a channel of the client's own, whether it is here, or away, or at a peer that has not named it yet.

A client that begins with a stream at another home is passed from one place to the other:

    client -> new home: hello, subscribe         new home: holds the stream back for the client, asks for it,
                                                 names the client in its `want`, and says from where on it has the
                                                 stream for it (`takes`)
    source: knows how far the last place was (f) goes back to f on the new home's channel if that was further on
                                                 (`again`, to which the home says anew what it has), or says `go`
    new home: begins the client's channel        at f, or where it was when the client came
    source -> other relays that name the client: `released`
                                                 they forget what they hold for it

One that is out of reach is not waited for: nothing is kept for it once its clients get the stream elsewhere.

Until `released` comes a relay goes on naming a client that it has been told to hold a stream for, wherever that is. So
the source may die, and the home, and any of them begin anew: the names come back to the source with the origin's
announcement, to a home with the source's, and what is not confirmed is there again.

Where a peer's channel ends without that (its clients' interest has changed, or it was started anew and they are not
back), the source keeps the rest in channels of those clients' own, and asks their homes (`owed`). A home whose client
has said what it wants, and not this, says so (`parted`).

A channel that goes back carries some messages again that the home has had for other clients: these do not get them
twice, as each has a channel of its own whose numbers go on.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import Relayed
from sern_core.relay.route_change import RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import Message, StreamId
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName, DropReason, TopicName
from sern_core.wire import framing

MAX_HELD_BACK_BYTES: Final = 32 * 2**20
"""What of one stream is held back for a client until its source says `go`; more is dropped and reported."""
MESSAGE_BYTES: Final = 100
"""What a message counts for there beside its body."""
BETWEEN_S: Final = 60.0
"""For so long a stream is waited for whose origin has left the relay that it came from."""


class MovingStreams(Protocol):
    """What is needed of the streams of a relay."""

    by_id: dict[StreamId, Relayed]

    def offer(self, client: ClientName, identity: StreamId, now: float, *, first: int | None = None) -> None: ...

    def close(self, client: ClientName, identity: StreamId, reason: DropReason, now: float) -> None: ...

    def apply(self, change: RouteChange, now: float) -> None: ...

    def rest(self, relayed: Relayed, peer: ClientName, now: float) -> None: ...

    def told(self, relayed: Relayed, now: float) -> None: ...


@dataclass(slots=True)
class _HeldBack:
    """A stream that waits for `go`: from seq `first` on."""

    first: int
    messages: list[Message] = field(default_factory=list)
    nbytes: int = 0


class _Taker(NamedTuple):
    """A client of a peer that gets a stream there from seq `first` on; `begins`: and has had none of it there."""

    first: int
    begins: bool


class Moves:
    """`home` names the peer that a client is at, None: here, or nowhere."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        streams: MovingStreams,
        *,
        home: Callable[[ClientName], ClientName | None],
    ) -> None:
        self._clients = clients
        self._routing = routing
        self._streams = streams
        self._home = home
        self.asked: Callable[[ClientName], bool] = lambda _client: False
        """Whether a client has said here what it wants; set by the owner."""
        self.deserted: Callable[[ClientName], bool] = lambda _peer: False
        """Whether no client is at a peer; set by the owner."""
        self._held_back: dict[StreamId, dict[ClientName, _HeldBack]] = {}
        self._again: set[StreamId] = set()  # streams whose channel is about to begin again
        self._takes: dict[StreamId, dict[tuple[ClientName, ClientName], _Taker]] = {}  # (peer, client)
        self._said: dict[StreamId, set[tuple[ClientName, ClientName]]] = {}  # and was told to go on
        self._elsewhere: dict[StreamId, set[tuple[ClientName, ClientName]]] = {}  # named by another relay than its home
        self._between: dict[StreamId, float] = {}  # came from a relay that the origin has left: since when
        self.named_by_source: frozenset[ClientName] = frozenset()
        """Clients for whom an announcement says that a stream is, while it is read: they lack nothing of it."""
        self._goes_back: StreamId | None = None  # whose channel ends to begin again at once

    # --- the new home -----------------------------------------------------------------------------------------------

    def holds_back(self, client: ClientName, relayed: Relayed, *, now: float) -> bool:
        """A client is to get a stream: whether it has to wait for `go`."""
        identity = relayed.stream.stream.id
        if is_peer(client) or not relayed.stream.reliable or self._is_source(relayed) or client in self.named_by_source:
            return False
        waiting = self._held_back.setdefault(identity, {})
        if client not in waiting:
            waiting[client] = _HeldBack(relayed.stream.delivered + 1)
        self._say_takes(relayed, client, waiting[client].first, now, begins=True)
        return True

    def _say_takes(self, relayed: Relayed, client: ClientName, first: int, now: float, *, begins: bool) -> None:
        identity = relayed.stream.stream.id
        source = self._routing.via(identity)
        if source is not None:
            said: framing.Envelope = {
                "t": "takes",
                "client": client,
                "origin": identity.origin,
                "boot": identity.boot,
                "topic": identity.topic,
                "next": first,
                "begins": begins,
            }
            self._clients.tell(source, said, now)

    def came_home(self, client: ClientName, now: float) -> None:
        """A client has begun a session here: the sources of what is kept for it are to know what of it that is."""
        for identity in self._routing.received_by(client):
            relayed, held = self._streams.by_id[identity], self._held_back.get(identity, {}).get(client)
            if not relayed.stream.reliable:
                continue
            if held is not None:
                self._say_takes(relayed, client, held.first, now, begins=True)
            elif client in relayed.outs:
                self._say_takes(relayed, client, relayed.outs[client][1].next_seq, now, begins=False)

    def _here(self, client: ClientName) -> bool:
        """Whether a client has its session with this relay."""
        link = self._clients.links.get(client)
        return link is not None and link.established and not is_peer(client) and self._home(client) is None

    def waiting(self, identity: StreamId) -> list[ClientName]:
        """Clients that wait for `go`: they are required."""
        return list(self._held_back.get(identity, ()))

    def confirms_below(self, identity: StreamId) -> int | None:
        """The first message that somebody has not been handed; None: there is none."""
        waiting = self._held_back.get(identity)
        return None if not waiting else min(held.first for held in waiting.values())

    def message(self, identity: StreamId, message: Message) -> None:
        """A message has gone to all others."""
        for client, held in self._held_back.get(identity, {}).items():
            if message.seq < held.first:
                continue
            nbytes = len(message.body) + MESSAGE_BYTES
            if held.nbytes + nbytes <= MAX_HELD_BACK_BYTES:
                held.messages.append(message)
                held.nbytes += nbytes
                continue
            relayed = self._streams.by_id[identity]
            if relayed.source is not None:
                relayed.source.answers.report(relayed.stream, message.seq, DropReason.QUEUE_FULL, client)

    def expect_again(self, identity: StreamId) -> None:
        """The source is about to go back: it ends the channel and begins another one."""
        if identity in self._streams.by_id:
            self._again.add(identity)

    def ends_for_good(self, identity: StreamId, peer: ClientName, *, now: float) -> bool:
        """A peer has ended a channel: whether the stream ends with it."""
        if identity in self._again:
            return False
        if identity not in self._streams.by_id or self._home(identity.origin) == peer:
            return True
        self._between[identity] = now  # its origin has left that relay
        return False

    def left_for(self, identity: StreamId, now: float) -> None:
        """The origin of a stream has gone to a peer, which has not announced it."""
        self._between[identity] = now
        self._no_source(identity)

    def _no_source(self, identity: StreamId) -> None:
        """A stream does not begin here any more: another relay decides who has what of it."""
        for table in (self._takes, self._said, self._elsewhere):
            table.pop(identity, None)

    def came(self, relayed: Relayed, *, now: float) -> None:
        """A peer has announced a stream, perhaps again: it is to know from where on clients take it."""
        identity = relayed.stream.stream.id
        self._between.pop(identity, None)
        if self._is_source(relayed):  # the origin has come here, and sends again what those lack who wait
            for client, held in list(self._held_back.get(identity, {}).items()):
                held.first = min(held.first, relayed.stream.delivered + 1)
                held.messages.clear()
                self._begin(identity, client, now)
            return
        if not relayed.stream.reliable or self._routing.via(identity) is None:
            return
        self._no_source(identity)
        again = identity in self._again
        self._again.discard(identity)
        for client, held in self._held_back.get(identity, {}).items():
            if again:
                held.first = min(held.first, relayed.stream.delivered + 1)
                held.messages.clear()  # they come again
                held.nbytes = 0
            self._say_takes(relayed, client, held.first, now, begins=True)
        for client, (_link, channel) in relayed.outs.items():
            self._say_takes(relayed, client, channel.next_seq, now, begins=False)

    def go(self, client: ClientName, topic: TopicName, *, now: float) -> None:
        """The client gets from now on what it lacks."""
        for identity in [
            each for each, waiting in self._held_back.items() if each.topic == topic and client in waiting
        ]:
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

    def _is_source(self, relayed: Relayed) -> bool:
        """Whether a reliable stream begins here. Of an origin that has gone to another relay it does not."""
        identity = relayed.stream.stream.id
        begins_here = self._routing.via(identity) is None and self._home(identity.origin) is None
        return relayed.stream.reliable and begins_here

    def up(self, peer: ClientName) -> None:
        """A session with a peer begins: what it was told in the one before it may not know, and it says anew what its
        clients take."""
        for pairs in self._said.values():
            pairs -= {pair for pair in pairs if pair[0] == peer}
        for table in self._takes.values():
            for pair in [pair for pair in table if pair[0] == peer]:
                del table[pair]

    def takes(
        self, link: Link, client: ClientName, identity: StreamId, first: int, *, begins: bool, now: float
    ) -> None:
        """A client of a peer gets a stream there from seq `first` on; `begins`: it has had none of it there before."""
        relayed = self._streams.by_id.get(identity)
        if relayed is None or not self._is_source(relayed) or link.peer not in relayed.outs:
            return
        if self._home(client) != link.peer:
            return  # it is somewhere else by now
        self._takes.setdefault(identity, {})[link.peer, client] = _Taker(first, begins)
        self._pass_on(relayed, link, relayed.outs[link.peer][1], now)

    def named(self, link: Link, channel: OutChannel, *, now: float) -> None:
        """A peer has said for whom a stream is that has its source here."""
        identity = channel.stream.id
        relayed = self._streams.by_id.get(identity)
        if relayed is None or not self._is_source(relayed):
            return
        peer, names = link.peer, [ClientName(name) for name in channel.required]
        said, elsewhere = self._said.setdefault(identity, set()), self._elsewhere.setdefault(identity, set())
        said -= {pair for pair in said if pair[0] == peer and pair[1] not in names}
        elsewhere -= {pair for pair in elsewhere if pair[0] == peer}
        elsewhere |= {(peer, name) for name in names if self._home(name) != peer}
        self._pass_on(relayed, link, channel, now)
        self._release_elsewhere(identity, now)

    def _pass_on(self, relayed: Relayed, link: Link, channel: OutChannel, now: float) -> None:
        """Let a peer's clients have the stream from there, once the peer has named them and everything is there."""
        identity, peer = channel.stream.id, link.peer
        known, said = self._takes.get(identity, {}), self._said.setdefault(identity, set())
        pairs = [(peer, ClientName(name)) for name in channel.required]
        due = [pair for pair in pairs if pair in known and pair not in said and self._home(pair[1]) == peer]
        lacking = [held for pair in due if (held := self._lacking(relayed, channel, pair, known[pair])) is not None]
        if lacking:  # nor may those lack anything who had the stream there before
            further = min((channel, *lacking), key=lambda each: each.watermark)
            for pair in [pair for pair in known if pair[0] == peer]:
                del known[pair]  # the peer says so again
            self._go_back(relayed, link, channel, further, now)
            return
        for _peer, name in due:
            said.add((peer, name))
            del known[peer, name]
            self._clients.tell(peer, {"t": "go", "client": name, "topic": identity.topic}, now)
            self._release(relayed, name, peer, now)

    def _lacking(
        self, relayed: Relayed, channel: OutChannel, pair: tuple[ClientName, ClientName], taker: _Taker
    ) -> OutChannel | None:
        """The channel with what a client of a peer does not get there; None: it gets all that is kept for it."""
        peer, client = pair
        held = self._held(relayed, client, peer)
        if held is None or held.watermark + 1 >= taker.first:
            return None
        return held if taker.begins or channel.first_seq > taker.first else None

    def settled(self, identity: StreamId, client: ClientName) -> bool:
        """Whether a client gets a stream that begins here at the peer where it is."""
        relayed, home = self._streams.by_id[identity], self._home(client)
        return home in relayed.outs and (home, client) in self._said.get(identity, ())

    def _settled(self, relayed: Relayed, client: ClientName) -> bool:
        """Whether the client gets the stream at its home, or does not want it there."""
        home = self._home(client)
        if home is not None:
            return self.settled(relayed.stream.stream.id, client)
        return self._here(client) and (client in relayed.outs or self.asked(client))

    def _release_elsewhere(self, identity: StreamId, now: float) -> None:
        """Relays that name a client which gets the stream at its home: they need not."""
        relayed = self._streams.by_id[identity]
        for peer, client in sorted(self._elsewhere.get(identity, ())):
            if self._home(client) != peer and self._settled(relayed, client):
                self._clients.tell(peer, {"t": "released", "client": client, "topic": identity.topic}, now)

    def sweep(self, *, now: float) -> None:
        """Ask for what is kept here for clients of peers, and end what no relay has announced after its origin came
        there. Call about once a second."""
        for identity, since_s in list(self._between.items()):
            if now - since_s >= BETWEEN_S:
                self._streams.apply(self._routing.withdraw(identity), now)
        for identity in list(self._elsewhere):
            self._release_elsewhere(identity, now)
        for client, link in self._clients.links.items():
            home = None if link.established or is_peer(client) else self._home(client)
            for identity in () if home is None else self._routing.received_by(client):
                relayed = self._streams.by_id[identity]
                if home is not None and client in relayed.outs and self._is_source(relayed):
                    self._clients.tell(home, {"t": "owed", "client": client, "topic": identity.topic}, now)
        for peer in sorted(self._routing.peers):
            other = self._clients.links.get(peer)
            if other is not None and not other.established:
                self._rest(other, now)

    def _rest(self, link: Link, now: float) -> None:
        """A peer is out of reach, and cannot be told `released`: nothing is kept for it in streams that its clients get
        elsewhere, or that have begun meanwhile while nobody is there."""
        peer = link.peer
        for channel in list(link.sender.channels.values()):
            relayed = self._streams.by_id.get(channel.stream.id)
            if relayed is None or peer not in relayed.outs or channel.wanted is False or not self._is_source(relayed):
                continue
            names = [ClientName(name) for name in channel.required]
            if all(self._settled_but(relayed, name, peer) for name in names) if names else self.deserted(peer):
                self._streams.rest(relayed, peer, now)

    def owed(self, peer: ClientName, client: ClientName, topic: TopicName, *, now: float) -> None:
        """A peer keeps a topic for a client: if that is here, and does not want it, the peer need not."""
        if self._here(client) and self.asked(client) and not self._routing.takes(client, topic):
            self._clients.tell(peer, {"t": "parted", "client": client, "topic": topic}, now)

    def parted(self, peer: ClientName, client: ClientName, topic: TopicName, *, now: float) -> None:
        """A client of a peer does not want a topic that is kept for it."""
        if self._home(client) == peer and client in self._clients.links:
            self.released(client, topic, now=now)

    def keep(self, relayed: Relayed, peer: ClientName, now: float) -> None:
        """The channel to a peer is about to end: keep what its clients have not confirmed in channels of their own."""
        identity = relayed.stream.stream.id
        if not self._is_source(relayed) or identity == self._goes_back:
            return
        for name in map(ClientName, relayed.outs[peer][1].required):
            if name in relayed.outs or name == identity.origin or self._settled_but(relayed, name, peer):
                continue
            self._clients.link(name, now)
            try:
                self._streams.apply(self._routing.also(name, identity.topic), now)
            except RefusedError:
                continue  # it has too many names: what it lacks is dropped and reported

    def _settled_but(self, relayed: Relayed, client: ClientName, but: ClientName) -> bool:
        return self._home(client) != but and self._settled(relayed, client)

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
        self._goes_back = identity
        self._streams.close(link.peer, identity, DropReason.UNWANTED, now)
        self._goes_back = None
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

    def begin_for(self, peer: ClientName, relayed: Relayed, first: int) -> OutChannel | None:
        """A peer, or a client of this relay, is to get a stream from seq `first` on: the channel with what a client has
        not confirmed before that, and that has come there; None: there is none."""
        if not self._is_source(relayed):
            return None
        held: OutChannel | None = None
        for name, (_link, channel) in relayed.outs.items():
            behind = map(ClientName, channel.required) if is_peer(name) else (name,)
            if is_peer(peer):
                come = name != peer and any(self._home(client) == peer for client in behind)
            else:
                come = is_peer(name) and peer in behind
            if come and channel.watermark + 1 < (first if held is None else held.watermark + 1):
                held = channel
        return held

    def go_on_with(self, held: OutChannel, link: Link, channel: OutChannel, now: float) -> None:
        """Hand over what is held."""
        _submit([out.message for out in held.retained], link, channel, now)

    def began(self, client: ClientName, relayed: Relayed, now: float) -> None:
        """A client of this relay gets a stream: relays that name it need not hold it any more."""
        if not self._is_source(relayed) or not self._here(client):
            return
        others = {
            (name, client)
            for name, (_link, channel) in relayed.outs.items()
            if is_peer(name) and client in channel.required
        }
        if others:
            self._elsewhere.setdefault(relayed.stream.stream.id, set()).update(others)
            self._release_elsewhere(relayed.stream.stream.id, now)

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

    def not_needed(self) -> list[ClientName]:
        """Clients of peers of which nothing is kept here any more."""
        away = [client for client, link in self._clients.links.items() if not (link.established or is_peer(client))]
        return [
            client
            for client in away
            if self._home(client) is not None
            and not self._clients.links[client].sender.channels
            and all(map(self._routing.via, self._routing.streams_of(client)))
        ]

    def ended(self, identity: StreamId) -> None:
        """The stream is gone."""
        for table in (self._held_back, self._takes, self._said, self._elsewhere):
            table.pop(identity, None)
        self._again.discard(identity)
        self._between.pop(identity, None)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        for table in (self._held_back, self._takes, self._said, self._elsewhere):
            assert table.keys() <= self._streams.by_id.keys(), "moves of streams that are gone"
        assert self._between.keys() <= self._streams.by_id.keys(), "streams are waited for that are gone"
        assert self._again <= self._streams.by_id.keys(), "streams are expected again that are gone"


def _submit(messages: list[Message], link: Link, channel: OutChannel, now: float) -> None:
    for message in messages:
        if message.replay or message.seq < channel.next_seq:
            continue
        if message.seq > channel.next_seq:
            link.outgoing.skip(channel, message.seq, now=now)
        link.sender.submit(channel, message, now=now, forced=True)
