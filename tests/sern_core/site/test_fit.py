"""Whole messages while the link carries them in time, their summary while it does not, and few changes between them."""

from itertools import pairwise

import pytest

from sern_core.site.fit import FAR_TOO_LARGE, MAX_PAUSE_S, MAX_WATCHED, MIN_PAUSE_S, MISSES, Fit
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.trace import LINK, TraceEvent
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel, RateStep
from tests.sensors import FittedTopic
from tests.world import World, spec

CLOUD = "/robot/points"
THIN_BYTES = 8_000
RATE_BPS = 1e6
RAW, SUMMARY = SummaryLevel.RAW, SummaryLevel.SUMMARY


class Robot:
    """One with clouds of 300 kB at 10 Hz, summaries of 8 kB, 25 ms each way."""

    def __init__(self, rate_bps: float, *steps: RateStep, whole_bytes: int = 300_000) -> None:
        self.world = World(lossless=False)
        link = LinkModel(rate_bps=rate_bps, delay_s=0.025, rate_steps=steps)
        self.robot = self.world.client("robot", link, LinkModel(delay_s=0.025))
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.clouds = FittedTopic(self.robot, CLOUD, whole_bytes, THIN_BYTES, 10.0)

    def run(self, seconds: float) -> tuple[int, int]:
        """How many clouds and how many summaries arrive in the next seconds."""
        before = len(self.site.on(CLOUD))
        self.world.run(seconds)
        sizes = [len(got.body) for got in self.site.on(CLOUD)[before:]]
        return sum(size > THIN_BYTES for size in sizes), sum(size == THIN_BYTES for size in sizes)

    def events(self) -> list[TraceEvent]:
        """What the decision trace is told of the level."""
        told = (TraceEvent.SUMMARISED, TraceEvent.WHOLE)
        return [record.event for record in self.robot.core.trace.records(LINK) if record.event in told]


def test_what_fits_goes_as_it_comes() -> None:
    robot = Robot(4e6)
    robot.run(3.0)
    whole, thin = robot.run(5.0)
    assert whole >= 5 and thin == 0 and robot.clouds.fit.switches == 0


def test_what_is_too_large_becomes_its_summary_and_the_link_is_left_to_it() -> None:
    robot = Robot(1e6)
    robot.run(5.0)
    assert robot.clouds.fit.level is SUMMARY
    whole, thin = robot.run(10.0)
    assert whole == 0 and thin >= 80
    assert robot.clouds.fit.switches == 1 and robot.events() == [TraceEvent.SUMMARISED]


def test_a_link_that_got_better_is_given_whole_messages_again() -> None:
    robot = Robot(1e6, RateStep(8.0, 10e6))
    robot.run(8.0)
    assert robot.clouds.fit.level is SUMMARY
    robot.run(12.0)
    assert robot.clouds.fit.level is RAW and robot.clouds.fit.switches == 2
    assert robot.run(3.0)[0] >= 6
    assert robot.events() == [TraceEvent.SUMMARISED, TraceEvent.WHOLE]


def test_a_topic_near_the_limit_changes_seldom() -> None:
    """1.1 s of the link, with a lifespan of one: what arrives now and then is an accident."""
    robot = Robot(1e6, whole_bytes=140_000)
    robot.run(30.0)
    assert robot.clouds.fit.switches <= 4


# --- by hand ----------------------------------------------------------------------------------------------------------


class ByHand:
    """A channel to nobody, of whose messages one says what became of them."""

    def __init__(self) -> None:
        world = World()
        self.robot = world.client("robot")
        self.channel: OutChannel = self.robot.publish(CLOUD, spec(PriorityClass.BULK, lifespan_s=1.0))
        self.fit = Fit(self.channel)

    def whole(self, reason: DropReason | None, nbytes: int = 1000) -> None:
        """One goes as it comes, and is dropped for a reason, or arrives."""
        seq = self.channel.next_seq
        self.fit.sent(seq, nbytes)
        self.robot.send(self.channel, b"cloud")
        if reason is not None:
            self.channel.drop_head(reason, self.robot.now)
        else:
            self.channel.queue.clear()

    def vain(self, now: float) -> None:
        """Until summaries go."""
        for _ in range(MISSES):
            assert self.fit.choose(now, RATE_BPS) is RAW
            self.whole(DropReason.TOO_SLOW)
        assert self.fit.choose(now, RATE_BPS) is SUMMARY


def test_one_that_arrives_between_is_enough_to_stay() -> None:
    hand = ByHand()
    for number in range(10):
        for _ in range(MISSES - 1):
            hand.whole(DropReason.TOO_SLOW)
        hand.fit.choose(float(number), RATE_BPS)
        hand.whole(None)
        assert hand.fit.choose(number + 0.5, RATE_BPS) is RAW


