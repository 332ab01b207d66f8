"""The cases, what is measured in each, and which figure is held against which limit."""

import argparse
import importlib.util
import random
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import psutil

from benchmarks.common import Report
from benchmarks.link import figures, plots
from benchmarks.link.junk import JUNK_HZ, flood
from benchmarks.link.load import Load
from benchmarks.link.runs import Outcome, Step, make_keys, run, start_relay
from sern_core.errors import SernError
from sern_sim.models import LinkModel
from sern_tools.lab.lab import Lab

SERN: Final = ("sern-udp", "sern-zmq")
ALL: Final = (*SERN, "zmq", "zenoh", "zenoh-multilink", "zenoh-multilink-bbr")
QUICK: Final = (*SERN, "zmq", "zenoh-multilink")
MULTILINK: Final = ("zenoh-multilink", "zenoh-multilink-bbr")
MEGABIT: Final = 1e6
FIELD: Final = LinkModel(rate_bps=4 * MEGABIT, delay_s=0.025, queue_packets=100)
LOSSY: Final = LinkModel(rate_bps=4 * MEGABIT, delay_s=0.025, loss=0.02, queue_packets=100)
STEP: Final = LinkModel(rate_bps=8 * MEGABIT, delay_s=0.025, queue_packets=100)
LONG: Final = LinkModel(rate_bps=20 * MEGABIT, delay_s=0.100, queue_packets=500)
"""A queue of its product of rate and round trip, 500 kB, roughly."""
OVERLOAD: Final = Load(cloud_bytes=100_000)
"""8 Mbit/s of clouds."""
HEAVY: Final = Load(cloud_bytes=150_000)
FAST: Final = Load(cloud_bytes=500_000)


@dataclass
class Bench:
    """What the cases share."""

    lab: Lab
    report: Report
    systems: tuple[str, ...]
    quick: bool
    directory: Path
    plots: Path | None
    floors_s: dict[str, float] = field(default_factory=dict)
    busiest: float = 0.0
    _runs: int = 0

    def run(
        self,
        case: str,
        system: str,
        model: LinkModel,
        load: Load,
        duration_s: float,
        *,
        script: Sequence[Step] = (),
        warm_s: float = 2.0,
    ) -> Outcome:
        self._runs += 1
        directory = self.directory / f"{self._runs:02d}-{system}"
        directory.mkdir()
        outcome = run(self.lab, system, model, load, duration_s, directory, script=script, warm_s=warm_s)
        self.busiest = max(self.busiest, outcome.busy)
        self.report.row(case, system, **figures.metrics(outcome))
        return outcome

    def floor_s(self, name: str, model: LinkModel) -> float:
        """The median of a pose in a single datagram on the idle link, measured once a link."""
        if name not in self.floors_s:
            case = f"{name}, idle"
            outcome = self.run(case, "floor", model, Load(), 2.0 if self.quick else 5.0, warm_s=0.0)
            self.floors_s[name] = figures.quantile(figures.latencies_ms(outcome), 0.5) / 1000
        return self.floors_s[name]

    def wanted(self, systems: Sequence[str]) -> list[str]:
        return [system for system in systems if system in self.systems]

    def attempt(self, case: str, system: str, work: Callable[[], Outcome]) -> Outcome | None:
        """A peer that does not work here is noted; SERN must work."""
        try:
            return work()
        except SernError as error:
            if system in SERN:
                raise
            self.report.note(f"{case}: {error}")
            return None

    def plot(self, name: str, title: str, outcomes: Sequence[Outcome]) -> None:
        if self.plots is not None and outcomes:
            plots.latency(self.plots / f"perf-{name}.png", title, outcomes)

    def poses(self, case: str, system: str, p50: float, p99: float, floor_s: float) -> None:
        """Reaches of a pose's latency, as multiples of the floor."""
        for name, limit in (("p50", p50), ("p99", p99)):
            if limit:
                value = self.report.value(case, system, f"pose_{name}_ms") / (1000 * floor_s)
                self.report.reach(f"{case}, {system}: pose {name}, times the floor", value, limit)


