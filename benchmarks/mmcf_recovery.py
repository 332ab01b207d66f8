"""How soon all clouds flow again after a link has come back, with the adaptation as its user has it, in virtual time.

The real core over links of several round trips (`sern_sim.replay`), profile `teleoperation`: poses at 50 Hz, and clouds
that take half of the link as they are and count however old they are. For 15 s the link is thin or gone. Told is the
time from its return until five seconds begin in which four fifths of the clouds that are offered arrive: the mean and
the most of the seeds, and in how many runs that came within 50 s. No time of this machine is in it, so a commit has one
result.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from random import Random
from statistics import fmean
from typing import Final

from benchmarks.common import Report, main, positive
from benchmarks.link.figures import NEVER_S
from sern_core.adaptation.adapter import SAMPLES, HopAdapter
from sern_core.bodies.codecs import Coder
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, PriorityClass, TopicName
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.profiles import load_profile
from sern_sim.models import LinkModel, RateStep, Window
from sern_sim.profiles import LinkProfile
from sern_sim.replay import Arrival, ReplayWorld

BEGINS_S, FALLS_S, RETURNS_S, END_S = 10.0, 20.0, 35.0, 85.0
POSE, CLOUD = TopicName("/robot/odom"), TopicName("/robot/points")
POSE_HZ: Final = 50.0
POSE_BYTES: Final = 120
CLOUD_BYTES: Final = 100_000
PART: Final = 0.5
"""Share of the link's rate that the clouds take as they are. It decides how many are sent a second."""
WINDOW_S: Final = 5.0
ENOUGH: Final = 0.8
MAX_BYTES: Final = 2**24
LIMITS_S: Final = ((0.1, 5.0), (0.2, 10.0))
"""(round trip up to, seconds): what docs/adaptation.md says. Beyond, nothing is promised."""


@dataclass(frozen=True)
class Case:
    """A link, and what it is for a while: so many bits a second, or nothing."""

    name: str
    link: LinkModel
    thin_bps: float | None
    stream: bool = False
    cloud_bytes: int = CLOUD_BYTES

    @property
    def cloud_hz(self) -> float:
        assert self.link.rate_bps is not None
        return PART * self.link.rate_bps / 8 / self.cloud_bytes

    @property
    def rtt_s(self) -> float:
        return 2 * self.link.delay_s

    @property
    def limit_s(self) -> float | None:
        return next((limit_s for rtt_s, limit_s in LIMITS_S if self.rtt_s <= rtt_s + 1e-9), None)

    def profile(self) -> LinkProfile:
        """The link both ways, with its bad time in it."""
        gone = self.thin_bps is None
        assert self.link.rate_bps is not None
        steps = () if gone else (RateStep(FALLS_S, self.thin_bps or 0.0), RateStep(RETURNS_S, self.link.rate_bps))
        model = replace(self.link, rate_steps=steps, blackouts=(Window(FALLS_S, RETURNS_S),) if gone else ())
        model = model.as_stream() if self.stream else model
        return LinkProfile("recovery", self.name, model, model)


def _link(rate_bps: float, rtt_s: float, loss: float = 0.0) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=rtt_s / 2, loss=loss, overhead_bytes=28)


