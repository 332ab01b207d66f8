"""Actions of one ROS given to servers of the other across the link: actionlib itself, and real nodes of ROS 2."""

import asyncio
import struct
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import NO_STAMP, GoalInfo
from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.types import TopicName
from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import PACKAGES, RosLab, need
from tests.peers.ros2.sourced import RosNode, RosNodes, before, sourced
from tests.sern_client.action_conversion.files import NAVIGATE, folder
from tests.support import DEADLINE_S, Events, until

ACTIONLIB: Final = "/usr/lib/python3/dist-packages/actionlib"
MOVE_BASE: Final = "/usr/lib/python3/dist-packages/move_base_msgs"
PACKAGES[MOVE_BASE] = "python3-move-base-msgs"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
MANUAL: Final = {"mode": "manual"}

TYPES: Final = """
import actionlib, json, os, rospy, sys, threading, time
from genpy.dynamic import generate_dynamic
below = "=" * 80 + "\\nMSG: "
text = "".join("FibonacciAction%s action_%s\\n" % (part, part.lower()) for part in ("Goal", "Result", "Feedback"))
text += below + "test_msgs/FibonacciActionGoal\\nHeader header\\nactionlib_msgs/GoalID goal_id\\nFibonacciGoal goal\\n"
for part in ("Result", "Feedback"):
    text += below + "test_msgs/FibonacciAction%s\\nHeader header\\nactionlib_msgs/GoalStatus status\\n" % part
    text += "Fibonacci%s %s\\n" % (part, part.lower())
    text += below + "test_msgs/Fibonacci%s\\nint32[] sequence\\n" % part
text += below + "test_msgs/FibonacciGoal\\nint32 order\\n"
text += below + "std_msgs/Header\\nuint32 seq\\ntime stamp\\nstring frame_id\\n"
text += below + "actionlib_msgs/GoalID\\ntime stamp\\nstring id\\n"
text += below + "actionlib_msgs/GoalStatus\\nGoalID goal_id\\nuint8 status\\n"
words = "PENDING ACTIVE PREEMPTED SUCCEEDED ABORTED REJECTED PREEMPTING RECALLING RECALLED LOST"
for number, name in enumerate(words.split()):
    text += "uint8 %s=%d\\n" % (name, number)
text += "string text\\n"
made = generate_dynamic("test_msgs/FibonacciAction", text)
Action, Goal, Result, Feedback = (made["test_msgs/Fibonacci" + part] for part in "Action Goal Result Feedback".split())
def say(*words):
    os.write(1, json.dumps(words).encode() + b"\\n")
"""
"""test_msgs/Fibonacci of ROS 2, as its .action file would be in ROS 1."""

SERVER: Final = (
    TYPES
    + """
rospy.init_node("server", disable_rosout=True)
def run(goal):
    "Orders: 0 to 99 are done with feedback, from 100 on it waits for its cancelling, -1 aborts, -2 is rejected."
    order = goal.get_goal().order
    say("goal", order)
    if order == -2:
        goal.set_rejected(Result(), "never")
        return
    goal.set_accepted()
    if order < 0:
        goal.set_aborted(Result([]), "no way")
        return
    numbers = [0, 1]
    for _ in range(min(order, 5)):
        numbers.append(numbers[-1] + numbers[-2])
        goal.publish_feedback(Feedback(list(numbers)))
    while order >= 100 and goal.get_goal_status().status != 6:
        time.sleep(0.005)
    if order >= 100:
        goal.set_canceled(Result(numbers), "as you wish")
        say("cancelled", order)
    else:
        goal.set_succeeded(Result(numbers), "done")
def begin(goal):
    threading.Thread(target=run, args=(goal,), daemon=True).start()
server = actionlib.ActionServer("/fibonacci", Action, begin, lambda goal: None, auto_start=False)
server.start()
rospy.spin()
"""
)

CLIENT: Final = (
    TYPES
    + """
rospy.init_node("client", disable_rosout=True)
client = actionlib.SimpleActionClient("/robot1/fibonacci", Action)
client.wait_for_server()
say("server")
for line in sys.stdin:
    word, *values = line.split()
    if word == "goal":
        order = int(values[0])
        client.send_goal(
            Goal(order),
            lambda status, result, order=order: say("ended", order, status, list(result.sequence)),
            lambda order=order: say("active", order),
            lambda feedback, order=order: say("feedback", order, list(feedback.sequence)),
        )
    elif word == "cancel":
        client.cancel_goal()
"""
)

MOVE_BASE_SERVER: Final = """
import actionlib, json, os, rospy
from move_base_msgs.msg import MoveBaseAction, MoveBaseFeedback, MoveBaseResult
rospy.init_node("move_base", disable_rosout=True)
def move(goal):
    target = goal.target_pose
    os.write(1, json.dumps([target.header.frame_id, target.pose.position.x]).encode() + b"\\n")
    while not server.is_preempt_requested():
        server.publish_feedback(MoveBaseFeedback(base_position=target))
        rospy.sleep(0.02)
    server.set_preempted(MoveBaseResult(), "as you wish")
server = actionlib.SimpleActionServer("/move_base", MoveBaseAction, move, auto_start=False)
server.start()
rospy.spin()
"""


