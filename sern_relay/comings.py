"""Who comes and goes, in the log: each loss is said once, and so is the return."""

import logging
from collections.abc import Mapping
from typing import Final

from sern_core.link.link import Link
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.outages import Outages

_log: Final = logging.getLogger(__name__)


class Comings:
    """Says of each client when it comes, goes, or falls silent. Call `look` about once a second."""

    def __init__(self) -> None:
        self._away_since_s: dict[ClientName, float] = {}
        self._outages = Outages(_log, logging.INFO)  # as clients that come and go

    def up(self, client: ClientName, *, resumed: bool) -> None:
        away_since_s = self._away_since_s.pop(client, None)
        if away_since_s is None:
            _log.info("%s connected%s", client, " again" if resumed else "")
        else:
            _log.info("%s connected again, after %.0f s", client, clock.now() - away_since_s)

    def down(self, client: ClientName, reason: str) -> None:
        self._away_since_s[client] = clock.now()
        self._outages.forget(client)
        _log.info("%s is away: %s", client, reason)

    def look(self, links: Mapping[ClientName, Link], now: float) -> None:
        """Say which client has been silent for a while in a session that goes on, and when it is not any more."""
        for client, link in links.items():
            if not link.established:
                continue
            self._outages.look(
                client, lost=link.lane.stalled, now=now,
                gone=f"{client} does not answer; its session waits for it", back=f"{client} answers again",
            )  # fmt: skip
        for client in self._away_since_s.keys() - links.keys():  # nobody waits for it any more
            del self._away_since_s[client]
