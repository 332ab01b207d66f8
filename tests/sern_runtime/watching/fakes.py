"""A daemon that tells what a test wants to have told."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sern_runtime.watching.history import Look
from sern_runtime.watching.state import TopicPart
from sern_runtime.watching.told import Adapting, Json


def client_row(name: str, state: str = "connected", **fields: Any) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": name, "state": state, "why": "", "address": None, "lane": "udp", "since_s": 12.0, "heard_s": 0.1,
        "round_trip_s": 0.1, "loss": 0.0, "received_bytes": 10, "sent_bytes": 20,
    }  # fmt: skip
    return row | fields


def received_row(delivered: int, **fields: Any) -> dict[str, Any]:
    row: dict[str, Any] = {
        "class": "bulk", "direction": "receive", "delivered": delivered, "bytes_delivered": 1000 * delivered,
        "dropped": {}, "age_s": 0.2,
    }  # fmt: skip
    return row | fields


ABOUT: Json = {"policy": "mmcf", "profile": "teleoperation", "weights": {}, "floors": {}, "interval_s": 1.0}


@dataclass
class FakeTold:
    """A relay; `topics_told` maps names to owner and row."""

    clients_told: list[dict[str, Any]] = field(default_factory=list)
    topics_told: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    kinds: list[str] = field(default_factory=list)
    looked: list[Look] = field(default_factory=list)
    adapted: list[Json] = field(default_factory=list)
    """Links of the adaptation; none: there is no adaptation."""
    fails: Exception | None = None

    def head(self) -> Json:
        if self.fails is not None:
            raise self.fails
        return {"name": "hub", "role": "relay", "time": "2026-01-31T12:00:00.000Z", "refused_total": 0}

    def clients(self) -> Iterator[Json]:
        return iter(self.clients_told)

    def links(self) -> Iterator[Json]:
        for row in self.clients_told:
            yield {"peer": row["name"], "rate_bps": 1e6, "queue": {"bulk": {"bytes": 5}}}

    def topics(self) -> Iterator[TopicPart]:
        for name, (owner, row) in self.topics_told.items():
            yield TopicPart("received", "", name, row)
            about = {"class": row["class"], "taken": True, "owners": [owner], "latched": False}
            yield TopicPart("announced", "", name, about)

    def objects(self) -> Iterator[str]:
        return iter(self.kinds)

    def adapting(self) -> Adapting | None:
        return Adapting(ABOUT, iter(self.adapted)) if self.adapted else None

    def looks(self, now: float) -> Iterator[Look]:
        del now
        return iter(self.looked)


def look(
    peer: str, *, up: bool = True, sent: int = 0, received: int = 0, trip_s: float | None = 0.05, loss: float = 0.0
) -> Look:
    return Look(peer, up, 1e6 if up else None, trip_s if up else None, loss, sent, received)
