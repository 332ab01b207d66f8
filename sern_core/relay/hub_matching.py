"""When the relay matches whose patterns: in slices, so that nobody's patterns hold up the others. Pure.

Any subscription costs its sender little and the relay much: all names there are may have to be looked at, and a channel
opened for each. So a client's patterns rest after every slice of that work, twice as long as the slice may have
taken, and of the subscriptions that arrive meanwhile only the newest counts: each replaces those before it.
"""

from collections.abc import Callable
from typing import Final

from sern_core.relay.interest import UNIT_S
from sern_core.relay.route_change import RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.types import ClientName

MATCHING_SHARE: Final = 1.0 / 3.0
"""The share of the relay's time that matching the patterns of one client may take."""


class Matching:
    """`subscribe` is called with a subscription whose turn has come, `apply` with what changed after it.

    A port whose client is in `due_s` calls `go_on` at that time; `sweep` does it for clients without one.
    """

    def __init__(
        self,
        routing: RoutingTable,
        subscribe: Callable[[ClientName, list[str], float], None],
        apply: Callable[[RouteChange, float], None],
    ) -> None:
        self._routing = routing
        self._subscribe = subscribe
        self._apply = apply
        self._waiting: dict[ClientName, list[str]] = {}
        self._rested_s: dict[ClientName, float] = {}
        self.due_s: dict[ClientName, float] = {}
        """Clients for whom there is something to do, and from when on."""

    def ask(self, client: ClientName, patterns: list[str], *, now: float) -> None:
        """A client says what it wants, in place of whatever it wanted before: at once, if its patterns have rested."""
        self._waiting[client] = patterns
        self.look(client, now=now)
        if now >= self.due_s[client]:
            self.go_on(client, now=now)

    def look(self, client: ClientName, *, now: float) -> None:
        """Something may have come to match for the client, by another way than `ask`."""
        if client in self._waiting or self._routing.unfinished(client):
            self.due_s[client] = max(now, self._rested_s.get(client, now))

    def go_on(self, client: ClientName, *, now: float) -> None:
        """One slice: take the newest subscription, or go on with the one that was taken."""
        patterns = self._waiting.pop(client, None)
        if patterns is None:
            self._apply(self._routing.go_on(client), now)
        else:
            self._subscribe(client, patterns, now)
        self._rested_s[client] = now + self._routing.spent.units * UNIT_S / MATCHING_SHARE
        self.due_s.pop(client, None)
        self.look(client, now=now)

    def sweep(self, *, now: float) -> None:
        for client, due_s in list(self.due_s.items()):
            if now >= due_s:
                self.go_on(client, now=now)

    def forget(self, client: ClientName) -> None:
        self._waiting.pop(client, None)
        self._rested_s.pop(client, None)
        self.due_s.pop(client, None)
