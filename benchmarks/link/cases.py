"""The cases, what is measured in each, and which figure is held against which limit."""

import argparse
import asyncio
import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.common import Report, pyplot
from benchmarks.flood import JUNK_HZ
from benchmarks.link import figures, peers, plots
from benchmarks.link.forwarder import FORWARDER
from benchmarks.link.junk import Junk
from benchmarks.link.load import POSES, Kind, Load
from benchmarks.link.runs import Outcome, Step, run
from benchmarks.recorded_links import CELLULAR, SLOT_S, read, recorded
from sern_core.vocabulary.errors import SernError
from sern_runtime.seal import ROOM_BYTES
from sern_sim.models import LinkModel, RateStep
from sern_tools.lab.lab import Lab

SERN: Final = ("sern-udp", "sern-zmq")
ONE: Final = "sern-one"
"""The stream lane without connections of their own for class control."""
ALL: Final = (*SERN, "zmq", "zenoh", "zenoh-multilink", "zenoh-multilink-bbr", "tcpros")
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
THIN: Final = LinkModel(rate_bps=2 * MEGABIT, delay_s=0.025, queue_packets=100)
FLOODS: Final = (1.3, 2.0, 4.0, 13.0)
"""Class control, times what the link carries."""
FLOOD_AGE_S: Final = 0.2
"""Four round trips."""
LTE: Final = CELLULAR / "att_lte_driving_up.csv"
LTE_FROM_S: Final = 60.0
"""A minute without gaps: netem gives a packet its time when it comes, so that one of a gap would wait for ever."""
MANY_POSES: Final = 10_000
CPU_LIMIT: Final = 4.0
"""CPU of the busier side, times that of a bare forwarder for the same datagrams in the same run."""
CPU_LIMIT_FAST: Final = 3.1
"""The same at 20 Mbit/s, where a datagram often finds both awake."""
JUNK_LIMIT: Final = 0.15
"""CPU of refusing a datagram, by that of forwarding one of the full size."""
FULL: Final = Load(even_hz=360.0, even_bytes=ROOM_BYTES)
"""Datagrams of the full size, nine tenths of what 4 Mbit/s carry."""


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
    newest: Path = Path()
    """Directory of the latest run."""
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
        extra: Callable[[Outcome], dict[str, float]] = lambda outcome: {},
    ) -> Outcome:
        """One row of the table; `extra` are the case's own figures."""
        self._runs += 1
        directory = self.newest = self.directory / f"{self._runs:02d}-{system}"
        directory.mkdir()
        work = run(self.lab, system, model, load, duration_s, directory, script=script, warm_s=warm_s)
        try:
            outcome = asyncio.run(work)
        except SernError as error:
            raise SernError(f"{system}: {error}") from error
        self.busiest = max(self.busiest, outcome.busy)
        self.report.row(case, system, **figures.metrics(outcome), **extra(outcome))
        return outcome

    def forwarder(self, case: str, model: LinkModel, load: Load) -> Outcome:
        """The bare forwarder in the relay's place, at the same link."""

        def costs(outcome: Outcome) -> dict[str, float]:
            return {"datagrams_hz": figures.datagrams_hz(outcome), "datagram_us": figures.forwarding_us(outcome)}

        return self.run(case, FORWARDER, model, load, 3.0 if self.quick else 10.0, warm_s=0.5, extra=costs)

    def cpu(self, case: str, outcome: Outcome, limit: float) -> None:
        """Reach of the busier side's CPU, as a multiple of a bare forwarder's for the same datagrams."""
        bare = self.forwarder(case, outcome.model, figures.bare_load(outcome))
        name = f"{case}: CPU of the busier side, times that of a bare forwarder"
        self.report.reach(name, figures.times_forwarding(outcome, bare), limit)

    def floor_s(self, name: str, model: LinkModel) -> float:
        """The median of a pose in a single datagram on the idle link, measured once a link."""
        if name not in self.floors_s:
            outcome = self.run(f"{name}, idle", "floor", model, Load(), 2.0 if self.quick else 5.0, warm_s=0.0)
            self.floors_s[name] = figures.quantile(figures.latencies_ms(outcome), 0.5) / 1000
        return self.floors_s[name]

    def wanted(self, systems: Sequence[str]) -> list[str]:
        return [system for system in systems if system in self.systems]

    def attempt(self, case: str, system: str, work: Callable[[], Outcome]) -> Outcome | None:
        """A peer that does not work here is noted; SERN must work."""
        try:
            return work()
        except SernError as error:
            if system in (*SERN, ONE):
                raise
            self.report.note(f"{case}: {error}")
            return None

    def plot(self, name: str, title: str, outcomes: Sequence[Outcome], floor_s: float | None) -> None:
        if self.plots is not None and outcomes:
            plots.latency(self.plots / f"perf-{name}.png", title, outcomes, floor_s)

    def poses(self, case: str, system: str, p50: float, p99: float, floor_s: float) -> None:
        """Reaches of a pose's latency, as multiples of the floor."""
        for name, limit in (("p50", p50), ("p99", p99)):
            if limit:
                value = self.report.value(case, system, f"pose_{name}_ms") / (1000 * floor_s)
                self.report.reach(f"{case}, {system}: pose {name}, times the floor", value, limit)


