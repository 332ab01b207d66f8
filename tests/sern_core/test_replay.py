"""What is kept for late joiners: the last messages of each stream, and a bound over all of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.hub import HubParams
from sern_core.message import Message, StreamId
from sern_core.replay import LatchedCache, ReplayStore
from sern_core.types import ClientName, PriorityClass, TopicName
from tests.world import World, spec


def message(topic: str, seq: int, size: int) -> Message:
    return Message(StreamId(ClientName("a"), 1, TopicName(topic)), seq, b"x" * size, 0, 0.0)


def seqs(cache: LatchedCache) -> list[int]:
    return [kept.seq for kept in cache.replay()]


def test_the_topic_that_was_longest_unused_gives_its_oldest() -> None:
    store = ReplayStore(100)
    first, second, third = (store.open(10) for _ in range(3))
    for seq in (1, 2):
        store.add(first, message("/first", seq, 20))
        store.add(second, message("/second", seq, 20))
    store.replay(first)  # a late joiner: that is use
    store.add(third, message("/third", 1, 30))
    assert (seqs(first), seqs(second), seqs(third)) == ([1, 2], [2], [1])
    store.add(third, message("/third", 2, 30))
    assert (seqs(first), seqs(second), seqs(third)) == ([1, 2], [], [1, 2])
    assert (store.held_bytes, store.evicted) == (100, 2)
    store.close(first)
    assert store.held_bytes == 60
    store.validate()


def test_a_message_above_the_bound_takes_nobody_elses_place() -> None:
    store = ReplayStore(100)
    small, large = store.open(5), store.open(5)
    store.add(small, message("/small", 1, 60))
    store.add(large, message("/large", 1, 40))
    store.add(large, message("/large", 2, 101))
    assert (seqs(small), seqs(large)) == ([1], [])  # an older one in its place would be taken for the latest
    assert store.evicted == 2


def test_depth_holds_within_the_bound() -> None:
    store = ReplayStore(1000)
    cache = store.open(2)
    for seq in range(1, 6):
        store.add(cache, message("/a", seq, 10))
    assert seqs(cache) == [4, 5]
    assert (store.held_bytes, store.evicted) == (20, 0)


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 60), st.booleans()), max_size=60),
    st.integers(0, 120),
)
def test_never_more_than_the_bound_and_always_the_newest(steps: list[tuple[int, int, bool]], max_bytes: int) -> None:
    store = ReplayStore(max_bytes)
    caches = [store.open(depth) for depth in (1, 2, 3, 50)]
    for seq, (index, size, read) in enumerate(steps, start=1):
        cache = caches[index]
        store.add(cache, message(f"/{index}", seq, size))
        store.validate()
        assert seqs(cache)[-1:] == ([seq] if size <= max_bytes else [])
        assert seqs(cache) == sorted(seqs(cache))
        if read:
            store.replay(caches[0])


@pytest.mark.parametrize(("cache_bytes", "expected"), [(2_500, {"/b", "/c"}), (10_000, {"/a", "/b", "/c"}), (0, set())])
def test_the_relay_keeps_no_more_than_it_may(cache_bytes: int, expected: set[str]) -> None:
    world = World(hub_params=HubParams(cache_bytes=cache_bytes))
    robot = world.client("robot")
    for topic in ("/a", "/b", "/c"):
        channel = robot.publish(topic, spec(PriorityClass.STATE, latched=True))
        world.run(1.0)
        robot.send(channel, b"m" * 1_000)
    world.run(1.0)
    late = world.client("late", patterns=[".*"])
    world.run(2.0)
    assert {got.topic for got in late.got} == expected
    assert world.relay.hub.replays.held_bytes == 1_000 * len(expected)
    world.validate()