@pytest.mark.parametrize("reason", [DropReason.SUPERSEDED, DropReason.SHUTDOWN])
def test_what_says_nothing_of_the_link_changes_nothing(reason: DropReason) -> None:
    hand = ByHand()
    for number in range(20):
        assert hand.fit.choose(float(number), RATE_BPS) is RAW
        hand.whole(reason)
    hand.vain(30.0)
    probe_s = 30.0 + MIN_PAUSE_S
    assert hand.fit.choose(probe_s, RATE_BPS) is RAW
    hand.whole(reason)
    assert hand.fit.choose(probe_s + MIN_PAUSE_S - 0.1, RATE_BPS) is SUMMARY
    assert hand.fit.choose(probe_s + MIN_PAUSE_S, RATE_BPS) is RAW, "another one has its turn, and no later for it"


@pytest.mark.parametrize(("times", "level"), [(0.9, RAW), (1.1, SUMMARY)])
def test_what_waits_for_its_turn_in_vain_says_something_where_it_is_far_too_large(
    times: float, level: SummaryLevel
) -> None:
    """Beside what is smaller it hardly has one on a slow link, and a newer one takes its place."""
    hand = ByHand()
    for _ in range(MISSES):
        assert hand.fit.choose(0.0, RATE_BPS) is RAW
        hand.whole(DropReason.SUPERSEDED, int(times * FAR_TOO_LARGE * RATE_BPS / 8))
    assert hand.fit.choose(0.1, RATE_BPS) is level


def test_probes_in_vain_come_less_and_less_often() -> None:
    hand = ByHand()
    hand.vain(0.0)
    now, probes_s = 0.0, []
    while now < 200.0:
        now += 0.1
        if hand.fit.choose(now, RATE_BPS) is RAW:
            probes_s.append(now)
            hand.whole(DropReason.LIFESPAN)
    gaps = [round(later - earlier) for earlier, later in pairwise(probes_s)]
    assert probes_s[0] == pytest.approx(MIN_PAUSE_S, abs=0.2)
    assert gaps == sorted(gaps) and gaps[-1] == MAX_PAUSE_S


def test_a_link_that_shows_that_it_got_faster_is_tried_again_soon() -> None:
    hand = ByHand()
    hand.vain(0.0)
    rate_bps = RATE_BPS
    for number in range(1, 5):
        assert hand.fit.choose(number * MIN_PAUSE_S - 0.1, rate_bps) is SUMMARY
        assert hand.fit.choose(number * MIN_PAUSE_S, rate_bps) is RAW
        hand.whole(DropReason.TOO_SLOW)
        rate_bps *= 1.5
        assert hand.fit.choose(number * MIN_PAUSE_S, rate_bps) is SUMMARY


def test_a_topic_that_goes_back_and_forth_does_so_less_and_less_often() -> None:
    hand = ByHand()
    now, rounds_s = 0.0, []
    for _ in range(5):
        hand.vain(now)
        begun_s = now
        while hand.fit.level is SUMMARY:
            now += 0.1
            if hand.fit.choose(now, RATE_BPS) is RAW and hand.fit.level is SUMMARY:
                hand.whole(None)
        rounds_s.append(now - begun_s)
    assert rounds_s == sorted(rounds_s) and rounds_s[-1] >= 4 * rounds_s[0]


def test_a_probe_that_never_came_to_the_channel_is_not_waited_for() -> None:
    hand = ByHand()
    hand.vain(0.0)
    assert hand.fit.choose(MIN_PAUSE_S, RATE_BPS) is RAW
    assert hand.fit.choose(MIN_PAUSE_S + 0.1, RATE_BPS) is SUMMARY
    assert hand.fit.choose(3 * MIN_PAUSE_S, RATE_BPS) is RAW


def test_who_else_is_told_of_drops_is_told_as_before() -> None:
    hand = ByHand()
    told: list[tuple[int, DropReason]] = []
    hand.channel.drops.on_count = lambda seq, reason: told.append((seq, reason))
    hand.fit = Fit(hand.channel)
    hand.whole(DropReason.TOO_SLOW)
    assert told == [(1, DropReason.TOO_SLOW)]


def test_messages_whose_fate_never_comes_are_let_go() -> None:
    hand = ByHand()
    for seq in range(10 * MAX_WATCHED):
        hand.channel.flying[seq] = OutMessage(Message(hand.channel.stream.id, seq, b"", 0, 0.0))
        hand.fit.sent(seq, 1000)
    assert hand.fit.choose(1.0, RATE_BPS) is RAW and hand.fit.watched == MAX_WATCHED
