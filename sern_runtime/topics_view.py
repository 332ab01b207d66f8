"""Counters of topics as JSON: for /api/topics, the summaries written at exit, and the tools that read them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

from sern_core.link.link import Link
from sern_core.link.view import CodecView
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.vocabulary.ledger import NO_DROPS, ReceiveCounters, ReceiveLedger
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, TopicName

TopicView = dict[str, Any]
"""The counters of one topic, as `json.dumps` takes them."""


def link_summary(link: Link, *, direction: str) -> dict[str, TopicView]:
    """What was offered to a link and what became of it: offered = delivered + dropped + in_queue + in_flight."""
    return dict(link_rows(link, direction=direction))


def link_rows(link: Link, *, direction: str) -> Iterator[tuple[str, TopicView]]:
    """The same, each row made when it is asked for. `answered`: the peer has said whether it wants it; `thinned`: left
    out for a share that the adaptation has set."""
    for counters, streams, held in link.each_topic():
        if counters.topic == OBJECTS_TOPIC:
            continue  # is nobody's topic; the metrics have it
        newest = streams[-1] if streams else None
        yield (
            counters.topic,
            {
                # The counters are of the class that the topic had first: what was counted stays where it is.
                "class": CLASS_LABELS[counters.priority if newest is None else newest.spec.priority],
                "direction": direction,
                "wanted": any(stream.wanted for stream in streams),
                "answered": any(stream.wanted is not None for stream in streams),
                "max_rate_hz": None if newest is None else newest.spec.max_rate_hz,
                "offered": counters.offered,
                "sent": counters.offered - counters.dropped - held.queued,
                "delivered": counters.delivered,
                "dropped": _dropped(counters.by_reason),
                "refused": counters.refused,
                "thinned": sum(stream.thinned for stream in streams),
                "in_queue": held.queued,
                "in_flight": held.in_flight,
                "bytes_offered": counters.offered_bytes,
                "bytes_delivered": counters.delivered_bytes,
                **_codec_view(None if newest is None else newest.codec),
            },
        )


def _dropped(by_reason: Mapping[DropReason, int]) -> dict[str, int]:
    """What was dropped, by reason. Refused messages were not offered, and are counted apart."""
    if by_reason is NO_DROPS:
        return {}
    return {str(reason): count for reason, count in by_reason.items() if count and reason is not DropReason.REFUSED}


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
    """Every topic that is announced at a relay, who publishes it, and whether anybody takes it: `taken`, of its streams
    any."""
    result: dict[str, TopicView] = {}
    for stream, taken in streams:
        view = result.setdefault(
            stream.id.topic,
            {
                "class": CLASS_LABELS[stream.spec.priority],
                "taken": False,
                "owners": [],
                "latched": stream.spec.latched,
            },
        )
        view["taken"] = view["taken"] or taken
        view["owners"].append(stream.id.origin)
    return result


def received_summary(received: ReceiveLedger, *, now: float) -> dict[str, TopicView]:
    """What arrived, by topic, and how old the freshest sample of each is."""
    return dict(received_rows(received, now=now))


def received_rows(received: ReceiveLedger, *, now: float) -> Iterator[tuple[str, TopicView]]:
    """The same, each row made when it is asked for."""
    for counters in tuple(received.topics.values()):
        yield counters.topic, _arrived(counters, now)


def _arrived(counters: ReceiveCounters, now: float) -> TopicView:
    return {
        "class": CLASS_LABELS[counters.priority],
        "direction": "receive",
        "delivered": counters.delivered,
        "bytes_delivered": counters.delivered_bytes,
        "dropped": _dropped(counters.by_reason),
        "age_s": counters.age_of_information_s(now),
        "last_age_s": counters.age_s,
    }


def both_ways(link: Link, received: ReceiveLedger, *, now: float) -> dict[str, TopicView]:
    """The topics of a client, with type and owners (comma between several; empty when nobody offers it any more).

    One that goes both ways (/tf of several robots) has what arrived under `received`.
    """
    return dict(both_rows(link, received, now=now))


def both_rows(link: Link, received: ReceiveLedger, *, now: float) -> Iterator[tuple[str, TopicView]]:
    """The same, each row made when it is asked for."""
    types: dict[str, str] = {}
    latched: set[str] = set()
    owners: dict[str, set[str]] = {}
    for stream in (*link.offered(), *link.arriving()):
        types.setdefault(stream.id.topic, stream.info.type_name)
        owners.setdefault(stream.id.topic, set()).add(stream.id.origin)
        if stream.spec.latched:
            latched.add(stream.id.topic)

    def about(topic: str) -> TopicView:
        owner = ",".join(sorted(owners.get(topic, ())))
        return {"type": types.get(topic, ""), "owner": owner, "latched": topic in latched}

    arrived = dict(received.topics)
    for name, view in link_rows(link, direction="send"):
        counters = arrived.pop(TopicName(name), None)
        received_too = {} if counters is None else {"received": _arrived(counters, now)}
        yield name, view | received_too | about(name)
    for topic, counters in arrived.items():
        yield topic, _arrived(counters, now) | about(topic)