def _ros1(ros: RosLab) -> dict[str, Any]:
    return {"kind": "ros1", "master_uri": ros.uri, "host": HOST}


def _actions(word: str, match: str, timeout_s: float = DEADLINE_S) -> dict[str, Any]:
    return {"actions": {word: [{"match": match, "timeout_s": timeout_s}]}, "discovery": MANUAL}


def in_order(fed: list[list[int]]) -> None:
    """Any of five in a row may be missing on the link: the newest feedback of ROS 1 counts."""
    lengths = [len(sequence) for sequence in fed]
    assert lengths == sorted(set(lengths)) and all(
        sequence == [0, 1, 1, 2, 3, 5, 8][: len(sequence)] for sequence in fed
    )


async def accepted(node: RosNode, key: str, order: int) -> bool:
    await node.do("send_goal", action="/robot1/fibonacci", order=order, key=key)
    return bool((await node.event("accepted", key=key))["accepted"])


async def ended(node: RosNode, key: str) -> int:
    return int((await node.event("result", key=key))["status"])


def kinds() -> list[Any]:
    from tests.peers.dds.peer import free_domain
    from tests.peers.ros2.sourced import PLACE

    domain = free_domain()
    rclpy = {"kind": "rclpy", "domain": domain, "poll_hz": 20}
    dds = {"kind": "dds", "domain": domain, "localhost_only": True, "type_paths": [str(PLACE / "share")]}
    return [domain, rclpy, [dds, {**rclpy, "services_only": True}]]


