"""The window estimator in virtual time: what a pose beside unlimited bulk sees, and how changes are followed.

Times are those of the simulated network, so they are the same on every machine and may be asserted.
"""

from dataclasses import replace
from functools import cache
from math import inf
from statistics import fmean

import pytest

from benchmarks.flows import BbrLike, Cubic, World
from sern_core.path.capacity import AckSample, CapacityEstimator, Pacer
from sern_core.path.congestion.hybrid import HybridWindow
from sern_sim.models import BurstLoss, Jitter, LinkModel, RateStep, Window
from tests.exploring import also

POSE_WIRE_BITS = 8 * 216
BULK_SHARE = (1200 - 56) / 1260


def link(rate_bps: float, rtt_s: float) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=rtt_s / 2, overhead_bytes=60)


def floor_ms(rate_bps: float, rtt_s: float) -> float:
    return 1e3 * (rtt_s / 2 + POSE_WIRE_BITS / rate_bps)


def carries_bps(rate_bps: float) -> float:
    """Bulk payload that fits beside 50 poses a second."""
    return (rate_bps - 50 * POSE_WIRE_BITS) * BULK_SHARE


def at(values: list[float], share: float) -> float:
    return values[min(len(values) - 1, int(share * len(values)))]


def run(model: LinkModel, until_s: float, *, seed: int = 1, tick_s: float = 0.0, thin: bool = False) -> World:
    world = World(model, seed=seed, tick_s=tick_s)
    world.flow(HybridWindow(), thin=thin)
    world.run(until_s)
    return world


@pytest.mark.parametrize("seed", [1, *also(2)])
@pytest.mark.parametrize("tick_s", [0.0, 0.001])
def test_a_saturated_link_hardly_delays_a_pose(seed: int, tick_s: float) -> None:
    world = run(link(4e6, 0.05), 14.0, seed=seed, tick_s=tick_s)
    poses, floor = world.poses_ms(5.0), floor_ms(4e6, 0.05)
    assert at(poses, 0.5) < 1.10 * floor
    assert at(poses, 0.99) < 1.25 * floor
    assert world.goodput_bps(5.0, 14.0) > 0.97 * carries_bps(4e6)
    assert world.hop.forward.stats.queue_drops == 0


def test_a_stream_with_fragments_of_3_ms() -> None:
    world = run(link(4e6, 0.05).as_stream(), 14.0)
    poses, floor = world.poses_ms(5.0), floor_ms(4e6, 0.05)
    assert at(poses, 0.5) < 1.15 * floor
    assert at(poses, 0.99) < 1.3 * floor
    assert world.goodput_bps(5.0, 14.0) > 0.96 * carries_bps(4e6)


@pytest.mark.parametrize(
    ("change", "loss"),
    [({"loss": 0.02}, 0.02), ({"loss": 0.05}, 0.05), ({"burst_loss": BurstLoss(0.01, 0.3)}, 0.033)],
)
def test_loss_on_the_path_is_not_a_full_link(change: dict[str, float], loss: float) -> None:
    model = LinkModel(rate_bps=4e6, delay_s=0.025, overhead_bytes=60, **change)  # type: ignore[arg-type]
    world = run(model, 14.0)
    assert world.goodput_bps(5.0, 14.0) > 0.92 * (1 - loss) * carries_bps(4e6)
    assert at(world.poses_ms(5.0), 0.99) < 1.35 * floor_ms(4e6, 0.05)


def test_jitter_costs_little_of_the_link() -> None:
    model = LinkModel(rate_bps=4e6, delay_s=0.025, jitter_s=0.005, overhead_bytes=60)
    world = run(model, 20.0)
    assert world.goodput_bps(5.0, 20.0) > 0.85 * carries_bps(4e6)
    assert at(world.poses_ms(5.0), 0.99) < 3 * floor_ms(4e6, 0.05)


@cache
def long_fast_path() -> World:
    """Two tests look at it, and change nothing."""
    return run(link(20e6, 0.2), 14.0)


def test_a_long_fast_path_is_filled_without_a_queue() -> None:
    world = long_fast_path()
    assert world.goodput_bps(8.0, 14.0) > 0.94 * carries_bps(20e6)
    assert at(world.poses_ms(8.0), 0.99) < 1.3 * floor_ms(20e6, 0.2)


