"""Commands: the operator's robot moves, and stands still when commands stop, whatever the cause."""

import math
import signal
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.base import Publisher
from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.trace import TraceEvent
from sern_core.vocabulary.types import TopicName
from sern_runtime import ros_types
from tests.daemons import Lab, endpoint_of
from tests.support import until

AFTER_S = 0.5
LIFESPAN_S = 0.3
CLOCK_S = 0.05  # the clocks of two processes are known to each other within this
COMMANDS = TopicName("/cmd_vel")
STILL = (0.0, 0.0)
ROBOT_RULES: list[dict[str, Any]] = [
    {
        "match": "/cmd_vel",
        "class": "control",
        "direction": "receive",
        "lifespan_s": LIFESPAN_S,
        "on_link_loss": {"publish": "zero", "after_s": AFTER_S},
    },
    {"match": "/pose", "class": "control", "direction": "send"},
]
OPERATOR_RULES: list[dict[str, Any]] = [
    {"match": "/robot1/cmd_vel", "class": "control", "direction": "send", "lifespan_s": LIFESPAN_S}
]


class Obeyed(NamedTuple):
    """One command as the robot got it."""

    at_s: float  # monotonic
    age_s: float  # of the wall time at which the operator gave it; about 0 for the stop command
    twist: tuple[float, float]  # forward m/s, left rad/s


class Commands:
    """Everything that is published on the robot's command topic."""

    def __init__(self) -> None:
        self.obeyed: list[Obeyed] = []

    def watch(self, robot: ClientDaemon) -> None:
        endpoint = robot.site.endpoint
        advertise = endpoint.advertise

        def watched(info: TopicInfo) -> Publisher:
            publisher = advertise(info)
            if info.name == COMMANDS:
                publish = publisher.publish

                def noted(body: bytes, stamp_ns: int) -> None:
                    at_s, age_s = time.monotonic(), (time.time_ns() - stamp_ns) / 1e9  # before what takes time
                    twist = ros_types.deserialise(body, info.type_name, info.encoding)
                    self.obeyed.append(Obeyed(at_s, age_s, (twist.linear.x, twist.angular.z)))
                    publish(body, stamp_ns)

                publisher.publish = noted  # type: ignore[method-assign]
            return publisher

        endpoint.advertise = watched  # type: ignore[method-assign]

    @property
    def moving(self) -> list[Obeyed]:
        return [command for command in self.obeyed if command.twist != STILL]

    def after(self, at_s: float) -> list[Obeyed]:
        return [command for command in self.obeyed if command.at_s > at_s]


RAMP: dict[str, Any] = {"publish": "ramp", "after_s": AFTER_S, "linear_mps2": 1.0, "angular_radps2": 1.0}
RAMP_RULES: list[dict[str, Any]] = [{**ROBOT_RULES[0], "on_link_loss": RAMP}, *ROBOT_RULES[1:]]


def robot_file(lab: Lab, rules: list[dict[str, Any]] = ROBOT_RULES) -> Path:
    endpoint = {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}
    return lab.client_file("robot1", endpoint, topics=rules, discovery={"mode": "manual"})


def operator_file(lab: Lab) -> Path:
    endpoint = {"kind": "synthetic", "role": "operator", "command_topic": "/robot1/cmd_vel", "command_rate_hz": 20}
    return lab.client_file(
        "site", endpoint, client={"namespace": "/"}, topics=OPERATOR_RULES, subscribe=["/robot1/pose"]
    )


def check_stop(commands: Commands) -> None:
    """After the last command the robot was told to stand, not before its time, again at 10 Hz for a second, and then no
    more."""
    last = commands.moving[-1]
    stops = commands.after(last.at_s)
    assert [stop.twist for stop in stops] == [STILL] * len(stops)
    # The lease counts from the birth of the command.
    assert stops[0].at_s - (last.at_s - last.age_s) >= AFTER_S - CLOCK_S
    assert 2 <= len(stops) <= 11
    assert stops[-1].at_s - stops[0].at_s >= 0.9


async def driven(robot: ClientDaemon, commands: Commands) -> int:
    """Wait until the robot is being driven; how often its lease has run out so far, as it does on a busy machine."""
    await until(lambda: len(commands.moving) > 10 and commands.obeyed[-1].twist != STILL, "the robot is driven")
    return robot.bridge.inbound.commands.leases_fired


