"""An e-stop over real daemons: the robot stands, whoever drives, until it is released by name."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import pytest

from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import DropReason, Encoding, PriorityClass, TopicName
from sern_runtime import clock, ros_types
from tests.daemons import Lab
from tests.loopback.test_commands import RAMP_RULES, STILL, Commands, operator_file
from tests.support import until
from tests.world import spec

STOP: Final = TopicName("/robot1/e_stop")
BOOL: Final = "std_msgs/msg/Bool"
RULES: Final[list[dict[str, Any]]] = [
    {"match": "/e_stop", "class": "control", "direction": "receive", "reliability": "reliable", "e_stop": {}},
    *RAMP_RULES,
]


def robot_file(lab: Lab, directory: str) -> Path:
    endpoint = {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}
    local = {"socket": f"{directory}/robot1.sock"}
    return lab.client_file("robot1", endpoint, topics=RULES, discovery={"mode": "manual"}, local=local)


async def test_it_latches_survives_a_restart_and_is_released_by_name_from_afar(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with TemporaryDirectory(prefix="sern-", dir="/tmp") as directory:
        async with Lab(tmp_path, "robot1", "site") as lab:
            relay = await lab.relay()
            commands = Commands()
            robot = await lab.client(robot_file(lab, directory), commands.watch)
            site = await lab.connected(operator_file(lab))
            await until(lambda: len(commands.moving) > 5, "it is driven")
            # A node at the operator's site says stop.
            info = ros_types.topic_info(STOP, BOOL, Encoding.CDR, reliable=True)
            stop = ros_types.serialise(ros_types.new(BOOL, Encoding.CDR, data=True), BOOL, Encoding.CDR)
            channel = site.core.publish(info, spec(PriorityClass.CONTROL, reliable=True), now=clock.now())
            site.core.send(channel, stop, 0, now=clock.now())
            site.connection.wake()
            await until(lambda: TopicName("/e_stop") in robot.e_stops.latched, "it is latched")
            assert commands.obeyed[-1].twist == STILL
            counted = robot.core.received.topics[TopicName("/robot1/cmd_vel")]
            await until(lambda: counted.by_reason[DropReason.E_STOP] > 5, "commands are refused, and counted")
            assert commands.obeyed[-1].twist == STILL
            # The robot's client is started anew, and the operator still drives.
            await lab.end(robot)
            again = Commands()
            robot = await lab.client(robot_file(lab, directory), again.watch)
            counted_again = robot.core.received.topics
            topic = TopicName("/robot1/cmd_vel")
            await until(lambda: topic in counted_again and counted_again[topic].by_reason[DropReason.E_STOP] > 5)
            assert again.moving == []
            # Its operator releases it by name.
            with pytest.raises(SernError, match="nobody takes /robot1/arm_stop/release: is its site there"):
                await site.operating.answer({"do": "release", "topic": "/robot1/arm_stop"})
            answer = await site.operating.answer({"do": "release", "topic": STOP})
            assert answer["at"] == "its site"
            await until(lambda: len(again.moving) > 5, "it is driven again")
            assert robot.e_stops.latched == {}
            assert "/e_stop: released by site" in caplog.messages
            # And once more, at the robot itself.
            site.core.send(channel, stop, 0, now=clock.now())
            site.connection.wake()
            await until(lambda: bool(robot.e_stops.latched))
            await robot.operating.answer({"do": "release", "topic": "/e_stop"})
            assert robot.e_stops.latched == {}
            for daemon in (site, robot, relay):
                await lab.end(daemon)