def overload(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, twice what it carries."""
    _field(bench, "4 Mbit/s 50 ms, 2x", "overload", FIELD)


def loss(bench: Bench) -> None:
    """The same with 2 % loss both ways."""
    _field(bench, "4 Mbit/s 50 ms 2 % loss, 2x", "loss", LOSSY)


def _field(bench: Bench, case: str, name: str, model: LinkModel) -> None:
    floor_s = bench.floor_s("4 Mbit/s 50 ms", FIELD)
    duration_s = 8.0 if bench.quick else 22.0
    report = bench.report
    found: dict[str, Outcome] = {}
    for system in bench.wanted(ALL):

        def work(system: str = system) -> Outcome:
            return bench.run(case, system, model, OVERLOAD, duration_s)

        outcome = bench.attempt(case, system, work)
        if outcome is not None:
            found[system] = outcome
    if "sern-udp" in found:
        ours = found["sern-udp"]
        share = figures.goodput_bps(ours) / figures.ceiling_bps(ours)
        if model.loss:
            bench.poses(case, "sern-udp", 0.0, 1.35, floor_s)
            report.reach(f"{case}, sern-udp: goodput, share of what the link can carry", share, 0.90, at_least=True)
            arrived = figures.delivered_share(ours)
            report.reach(f"{case}, sern-udp: poses that arrive", arrived, 0.999, at_least=True)
        else:
            bench.poses(case, "sern-udp", 1.10, 1.25, floor_s)
            report.reach(f"{case}, sern-udp: goodput, share of what the link can carry", share, 0.97, at_least=True)
            arrived = figures.delivered_share(ours, forgive_superseded=True)
            report.reach(f"{case}, sern-udp: poses that arrive, unless superseded", arrived, 1.0, at_least=True)
        _against_zenoh(bench, case, found)
        report.reach(
            f"{case}: CPU of the busier side [% of a core]",
            max(ours.cpu_percent["robot"], ours.cpu_percent["relay"]),
            5.0,
        )
    if "sern-zmq" in found and not model.loss:
        bench.poses(case, "sern-zmq", 1.15, 1.4, floor_s)
    bench.plot(name, case, list(found.values()))
    if "sern-udp" in found and bench.plots is not None:
        plots.window(bench.plots / f"perf-{name}-window.png", case, found["sern-udp"])


def _against_zenoh(bench: Bench, case: str, found: dict[str, Outcome]) -> None:
    """Against the better of the multilinks by either figure."""
    rivals = [found[system] for system in MULTILINK if system in found]
    if not rivals:
        return
    ours = found["sern-udp"]
    p99s = [figures.quantile(figures.latencies_ms(outcome), 0.99) for outcome in (ours, *rivals)]
    goodputs = [figures.goodput_bps(outcome) for outcome in (ours, *rivals)]
    bench.report.reach(f"{case}: p99, times lower than zenoh multilink's", min(p99s[1:]) / p99s[0], 3.0, at_least=True)
    share = goodputs[0] / max(goodputs[1:])
    bench.report.reach(f"{case}: goodput, times zenoh multilink's", share, 1.15, at_least=True)


def steps(bench: Bench) -> None:
    """8, then 1, then 4 Mbit/s, 50 ms, 12 Mbit/s of clouds."""
    case = "8, 1, 4 Mbit/s 50 ms"
    each_s = 4.0 if bench.quick else 8.0
    script = (
        Step(each_s, "down", lambda lab: lab.change(rate_bps=1 * MEGABIT)),
        Step(2 * each_s, "up", lambda lab: lab.change(rate_bps=4 * MEGABIT)),
    )
    found = []
    for system in bench.wanted(SERN):
        outcome = bench.run(case, system, STEP, HEAVY, 3 * each_s, script=script)
        down_s = figures.settled_s(outcome, "down", 1 * MEGABIT, "up")
        up_s = figures.settled_s(outcome, "up", 4 * MEGABIT, None)
        bench.report.row(f"{case}, settled", system, down_s=down_s, up_s=up_s)
        if system == "sern-udp":
            bench.report.reach(f"{case}, {system}: capacity within 25 %, down [s]", down_s, 0.5)
            bench.report.reach(f"{case}, {system}: capacity within 25 %, up [s]", up_s, 1.0)
        if bench.plots is not None:
            plots.window(bench.plots / f"perf-steps-{system}.png", f"{case}, {system}", outcome)
        found.append(outcome)
    bench.plot("steps", case, found)


def blackout_10(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, gone for 10 s."""
    _blackout(bench, 10.0, SERN if bench.quick else ALL)


def blackout_30(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, gone for 30 s."""
    _blackout(bench, 30.0, SERN)


def _blackout(bench: Bench, gone_s: float, systems: Sequence[str]) -> None:
    case = f"4 Mbit/s 50 ms, blackout {gone_s:g} s"
    floor_s = bench.floor_s("4 Mbit/s 50 ms", FIELD)
    begin_s, after_s = (3.0, 5.0) if bench.quick else (5.0, 8.0)
    script = (
        Step(begin_s, "gone", lambda lab: lab.blackout(True)),
        Step(begin_s + gone_s, "back", lambda lab: lab.blackout(False)),
    )
    limits = {"sern-udp": 0.3, "sern-zmq": 1.5}
    found = []
    for system in bench.wanted(systems):

        def work(system: str = system) -> Outcome:
            return bench.run(case, system, FIELD, OVERLOAD, begin_s + gone_s + after_s, script=script)

        outcome = bench.attempt(case, system, work)
        if outcome is None:
            continue
        found.append(outcome)
        fresh_s = figures.first_fresh_s(outcome, "back", floor_s)
        bench.report.row(f"{case}, first fresh pose", system, fresh_s=fresh_s)
        if system in limits:
            bench.report.reach(f"{case}, {system}: first fresh pose [s]", fresh_s, limits[system])
    bench.plot(f"blackout-{gone_s:g}", case, found)


def long_path(bench: Bench) -> None:
    """20 Mbit/s, 200 ms, twice what it carries."""
    case = "20 Mbit/s 200 ms, 2x"
    floor_s = bench.floor_s("20 Mbit/s 200 ms", LONG)
    found = []
    for system in bench.wanted(SERN):
        outcome = bench.run(case, system, LONG, FAST, 10.0 if bench.quick else 24.0, warm_s=3.0)
        found.append(outcome)
        if system == "sern-udp":
            bench.poses(case, system, 0.0, 1.5, floor_s)
            share = figures.goodput_bps(outcome) / figures.ceiling_bps(outcome)
            name = f"{case}, {system}: goodput, share of what the link can carry"
            bench.report.reach(name, share, 0.95, at_least=True)
            busier = max(outcome.cpu_percent["robot"], outcome.cpu_percent["relay"])
            bench.report.reach(f"{case}: CPU of the busier side [% of a core]", busier, 12.0)
            if bench.plots is not None:
                plots.window(bench.plots / "perf-long-window.png", case, outcome)
    bench.plot("long", case, found)


def junk(bench: Bench) -> None:
    """An idle relay under 20,000 junk datagrams a second, from its own side of the link."""
    if "sern-udp" not in bench.systems:
        return
    case = f"{JUNK_HZ:,} junk datagrams/s"
    watch_s = 2.0 if bench.quick else 5.0
    directory = bench.directory / "junk"
    directory.mkdir()
    bench.lab.reset()
    make_keys(directory)
    relay = start_relay(bench.lab, directory, udp=True)
    try:
        watched = psutil.Process(relay.pid)
        _await_port(relay)
        quiet = _cpu_percent(watched, watch_s)
        ours, far = get_context("spawn").Pipe(duplex=False)
        attacker = get_context("spawn").Process(
            target=flood, args=(bench.lab.b.namespace, random.getrandbits(31), watch_s + 4.0, far), daemon=True
        )
        attacker.start()
        try:
            ours.recv()  # it has begun
            time.sleep(0.5)
            busy = _cpu_percent(watched, watch_s)
            rate_hz = ours.recv()
        finally:
            attacker.join(10.0)
            if attacker.is_alive():
                attacker.kill()
                attacker.join()
    finally:
        relay.terminate()
        relay.wait(20.0)
    bench.report.row(case, "sern-udp", relay_cpu_percent=busy, relay_cpu_idle_percent=quiet, junk_hz=float(rate_hz))
    bench.report.reach(f"{case}: the relay's CPU [% of a core]", busy - quiet, 10.0)


def _await_port(relay: "subprocess.Popen[bytes]") -> None:
    give_up_s = time.monotonic() + 20.0
    while not psutil.Process(relay.pid).net_connections("udp"):
        if relay.poll() is not None or time.monotonic() > give_up_s:
            raise SernError("the relay does not open its UDP port")
        time.sleep(0.05)


def _cpu_percent(process: psutil.Process, seconds: float) -> float:
    def used_s() -> float:
        times = process.cpu_times()
        return float(times.user + times.system)

    before_s, begun_s = used_s(), time.monotonic()
    time.sleep(seconds)
    return 100 * (used_s() - before_s) / (time.monotonic() - begun_s)


CASES: Final[dict[str, Callable[[Bench], None]]] = {
    "overload": overload,
    "loss": loss,
    "steps": steps,
    "blackout-10": blackout_10,
    "blackout-30": blackout_30,
    "long": long_path,
    "junk": junk,
}
QUICK_CASES: Final = ("overload", "loss", "steps", "blackout-10", "long", "junk")


def bench_all(options: argparse.Namespace, report: Report, note: str) -> None:
    systems = tuple(options.systems or (QUICK if options.quick else ALL))
    if importlib.util.find_spec("zenoh") is None:
        systems = tuple(system for system in systems if not system.startswith("zenoh"))
        report.note("without zenoh: pip install eclipse-zenoh")
    if options.plots is not None:
        plots.check()
        options.plots.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="sern-bench-") as temporary, Lab() as lab:
        directory = Path(temporary)
        if options.traces is not None:
            options.traces.mkdir(parents=True, exist_ok=True)
            directory = Path(tempfile.mkdtemp(prefix="run-", dir=options.traces)).resolve()
        bench = Bench(lab, report, systems, options.quick, directory, options.plots)
        for name in options.cases or (QUICK_CASES if options.quick else CASES):
            CASES[name](bench)
        report.note(f"lab: {lab.backend}; {note}; the machine's processors were up to {100 * bench.busiest:.0f} % busy")
    report.note("the floor is the median of a pose in one datagram on the idle link; limits are multiples of it")
    report.note("TCPROS is not measured: no rospy here (Debian packages python3-rospy and python3-rosmaster)")
