"""What the window does on paths with jitter, over several starts each, in virtual time; half a minute on two cores.

One start is luck where a window meets jitter: a change of the window is judged by the mean and the worst of several.
Every line is a path, by its rate and jitter, 25 ms each way where it says nothing else; poses go beside bulk without
end, or clouds go now and again.

    steady    bulk and poses, once the rate is known
    two       a second flow after 5 s; the later poses of the worse one, and how alike they share (Jain, 1984)
    start     the first seconds
    gone      after a blackout of 3 s: from half a second after its end
    thin      after 5 s at 0.6 Mbit/s: from two seconds after their end
    clouds    of several robots at once over a link that carries three times as much, by the real core, over datagrams
              or a stream: what came of the first two seconds, later ages over those of an ideal sender

`over` is the oldest pose of a hundred beyond the way there and back of the empty path.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from statistics import fmean
from typing import Final, NamedTuple

from benchmarks.common import Report, main, percentile
from benchmarks.flows import DATAGRAM_BYTES, HEADER_BYTES, OVERHEAD_BYTES, World
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import Jitter, LinkModel, RateStep, Window
from tests.world import World as CoreWorld
from tests.world import spec

DELAY_S: Final = 0.025
STARTS: Final = 8
QUICK_STARTS: Final = 2
BACK_S: Final = 9.0
"""When a link is whole again that was gone since 6 s, or thin since 4 s."""
CARRIES: Final = (DATAGRAM_BYTES - HEADER_BYTES) / (DATAGRAM_BYTES + OVERHEAD_BYTES)
"""What of a datagram on the wire is a message's."""
Figures = dict[str, float]


class Clouds(NamedTuple):
    """Robots that send clouds together, and the jitter of the link."""

    robots: int
    nbytes: int
    rate_hz: float
    delay_s: float
    jitter_s: float
    lossless: bool


def link(rate_bps: float, jitter_s: float, *, gone: bool = False, thin: bool = False) -> LinkModel:
    return LinkModel(
        rate_bps=rate_bps,
        delay_s=DELAY_S,
        jitter_s=jitter_s,
        jitter=Jitter.UNIFORM,
        queue_packets=200,
        overhead_bytes=OVERHEAD_BYTES,
        rate_steps=(RateStep(4.0, 0.6e6), RateStep(BACK_S, rate_bps)) if thin else (),
        blackouts=(Window(6.0, BACK_S),) if gone else (),
    )


def play(model: LinkModel, from_s: float, to_s: float, seed: int) -> Figures:
    """One flow; poses and bulk of that part of the run."""
    world = World(model, seed=seed)
    world.flow(HybridWindow())
    world.run(to_s)
    return _figures(world, model, from_s, to_s)


def _figures(world: World, model: LinkModel, from_s: float, to_s: float, index: int = 0) -> Figures:
    assert model.rate_bps is not None
    late_ms = percentile(world.poses_ms(from_s, to_s, index), 0.99) - 1e3 * DELAY_S
    share = world.goodput_bps(from_s, to_s, index) / (CARRIES * model.rate_bps)
    return {"over_ms": late_ms, "share_percent": 100 * share}


def two(model: LinkModel, seed: int) -> Figures:
    world = World(model, seed=seed)
    for start_s in (0.0, 5.0):
        world.flow(HybridWindow(), start_s=start_s)
    world.run(22.0)
    flows = [_figures(world, model, 12.0, 22.0, index) for index in (0, 1)]
    shares = [flow["share_percent"] for flow in flows]
    alike = sum(shares) ** 2 / (2 * sum(share**2 for share in shares))
    return {"over_ms": max(flow["over_ms"] for flow in flows), "share_percent": sum(shares), "alike_ratio": alike}