@pytest.mark.parametrize(("rate_bps", "rtt_s"), [(0.25e6, 0.05), (1e6, 0.005), (1e6, 1.0), (20e6, 0.005), (20e6, 0.2)])
def test_links_of_all_kinds(rate_bps: float, rtt_s: float) -> None:
    begin_s = 4.0 + 15 * rtt_s
    end_s = begin_s + 4.0 + 8 * rtt_s
    world = long_fast_path() if (rate_bps, rtt_s) == (20e6, 0.2) else run(link(rate_bps, rtt_s), end_s)
    assert world.goodput_bps(begin_s, end_s) > 0.88 * carries_bps(rate_bps)
    # One datagram may be on the wire when the pose comes.
    limit_ms = max(30.0, 500 * rtt_s) + 8e3 * 1260 / rate_bps
    assert at(world.poses_ms(begin_s), 0.99) - floor_ms(rate_bps, rtt_s) < 1.15 * limit_ms


@pytest.mark.parametrize(
    ("off_s", "tick_s"),
    [(0.0, 0.0), (0.013, 0.001), (0.37, 0.0), (0.37, 0.001), *also((0.0, 0.001), (0.013, 0.0))],
)
def test_the_estimate_follows_the_capacity(off_s: float, tick_s: float) -> None:
    down_s, up_s = 4.0 + off_s, 8.0 + off_s
    model = LinkModel(
        rate_bps=8e6, delay_s=0.025, overhead_bytes=60, rate_steps=(RateStep(down_s, 1e6), RateStep(up_s, 4e6))
    )
    world = run(model, 12.0, tick_s=tick_s)
    for from_s, to_s, rate_bps, within_s in ((down_s, up_s, 1e6, 0.5), (up_s, 12.0, 4e6, 0.6)):
        off = [t for t, rate in world.rates() if from_s <= t < to_s and not 0.75 * rate_bps <= rate <= 1.25 * rate_bps]
        assert off[-1] - from_s < within_s


@pytest.mark.parametrize(
    ("rate_bps", "faster_bps", "tick_s"),
    [
        (1e6, 2e6, 0.0), (1e6, 2e6, 0.001), (2e6, 8e6, 0.001), (4e6, 20e6, 0.0),
        *also((2e6, 8e6, 0.0), (4e6, 20e6, 0.001)),
    ],
)  # fmt: skip
def test_a_link_that_gets_faster_is_found_by_packets_that_come_sooner(
    rate_bps: float, faster_bps: float, tick_s: float
) -> None:
    up_s = 4.1
    model = LinkModel(rate_bps=rate_bps, delay_s=0.025, overhead_bytes=60, rate_steps=(RateStep(up_s, faster_bps),))
    world = run(model, 7.0, tick_s=tick_s)
    off = [t for t, rate in world.rates() if t >= up_s and not 0.75 * faster_bps <= rate <= 1.25 * faster_bps]
    assert off[-1] - up_s < 0.6
    assert at(world.poses_ms(up_s, up_s + 2.0), 0.99) < 3.0 * floor_ms(rate_bps, 0.05)


@pytest.mark.parametrize(("jitter_s", "seed"), [(0.001, 6), (0.002, 17)])
def test_a_link_that_gets_faster_is_found_right_after_the_queue_made_way(jitter_s: float, seed: int) -> None:
    """By packets that come sooner, though some of that may be a queue that is gone."""
    up_s = 15.0 + 0.23 * seed
    model = replace(
        link(8e6, 0.05),
        jitter_s=jitter_s,
        jitter=Jitter.UNIFORM,
        rate_steps=(RateStep(5.0, 1e6), RateStep(up_s, 4e6)),
    )
    world = run(model, up_s + 3.0, seed=seed, tick_s=jitter_s)
    found_s = next(t for t, rate in world.rates() if t >= up_s and 3e6 <= rate <= 5e6)
    assert found_s - up_s < 0.6
    assert max(world.poses_ms(up_s)) < 80.0


def test_a_link_that_gets_faster_shows_in_what_little_is_sent_and_nothing_else_does() -> None:
    model = LinkModel(
        rate_bps=40e6, delay_s=0.005, overhead_bytes=60, rate_steps=(RateStep(1.0, 0.3e6), RateStep(28.0, 40e6))
    )
    world = World(model, seed=1)
    estimator = HybridWindow()
    world.flow(estimator, stop_s=10.0)  # from then on only poses
    world.run(27.9)
    assert estimator.eased_s == -inf
    world.run(28.5)
    assert 0.0 < estimator.eased_s - world.network.start_s - 28.0 < 0.3


