"""One relay and 1 to 100 robots of 20 topics each, and one site that receives everything, over loopback with keys.

The robots are client cores with connections of their own, several in each process; relay and site are one process each.
They connect as daemons do: over TCP with CURVE, and then over the datagram lane. Measuring begins when everybody's data
takes that lane. `--tcp` leaves it off.
All clocks are one, so an age is the difference of two readings. Latency is from `send` at the robot to the site's
callback, through the relay; CPU is the relay process's, I/O threads included, for each message that reached the site.
Memory is the relay's (RSS) when a fleet has been measured.

A robot sends 56 messages a second: 2 topics of class control (100 B, 20 and 10 Hz), 8 of class state (300 B, 2 Hz) and
10 of class bulk (1 kB, 1 Hz).
"""

import argparse
import asyncio
import multiprocessing
import sys
import tempfile
from array import array
from collections.abc import Callable, Sequence
from ctypes import c_bool, c_uint64
from functools import partial
from multiprocessing.sharedctypes import RawArray, RawValue
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import uvloop
import zmq

from benchmarks import common
from benchmarks.child import Worker, await_workers
from benchmarks.fleet import STAMP, Kind, looked_after, offer, rate_hz_of, topics_of
from benchmarks.loopback import Member, running, serve, watch
from sern_core.path.lanes import LANE_NAMES, LANE_UDP, LANE_ZMQ
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import CLASS_LABELS, ClientName, PriorityClass
from sern_runtime import clock
from sern_tools.harness.files import relay_content, write
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

FLEETS: Final = (1, 5, 10, 20, 50, 100)
HOSTS: Final = 2
"""Processes that the robots are spread over."""
START_S: Final = 60.0
UDP, ZMQ = LANE_NAMES[LANE_UDP], LANE_NAMES[LANE_ZMQ]
PROMPT_ROBOTS: Final = 50
LATENCY_LIMIT_MS: Final = 10.0
"""The limit holds for so many robots; the cores of a small machine are full with more."""
CPU_RATIO_LIMIT: Final = 1.2


ROBOT: Final = (
    Kind(PriorityClass.CONTROL, 1, 100, 20.0),
    Kind(PriorityClass.CONTROL, 1, 100, 10.0),
    Kind(PriorityClass.STATE, 8, 300, 2.0),
    Kind(PriorityClass.BULK, 10, 1000, 1.0),
)
TOPICS: Final = topics_of(ROBOT)
RATE_HZ: Final = rate_hz_of(ROBOT)


class Shared:
    """What the processes share. `ready[i]`: how many clients of process i have their data on the `lane` to measure."""

    def __init__(self, lane: str) -> None:
        self.lane = lane
        self.ready = RawArray(c_uint64, HOSTS + 1)
        self.opened = RawValue(c_uint64, 0)
        self.received = RawValue(c_uint64, 0)
        self.measuring = RawValue(c_bool, False)
        self.stopped = RawValue(c_bool, False)


class Sample(NamedTuple):
    """One measured fleet: `ages_s` of what arrived while measuring, by class label."""

    robots: int
    messages_hz: float
    relay_cpu_us: float
    relay_rss_bytes: int
    ages_s: dict[str, Any]

    def percentile_ms(self, label: str, percent: float) -> float:
        if not len(self.ages_s[label]):
            raise SernError(f"no message of class {label} came in time: measure for longer (--seconds)")
        return float(np.percentile(self.ages_s[label], percent)) * 1e3


def robot_name(number: int) -> ClientName:
    return ClientName(f"robot{number}")


def _say(shared: Shared, process: int, members: Sequence[Member]) -> Callable[[], None]:
    """Says how many of these clients are as they are to be measured."""

    def say() -> None:
        shared.ready[process] = sum(member.lane == shared.lane for member in members)

    return say


class _Site(Member):
    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", folder: Path, address: str, shared: Shared) -> None:
        super().__init__(context, folder, address, ClientName("site"), udp=shared.lane == UDP)
        self.shared = shared
        self.ages_s = {label: array("d") for label in CLASS_LABELS}

    def stream_opened(self, stream: StreamInfo) -> None:
        self.shared.opened.value += 1

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self.shared.received.value += 1
        if self.shared.measuring.value:
            (sent_s,) = STAMP.unpack_from(message.body)
            self.ages_s[CLASS_LABELS[stream.spec.priority]].append(clock.now() - sent_s)


def _site(folder: Path, address: str, shared: Shared, result: Any) -> None:
    async def main() -> None:
        with zmq.Context() as context:
            site = _Site(context, folder, address, shared)
            site.core.subscribe((".*",), now=clock.now())
            async with looked_after([site], _say(shared, HOSTS, [site])):
                while not shared.stopped.value:  # noqa: ASYNC110  (a flag in shared memory has no event)
                    await asyncio.sleep(0.02)
        result.send({label: np.array(ages_s) for label, ages_s in site.ages_s.items()})

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main())


def _robots(folder: Path, address: str, numbers: range, process: int, shared: Shared) -> None:
    async def main() -> None:
        with zmq.Context() as context:
            members = [
                Member(context, folder, address, robot_name(number), udp=shared.lane == UDP) for number in numbers
            ]
            async with looked_after(members, _say(shared, process, members)):
                await offer(members, ROBOT, numbers.start, lambda: bool(shared.stopped.value))

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main())


