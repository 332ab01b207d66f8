"""Summaries of one client without a relay: what is worked on, what waits, what gives way, and what is measured."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sern_client.summaries.client_summaries import Summaries
from sern_client.summaries.makers import patch_work
from sern_client.summaries.source import SummarisedTopic, streams_of
from sern_client.summaries.topic_summary import (
    INLINE_BYTES,
    MAX_WAITING,
    PROBE_EVERY,
    Job,
    Send,
    TopicSummary,
    Work,
)
from sern_client.tf_merge import LatchedTransforms, MergedTransforms
from sern_core.site.client import ClientCore
from sern_core.site.fit import MISSES
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.rate_cap import RateCap
from sern_core.summaries.patches import PatchMaker, PatchParams
from sern_core.summaries.spec import STAND_IN, SummaryLevel, SummarySpec, VoxelParams
from sern_core.topics.rules import Direction, ResolvedTopic
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import (
    ClientName,
    DropReason,
    Durability,
    Encoding,
    PriorityClass,
    Reliability,
    TopicName,
)
from sern_runtime import clock
from tests.sern_core.summaries import scenes
from tests.sern_core.summaries.test_patches import grid_body
from tests.sern_core.summaries.test_transforms import message as tf_message
from tests.sern_core.summaries.test_transforms import pairs, transform
from tests.support import until

BIG = INLINE_BYTES + 1
RAW, SUMMARY = SummaryLevel.RAW, SummaryLevel.SUMMARY


class NoEvents:
    """`ClientEvents` of a client that has no relay."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *args, **kwargs: None


def core_of() -> ClientCore:
    events: Any = NoEvents()
    return ClientCore(
        name=ClientName("robot1"), boot=1, events=events, link=LinkParams(), scheduler=SchedulerParams(), now=0.0
    )


class Bench:
    """A client core that is never connected, and summaries on it whose work the test holds and lets go."""

    def __init__(self, executor: ThreadPoolExecutor) -> None:
        self.core = core_of()
        self.executor = executor
        self.gate = threading.Event()
        self.gate.set()
        self.begun = 0
        self.sent: list[bytes] = []
        self.refuse = False
        self.made: list[TopicSummary] = []

    def channel(self, name: str = "/robot1/points", **settings: Any) -> OutChannel:
        info = TopicInfo(TopicName(name), "sensor_msgs/msg/PointCloud2", Encoding.CDR)
        return self.core.publish(info, TopicSpec(**settings), now=0.0)

    def send(self, body: bytes, stamp_ns: int, born_s: float) -> bool:
        if not self.refuse:
            self.sent.append(body)
        return not self.refuse

    def work(self, job: Job) -> tuple[tuple[int, bytes], ...]:
        self.begun += 1
        assert self.gate.wait(20.0)
        if job.body.startswith(b"bad"):
            raise BodyError("it is bad")
        return ((0, job.body[:1].upper()),)

    def summary(
        self,
        params: VoxelParams | PatchParams,
        channels: tuple[OutChannel, ...],
        *,
        work: Work | None = None,
        maker: PatchMaker | None = None,
    ) -> TopicSummary:
        made = TopicSummary(
            TopicName("/points"),
            SummarySpec(params),
            channels,
            tuple(self.send for _ in channels),
            work or self.work,
            core=self.core,
            executor=self.executor,
            source=channels[0],
            maker=maker,
        )
        self.made.append(made)
        return made

    def dropped(self, channel: OutChannel) -> dict[DropReason, int]:
        self.core.link.validate()
        return {reason: count for reason, count in channel.counters.by_reason.items() if count}


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    with ThreadPoolExecutor(max_workers=1) as executor:
        bench = Bench(executor)
        yield bench
        bench.gate.set()
        for made in bench.made:
            made.close()
    await asyncio.sleep(0)  # what the thread still handed over


def big(letter: bytes) -> bytes:
    return letter + bytes(BIG)


