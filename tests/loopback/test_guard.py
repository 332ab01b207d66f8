"""The guard: a robot is told to stand although its client is held up, stopped or killed. Real processes and TCPROS."""

import os
import re
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from sern_client.endpoints.ros1 import Ros1Endpoint
from sern_client.endpoints.ros1.subscription import Source
from sern_client.guard import Guard
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.config.client import load_client
from tests.daemons import HOST, Lab, Process
from tests.loopback.test_commands import OPERATOR_RULES, RAMP_RULES, ROBOT_RULES, STILL
from tests.sern_client.endpoints.ros1.fakes import FakeMaster, running
from tests.support import Events, until

HELD_S: Final = 3.0
TWIST: Final = "geometry_msgs/msg/Twist"
CLIENT: Final = f"""
import ctypes, signal, sys
from sern_client.cli import main
from sern_runtime import clock

def hold(number, frame):
    "Calls into C that keep the interpreter's lock: no other thread of this process runs. Any signal ends one of them."
    sys.setswitchinterval({2 * HELD_S})
    began = clock.now()
    while (left_s := began + {HELD_S} - clock.now()) > 0:
        ctypes.PyDLL(None).usleep(int(left_s * 1e6) + 1)
    sys.setswitchinterval(0.005)
    print("held", began, clock.now(), file=sys.stderr, flush=True)

signal.signal(signal.SIGUSR1, hold)
sys.argv = ["sern-client", *sys.argv[-2:]]
main()
"""


class Told(NamedTuple):
    at_s: float
    moves: bool
    forward_mps: float


class Robot:
    """What a node of the robot's master gets on /cmd_vel, from whomever."""

    def __init__(self) -> None:
        self.told: list[Told] = []

    def listen(self, endpoint: Ros1Endpoint, events: Events) -> None:
        """Once somebody publishes it."""
        assert TopicName("/cmd_vel") in events.infos
        endpoint.subscribe(TopicName("/cmd_vel"), self._heard)

    def _heard(self, body: bytes, _stamp_ns: int) -> bool:
        twist = ros_types.deserialise(body, TWIST, Encoding.ROS1)
        self.told.append(Told(clock.now(), (twist.linear.x, twist.angular.z) != STILL, twist.linear.x))
        return True

    def moving(self, after_s: float = 0.0) -> list[Told]:
        return [told for told in self.told if told.moves and told.at_s > after_s]

    def stops(self, after_s: float) -> list[Told]:
        return [told for told in self.told if not told.moves and told.at_s > after_s]


class Scene(NamedTuple):
    lab: Lab
    master: FakeMaster
    robot: Robot
    client: Process
    operator: Process
    sources: dict[str, Source]


@asynccontextmanager
async def driving(tmp_path: Path, rules: list[dict[str, Any]] = ROBOT_RULES) -> AsyncIterator[Scene]:
    """A robot with a ROS 1 master that is being driven, and its guard is at the master too."""
    master, robot = FakeMaster(), Robot()
    await master.start()
    script = tmp_path / "client.py"
    script.write_text(CLIENT)
    try:
        async with (
            running(master, "driver", accept_bridged=True) as (driver, events),
            Lab(tmp_path, "robot1", "site") as lab,
        ):
            endpoint = {"kind": "ros1", "master_uri": master.uri, "host": HOST, "poll_hz": 20}
            file = lab.client_file("robot1", endpoint, topics=rules, discovery={"mode": "manual"})
            await lab.relay()
            client = lab.process(file, before=[sys.executable, str(script)])
            where = {"kind": "synthetic", "role": "operator", "command_topic": "/robot1/cmd_vel", "command_rate_hz": 20}
            operator = lab.process(lab.client_file("site", where, client={"namespace": "/"}, topics=OPERATOR_RULES))
            await until(lambda: TopicName("/cmd_vel") in events.infos)
            robot.listen(driver, events)
            await until(lambda: publishers(master) == {"/sern_robot1", "/sern_robot1_guard"})
            scene = Scene(lab, master, robot, client, operator, driver._topics["/cmd_vel"].sources)
            await until(lambda: len(robot.moving()) > 10 and driven(scene), "it is driven")
            yield scene
    finally:
        await master.stop()


def driven(scene: Scene) -> bool:
    """Whether the robot is connected to the client and to its guard, and moves: then a lease runs that can end."""
    links = [source.link for source in scene.sources.values()]
    return len(links) == 2 and all(link is not None and link.open for link in links) and scene.robot.told[-1].moves


def publishers(master: FakeMaster) -> set[str]:
    return set(master.tables[0].get("/cmd_vel", ()))


