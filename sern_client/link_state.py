"""Says at this site who is there: in the log, on ROS, over HTTP and in the metrics; and ends topics of who is not.

Everything is made here, from what the core knows (`sern_core/site/peers.py`), so a full link cannot keep it from the
site's nodes: what has to come over the link is a relay's few words of control about each peer.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Final, Protocol

from sern_client.link_topics import LinkTopics, LinkView
from sern_core.site.client import ClientCore
from sern_core.site.peers import MAX_PEERS, PeerChange, PeerStatus, PeerView
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime import clock
from sern_runtime.events import EventLog
from sern_runtime.loop import Timer
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts

PART: Final = "link_state"
MAX_NAMED: Final = 8
"""Peers that are named in one line."""

_log = logging.getLogger(__name__)


class Withdraws(Protocol):
    """Ends the topics of an origin here, and lets them come back."""

    def withdraw(self, origin: ClientName) -> None: ...

    def restore(self, origin: ClientName) -> None: ...


class LinkState:
    """`start` when the endpoint is, `close` before it ends. `topics` None: nothing is published. `reason` says why
    there is no session."""

    def __init__(
        self,
        core: ClientCore,
        topics: LinkTopics | None,
        withdrawal: Withdraws,
        *,
        period_s: float,
        withdraw_after_s: float | None,
        reason: Callable[[], str],
        parts: OptionalParts,
        events: EventLog | None = None,
    ) -> None:
        self._events = events or EventLog()
        self._core = core
        self._topics = topics
        self._withdrawal = withdrawal
        self._period_s = period_s
        self._withdraw_after_s = withdraw_after_s
        self._reason = reason
        self._parts = parts
        self._timer = Timer(self._due)
        self._started = False
        self._own_up = False
        self._own_since_s = clock.now()
        self._there: set[ClientName] = set()  # of whom that was said
        self._gone_s: dict[ClientName, float] = {}  # who was said to be gone, also when nothing else knows it any more
        core.peers.on_change = self._changed

    def start(self) -> None:
        self._started = True
        self.soon()

    def close(self) -> None:
        self._started = False
        self._timer.close()
        if self._topics is not None:
            self._topics.close()

    @property
    def held(self) -> Counter[TopicName]:
        """What is open at the endpoint for this, by local name."""
        return Counter() if self._topics is None else self._topics.held

    def repair(self, names: set[TopicName]) -> None:
        if self._topics is not None:
            self._topics.repair(names)

    def soon(self) -> None:
        """Something has changed: it is said before the loop comes round again."""
        if self._started:
            self._timer.arm(clock.now())

    def look(self) -> None:
        """See who is there. Call about twice a second."""
        now = clock.now()
        with self._parts.survive(PART):
            self._own_now(now)
            names = {peer.name for peer in self._core.look_at_peers(now=now)}
            self._there &= names

    def _changed(self, change: PeerChange) -> None:
        """Also said once where our own link was down in between: of that one line speaks for all."""
        self.soon()
        name, now = change.name, clock.now()
        if change.forgotten:
            gone_s = self._gone_s.pop(name, None)
            if gone_s is not None:
                self._events.say(
                    _log, logging.WARNING, "peer_forgotten", name,
                    "%s is forgotten after %.1f s: it has nothing that is wanted here, as far as the relay says",
                    name, now - gone_s,
                )  # fmt: skip
        elif change.given_up:
            self._events.say(
                _log, logging.WARNING, "peer_given_up", name,
                "%s is given up by the relay after %.0f s: its topics end, and it is gone until it is back",
                name, change.lasted_s,
            )  # fmt: skip
        elif change.new is PeerStatus.GONE and name not in self._gone_s:
            while len(self._gone_s) >= MAX_PEERS:
                del self._gone_s[next(iter(self._gone_s))]
            self._gone_s[name] = now
            words = "%s is gone: the relay does not reach it any more"
            self._events.say(_log, logging.WARNING, "peer_gone", name, words, name)
        elif change.new is PeerStatus.CONNECTED:
            gone_s = self._gone_s.pop(name, None)
            if gone_s is not None:
                away_s = now - gone_s
                words = "%s is back after %.1f s"
                self._events.say(_log, logging.WARNING, "peer_back", name, words, name, away_s, away_s=away_s)
            elif name not in self._there:
                self._events.say(_log, logging.INFO, "peer_there", name, "%s is there", name)
            self._there.add(name)

    def _due(self) -> None:
        now = clock.now()
        self._timer.arm(now + self._period_s)
        with self._parts.survive(PART):
            self._withdraw(now)
        with self._parts.survive(PART):
            if self._topics is not None:
                self._topics.publish(self.views(), time.time_ns())

    def _withdraw(self, now: float) -> None:
        after_s = self._withdraw_after_s
        if after_s is None:
            return
        for peer in self._core.look_at_peers(now=now):
            if peer.status is PeerStatus.CONNECTED:
                self._withdrawal.restore(peer.name)
            elif peer.since_s >= after_s and (peer.age_s is None or peer.age_s >= after_s):
                self._withdrawal.withdraw(peer.name)

    # --- views ------------------------------------------------------------------------------------------------------

    def views(self) -> list[LinkView]:
        """Our own link, and then every peer."""
        now = clock.now()
        peers = self._core.look_at_peers(now=now)
        return [self._own(peers, now), *(self._view(peer) for peer in peers)]

    def _own(self, peers: list[PeerView], now: float) -> LinkView:
        link = self._core.link
        up = self._own_now(now)
        ages_s = [peer.age_s for peer in peers if peer.age_s is not None]
        return LinkView(
            link.peer,
            True,
            PeerStatus.CONNECTED if up else PeerStatus.GONE,
            now - self._own_since_s,
            min(ages_s, default=None),
            self._own_rtt_s,
            link.peer,
            link.lane.name,
            "" if up else "no acknowledgement comes" if link.established else self._reason(),
        )

    def _own_now(self, now: float) -> bool:
        """Whether the relay answers; a change is published at once."""
        link = self._core.link
        up = link.established and not link.lane.stalled
        if up is not self._own_up:
            self._own_up, self._own_since_s = up, now
            self.soon()
        return up

    def _view(self, peer: PeerView) -> LinkView:
        own_s = self._own_rtt_s
        whole = own_s is not None and peer.rtt_s is not None
        why = {
            PeerStatus.CONNECTED: "",
            PeerStatus.GONE: "given up by the relay" if peer.given_up else "the relay does not reach it",
            PeerStatus.UNKNOWN: "the relay does not say" if self._own_up else "our own link is down",
        }[peer.status]
        return LinkView(
            peer.name,
            False,
            peer.status,
            peer.since_s,
            peer.age_s,
            own_s if own_s is None or peer.rtt_s is None else own_s + peer.rtt_s,
            peer.name if whole else self._core.link.peer,
            peer.lane,
            why,
            peer.given_up,
        )

    @property
    def _own_rtt_s(self) -> float | None:
        rtt = self._core.link.lane.flight.rtt
        return rtt.srtt_s if rtt.samples else None

    def detail(self) -> str:
        """Who is not there, for /readyz: empty when all are."""
        views = [view for view in self.views() if not view.own]
        away = [view for view in views if view.status is not PeerStatus.CONNECTED]
        if not away:
            return ""
        named = ", ".join(view.line for view in away[:MAX_NAMED]) + (", ..." if len(away) > MAX_NAMED else "")
        return f"{len(away)} of {len(views)} peers away: {named}"

    def to_json(self) -> list[dict[str, object]]:
        """A row for each peer, as /api/peers tells it."""
        return [
            {
                "peer": view.peer,
                "connected": view.status is PeerStatus.CONNECTED,
                "status": str(view.status),
                "since_s": view.since_s,
                "age_s": view.age_s,
                "round_trip_s": view.round_trip_s,
                "round_trip_to": view.round_trip_to,
                "lane": view.lane,
                "given_up": view.given_up,
            }
            for view in self.views()
            if not view.own
        ]

    def register(self, metrics: Metrics) -> None:
        def look() -> list[PeerView]:
            return self._core.look_at_peers(now=clock.now())

        metrics.gauge(
            "sern_peer_connected",
            "1 while the relay reaches a client whose streams we take, and we reach the relay.",
            ("peer",),
            lambda: [((peer.name,), float(peer.status is PeerStatus.CONNECTED)) for peer in look()],
        )
        metrics.gauge(
            "sern_peer_age_seconds",
            "Time since a message of that client came here.",
            ("peer",),
            lambda: [((peer.name,), peer.age_s) for peer in look() if peer.age_s is not None],
        )