def cases() -> list[Case]:
    found = [
        Case("4 Mbit/s 10 ms, 0.3 Mbit/s", _link(4e6, 0.01), 0.3e6),
        Case("4 Mbit/s 10 ms, 0.3 Mbit/s, stream", _link(4e6, 0.01), 0.3e6, stream=True),
        Case("4 Mbit/s 10 ms, gone", _link(4e6, 0.01), None),
        Case("4 Mbit/s 100 ms 2 % loss, 0.3 Mbit/s", _link(4e6, 0.1, 0.02), 0.3e6),
        Case("4 Mbit/s 200 ms 2 % loss, 0.3 Mbit/s", _link(4e6, 0.2, 0.02), 0.3e6),
        Case("4 Mbit/s 200 ms, 0.3 Mbit/s, stream", _link(4e6, 0.2), 0.3e6, stream=True),
        Case("4 Mbit/s 500 ms, 0.3 Mbit/s", _link(4e6, 0.5), 0.3e6),
        Case("4 Mbit/s 500 ms 1 % loss, 0.3 Mbit/s", _link(4e6, 0.5, 0.01), 0.3e6),
        Case("4 Mbit/s 500 ms 1 % loss, gone", _link(4e6, 0.5, 0.01), None),
        Case("4 Mbit/s 500 ms, 0.3 Mbit/s, stream", _link(4e6, 0.5), 0.3e6, stream=True),
        Case("8 Mbit/s 60 ms 0.5 % loss, 0.3 Mbit/s", _link(8e6, 0.06, 0.005), 0.3e6),
        Case("10 Mbit/s 600 ms 1 % loss, 0.5 Mbit/s", _link(10e6, 0.6, 0.01), 0.5e6),
    ]
    for name, thin_bps, cloud_bytes in (
        ("lte", 0.3e6, CLOUD_BYTES),
        ("mesh-radio", 0.1e6, CLOUD_BYTES // 4),
        ("satcom", 0.1e6, CLOUD_BYTES),
        ("satcom", None, CLOUD_BYTES),
    ):
        what = "gone" if thin_bps is None else f"{thin_bps / 1e6:g} Mbit/s"
        found.append(Case(f"{name}, {what}", load_profile(name).up, thin_bps, cloud_bytes=cloud_bytes))
    return found


def recovered_s(times_s: Sequence[float], wanted_hz: float, from_s: float, to_s: float) -> float:
    """Whole seconds from `from_s` until WINDOW_S begin in which ENOUGH of `wanted_hz` arrive. NEVER_S where that is not
    before `to_s`."""
    for start in range(int(to_s - from_s - WINDOW_S) + 1):
        begin_s = from_s + start
        if sum(begin_s <= at_s < begin_s + WINDOW_S for at_s in times_s) >= ENOUGH * wanted_hz * WINDOW_S:
            return float(start)
    return NEVER_S


def run(case: Case, seed: int) -> list[Arrival]:
    """The clouds of one run."""
    coder = Coder(max_bytes=MAX_BYTES)
    world = ReplayWorld(case.profile(), seed=seed, coder=coder)
    section = AdaptationSection.model_validate({"profile": "teleoperation"})
    params = section.params(encodes=True)
    adapter = HopAdapter(
        world.robot.link, section.make_policy(encodes=True)(), params, coder=coder, now=world.network.now
    )
    specs = {
        POSE: TopicSpec(priority=PriorityClass.CONTROL, weight=10.0, lifespan_s=1.0),
        CLOUD: TopicSpec(priority=PriorityClass.BULK, depth=4, lifespan_s=None),
    }
    channels = {
        name: world.publish(TopicInfo(name, "std_msgs/msg/String", Encoding.ROS1), spec) for name, spec in specs.items()
    }
    random = Random(seed)
    cloud = bytes(random.randrange(40) for _ in range(case.cloud_bytes))
    messages = [(1.0 + i / POSE_HZ, channels[POSE], bytes(POSE_BYTES)) for i in range(int((END_S - 1.0) * POSE_HZ))]
    # Off the beat of the intervals, as sources are.
    count = int((END_S - 1.1) * case.cloud_hz)
    messages += [(1.053 + i / case.cloud_hz, channels[CLOUD], cloud) for i in range(count)]
    world.every(params.interval_s / SAMPLES, lambda now: adapter.sample(now=now))
    world.every(params.interval_s, lambda now: adapter.step(now=now))
    world.feed(sorted(messages, key=lambda message: message[0]))
    world.run(END_S)
    return world.arrivals[CLOUD]


def job(arguments: tuple[int, int]) -> tuple[float, float, float]:
    """(share of the clouds that came before the bad time, seconds until they flow again, share that came since)."""
    number, seed = arguments
    case = cases()[number]
    times_s = [arrival.at_s for arrival in run(case, seed)]

    def share(begin_s: float, end_s: float) -> float:
        return sum(begin_s <= at_s < end_s for at_s in times_s) / ((end_s - begin_s) * case.cloud_hz)

    took_s = recovered_s(times_s, case.cloud_hz, RETURNS_S, END_S)
    return share(BEGINS_S, FALLS_S), took_s, share(RETURNS_S, END_S)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=positive, metavar="N", help="draws of losses (default 3, quick 1)")


def measure(options: argparse.Namespace, report: Report) -> None:
    seeds = range(1, 1 + (options.seeds or (1 if options.quick else 3)))
    every = [case for case in cases() if not options.quick or case.limit_s is not None]
    numbers = [cases().index(case) for case in every]
    with ProcessPoolExecutor() as pool:
        found = list(pool.map(job, [(number, seed) for number in numbers for seed in seeds]))
    for index, case in enumerate(every):
        mine = found[index * len(seeds) : (index + 1) * len(seeds)]
        in_time = [took_s for _, took_s, _ in mine if took_s < NEVER_S]
        report.row(
            case.name,
            "mmcf",
            rtt_s=case.rtt_s,
            mean_s=fmean(in_time) if in_time else NEVER_S,
            most_s=max(took_s for _, took_s, _ in mine),
            recovered_count=len(in_time),
            clouds_percent=100 * fmean(after for *_, after in mine),
        )
        if case.limit_s is not None:
            worst_s = max(took_s for _, took_s, _ in mine)
            report.reach(f"{case.name}: seconds until the clouds flow, the most", worst_s, case.limit_s)
            least = min(before for before, *_ in mine)
            report.reach(f"{case.name}: share of the clouds before, the least", least, 0.9, at_least=True)
    report.note(
        f"virtual time, seeds: {len(seeds)}; the link is bad for {RETURNS_S - FALLS_S:g} s; clouds: what came "
        f"of those offered in the {END_S - RETURNS_S:g} s since"
    )


if __name__ == "__main__":
    sys.exit(main("mmcf_recovery", measure, description=__doc__, arguments=add_arguments))
