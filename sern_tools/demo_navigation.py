"""`sern demo-navigation`: a robot crosses a campus three times: by its own sensors, by its twin alone, and by both.

    jackal, sern-navigation, sern-client --> shaping proxy --> relay <-- sern-twin, sern-client, an operator

All are real processes with keys; robot and operator have a ROS 2 graph (DDS) each. The operator's goal is the action
navigate_to_pose, which crosses the link, and the link is gone for a while on the way. What the twin has wrong, logs
that nobody laid there, only the robot's own sensors can tell.
"""

import asyncio
import math
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

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.endpoints import installing
from sern_runtime.profiles import load_profile
from sern_sim.profiles import LinkProfile
from sern_tools import demo_navigation_report as reporting
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
from sern_tools.harness.files import Content, client_content, relay_content, write
from sern_tools.harness.processes import Children, program, python
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports
from sern_tools.shaping import RateSchedule

RELAY, ROBOT, TWIN, SITE, JACKAL, NAVIGATION = "relay", "robot", "twin", "site", "jackal", "navigation"
DAEMONS: Final = (RELAY, TWIN, SITE, ROBOT, NAVIGATION)
PROFILE: Final = "demo-navigation"
REAL_ONLY, SIM_ONLY, SERN = "Real Only", "Sim Only", "SERN"
MODES: Final = (REAL_ONLY, SIM_ONLY, SERN)
DOMAINS: Final = (111, 112)
"""ROS_DOMAIN_ID of the robot's graph and of the operator's."""
LOOK_S: Final = 0.2
SAID_S: Final = 5.0
MOST_S: Final = 240.0
ACTION: Final = f"/{ROBOT}/navigate_to_pose"
TWIN_MAP: Final = "/twin/scene/map"


@dataclass(frozen=True)
class Options:
    profile: LinkProfile
    profiles: Path | None
    seed: int
    dem: Path | None
    streets: Path | None
    modes: tuple[str, ...]
    out: Path
    keep: bool
    view_port: int | None
    command: str


def contents(options: Options, mode: str, relay_port: int, web: dict[str, int], plane: Any) -> dict[str, Content]:
    """The files of all daemons for one of the three ways."""

    def said(name: str) -> Content:
        return {"http": {"listen": f"{HOST}:{web[name]}"}}

    def graph(domain: int) -> Content:
        return {"kind": "dds", "domain": domain, "localhost_only": True}

    grid: Content = {"west_m": -20, "south_m": -20, "width_m": 40, "length_m": 40, "frame_id": "odom"}
    scene: Content = {"name": "campus", **grid}
    origin = {"latitude_deg": math.degrees(plane.latitude_rad), "longitude_deg": math.degrees(plane.longitude_rad)}
    scanner = {"scan": "/obstacle_scan", "pose": "/odometry/filtered", "pose_error_m": 0.05}
    twin: Content = {
        "kind": "twin",
        "robots": [
            {"name": ROBOT, "pose": f"/{ROBOT}/odometry/filtered", "plan": f"/{ROBOT}/plan", "max_speed_mps": 1.0}
        ],
    }
    if options.view_port is not None:
        twin["view"] = {"listen": f"{HOST}:{options.view_port}"}
    own = [
        {"match": "/odometry/filtered", "class": "control", "max_rate_hz": 20},
        {"match": "/plan", "class": "state", "reliability": "reliable", "durability": "transient_local"},
        {"match": "/navigation/status", "class": "state"},
    ]
    heard = ["/twin/scene/.*"]
    navigation: Content = {
        "endpoint": graph(DOMAINS[0]),
        "grid": grid,
        "lidar": {"z_m": 0.4},
        "yaw_scale": 0.34,
        "topics": {"link": "/sern/link"},
        "seed": options.seed,
        **said(NAVIGATION),
    }
    robot: Content = {
        "topics": own,
        "subscribe": heard,
        "actions": {"offer": [{"match": "/navigate_to_pose", "timeout_s": 900}]},
        **said(ROBOT),
    }
    if mode == SIM_ONLY:  # the twin's map is the world, and nothing is marked but what would be hit
        navigation["topics"]["map"] = TWIN_MAP
        navigation["obstacle_layer"] = {
            "obstacle_max_range": 1e-6, "raytrace_max_range": 1e-6, "footprint_clearing_enabled": False,
        }  # fmt: skip
    if mode == SERN:
        navigation["topics"]["twin"] = TWIN_MAP
        # Unknown ground is dear as well: by default a wall of the twin is worth a detour of five metres over it.
        navigation["planner"] = {"twin_travel_multiplier": 120.0}
        robot["scene"] = {**scene, "scanners": [scanner]}
    shared = ["/scene/.*"]
    return {
        RELAY: relay_content(
            f"tcp://{HOST}:{relay_port}",
            access=[
                {"client": ROBOT, "publish": ["/{self}/.*", *shared], "subscribe": [*heard, *shared, "/{self}/.*"]},
                {"client": TWIN, "publish": ["/twin/.*", *shared], "subscribe": [f"/{ROBOT}/.*", *shared]},
                {"client": SITE, "publish": [f"{ACTION}/.*", *shared], "subscribe": [f"/{ROBOT}/.*", *shared]},
            ],
            **said(RELAY),
        ),
        ROBOT: client_content(ROBOT, f"tcp://{FAR_HOST}:{relay_port}", graph(DOMAINS[0]), **robot),
        TWIN: client_content(
            TWIN, f"tcp://{HOST}:{relay_port}", twin, client={"namespace": "/"},
            scene={**scene, "base": "campus.geojson", "origin": origin}, **said(TWIN),
        ),
        SITE: client_content(
            SITE, f"tcp://{HOST}:{relay_port}", graph(DOMAINS[1]), client={"namespace": "/"},
            scene={**scene, "obstacles": "/scene/add"},
            actions={"use": [{"match": ACTION, "timeout_s": 900}]}, **said(SITE),
        ),
        NAVIGATION: navigation,
    }  # fmt: skip


