"""`sern demo`: relay, robot and site as real processes over a bad link, beside the same load on plain ZMQ.

    robot --> shaping proxy --> relay <-- site          commands take the same way back
    robot --> shaping proxy --> site                    the baseline: a PUB and a SUB socket each

Three phases, one after the other because two loads on a small machine would disturb each other: the idle link is
measured, SERN runs, the baseline runs. Then the logs are read, the promises judged, and the report written.

Whatever happens, no process and no temporary file is left: children are stopped in order, and by force if need be.
"""

import asyncio
import math
import shlex
import sys
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Final

import aiohttp
import typer
from rich.console import Console

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_runtime.config.endpoints import installing
from sern_runtime.profiles import load_profile
from sern_tools import demo_charts, demo_relays, demo_report, demo_view
from sern_tools.counters import Counters, read_counters
from sern_tools.demo_behaviour import Behaviour, Look
from sern_tools.demo_link import LinkProcess
from sern_tools.demo_live import LiveView, Sample, join
from sern_tools.demo_report import Carried, Report
from sern_tools.demo_running import START_S, cancelled_by_signals, get_json, is_ready, working_directory
from sern_tools.demo_scenario import (
    COMMAND_TOPIC,
    CONTROL_OVERTAKEN_LIMIT,
    HOST,
    POSE_TOPIC,
    RELAY,
    ROBOT,
    SITE,
    STATE_OVERTAKEN_LIMIT,
    Ports,
    Scenario,
    write_files,
)
from sern_tools.harness.processes import DRAIN_S, Child, Children, program, python
from sern_tools.message_log import TopicLog, read_logs
from sern_tools.ports import free_ports
from sern_tools.processors import ProcessorTime, crowded
from sern_tools.shaping import RateSchedule
from sern_tools.summary import RunFacts, analyse, judge

EXIT_OK: Final = 0
EXIT_BROKEN: Final = 1
EXIT_ERROR: Final = 2
EXIT_INTERRUPTED: Final = 130
IDLE_S: Final = 2.0
"""How long the idle link is measured."""
POLL_S: Final = 0.5
TAIL_S: Final = 3.0
"""After the load has ended, what is under way may still arrive for so long."""
SERN_NAME: Final = "SERN"
BASELINE_NAME: Final = "plain ZMQ"


@dataclass(frozen=True)
class Options:
    """What `sern demo` was asked for. `relay_command` and `client_command` are followed by `--config FILE`."""

    scenario: Scenario
    out: Path
    json_file: Path
    html_file: Path
    picture_file: Path | None
    baseline: bool = True
    keep: bool = False
    profiles: Path | None = None
    command: str = "sern demo"
    relay_command: Sequence[str] = ()
    client_command: Sequence[str] = ()


@dataclass
class Run:
    """One system's run: when the script began, what the proxy carried, where the files are."""

    origin_ns: int = 0
    carried: Carried = field(default_factory=lambda: Carried(1.0, ()))
    files: Mapping[str, Path] = field(default_factory=dict)
    behaviour: Behaviour = field(default_factory=Behaviour)


