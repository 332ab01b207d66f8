"""`sern demo-twin`: a robot that follows its plan, a relay and the robot's twin as real processes with keys, over a
link that loses packets and is gone for half a minute.

    robot --> shaping proxy --> relay <-- sern-twin

Both say over HTTP where the robot truly is and where its twin shows it, several times a second. What was promised of
the twin is judged, and written with plots of error and bound over time.
"""

import asyncio
import shlex
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import aiohttp
import typer
from rich.console import Console

from sern_runtime.profiles import load_profile
from sern_sim.profiles import LinkProfile
from sern_sim.robot import Pose2
from sern_tools import demo_twin_report as reporting
from sern_tools.demo_link import LinkProcess
from sern_tools.demo_promises import conclude
from sern_tools.demo_running import (
    START_S,
    cancelled_by_signals,
    get_json,
    is_ready,
    working_directory,
)
from sern_tools.demo_scenario import FAR_HOST, HOST
from sern_tools.demo_twin_report import Sample, TwinReport, judged
from sern_tools.harness.files import Content, client_content, relay_content, write
from sern_tools.harness.processes import Children, program
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports
from sern_tools.shaping import RateSchedule

RELAY, ROBOT, TWIN = "relay", "robot", "twin"
PROFILE: Final = "demo-twin"
SETTLES_S: Final = 3.0
"""After the first pose, before the script begins: the twin learns how late the robot is."""
ERROR_M: Final = 0.04
"""What the twin is told of the robot's localisation: four times its sigma of 1 cm in each axis."""
LOOK_S: Final = 0.1
SAID_S: Final = 1.0
POSE: Final = f"/{ROBOT}/odometry/filtered"
PLAN: Final = f"/{ROBOT}/plan"


@dataclass(frozen=True)
class Options:
    profile: LinkProfile
    profiles: Path | None
    duration_s: float
    seed: int
    plant: str
    out: Path
    keep: bool
    view_port: int | None
    command: str


def contents(options: Options, relay_port: int, web: dict[str, int]) -> dict[str, Content]:
    """The files of the three daemons."""

    def said(name: str) -> Content:
        return {"http": {"listen": f"{HOST}:{web[name]}"}}

    robot = {
        "kind": "synthetic",
        "role": "robot",
        "seed": options.seed,
        "plant": options.plant,
        "follow": True,
        "topics": ["/odometry/filtered"],
        "pose_rate_hz": 20.0,
        "encoding": "cdr",
    }
    twin: dict[str, Any] = {
        "kind": "twin",
        "robots": [{"name": ROBOT, "pose": POSE, "plan": PLAN, "max_speed_mps": 1.5, "error_m": ERROR_M}],
    }
    if options.view_port is not None:
        twin["view"] = {"listen": f"{HOST}:{options.view_port}"}
    rules = [
        {"match": "/odometry/filtered", "class": "control", "reliability": "best_effort"},
        {"match": "/plan", "class": "state", "reliability": "reliable", "durability": "transient_local"},
    ]
    return {
        RELAY: relay_content(
            f"tcp://{HOST}:{relay_port}",
            access=[
                {"client": ROBOT, "publish": ["/{self}/.*"], "subscribe": ["/{self}/cmd_vel"]},
                {"client": TWIN, "publish": ["/twin/.*"], "subscribe": [POSE, PLAN]},
            ],
            **said(RELAY),
        ),
        ROBOT: client_content(ROBOT, f"tcp://{FAR_HOST}:{relay_port}", robot, topics=rules, **said(ROBOT)),
        TWIN: client_content(TWIN, f"tcp://{HOST}:{relay_port}", twin, client={"namespace": "/"}, **said(TWIN)),
    }


class Look:
    """Asks robot and twin at the same moment where the one is, and the other has it."""

    def __init__(self, session: aiohttp.ClientSession, web: dict[str, int]) -> None:
        self._session = session
        self._urls = (f"http://{HOST}:{web[ROBOT]}/api/robot", f"http://{HOST}:{web[TWIN]}/api/twins")

    async def take(self, origin_s: float) -> Sample | None:
        """None: one of them did not answer, or the robot was not heard yet."""
        before_s = time.monotonic()
        truth, twins = await asyncio.gather(*(get_json(self._session, url) for url in self._urls))
        at_s = (before_s + time.monotonic()) / 2 - origin_s
        twin = (twins or {}).get(ROBOT)
        if truth is None or twin is None or twin["pose"] is None:
            return None
        return Sample(
            at_s,
            _at(truth, "pose", twin["now_s"]),
            _at(truth, "thinks", twin["now_s"]),
            tuple(twin["pose"]),
            twin["age_s"],
            twin["error_m"],
            int(twin["snaps"]),
            int(twin["gaps_violated"]),
            twin["goes_by"],
            twin["says"],
        )


def _at(truth: Any, place: str, now_s: float) -> tuple[float, float, float]:
    """Where the robot is, or thinks it is, at the moment of the twin: they do not answer at the same time."""
    since_s = now_s - truth["now_s"]
    moved = Pose2(*truth[place]).moved(truth["speed_mps"] * since_s, truth["yaw_rate_radps"] * since_s)
    return moved.x_m, moved.y_m, moved.yaw_rad


