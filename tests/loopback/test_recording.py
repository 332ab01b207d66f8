"""A recording keeps what was confirmed: real daemons, and a site that is killed without a word."""

import json
from pathlib import Path
from typing import Any

import pytest

from sern_client.endpoints.bag_files import BagFile, McapFile
from sern_core.vocabulary.types import Encoding
from sern_runtime.ros_types import topic_info
from tests.daemons import Lab, Process, bodies

COUNT = 2500
TOPIC = "/robot1/chat"


def delivered(robot: Process) -> int:
    status, text = robot.get("/api/topics")
    topics: dict[str, Any] = json.loads(text) if status == 200 else {}
    return int(topics.get(TOPIC, {}).get("delivered", 0))


def write(path: Path, encoding: Encoding) -> Path:
    """COUNT messages, one a millisecond."""
    file = (BagFile if encoding is Encoding.ROS1 else McapFile)(path)
    info = topic_info("/chat", "std_msgs/msg/String", encoding)
    file.add(info)
    for number in range(COUNT):
        text = f"message {number:05}".encode() + b"\0"
        head = b"" if encoding is Encoding.ROS1 else b"\0\1\0\0"
        file.write(info, 10**18 + number * 10**6, head + len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
async def test_a_killed_site_has_recorded_all_it_confirmed(encoding: Encoding, tmp_path: Path) -> None:
    """Every message is in the file that the killed process left, or in that of the next one: none was confirmed and
    lost."""
    kind = "bag" if encoding is Encoding.ROS1 else "mcap"
    bag = write(tmp_path / f"run.{kind}", encoding)
    sent = bodies(bag)["/chat"]
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay = lab.process(lab.relay_file())
        endpoint = {"kind": "record", "path": f"site.{kind}", "flush_s": 0.1}
        config = lab.client_file("site1", endpoint, client={"namespace": "/"}, subscribe=["/.*"])
        site = lab.process(config)
        await site.said("connected to relay")
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 1}))
        await robot.until(lambda: delivered(robot) > COUNT // 5, "has had a fifth confirmed")
        site.kill()
        confirmed = delivered(robot)
        again = lab.process(config)
        await again.said("connected to relay")
        await robot.until(lambda: delivered(robot) == COUNT, "has had everything confirmed")
        await robot.stop()
        await again.stop()
        assert "was left by a recording that did not finish" in again.text
        await relay.stop()
    left = bodies(tmp_path / f"site.1.{kind}")[TOPIC]
    second = tmp_path / f"site.{kind}"
    rest = bodies(second).get(TOPIC, []) if second.exists() else []  # a slow machine may have had all confirmed before
    assert left == sent[: len(left)] and len(left) >= confirmed
    assert rest == sent[COUNT - len(rest) :] and len(left) + len(rest) >= COUNT
