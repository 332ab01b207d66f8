"""What a stream costs the relay for each subscriber before anything was sent: one announcement makes that many."""

import gc
import tracemalloc
from typing import Final

import pytest

from sern_core.vocabulary.ledger import NO_DROPS, ReceiveCounters, SendCounters
from sern_core.vocabulary.types import DropReason, PriorityClass, TopicName
from tests.fuzz.test_hostile_peer import Hostile
from tests.fuzz.test_price_datagrams import said
from tests.world import World

STREAMS: Final = 40
SUBSCRIBERS: Final = 10
MAX_CHANNEL_BYTES: Final = 2_000
LARGE_BLOCK_BYTES: Final = 200_000
"""A table of the whole process, which grows when its time has come, whoever adds the next entry."""


@pytest.mark.parametrize("reliable", [False, True])
def test_a_channel_on_which_nothing_was_sent_is_small(reliable: bool) -> None:
    """The lesser of two measurements counts: a smaller table of the process may grow in one, not in both."""
    assert min(channel_bytes(reliable=reliable) for _ in range(2)) <= MAX_CHANNEL_BYTES


def channel_bytes(*, reliable: bool) -> float:
    """What is held for each channel, the tables of the process left out."""
    world = World()
    peer = Hostile(world)
    for number in range(SUBSCRIBERS):
        reader = Hostile(world, f"reader{number}")
        reader.control({"t": "subscribe", "patterns": [".*"], "more": False})
    peer.announce(1, "/robot/first")
    gc.collect()
    tracemalloc.start()
    try:
        for index in range(STREAMS):
            peer.announce(2 + index, f"/robot/t{index}", reliable=reliable)
            said(peer)
        gc.collect()
        sizes = [trace.size for trace in tracemalloc.take_snapshot().traces]
    finally:
        tracemalloc.stop()
    channels = sum(len(relayed.outs) for relayed in world.relay.hub.relayed.values())
    assert channels == (STREAMS + 1) * SUBSCRIBERS
    assert sum(size >= LARGE_BLOCK_BYTES for size in sizes) <= 1
    return sum(size for size in sizes if size < LARGE_BLOCK_BYTES) / (STREAMS * SUBSCRIBERS)


def test_topics_share_the_counts_of_drops_until_they_drop_something() -> None:
    sent = [SendCounters(TopicName(name), PriorityClass.BULK) for name in ("/a", "/b")]
    came = [ReceiveCounters(TopicName(name), PriorityClass.BULK) for name in ("/a", "/b")]
    assert all(counters.by_reason is NO_DROPS for counters in (*sent, *came))
    sent[0].drop(DropReason.LIFESPAN, 5)
    came[0].drop_arrived(DropReason.LOST)
    assert sent[0].by_reason[DropReason.LIFESPAN] == came[0].by_reason[DropReason.LOST] == 1
    assert set(sent[0].by_reason) == set(came[0].by_reason) == set(DropReason)
    sent[1].add(sent[0])
    sent[1].refuse(7)
    came[1].add(came[0])
    assert sent[1].by_reason == {**NO_DROPS, DropReason.LIFESPAN: 1, DropReason.REFUSED: 1}
    assert came[1].by_reason == {**NO_DROPS, DropReason.LOST: 1}
    sent[0].drop(DropReason.LIFESPAN, 5)
    assert sent[1].by_reason[DropReason.LIFESPAN] == 1, "counts are shared after a sum"
    assert not any(NO_DROPS.values())
