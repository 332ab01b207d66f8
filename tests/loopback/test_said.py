"""What the daemons say to their operator: in the log, in /readyz and in the status, and that it is so."""

from pathlib import Path

import pytest

from sern_core.message import TopicInfo
from sern_core.types import Encoding, TopicName
from tests.daemons import Lab, write_bag

CHAT = ({"match": "/chat", "class": "state", "reliability": "reliable"},)


async def test_a_topic_that_no_rule_names_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    bag = write_bag(tmp_path / "a.bag", {"/chat": 3, "/chta": 3, "/denied": 3})
    discovery = {"mode": "manual", "deny": ["/denied"]}
    async with Lab(tmp_path, "robot1") as lab:
        await lab.relay()
        play = {"loop": True, "wait_for": []}
        robot = await lab.connected(lab.player_file("robot1", bag, play=play, topics=list(CHAT), discovery=discovery))
        again = TopicInfo(TopicName("/chta"), "std_msgs/msg/String", Encoding.ROS1)
        robot.bridge.topic_removed(again.name)  # a node that comes and goes is no news
        robot.bridge.topic_added(again)
        said = [message for message in caplog.messages if "stays here" in message]
        assert said == ["/chta (std_msgs/msg/String) stays here: no rule in `topics` names it (discovery.mode: manual)"]