class Demo:
    """One demo, in `directory`, which is not its own to remove."""

    def __init__(self, options: Options, directory: Path, console: Console) -> None:
        self.options = options
        self.scenario = options.scenario
        self.directory = directory
        self.console = console

    async def run(self) -> Report:
        """The three phases and the report. SernError when something could not run."""
        started = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
        total = 3 if self.options.baseline else 2
        self._say(f"1/{total}  measuring the idle link, {IDLE_S:g} s")
        floor_s = await self.idle_latency()
        words = ", ".join(f"from the {origin} {demo_report.seconds(value)}" for origin, value in floor_s.items())
        self._say(f"     one way, idle: {words}")
        self._say(f"2/{total}  SERN, {self.scenario.duration_s:g} s: {demo_report.load_words(self.scenario)}")
        before = ProcessorTime.now()
        sern = await self.run_sern()
        busy = crowded(before, ProcessorTime.now())
        carried = {SERN_NAME: sern.carried}
        baseline = None
        if self.options.baseline:
            self._say(f"3/{total}  the same load over plain ZMQ, {self.scenario.duration_s:g} s")
            baseline = await self.run_baseline()
            carried[BASELINE_NAME] = baseline.carried
        self._say("reading the logs")
        report = self.judge(started, floor_s, sern, baseline, carried)
        return replace(report, remarks=() if busy is None else (busy,))

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False)

    # -- the idle link and the baseline ----------------------------------------------------------------------------

    async def idle_latency(self) -> dict[str, float]:
        """One-way latency by origin, of small messages over plain ZMQ through a proxy of the same profile."""
        directory = self._new_directory("idle")
        async with Children(directory) as children:
            link, robot, site = await self._start_baseline(children, directory)
            try:
                await asyncio.sleep(IDLE_S)
                await children.until(partial(_probed, robot, site), START_S, "nothing came through the idle link")
                return {ROBOT: (await site.ask("floor"))["floor_s"], SITE: (await robot.ask("floor"))["floor_s"]}
            finally:
                link.close()

    async def _start_baseline(self, children: Children, directory: Path) -> tuple[LinkProcess, Child, Child]:
        publish, subscribe = free_ports(2)
        files = write_files(directory / "config", self.scenario, Ports(*free_ports(4)))
        base = python("-m", "sern_tools.baseline")
        site = await children.start(
            "baseline-site",
            [
                *base,
                *("--config", str(files[SITE])),
                *("--publish", f"bind:tcp://{HOST}:{publish}"),
                *("--subscribe", f"bind:tcp://{HOST}:{subscribe}"),
            ],
            talks=True,
        )
        await site.read_object()
        link = await self._start_link(children, [subscribe, publish])
        robot = await children.start(
            "baseline-robot",
            [
                *base,
                *("--config", str(files[ROBOT])),
                *("--publish", f"tcp://{HOST}:{link.ports[0]}"),
                *("--subscribe", f"tcp://{HOST}:{link.ports[1]}"),
            ],
            talks=True,
        )
        await robot.read_object()
        return link, robot, site

    async def _start_link(self, children: Children, targets: list[int], *, datagrams: bool = False) -> LinkProcess:
        return await LinkProcess.start(
            children,
            "proxy",
            targets,
            profile=self.scenario.profile.name,
            profiles=self.options.profiles,
            seed=self.scenario.seed,
            datagrams=datagrams,
        )

    async def run_baseline(self) -> Run:
        directory = self._new_directory("baseline")
        async with Children(directory) as children:
            link, robot, site = await self._start_baseline(children, directory)
            try:
                await children.until(partial(_probed, robot, site), START_S, "the baseline did not connect")
                for child in (site, robot):
                    await child.ask("go")

                async def sample(t_s: float, statistics: Mapping[str, Any]) -> Sample:
                    counts = [(await child.ask("count"))["topics"] for child in (robot, site)]
                    return _sample(t_s, statistics, counts)

                run = await self._watch(children, link, BASELINE_NAME, sample)
                for child in (robot, site):
                    await child.ask("quiet")
                await asyncio.sleep(TAIL_S)
                await children.stop([robot, site])
            finally:
                link.close()
        config = directory / "config"
        return replace(run, files={ROBOT: config / f"{ROBOT}.csv", SITE: config / f"{SITE}.csv"})

    # -- SERN ------------------------------------------------------------------------------------------------------

    async def run_sern(self) -> Run:
        directory = self._new_directory("sern")
        relay_port, *http_ports = free_ports(4)
        timeout = aiohttp.ClientTimeout(total=2.0)
        where = f"the logs are in {directory}" if self.options.keep else "--keep keeps the logs"
        async with aiohttp.ClientSession(timeout=timeout) as session, Children(directory) as children:
            link = await self._start_link(children, [relay_port], datagrams=True)
            try:
                ports = Ports(relay_port, *http_ports)
                files = write_files(directory / "config", self.scenario, ports)
                web = {
                    name: f"http://{HOST}:{port}" for name, port in zip((RELAY, ROBOT, SITE), http_ports, strict=True)
                }
                daemons: dict[str, Child] = {}
                for name in (RELAY, SITE, ROBOT):
                    command = self.options.relay_command if name == RELAY else self.options.client_command
                    daemons[name] = await children.start(name, [*command, "--config", str(files[name])])
                    ready = partial(is_ready, session, web[name])
                    await children.until(ready, START_S, f"{name} is not ready ({where})", every_s=0.05)
                arriving = partial(_arriving, session, web[SITE])
                problem = f"none of the robot's messages arrived ({where})"
                await children.until(arriving, START_S, problem, every_s=0.05)

                behaviour = Behaviour()

                async def sample(t_s: float, statistics: Mapping[str, Any]) -> Sample:
                    topics = [await get_json(session, f"{web[name]}/api/topics") or {} for name in (ROBOT, SITE)]
                    links = await get_json(session, f"{web[ROBOT]}/api/link") or []
                    mmcf = await get_json(session, f"{web[ROBOT]}/api/mmcf") or {}
                    adapting = next(iter(mmcf.get("links", ())), None)
                    behaviour.looks.append(Look.of(t_s, next(iter(links), None), adapting))
                    return _with_links(_sample(t_s, statistics, topics), links)

                run = await self._watch(children, link, SERN_NAME, sample)
                run.behaviour = behaviour
                # Upstream first: what the robot still has goes to the relay, and from there to the site.
                await children.end(daemons[ROBOT])
                await _drained(children, partial(get_json, session, f"{web[RELAY]}/api/link"))
                await children.end(daemons[SITE])
                await children.end(daemons[RELAY])
            finally:
                link.close()
        return replace(run, files={name: directory / "config" / f"{name}.csv" for name in (ROBOT, RELAY, SITE)})

    # -- both ------------------------------------------------------------------------------------------------------

    async def _watch(
        self,
        children: Children,
        link: LinkProcess,
        title: str,
        sample: Callable[[float, Mapping[str, Any]], Awaitable[Sample]],
    ) -> Run:
        """Start the link's script, show the run until its end, and return what the link carried."""
        origin_s = time.monotonic()
        run = Run(origin_ns=time.time_ns())
        await link.ask(do="start", at_s=origin_s)
        profile, duration_s = self.scenario.profile, self.scenario.duration_s
        with LiveView(self.console, title, profile, duration_s, namespace=f"/{ROBOT}") as view:
            while (t_s := time.monotonic() - origin_s) < duration_s:
                children.check()
                view.show(await sample(t_s, await link.ask(do="stats")))
                await asyncio.sleep(min(POLL_S, max(0.0, duration_s - (time.monotonic() - origin_s))))
        run.carried = await link.carried()
        return run

    def _new_directory(self, name: str) -> Path:
        path = self.directory / name
        path.mkdir()
        return path

    def judge(
        self, started: str, floor_s: Mapping[str, float], sern: Run, baseline: Run | None, carried: dict[str, Carried]
    ) -> Report:
        logs = read_logs(sern.files.items())
        facts = self._facts(floor_s, sern, logs)
        results = [analyse(SERN_NAME, logs, facts, self._counters(sern))]
        if baseline is not None:
            facts = replace(facts, origin_ns=baseline.origin_ns)
            results.append(analyse(BASELINE_NAME, read_logs(baseline.files.items()), facts))
        limits = {"control": CONTROL_OVERTAKEN_LIMIT, "state": STATE_OVERTAKEN_LIMIT}
        verdicts = judge(
            results[0],
            results[1] if baseline else None,
            overtaken_share_limits=limits,
            datagram_share=sern.behaviour.lane_shares().get("udp", 0.0),  # the proxy of SERN's run lets them through
        )
        # First in, first out overtakes nobody: the class order is nothing to compare plain ZMQ by.
        others = judge(results[1], None, overtaken_share_limits={}) if baseline else ()
        comparison = {verdict.name: verdict for verdict in others}
        return Report(
            self.options.command,
            started,
            self.scenario,
            results,
            verdicts,
            carried,
            comparison,
            behaviour=sern.behaviour,
        )

    def _facts(self, floor_s: Mapping[str, float], run: Run, logs: Mapping[str, TopicLog]) -> RunFacts:
        poses = {name: log.offered for name, log in logs.items() if log.priority == "control" and log.origin == ROBOT}
        duration_s = self.scenario.duration_s
        return RunFacts(
            origin_ns=run.origin_ns,
            duration_s=duration_s,
            floor_s=floor_s,
            blackouts=tuple(RateSchedule.of(self.scenario.profile.up, until_s=duration_s).blackouts(duration_s)),
            reliable_topics=frozenset(name for name, log in logs.items() if log.priority == "state"),
            command_lifespans_s={COMMAND_TOPIC: self.scenario.command_lifespan_s},
            relay=RELAY,
            subscribers={ROBOT: SITE, SITE: ROBOT},
            pose_topic=POSE_TOPIC if POSE_TOPIC in poses else max(poses, key=poses.__getitem__, default=""),
        )

    def _counters(self, run: Run) -> dict[str, list[Counters]]:
        directory = run.files[ROBOT].parent
        return read_counters([directory / f"{name}.summary.json" for name in (ROBOT, RELAY, SITE)])


