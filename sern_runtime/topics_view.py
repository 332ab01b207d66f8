"""Counters of topics as JSON: for /api/topics, the summaries written at exit, and the tools that read them."""

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from sern_core.link.link import Link
from sern_core.link.view import CodecView
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import CLASS_LABELS

TopicView = dict[str, Any]
"""The counters of one topic, as `json.dumps` takes them."""


def link_summary(link: Link, *, direction: str) -> dict[str, TopicView]:
    """What was offered to a link and what became of it: offered = delivered + dropped + in_queue + in_flight."""
    held = link.held()
    views = link.topics()
    codecs = {view.stream.id.topic: view.codec for view in views}
    wanted = {view.stream.id.topic for view in views if view.wanted}
    result: dict[str, TopicView] = {}
    for topic, counters in link.counters.items():
        if topic == OBJECTS_TOPIC:
            continue  # is nobody's topic; the metrics have it
        in_queue, in_flight = held.get(topic, (0, 0))
        result[topic] = {
            "class": CLASS_LABELS[counters.priority],
            "direction": direction,
            "wanted": topic in wanted,
            "offered": counters.offered,
            "sent": counters.offered - counters.dropped - in_queue,
            "delivered": counters.delivered,
            "dropped": {str(reason): n for reason, n in counters.by_reason.items() if n and reason != "refused"},
            "refused": counters.refused,
            "in_queue": in_queue,
            "in_flight": in_flight,
            "bytes_offered": counters.offered_bytes,
            "bytes_delivered": counters.delivered_bytes,
            **_codec_view(codecs.get(topic)),
        }
    return result


def _codec_view(codec: CodecView | None) -> TopicView:
    """How a topic is compressed here: the mode in use, what it makes of the messages, and what each mode would."""
    if codec is None:
        return {}
    return {
        "compression": {
            "setting": "auto" if codec.setting is None else str(codec.setting),
            "mode": str(codec.mode),
            "bytes_raw": codec.raw_bytes,
            "bytes_encoded": codec.encoded_bytes,
            "ratio": codec.encoded_bytes / codec.raw_bytes if codec.raw_bytes else None,
            "profiles": {str(mode): asdict(profile) for mode, profile in codec.profiles.items()},
        }
    }


def announced_summary(streams: Iterable[tuple[StreamInfo, bool]]) -> dict[str, TopicView]:
    """Every topic that is announced at a relay, and whether anybody takes it: `taken`, of its streams any."""
    result: dict[str, TopicView] = {}
    for stream, taken in streams:
        view = result.setdefault(stream.id.topic, {"class": CLASS_LABELS[stream.spec.priority], "taken": False})
        view["taken"] = view["taken"] or taken
    return result


def received_summary(received: ReceiveLedger, *, now: float) -> dict[str, TopicView]:
    """What arrived, by topic, and how old the freshest sample of each is."""
    return {
        counters.topic: {
            "class": CLASS_LABELS[counters.priority],
            "direction": "receive",
            "delivered": counters.delivered,
            "bytes_delivered": counters.delivered_bytes,
            "dropped": {str(reason): n for reason, n in counters.by_reason.items() if n},
            "age_s": counters.age_of_information_s(now),
            "last_age_s": counters.age_s,
        }
        for counters in received.topics.values()
    }


def both_ways(link: Link, received: ReceiveLedger, *, now: float) -> dict[str, TopicView]:
    """The topics of a client, with type and owners (comma between several; empty when nobody offers it any more).

    One that goes both ways (/tf of several robots) has what arrived under `received`.
    """
    topics = link_summary(link, direction="send")
    for topic, arrived in received_summary(received, now=now).items():
        if topic in topics:
            topics[topic]["received"] = arrived
        else:
            topics[topic] = arrived
    types: dict[str, str] = {}
    owners: dict[str, set[str]] = {}
    for stream in (*(view.stream for view in link.topics()), *link.arriving()):
        types.setdefault(stream.id.topic, stream.info.type_name)
        owners.setdefault(stream.id.topic, set()).add(stream.id.origin)
    for topic, view in topics.items():
        view["type"] = types.get(topic, "")
        view["owner"] = ",".join(sorted(owners.get(topic, ())))
    return topics