def _prepare(folder: Path, robots: int, address: str, *, udp: bool) -> Path:
    """The relay's file."""
    make_keys(folder, "relay", "site", *map(robot_name, range(robots)))
    content = relay_content(address, relay={"udp": udp}, http={"listen": None}, log={"level": "error"})
    return write(folder, "relay", content)


def _relay(config: Path, ready: Any) -> None:
    serve(config, ready.set)


def measure(robots: int, duration_s: float, *, udp: bool) -> Sample:
    """Start a fleet, wait until the site has every stream and all data its lane, and measure for `duration_s`."""
    processes = multiprocessing.get_context("spawn")
    shared, ready, address = Shared(UDP if udp else ZMQ), processes.Event(), f"tcp://127.0.0.1:{free_ports(1)[0]}"
    ours, theirs = processes.Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        relay = Worker("the relay", _relay, _prepare(folder, robots, address, udp=udp), ready)
        ends = [
            Worker("site", _site, folder, address, shared, theirs),
            *(
                Worker(f"robots {numbers.start} to {numbers.stop - 1}", _robots, folder, address, numbers, host, shared)
                for host in range(HOSTS)
                if len(numbers := range(host * robots // HOSTS, (host + 1) * robots // HOSTS))
            ),
        ]
        with running(relay, ends, ready, shared.stopped, START_S) as workers:
            everybody = robots * TOPICS
            await_workers(
                lambda: shared.opened.value == everybody, workers, f"{robots} robots were not all there", START_S
            )
            await_workers(
                lambda: sum(shared.ready) == robots + 1, workers, f"not all data took the lane {shared.lane}", START_S
            )
            settled = shared.received.value + int(robots * RATE_HZ)
            await_workers(lambda: shared.received.value > settled, workers, "messages did not flow", START_S)
            carried = watch(workers, shared.received, duration_s, shared.measuring)
            shared.stopped.value = True
            if not ours.poll(START_S):
                raise SernError("the site does not answer")
            ages_s = ours.recv()
    return Sample(robots, carried.messages_hz, carried.cpu_us, carried.rss_bytes, ages_s)


def bench(options: argparse.Namespace, report: common.Report) -> None:
    rounds, duration_s = common.repetitions(options, (3, 10.0), quick=(1, 3.0))
    measured = {str(n): partial(measure, n, duration_s, udp=not options.tcp) for n in options.robots}
    samples = common.interleaved(measured, rounds)
    median: dict[int, dict[str, float]] = {}
    for found in samples.values():
        figures = {
            "messages_hz": [sample.messages_hz for sample in found],
            "control_p50_ms": [sample.percentile_ms("control", 50) for sample in found],
            "control_p99_ms": [sample.percentile_ms("control", 99) for sample in found],
            "state_p99_ms": [sample.percentile_ms("state", 99) for sample in found],
            "relay_cpu_us": [sample.relay_cpu_us for sample in found],
            "relay_rss_MB": [sample.relay_rss_bytes / 1e6 for sample in found],
        }
        robots = found[0].robots
        median[robots] = {name: float(np.median(values)) for name, values in figures.items()}
        report.row(f"{robots} robots", "sern", **median[robots])
    most = max(median)
    prompt = min(PROMPT_ROBOTS, most)
    if prompt in median:
        report.reach(f"p99 of class control at {prompt} robots, ms", median[prompt]["control_p99_ms"], LATENCY_LIMIT_MS)
    if 5 in median and most > 5:
        ratio = median[most]["relay_cpu_us"] / median[5]["relay_cpu_us"]
        report.reach(f"relay CPU a message at {most} robots, times that at 5", ratio, CPU_RATIO_LIMIT)
    report.note(f"{TOPICS} topics and {RATE_HZ:g} messages/s a robot; medians of {rounds} rounds of {duration_s:g} s")
    report.note("data over TCP" if options.tcp else "data over the datagram lane")
    if options.figure is not None:
        _draw(options.figure, median)
        report.detail(f"figure: {options.figure}")


def _draw(path: Path, median: dict[int, dict[str, float]]) -> None:
    figure, (left, right) = common.pyplot("--figure").subplots(1, 2, figsize=(9.0, 3.4))
    robots = sorted(median)
    for name, label in (
        ("control_p50_ms", "control, median"),
        ("control_p99_ms", "control, p99"),
        ("state_p99_ms", "state, p99"),
    ):
        left.plot(robots, [median[n][name] for n in robots], "o-", label=label)
    left.axhline(LATENCY_LIMIT_MS, color="grey", linewidth=0.8, linestyle="--")
    left.set_ylabel("robot to site [ms]")
    left.legend(fontsize=8)
    right.plot(robots, [median[n]["relay_cpu_us"] for n in robots], "o-")
    right.set_ylabel("relay CPU a message [µs]")
    for axes in (left, right):
        axes.set_xlabel(f"robots of {TOPICS} topics, {RATE_HZ:g} messages/s")
        axes.set_ylim(bottom=0)
    figure.tight_layout()
    common.save(figure, path, dpi=150)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--robots", nargs="+", type=common.positive, default=list(FLEETS), metavar="N", help="measure these fleets"
    )
    parser.add_argument("--tcp", action="store_true", help="leave the datagram lane off")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw the figures (PNG)")
    common.repetition_arguments(parser)


def main() -> int:
    return common.main("robots", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    # Spawned processes import this file by its name, not as __main__.
    from benchmarks.robots import main as imported_main

    sys.exit(imported_main())