async def _probed(robot: Child, site: Child) -> bool:
    """Both directions are connected and subscribed once a probe has arrived each way."""
    return all([(await child.ask("floor"))["floor_s"] is not None for child in (robot, site)])


# What the daemons say over HTTP ---------------------------------------------------------------------------------------


async def _arriving(session: aiohttp.ClientSession, url: str) -> bool:
    topics = await get_json(session, f"{url}/api/topics") or {}
    return any(counters.get("delivered") for name, counters in topics.items() if name != COMMAND_TOPIC)


async def _drained(children: Children, ask: Callable[[], Awaitable[list[Mapping[str, Any]] | None]]) -> None:
    """Wait until nothing waits for the site any more, or until it has not got less for `DRAIN_S`.

    `ask`: the relay's /api/link, None while it does not answer. SernError when a child ended that nobody told to.
    """
    least = math.inf
    deadline_s = time.monotonic() + DRAIN_S
    while time.monotonic() < deadline_s:
        children.check()
        links = await ask()
        if links is not None:
            left = sum(_waiting(entry) + entry.get("inflight_bytes", 0) for entry in links if entry.get("peer") == SITE)
            if not left:
                return
            if left < least:
                least, deadline_s = left, time.monotonic() + DRAIN_S
        await asyncio.sleep(0.05)


