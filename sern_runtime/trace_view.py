"""The decision trace over HTTP: /api/trace, and of one topic its story.

topic=/jackal1/odom  this topic alone: its streams with what waits of them and why, their counters, and the records
peer=NAME            of a relay: the link to this client alone

Without a topic the answer is the list of all records. A relay records what is out of the ordinary only.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, Final, NamedTuple

from sern_core.link.link import Link
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.trace import DecisionTrace, record_json
from sern_core.vocabulary.types import CLASS_LABELS, TopicName
from sern_runtime.http_routes import JsonParts, JsonQuery, UnknownError

MAX_STREAMS: Final = 64
"""Streams of one topic that are told of: a relay may have a thousand subscribers of one."""
NAMED: Final = 8
"""Topics that the answer about an unknown one names."""
OWN: Final = "/_sern/"
"""Streams of the link itself."""
TOO_LARGE: Final = "the answer is too large; ask for one topic, or of a relay for one client with peer="


class Seen(NamedTuple):
    """One stream on one link, which goes out there or arrives."""

    link: Link
    stream: StreamInfo
    goes_out: bool


class Source(NamedTuple):
    """What a daemon knows: its traces by the name of the peer, its topics, and the streams of one."""

    traces: Callable[[], Mapping[str, DecisionTrace]]
    topics: Callable[[], Iterable[str]]
    streams: Callable[[TopicName], Iterable[Seen]]


def trace_view(source: Source, now: Callable[[], float]) -> JsonQuery:
    """The route of /api/trace."""

    def read(query: Mapping[str, str]) -> object:
        traces = source.traces()
        peer = query.get("peer")
        if peer is not None:
            if peer not in traces:
                raise UnknownError(f"no link to {peer[:80]!r} is traced here; {_known(peer, traces)}")
            traces = {peer: traces[peer]}
        if "topic" not in query:
            return JsonParts(_all(traces.values()), TOO_LARGE)
        topic = TopicName(query["topic"])
        seen = [each for each in source.streams(topic) if peer is None or each.link.peer == peer]
        records = {name: trace for name, trace in traces.items() if trace.records(topic)}
        if not seen and not records:
            raise UnknownError(f"topic {topic[:80]!r} is not known here; {_known(topic, source.topics())}")
        links = sorted({each.link.peer for each in seen[:MAX_STREAMS]} & traces.keys() | records.keys())
        return {
            "topic": topic,
            "now_s": now(),
            "steps": all(trace.steps for trace in traces.values()),
            "streams": [_stream(each, now()) for each in seen[:MAX_STREAMS]],
            "streams_left_out": max(0, len(seen) - MAX_STREAMS),
            "records": [
                record_json(record) for name in links[:MAX_STREAMS] for record in traces[name].about(topic)
            ],
        }  # fmt: skip

    return JsonQuery(("topic", "peer"), read)


def of_client(link: Link, trace: DecisionTrace) -> Source:
    """A client has one link."""

    def streams(topic: TopicName) -> Iterator[Seen]:
        for out in link.topics():
            if out.stream.id.topic == topic:
                yield Seen(link, out.stream, goes_out=True)
        for stream in link.arriving():
            if stream.id.topic == topic:
                yield Seen(link, stream, goes_out=False)

    def topics() -> Iterator[str]:
        yield from (out.stream.id.topic for out in link.topics())
        yield from (stream.id.topic for stream in link.arriving())

    return Source(lambda: {link.peer: trace}, topics, streams)


def _known(name: str, names: Iterable[str]) -> str:
    every = sorted({each for each in names if not each.startswith(OWN)})
    if not every:
        return "none is"
    close = get_close_matches(name, every, n=NAMED, cutoff=0.5)
    shown = [*close, *(each for each in every if each not in close)][:NAMED]
    more = len(every) - len(shown)
    return f"known: {', '.join(shown)}" + (f" and {more} more" if more else "")


def _all(traces: Iterable[DecisionTrace]) -> Iterator[str]:
    yield "["
    first = True
    for trace in traces:
        for record in trace.records():
            yield ("" if first else ", ") + json.dumps(record_json(record))
            first = False
    yield "]"


def _stream(seen: Seen, now: float) -> dict[str, Any]:
    link, stream, goes_out = seen
    spec = stream.spec
    told: dict[str, Any] = {
        "peer": link.peer,
        "origin": stream.id.origin,
        "direction": "send" if goes_out else "receive",
        "up": link.established,
        "class": CLASS_LABELS[spec.priority],
        "reliable": spec.reliable,
        "latched": spec.latched,
        "depth": spec.depth,
        "lifespan_s": spec.lifespan_s,
        "max_rate_hz": spec.max_rate_hz,
    }
    sending = link.sending(stream.id, now=now) if goes_out else None
    if sending is None:
        return told
    counters = sending.counters
    return told | {
        "wanted": sending.wanted,
        "standing": sending.standing,
        "offered": counters.offered,
        "delivered": counters.delivered,
        "refused": counters.refused,
        "dropped": {
            str(reason): count for reason, count in counters.by_reason.items() if count and reason != "refused"
        },
    }
