"""What a client tells over HTTP: the routes under /api that every client has."""

import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from sern_client.bridge import Bridge
from sern_client.link_news import LinkNews
from sern_client.link_state import LinkState
from sern_client.link_topics import LinkView
from sern_client.objects_view import objects_view
from sern_core.site.peers import PeerStatus
from sern_runtime import clock
from sern_runtime.events import EventLog, wall_text
from sern_runtime.http_routes import JsonParts, JsonQuery, JsonSource, table
from sern_runtime.topics_view import both_rows
from sern_runtime.trace_view import of_client, trace_view

TOO_LARGE: Final = "the answer is too large"
MAX_TOLD: Final = 100
"""Names that are told of a list which may be long."""


class ClientViews:
    """The routes of one client. `reason` says why there is no link, `address` where the relay is, `relay` how it is
    with all of them, `by_hand` what is set so."""

    def __init__(
        self,
        name: str,
        bridge: Bridge,
        news: LinkNews,
        link_state: LinkState,
        events: EventLog,
        *,
        reason: Callable[[], str],
        address: Callable[[], str],
        relay: Callable[[], dict[str, object]] = dict,
        by_hand: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        self._name = name
        self._bridge = bridge
        self._core = bridge.core
        self._news = news
        self._link_state = link_state
        self._events = events
        self._reason = reason
        self._address = address
        self._relays = relay
        self._by_hand = by_hand

    def routes(self) -> dict[str, JsonSource | JsonQuery]:
        link, received = self._core.link, self._core.received
        return {
            "/api/clients": self.clients,
            "/api/events": self._events.view(),
            "/api/link": lambda: [self.link()],
            "/api/peers": self._link_state.to_json,
            "/api/site_objects": objects_view(self._core),
            "/api/topics": lambda: JsonParts(table(both_rows(link, received, now=clock.now())), TOO_LARGE),
            "/api/trace": trace_view(of_client(link, self._core.trace), clock.now),
            "/api/values": self._bridge.site.values.view(),
        }

    def link(self) -> dict[str, object]:
        """The link, and what of this client's topics it is sent as, is refused, or stays here."""
        now = clock.now()
        outbound, inbound = self._bridge.outbound, self._bridge.inbound
        return {
            **self._core.link.snapshot(),
            "why": "" if self._up else self._reason(),
            "relay": self._relays(),
            "summaries": outbound.summaries.to_json(now),
            "refused": dict(list(outbound.refused.items())[:MAX_TOLD]),
            "subscriptions_refused": list(inbound.subscription_problems)[:MAX_TOLD],
            # Nobody misses a request that nobody makes.
            "subscribed": [text for text in self._core.subscription.patterns if not self._bridge.asking.takes(text)],
            "by_hand": self._by_hand(),
            "spool": {} if self._bridge.spool is None else self._bridge.spool.in_brief(),
            "stays_here": list(outbound.unnamed)[:MAX_TOLD],
            "now_s": now,
        }

    def clients(self) -> dict[str, Any]:
        """The relay and the peers, in the shape of a relay's answer: what this client does not know is None."""
        return self.head() | {"clients": list(self.rows())}

    def head(self) -> dict[str, Any]:
        """The same without its rows."""
        return {
            "name": self._name,
            "role": "client",
            "time": wall_text(time.time()),
            "now_s": clock.now(),
            "refused": [],
            "refused_total": 0,
            "refused_gone": 0,
        }

    def rows(self) -> Iterator[dict[str, Any]]:
        """The relay and the peers, each as it is when it is asked for."""
        return (self._relay(view) if view.own else _row(view) for view in self._link_state.views())

    @property
    def _up(self) -> bool:
        link = self._core.link
        return link.established and not link.lane.stalled

    def _relay(self, view: LinkView) -> dict[str, Any]:
        now = clock.now()
        link = self._core.link
        seen = link.observe(now=now)
        since_s = None if self._news.since_s is None else now - self._news.since_s
        state = "silent" if link.established and seen.stalled else "connected" if link.established else "away"
        return _row(view) | {
            "state": state if self._news.sessions else "never",
            "address": self._address(),
            **_since(since_s),
            **_heard(None if link.heard_s is None else now - link.heard_s),
            "lane": seen.lane if link.established else None,
            "loss": seen.loss if link.established else None,
            "received_bytes": link.heard_bytes,
            "sent_bytes": seen.wire_bytes,
            "streams": len(link.topics()),
            "sessions": self._news.sessions,
        }


def _row(view: LinkView) -> dict[str, Any]:
    states = {PeerStatus.CONNECTED: "connected", PeerStatus.GONE: "away", PeerStatus.UNKNOWN: "unknown"}
    return {
        "name": view.peer,
        "state": "forgotten" if view.given_up else states[view.status],
        "why": view.why,
        "address": None,
        "lane": view.lane or None,
        **_since(view.since_s),
        **_heard(view.age_s),
        "round_trip_s": view.round_trip_s,
        "loss": None,
        "received_bytes": None,
        "sent_bytes": None,
        "streams": None,
        "sessions": None,
        "takeovers": None,
    }


def _since(since_s: float | None) -> dict[str, Any]:
    return {"since": None if since_s is None else wall_text(time.time() - since_s), "since_s": since_s}


def _heard(heard_s: float | None) -> dict[str, Any]:
    return {"heard": None if heard_s is None else wall_text(time.time() - heard_s), "heard_s": heard_s}