def idle(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, poses alone: what a system adds to the floor by itself."""
    floor_s = bench.floor_s("4 Mbit/s 50 ms", FIELD)
    found = []
    for system in bench.wanted(("sern-udp",) if bench.quick else ALL):

        def work(system: str = system) -> Outcome:
            return bench.run("4 Mbit/s 50 ms, idle", system, FIELD, Load(), 3.0, warm_s=1.0)

        outcome = bench.attempt("idle", system, work)
        if outcome is not None:
            found.append(outcome)
    bench.plot("idle", "4 Mbit/s 50 ms, poses alone", found, floor_s)


def overload(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, twice what it carries."""
    _field(bench, "4 Mbit/s 50 ms, 2x", "overload", FIELD)


def loss(bench: Bench) -> None:
    """The same with 2 % loss both ways."""
    _field(bench, "4 Mbit/s 50 ms 2 % loss, 2x", "loss", LOSSY)


def lossy_poses(bench: Bench) -> None:
    """The same for so long that a share of poses in ten thousand can be told; SERN alone."""
    if "sern-udp" not in bench.systems:
        return
    case = "4 Mbit/s 50 ms 2 % loss, 2x, 10,000 poses"
    outcome = bench.run(case, "sern-udp", LOSSY, OVERLOAD, MANY_POSES / POSES.rate_hz + 2.0)
    arrived = figures.delivered_share(outcome)
    bench.report.reach(f"{case}, sern-udp: poses that arrive", arrived, 0.9995, at_least=True)


def _field(bench: Bench, case: str, name: str, model: LinkModel) -> None:
    floor_s = bench.floor_s("4 Mbit/s 50 ms", FIELD)
    duration_s = 7.0 if bench.quick else 17.0
    report = bench.report
    found: dict[str, Outcome] = {}
    for system in bench.wanted(("sern-udp", "zenoh-multilink") if bench.quick and model.loss else ALL):

        def work(system: str = system) -> Outcome:
            return bench.run(case, system, model, OVERLOAD, duration_s)

        outcome = bench.attempt(case, system, work)
        if outcome is not None:
            found[system] = outcome
    if "sern-udp" in found:
        ours = found["sern-udp"]
        share = figures.goodput_bps(ours) / figures.ceiling_bps(ours)
        if model.loss:
            bench.poses(case, "sern-udp", 0.0, 1.30, floor_s)
            report.reach(f"{case}, sern-udp: goodput, share of what the link can carry", share, 0.96, at_least=True)
            arrived = figures.delivered_share(ours)
            report.reach(f"{case}, sern-udp: poses that arrive", arrived, 0.999, at_least=True)
        else:
            bench.poses(case, "sern-udp", 1.05, 1.20, floor_s)
            report.reach(f"{case}, sern-udp: goodput, share of what the link can carry", share, 0.98, at_least=True)
            arrived = figures.delivered_share(ours, forgive_superseded=True)
            report.reach(f"{case}, sern-udp: poses that arrive, unless superseded", arrived, 1.0, at_least=True)
        _against_zenoh(bench, case, found)
        if "tcpros" in found and not model.loss:  # with losses TCP does not fill the link: nothing queues
            means = [float(figures.latencies_ms(found[system]).mean()) for system in ("tcpros", "sern-udp")]
            report.reach(f"{case}: mean latency, times lower than TCPROS's", means[0] / means[1], 5.0, at_least=True)
    if "sern-zmq" in found and not model.loss:
        bench.poses(case, "sern-zmq", 1.15, 1.4, floor_s)
    bench.plot(name, case, list(found.values()), floor_s)
    if "sern-udp" in found:
        if bench.plots is not None:
            plots.window(bench.plots / f"perf-{name}-window.png", case, found["sern-udp"])
        bench.cpu(case, found["sern-udp"], CPU_LIMIT)


def _against_zenoh(bench: Bench, case: str, found: dict[str, Outcome]) -> None:
    """Each multilink by itself: what one of them has of latency the other has of goodput."""
    ours = found["sern-udp"]
    for system in MULTILINK:
        if system not in found:
            continue
        theirs = found[system]
        p99s = [figures.quantile(figures.latencies_ms(outcome), 0.99) for outcome in (theirs, ours)]
        name = f"{case}: p99, times lower than that of {system}"
        bench.report.reach(name, p99s[0] / p99s[1], 3.0, at_least=True)
        share = figures.goodput_bps(ours) / figures.goodput_bps(theirs)
        bench.report.reach(f"{case}: goodput, times that of {system}", share, 1.15, at_least=True)


def steps(bench: Bench) -> None:
    """8, then 1, then 4 Mbit/s, 50 ms, 12 Mbit/s of clouds."""
    case = "8, 1, 4 Mbit/s 50 ms"
    each_s = 4.0 if bench.quick else 8.0
    script = (
        Step(each_s, "down", lambda lab: lab.change(rate_bps=1 * MEGABIT)),
        Step(2 * each_s, "up", lambda lab: lab.change(rate_bps=4 * MEGABIT)),
    )
    found = []
    for system in bench.wanted(("sern-udp",) if bench.quick else SERN):

        def settled(outcome: Outcome) -> dict[str, float]:
            return {
                "settled_down_s": figures.settled_s(outcome, "down", 1 * MEGABIT, "up"),
                "settled_up_s": figures.settled_s(outcome, "up", 4 * MEGABIT, None),
            }

        outcome = bench.run(case, system, STEP, HEAVY, 3 * each_s, script=script, extra=settled)
        if system == "sern-udp":
            bench.report.reach(
                f"{case}, {system}: capacity within 25 %, down [s]",
                bench.report.value(case, system, "settled_down_s"),
                0.5,
            )
            bench.report.reach(
                f"{case}, {system}: capacity within 25 %, up [s]", bench.report.value(case, system, "settled_up_s"), 0.6
            )
        if bench.plots is not None:
            plots.window(bench.plots / f"perf-steps-{system}.png", f"{case}, {system}", outcome)
        found.append(outcome)
    bench.plot("steps", case, found, None)  # whose path is another one


def blackout_10(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, gone for 10 s."""
    _blackout(bench, 10.0, ("sern-udp",) if bench.quick else ALL)


def blackout_30(bench: Bench) -> None:
    """4 Mbit/s, 50 ms, gone for 30 s."""
    _blackout(bench, 30.0, SERN)


def _blackout(bench: Bench, gone_s: float, systems: Sequence[str]) -> None:
    case = f"4 Mbit/s 50 ms, blackout {gone_s:g} s"
    floor_s = bench.floor_s("4 Mbit/s 50 ms", FIELD)
    begin_s, after_s = (3.0, 4.0) if bench.quick else (4.0, 6.0)
    script = (
        Step(begin_s, "gone", lambda lab: lab.blackout(True)),
        Step(begin_s + gone_s, "back", lambda lab: lab.blackout(False)),
    )
    limits = {"sern-udp": 0.2, "sern-zmq": 1.5}

    def fresh(outcome: Outcome) -> dict[str, float]:
        return {"fresh_s": figures.first_fresh_s(outcome, "back", floor_s)}

    found = []
    for system in bench.wanted(systems):

        def work(system: str = system) -> Outcome:
            whole_s = begin_s + gone_s + after_s
            return bench.run(case, system, FIELD, OVERLOAD, whole_s, script=script, extra=fresh)

        outcome = bench.attempt(case, system, work)
        if outcome is None:
            continue
        found.append(outcome)
        if system in limits:
            bench.report.reach(f"{case}, {system}: first fresh pose [s]", fresh(outcome)["fresh_s"], limits[system])
    bench.plot(f"blackout-{gone_s:g}", case, found, floor_s)


def long_path(bench: Bench) -> None:
    """20 Mbit/s, 200 ms, twice what it carries."""
    case = "20 Mbit/s 200 ms, 2x"
    floor_s = bench.floor_s("20 Mbit/s 200 ms", LONG)
    found: dict[str, Outcome] = {}
    for system in bench.wanted(("sern-udp",) if bench.quick else SERN):
        outcome = bench.run(case, system, LONG, FAST, 10.0 if bench.quick else 20.0, warm_s=3.0)
        found[system] = outcome
        if system == "sern-udp":
            bench.poses(case, system, 0.0, 1.5, floor_s)
            share = figures.goodput_bps(outcome) / figures.ceiling_bps(outcome)
            name = f"{case}, {system}: goodput, share of what the link can carry"
            bench.report.reach(name, share, 0.95, at_least=True)
            if bench.plots is not None:
                plots.window(bench.plots / "perf-long-window.png", case, outcome)
    bench.plot("long", case, list(found.values()), floor_s)
    if "sern-udp" in found:
        bench.cpu(case, found["sern-udp"], CPU_LIMIT_FAST)


def junk(bench: Bench) -> None:
    """Poses alone, and beside them 20,000 junk datagrams a second from the relay's own side of the link: of an unknown
    session, then with the id of the live one and a bad tag."""
    if "sern-udp" not in bench.systems:
        return
    case = "4 Mbit/s 50 ms, poses alone"
    duration_s = 3.0 if bench.quick else 6.0
    quiet = bench.run(case, "sern-udp", FIELD, Load(), duration_s, warm_s=1.0).cpu_percent["relay"]
    bare = bench.forwarder("4 Mbit/s 50 ms, full datagrams", FIELD, FULL)
    for name, known_id in (("unknown session", False), ("bad tag", True)):
        with Junk(bench.lab.b, duration_s) as attacker:

            def begin(_lab: Lab, attacker: Junk = attacker, known_id: bool = known_id) -> None:
                # The session's directory is the newest.
                session_id = int((bench.newest / "session").read_text())
                attacker.begin(session_id if known_id else session_id ^ 1)

            script = (Step(0.0, "junk", begin),)
            attacked = f"{case}, {JUNK_HZ:,} junk/s, {name}"
            outcome = bench.run(attacked, "sern-udp", FIELD, Load(), duration_s, script=script, warm_s=1.0)
            rate_hz = attacker.rate_hz()
        if rate_hz < 0.9 * JUNK_HZ:
            bench.report.note(f"{attacked}: only {rate_hz:,.0f} datagrams/s could be made")
        cost = figures.refusing_to_forwarding(outcome.cpu_percent["relay"] - quiet, rate_hz, bare)
        bench.report.reach(f"{attacked}: CPU of refusing one, by that of forwarding one", cost, JUNK_LIMIT)
        bench.plot(f"junk-{name.replace(' ', '-')}", attacked, [outcome], None)


def flood(bench: Bench) -> None:
    """2 Mbit/s, 50 ms, class control alone above what it carries, and beside clouds; heartbeats of the same class."""
    loads = [(f"{times:g}x", Load(flood_bps=times * 2 * MEGABIT)) for times in FLOODS[:: 3 if bench.quick else 1]]
    loads.append(("2x beside clouds", Load(flood_bps=4 * MEGABIT, cloud_bytes=50_000)))
    for name, load in loads:
        case = f"2 Mbit/s 50 ms, class control {name}"
        for system in (*bench.wanted(SERN), *((ONE,) if "sern-zmq" in bench.systems else ())):
            outcome = bench.run(case, system, THIN, load, 7.0 if bench.quick else 17.0)
            for kind in (Kind.FLOOD, Kind.POSE):
                p99_s = figures.quantile(figures.latencies_ms(outcome, kind), 0.99) / 1000
                bench.report.reach(f"{case}, {system}: {kind.name.lower()} p99 [s]", p99_s, FLOOD_AGE_S)
            arrived = figures.delivered_share(outcome)
            bench.report.reach(f"{case}, {system}: heartbeats that arrive", arrived, 0.99, at_least=True)
            share = figures.goodput_bps(outcome) / figures.flood_ceiling_bps(outcome)
            name = f"{case}, {system}: goodput, share of what the link can carry"
            bench.report.reach(name, share, 0.9, at_least=True)


def cellular(bench: Bench) -> None:
    """A minute of an LTE link to a car that drives, recorded, another rate every 0.1 s; 4 Mbit/s of clouds."""
    if not LTE.is_file():
        bench.report.note(f"cellular: without {LTE.name}, a recording that is not ours to ship")
        return
    slots = read(LTE)[round(LTE_FROM_S / SLOT_S) :]
    model, played_s = recorded(slots, 20.0 if bench.quick else 60.0)
    mean_bps = model.capacity_bits(0.0, played_s) / played_s
    changes = [RateStep(0.0, model.rate_bps), *model.rate_steps]
    script = [Step(change.at_s, f"{change.at_s:g} s", partial(_carry, change.rate_bps)) for change in changes]
    case = f"LTE, {mean_bps / MEGABIT:.1f} Mbit/s in the mean, 50 ms"
    link = replace(model, rate_bps=mean_bps, rate_steps=(), overhead_bytes=0)

    def used(outcome: Outcome) -> float:
        return 8 * outcome.wire_bytes / outcome.duration_s / mean_bps

    def extra(outcome: Outcome) -> dict[str, float]:
        late_ns = max(outcome.events[step.name][1] - outcome.start_ns - step.at_s * 1e9 for step in script)
        p95_ms = figures.quantile(figures.latencies_ms(outcome), 0.95)
        return {"pose_p95_ms": p95_ms, "used_percent": 100 * used(outcome), "step_late_ms": late_ns / 1e6}

    def play(name: str, system: str, load: Load) -> Outcome:
        return bench.run(name, system, link, load, played_s, script=script, extra=extra)

    for system in bench.wanted(("sern-udp",) if bench.quick else QUICK):
        outcome = bench.attempt(case, system, partial(play, case, system, Load(cloud_bytes=50_000)))
        if outcome is not None and system == "sern-udp":
            alone = play(f"{case}, poses alone", system, Load())
            share = used(outcome) - used(alone)
            bench.report.reach(f"{case}, {system}: share of the link that bulk uses", share, 0.80, at_least=True)
            p95s = [figures.quantile(figures.latencies_ms(each), 0.95) for each in (outcome, alone)]
            bench.report.reach(f"{case}, {system}: pose p95, times that of poses alone", p95s[0] / p95s[1], 2.0)


def _carry(rate_bps: float | None, lab: Lab) -> None:
    lab.change("up", rate_bps=rate_bps)


CASES: Final[dict[str, Callable[[Bench], None]]] = {
    "idle": idle,
    "overload": overload,
    "loss": loss,
    "lossy-poses": lossy_poses,
    "steps": steps,
    "blackout-10": blackout_10,
    "blackout-30": blackout_30,
    "long": long_path,
    "junk": junk,
    "flood": flood,
    "cellular": cellular,
}
QUICK_CASES: Final = ("idle", "overload", "loss", "steps", "blackout-10", "long", "junk")


def bench_all(options: argparse.Namespace, report: Report, note: str) -> bool:
    """Run what is asked for. `note` says under which priority. False when a case could not be measured."""
    systems = tuple(options.systems or (QUICK if options.quick else ALL))
    if importlib.util.find_spec("zenoh") is None:
        systems = tuple(system for system in systems if not system.startswith("zenoh"))
        report.note("without zenoh: pip install eclipse-zenoh")
    if lacking := peers.missing_ros():
        systems = tuple(system for system in systems if system != "tcpros")
        report.note(f"without rospy over TCPROS, which needs Debian packages: {', '.join(lacking)}")
    if options.plots is not None:
        pyplot("--plots")  # before the work, not after it
        options.plots.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="sern-bench-") as temporary, Lab() as lab:
        directory = Path(temporary)
        if options.traces is not None:
            options.traces.mkdir(parents=True, exist_ok=True)
            directory = Path(tempfile.mkdtemp(prefix="run-", dir=options.traces)).resolve()
        failed = False
        bench = Bench(lab, report, systems, options.quick, directory, options.plots)
        for name in options.cases or (QUICK_CASES if options.quick else CASES):
            try:
                CASES[name](bench)
            except SernError as error:  # what was measured before is still worth printing
                report.note(f"{name} could not be measured: {error}")
                failed = True
        report.note(f"lab: {lab.backend}; {note}; the machine's processors were up to {100 * bench.busiest:.0f} % busy")
    report.note("the floor is the median of a pose in one datagram on the idle link; limits are multiples of it")
    return not failed