def _waiting(link: Mapping[str, Any]) -> int:
    """Bytes in the queues of one entry of /api/link."""
    return sum(int(queue.get("bytes", 0)) for queue in link.get("queue", {}).values())


def _sample(t_s: float, statistics: Mapping[str, Any], topics: Sequence[Mapping[str, Any]]) -> Sample:
    up = statistics["up"]
    return Sample(t_s, join(*topics), capacity_bps=up["rate_bps"], link_packets=up["queue_packets"])


def _with_links(sample: Sample, links: Sequence[Mapping[str, Any]]) -> Sample:
    if not links:
        return sample
    up = [entry for entry in links if entry.get("up")]
    rtts = [entry["srtt_s"] for entry in up if entry.get("srtt_s") is not None]
    return replace(
        sample,
        estimate_bps=sum(entry.get("rate_bps") or 0.0 for entry in up),
        waiting_bytes=sum(_waiting(entry) for entry in links),
        round_trip_s=min(rtts, default=None),
    )


# The command ----------------------------------------------------------------------------------------------------------


async def run(options: Options, console: Console) -> int:
    """Run the demo, print the summary, write the report; the exit status. Ctrl-C is asyncio.CancelledError."""
    cancelled_by_signals()
    with working_directory(options.out, "run", keep=options.keep) as directory:
        report = await Demo(options, directory, console).run()
        console.print()
        demo_report.print_summary(report, console)
        for path, text in (
            (options.json_file, demo_report.as_json(report)),
            (options.html_file, demo_report.as_html(report)),
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            console.print(f"wrote {path}", highlight=False, soft_wrap=True)
        if options.picture_file is not None:
            options.picture_file.parent.mkdir(parents=True, exist_ok=True)
            options.picture_file.write_bytes(demo_charts.pose_age(report.results))
            console.print(f"wrote {options.picture_file}", highlight=False, soft_wrap=True)
        if options.keep:
            console.print(f"kept {directory}", highlight=False, soft_wrap=True)
    return EXIT_OK if report.ok else EXIT_BROKEN


def demo(
    profile: Annotated[str, typer.Option(help="Name of the link profile.")] = "demo",
    profiles: Annotated[Path | None, typer.Option(help="File of profiles other than the shipped one.")] = None,
    duration: Annotated[float | None, typer.Option(min=2, help="Seconds; by default what the profile takes.")] = None,
    overload: Annotated[float, typer.Option(min=0.1, max=50, help="Offered load as a multiple of the link.")] = 2.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the load and of the link's jitter.")] = 1,
    bag: Annotated[Path | None, typer.Option(help="Play this recording in place of the simulated robot.")] = None,
    out: Annotated[Path, typer.Option(help="Directory for what the demo leaves behind.")] = Path("demo-out"),
    json: Annotated[Path | None, typer.Option(help="The figures; default OUT/result.json.")] = None,
    html: Annotated[Path | None, typer.Option(help="The report; default OUT/report.html.")] = None,
    picture: Annotated[Path | None, typer.Option(help="The age of the newest pose over time, as a PNG file.")] = None,
    view: Annotated[str | None, typer.Option(help="Keep it running for a viewer of this kind: foxglove.")] = None,
    relays: Annotated[
        int | None, typer.Option(min=2, max=5, help="In place of all that: so many relays, of which one is killed.")
    ] = None,
    no_baseline: Annotated[bool, typer.Option("--no-baseline", help="Leave out the run over plain ZMQ.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Keep configuration, keys and logs in OUT.")] = False,
) -> None:
    """Relay, robot and site over a bad link on this machine, beside the same load on plain ZMQ.

    With --relays several relays that form a fabric (extra zenoh), of which one is killed in the middle of the run.
    Exit status: 0 every promise kept, 1 one was broken, 2 it could not run, 130 interrupted.
    """
    console = Console()
    command = shlex.join(["sern", *sys.argv[1:]])
    try:
        if relays is not None:
            unused = {"--view": view, "--bag": bag, "--picture": picture, "--html": html, "--profiles": profiles}
            for option, value in unused.items():
                if value is not None:
                    raise ConfigError(f"{option} does not go with --relays; leave one of them out")
            duration_s = duration or demo_relays.DURATION_S
            asked = demo_relays.RelaysOptions(relays, duration_s, seed, out, json or out / "result.json", keep, command)
            raise typer.Exit(EXIT_OK if asyncio.run(demo_relays.run(asked, console)) else EXIT_BROKEN)
        link = load_profile(profile, profiles)
        if bag is not None and not bag.exists():
            raise ConfigError("no such file or directory", file=str(bag))
        if picture is not None and find_spec("matplotlib") is None:
            raise ConfigError(f"--picture needs matplotlib: {installing('matplotlib')}")
        scenario = Scenario(link, duration or link.duration_s, overload=overload, seed=seed, bag=bag)
        if view is not None:
            asyncio.run(demo_view.look(demo_view.ViewOptions(view, scenario, profiles, out, keep), console))
        options = Options(
            scenario=scenario,
            out=out,
            json_file=json or out / "result.json",
            html_file=html or out / "report.html",
            picture_file=picture,
            baseline=not no_baseline,
            keep=keep,
            profiles=profiles,
            command=command,
            relay_command=program("sern-relay"),
            client_command=program("sern-client"),
        )
        code = asyncio.run(run(options, console))
    except (SernError, OSError) as error:
        Console(stderr=True).print(f"sern demo: {error}", highlight=False, markup=False, soft_wrap=True)
        code = EXIT_ERROR
    except (asyncio.CancelledError, KeyboardInterrupt):
        console.print("interrupted; everything was stopped")
        code = EXIT_INTERRUPTED
    raise typer.Exit(code)
