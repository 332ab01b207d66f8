"""The adaptation on the real core: the paper's two policy tables, and streams that come and go while it runs.

A recording of a real robot (pose, IMU and GNSS of a Husky) with LiDAR scans beside it crosses link profiles in virtual
time, once for each policy and mission profile: the paper's tables (mmcf_eval) and (mmcf_breakdown), on our links. What
is counted is what the adaptation of a client measures: arrivals by acknowledgement, encoding by the clock, bytes on the
wire. Then the paper's section "Runtime Reconfiguration Evaluation": two robots' streams, a third that appears after
20 s and leaves at 40 s. Without the recordings beside the checkout the same topics are made up
(`benchmarks.recordings`), and a note says so.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from math import isfinite
from pathlib import Path
from random import Random
from statistics import fmean
from time import perf_counter

from benchmarks import recordings
from benchmarks.common import Report, half_width_95, main, positive, pyplot, save
from sern_client.endpoints.clouds import CLOUD_TYPE, cloud_body
from sern_core.adaptation.adapter import SAMPLES, HopAdapter, Step
from sern_core.adaptation.cost import cost
from sern_core.adaptation.model import Terms
from sern_core.bodies.codecs import Coder
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, PriorityClass, TopicName
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.profiles import load_profile
from sern_sim.models import LinkModel
from sern_sim.profiles import LinkProfile
from sern_sim.replay import Arrival, ReplayWorld

SETTLE_S = 1.0
CLOUD_HZ = 5.0
EVERY_NTH_POINT = 8
"""8,700 points a scan, about what a 16-beam LiDAR gives in a tenth of a second."""
POLICIES = ("fixed_throughput", "fixed_reliability", "mmcf")
PROFILES = ("teleoperation", "mapping")
LINKS = ("step", "field-wifi", "mesh-radio")
APPEARS_S, LEAVES_S, END_S = 20.0, 40.0, 60.0


@dataclass
class Load:
    """Topics with their classes, and messages: (time, topic, body)."""

    specs: dict[str, tuple[TopicInfo, TopicSpec]] = field(default_factory=dict)
    messages: list[tuple[float, str, bytes]] = field(default_factory=list)
    note: str = ""


def _spec(priority: PriorityClass) -> TopicSpec:
    return TopicSpec(priority=priority, weight=(10.0, 3.0, 1.0)[priority], lifespan_s=1.0)


def recorded(duration_s: float, data: Path = recordings.DATA) -> Load:
    """The Husky's recording with scans beside it, or something like it where `data` has none."""
    load = Load(note=recordings.note(data))
    infos, load.messages = recordings.drive(duration_s, data)
    for name, info in infos.items():
        control = "odom" in name or "imu" in name
        load.specs[name] = (info, _spec(PriorityClass.CONTROL if control else PriorityClass.STATE))
    scans = [cloud_body(points[::EVERY_NTH_POINT], 0, "velodyne", Encoding.ROS1) for points in recordings.scans(data)]
    load.specs["/points"] = (TopicInfo(TopicName("/points"), CLOUD_TYPE, Encoding.ROS1), _spec(PriorityClass.BULK))
    count = int(CLOUD_HZ * duration_s)
    load.messages += [(0.05 + i / CLOUD_HZ, "/points", scans[i % len(scans)]) for i in range(count)]
    load.messages.sort(key=lambda message: message[0])
    return load


def run(load: Load, link: LinkProfile, section: AdaptationSection, duration_s: float, *, seed: int) -> list[Terms]:
    """All intervals that were measured. Whatever a policy believed, bandwidth is a share of what the link carried."""
    coder = Coder(max_bytes=2**24, clock=perf_counter)
    world = ReplayWorld(link, seed=seed, coder=coder)
    channels = {name: world.publish(info, spec) for name, (info, spec) in load.specs.items()}
    params = section.params(encodes=True)
    policy = section.make_policy(encodes=True)()
    adapter = HopAdapter(world.robot.link, policy, params, coder=coder, now=world.network.now)
    steps: list[Step] = []
    world.every(params.interval_s / SAMPLES, lambda now: adapter.sample(now=now))
    world.every(params.interval_s, lambda now: steps.append(adapter.step(now=now)))
    world.feed((SETTLE_S + at_s, channels[topic], body) for at_s, topic, body in load.messages)
    world.run(SETTLE_S + duration_s)
    found = []
    for step in steps:
        end_s, measurement = step.now - world.network.start_s, step.measurement
        if measurement is not None:
            capacity_bps = link.up.capacity_bits(end_s - params.interval_s, end_s) / params.interval_s
            found.append(
                params.ranges.terms(
                    latency_s=measurement.latency_s,
                    unreliability=measurement.unreliability,
                    compute=measurement.compute,
                    bandwidth_bps=measurement.bandwidth_bps,
                    capacity_bps=capacity_bps if isfinite(capacity_bps) else None,
                )
            )
    return found


