"""The decision log: bounds, cost when switched off, and stories that end with the reason."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.trace import LINK, OTHER, DecisionTrace, TraceEvent
from sern_core.vocabulary.types import DropReason, TopicName
from tests.exploring import cases

PURE = settings(max_examples=cases(100))
ODOM, MAP = TopicName("/odom"), TopicName("/map")


def test_the_story_of_a_dropped_message() -> None:
    trace = DecisionTrace()
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 1, size_bytes=720)
    trace.record(0.1, ODOM, TraceEvent.ACKED, 1)
    trace.record(1.0, ODOM, TraceEvent.OFFERED, 2, size_bytes=720)
    trace.record(1.0, ODOM, TraceEvent.QUEUED, 2, depth=1)
    trace.record(1.1, LINK, TraceEvent.LINK_DOWN, rtt_s=0.25)
    trace.record(1.2, MAP, TraceEvent.CHOSEN, 9)
    trace.record(1.2, ODOM, TraceEvent.HELD, 2, reason="no window", score=0.125)
    trace.record(1.5, ODOM, TraceEvent.DROPPED, 2, reason=DropReason.LIFESPAN, age_s=0.5)
    trace.record(1.6, ODOM, TraceEvent.LOST, 1)  # about an earlier message
    assert trace.story(ODOM) == [
        "/odom message 2",
        "  +0.000 s  offered (size 720 bytes)",
        "  +0.000 s  queued (depth 1)",
        "  +0.100 s  link: link down (rtt 0.25 s)",
        "  +0.200 s  held (reason no window, score 0.125)",
        "  +0.500 s  dropped (reason lifespan, age 0.5 s)",
        "message 2 was dropped: lifespan, age 0.5 s",
    ]
    trace.validate()


@pytest.mark.parametrize("event", [event for event in TraceEvent if event is not TraceEvent.OFFERED])
def test_every_event_ends_a_story(event: TraceEvent) -> None:
    trace = DecisionTrace()
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 1)
    trace.record(1.0, ODOM, event, 1, reason="because")
    story = trace.story(ODOM)
    undecided = {TraceEvent.LEASE_EXPIRED, TraceEvent.WINDOW, TraceEvent.LINK_UP, TraceEvent.LINK_DOWN}
    if event in undecided:
        assert story[-1] == "message 1 was offered and nothing was decided yet"
    else:
        assert story[-1].startswith("message 1 ") and story[-1].endswith(": because")


def test_a_story_without_an_offer_tells_of_the_newest_event() -> None:
    trace = DecisionTrace()
    assert trace.story(ODOM) == ["/odom: nothing is recorded"]
    trace.record(1.0, ODOM, TraceEvent.DELIVERED, 7)
    trace.record(2.0, ODOM, TraceEvent.DROPPED, 8, reason=DropReason.DUPLICATE)
    assert trace.story(ODOM)[-1] == "message 8 was dropped: duplicate"
    trace.record(3.0, ODOM, TraceEvent.LEASE_EXPIRED, 9)
    assert trace.story(ODOM)[-1] == "message 9 has no decision in the log"


def test_a_restarted_stream_starts_a_new_story() -> None:
    trace = DecisionTrace()
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 50)
    trace.record(1.0, ODOM, TraceEvent.OFFERED, 1)
    trace.record(1.1, ODOM, TraceEvent.HELD, reason="class floor")  # about the topic, not one message
    assert trace.story(ODOM)[-1] == "message 1 is held: class floor"


def test_switched_off_it_records_nothing() -> None:
    trace = DecisionTrace(enabled=False)
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 1)
    assert trace.records() == ()
    assert trace.story(ODOM) == ["/odom: nothing is recorded; the trace is switched off"]
    trace.enabled = True
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 1)
    assert trace.topics == (ODOM,)
    trace.clear()
    assert trace.records() == ()


def test_a_fast_topic_does_not_push_out_a_slow_one() -> None:
    trace = DecisionTrace(4)
    trace.record(0.0, MAP, TraceEvent.OFFERED, 1)
    for seq in range(1, 100):
        trace.record(1.0, ODOM, TraceEvent.OFFERED, seq)
    assert len(trace.records(MAP)) == 1
    assert [record.seq for record in trace.records(ODOM)] == [96, 97, 98, 99]


def test_topics_beyond_the_limit_share_a_ring() -> None:
    trace = DecisionTrace(3, max_topics=1)
    trace.record(0.0, ODOM, TraceEvent.OFFERED, 1)
    trace.record(0.0, LINK, TraceEvent.LINK_UP)
    for topic in ("/a", "/b", "/a"):
        trace.record(1.0, TopicName(topic), TraceEvent.OFFERED, 2)
    assert trace.topics == (ODOM,)
    assert [record.number for record in trace.records(TopicName("/a"))] == [3, 5]
    assert trace.story(TopicName("/b"))[0] == "/b message 2"
    assert len(trace.records(OTHER)) == 3
    trace.validate()


def test_json() -> None:
    trace = DecisionTrace()
    trace.record(1.5, ODOM, TraceEvent.DROPPED, 3, reason=DropReason.LOST, size_bytes=10)
    trace.record(1.6, MAP, TraceEvent.CHOSEN, 4)
    expected = [
        {
            "number": 1,
            "now_s": 1.5,
            "topic": "/odom",
            "event": "dropped",
            "seq": 3,
            "reason": "lost",
            "size_bytes": 10,
        },
        {"number": 2, "now_s": 1.6, "topic": "/map", "event": "chosen", "seq": 4},
    ]
    assert json.loads(json.dumps(trace.to_json())) == expected
    assert trace.to_json(MAP) == expected[1:]


@pytest.mark.parametrize("sizes", [(0, 1), (1, 0)])
def test_senseless_bounds(sizes: tuple[int, int]) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        DecisionTrace(sizes[0], max_topics=sizes[1])


@PURE
@given(
    st.lists(
        st.tuples(st.sampled_from(["", "/a", "/b", "/c", "/d"]), st.sampled_from(TraceEvent), st.integers(0, 3)),
        max_size=60,
    )
)
def test_any_sequence_stays_bounded_and_tells_a_story(events: list[tuple[str, TraceEvent, int]]) -> None:
    trace = DecisionTrace(5, max_topics=2)
    for number, (topic, event, seq) in enumerate(events):
        trace.record(float(number), TopicName(topic), event, seq)
    trace.validate()
    numbers = [record.number for record in trace.records()]
    assert numbers == sorted(numbers)
    for topic in ("/a", "/b", "/c", "/d"):
        story = trace.story(TopicName(topic))
        assert story and all("\n" not in line for line in story)
        assert (len(story) == 1) == story[0].endswith("nothing is recorded")