async def drive(options: Options, mode: str, directory: Path, console: Console) -> reporting.Drive:
    """One of the three ways, from new processes to their end. SernError: something could not run."""
    from sern_tools.demo_campus import GOAL_M, campus
    from sern_tools.demo_operator import Operator

    place = campus(options.seed, options.dem, options.streets)
    folder = directory / mode.lower().replace(" ", "-")
    folder.mkdir()
    (folder / "campus.geojson").write_text(place.base_map())
    relay_port, *ports = free_ports(7)
    web = dict(zip((*DAEMONS, JACKAL), ports, strict=True))
    make_keys(folder, RELAY, ROBOT, TWIN, SITE)
    made = contents(options, mode, relay_port, web, place.plane)
    files = {name: write(folder, name, content) for name, content in made.items()}
    where = f"the logs are in {folder}" if options.keep else "--keep keeps the logs"
    timeout = aiohttp.ClientTimeout(total=2.0)
    operator = Operator(DOMAINS[1], ACTION)
    async with aiohttp.ClientSession(timeout=timeout) as session, Children(folder) as children:
        link = await LinkProcess.start(
            children, "proxy", [relay_port], profile=options.profile.name, profiles=options.profiles,
            seed=options.seed, datagrams=True,
        )  # fmt: skip
        try:
            await children.start(JACKAL, _jackal(options, web[JACKAL]))
            for name in DAEMONS:
                kind = {RELAY: "relay", TWIN: "twin", NAVIGATION: "navigation"}.get(name, "client")
                await children.start(name, [*program(f"sern-{kind}"), "--config", str(files[name])])
                ready = partial(is_ready, session, f"http://{HOST}:{web[name]}")
                await children.until(ready, START_S, f"{name} is not ready ({where})", every_s=0.1)
            await operator.start()
            for each in place.added():
                operator.add(*each)

            async def knows() -> bool:
                return await _knows(session, web, mode)

            await children.until(knows, START_S, f"the robot does not have the twin's map ({where})", every_s=0.2)
            await children.within(operator.served(), START_S, f"{ACTION} is not offered at the site ({where})")
            result = asyncio.create_task(operator.navigate(*GOAL_M, timeout_s=options.profile.duration_s))
            try:
                return await _watch(options, mode, link, children, session, web, result, console)
            finally:
                result.cancel()
                await asyncio.gather(result, return_exceptions=True)
        finally:
            await operator.stop()
            link.close()


def _jackal(options: Options, port: int) -> list[str]:
    command = python("-m", "sern_tools.demo_jackal", "--domain", str(DOMAINS[0]), "--port", str(port))
    command += ["--seed", str(options.seed)]
    for flag, path in (("--dem", options.dem), ("--streets", options.streets)):
        if path is not None:
            command += [flag, str(path.resolve())]
    return command


async def _knows(session: aiohttp.ClientSession, web: dict[str, int], mode: str) -> bool:
    """Whether what was added to the twin has arrived where it is needed."""
    twin = await get_json(session, f"http://{HOST}:{web[TWIN]}/api/scene") or {}
    navigation = await get_json(session, f"http://{HOST}:{web[NAVIGATION]}/api/navigation") or {}
    added = twin.get("occupied_cells", 0) > 0 and bool(twin.get("added_cells", 0))
    return added and (mode != SERN or navigation.get("twin_age_s") is not None)


