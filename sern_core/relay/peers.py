"""Other relays: which clients are at which, and what this relay asks them for. Pure.

Relays of a fabric have a link to each other, every two of them: each is the other's *peer*. A peer has a name that no
client can have (`@NAME`), and is in many things a client of another kind: it subscribes for the clients behind it and
announces their streams. Of two relays the one whose name comes first says HELLO.

A client is at home where it has begun a session last. Its relay tells the others so, with an *epoch*: the time of that
session by its wall clock, in microseconds since 1970, and at the least one more than the greatest that it has heard of
for that client. So a relay that was just started, and has heard of nobody yet, is right about who has come back to it,
as far as the clocks agree. The greater epoch holds; of two that are alike the one whose relay's name comes last.
Elsewhere the client's session ends: it is an old one, or another process under its name. A relay that has it no more
says so to all, since not every one may have heard of the other. What each peer says is kept: the next best of it holds
then.
"""

from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Final, NamedTuple

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.feed_owners import FeedOwners
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS

MAX_HOMES: Final = 40
"""Clients in one message: an envelope holds 4 KiB."""
MAX_EPOCH: Final = 2**62
MAX_CLIENTS: Final = 65_536
"""Clients at all relays together; a peer that says more is no honest one."""


def says_hello(own: ClientName, peer: ClientName) -> bool:
    """Whether of two relays `own` is to say HELLO (`peer_name` of both)."""
    return own < peer


class Home(NamedTuple):
    """Where a client is. `peer` None: here."""

    epoch: int
    peer: ClientName | None


