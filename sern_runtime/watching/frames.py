"""A view as JSON for the page, in pieces, and bounded: of topics and clients the worst, and how many more there are."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from math import isfinite
from typing import Any, Final

from sern_core.vocabulary.types import CLASS_LABELS
from sern_runtime.http_routes import array
from sern_runtime.watching.alerts import Alert, of_link
from sern_runtime.watching.history import Point
from sern_runtime.watching.state import LinkLine, TopicLine, View, class_order
from sern_runtime.watching.why import LEVELS, OK

MAX_TOPICS: Final = 1000
MAX_LINES: Final = 300
"""Clients, and choices of the adaptation."""
MAX_ALERTS: Final = 50
MAX_EVENTS: Final = 20
REASONS: Final = 5
"""Reasons of drops that are told of a topic."""
STATES: Final = ("silent", "away", "connected", "unknown", "forgotten", "never")
"""States of clients, in the order in which they are told; at the end those that are at another relay."""
Json = dict[str, Any]


def state_frame(
    view: View, alerts: Sequence[Alert], *, adaptation: Mapping[str, Any] | None, objects: Mapping[str, int]
) -> Iterator[str]:
    """What is so now, as the pieces of a JSON object. `adaptation`: what holds for all links; `objects` by kind."""
    up = sum(line.state == "connected" for line in view.links)
    head: Json = {
        "name": view.name,
        "role": view.role,
        "time": view.time,
        "links_up": up,
        "links_known": sum(_rank(line) < STATES.index("forgotten") for line in view.links),
        "links_total": len(view.links),
        "alerts": [asdict(alert) for alert in alerts[:MAX_ALERTS]],
        "alerts_total": len(alerts),
        "peers": _lines(view.peers),
        "choices": [asdict(choice) for choice in view.choices[:MAX_LINES]],
        "choices_total": len(view.choices),
        "adaptation": None if adaptation is None else _adaptation(adaptation),
        "objects": dict(objects),
        "events": [_event(event) for event in view.events[-MAX_EVENTS:]],
        "classes": _classes(view.topics),
        "topics_total": len(view.topics),
        "topics_wrong": sum(line.level in ("bad", "warn") for line in view.topics),
    }
    yield json.dumps(head)[:-1] + ', "links": '
    yield from array(_lines(view.links))
    yield ', "topics": '
    yield from array(_topic(line) for line in _worst(view.topics))
    yield "}"


def links_frame(step_s: float, number: int, left_out: int, links: Iterable[tuple[str, list[Point]]]) -> Iterator[str]:
    """Points of the pictures, as the pieces of a JSON object: `[number, up, capacity, sent, received, round trip in ms,
    loss in per mille]`, rates in kbit/s; null: not known."""
    yield json.dumps({"step_s": step_s, "number": number, "left_out": left_out})[:-1] + ', "links": '
    yield from array([peer, [_point(point) for point in points]] for peer, points in links)
    yield "}"


def _point(point: Point) -> list[float | None]:
    return [
        point.number,
        int(point.up),
        _thousandth(point.capacity_bps),
        _thousandth(point.sent_bps),
        _thousandth(point.received_bps),
        None if point.round_trip_s is None else round(1e3 * point.round_trip_s, 1),
        round(1e3 * point.loss),
    ]


def _thousandth(value: float | None) -> float | None:
    return None if value is None else round(value / 1e3, 1)


def _lines(lines: Iterable[LinkLine]) -> list[Json]:
    in_order = sorted(lines, key=lambda line: (_rank(line), line.peer))
    return [_rounded(asdict(line)) for line in in_order[:MAX_LINES]]


def _rank(line: LinkLine) -> int:
    return STATES.index(line.state) if line.state in STATES else len(STATES)


def _worst(topics: Iterable[TopicLine]) -> list[TopicLine]:
    """Some of the topics: those in trouble of their own first, and those behind a link that is down not before others
    that are well."""

    def place(line: TopicLine) -> tuple[float, int, str]:
        rank = LEVELS.index(OK) + 0.5 if of_link(line.why) else float(LEVELS.index(line.level))
        return rank, class_order(line.priority), line.topic

    return sorted(topics, key=place)[:MAX_TOPICS]


def _topic(line: TopicLine) -> Json:
    """`elsewhere`: what is wrong is wrong with a link, and told there."""
    some = dict(list(line.reasons.items())[:REASONS])
    row = _rounded(asdict(line) | {"reasons": some, "elsewhere": of_link(line.why)})
    del row["reasons_hz"]
    return row


def _classes(topics: Iterable[TopicLine]) -> dict[str, Json]:
    """How much there is of each class, over all topics."""
    found: dict[str, Json] = {
        label: {"topics": 0, "hz": 0.0, "bytes_per_s": 0.0, "drops_hz": 0.0} for label in CLASS_LABELS
    }
    for line in topics:
        row = found.get(line.priority)
        if row is not None:
            row["topics"] += 1
            for key in ("hz", "bytes_per_s", "drops_hz"):
                row[key] += getattr(line, key)
    return {label: _rounded(row) for label, row in found.items()}


def _adaptation(head: Mapping[str, Any]) -> Json:
    return {key: head[key] for key in ("policy", "profile", "weights", "floors", "interval_s")}


def _event(event: Mapping[str, Any]) -> Json:
    return {key: event[key] for key in ("number", "time", "kind", "text")}


def _rounded(row: Json) -> Json:
    """Numbers with as many digits as a page shows; what is not finite is not known."""
    return {
        key: (round(value, 4) if isfinite(value) else None) if isinstance(value, float) else value
        for key, value in row.items()
    }
