"""What an estimator makes of a link, in virtual time: pose delay, goodput, adaptation, company, start-up.

Bulk without end beside a 100-byte pose every 20 ms, as `benchmarks.flows` models them: 1200-byte datagrams, or for
`stream` fragments of 3 ms in a stream that loses nothing. Pose delays are given as multiples of the idle path's,
goodput as the share of what the link can carry beside the poses, headers and losses counted out.
`fixed` knows 4 Mbit/s x 50 ms and is measured only there. `hybrid6` is an earlier design, kept here as a reference.
"""

import argparse
import sys
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from time import process_time
from typing import Final

from benchmarks.common import Report, interleaved, main, percentile
from benchmarks.delay import DelayWindow
from benchmarks.flows import (
    DATAGRAM_BYTES,
    FRAGMENT_TIME_S,
    HEADER_BYTES,
    MAX_FRAGMENT_BYTES,
    OVERHEAD_BYTES,
    POSE_BYTES,
    POSE_PERIOD_S,
    BbrLike,
    Cubic,
    World,
)
from benchmarks.reference import reach_forwarding
from sern_core.path.capacity import AckSample, CapacityEstimator
from sern_core.path.congestion.fixed import FixedWindow
from sern_core.path.congestion.hybrid import HybridWindow
from sern_sim.models import SEGMENT_BYTES, BurstLoss, LinkModel, RateStep, Window

Maker = Callable[[], CapacityEstimator]
ACK_LIMIT: Final = 0.4
"""CPU of an acknowledgement, by that of forwarding one datagram."""
POSE_WIRE_BYTES: Final = POSE_BYTES + HEADER_BYTES + OVERHEAD_BYTES