async def test_small_bodies_are_worked_on_at_once_and_large_ones_in_a_thread(bench: Bench) -> None:
    summary = bench.summary(VoxelParams(), (bench.channel(),))
    assert summary.offer(b"a", 1, 0.0)
    assert bench.sent == [b"A"]
    bench.gate.clear()
    assert summary.offer(big(b"b"), 2, 0.1)
    assert bench.sent == [b"A"] and summary.pending == 1
    bench.gate.set()
    await until(lambda: bench.sent == [b"A", b"B"])
    assert summary.pending == 0


async def test_the_newest_waits_and_the_others_are_superseded(bench: Bench) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(), (channel,))
    bench.gate.clear()
    for letter in (b"a", b"b", b"c", b"d"):
        assert summary.offer(big(letter), 1, 0.0)
    await until(lambda: bench.begun == 1)
    assert bench.dropped(channel) == {DropReason.SUPERSEDED: 2} and summary.pending == 2
    bench.gate.set()
    await until(lambda: bench.sent == [b"A", b"D"])


async def test_a_small_one_does_not_overtake_a_large_one(bench: Bench) -> None:
    summary = bench.summary(VoxelParams(), (bench.channel(),))
    bench.gate.clear()
    summary.offer(big(b"a"), 1, 0.0)
    summary.offer(b"b", 2, 0.1)
    assert bench.sent == []
    bench.gate.set()
    await until(lambda: bench.sent == [b"A", b"B"])


async def test_a_reliable_summary_refuses_what_it_cannot_take(bench: Bench) -> None:
    channel = bench.channel(reliability=Reliability.RELIABLE)
    summary = bench.summary(VoxelParams(), (channel,))
    bench.gate.clear()
    assert [summary.offer(big(letter), 1, 0.0) for letter in (b"a", b"b", b"c")] == [True, True, False]
    bench.gate.set()
    await until(lambda: bench.sent == [b"A", b"B"])
    assert summary.offer(big(b"c"), 1, 0.0)
    await until(lambda: bench.sent[-1] == b"C")
    assert bench.dropped(channel) == {}


async def test_what_a_full_queue_refuses_is_tried_again(bench: Bench) -> None:
    summary = bench.summary(VoxelParams(), (bench.channel(reliability=Reliability.RELIABLE),))
    bench.refuse = True
    assert not summary.offer(b"a", 1, 0.0)  # the source knows, and may offer it again
    assert summary.offer(big(b"b"), 1, 0.0)
    await until(lambda: summary.pending == 1 and bench.begun >= 2)
    bench.refuse = False
    await until(lambda: bench.sent == [b"B"])


async def test_levels_switch_without_loss_or_reorder(bench: Bench) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(in_place=True), (channel,))
    bench.gate.clear()
    summary.offer(big(b"a"), 1, 0.0)
    summary.set_level(RAW)
    for letter in (b"b", b"c"):
        summary.offer(big(letter), 2, 0.1)
    summary.set_level(SUMMARY)
    for letter in (b"d", b"e"):  # d gives way: both are summaries that wait
        summary.offer(big(letter), 3, 0.2)
    assert bench.sent == []
    bench.gate.set()
    await until(lambda: len(bench.sent) == 4)
    assert [body[:1] for body in bench.sent] == [b"A", b"b", b"c", b"E"]
    assert len(bench.sent[1]) == BIG + 1 and bench.dropped(channel) == {DropReason.SUPERSEDED: 1}


async def test_what_waits_is_bounded(bench: Bench) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(in_place=True), (channel,))
    bench.gate.clear()
    summary.offer(big(b"a"), 1, 0.0)
    summary.set_level(RAW)
    for _ in range(MAX_WAITING + 7):
        summary.offer(b"x", 1, 0.0)
    assert summary.pending == MAX_WAITING + 1 and bench.dropped(channel) == {DropReason.SUPERSEDED: 7}
    bench.gate.set()
    await until(lambda: len(bench.sent) == MAX_WAITING + 1)


async def test_nothing_is_made_that_nobody_wants(bench: Bench) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(), (channel,))
    channel.set_wanted(False)
    assert summary.offer(b"a", 1, 0.0) and not summary.wanted
    assert bench.begun == 0 and bench.dropped(channel) == {DropReason.UNWANTED: 1}
    channel.set_wanted(True)
    assert summary.offer(b"a", 1, 0.0) and bench.sent == [b"A"] and summary.wanted