async def stood(robot: ClientDaemon, commands: Commands, fired: int) -> None:
    """Wait until the lease has run out once more than `fired` times, and said all it has to say."""
    await until(lambda: robot.bridge.inbound.commands.leases_fired > fired and commands.obeyed[-1].twist == STILL)
    await until(lambda: robot.bridge.inbound.commands.due_s is None, "the stop command has been repeated")
    told = {record.event for record in robot.core.trace.records(TopicName("/robot1/cmd_vel"))}
    assert TraceEvent.LEASE_EXPIRED in told and TraceEvent.DELIVERED in told


async def test_the_operator_drives_the_robot_and_sees_it_move(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.connected(robot_file(lab))
        site = await lab.connected(operator_file(lab))
        operator: SyntheticEndpoint = endpoint_of(site, SyntheticEndpoint)
        simulated: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        await until(lambda: operator.latest("/robot1/pose") is not None)
        start = operator.latest("/robot1/pose").pose.position
        assert simulated.state().speed_mps == 0.0 or simulated.received("/cmd_vel") is not None

        def moved_m() -> float:
            here = operator.latest("/robot1/pose").pose.position
            return math.hypot(here.x - start.x, here.y - start.y)

        await until(lambda: moved_m() > 0.2, "the operator sees the robot move")
        received = simulated.received("/cmd_vel")
        assert received is not None and received.count > 0
        assert simulated.counters.bad_commands == 0
        for daemon in (site, robot, relay):
            await lab.end(daemon)


async def test_a_killed_operator_leaves_a_robot_that_stands(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    commands = Commands()
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.client(robot_file(lab), commands.watch)
        site = lab.process(operator_file(lab))
        fired = await driven(robot, commands)
        site.kill()
        await stood(robot, commands, fired)
        check_stop(commands)
        assert "/cmd_vel: no fresh command; publishing the stop command" in caplog.messages
        simulated: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        await until(lambda: simulated.state().speed_mps == 0.0, "the robot stands")
        count = len(commands.obeyed)
        # Nothing more comes, and a new operator takes over.
        site = lab.process(site.config)
        await until(lambda: len(commands.obeyed) > count)
        assert commands.obeyed[count].twist != STILL
        await site.stop()
        await lab.end(robot)
        await lab.end(relay)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
async def test_a_robot_with_a_ramp_is_slowed_down_whether_its_operator_is_killed_or_leaves(
    tmp_path: Path, number: signal.Signals, caplog: pytest.LogCaptureFixture
) -> None:
    commands = Commands()
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.client(robot_file(lab, RAMP_RULES), commands.watch)
        site = lab.process(operator_file(lab))
        await driven(robot, commands)
        at_s = time.monotonic()
        site.signal(number)
        await site.ended()
        inbound = robot.bridge.inbound
        await until(lambda: commands.obeyed[-1].twist == STILL and inbound.commands.due_s is None, "the robot stands")
        assert "/cmd_vel: no fresh command; slowing the robot down" in caplog.messages
        # The operator drives at one speed: what is slower is said by the robot's own client.
        speeds = [command.twist[0] for command in commands.after(at_s)]
        assert speeds == sorted(speeds, reverse=True) and len(set(speeds)) > 3
        assert speeds.count(0.0) == 1, "one zero"
        await lab.end(robot)
        await lab.end(relay)


async def test_commands_that_were_held_up_are_never_obeyed(tmp_path: Path) -> None:
    commands = Commands()
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.client(robot_file(lab), commands.watch)
        site = await lab.connected(operator_file(lab))
        for _holdup in (1, 2):
            fired = await driven(robot, commands)
            relay.signal(signal.SIGSTOP)  # nothing gets through, and no connection breaks
            await stood(robot, commands, fired)
            check_stop(commands)
            resumed_s = time.monotonic()
            relay.signal(signal.SIGCONT)
            await until(lambda at_s=resumed_s: len(commands.after(at_s)) > 5)  # type: ignore[misc]
        assert max(command.age_s for command in commands.moving) <= LIFESPAN_S + CLOCK_S
        assert site.core.link.established and robot.core.link.established
        await lab.end(site)
        await lab.end(robot)
        await relay.stop()


async def test_a_robot_whose_client_stops_is_told_to_stand(tmp_path: Path) -> None:
    commands = Commands()
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.client(robot_file(lab), commands.watch)
        site = await lab.connected(operator_file(lab))
        await until(lambda: len(commands.moving) > 5)
        await lab.end(robot)
        assert commands.obeyed[-1].twist == STILL
        await lab.end(site)
        await lab.end(relay)