@pytest.mark.parametrize("gap_s", [10.0, 30.0])
def test_after_a_blackout_poses_flow_at_once(gap_s: float) -> None:
    model = LinkModel(rate_bps=4e6, delay_s=0.025, overhead_bytes=60, blackouts=(Window(4.0, 4.0 + gap_s),))
    world = run(model, 10.0 + gap_s)
    back_s = world.network.start_s + 4.0 + gap_s
    first_s = min(born + delay for born, delay in world.sinks[0].poses if born + delay > back_s)
    assert first_s - back_s < 0.3
    assert world.goodput_bps(6.0 + gap_s, 10.0 + gap_s) > 0.9 * carries_bps(4e6)


def test_start_up_on_a_long_path() -> None:
    world = run(link(1e6, 0.5), 8.0)
    assert world.goodput_bps(2.0, 8.0) > 0.9 * carries_bps(1e6)
    assert world.poses_ms(0.0)[-1] - floor_ms(1e6, 0.5) < 300.0


@pytest.mark.parametrize(("rate_bps", "rtt_s"), [(4e6, 0.05), (8e6, 0.04)])
def test_two_flows_share_alike(rate_bps: float, rtt_s: float) -> None:
    """Jain's index, in the mean: who has how much depends on when the second one came."""
    shares = []
    for start_s in (2.0, 2.17, 2.34, 2.51):
        world = World(link(rate_bps, rtt_s))
        world.flow(HybridWindow())
        world.flow(HybridWindow(), poses=False, start_s=start_s)
        world.run(20.0)
        one, two = (world.goodput_bps(10.0, 20.0, index) for index in (0, 1))
        shares.append((one + two) ** 2 / (2 * (one**2 + two**2)))
    assert fmean(shares) > 0.88 and min(shares) > 0.65


@pytest.mark.parametrize("rival", [Cubic, BbrLike])
def test_a_rival_that_fills_the_queue_starves_nobody(rival: type[CapacityEstimator]) -> None:
    world = World(link(4e6, 0.05))
    world.flow(HybridWindow())
    world.flow(rival(), poses=False, start_s=3.0)
    world.run(30.0)
    ours, theirs = (world.goodput_bps(15.0, 30.0, index) for index in (0, 1))
    assert 0.15 < ours / (ours + theirs) < 0.85


def test_when_the_rival_leaves_the_queue_goes() -> None:
    world = World(link(4e6, 0.05))
    estimator = HybridWindow()
    world.flow(estimator)
    world.flow(Cubic(), poses=False, start_s=2.0, stop_s=15.0)
    world.run(14.0)
    assert at(world.poses_ms(8.0, 14.0), 0.5) > 100.0  # its queue, whoever waits in it
    world.run(36.0)
    assert estimator.snapshot()["competing"] == 0.0
    assert at(world.poses_ms(30.0), 0.99) < 1.35 * floor_ms(4e6, 0.05)
    assert world.goodput_bps(30.0, 36.0) > 0.94 * carries_bps(4e6)


def test_poses_alone_for_minutes_then_overload() -> None:
    world = World(link(4e6, 0.05))
    world.flow(HybridWindow(), start_s=120.0)
    world.run(130.0)
    assert at(world.poses_ms(120.0), 0.99) < 1.6 * floor_ms(4e6, 0.05)
    assert world.goodput_bps(121.0, 130.0) > 0.94 * carries_bps(4e6)


def test_a_window_that_was_not_used_is_not_believed() -> None:
    model = LinkModel(rate_bps=8e6, delay_s=0.025, overhead_bytes=60, rate_steps=(RateStep(10.0, 1e6),))
    world = World(model)
    estimator = HybridWindow()
    world.flow(estimator, stop_s=5.0)
    world.run(5.0)
    full = estimator.window_bytes
    world.run(30.0)
    assert full > 45_000 and estimator.window_bytes < 13_000
    flow = world.flows[0]
    flow.start_s, flow.stop_s = world.network.now, inf
    world.run(40.0)
    assert world.poses_ms(30.0)[-1] < 200.0
    assert world.goodput_bps(31.0, 40.0) > 0.9 * carries_bps(1e6)


def test_a_saturated_way_back_is_no_queue_of_ours() -> None:
    back = LinkModel(rate_bps=0.5e6, delay_s=0.025, overhead_bytes=60)
    world = World(link(20e6, 0.05), back)
    world.flow(HybridWindow(), thin=True)
    world.run(11.0)
    assert at(world.poses_ms(5.0), 0.99) < 1.4 * floor_ms(20e6, 0.05)
    assert world.goodput_bps(5.0, 11.0) > 0.85 * carries_bps(20e6)


def ack(estimator: HybridWindow, now: float, rtt_s: float, cum_bytes: int, *, behind_s: float = 0.0) -> None:
    sent_s = now - rtt_s
    estimator.on_sent(now=sent_s, nbytes=1260, inflight_bytes=int(estimator.window_bytes))
    received_s = 7e4 + sent_s + rtt_s / 2
    estimator.on_ack(AckSample(now, rtt_s + behind_s, 2520, 20_000, received_s, cum_bytes, False, sent_s, 1260))


