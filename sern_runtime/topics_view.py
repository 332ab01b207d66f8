"""Counters of topics as JSON: for /api/topics, the summaries written at exit, and the tools that read them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from sern_core.link.link import Link
from sern_core.link.view import CodecView, Held
from sern_core.link.view import TopicView as Open
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.vocabulary.ledger import NO_DROPS, ReceiveCounters, ReceiveLedger
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, TopicName

TopicView = dict[str, Any]
"""The counters of one topic, as `json.dumps` takes them."""


class _Sent(NamedTuple):
    """What a row of `link_rows` is made of, as it was when the link was looked at."""

    topic: str
    priority: int
    wanted: bool
    answered: bool
    max_rate_hz: float | None
    thinned: int
    offered: int
    delivered: int
    dropped: int
    reasons: Mapping[DropReason, int]
    refused: int
    held: Held
    offered_bytes: int
    delivered_bytes: int
    codec: CodecView | None


def link_summary(link: Link, *, direction: str) -> dict[str, TopicView]:
    """What was offered to a link and what became of it: offered = delivered + dropped + in_queue + in_flight."""
    return dict(link_rows(link, direction=direction))


def link_rows(link: Link, *, direction: str) -> Iterator[tuple[str, TopicView]]:
    """The same, each row made when it is asked for: the link is looked at when the first is, and 2,000 topics take
    some milliseconds then. `answered`: the peer has said whether it wants it; `thinned`: left out for a share that the
    adaptation has set."""
    for sent in _look(link):
        yield (
            sent.topic,
            {
                "class": CLASS_LABELS[sent.priority],
                "direction": direction,
                "wanted": sent.wanted,
                "answered": sent.answered,
                "max_rate_hz": sent.max_rate_hz,
                "offered": sent.offered,
                "sent": sent.offered - sent.dropped - sent.held.queued,
                "delivered": sent.delivered,
                "dropped": {str(reason): n for reason, n in sent.reasons.items() if n and reason != "refused"},
                "refused": sent.refused,
                "thinned": sent.thinned,
                "in_queue": sent.held.queued,
                "in_flight": sent.held.in_flight,
                "bytes_offered": sent.offered_bytes,
                "bytes_delivered": sent.delivered_bytes,
                **_codec_view(sent.codec),
            },
        )


def _look(link: Link) -> list[_Sent]:
    held = link.held()
    open_now: dict[str, list[Open]] = {}
    for view in link.topics():
        open_now.setdefault(view.stream.id.topic, []).append(view)
    nothing = Held(0, 0)
    found = []
    for topic, counters in link.counters.items():
        if topic == OBJECTS_TOPIC:
            continue  # is nobody's topic; the metrics have it
        views = open_now.get(topic, ())
        by_reason = counters.by_reason
        found.append(
            _Sent(
                topic,
                counters.priority,
                any(view.wanted for view in views),
                any(view.wanted is not None for view in views),
                views[-1].spec.max_rate_hz if views else None,
                sum(view.thinned for view in views),
                counters.offered,
                counters.delivered,
                counters.dropped,
                {} if by_reason is NO_DROPS else dict(by_reason),
                counters.refused,
                held.get(topic, nothing),
                counters.offered_bytes,
                counters.delivered_bytes,
                views[-1].codec if views else None,
            )
        )
    return found


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
    by_reason = counters.by_reason
    return {
        "class": CLASS_LABELS[counters.priority],
        "direction": "receive",
        "delivered": counters.delivered,
        "bytes_delivered": counters.delivered_bytes,
        "dropped": {} if by_reason is NO_DROPS else {str(reason): n for reason, n in by_reason.items() if n},
        "age_s": counters.age_of_information_s(now),
        "last_age_s": counters.age_s,
    }


def both_ways(link: Link, received: ReceiveLedger, *, now: float) -> dict[str, TopicView]:
    """The topics of a client, with type and owners (comma between several; empty when nobody offers it any more).

    One that goes both ways (/tf of several robots) has what arrived under `received`.
    """
    return dict(both_rows(link, received, now=now))


def both_rows(link: Link, received: ReceiveLedger, *, now: float) -> Iterator[tuple[str, TopicView]]:
    """The same, each row made when it is asked for. The link is looked at when the first is."""
    types: dict[str, str] = {}
    latched: set[str] = set()
    owners: dict[str, set[str]] = {}
    for stream in (*(view.stream for view in link.topics()), *link.arriving()):
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