class Peers:
    """`own` is this relay's own name as a peer. `displaced` is told of a client whose session here is an old one, and
    the peer where it is now; `changed` of one that has come to another relay, or left it. `feeds` are the names under
    which relays publish themselves."""

    def __init__(
        self,
        own: ClientName,
        clients: Clients,
        routing: RoutingTable,
        feeds: FeedOwners,
        *,
        displaced: Callable[[ClientName, ClientName, float], None],
        changed: Callable[[ClientName, float], None],
        wall_us: Callable[[float], int],
    ) -> None:
        self.own = own
        self._wall_us = wall_us
        self.names: set[ClientName] = set()
        """The peers that there are, reached or not."""
        self._sorted: tuple[ClientName, ...] = ()  # the same, in order
        self._clients = clients
        self._routing = routing
        self._feeds = feeds
        self.also: Callable[[], Collection[str]] = tuple
        """Names and patterns that are asked for beside what clients want (a subscriber of the feed); set by the
        shell."""
        self._displaced = displaced
        self._changed = changed
        self._homes: dict[ClientName, Home] = {}
        self._said: dict[ClientName, dict[ClientName, int]] = {}  # the epochs with which peers say that they have one
        self._came = False  # a peer has, since all were asked last
        self._wanted: tuple[str, ...] = ()  # what was wanted then
        self._told_own: frozenset[ClientName] = frozenset()  # the relay's own names then
        self._asked: dict[ClientName, tuple[str, ...]] = {}  # what a peer was asked for in its session

    # --- peers ------------------------------------------------------------------------------------------------------

    def add(self, peer: ClientName) -> None:
        """There is another relay."""
        self.names.add(peer)
        self._sorted = tuple(sorted(self.names))
        self._routing.peers.add(peer)
        self._routing.rights.add(peer)

    def up(self, link: Link, *, now: float) -> None:
        """The session with a peer has begun: it is told who is here, and what is wanted."""
        peer = link.peer
        self._asked.pop(peer, None)
        self._came = True
        self._feeds.up(peer)
        self._leave(peer, now)  # it says anew who is there
        self._say(link, [(client, home.epoch) for client, home in self._homes.items() if home.peer is None], now)
        self.ask(now=now)

    def lost(self, peer: ClientName, *, now: float) -> None:
        """A peer has stayed away for too long: who was there is nowhere."""
        self._asked.pop(peer, None)
        self._feeds.lost(peer, now=now)
        self._leave(peer, now)

    def _leave(self, peer: ClientName, now: float) -> None:
        for client in [client for client, said in self._said.items() if peer in said]:
            self._gone(client, peer, now)

    def _gone(self, client: ClientName, peer: ClientName | None, now: float) -> None:
        """A client is at a peer no more, or here (None): it is where the next best says, if anybody does."""
        said = self._said.get(client, {})
        if peer is not None:
            said.pop(peer, None)
        if not said:
            self._said.pop(client, None)
        home = self._homes.get(client)
        if home is None or home.peer != peer:
            return
        del self._homes[client]
        if said:
            epoch, other = max((epoch, each) for each, epoch in said.items())
            self._homes[client] = Home(epoch, other)
        if said or peer is not None:
            self._changed(client, now)

    # --- who is where -----------------------------------------------------------------------------------------------

    def home(self, client: ClientName) -> ClientName | None:
        """The peer that a client is at, or that publishes under this name; None: it is here, or nowhere."""
        home = self._homes.get(client)
        return self._feeds.home(client) if home is None else home.peer

    def at(self) -> Iterator[tuple[ClientName, ClientName]]:
        """The clients of other relays, each with the peer that it is at."""
        return ((client, home.peer) for client, home in self._homes.items() if home.peer is not None)

    def epoch(self, client: ClientName) -> int:
        """That of a client that is here; 0: it is elsewhere, or nowhere."""
        home = self._homes.get(client)
        return home.epoch if home is not None and home.peer is None else 0

    def counts(self) -> dict[ClientName, int]:
        """How many clients are at each peer."""
        counts = dict.fromkeys(sorted(self.names), 0)
        for home in self._homes.values():
            if home.peer is not None:
                counts[home.peer] += 1
        return counts

    def deserted(self, peer: ClientName) -> bool:
        """Whether no client is at a peer."""
        return all(home.peer != peer for home in self._homes.values())

    def came(self, client: ClientName, *, now: float) -> None:
        """A client has begun a session here."""
        known = self._homes.get(client)
        newest = max((0 if known is None else known.epoch, *self._said.get(client, {}).values()))
        home = self._homes[client] = Home(max(self._wall_us(now), newest + 1), None)
        for link in self.reached():
            self._say(link, [(client, home.epoch)], now)

    def left(self, client: ClientName, *, now: float) -> None:
        """A client is given up here."""
        home = self._homes.get(client)
        if home is None or home.peer is not None:
            return
        self._say_left(client, now)
        self._gone(client, None, now)

    def _say_left(self, client: ClientName, now: float) -> None:
        for link in self.reached():
            self._attempt(link, {"t": "left", "clients": [client]}, now)

    def told(self, peer: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """A peer says who is there. Raises WireError."""
        for name, epoch in _homes(envelope):
            if self._feeds.claimed(peer, name):
                continue
            known = self._homes.get(name)
            if known is None and len(self._homes) >= MAX_CLIENTS:
                raise WireError(f"here with more than {MAX_CLIENTS} clients")
            self._said.setdefault(name, {})[peer] = epoch
            if known is not None and known.peer != peer and not self._wins(epoch, peer, known):
                continue
            self._homes[name] = Home(epoch, peer)
            if known is not None and known.peer is None:
                self._say_left(name, now)
                self._displaced(name, peer, now)
            if known is None or known.peer != peer:
                self._changed(name, now)

    def told_left(self, peer: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """A peer has given clients up. Raises WireError."""
        for name in map(ClientName, framing.take_strings(envelope, "clients", max_length=64)):
            self._gone(name, peer, now)

    def _wins(self, epoch: int, peer: ClientName, known: Home) -> bool:
        return (epoch, peer) > (known.epoch, self.own if known.peer is None else known.peer)

    def _say(self, link: Link, homes: list[tuple[ClientName, int]], now: float) -> None:
        for start in range(0, len(homes), MAX_HOMES):
            told = [list(home) for home in homes[start : start + MAX_HOMES]]
            self._attempt(link, {"t": "here", "clients": told}, now)

    # --- what is asked for ------------------------------------------------------------------------------------------

    def ask(self, *, now: float) -> None:
        """Ask the peers for what is wanted here, and say what this relay's own names are, if that has changed."""
        self._feeds.look(now=now)
        wanted = self._routing.interests()
        also = self.also()
        if also:
            wanted = (*wanted, *sorted({*also}.difference(wanted)))
        own = self._feeds.own
        if not self._came and wanted is self._wanted and own == self._told_own:
            return
        self._came, self._wanted, self._told_own = False, wanted, own
        links = list(self.reached())
        self._tell_feeds(links, now)
        for link in links:
            asked = self._asked.get(link.peer)
            if asked is not wanted and asked != wanted:
                self._asked[link.peer] = wanted
                self._subscribe(link, wanted, now)

    def tell_feeds(self, *, now: float) -> None:
        """Say under which names this relay publishes itself: before it announces anything of them."""
        self._feeds.look(now=now)
        self._tell_feeds(self.reached(), now)

    def _tell_feeds(self, links: Iterable[Link], now: float) -> None:
        for link in links:
            said = self._feeds.to_say(link.peer)
            if said is not None:
                self._attempt(link, said, now)

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
        self._attempt(link, {"t": "subscribe", "patterns": batch, "more": False, "peers": True}, now)

    # --- both -------------------------------------------------------------------------------------------------------

    def reached(self) -> Iterator[Link]:
        """The peers that are reached."""
        for peer in self._sorted:
            link = self._clients.links.get(peer)
            if link is not None and link.established:
                yield link

    def _attempt(self, link: Link, envelope: framing.Envelope, now: float) -> None:
        self._clients.tell(link.peer, envelope, now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._asked.keys() <= self.names, "peers are asked that are gone"
        for client, said in self._said.items():
            assert said and said.keys() <= self.names, f"{client} is said to be at {said}"
            assert client in self._homes, f"{client} is said to be at {said}, and is nowhere"
        for client, home in self._homes.items():
            assert home.peer is None or self._said[client][home.peer] == home.epoch, f"nobody says that of {client}"
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