def test_without_a_bottleneck_the_window_grows_without_limit() -> None:
    estimator = HybridWindow()
    cum_bytes = 0
    for n in range(4000):
        cum_bytes += 2520
        ack(estimator, 5.0 + n * 5e-5, 2e-4, cum_bytes)
    rate_bps = estimator.rate_bps
    assert rate_bps is not None and rate_bps > 300e6
    # More than the product of what was offered and the round trip: it limits nothing.
    assert estimator.window_bytes > 1.05 * rate_bps / 8 * 2e-4
    pacing_bps = estimator.pacing_bps
    assert pacing_bps is None or pacing_bps > rate_bps


def test_stamps_that_stand_still_divide_nothing_by_zero() -> None:
    estimator = HybridWindow()
    for n in range(1000):
        estimator.on_ack(AckSample(1.0, 1e-6, 1200, 0, 1.0, 1200 * n, False, 1.0, 1260))
    assert 0.0 < estimator.window_bytes < inf


def test_without_send_stamps_the_round_trip_serves() -> None:
    estimator = HybridWindow()
    for n in range(2000):
        now = 10.0 + 0.005 * n
        estimator.on_sent(now=now, nbytes=1260, inflight_bytes=int(estimator.window_bytes))
        estimator.on_ack(AckSample(now, 0.0525, 2520, 24_000, now, 2520 * n, False))
    assert estimator.rtprop_s == pytest.approx(0.0525)
    assert estimator.rate_bps == pytest.approx(8 * 2520 / 0.005, rel=0.01)


def test_a_reset_forgets_and_a_stall_keeps_the_path() -> None:
    estimator = HybridWindow()
    for n in range(500):
        ack(estimator, 10.0 + 0.005 * n, 0.0525, 2520 * n)
    before = estimator.snapshot()
    estimator.on_stall(now=13.0)
    stalled = estimator.snapshot()
    assert stalled["rate_bps"] is None and stalled["rtprop_s"] == before["rtprop_s"]
    assert estimator.window_bytes <= 12_600
    estimator.on_reset(now=14.0)
    reset = estimator.snapshot()
    assert reset["rtprop_s"] is None and reset["window_bytes"] == 12_600


def test_what_was_sent_into_a_silence_does_not_end_start_up() -> None:
    """A few poses, most of them lost before the path was back, say nothing of what it carries."""
    estimator = HybridWindow()
    cum_bytes = 0

    def acked(now: float, nbytes: int) -> None:
        nonlocal cum_bytes
        cum_bytes += nbytes
        sent_s = now - 0.5
        estimator.on_sent(now=sent_s, nbytes=nbytes, inflight_bytes=nbytes)
        estimator.on_ack(AckSample(now, 0.5, nbytes, 0, 7e4 + sent_s + 0.25, cum_bytes, False, sent_s, nbytes))

    for n in range(200):
        acked(10.0 + 0.02 * n, 1260)
    estimator.on_stall(now=15.0)
    for n in range(6):
        estimator.on_loss(now=20.0 + 0.1 * n, nbytes=208)
        acked(20.0 + 0.1 * n, 208)
    assert estimator.snapshot()["startup"] == 1.0
    for _ in range(10):
        acked(21.5, 1260)
    assert estimator.window_bytes >= 12_600


@pytest.mark.parametrize(("rtt_s", "longer_s"), [(0.05, 0.05), (0.15, -0.05)])
def test_another_route_is_not_taken_for_a_queue_for_ever(rtt_s: float, longer_s: float) -> None:
    """The way out gets longer, or shorter."""
    world = World(link(4e6, rtt_s))
    world.flow(HybridWindow())
    path = world.hop.forward.link

    def reroute(_now: float) -> None:
        path._delay_ns += round(longer_s * 1e9)

    world.network.at(8.0, reroute)
    world.run(20.0)
    assert world.goodput_bps(14.0, 20.0) > 0.9 * carries_bps(4e6)
    assert at(world.poses_ms(14.0), 0.99) < 1e3 * (rtt_s / 2 + longer_s) + 15.0