async def test_what_cannot_be_read_is_dropped_and_said_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(), (channel,))
    for body in (b"bad", b"bad", b"good"):
        assert summary.offer(body, 1, 0.0)
    assert bench.sent == [b"G"] and summary.undecodable == 2
    assert bench.dropped(channel) == {DropReason.UNDECODABLE: 2}
    assert [record.getMessage() for record in caplog.records] == [
        "/points: no voxel can be made of it, such messages are dropped: it is bad"
    ]


async def test_the_profile_is_measured_also_while_nothing_is_summarised(bench: Bench) -> None:
    summary = bench.summary(VoxelParams(), (bench.channel(),))
    for number in range(10):
        summary.offer(bytes(1000), number, number * 0.1)
    profile = summary.profile
    assert (profile.messages, profile.raw_bytes) == (10, 1000.0)
    assert profile.bytes_ratio == pytest.approx(0.001) and profile.rate_hz == pytest.approx(10.0)
    assert 0 <= profile.seconds_per_message < 1
    summary.set_level(RAW)
    for number in range(PROBE_EVERY):
        summary.offer(bytes(2000), number, 1.0 + number * 0.05)
    assert summary.profile.messages == 11 and len(bench.sent) == 10
    assert summary.profile.raw_bytes == pytest.approx(1200.0) and summary.profile.rate_hz == pytest.approx(20.0)


async def test_after_the_end_nothing_comes_of_what_is_worked_on(bench: Bench) -> None:
    channel = bench.channel()
    summary = bench.summary(VoxelParams(), (channel,))
    bench.gate.clear()
    summary.offer(big(b"a"), 1, 0.0)
    summary.offer(big(b"b"), 1, 0.0)
    summary.close()
    bench.gate.set()
    await asyncio.get_running_loop().run_in_executor(bench.executor, int)  # the thread has ended what it had
    assert bench.sent == [] and bench.dropped(channel) == {DropReason.SHUTDOWN: 1}


async def test_a_patch_waits_until_the_one_before_has_left(bench: Bench) -> None:
    whole, updates = bench.channel("/robot1/map"), bench.channel("/robot1/map_updates", depth=128)
    maker = PatchMaker(PatchParams(), Encoding.CDR)
    summary = bench.summary(PatchParams(), (whole, updates), work=patch_work(maker), maker=maker)
    grid = grid_body(np.zeros((9, 9)))
    summary.offer(grid, 5, 0.0)
    assert bench.sent[0] == grid and len(bench.sent) == 2
    bench.core.send(updates, b"x", 1, now=0.0)  # something waits for the link
    for _ in range(3):
        assert summary.offer(grid, 5, 0.1)
    assert len(bench.sent) == 2 and bench.dropped(whole) == {DropReason.SUPERSEDED: 2}
    updates.queue.clear()
    await until(lambda: len(bench.sent) == 3)
    assert summary.pending == 0
    summary.lost()
    summary.offer(grid, 5, 0.2)
    assert bench.sent[3] == grid


async def test_the_topic_itself_goes_at_level_raw_or_beside(bench: Bench) -> None:
    channel, own = bench.channel(), bench.channel("/robot1/points/voxel")
    summary = bench.summary(VoxelParams(), (own,))
    raw: list[bytes] = []

    def send_raw(body: bytes, stamp_ns: int, born_s: float) -> bool:
        raw.append(body)
        return True

    topic = SummarisedTopic(bench.core, channel, send_raw, [summary], RateCap(None))
    topic.sink(b"a", 1)
    summary.set_level(RAW)
    topic.sink(b"b", 2)
    summary.beside = True
    topic.sink(b"c", 3)
    summary.set_level(SUMMARY)
    topic.sink(b"d", 4)
    assert raw == [b"b", b"c", b"d"] and bench.sent == [b"A", b"D"]
    capped = SummarisedTopic(bench.core, channel, send_raw, [summary], RateCap(0.001))
    assert capped.sink(b"e", 5) and capped.sink(b"f", 6)
    assert raw[-1] == b"e" and bench.dropped(channel) == {} and capped.pending == 1
    assert capped.sink(b"g", 7) and bench.dropped(channel) == {DropReason.RATE_CAP: 1}
    capped.close()
    assert raw[-1] == b"e" and bench.dropped(channel) == {DropReason.RATE_CAP: 1, DropReason.SHUTDOWN: 1}


