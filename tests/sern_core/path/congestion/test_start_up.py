"""Start-up where packets come evenly, where jitter moves them, and after a pause."""

from math import inf

import pytest

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.start_up import StartUp
from sern_core.path.congestion.train import EVEN, EVEN_ARRIVALS, TRAIN_BYTES, Train
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import Jitter, LinkModel
from tests.world import World, spec

PACKET_BYTES = 1200
RTT_S = 0.1
PACKETS = TRAIN_BYTES // PACKET_BYTES + 1


class Sent:
    """Packets that leave so long after each other, and come so."""

    def __init__(self) -> None:
        self.train = Train()
        self.at_s, self.sent_s, self.cum_bytes = 1.0, 0.5, 0

    def arrive(self, gaps_s: list[float], *, left_gap_s: float = 0.0, jittery: bool = False) -> bool:
        """Whether the last of them tells a rate."""
        told = False
        for gap_s in gaps_s:
            self.at_s += gap_s
            self.sent_s += left_gap_s
            self.cum_bytes += PACKET_BYTES
            told = self.train.note(
                AckSample(
                    now=self.at_s + 0.01,
                    rtt_s=self.at_s + 0.01 - self.sent_s,
                    acked_bytes=PACKET_BYTES,
                    inflight_bytes=0,
                    receiver_s=self.at_s,
                    cum_bytes=self.cum_bytes,
                    app_limited=False,
                    sent_s=self.sent_s,
                ),
                self.sent_s,
                RTT_S,
                jittery=jittery,
            )
        return told


def test_an_even_train_shows_the_rate_of_the_bottleneck() -> None:
    sent = Sent()
    assert sent.arrive([0.001] * PACKETS)
    assert sent.train.even and sent.train.spread and sent.train.whole_spread
    assert sent.train.even_rate == sent.train.rate == pytest.approx(PACKET_BYTES / 0.001)


def test_what_comes_as_it_left_was_spread_by_the_sender() -> None:
    sent = Sent()
    assert sent.arrive([0.001] * PACKETS, left_gap_s=0.001)
    assert sent.train.even and not sent.train.spread and not sent.train.whole_spread


def test_an_uneven_train_shows_that_it_is_none() -> None:
    sent = Sent()
    assert sent.arrive([0.004, 0.003, 0.001, *[1e-6] * (PACKETS - 3)])
    assert not sent.train.even and sent.train.even_rate == 0.0
    assert 0.0 < sent.train.whole_rate < inf


def test_few_acknowledgements_are_even_by_chance() -> None:
    """A stream's large fragments are acknowledged a few at a time."""
    assert len(EVEN) == EVEN_ARRIVALS + 1
    sent = Sent()
    sent.arrive([0.001])
    for _ in range(2):
        sent.cum_bytes += TRAIN_BYTES
        assert sent.arrive([0.001]) and not sent.train.even and not sent.train.tells
    sent.cum_bytes += TRAIN_BYTES
    assert sent.arrive([0.001]) and sent.train.even and sent.train.tells


def test_where_packets_came_unevenly_it_takes_more_of_them() -> None:
    sent = Sent()
    for count in range(1, 2 * PACKETS):
        sent.arrive([0.001], jittery=True)
        assert sent.train.even == (count >= PACKETS)


def test_a_window_that_comes_as_it_left_within_a_round_trip_or_two_shows_no_bottleneck() -> None:
    """The first half of the window waited in TCP for the second one, so it came as evenly as behind a slow link."""
    start = StartUp(DEFAULT_HYBRID)
    start.begin(0.0, 12_600.0, None)
    ramps = []
    for number in range(1, 11):
        at_s = 1.0 + 0.001 * number
        sample = AckSample(at_s, 0.008, 1260, 0, at_s, 1260 * number, False, at_s - 0.008)
        ramps.append(start.ramp(sample, at_s - 0.008, window=12_600.0, rtt_s=0.008, fragment=1260.0))
    assert ramps[:-1] == [None] * 9
    last = ramps[-1]
    assert last is not None and last.round_over and not last.filled and last.window > 12_600.0


def test_what_comes_at_once_is_no_rate() -> None:
    sent = Sent()
    assert sent.arrive([0.0] * PACKETS)
    assert not sent.train.even and sent.train.whole_rate == inf


@pytest.mark.parametrize(("pause_s", "short"), [(0.2 * RTT_S, True), (0.3 * RTT_S, False)])
def test_a_pause_of_the_sender_is_in_no_rate(pause_s: float, short: bool) -> None:
    """One that is short against the round trip hardly shows."""
    sent = Sent()
    sent.arrive([0.001] * 3)
    sent.train.nothing_more(sent.sent_s)
    sent.sent_s += pause_s
    assert sent.arrive([0.001 + pause_s, *[0.001] * (PACKETS - 2)]) is short, "a train is not over a pause"
    assert sent.arrive([0.001] * 2)
    if short:
        return
    assert sent.train.even and sent.train.rate == pytest.approx(PACKET_BYTES / 0.001)
    assert sent.train.whole_rate == pytest.approx(PACKET_BYTES / 0.001)


def test_what_a_stream_held_back_for_a_lost_segment_tells_nothing() -> None:
    sent = Sent()
    sent.arrive([0.0])
    assert not sent.arrive([2.0, *[1e-6] * (PACKETS - 2)])
    assert sent.train.rate == sent.train.whole_rate == 0.0


@pytest.mark.parametrize(
    ("robots", "nbytes", "phase_s", "delay_s", "jitter_s", "jitter"),
    [
        (5, 200_000, 0.0, 0.00375, 0.00125, Jitter.NORMAL),
        (5, 200_000, 0.033, 0.00375, 0.00125, Jitter.NORMAL),
        (3, 200_000, 0.0, 0.00375, 0.00125, Jitter.NORMAL),
        (3, 100_000, 0.01, 0.025, 0.01, Jitter.UNIFORM),
    ],
)
def test_clouds_come_from_the_first_seconds_on_over_a_wide_link_with_jitter(
    robots: int, nbytes: int, phase_s: float, delay_s: float, jitter_s: float, jitter: Jitter
) -> None:
    """What the handshake and announcements take is no rate to send clouds at, and what jitter spreads is no slow link.
    The link carries three times what is offered."""
    rate_hz = 10.0
    model = LinkModel(
        rate_bps=3 * 8 * robots * nbytes * rate_hz,
        delay_s=delay_s,
        jitter_s=jitter_s,
        jitter=jitter,
        overhead_bytes=28,
    )
    world = World(lossless=False)
    robot = world.client("robot", model)
    site = world.client("site", patterns=["/robot/.*"])
    for number in range(robots):
        channel = robot.publish(f"/robot/points{number}", spec(PriorityClass.STATE))
        robot.every(1 / rate_hz, channel, bytes(nbytes), first_s=2.0 + number * phase_s)
    world.run(4.0)
    assert len(site.got) > 0.75 * robots * rate_hz * 2.0
    world.validate()
