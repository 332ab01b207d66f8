"""Says in the log, and as events, when the relay is lost, silent, and there again: each loss once, its end with how
long it took; and keeps since when it has been so."""

import logging
from typing import Final

from sern_core.link.handshake import NEW_SESSION
from sern_core.link.link import Link
from sern_runtime import clock
from sern_runtime.events import EventLog
from sern_runtime.outages import Outages
from sern_runtime.transport_watch import NOT_YET

SILENT: Final = "the relay does not answer now; the session waits for it"

_log = logging.getLogger(__name__)


class LinkNews:
    """Is told what becomes of `link`; `relay` is the address it leads to, as a person knows it."""

    def __init__(self, link: Link, relay: str, events: EventLog | None = None) -> None:
        self._events = events or EventLog()
        self.reason = NOT_YET
        """Why the link was last down, in words."""
        self.said: set[tuple[str, str]] = set()
        """Relays and reasons that were said since the last session: an attempt that fails as before is no news."""
        self.outages = Outages(_log, logging.WARNING, events=self._events)
        self.since_s: float | None = None
        """Since when there has been a session, or none after one; None: there never was one."""
        self.sessions = 0
        self._link = link
        self.relay = relay
        """Another one from when the client goes elsewhere."""
        self._down_since_s = clock.now()
        self._stopping = False
        self._up = False

    def leaves(self, reason: str) -> None:
        """The session is about to end for this reason, because the client goes to a relay that it prefers: of that is
        told when it is there."""
        silent_since_s = self.outages.since_s(self._link.peer)
        self._down_since_s = clock.now() if silent_since_s is None else silent_since_s
        self.said.add((self.relay, reason))

    def stopping(self) -> None:
        """What ends from now on ends because we do."""
        self._stopping = True

    def down(self, reason: str) -> None:
        """Told by the transport and by the session on it, usually of the same thing."""
        self.reason = reason
        link, silent_since_s = self._link, None
        if not link.established:  # else the session goes on over the other lane
            silent_since_s = self.outages.since_s(link.peer)
            self.outages.forget(link.peer)
            if self._up:
                self._up, self.since_s = False, clock.now()
        if self._stopping:
            return
        said = self.relay, reason
        if not self.said:
            self._down_since_s = clock.now()
        if silent_since_s is not None:  # it began before anybody gave it up
            self._down_since_s = min(self._down_since_s, silent_since_s)
        if said not in self.said:
            self.said.add(said)
            then = "" if reason == NEW_SESSION else "; trying again until it works"
            self._events.say(
                _log, logging.WARNING, "lost", link.peer, "%s: %s%s", self.relay, reason, then, reason=reason
            )

    def up(self) -> None:
        """A session has begun."""
        self.sessions += 1
        now = self.since_s = clock.now()
        self._up = True
        if self.said:  # in the words and at the level of the loss
            away_s = now - self._down_since_s
            words = "%s: the link is there again, after %.0f s"
            self._events.say(
                _log, logging.WARNING, "connected", self._link.peer, words, self.relay, away_s, away_s=away_s
            )
        else:
            self._events.add("connected", self._link.peer, f"{self.relay}: connected")
        self.said.clear()

    def look(self) -> None:
        """Say that the relay has been silent for a while in a session that goes on, and when it is not any more."""
        link, now = self._link, clock.now()
        if not link.established:
            return
        if self.said and link.handshake.transport_up:  # a session that outlived its connection has another now
            self.said.clear()
            away_s = now - self._down_since_s
            words = "%s: the connection is there again, after %.0f s"
            self._events.say(_log, logging.WARNING, "connection", link.peer, words, self.relay, away_s, away_s=away_s)
        self.outages.look(
            link.peer, lost=link.lane.stalled, now=now,
            gone=f"{self.relay}: {SILENT}", back=f"{self.relay}: the relay answers again",
        )  # fmt: skip