def tables(report: Report, duration_s: float, links: tuple[str, ...], seeds: int) -> None:
    """Policy by profile, with the four terms, over the links; `seeds` draws of losses and jitter."""
    load = recorded(duration_s)
    report.note(f"{load.note}, {duration_s:g} s on each of {', '.join(links)}; means over intervals of 1 s")

    def intervals(section: AdaptationSection, number: int) -> list[Terms]:
        parts = [run(load, load_profile(name), section, duration_s, seed=number + 1) for name in links]
        return [terms for part in parts for terms in part]

    tabulate(report, intervals, seeds)


def tabulate(
    report: Report,
    intervals: Callable[[AdaptationSection, int], list[Terms]],
    runs: int,
    profiles: Sequence[str] = PROFILES,
) -> None:
    """Policy by profile: the means of the terms over the intervals of all runs, and what they cost, with half the width
    of the 95 % confidence interval over the runs.

    The runs are in mixed order, first to last and last to first in turn, so that what drifts falls on all alike. What
    came of each order is reported as it is. The cost is linear in the terms, so that of their means is the mean of the
    intervals'.
    """
    report.note("terms: 1 is 0.5 s of latency, no reliability, a quarter of a core, all that the link carries")
    cases = [(profile, policy) for profile in profiles for policy in POLICIES]
    sections = {
        (profile, policy): AdaptationSection.model_validate({"policy": policy, "profile": profile})
        for profile, policy in cases
    }
    found: dict[tuple[str, str], list[Terms]] = {case: [] for case in cases}
    for number in range(runs):
        for case in cases if number % 2 == 0 else reversed(cases):
            found[case].append(mean_terms(intervals(sections[case], number)))
    for profile in profiles:
        means: dict[str, float] = {}
        for policy in POLICIES:
            mine, weights = found[profile, policy], sections[profile, policy].cost_weights()
            terms = mean_terms(mine)
            costs = [cost(weights, one) for one in mine]
            means[policy] = cost(weights, terms)
            spread = {} if runs < 2 else {"plusminus_1": half_width_95(costs)}
            orders = {} if runs < 2 else {"forward_1": fmean(costs[::2]), "backward_1": fmean(costs[1::2])}
            report.row(
                profile,
                policy,
                cost_1=means[policy],
                **spread,
                **orders,
                latency_1=terms.latency,
                reliability_1=1.0 - terms.unreliability,
                compute_1=terms.compute,
                bandwidth_1=terms.bandwidth,
            )
        others = min(value for policy, value in means.items() if policy != "mmcf")
        report.reach(f"{profile}: cost of mmcf over the best fixed policy's", means["mmcf"] / others, 1.0)


def mean_terms(terms: Iterable[Terms]) -> Terms:
    return Terms(*(fmean(values) for values in zip(*terms, strict=True)))


# --- streams that come and go -----------------------------------------------------------------------------------------


@dataclass
class Reconfiguration:
    """What a third robot's coming and going did."""

    steps: list[Step]
    start_s: float
    arrivals: dict[TopicName, list[Arrival]]
    first_s: float  # from its coming until the site has its first message
    known_s: float  # from its first message until a decision knew of it
    gone_s: float  # from its end until a decision knew
    gap_s: float  # the longest time between two poses of the others, from a second before to the end


def _robot(prefix: str) -> dict[str, tuple[float, int, PriorityClass]]:
    return {
        f"{prefix}/odom": (20.0, 700, PriorityClass.CONTROL),
        f"{prefix}/scan": (10.0, 2200, PriorityClass.STATE),
        f"{prefix}/points": (2.0, 80_000, PriorityClass.BULK),
    }


def _ticks(topics: dict[str, tuple[float, int, PriorityClass]], a: float, b: float) -> Iterator[tuple[float, str, int]]:
    for number, (name, (rate_hz, size, _)) in enumerate(topics.items()):
        count = int((b - a) * rate_hz)
        yield from ((a + (i + 0.1 * number) / rate_hz, name, size) for i in range(count))


def _leave(world: ReplayWorld, channel: OutChannel, _now: float) -> None:
    world.unpublish(channel)