async def _watch(
    options: Options,
    mode: str,
    link: LinkProcess,
    children: Children,
    session: aiohttp.ClientSession,
    web: dict[str, int],
    result: "asyncio.Task[reporting.Ended]",
    console: Console,
) -> reporting.Drive:
    origin_s = time.monotonic()
    await link.ask(do="start", at_s=origin_s)
    places: list[reporting.Place] = []
    said_s = 0.0
    touched, travelled_m = 0, 0.0
    flagged: dict[str, Any] = {}
    while (at_s := time.monotonic() - origin_s) < options.profile.duration_s and not result.done():
        children.check()
        robot, navigation, scene = await asyncio.gather(
            get_json(session, f"http://{HOST}:{web[JACKAL]}/api/robot"),
            get_json(session, f"http://{HOST}:{web[NAVIGATION]}/api/navigation"),
            get_json(session, f"http://{HOST}:{web[TWIN]}/api/scene"),
        )
        for each in (scene or {}).get("discrepancies", ()):
            flagged.setdefault(each["id"], {**each, "at_s": at_s})
        if robot is not None:
            touched, travelled_m = robot["touched"], robot["travelled_m"]
            state = (navigation or {}).get("state", "")
            places.append(reporting.Place(at_s, robot["pose"][0], robot["pose"][1], state))
            if at_s >= said_s:
                said_s = at_s + SAID_S
                gone = "link gone" if options.profile.blackout_at(at_s) else "link up"
                console.print(
                    f"{mode:9} {at_s:4.0f} s  {gone:9}  ({robot['pose'][0]:6.1f}, {robot['pose'][1]:6.1f})  "
                    f"{': '.join(filter(None, (state, (navigation or {}).get('message'))))}",
                    highlight=False,
                )
        await asyncio.sleep(max(0.0, origin_s + at_s + LOOK_S - time.monotonic()))
    took_s = time.monotonic() - origin_s
    navigation = await get_json(session, f"http://{HOST}:{web[NAVIGATION]}/api/navigation") or {}
    if result.done():
        ended = result.result()
    else:
        ended = reporting.Ended("no result", f"after {took_s:.0f} s: {navigation.get('message') or 'still driving'}")
    return reporting.Drive(
        mode, ended, took_s, tuple(places), touched, travelled_m, int(navigation.get("recoveries", 0)),
        navigation.get("cycle_p99_ms"), tuple(flagged.values()),
    )  # fmt: skip


async def run(options: Options, console: Console) -> reporting.NavigationReport:
    """Ctrl-C is asyncio.CancelledError."""
    from sern_tools.demo_campus import campus

    cancelled_by_signals()
    place = campus(options.seed, options.dem, options.streets)
    for note in (options.profile.description, *place.notes):
        console.print(note, highlight=False)
    if options.view_port is not None:
        console.print(f"watch it: http://{HOST}:{options.view_port}", highlight=False)
    drives = []
    with working_directory(options.out, "navigation", keep=options.keep) as directory:
        for mode in options.modes:
            drives.append(await drive(options, mode, directory, console))
            console.print(f"{mode}: {drives[-1].words}", highlight=False)
        if options.keep:
            console.print(f"kept {directory}", highlight=False, soft_wrap=True)
    schedule = RateSchedule.of(options.profile.up, until_s=options.profile.duration_s)
    gone = tuple(schedule.blackouts(options.profile.duration_s))
    return reporting.judged(tuple(drives), place, gone, options.command)


def demo_navigation(
    profile: Annotated[str, typer.Option(help="Name of the link profile.")] = PROFILE,
    profiles: Annotated[Path | None, typer.Option(help="File of profiles other than the shipped one.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the place, the robot and the link's jitter.")] = 1,
    dem: Annotated[Path | None, typer.Option(help="Elevation model whose ground is taken (extra geo).")] = None,
    streets: Annotated[Path | None, typer.Option(help="Map (.osm) whose buildings are taken (extra geo).")] = None,
    mode: Annotated[str | None, typer.Option(help="One of the three alone: 'Real Only', 'Sim Only', 'SERN'.")] = None,
    view: Annotated[int | None, typer.Option(help="Port of the view in the browser (extra viz).")] = None,
    out: Annotated[Path, typer.Option(help="Directory for what the demo leaves behind.")] = Path("demo-out"),
    keep: Annotated[bool, typer.Option("--keep", help="Keep configuration, keys and logs in OUT.")] = False,
) -> None:
    """A robot crosses a campus by its own sensors, by its twin alone, and by both; ends with a picture of its ways.

    Needs the extras twin, geo, sim and dds. Exit status: 0 every promise kept, 1 one was broken, 2 it could not run,
    130 interrupted.
    """

    async def driven(console: Console) -> reporting.NavigationReport:
        if mode is not None and mode not in MODES:
            raise ConfigError(f"--mode {mode!r} is none of {', '.join(map(repr, MODES))}")
        options = Options(
            profile=load_profile(profile, profiles),
            profiles=profiles,
            seed=seed,
            dem=dem,
            streets=streets,
            modes=MODES if mode is None else (mode,),
            out=out,
            keep=keep,
            view_port=view,
            command=shlex.join(["sern", *sys.argv[1:]]),
        )
        return await run(options, console)

    conclude(
        "sern demo-navigation", driven, reporting.show, lambda report: reporting.write(report, out),
        packages=installing("'sern[twin,geo,sim,dds]'"),
    )  # fmt: skip
