"""Other relays: which clients are at which, and what this relay asks them for. Pure.

Relays of a fabric have a link to each other, every two of them: each is the other's *peer*. A peer has a name that no
client can have (`@NAME`), and is in many things a client of another kind: it subscribes for the clients behind it and
announces their streams. Of two relays the one whose name comes first says HELLO.

A client is at home where it has begun a session last. Its relay tells the others so, with an *epoch*: one more than the
greatest that it has heard of for that client. The greater epoch holds; of two that are alike, which takes a partition,
the one whose relay's name comes last. Elsewhere the client's session ends: it is an old one, or another process under
its name.
"""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.routing import RoutingTable
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS

MAX_HOMES: Final = 40
"""Clients in one message: an envelope holds 4 KiB."""
MOVED_S: Final = 10.0
"""For so long a client that has come from a peer may lack what was held for it there."""
MAX_EPOCH: Final = 2**62


def says_hello(own: ClientName, peer: ClientName) -> bool:
    """Whether of two relays `own` is to say HELLO (`peer_name` of both)."""
    return own < peer


class Home(NamedTuple):
    """Where a client is. `peer` None: here."""

    epoch: int
    peer: ClientName | None


class Peers:
    """`own` is this relay's own name as a peer. `displaced` is told of a client whose session here is an old one, and
    the peer where it is now; `changed` of one that has come to another relay, or left it."""

    def __init__(
        self,
        own: ClientName,
        clients: Clients,
        routing: RoutingTable,
        *,
        displaced: Callable[[ClientName, ClientName, float], None],
        changed: Callable[[ClientName, float], None],
    ) -> None:
        self.own = own
        self.names: set[ClientName] = set()
        """The peers that there are, reached or not."""
        self._clients = clients
        self._routing = routing
        self._displaced = displaced
        self._changed = changed
        self._homes: dict[ClientName, Home] = {}
        self._came_s: dict[ClientName, float] = {}  # when a client came from a peer
        self._asked: dict[ClientName, tuple[str, ...]] = {}  # what a peer was asked for in its session
        self._asking: dict[ClientName, list[str]] = {}  # what a peer asks for
        self._owed: dict[ClientName, set[TopicName]] = {}  # topics that a peer gets beside that

    # --- peers ------------------------------------------------------------------------------------------------------

    def add(self, peer: ClientName) -> None:
        """There is another relay."""
        self.names.add(peer)
        self._routing.peers.add(peer)

    def up(self, link: Link, *, now: float) -> None:
        """The session with a peer has begun: it is told who is here, and what is wanted."""
        peer = link.peer
        self._asked.pop(peer, None)
        self._leave(peer, now)  # it says anew who is there
        self._say(link, [(client, home.epoch) for client, home in self._homes.items() if home.peer is None], now)
        self.ask(now=now)

    def lost(self, peer: ClientName, *, now: float) -> None:
        """A peer has stayed away for too long: who was there is nowhere."""
        for table in (self._asked, self._asking, self._owed):
            table.pop(peer, None)
        self._leave(peer, now)

    def _leave(self, peer: ClientName, now: float) -> None:
        for client in [client for client, home in self._homes.items() if home.peer == peer]:
            del self._homes[client]
            self._changed(client, now)

    # --- who is where -----------------------------------------------------------------------------------------------

    def home(self, client: ClientName) -> ClientName | None:
        """The peer that a client is at; None: it is here, or nowhere."""
        home = self._homes.get(client)
        return None if home is None else home.peer

    def came(self, client: ClientName, *, now: float) -> None:
        """A client has begun a session here."""
        known = self._homes.get(client)
        if known is not None and known.peer is not None:
            self._came_s[client] = now
        home = self._homes[client] = Home(1 if known is None else known.epoch + 1, None)
        for link in self._links():
            self._say(link, [(client, home.epoch)], now)

    def moved(self, client: ClientName, now: float) -> bool:
        """Whether a client has come here from a peer just now."""
        came_s = self._came_s.get(client)
        if came_s is not None and now > came_s + MOVED_S:
            del self._came_s[client]
        return client in self._came_s

    def left(self, client: ClientName, *, now: float) -> None:
        """A client is given up here."""
        home = self._homes.get(client)
        if home is None or home.peer is not None:
            return
        del self._homes[client]
        self._came_s.pop(client, None)
        for link in self._links():
            self._attempt(link, {"t": "left", "clients": [client]}, now)

    def told(self, peer: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """A peer says who is there. Raises WireError."""
        for name, epoch in _homes(envelope):
            known = self._homes.get(name)
            if known is not None and known.peer != peer and not self._wins(epoch, peer, known):
                continue
            self._homes[name] = Home(epoch, peer)
            if known is not None and known.peer is None:
                self._displaced(name, peer, now)
            if known is None or known.peer != peer:
                self._changed(name, now)

    def told_left(self, peer: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """A peer has given clients up. Raises WireError."""
        for name in map(ClientName, framing.take_strings(envelope, "clients", max_length=64)):
            if self.home(name) == peer:
                del self._homes[name]
                self._changed(name, now)

    def _wins(self, epoch: int, peer: ClientName, known: Home) -> bool:
        return (epoch, peer) > (known.epoch, self.own if known.peer is None else known.peer)

    def _say(self, link: Link, homes: list[tuple[ClientName, int]], now: float) -> None:
        for start in range(0, len(homes), MAX_HOMES):
            told = [list(home) for home in homes[start : start + MAX_HOMES]]
            self._attempt(link, {"t": "here", "clients": told}, now)

    # --- what a peer asks for ---------------------------------------------------------------------------------------

    def asks(self, peer: ClientName, parts: list[str]) -> set[TopicName]:
        """A peer asks for these patterns and names. Returns topics that it gets as well: those that it was to deliver
        to clients which may not have come back yet, if it was started anew. It takes note of them from the
        announcements, and answers for whom they are."""
        self._asking[peer] = parts
        link = self._clients.links.get(peer)
        channels = [] if link is None else link.sender.channels.values()
        owed = self._owed[peer] = {channel.stream.id.topic for channel in channels if channel.required}
        return owed

    def answered(self, link: Link, channel: OutChannel) -> list[str] | None:
        """A peer has said for whom a stream is. Returns what it asks for, if that was owed and is not any more."""
        topic = channel.stream.id.topic
        owed = self._owed.get(link.peer, set())
        if channel.required or topic not in owed:
            return None
        owed.discard(topic)
        return self._asking.get(link.peer)

    # --- what is asked for ------------------------------------------------------------------------------------------

    def ask(self, *, now: float) -> None:
        """Ask the peers for what clients want here, if that has changed."""
        links = list(self._links())
        if not links:
            return
        patterns, names = self._routing.interests()
        wanted = (*patterns, *names)
        for link in links:
            if self._asked.get(link.peer) != wanted:
                self._asked[link.peer] = wanted
                self._subscribe(link, wanted, now)

    def _subscribe(self, link: Link, wanted: tuple[str, ...], now: float) -> None:
        batch: list[str] = []
        batch_bytes = 0
        for text in wanted:
            nbytes = len(text) + 4
            if len(batch) == MAX_STRINGS or batch_bytes + nbytes > framing.MAX_ENVELOPE_BYTES // 2:
                self._attempt(link, {"t": "subscribe", "patterns": batch, "more": True}, now)
                batch, batch_bytes = [], 0
            batch.append(text)
            batch_bytes += nbytes
        self._attempt(link, {"t": "subscribe", "patterns": batch, "more": False}, now)

    # --- both -------------------------------------------------------------------------------------------------------

    def _links(self) -> Iterator[Link]:
        """The peers that are reached."""
        for peer in sorted(self.names):
            link = self._clients.links.get(peer)
            if link is not None and link.established:
                yield link

    def _attempt(self, link: Link, envelope: framing.Envelope, now: float) -> None:
        self._clients.tell(link.peer, envelope, now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._asked.keys() <= self.names, "peers are asked that are gone"
        for client, home in self._homes.items():
            assert is_client_name(client), f"{client} is no client"
            assert home.peer is None or home.peer in self.names, f"{client} is at {home.peer}, which is gone"


def _homes(envelope: framing.Envelope) -> Iterator[tuple[ClientName, int]]:
    """Raises WireError."""
    told = envelope.get("clients")
    if not isinstance(told, list):
        raise WireError("here without clients")
    for each in told:
        if not (isinstance(each, list) and len(each) == 2 and isinstance(each[0], str) and type(each[1]) is int):
            raise WireError("here with something that is no client")
        if not is_client_name(each[0]) or not 0 < each[1] < MAX_EPOCH:
            raise WireError(f"here with {each[0][:64]!r}, epoch {each[1]}")
        yield ClientName(each[0]), each[1]