class Hybrid6(CapacityEstimator):
    """The reference: round-trip percentiles, W adjusted by 5 % an epoch, drain every 5 s."""

    def __init__(self, *, fragment_bytes: int = DATAGRAM_BYTES + OVERHEAD_BYTES) -> None:
        self._fragment = float(fragment_bytes)
        self._begin()

    def _begin(self) -> None:
        self._window = 24_000.0
        self._startup = True
        self._rates: deque[tuple[float, float]] = deque()
        self._least: deque[tuple[float, float]] = deque()
        self._epoch: list[tuple[float, float]] = []
        self._epoch_s: float | None = None
        self._last: deque[float] = deque(maxlen=8)
        self._jitter_s = 0.0
        self._mark: tuple[float, int] | None = None
        self._marks: deque[tuple[float, int]] = deque(maxlen=16)
        self._span_limited = False
        self._limited = False
        self._above = self._empty = 0
        self._emergency_s = -inf
        self._drain_s = -inf
        self._drained_s: float | None = None
        self._high_s = inf

    @property
    def window_bytes(self) -> float:
        rtprop_s = self.rtprop_s
        if self._drained_s is not None and self._rates and rtprop_s is not None:
            return min(self._window, max(3 * self._fragment, 0.55 * self._rates[0][1] * rtprop_s))
        return self._window

    @property
    def rate_bps(self) -> float | None:
        return 8 * self._rates[0][1] if self._rates else None

    @property
    def rtprop_s(self) -> float | None:
        return self._least[0][1] if self._least else None

    @property
    def pacing_bps(self) -> float | None:
        return 8 * 1.15 * self._window / self._least[0][1] if self._least else None

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        self._fragment = max(self._fragment, float(nbytes))
        if inflight_bytes >= self._window - self._fragment:
            self._limited = True

    def on_ack(self, sample: AckSample) -> None:
        now = sample.now
        self._last.append(sample.rtt_s)
        if not self._marks or sample.receiver_s >= self._marks[-1][0] + 0.02:
            self._marks.append((sample.receiver_s, sample.cum_bytes))
        self._measure(sample)
        if self._epoch_s is None:
            self._epoch_s = now
            self._drain_s = now
        self._epoch.append((now, sample.rtt_s))
        rtprop_s = self.rtprop_s
        if rtprop_s is not None and len(self._last) == 8:
            high = sorted(self._last)[1] - rtprop_s > 3 * self._high_s
            if high and now >= self._emergency_s + max(0.1, sample.rtt_s):
                self._emergency(now, rtprop_s)
        if now >= self._epoch_s + max(0.040, rtprop_s or 0.0):
            self._close(now)

    def _measure(self, sample: AckSample) -> None:
        if self._mark is None:
            self._mark = (sample.receiver_s, sample.cum_bytes)
            return
        self._span_limited |= sample.app_limited
        span_s = sample.receiver_s - self._mark[0]
        if span_s < max(0.120, 2 * (self.rtprop_s or 0.0)):
            return
        rate = (sample.cum_bytes - self._mark[1]) / span_s
        self._mark = (sample.receiver_s, sample.cum_bytes)
        if self._drained_s is None and (not self._span_limited or not self._rates):
            self._note(sample.now, rate)
        self._span_limited = False

    def _note(self, now: float, rate: float) -> None:
        while self._rates and self._rates[-1][1] <= rate:
            self._rates.pop()
        self._rates.append((now, rate))
        while self._rates[0][0] < now - 1.2 and len(self._rates) > 1:
            self._rates.popleft()

    def _recent(self) -> float | None:
        if len(self._marks) < 2:
            return None
        last = self._marks[-1]
        since = next((mark for mark in reversed(self._marks) if last[0] - mark[0] >= 0.15), self._marks[0])
        return (last[1] - since[1]) / (last[0] - since[0])

    def _emergency(self, now: float, rtprop_s: float) -> None:
        rate = self._recent()
        if rate is None:
            return
        self._rates.clear()
        self._note(now, rate)
        self._window = max(3 * self._fragment, 0.9 * rate * (rtprop_s + self._jitter_s))
        self._emergency_s = now
        self._startup = False

    def _close(self, now: float) -> None:
        rtts = sorted(rtt_s for _, rtt_s in self._epoch)
        typical_s, upper_s = rtts[len(rtts) // 5], rtts[len(rtts) * 4 // 5]
        least = self._least
        while least and least[-1][1] >= typical_s:
            least.pop()
        least.append((now, typical_s))
        while least[0][0] < now - 10.0:
            least.popleft()
        rtprop_s = least[0][1]
        self._jitter_s += 0.1 * (min(upper_s - typical_s, 0.020 + 0.2 * rtprop_s) - self._jitter_s)
        queue_s = typical_s - rtprop_s
        rate = self._rates[0][1] if self._rates else None
        serialise_s = self._fragment / rate if rate else 0.0
        target_s = 0.002 + serialise_s / 2 + self._jitter_s
        self._high_s = max(0.010, 0.2 * rtprop_s) + serialise_s + 1.5 * self._jitter_s
        if self._drained_s is not None:
            if now >= self._drained_s + rtprop_s:
                self._drained_s = None
        elif rate is not None:
            self._adjust(now, queue_s, target_s, rtprop_s, rate)
            if now >= self._drain_s + 5.0:
                self._drain_s = self._drained_s = now
        elif self._limited:
            self._window *= 1.6
        floor = 3 * self._fragment
        most = 1.4 * rate * (rtprop_s + self._jitter_s) + floor if rate else inf
        self._window = max(floor, min(self._window, most, 64 * 2**20))
        self._epoch.clear()
        self._epoch_s = now
        self._limited = False

    def _adjust(self, now: float, queue_s: float, target_s: float, rtprop_s: float, rate: float) -> None:
        if queue_s > self._high_s:
            self._startup = False
            self._above += 1
            self._window = min(self._window, 0.95 * rate * (rtprop_s + self._jitter_s))
            recent = self._recent()
            if self._above >= 2 and recent:
                self._rates.clear()
                self._note(now, recent)
                self._above = 0
            return
        self._above = 0
        if not self._limited:
            return
        if self._startup and queue_s < self._high_s / 2:
            self._window *= 1.6
            return
        self._startup = False
        self._empty = self._empty + 1 if queue_s < target_s / 4 else 0
        if self._empty >= 3:
            self._window *= 1.10 if self._empty == 3 else 1.25
        else:
            self._window *= 1 + 0.05 * min(1.0, max(-2.0, (target_s - queue_s) / target_s))

    def on_loss(self, *, now: float, nbytes: int) -> None:
        """Delay decides."""

    def on_reset(self, *, now: float) -> None:
        self._begin()

    def on_stall(self, *, now: float) -> None:
        self._begin()


SYSTEMS: Final[dict[str, Maker]] = {
    "delay": lambda: DelayWindow(fragment_bytes=DATAGRAM_BYTES + OVERHEAD_BYTES),
    "hybrid6": Hybrid6,
    "hybrid": HybridWindow,
}
FIXED: Final[Maker] = lambda: FixedWindow(25_000)  # noqa: E731 - one of the makers


def link(rate_bps: float, rtt_s: float, **more: object) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=rtt_s / 2, overhead_bytes=OVERHEAD_BYTES, **more)  # type: ignore[arg-type]


