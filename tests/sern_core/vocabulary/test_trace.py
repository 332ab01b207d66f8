"""The decision log: its bounds, what it is when it is switched off, and what is told of one topic."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.trace import LINK, OTHER, RECORD_BYTES, DecisionTrace, HoldReason, TraceEvent
from sern_core.vocabulary.types import DropReason, TopicName
from tests.exploring import cases

PURE = settings(max_examples=cases(60))
ODOM, MAP = TopicName("/odom"), TopicName("/map")


def test_about_a_topic_are_its_records_and_how_the_link_was() -> None:
    trace = DecisionTrace()
    trace.record(0.0, LINK, TraceEvent.LINK_UP)
    trace.record(0.1, LINK, TraceEvent.CAPACITY, rate_bps=1e6)
    trace.record(1.0, ODOM, TraceEvent.QUEUED, 1)
    trace.record(1.1, MAP, TraceEvent.QUEUED, 1)
    trace.record(1.2, LINK, TraceEvent.LINK_DOWN)
    trace.record(1.3, ODOM, TraceEvent.HELD, 1, reason=HoldReason.LINK_DOWN)
    assert [record.number for record in trace.about(ODOM)] == [2, 3, 5, 6]
    assert [record.number for record in trace.about(TopicName("/none"))] == [1, 2, 5]
    trace.validate()


def test_one_topic_gives_way_to_others_where_the_room_is_short() -> None:
    trace = DecisionTrace(100, max_bytes=10 * RECORD_BYTES)
    for seq in range(1, 50):
        trace.record(0.0, ODOM, TraceEvent.QUEUED, seq)
        trace.validate()
    for seq in range(1, 6):
        trace.record(1.0, MAP, TraceEvent.QUEUED, seq)
        trace.validate()
    assert [record.seq for record in trace.records(ODOM)] == [45, 46, 47, 48, 49]
    assert [record.seq for record in trace.records(MAP)] == [1, 2, 3, 4, 5]


def test_switched_off_it_records_nothing() -> None:
    trace = DecisionTrace(enabled=False)
    trace.record(0.0, ODOM, TraceEvent.QUEUED, 1)
    assert trace.records() == ()
    assert not trace.steps
    trace.enabled = True
    trace.record(0.0, ODOM, TraceEvent.QUEUED, 1)
    assert trace.topics == (ODOM,)
    trace.clear()
    assert trace.records() == ()


def test_a_fast_topic_does_not_push_out_a_slow_one() -> None:
    trace = DecisionTrace(4)
    trace.record(0.0, MAP, TraceEvent.QUEUED, 1)
    for seq in range(1, 100):
        trace.record(1.0, ODOM, TraceEvent.QUEUED, seq)
    assert len(trace.records(MAP)) == 1
    assert [record.seq for record in trace.records(ODOM)] == [96, 97, 98, 99]


def test_topics_beyond_the_limit_share_a_ring() -> None:
    trace = DecisionTrace(3, max_topics=1)
    trace.record(0.0, ODOM, TraceEvent.QUEUED, 1)
    trace.record(0.0, LINK, TraceEvent.LINK_UP)
    for topic in ("/a", "/b", "/a"):
        trace.record(1.0, TopicName(topic), TraceEvent.QUEUED, 2)
    assert trace.topics == (TopicName("/a"), TopicName("/b"), ODOM)
    assert [record.number for record in trace.records(TopicName("/a"))] == [3, 5]
    assert len(trace.records(TopicName("/b"))) == 1
    assert len(trace.records(OTHER)) == 3
    trace.validate()


def test_json() -> None:
    trace = DecisionTrace()
    trace.record(1.5, ODOM, TraceEvent.DROPPED, 3, reason=DropReason.LOST, size_bytes=10)
    trace.record(1.6, MAP, TraceEvent.BEGUN, 4)
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
        {"number": 2, "now_s": 1.6, "topic": "/map", "event": "begun", "seq": 4},
    ]
    assert json.loads(json.dumps(trace.to_json())) == expected
    assert trace.to_json(MAP) == expected[1:]


@pytest.mark.parametrize("sizes", [(0, 1), (1, 0)])
def test_senseless_bounds(sizes: tuple[int, int]) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        DecisionTrace(sizes[0], max_topics=sizes[1])
    with pytest.raises(UsageError, match="max_bytes 10 must be at least"):
        DecisionTrace(max_bytes=10)


@PURE
@given(
    st.lists(
        st.tuples(st.sampled_from(["", "/a", "/b", "/c", "/d"]), st.sampled_from(TraceEvent), st.integers(0, 3)),
        max_size=60,
    )
)
def test_any_sequence_stays_bounded_and_in_order(events: list[tuple[str, TraceEvent, int]]) -> None:
    trace = DecisionTrace(5, max_topics=2, max_bytes=12 * RECORD_BYTES)
    for number, (topic, event, seq) in enumerate(events):
        trace.record(float(number), TopicName(topic), event, seq)
    trace.validate()
    numbers = [record.number for record in trace.records()]
    assert numbers == sorted(numbers)
    assert len(numbers) <= 12
    for topic in trace.topics:
        assert trace.records(topic), "a topic of which something is recorded"
