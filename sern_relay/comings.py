"""Who comes and goes: in the log and as events, each loss said once, and so is the return; and what is known of each
client for /api/clients."""

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from sern_core.link.handshake import DISPLACED
from sern_core.link.link import Link
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.events import EventLog
from sern_runtime.outages import Outages

CONNECTED: Final = "connected"
AWAY: Final = "away"
FORGOTTEN: Final = "forgotten"
TAKEOVER: Final = "takeover"
DENIED: Final = "denied"
"""Kinds of events, beside those of `Outages`."""
TURNS: Final = 3
TURN_S: Final = 60.0
"""A client whose session passes from one process or relay to another more often than this in so many seconds is two
processes. One that goes over to another relay, and perhaps back, is none."""

_log: Final = logging.getLogger(__name__)


@dataclass(slots=True)
class Coming:
    """What is remembered of a client. `heard_s`: when it was last heard, if its link is gone by now."""

    since_s: float
    up: bool = False
    why: str = ""
    """Why it is away."""
    address: str = ""
    """Where it came from last."""
    sessions: int = 0
    takeovers: int = 0
    turns: deque[float] = field(default_factory=lambda: deque(maxlen=TURNS + 1))
    """When its session last passed to another process or relay."""
    told_s: float = -math.inf
    """When it was last said that this happens too often."""
    waited_for: bool = False
    """It was lost, and the relay keeps what is for it."""
    heard_s: float | None = None


class Comings:
    """Says of each client when it comes, goes, or falls silent. Call `look` about once a second.

    `remembered(client)` says of whom something is kept when nobody waits for it any more: names of the directory,
    which bound it. `address(client)` is where it comes from now. `relay` is this relay's name.
    """

    def __init__(
        self,
        events: EventLog | None = None,
        *,
        relay: str = "",
        remembered: Callable[[ClientName], bool] = lambda _client: False,
        address: Callable[[ClientName], str] = lambda _client: "",
    ) -> None:
        self.clients: dict[ClientName, Coming] = {}
        """All that have come and are remembered."""
        self.takeovers = 0
        """Of all clients."""
        self._events = events or EventLog()
        self._relay = relay
        self._remembered = remembered
        self._address = address
        self._outages = Outages(_log, logging.INFO, events=self._events)  # as clients that come and go

    def up(self, client: ClientName, *, resumed: bool) -> None:
        now = clock.now()
        coming = self._of(client, now)
        before, coming.address = coming.address, self._address(client)
        away_s = now - coming.since_s if coming.waited_for else None
        coming.up, coming.since_s, coming.why, coming.waited_for = True, now, "", False
        coming.sessions += 1
        details: dict[str, object] = {"address": coming.address, "resumed": resumed}
        if before and before != coming.address:
            details["address_before"] = before
        where = f", from {coming.address}" if coming.address else ""
        if away_s is None:
            again = " again" if resumed else ""
            words = "%s connected%s%s"
            self._events.say(_log, logging.INFO, CONNECTED, client, words, client, again, where, **details)
        else:
            self._events.say(
                _log, logging.INFO, CONNECTED, client, "%s connected again, after %.0f s%s", client, away_s, where,
                away_s=away_s, **details,
            )  # fmt: skip

    def down(self, client: ClientName, reason: str) -> None:
        now = clock.now()
        coming = self._of(client, now)
        lasted_s = now - coming.since_s
        coming.up, coming.since_s, coming.why, coming.waited_for = False, now, reason, True
        self._outages.forget(client)
        self._events.say(
            _log, logging.INFO, AWAY, client, "%s is away: %s", client, reason, reason=reason, lasted_s=lasted_s
        )

    def refused(self, client: ClientName, code: str, text: str) -> None:
        """The relay does not take something of a client's, or gives its session to another process of its name."""
        kind = TAKEOVER if code == DISPLACED else DENIED
        self._events.say(_log, logging.WARNING, kind, client, "%s: %s", client, text, code=code)
        if kind == TAKEOVER:
            self._count(client)
            self._turn(client, f"two processes take its session at {self._relay or 'this relay'} from each other")

    def went_over(self, client: ClientName, relay: str, *, came: bool) -> None:
        """Its session has passed here from another relay (`came`), or there."""
        both = (relay, self._relay) if came else (self._relay, relay)
        if self._turn(client, f"its sessions begin at the relays {both[0]} and {both[1]} in turn", relay=relay):
            self._count(client)

    def _count(self, client: ClientName) -> None:
        self._of(client, clock.now()).takeovers += 1
        self.takeovers += 1

    def _turn(self, client: ClientName, what: str, **details: object) -> bool:
        """Whether this has happened too often of late; then it is said, once in a while."""
        now = clock.now()
        coming = self._of(client, now)
        turns = coming.turns
        turns.append(now)
        if len(turns) <= TURNS or now - turns[0] > TURN_S:
            return False
        if now - coming.told_s >= TURN_S:
            coming.told_s = now
            self._events.say(
                _log, logging.ERROR, TAKEOVER, client,
                "%s: %s, %d times in %.0f s: two processes have one name and key; give each its own",
                client, what, len(turns), now - turns[0], **details,
            )  # fmt: skip
        return True

    def look(self, links: Mapping[ClientName, Link], now: float) -> None:
        """Say which client has been silent for a while in a session that goes on, and when it is not any more; and
        who is waited for no longer."""
        for client, link in links.items():
            if is_peer(client):
                continue  # it is no client
            if not link.established:
                continue
            self._outages.look(
                client, lost=link.lane.stalled, now=now,
                gone=f"{client} does not answer; its session waits for it", back=f"{client} answers again",
            )  # fmt: skip
            coming = self.clients.get(client)
            if coming is not None:
                coming.heard_s = link.heard_s
        for client in self.clients.keys() - links.keys():
            coming = self.clients[client]
            if coming.waited_for:  # nobody does any more
                coming.waited_for = False
                away_s = now - coming.since_s
                self._events.say(
                    _log, logging.INFO, FORGOTTEN, client, "%s is forgotten, %.0f s after it left", client, away_s,
                    away_s=away_s,
                )  # fmt: skip
            if not self._remembered(client):
                del self.clients[client]

    def _of(self, client: ClientName, now: float) -> Coming:
        coming = self.clients.get(client)
        if coming is None:
            coming = self.clients[client] = Coming(now)
        return coming
