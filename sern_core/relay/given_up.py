"""What was lost of clients that were given up: their links are gone, and these counts stay for who reads them later.

A client is given up in one turn: what waits for it is dropped, and its link with all its counters ends. Who looks at
the counters now and then, as a monitor does, would never see that anything was lost.
"""

from collections.abc import Iterable, Iterator
from typing import Final

from sern_core.vocabulary.ledger import LOSSES, SendCounters
from sern_core.vocabulary.types import ClientName

KEPT_S: Final = 3600.0
"""How long they stay, unless the client comes back: then its new link counts from 0."""
MAX_KEPT: Final = 4096
"""Topics of all clients together; beyond, the client that was given up first is forgotten."""


class GivenUp:
    """Counters of reliable topics of which something was lost, by client; of `max_kept` topics at most."""

    def __init__(self, max_kept: int = MAX_KEPT) -> None:
        self._max_kept = max_kept
        self._by_client: dict[ClientName, tuple[float, list[SendCounters]]] = {}
        self._count = 0

    def keep(self, client: ClientName, counters: Iterable[SendCounters], *, now: float) -> None:
        """The client was given up with these counters; those that tell of no loss are left out."""
        self.back(client)
        lost = [each for each in counters if each.reliable_unconfirmed or any(each.by_reason[r] for r in LOSSES)]
        if not lost:
            return
        del lost[self._max_kept :]
        self._by_client[client] = (now, lost)
        self._count += len(lost)
        while self._count > self._max_kept:
            self.back(next(iter(self._by_client)))

    def back(self, client: ClientName) -> None:
        """The client has a link again."""
        kept = self._by_client.pop(client, None)
        if kept is not None:
            self._count -= len(kept[1])

    def sweep(self, *, now: float) -> None:
        """Forget what is older than KEPT_S."""
        for client in [client for client, (at_s, _lost) in self._by_client.items() if now - at_s > KEPT_S]:
            self.back(client)

    def counters(self) -> Iterator[tuple[ClientName, SendCounters]]:
        for client, (_at_s, lost) in tuple(self._by_client.items()):
            for each in lost:
                yield client, each