def test_class_control_that_exceeds_a_low_pace_holds_nobody_back_for_long() -> None:
    """Class control does not ask the pacer. Forty datagrams a second at a pace of 25 kbit/s must not add up."""
    pacer = Pacer()
    for number in range(80):
        now = 0.025 * number
        before_s = pacer.due_s
        pacer.sent(now=now, nbytes=420, pacing_bps=25_000.0)
        assert before_s <= pacer.due_s <= max(before_s, now + 8 * 420 / 25_000)
    assert pacer.due_s - 2.0 < 0.2
    pacer.sent(now=2.0, nbytes=1250, pacing_bps=10_000.0)  # who asks still keeps to the pace
    assert pacer.due_s >= 3.0 - 1e-9
    pacer.sent(now=2.1, nbytes=420, pacing_bps=1e6)
    assert pacer.due_s >= 3.0 - 1e-9


def test_a_pace_that_turns_out_too_low_holds_nobody_back() -> None:
    """Before much was sent the estimate may be a kilobit a second, for which a datagram takes seconds."""
    pacer = Pacer()
    pacer.sent(now=0.0, nbytes=1250, pacing_bps=1000.0)
    pacer.paced(now=0.05, pacing_bps=500.0)  # slower: what has left keeps its time
    assert pacer.due_s == pytest.approx(10.0, abs=0.01)
    pacer.paced(now=0.05, pacing_bps=2e6)
    assert pacer.due_s < 0.06
    pacer.sent(now=1.0, nbytes=1250, pacing_bps=1e6)
    due_s = pacer.due_s
    pacer.paced(now=1.0, pacing_bps=2e6)  # a short wait is not worth it
    assert pacer.due_s == due_s


def test_the_pacer_gives_back_what_a_late_timer_lost() -> None:
    pacer = Pacer()
    left, now = 0, 0.0
    while now < 10.0:
        while pacer.ready(now):
            pacer.sent(now=now, nbytes=1250, pacing_bps=4e6)
            left += 1250
        now += 0.001
    assert 8 * left / 10.0 == pytest.approx(4e6, rel=0.01)
    pacer.sent(now=20.0, nbytes=1250, pacing_bps=None)
    assert pacer.ready(20.0)


@pytest.mark.parametrize("waits", [False, True])
def test_what_waited_for_a_busy_machines_timer_is_made_good(*, waits: bool) -> None:
    """And what was not there meanwhile is not: it leaves no faster than the pace."""
    pacer = Pacer()
    left, now = 0, 0.0
    while now < 10.0:
        while pacer.ready(now):
            pacer.sent(now=now, nbytes=1250, pacing_bps=4e6, waits=waits)
            left += 1250
        now += 0.010
    assert 8 * left / 10.0 == pytest.approx(4e6 if waits else 1e6, rel=0.1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_late_timers_do_not_hide_a_faster_link(seed: int) -> None:
    steps = (RateStep(5.0, 1e6), RateStep(15.0, 4e6))
    world = run(replace(link(8e6, 0.05), rate_steps=steps), 20.0, seed=seed, tick_s=0.010)
    assert world.goodput_bps(16.0, 20.0) > 0.85 * carries_bps(4e6)
    assert at(world.poses_ms(16.0), 0.99) < 25.0 + 25.0


def test_our_own_slowness_is_not_taken_for_the_links() -> None:
    """A busy processor sends late: little arrives, nothing queues. That was taken for the link's rate, and paced by."""
    estimator = HybridWindow()
    now, cum_bytes = 100.0, 0

    def send(spacing_s: float, inflight_bytes: int, seconds: float) -> None:
        nonlocal now, cum_bytes
        end_s = now + seconds
        while now < end_s:
            now += spacing_s
            cum_bytes += 1228
            estimator.on_ack(
                AckSample(now, 0.05, 1228, inflight_bytes, now - 0.025, cum_bytes, False, now - 0.05, 1228)
            )

    send(1228 * 8 / 4e6, 25_000, 5.0)
    before_bps = estimator.bound_bps
    assert before_bps is not None and before_bps > 3e6
    send(0.25, 0, 30.0)
    after_bps = estimator.bound_bps
    assert after_bps is not None and after_bps > 0.5 * before_bps


def test_little_traffic_of_several_sizes_makes_no_long_path() -> None:
    """The rate is that of what was offered, a few hundred bytes a second: by it a packet would take seconds."""
    estimator = HybridWindow()
    cum_bytes = 0
    for number in range(400):
        now, nbytes = 100.0 + 0.5 * number, (1231, 1000, 700, 200)[number % 4]
        estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=nbytes)
        cum_bytes += nbytes
        estimator.on_ack(
            AckSample(now + 0.002, 0.002, nbytes, 0, now + 0.001, cum_bytes, True, now, packet_bytes=nbytes)
        )
    assert estimator.rtprop_s == pytest.approx(0.002, rel=0.5)
    assert estimator.rate_bps is None