async def measure(options: Options, directory: Path, console: Console) -> list[Sample]:
    """Run it, and what was seen. SernError: something could not run."""
    relay_port, *ports = free_ports(4)
    web = dict(zip((RELAY, ROBOT, TWIN), ports, strict=False))
    make_keys(directory, RELAY, ROBOT, TWIN)
    files = {name: write(directory, name, content) for name, content in contents(options, relay_port, web).items()}
    commands = {RELAY: program("sern-relay"), ROBOT: program("sern-client"), TWIN: program("sern-twin")}
    where = f"the logs are in {directory}" if options.keep else "--keep keeps the logs"
    timeout = aiohttp.ClientTimeout(total=2.0)
    async with aiohttp.ClientSession(timeout=timeout) as session, Children(directory) as children:
        link = await LinkProcess.start(
            children,
            "proxy",
            [relay_port],
            profile=options.profile.name,
            profiles=options.profiles,
            seed=options.seed,
            datagrams=True,
        )
        try:
            for name in (RELAY, TWIN, ROBOT):
                await children.start(name, [*commands[name], "--config", str(files[name])])
                ready = partial(is_ready, session, f"http://{HOST}:{web[name]}")
                await children.until(ready, START_S, f"{name} is not ready ({where})", every_s=0.05)
            look = Look(session, web)

            async def follows() -> bool:
                sample = await look.take(0.0)
                return sample is not None and sample.goes_by == "trajectory"

            await children.until(follows, START_S, f"the twin does not follow the robot's plan ({where})", every_s=0.1)
            await asyncio.sleep(SETTLES_S)
            return await _watch(options, link, children, look, console)
        finally:
            link.close()


async def _watch(options: Options, link: LinkProcess, children: Children, look: Look, console: Console) -> list[Sample]:
    origin_s = time.monotonic()
    await link.ask(do="start", at_s=origin_s)
    samples: list[Sample] = []
    said_s = 0.0
    while (at_s := time.monotonic() - origin_s) < options.duration_s:
        children.check()
        sample = await look.take(origin_s)
        if sample is not None:
            samples.append(sample)
            if at_s >= said_s:
                said_s = at_s + SAID_S
                gone = "link gone" if options.profile.blackout_at(at_s) else "link up"
                console.print(
                    f"{at_s:5.0f} s  {gone:9}  {sample.says};  truly off by {100 * sample.off_m:.1f} cm",
                    highlight=False,
                )
        await asyncio.sleep(max(0.0, origin_s + at_s + LOOK_S - time.monotonic()))
    return samples


async def run(options: Options, console: Console) -> TwinReport:
    """Ctrl-C is asyncio.CancelledError."""
    cancelled_by_signals()
    console.print(f"{options.profile.description}; {options.duration_s:g} s", highlight=False)
    if options.view_port is not None:
        console.print(f"watch it: http://{HOST}:{options.view_port}", highlight=False)
    with working_directory(options.out, "twin", keep=options.keep) as directory:
        samples = await measure(options, directory, console)
        if options.keep:
            console.print(f"kept {directory}", highlight=False, soft_wrap=True)
    schedule = RateSchedule.of(options.profile.up, until_s=options.duration_s)
    return judged(samples, tuple(schedule.blackouts(options.duration_s)), options.duration_s, options.command)


def demo_twin(
    profile: Annotated[str, typer.Option(help="Name of the link profile.")] = PROFILE,
    profiles: Annotated[Path | None, typer.Option(help="File of profiles other than the shipped one.")] = None,
    duration: Annotated[float | None, typer.Option(min=10, help="Seconds; by default what the profile takes.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the robot and of the link's jitter.")] = 1,
    plant: Annotated[
        str, typer.Option(help="What drives: unicycle, or mujoco (pip install 'sern[sim]').")
    ] = "unicycle",
    view: Annotated[int | None, typer.Option(help="Port of the view in the browser (extra viz).")] = None,
    out: Annotated[Path, typer.Option(help="Directory for what the demo leaves behind.")] = Path("demo-out"),
    keep: Annotated[bool, typer.Option("--keep", help="Keep configuration, keys and logs in OUT.")] = False,
) -> None:
    """A robot and its twin over a link that is gone for 30 s: how far off the twin was, and what it said of itself.

    Exit status: 0 every promise kept, 1 one was broken, 2 it could not run, 130 interrupted.
    """

    async def measured(console: Console) -> TwinReport:
        link = load_profile(profile, profiles)
        options = Options(
            profile=link,
            profiles=profiles,
            duration_s=duration or link.duration_s,
            seed=seed,
            plant=plant,
            out=out,
            keep=keep,
            view_port=view,
            command=shlex.join(["sern", *sys.argv[1:]]),
        )
        return await run(options, console)

    conclude("sern demo-twin", measured, reporting.show, lambda report: reporting.write(report, out))