def clouds(case: Clouds, seed: int) -> Figures:
    """From 2 s on, when the session is there."""
    capacity_bps = 3 * 8 * case.robots * case.nbytes * case.rate_hz
    world = CoreWorld(lossless=case.lossless, seed=seed)
    model = LinkModel(rate_bps=capacity_bps, delay_s=case.delay_s, jitter_s=case.jitter_s, overhead_bytes=28)
    robot = world.client("robot", model.as_stream() if case.lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    topics = [f"/robot/points{number}" for number in range(case.robots)]
    for topic in topics:
        robot.every(1 / case.rate_hz, robot.publish(topic, spec(PriorityClass.STATE)), bytes(case.nbytes), first_s=2.0)
    world.run(4.0)
    first = len(site.got) / (case.robots * case.rate_hz * 2.0)
    world.run(3.0)
    start_s = world.network.start_s
    ages_s = sorted(
        got.at_s - robot.sent[topic, got.seq][0] for topic in topics for got in site.on(topic)
        if got.at_s - start_s >= 5.0
    )  # fmt: skip
    ideal_s = 8 * case.robots * case.nbytes / capacity_bps + case.delay_s
    return {
        "first_percent": 100 * first,
        "later_p50_ratio": percentile(ages_s, 0.5) / ideal_s,
        "later_p99_ratio": percentile(ages_s, 0.99) / ideal_s,
    }


def cases() -> dict[str, Callable[[int], Figures]]:
    """Returns what plays one start, by the name of the case."""
    found: dict[str, Callable[[int], Figures]] = {}
    for rate_bps, jitter_s in ((8e6, 0.001), (4e6, 0.001), (8e6, 0.005), (8e6, 0.010), (8e6, 0.020)):
        path = f"{rate_bps / 1e6:g} Mbit/s ±{1e3 * jitter_s:g} ms"
        found[f"steady {path}"] = partial(play, link(rate_bps, jitter_s), 5.0, 14.0)
        found[f"start {path}"] = partial(play, link(rate_bps, jitter_s), 0.5, 2.0)
    for jitter_s in (0.0, 0.005, 0.020):
        path = f"8 Mbit/s ±{1e3 * jitter_s:g} ms"
        found[f"gone {path}"] = partial(play, link(8e6, jitter_s, gone=True), BACK_S + 0.5, BACK_S + 2.0)
        found[f"thin {path}"] = partial(play, link(8e6, jitter_s, thin=True), BACK_S + 2.0, BACK_S + 4.0)
    for jitter_s in (0.001, 0.005):
        found[f"two 8 Mbit/s ±{1e3 * jitter_s:g} ms"] = partial(two, link(8e6, jitter_s))
    for lossless in (False, True):
        for robots, nbytes, rate_hz, delay_s, jitter_s in (
            (5, 200_000, 10.0, 0.00375, 0.00125), (2, 200_000, 10.0, 0.00375, 0.00125),
            (1, 10_000, 20.0, 0.00375, 0.00125), (3, 100_000, 10.0, 0.025, 0.010),
        ):  # fmt: skip
            case = Clouds(robots, nbytes, rate_hz, delay_s, jitter_s, lossless)
            over = "a stream" if lossless else "datagrams"
            name = f"clouds {robots} of {nbytes // 1000} kB ±{1e3 * jitter_s:g} ms over {over}"
            found[name] = partial(clouds, case)
    return found


WORST_IS_LEAST: Final = frozenset({"share_percent", "alike_ratio", "first_percent"})


def summary(starts: Sequence[Figures]) -> Figures:
    """Mean and worst of each figure."""
    row = {}
    for name in starts[0]:
        values = [start[name] for start in starts]
        figure, unit = name.rsplit("_", 1)
        row[name] = fmean(values)
        row[f"{figure}_worst_{unit}"] = (min if name in WORST_IS_LEAST else max)(values)
    return row


def bench(options: argparse.Namespace, report: Report) -> None:
    count = QUICK_STARTS if options.quick else STARTS
    chosen = {name: play for name, play in cases().items() if options.only is None or name.startswith(options.only)}
    with ProcessPoolExecutor() as pool:
        waiting = {name: [pool.submit(play, seed) for seed in range(1, count + 1)] for name, play in chosen.items()}
        for name, starts in waiting.items():
            report.row(name, "sern", **summary([start.result() for start in starts]))
    report.note(f"virtual time; {count} starts each: the mean of them, and the worst")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", help="cases whose names begin so")


if __name__ == "__main__":
    sys.exit(main("window", bench, description=__doc__, arguments=_arguments))
