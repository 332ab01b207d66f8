"""The names under which relays publish what comes in through their plain feeds: each is at home at one relay. Pure.

Every relay tells its peers its names (`feeds`), all of them each time. Two relays with the same name are a fault of
their configuration: both say so, and what either publishes under that name stays there.
"""

from collections.abc import Callable, Set
from typing import Final

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

MAX_OWNERS: Final = 64
"""Names of one relay: one message."""


class FeedOwners:
    """`name` is this relay's, `own` are the names under which it publishes. `clash(peer, text)` is told once of each
    name that a peer has, too; `contested(owner)`, that a name of ours is one that others have by now, or no more."""

    def __init__(
        self,
        name: ClientName,
        own: Set[ClientName],
        *,
        clash: Callable[[ClientName, str], None],
        contested: Callable[[ClientName, float], None],
    ) -> None:
        self._name = name
        self._own = own
        self._clash = clash
        self._contested = contested
        self._at: dict[ClientName, set[ClientName]] = {}  # names by peer
        self._said: dict[ClientName, frozenset[ClientName]] = {}  # what a peer was told in its session
        self._clashes: set[tuple[ClientName, ClientName]] = set()  # (peer, name) that were told
        self._claims: set[tuple[ClientName, ClientName]] = set()  # (peer, client) that were told
        self.stay: set[ClientName] = set()
        """Names of ours that a peer has as well: what is published under them is offered to no peer."""

    def home(self, owner: ClientName) -> ClientName | None:
        """The peer that publishes under this name; None: none does, or we do."""
        if owner in self._own:
            return None
        return min((peer for peer, names in self._at.items() if owner in names), default=None)

    def told(self, peer: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """A peer says what its names are. Raises WireError."""
        names = framing.take_strings(envelope, "owners", max_length=64)
        if len(names) > MAX_OWNERS or not all(map(is_client_name, names)):
            raise WireError("feeds with something that is no name")
        self._at[peer] = set(map(ClientName, names))
        self.look(now=now)

    def claimed(self, peer: ClientName, client: ClientName) -> bool:
        """A peer says that a client is there: whether it has a name of ours, which stays ours."""
        if client not in self._own:
            return False
        if (peer, client) not in self._claims:
            self._claims.add((peer, client))
            text = f"{client} is a client of {peer[1:]}, and a feed role of {self._name} publishes as {client}"
            self._clash(peer, f"{text}: neither gets the other's topics of that name; give the role another name")
        return True

    def lost(self, peer: ClientName, *, now: float) -> None:
        """A peer is gone for good."""
        self._at.pop(peer, None)
        self._said.pop(peer, None)
        self._claims = {claim for claim in self._claims if claim[0] != peer}
        self.look(now=now)

    def up(self, peer: ClientName) -> None:
        """A session with a peer has begun."""
        self._said.pop(peer, None)

    @property
    def own(self) -> frozenset[ClientName]:
        """This relay's own names."""
        return frozenset(self._own)

    def to_say(self, peer: ClientName) -> framing.Envelope | None:
        """What a peer is to be told; None: it knows."""
        own = self.own
        if self._said.get(peer) == own:
            return None
        self._said[peer] = own
        return {"t": "feeds", "owners": sorted(own)[:MAX_OWNERS]}

    def look(self, *, now: float) -> None:
        """Names have come or gone, here or elsewhere: see who else has one of ours."""
        if not self._own and not self.stay:
            return
        clashes = {(peer, owner) for peer, names in self._at.items() for owner in names & self._own}
        for peer, owner in sorted(clashes - self._clashes):
            self._clash(
                peer,
                f"both {self._name} and {peer[1:]} have a feed role that publishes as {owner}: what it publishes stays "
                f"at each of them; give the role another name at one",
            )
        self._clashes = clashes
        changed = self.stay ^ {owner for _peer, owner in clashes}
        self.stay ^= changed
        for owner in sorted(changed):
            self._contested(owner, now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self.stay <= self._own, "names that are not ours"