@pytest.mark.parametrize("kind", [1, 2], ids=["rclpy", "dds-and-rclpy"])
async def test_real_nodes_of_ros_2_give_goals_to_a_server_of_ros_1(tmp_path: Path, kind: int) -> None:
    need(ACTIONLIB)
    sourced()
    if kind == 2:
        pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")
    domain, *endpoints = kinds()
    async with (
        RosLab(tmp_path, "robot_ros") as ros,
        RosNodes(tmp_path) as nodes,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.process(lab.relay_file()).ready()
        await lab.connected(lab.client_file("robot1", _ros1(ros), **_actions("offer", "/fibonacci")))
        desk = await nodes.start(domain, "desk")
        site = lab.process(
            lab.client_file(
                "site", endpoints[kind - 1], client={"namespace": "/"}, **_actions("use", "/robot1/fibonacci")
            ),
            before=before(),
        )
        ros.python("server", SERVER)

        assert await accepted(desk, "done", 5)
        assert await ended(desk, "done") == SUCCEEDED
        sequence = [0, 1, 1, 2, 3, 5, 8]
        assert desk.of("result", key="done")[0]["sequence"] == sequence
        in_order([each["sequence"] for each in desk.of("feedback", key="done")])

        assert await accepted(desk, "aborted", -1)
        assert await ended(desk, "aborted") == ABORTED
        assert not await accepted(desk, "refused", -2)

        assert await accepted(desk, "long", 100)
        await desk.event("feedback", key="long")
        await desk.do("cancel", key="long")
        assert (await desk.event("cancelling", key="long"))["goals"] == 1
        assert await ended(desk, "long") == CANCELED
        assert ["cancelled", 100] in ros.lines("server")
        await site.stop()


async def test_what_a_lost_link_means_for_real_nodes_of_ros_2(tmp_path: Path) -> None:
    need(ACTIONLIB)
    sourced()
    domain, rclpy, _ = kinds()
    async with (
        RosLab(tmp_path, "robot_ros") as ros,
        RosNodes(tmp_path) as nodes,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        relay = lab.process(lab.relay_file())
        await relay.ready()
        await lab.connected(lab.client_file("robot1", _ros1(ros), **_actions("offer", "/fibonacci")))
        desk = await nodes.start(domain, "desk")
        site = lab.process(
            lab.client_file("site", rclpy, client={"namespace": "/"}, **_actions("use", "/robot1/fibonacci", 3.0)),
            before=before(),
        )
        ros.python("server", SERVER)
        assert await accepted(desk, "long", 100)
        await desk.event("feedback", key="long")

        # Of a goal under way nothing is heard, a new one is never sent.
        relay.kill()
        assert await ended(desk, "long") == ABORTED
        assert not await accepted(desk, "late", 7)
        await site.said("is given up and cancelled", "/robot1/fibonacci")
        await lab.process(relay.config).ready()
        await ros.until_printed("server", '["cancelled", 100]')
        assert ["goal", 7] not in ros.lines("server")
        await site.stop()


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

    async def until(self, *words: Any) -> None:
        await until(lambda: list(words) in self.said(), f"the client says {words}: {self.said()}")


async def test_clients_of_ros_1_give_goals_to_a_real_server_of_ros_2(tmp_path: Path) -> None:
    need(ACTIONLIB)
    sourced()
    domain, rclpy, _ = kinds()
    preempted, succeeded, aborted, rejected = 2, 3, 4, 5
    async with (
        RosLab(tmp_path, "site_ros") as ros,
        RosNodes(tmp_path) as nodes,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        relay = lab.process(lab.relay_file())
        await relay.ready()
        machine = await nodes.start(domain, "machine")
        robot = lab.process(lab.client_file("robot1", rclpy, **_actions("offer", "/fibonacci")), before=before())
        site: ClientDaemon = await lab.connected(
            lab.client_file("site", _ros1(ros), client={"namespace": "/"}, **_actions("use", "/robot1/fibonacci"))
        )
        client = Client(ros)
        await machine.do("action_server", action="/fibonacci")
        await client.until("server")

        sequence = [0, 1, 1, 2, 3, 5, 8]
        client.tell("goal 5")
        await client.until("ended", 5, succeeded, sequence)
        in_order([line[2] for line in client.said() if line[:2] == ["feedback", 5]])

        client.tell("goal -1")
        await client.until("ended", -1, aborted, [])
        client.tell("goal -2")
        await client.until("ended", -2, rejected, [])

        client.tell("goal 100")
        await client.until("active", 100)
        client.tell("cancel")
        await client.until("ended", 100, preempted, sequence)
        assert len(machine.of("cancelled")) == 1

        # The link goes away while a goal is under way, and its cancelling waits for it to come back.
        client.tell("goal 101")
        await client.until("active", 101)
        relay.kill()
        await until(lambda: site.core.link.lane.stalled, "the link is lost")
        client.tell("cancel")
        relay = lab.process(relay.config)
        await relay.ready()
        await client.until("ended", 101, preempted, sequence)
        assert len(machine.of("cancelled")) == 2

        # A goal that the link does not take there in time is refused.
        relay.kill()
        await until(lambda: site.core.link.lane.stalled, "the link is lost")
        client.tell("goal 7")
        await client.until("ended", 7, rejected, [])
        await lab.process(relay.config).ready()
        await robot.stop()


async def test_a_node_of_nav2_moves_a_robot_with_move_base(tmp_path: Path) -> None:
    need(ACTIONLIB, MOVE_BASE)
    pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")
    from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
    from sern_client.endpoints.zenoh.options import ZenohOptions
    from tests.peers.test_zenoh import Router

    router = Router()
    router.start()
    client, events = (
        ZenohEndpoint(ZenohOptions(router.options, 9, "navigator", accept_bridged=True, enclave="/")),
        Events(),
    )
    client.watch_services(events)
    definitions = folder(tmp_path / "nav2", nav2_msgs__NavigateToPose=NAVIGATE)
    try:
        async with RosLab(tmp_path, "robot_ros") as ros, Lab(tmp_path, "robot1", "site") as lab:
            await lab.process(lab.relay_file()).ready()
            await lab.connected(lab.client_file("robot1", _ros1(ros), **_actions("offer", "/move_base")))
            endpoint = {"kind": "zenoh", "connect": [router.locator], "listen": ["tcp/127.0.0.1:0"], "domain": 9,
                        "type_paths": [str(definitions)]}  # fmt: skip
            await lab.connected(
                lab.client_file("site", endpoint, client={"namespace": "/"}, **_actions("use", "/robot1/move_base"))
            )
            await client.start(events)
            ros.python("server", MOVE_BASE_SERVER)
            action = "/robot1/move_base/_action"
            names = {part: TopicName(f"{action}/{part}") for part in ("send_goal", "cancel_goal", "get_result")}
            feedback = TopicName(f"{action}/feedback")
            await until(lambda: set(events.services) == set(names.values()) and feedback in events.infos, "it is there")
            assert events.services[names["send_goal"]].type_name == "nav2_msgs/action/NavigateToPose_SendGoal"

            fed: list[bytes] = []

            def take(body: bytes, _stamp_ns: int) -> bool:
                fed.append(body)
                return True

            client.subscribe(feedback, take)
            uuid = bytes(range(16))
            pose = struct.pack("<iII4s7d", 0, 0, 4, b"map\0", 3.5, 0, 0, 0, 0, 0, 1)
            goal = bodies.HEAD + uuid + pose + struct.pack("<Is", 1, b"\0")
            assert bodies.is_accepted(await client.call(names["send_goal"], goal, timeout_s=DEADLINE_S))
            assert ["map", 3.5] in ros.lines("server")
            await until(lambda: fed, "feedback comes")
            assert fed[0][4:20] == uuid and struct.unpack_from("<d", fed[0], 4 + 16 + 16)[0] == 3.5
            asked = asyncio.ensure_future(
                client.call(names["get_result"], bodies.result_request(uuid), timeout_s=DEADLINE_S)
            )
            answer = await client.call(
                names["cancel_goal"], bodies.cancel_request(GoalInfo(uuid, NO_STAMP)), timeout_s=DEADLINE_S
            )
            assert bodies.cancel_code(answer) == bodies.NONE
            assert (await asked)[4:13] == struct.pack("<bxHIs", CANCELED, 0, 1, b"\0")  # status, error_code, error_msg
    finally:
        await client.stop()
        router.stop()