@pytest.mark.parametrize("size", [10, 200_000])
async def test_a_fault_of_ours_is_counted_and_the_message_is_unreadable(bench: Bench, size: int) -> None:
    own = bench.channel("/robot1/points/voxel")

    def work(job: Job) -> tuple[tuple[int, bytes], ...]:
        if job.stamp_ns == 1:
            raise ZeroDivisionError("injected")
        return ((0, b"made"),)

    summary = bench.summary(VoxelParams(), (own,), work=work)
    assert summary.offer(bytes(size), 1, 0.0)
    await until(lambda: not summary.pending)
    assert summary.undecodable == summary.failures == 1 and bench.dropped(own) == {DropReason.UNDECODABLE: 1}
    assert summary.offer(bytes(size), 2, 0.0)
    await until(lambda: bench.sent == [b"made"])


async def test_a_dead_thread_is_done_without(bench: Bench) -> None:
    own = bench.channel("/robot1/points/voxel")
    summary = bench.summary(VoxelParams(), (own,), work=lambda _job: ((0, b"made"),))
    bench.executor.shutdown()
    assert summary.offer(bytes(200_000), 1, 0.0) and bench.sent == [b"made"] and summary.failures == 1


async def test_the_last_of_a_capped_series_goes_when_its_time_comes(bench: Bench) -> None:
    channel = bench.channel()
    raw: list[tuple[bytes, int]] = []

    def send_raw(body: bytes, stamp_ns: int, born_s: float) -> bool:
        raw.append((body, stamp_ns))
        return True

    summary = bench.summary(VoxelParams(), (bench.channel("/robot1/points/voxel"),))
    summary.set_level(RAW)
    capped = SummarisedTopic(bench.core, channel, send_raw, [summary], RateCap(20.0))
    for number in range(5):
        capped.sink(b"%d" % number, number)
    await until(lambda: not capped.pending)
    assert raw[0] == (b"0", 0) and raw[-1] == (b"4", 4)
    assert len(raw) + bench.dropped(channel).get(DropReason.RATE_CAP, 0) == 5
    capped.close()


async def test_merged_transforms_wait_while_one_is_queued_and_none_is_lost(bench: Bench) -> None:
    channel = bench.channel("/tf", lifespan_s=None)  # else what waits for too long is left out
    merged = MergedTransforms(
        bench.core, channel, bench.send, TopicName("/tf"), Encoding.CDR, max_rate_hz=1000.0
    )  # fmt: skip
    bench.core.send(channel, b"x", 1, now=0.0)
    for number in range(5):
        assert merged.sink(tf_message(transform("a", f"b{number % 2}", 1 + number, number)), number)
    assert bench.sent == [] and merged.pending == 1
    channel.queue.clear()
    await until(lambda: len(bench.sent) == 1)
    assert pairs(bench.sent[0]) == {("a", "b0"): 4, ("a", "b1"): 3} and merged.pending == 0
    assert merged.sink(b"not transforms", 9) and bench.sent[1] == b"not transforms" and merged.undecodable == 1
    merged.close()


async def test_static_transforms_that_were_refused_are_not_forgotten(bench: Bench) -> None:
    channel = bench.channel("/tf_static", durability=Durability.TRANSIENT_LOCAL)
    static = LatchedTransforms(bench.core, channel, bench.send, TopicName("/tf_static"), Encoding.CDR)
    first, second = (tf_message(transform("a", name, 1, 1)) for name in "bc")
    assert static.sink(first, 1)
    bench.refuse = True
    assert not static.sink(second, 2)
    bench.refuse = False
    assert static.sink(second, 2)
    assert [set(pairs(body)) for body in bench.sent] == [{("a", "b")}, {("a", "b"), ("a", "c")}]
    assert static.sink(first, 3) and len(bench.sent) == 2
    assert bench.dropped(channel) == {DropReason.SUPERSEDED: 1}


