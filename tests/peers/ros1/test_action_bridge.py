"""Actions of ROS 1 across the link: actionlib's own server at the robot, its own clients at the site."""

import subprocess
from pathlib import Path
from typing import Any, Final

from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import RosLab, need
from tests.support import until

ACTIONLIB: Final = "/usr/lib/python3/dist-packages/actionlib"

SERVER: Final = """
import actionlib, os, rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
rospy.init_node("server", disable_rosout=True)
def count(goal):
    "Counts to the goal, a negative one until it is cancelled."
    os.write(1, b"goal %d\\n" % goal.goal)
    rate = rospy.Rate(50)
    number = 0
    while goal.goal < 0 or number < goal.goal:
        if server.is_preempt_requested():
            os.write(1, b"cancelled %d\\n" % goal.goal)
            server.set_preempted(TestResult(number), "as you wish")
            return
        number += 1
        server.publish_feedback(TestFeedback(number))
        rate.sleep()
    server.set_succeeded(TestResult(number), "counted")
server = actionlib.SimpleActionServer("/count", TestAction, count, auto_start=False)
server.start()
rospy.spin()
"""

CLIENT: Final = """
import actionlib, json, os, rospy, sys
from actionlib.msg import TestAction, TestGoal
rospy.init_node("client", disable_rosout=True)
client = actionlib.ActionClient("/robot1/count", TestAction)
def say(*words):
    os.write(1, json.dumps(words).encode() + b"\\n")
seen = [0]
def changed(goal):
    if goal.get_comm_state() == actionlib.CommState.DONE:
        say("ended", goal.get_terminal_state(), goal.get_result().result, goal.get_goal_status_text())
def feedback(_, message):
    seen[0] += 1
    if seen[0] in (1, 10):
        say("feedback", seen[0])
client.wait_for_action_server_to_start()
say("server")
for line in sys.stdin:
    word, *values = line.split()
    if word == "goal":
        seen[0] = 0
        goal = client.send_goal(TestGoal(int(values[0])), changed, feedback)
    elif word == "cancel":
        goal.cancel()
"""
PREEMPTED, SUCCEEDED, ABORTED, REJECTED = 2, 3, 4, 5


def _endpoint(ros: RosLab) -> dict[str, Any]:
    return {"kind": "ros1", "master_uri": ros.uri, "host": HOST}


class Client:
    """The process of `CLIENT`."""

    def __init__(self, ros: RosLab) -> None:
        self._ros = ros
        self._process = ros.spawn("client", "/usr/bin/python3", "-u", "-c", CLIENT, stdin=subprocess.PIPE)

    def tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")
        self._process.stdin.flush()

    def said(self) -> list[Any]:
        return self._ros.lines("client")

    async def until(self, *words: Any, count: int = 1) -> None:
        await until(lambda: self.said().count(list(words)) >= count, f"the client says {words}: {self.said()}")


async def test_goal_feedback_result_and_cancel_across_a_blackout(tmp_path: Path) -> None:
    need(ACTIONLIB)
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        relay = lab.process(lab.relay_file())
        await relay.ready()
        manual = {"mode": "manual"}
        await lab.connected(
            lab.client_file("robot1", _endpoint(robot_ros), discovery=manual, actions={"offer": [{"match": "/count"}]})
        )
        site = await lab.connected(
            lab.client_file(
                "site", _endpoint(site_ros), discovery=manual, client={"namespace": "/"},
                actions={"use": [{"match": "/robot1/count"}]},
            )
        )  # fmt: skip
        robot_ros.python("server", SERVER)
        client = Client(site_ros)
        await client.until("server")

        client.tell("goal 9")  # at once: the robot's action server connects to us only now
        await client.until("ended", SUCCEEDED, 9, "counted")

        client.tell("goal -1")
        await robot_ros.until_printed("server", "goal -1")
        await client.until("feedback", 10)
        client.tell("cancel")
        await until(lambda: any(line[:2] == ["ended", PREEMPTED] for line in client.said()), "it is cancelled")
        assert "cancelled -1" in robot_ros.printed("server")

        # The link goes away while a goal is under way, and its cancelling waits for it to come back.
        client.tell("goal -2")
        await client.until("feedback", 10, count=2)
        relay.kill()
        await until(lambda: site.core.link.lane.stalled, "the link is lost")
        client.tell("cancel")
        await lab.process(relay.config).ready()
        await robot_ros.until_printed("server", "cancelled -2")
        await until(lambda: [line[:2] for line in client.said()].count(["ended", PREEMPTED]) == 2, "it is cancelled")


async def test_a_goal_that_is_lost_ends_for_its_client_and_never_drives_the_robot(tmp_path: Path) -> None:
    need(ACTIONLIB)
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        relay = lab.process(lab.relay_file())
        await relay.ready()
        manual = {"mode": "manual"}
        robot_file = lab.client_file(
            "robot1", _endpoint(robot_ros), discovery=manual, actions={"offer": [{"match": "/count"}]}
        )
        robot = await lab.connected(robot_file)
        site = await lab.connected(
            lab.client_file(
                "site", _endpoint(site_ros), discovery=manual, client={"namespace": "/"},
                actions={"use": [{"match": "/robot1/count", "timeout_s": 2}]},
            )
        )  # fmt: skip
        assert site.bridge.goals is not None
        robot_ros.python("server", SERVER)
        client = Client(site_ros)
        await client.until("server")
        client.tell("goal -1")
        await client.until("feedback", 10)

        # The link is lost: of a goal under way nothing is heard, a new one is never sent.
        relay.kill()
        await until(lambda: site.core.link.lane.stalled, "the link is lost")
        await until(lambda: [line[:2] for line in client.said()].count(["ended", ABORTED]) == 1, "it is given up")
        client.tell("goal 5")
        await until(lambda: [line[:2] for line in client.said()].count(["ended", REJECTED]) == 1, "it is refused")
        assert any("dropped on its way: lifespan" in str(line[-1]) for line in client.said())
        await lab.process(relay.config).ready()
        await robot_ros.until_printed("server", "cancelled -1")

        # The robot's own client ends.
        client.tell("goal -3")
        await robot_ros.until_printed("server", "goal -3")
        await client.until("feedback", 10, count=2)
        await lab.end(robot)
        await until(lambda: [line[:2] for line in client.said()].count(["ended", ABORTED]) == 2, "it is given up")
        assert site.bridge.goals.reported == 3
        assert "goal 5" not in robot_ros.printed("server")