def reconfigure() -> Reconfiguration:
    """Two robots, a third from APPEARS_S to LEAVES_S, on 3 Mbit/s."""
    model = LinkModel(rate_bps=3e6, delay_s=0.025, overhead_bytes=28)
    coder = Coder(max_bytes=2**24, clock=perf_counter)
    world = ReplayWorld(LinkProfile("reconfigure", "3 Mbit/s", model, model), coder=coder)
    section = AdaptationSection()
    params = section.params(encodes=True)
    adapter = HopAdapter(
        world.robot.link, section.make_policy(encodes=True)(), params, coder=coder, now=world.network.now
    )
    steps: list[Step] = []
    random = Random(1)
    body = bytes(random.randrange(40) for _ in range(80_000))

    def appear(prefix: str, a: float, b: float) -> None:
        topics = _robot(prefix)
        info = {name: TopicInfo(TopicName(name), "std_msgs/msg/String", Encoding.ROS1) for name in topics}
        channels = {name: world.publish(info[name], _spec(topics[name][2])) for name in topics}
        world.feed((at_s, channels[name], body[:size]) for at_s, name, size in sorted(_ticks(topics, a, b)))
        if b < END_S:
            for channel in channels.values():
                world.network.at(b, partial(_leave, world, channel), node=world.robot_node)

    appear("/robot1", SETTLE_S, END_S)
    appear("/robot2", SETTLE_S, END_S)
    # Off the beat of the intervals, as robots are.
    came_s, went_s = APPEARS_S + 0.31, LEAVES_S + 0.31
    world.network.at(came_s, lambda _now: appear("/robot3", came_s + 0.01, went_s), node=world.robot_node)
    world.every(params.interval_s / SAMPLES, lambda now: adapter.sample(now=now))
    world.every(params.interval_s, lambda now: steps.append(adapter.step(now=now)))
    world.run(END_S)
    start_s = world.network.start_s

    def streams(step: Step) -> int:
        return sum(demand.topics for demand in step.situation.classes)

    known = next(s for s in steps if s.now - start_s > came_s and streams(s) == 9)
    gone = next(s for s in steps if s.now - start_s > went_s and streams(s) == 6)
    gaps = [
        b.at_s - a.at_s
        for name in ("/robot1/odom", "/robot2/odom")
        for a, b in pairwise(world.arrivals[TopicName(name)])
        if b.at_s > APPEARS_S - 1.0
    ]
    return Reconfiguration(
        steps,
        start_s,
        dict(world.arrivals),
        min(world.arrivals[TopicName(f"/robot3/{part}")][0].at_s for part in ("odom", "scan", "points")) - came_s,
        known.now - start_s - came_s,
        gone.now - start_s - went_s,
        max(gaps),
    )


def draw(path: Path, found: Reconfiguration) -> None:
    """The paper's figure (runtime_reconfig_demo) from this run."""
    times = [step.now - found.start_s for step in found.steps]
    figure, (streams, load, ages) = pyplot("--plots").subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    counts = [sum(demand.topics for demand in step.situation.classes) for step in found.steps]
    streams.step(times, counts, where="post", ls=":", color="tab:purple", label="topics known to the adaptation")
    streams.set_ylabel("topics")
    used = [0.0 if s.measurement is None else s.measurement.bandwidth_bps * 1e-6 for s in found.steps]
    load.plot(times, used, color="tab:blue", label="Mbit/s on the wire")
    shares = [step.decision.chosen.rates[2] for step in found.steps]
    load.step(times, shares, where="post", color="tab:orange", label="share of class bulk that is let in")
    load.set_ylabel("Mbit/s, share")
    for name, colour in (("/robot1/odom", "tab:blue"), ("/robot2/odom", "tab:green"), ("/robot3/odom", "tab:red")):
        points = found.arrivals[TopicName(name)]
        ages.plot([p.at_s for p in points], [1e3 * p.age_s for p in points], ".", ms=2, color=colour, label=name)
    ages.set_ylabel("age on arrival [ms]")
    ages.set_yscale("log")
    ages.set_xlabel("s")
    for axes in (streams, load, ages):
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize=8)
        for at_s in (APPEARS_S + 0.31, LEAVES_S + 0.31):
            axes.axvline(at_s, color="0.5", lw=0.8)
    streams.set_title("A third robot appears and leaves, 3 Mbit/s, 50 ms")
    save(figure, path, dpi=110)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=positive, metavar="N", help="draws of losses and jitter (default 5, quick 1)")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw the reconfiguration into DIR")


def measure(options: argparse.Namespace, report: Report) -> None:
    duration_s, links = (15.0, LINKS[:1]) if options.quick else (60.0, LINKS)
    tables(report, duration_s, links, options.seeds or (1 if options.quick else 5))
    found = reconfigure()
    report.row(
        "a third robot",
        "mmcf",
        first_s=found.first_s,
        known_s=found.known_s,
        gone_s=found.gone_s,
        gap_s=found.gap_s,
    )
    report.reach("a new robot is forwarded after, s", found.first_s, 1.0)
    report.reach("a new robot is taken in after, s", found.known_s, 1.0)
    report.reach("a robot that left is forgotten after, s", found.gone_s, 1.0)
    report.reach("longest gap between poses (50 ms apart) of the others, s", found.gap_s, 0.15)
    if options.plots is not None:
        draw(options.plots / "mmcf-reconfigure.png", found)
        report.detail(f"wrote {options.plots / 'mmcf-reconfigure.png'}")


if __name__ == "__main__":
    sys.exit(
        main("mmcf_replay", measure, description=__doc__.splitlines()[0] if __doc__ else None, arguments=add_arguments)
    )