async def test_the_robot_stands_while_its_client_is_held_up(tmp_path: Path) -> None:
    async with driving(tmp_path) as scene:
        robot, client = scene.robot, scene.client
        asked_s = clock.now()
        client.signal(signal.SIGUSR1)
        await until(lambda: any(line.startswith("held ") for line in client.lines), "the client goes on")
        began_s, ended_s = map(float, next(line for line in client.lines if line.startswith("held ")).split()[1:])
        assert began_s >= asked_s and ended_s - began_s >= HELD_S
        await until(lambda: robot.moving(ended_s), "fresh commands are obeyed again")
        last_s = max(told.at_s for told in robot.moving() if told.at_s < began_s + 1.0)
        stops = [told.at_s for told in robot.stops(last_s) if told.at_s < ended_s]
        assert stops, "nobody told the robot to stand while the client was held up"
        assert len(stops) <= 11, "the stop command is repeated at 10 Hz for a second, and then no more"
        assert "/cmd_vel: the client does not answer; publishing the stop command" in client.text
        await client.until(lambda: guard_counts(client, "stops") >= 1, "has counted it")
        await scene.operator.stop()
        await client.stop()
        await until(lambda: publishers(scene.master) == set(), "the guard has left with its client")


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
async def test_the_robot_stands_when_its_client_is_no_more(tmp_path: Path, number: signal.Signals) -> None:
    async with driving(tmp_path) as scene:
        robot, client = scene.robot, scene.client
        client.signal(number)
        at_s = clock.now()
        await until(lambda: robot.stops(at_s), "the robot is told to stand")
        if number == signal.SIGKILL:
            await until(lambda: publishers(scene.master) == {"/sern_robot1"}, "the guard ends; the dead stay listed")
            assert "/cmd_vel: the client has ended; publishing the stop command" in client.text
        else:
            client.signal(signal.SIGCONT)
            resumed_s = clock.now()
            await until(lambda: robot.moving(resumed_s))
            await client.stop()
        await scene.operator.stop()


async def test_a_robot_with_a_ramp_is_slowed_down_by_the_guard_of_a_client_that_was_killed(tmp_path: Path) -> None:
    async with driving(tmp_path, RAMP_RULES) as scene:
        robot, client = scene.robot, scene.client
        client.kill()
        at_s = clock.now()
        await until(lambda: robot.stops(at_s), "the robot stands")
        assert "/cmd_vel: the client has ended; slowing the robot down" in client.text
        speeds = [told.forward_mps for told in robot.told if told.at_s > at_s]
        assert len(speeds) > 2 and speeds == sorted(speeds, reverse=True) and speeds.count(0.0) == 1
        await until(lambda: publishers(scene.master) == {"/sern_robot1"}, "the guard ends; the dead stay listed")
        await scene.operator.stop()


async def test_a_guard_that_was_killed_is_started_again_and_knows_what_it_guards(tmp_path: Path) -> None:
    async with driving(tmp_path) as scene:
        robot, client = scene.robot, scene.client
        await until(lambda: guards(client), "the client has heard of its guard")
        (first,) = guards(client)
        os.kill(first, signal.SIGKILL)
        await client.said("the guard of the command topics has ended (exit code -9)")
        await until(lambda: len(guards(client)) == 2, "another one runs")
        await client.said("ERROR", "the guard of the command topics runs again as process ", ", after ")
        await until(lambda: driven(scene), "the robot has found the second guard")
        client.signal(signal.SIGSTOP)
        at_s = clock.now()
        await until(lambda: robot.stops(at_s), "the second guard tells the robot to stand")
        client.signal(signal.SIGCONT)
        await client.until(lambda: guard_counts(client, "restarts") == 1, "has counted the restart")
        await scene.operator.stop()
        await client.stop()


def guard_counts(client: Process, what: str) -> float:
    """A counter of its guard; 0 while the client does not tell."""
    words = f"sern_command_guard_{what}_total "
    return sum(
        float(line.removeprefix(words)) for line in client.get("/metrics")[1].splitlines() if line.startswith(words)
    )


def guards(client: Process) -> list[int]:
    """The processes that were its guards, the latest last."""
    words = re.compile(r"the guard of the command topics runs (?:again )?as process (\d+)")
    return [int(found[1]) for line in client.lines if (found := words.search(line))]


def test_only_a_client_that_drives_a_robot_has_a_guard(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "robot1")
    here: dict[str, Any] = {"kind": "ros1", "master_uri": "http://127.0.0.1:11311"}
    simulated: dict[str, Any] = {"kind": "synthetic", "role": "robot"}

    def guard(endpoint: object, topics: list[dict[str, Any]]) -> Guard | None:
        return Guard.of(load_client(lab.client_file("robot1", endpoint, topics=topics)))

    assert guard(here, ROBOT_RULES) is not None
    assert guard([here, simulated], ROBOT_RULES) is not None
    assert guard(here, ROBOT_RULES[1:]) is None, "no lease"
    assert guard(simulated, ROBOT_RULES) is None, "its robot is in this process"
