"""What a stream that goes from one relay to another needs: where their access rules differ, both must grant it. Pure.

Who publishes is judged by the origin's relay and by the taker's, each by its own rules (`RoutingTable.announce`). Of
who subscribes both need to know something of the other:

- The taker's relay knows the client, and asks the rules of the origin's relay for it as well (`peer_rules` has them).
  Until it has heard that a peer has the same rules, or which, a relay gives its clients nothing of that peer's.
- The origin's relay gives a peer only what some client may have that was at home there since the peer came: so a peer
  gets nothing for clients that it has not. It does not take back what it gave when that client moves on, for the peer
  holds what the client has not confirmed. The name of the peer itself counts as such a client, for what it reads.

Rates and queues are bounded by the rules of a client's own relay alone.
"""

from collections.abc import Callable, Container
from typing import Final

from sern_core.relay.access import AccessTable, Right
from sern_core.vocabulary.types import ClientName, TopicName

MIN_SEEN: Final = 4096
"""This many clients that were seen at a peer are remembered; of more, those that are there now."""
TRIED_ENTRIES: Final = 65_536
"""Topics by peer of which it is remembered which clients there may not have them; when full it is emptied."""


class _Seen:
    """Clients that were at home at a peer, in the order in which they came."""

    __slots__ = ("known", "limit", "names")

    def __init__(self, peer: ClientName) -> None:
        self.names = [ClientName(peer[1:])]
        self.known = set(self.names)
        self.limit = MIN_SEEN


class PeerRights:
    """What the routing table asks about peers. `rules` has the rules of a peer where they are not ours; None: it is not
    known which it has."""

    def __init__(self) -> None:
        self.rules: dict[ClientName, AccessTable | None] = {}
        self.home: Callable[[ClientName], ClientName | None] = lambda _client: None
        """Names the peer that a client is at; set by the owner."""
        self.stays: Container[ClientName] = ()
        """Origins whose streams no peer gets; set by the owner."""
        self._seen: dict[ClientName, _Seen] = {}
        self._tried: dict[tuple[ClientName, TopicName], int] = {}  # how many of `_seen` may not have it
        self._tried_by: AccessTable | None = None

    def add(self, peer: ClientName) -> None:
        """There is a peer; nothing is known of it yet."""
        if peer not in self._seen:
            self.lost(peer)

    def lost(self, peer: ClientName) -> None:
        """It has stayed away for too long: nothing is known of it."""
        self.rules[peer] = None
        self._seen[peer] = _Seen(peer)
        self._tried.clear()

    def saw(self, peer: ClientName, client: ClientName) -> bool:
        """A client is at home at a peer. True: for the first time."""
        seen = self._seen[peer]
        if client in seen.known:
            return False
        if len(seen.names) >= seen.limit:  # those that are not there any more make room
            seen.names = [name for name in seen.names if name == peer[1:] or self.home(name) == peer]
            seen.known = set(seen.names)
            seen.limit = max(MIN_SEEN, 2 * len(seen.names))
            self._tried.clear()
        seen.names.append(client)
        seen.known.add(client)
        return True

    def may_have(self, access: AccessTable, peer: ClientName, topic: TopicName) -> tuple[bool, int]:
        """Whether some client at a peer may have a topic by our own rules, and how many were looked at."""
        if access is not self._tried_by or len(self._tried) >= TRIED_ENTRIES:
            self._tried.clear()
            self._tried_by = access
        names = self._seen[peer].names
        first = self._tried.get((peer, topic), 0)
        for index in range(first, len(names)):
            if access.may_subscribe(names[index], topic):
                self._tried[peer, topic] = index  # it is found at once the next time
                return True, index + 1 - first
        self._tried[peer, topic] = len(names)
        return False, len(names) - first

    def may_replay(self, access: AccessTable, peer: ClientName, topic: TopicName) -> bool:
        """Whether some client at a peer may have a topic's earlier messages by our own rules."""
        return any(access.may_replay(client, topic) for client in self._seen[peer].names)

    def grants(self, via: ClientName | None, client: ClientName, topic: TopicName, right: Right) -> bool:
        """Whether the relay that a stream comes from lets a client have it; `via` None: it comes from no other."""
        if via is None or via not in self.rules:
            return True
        table = self.rules[via]
        return table is not None and table.allows(right, client, topic)

    def denies(self, via: ClientName | None, client: ClientName, topic: TopicName) -> bool:
        """Whether the rules of the relay that a stream comes from are known, and do not let a client have it."""
        table = None if via is None else self.rules.get(via)
        return table is not None and not table.may_subscribe(client, topic)