# --- what the link carries --------------------------------------------------------------------------------------------


class ByLink:
    """A cloud topic whose level the link decides, and a core that is connected to nobody."""

    def __init__(self, *specs: SummarySpec) -> None:
        self.core = core_of()
        self.summaries = Summaries(self._sender)
        info = TopicInfo(TopicName("/points"), "sensor_msgs/msg/PointCloud2", Encoding.CDR)
        spec = TopicSpec(priority=PriorityClass.BULK, lifespan_s=1.0)
        resolved = ResolvedTopic(spec, Direction.SEND, info.name, None, None, specs)
        opened = self.summaries.open(self.core, info, resolved, None, TopicName("/robot1/points"))
        assert opened is not None
        self.channel, self.topic = opened

    def _sender(self, channel: OutChannel, info: TopicInfo) -> Send:
        return lambda body, stamp_ns, born_s: self.core.send(channel, body, stamp_ns, born_s=born_s, now=clock.now())

    def come(self, reason: DropReason) -> list[tuple[str, int]]:
        """One cloud comes; returns what the link has of it, by topic and size, and drops it."""
        cloud = scenes.cloud_body(scenes.structured(np.zeros((500, 3))), Encoding.CDR)
        assert self.topic.sink(cloud, 1)
        found: list[tuple[str, int]] = []
        for channel in streams_of(self.channel, self.topic):
            for out in list(channel.queue):
                found.append((channel.stream.id.topic, len(out.message.body)))
                channel.drop_head(reason, clock.now())
        return found

    def close(self) -> None:
        self.topic.close()
        self.summaries.close()


@pytest.fixture
async def stand_in() -> AsyncIterator[ByLink]:
    made = ByLink(STAND_IN)
    yield made
    made.close()


async def test_what_is_too_large_becomes_a_thinner_one_under_its_name(
    stand_in: ByLink, caplog: pytest.LogCaptureFixture
) -> None:
    whole = [stand_in.come(DropReason.TOO_SLOW) for _ in range(MISSES)]
    assert all(size > 8000 for ((_, size),) in whole)
    ((name, size),) = stand_in.come(DropReason.SHUTDOWN)
    assert name == "/robot1/points" and size < 200
    (line,) = caplog.messages
    assert line == "/points: the link is too slow for a message to arrive within 1 s; its voxel goes instead"
    (told,) = stand_in.summaries.to_json(clock.now())
    since_s = told.pop("since_s")
    assert isinstance(since_s, float) and since_s >= 0.0
    assert (told["topic"], told["stream"], told["kind"]) == ("/points", "/robot1/points", "voxel")
    assert (told["level"], told["by_link"], told["switches"]) == ("summary", True, 1)
    assert "summary" not in stand_in.channel.stream.attributes


async def test_what_is_dropped_for_another_reason_goes_on_as_it_comes(stand_in: ByLink) -> None:
    sizes = [stand_in.come(DropReason.SHUTDOWN)[0][1] for _ in range(3 * MISSES)]
    assert min(sizes) > 8000


async def test_a_summary_of_its_own_goes_where_only_it_is_wanted() -> None:
    made = ByLink(replace(STAND_IN, params=VoxelParams(0.2)))
    thin, whole = streams_of(made.channel, made.topic)
    try:
        assert made.come(DropReason.TOO_SLOW)[0][0] == "/robot1/points", "nobody is known to want the summary"
        thin.wanted, whole.wanted = True, False
        assert [name for name, _ in made.come(DropReason.TOO_SLOW)] == ["/robot1/points/voxel"]
        whole.wanted = True
        assert [made.come(DropReason.TOO_SLOW)[0][0] for _ in range(MISSES - 1)] == (MISSES - 1) * ["/robot1/points"]
        assert [name for name, _ in made.come(DropReason.TOO_SLOW)] == ["/robot1/points/voxel"]
    finally:
        made.close()
