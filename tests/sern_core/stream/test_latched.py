"""What is kept for late joiners: the last messages of each stream, and a bound over all of them."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.relay.interest import UNIT_S, RoutingLimits
from sern_core.relay.relayed_streams import REPLAY_US
from sern_core.stream.latched import MAX_REPLAY_MESSAGES, LatchedCache, ReplayStore
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES, MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_core.wire.announce import Announcement, encode_announcement
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.world import World, spec

LATE = ClientName("late")
UNIT = MESSAGE_OVERHEAD_BYTES
"""What an empty message counts for, and the unit of sizes here."""


def message(topic: str, seq: int, size: int) -> Message:
    return Message(StreamId(ClientName("a"), 1, TopicName(topic)), seq, bytes((size - 1) * UNIT), 0, 0.0)


def seqs(cache: LatchedCache) -> list[int]:
    return [kept.seq for kept in cache.replay()]


def test_the_topic_that_was_longest_unused_gives_its_oldest() -> None:
    store = ReplayStore(100 * UNIT)
    first, second, third = (store.open(10) for _ in range(3))
    for seq in (1, 2):
        store.add(first, message("/first", seq, 20))
        store.add(second, message("/second", seq, 20))
    store.below(first, 10)  # a late joiner: that is use
    store.add(third, message("/third", 1, 30))
    assert (seqs(first), seqs(second), seqs(third)) == ([1, 2], [2], [1])
    store.add(third, message("/third", 2, 30))
    assert (seqs(first), seqs(second), seqs(third)) == ([1, 2], [], [1, 2])
    assert (store.held_bytes, store.evicted) == (100 * UNIT, 2)
    store.close(first)
    assert store.held_bytes == 60 * UNIT
    store.validate()


def test_a_message_above_the_bound_takes_nobody_elses_place() -> None:
    store = ReplayStore(100 * UNIT)
    small, large = store.open(5), store.open(5)
    store.add(small, message("/small", 1, 60))
    store.add(large, message("/large", 1, 40))
    store.add(large, message("/large", 2, 101))
    assert (seqs(small), seqs(large)) == ([1], [])  # an older one in its place would be taken for the latest
    assert store.evicted == 2


def test_depth_holds_within_the_bound() -> None:
    store = ReplayStore(1000 * UNIT)
    cache = store.open(2)
    for seq in range(1, 6):
        store.add(cache, message("/a", seq, 10))
    assert seqs(cache) == [4, 5]
    assert (store.held_bytes, store.evicted) == (20 * UNIT, 0)


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 60), st.booleans()), max_size=60),
    st.integers(0, 120),
)
def test_never_more_than_the_bound_and_always_the_newest(steps: list[tuple[int, int, bool]], max_bytes: int) -> None:
    store = ReplayStore(max_bytes * UNIT)
    caches = [store.open(depth) for depth in (1, 2, 3, 50)]
    for seq, (index, size, read) in enumerate(steps, start=1):
        cache = caches[index]
        store.add(cache, message(f"/{index}", seq, size))
        store.validate()
        assert seqs(cache)[-1:] == ([seq] if size <= max_bytes else [])
        assert seqs(cache) == sorted(seqs(cache))
        if read:
            store.below(caches[0], seq)


@pytest.mark.parametrize(
    ("cache_bytes", "expected"), [(2 * (1_000 + UNIT), {"/b", "/c"}), (10_000, {"/a", "/b", "/c"}), (0, set())]
)
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
    assert world.relay.hub.streams.replays.held_bytes == (1_000 + UNIT) * len(expected)
    world.validate()


def test_empty_messages_count_for_what_they_take() -> None:
    store = ReplayStore(100 * UNIT)
    cache = store.open(500)
    for seq in range(1, 500):
        store.add(cache, message("/a", seq, 1))
    assert cache.count == 100 and store.held_bytes == 100 * UNIT and store.evicted == 399


def test_of_a_deep_stream_the_newest_are_kept_and_the_others_counted() -> None:
    store = ReplayStore(10**9)
    cache = store.open(100_000)
    for seq in range(1, MAX_REPLAY_MESSAGES + 6):
        store.add(cache, message("/a", seq, 1))
    assert seqs(cache) == list(range(6, MAX_REPLAY_MESSAGES + 6))
    assert store.evicted == 5
    store.validate()


@pytest.mark.interpreted
@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("restarts", [False, True])
def test_a_late_joiner_gets_the_newest_that_may_wait_for_it(
    reliable: bool, restarts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    room_bytes = 30 * (100 + CLIENT_OVERHEAD_BYTES)
    late_rule = AccessRule(client="late", subscribe=(".*",), max_queue_bytes=room_bytes)
    world = World(access=AccessTable([late_rule, AccessRule(client=".*", publish=(".*",), subscribe=(".*",))]))
    hub = world.relay.hub
    robot = world.client("robot")
    for topic in ("/a", "/b"):
        channel = robot.publish(topic, spec(PriorityClass.BULK, latched=True, reliable=reliable, depth=20))
        world.run(1.0)
        for _ in range(20):
            robot.send(channel, bytes(100))
            world.run(0.05)
    opened: list[int] = []
    prime = OutChannel.prime

    def primed(channel: OutChannel, replays: Sequence[Message], *, now: float) -> None:
        prime(channel, replays, now=now)
        opened.append(sum(other.kept_bytes for other in {channel, *hub.links[LATE].sender.channels.values()}))

    monkeypatch.setattr(OutChannel, "prime", primed)
    late = world.client(LATE, patterns=[".*"])
    world.run(5.0)
    if restarts:
        late = world.restart_client(LATE)
        world.run(5.0)
    got = {topic: [each.seq for each in late.got if each.topic == topic] for topic in ("/a", "/b")}
    assert sorted(map(len, got.values())) == [10, 20]
    assert all(seqs == list(range(21 - len(seqs), 21)) for seqs in got.values()), "the newest are among them"
    assert 0 < max(opened) <= room_bytes
    counters = hub.links[LATE].sender.ledger.topics.values()
    assert sum(each.by_reason[DropReason.QUEUE_FULL] for each in counters) == (20 if restarts else 10)
    world.validate()


@pytest.mark.interpreted
def test_many_latched_messages_are_replayed_in_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = Hostile()
    streams, depth = 60, 300
    for index in range(streams):
        identity = StreamId(peer.name, peer.boot, TopicName(f"/robot/t{index}"))
        latched = StreamInfo(
            identity, TopicInfo(identity.topic, "a/b", Encoding.CDR, latched=True), spec(latched=True, depth=depth)
        )
        peer.control(encode_announcement(Announcement(1 + index, latched, "", 1)))
        peer.say(*(_whole(1 + index, seq) for seq in range(1, 1 + depth)))
    reader = Hostile(peer.world, LATE)
    replayed: list[int] = []
    prime = OutChannel.prime

    def primed(channel: OutChannel, replays: Sequence[Message], *, now: float) -> None:
        replayed[-1] += len(replays)
        prime(channel, replays, now=now)

    monkeypatch.setattr(OutChannel, "prime", primed)
    replayed.append(0)
    reader.control({"t": "subscribe", "patterns": [".*"], "more": False})
    matching = peer.hub.matching
    while LATE in matching.due_s:
        replayed.append(0)
        matching.go_on(LATE, now=matching.due_s[LATE])
    assert sum(replayed) == streams * depth
    assert max(replayed) * REPLAY_US <= RoutingLimits().slice_units * UNIT_S * 1e6 + depth * REPLAY_US
    peer.hub.validate()