def floor_ms(model: LinkModel) -> float:
    """The delay of a pose on the idle path, without jitter."""
    return 1e3 * (model.delay_s + 8 * POSE_WIRE_BYTES / (model.rate_bps or inf))


def carries_bps(model: LinkModel, rate_bps: float | None = None) -> float:
    """Bulk payload that fits beside the poses."""
    rate_bps = rate_bps or model.rate_bps or inf
    size, segments = DATAGRAM_BYTES, 1
    if model.streaming:
        size = int(min(max(FRAGMENT_TIME_S * rate_bps / 8, DATAGRAM_BYTES), MAX_FRAGMENT_BYTES))
        segments = -(-size // SEGMENT_BYTES)
    share = (size - HEADER_BYTES) / (size + OVERHEAD_BYTES * segments)
    return (
        (rate_bps - 8 * POSE_WIRE_BYTES / POSE_PERIOD_S) * share * (1 - (0.0 if model.streaming else model.mean_loss))
    )


def jain(shares: list[float]) -> float:
    return sum(shares) ** 2 / (len(shares) * sum(share * share for share in shares))


def mean(values: list[float]) -> float:
    return sum(values) / len(values)


Case = tuple[str, LinkModel, LinkModel | None, float]
STEADY: Final[list[Case]] = [
    ("4 Mbit/s 50 ms", link(4e6, 0.05), None, 0.0),
    ("same, stream", link(4e6, 0.05).as_stream(), None, 0.0),
    ("same, 1 ms timers", link(4e6, 0.05), None, 0.001),
    ("same, 2 % loss", link(4e6, 0.05, loss=0.02), link(4e6, 0.05, loss=0.02), 0.0),
    ("same, 5 % loss", link(4e6, 0.05, loss=0.05), link(4e6, 0.05, loss=0.05), 0.0),
    ("same, burst loss", link(4e6, 0.05, burst_loss=BurstLoss(0.01, 0.3)), None, 0.0),
    ("same, jitter 5 ms", link(4e6, 0.05, jitter_s=0.005), None, 0.0),
    ("same, reordering 2 %", link(4e6, 0.05, reorder=0.02, reorder_delay_s=0.005), None, 0.0),
    ("same, 20 % of acks lost", link(4e6, 0.05), link(4e6, 0.05, loss=0.2), 0.0),
    ("20 Mbit/s 200 ms", link(20e6, 0.2), None, 0.0),
    ("20 Mbit/s 200 ms, 2 % loss", link(20e6, 0.2, loss=0.02), None, 0.0),
    ("1 Mbit/s 500 ms", link(1e6, 0.5), None, 0.0),
    ("20 Mbit/s 600 ms", link(20e6, 0.6), None, 0.0),
]
GRID_BPS: Final = (0.25e6, 1e6, 4e6, 20e6, 50e6)
GRID_RTT_S: Final = (0.005, 0.05, 0.2, 1.0)


def steady(case: Case, make: Maker, seed: int) -> tuple[float, float, float]:
    """Pose p50 and p99 against the floor, goodput against what the link carries."""
    _, forward, backward, tick_s = case
    world = World(forward, backward, seed=seed, tick_s=tick_s)
    world.flow(make())
    begin_s = 8.0 + 10 * forward.delay_s
    world.run(begin_s + 20.0)
    delays, floor = world.poses_ms(begin_s), floor_ms(forward)
    goodput = world.goodput_bps(begin_s, begin_s + 20.0) / carries_bps(forward)
    return percentile(delays, 0.5) / floor, percentile(delays, 0.99) / floor, goodput


def run_steady(report: Report, seeds: range, cases: Sequence[str]) -> None:
    for case in STEADY:
        if case[0] not in cases:
            continue
        systems = {"fixed 25 kB": FIXED, **SYSTEMS} if "Mbit/s 50" in case[0] or "same" in case[0] else SYSTEMS
        for name, make in systems.items():
            runs = [steady(case, make, seed) for seed in seeds]
            report.row(
                case[0],
                name,
                p50_x=mean([run[0] for run in runs]),
                p99_x=max(run[1] for run in runs),
                goodput_share=min(run[2] for run in runs),
            )


def settled_s(rates: list[tuple[float, float]], from_s: float, to_s: float, rate_bps: float) -> float:
    """How long after `from_s` the estimate was last more than 25 % off."""
    off = [t for t, rate in rates if from_s <= t < to_s and not 0.75 * rate_bps <= rate <= 1.25 * rate_bps]
    return off[-1] - from_s if off else 0.0


def run_changes(report: Report) -> None:
    stepped = link(8e6, 0.05, rate_steps=(RateStep(10.0, 1e6), RateStep(20.0, 4e6)))
    for name, make in SYSTEMS.items():
        world = World(stepped)
        world.flow(make())
        world.run(30.0)
        report.row("step 8 to 1 Mbit/s", name, settled_s=settled_s(world.rates(), 10.0, 20.0, 1e6))
        report.row("step 1 to 4 Mbit/s", name, settled_s=settled_s(world.rates(), 20.0, 30.0, 4e6))
        for gap_s in (10.0, 30.0):
            world = World(link(4e6, 0.05, blackouts=(Window(10.0, 10.0 + gap_s),)))
            world.flow(make())
            world.run(14.0 + gap_s)
            back_s = world.network.start_s + 10.0 + gap_s
            first_s = min(born + delay - back_s for born, delay in world.sinks[0].poses if born + delay > back_s)
            report.row(f"blackout {gap_s:.0f} s", name, first_s=first_s)
        for rate_bps, rtt_s in ((1e6, 0.5), (20e6, 0.6)):
            model = link(rate_bps, rtt_s)
            world = World(model)
            world.flow(make())
            world.run(20.0)
            steps = [0.1 * n for n in range(180)]
            enough = 0.8 * carries_bps(model)
            up_s = next((t for t in steps if world.goodput_bps(t, t + rtt_s) >= enough), inf)
            queue_ms = world.poses_ms(0.0)[-1] - floor_ms(model)
            report.row(
                f"start {rate_bps / 1e6:g} Mbit/s {rtt_s * 1e3:g} ms",
                name,
                to_80_s=min(up_s, 20.0),
                most_queue_ms=queue_ms,
            )


def run_company(report: Report, seeds: range) -> None:
    for rate_bps, rtt_s in ((4e6, 0.05), (20e6, 0.04)):
        model = link(rate_bps, rtt_s)
        for name, make in SYSTEMS.items():
            for rival, other in (("itself", make), ("cubic", Cubic), ("bbr-like", BbrLike)):
                shares, fair = [], []
                for seed in seeds:
                    world = World(model, seed=seed)
                    world.flow(make())
                    world.flow(other(), poses=False, start_s=3.0)
                    world.run(60.0)
                    goodputs = [world.goodput_bps(30.0, 60.0, index) for index in (0, 1)]
                    shares.append(goodputs[0] / sum(goodputs))
                    fair.append(jain(goodputs))
                report.row(f"{rate_bps / 1e6:g} Mbit/s with {rival}", name, share_x=mean(shares), fairness_x=min(fair))


def run_grid(report: Report) -> None:
    for name, make in SYSTEMS.items():
        passed = count = 0
        for rate_bps in GRID_BPS:
            for rtt_s in GRID_RTT_S:
                if rate_bps * rtt_s > 25e6:
                    continue
                model = link(rate_bps, rtt_s)
                begin_s = 8.0 + 20 * rtt_s
                end_s = begin_s + 12.0 + 8 * rtt_s
                world = World(model)
                world.flow(make())
                world.run(end_s)
                share = world.goodput_bps(begin_s, end_s) / carries_bps(model)
                queue_ms = percentile(world.poses_ms(begin_s), 0.99) - floor_ms(model)
                # One datagram may be under way when the pose comes.
                limit_ms = max(30.0, 500 * rtt_s) + 8e3 * (DATAGRAM_BYTES + OVERHEAD_BYTES) / rate_bps
                count += 1
                passed += share >= 0.9 and queue_ms <= limit_ms
        report.row("grid 0.25-50 Mbit/s, 5-1000 ms", name, passed_share=passed / count)


def run_cost(report: Report) -> None:
    count = 20_000
    samples = [
        AckSample(now := 1e3 + n * 5e-3, 0.0525, 2520, 24_000, now - 0.025, 2520 * n, False, now - 0.0525, 1260)
        for n in range(count)
    ]

    def cost_us(make: Maker) -> float:
        estimator = make()
        began_s = process_time()
        for sample in samples:
            estimator.on_ack(sample)
        return 1e6 * (process_time() - began_s) / count

    for name, costs in interleaved({name: partial(cost_us, make) for name, make in SYSTEMS.items()}, 3).items():
        report.row("one acknowledgement", name, cost_us=min(costs))


PARTS: Final = ("steady", "changes", "company", "cost", "grid")


def run(options: argparse.Namespace, report: Report) -> None:
    seeds = range(1, 2) if options.quick else range(1, 4)
    parts = options.parts or (PARTS[:-1] if options.quick else PARTS)
    if "steady" in parts:
        run_steady(report, seeds, options.cases)
    if "changes" in parts:
        run_changes(report)
    if "company" in parts:
        run_company(report, seeds)
    if "cost" in parts:
        run_cost(report)
    if "grid" in parts:
        run_grid(report)
    report.note(f"virtual time, seeds {seeds.start} to {seeds.stop - 1}; p99 and goodput are the worst seed's")
    if len(parts) < len(PARTS):
        report.note(f"measured alone: {', '.join(parts)}")
    for part, reach in (
        ("steady", partial(_steady_reaches, cases=options.cases)),
        ("changes", _change_reaches),
        ("company", _company_reaches),
        ("cost", _cost_reach),
        ("grid", _grid_reach),
    ):
        if part in parts:
            reach(report)


def _steady_reaches(report: Report, *, cases: Sequence[str]) -> None:
    for case, p50, p99, share in (
        ("4 Mbit/s 50 ms", 1.10, 1.25, 0.97),
        ("same, stream", 1.15, 1.40, 0.97),
        ("same, 2 % loss", inf, 1.35, 0.90),
        ("20 Mbit/s 200 ms", inf, 1.50, 0.95),
    ):
        if case not in cases:
            continue
        if p50 < inf:
            report.reach(f"{case}: pose p50 / floor", report.value(case, "hybrid", "p50_x"), p50)
        report.reach(f"{case}: pose p99 / floor", report.value(case, "hybrid", "p99_x"), p99)
        report.reach(f"{case}: goodput", report.value(case, "hybrid", "goodput_share"), share, at_least=True)


def _change_reaches(report: Report) -> None:
    report.reach("step down, s", report.value("step 8 to 1 Mbit/s", "hybrid", "settled_s"), 0.5)
    report.reach("step up, s", report.value("step 1 to 4 Mbit/s", "hybrid", "settled_s"), 1.0)
    for gap in ("10", "30"):
        report.reach(f"pose after blackout {gap} s, s", report.value(f"blackout {gap} s", "hybrid", "first_s"), 0.3)


def _company_reaches(report: Report) -> None:
    for rate in ("4", "20"):
        fairness = report.value(f"{rate} Mbit/s with itself", "hybrid", "fairness_x")
        report.reach(f"{rate} Mbit/s: fairness of two", fairness, 0.95, at_least=True)
        for rival in ("cubic", "bbr-like"):
            share = report.value(f"{rate} Mbit/s with {rival}", "hybrid", "share_x")
            report.reach(f"{rate} Mbit/s with {rival}: smaller share", min(share, 1 - share), 0.2, at_least=True)


def _cost_reach(report: Report) -> None:
    reach_forwarding(
        report, "CPU of an acknowledgement", report.value("one acknowledgement", "hybrid", "cost_us"), ACK_LIMIT
    )


def _grid_reach(report: Report) -> None:
    passed = report.value("grid 0.25-50 Mbit/s, 5-1000 ms", "hybrid", "passed_share")
    report.reach("grid: cases within limits", passed, 1.0, at_least=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    names = [case[0] for case in STEADY]
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="these alone (default: all; quick: without grid)")
    parser.add_argument("--cases", nargs="+", choices=names, default=names, help="of the steady links these alone")


if __name__ == "__main__":
    sys.exit(main("estimator", run, description=__doc__, arguments=add_arguments))
