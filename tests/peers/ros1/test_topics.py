"""Topics to and from real ROS 1 nodes."""

import subprocess
import time
import zlib
from pathlib import Path

import pytest

from sern_client.endpoints.ros1 import Ros1Endpoint
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.daemons import bodies, recording
from tests.peers.ros1.lab import GEOMETRY_MSGS, SUBSCRIBER, RosLab, need, publisher
from tests.support import Events, until

STRING = "std_msgs/msg/String"


def text(data: str) -> bytes:
    return ros_types.serialise(ros_types.new(STRING, Encoding.ROS1, data=data), STRING, Encoding.ROS1)


def collect(endpoint: Ros1Endpoint, name: str) -> list[bytes]:
    got: list[bytes] = []

    def sink(body: bytes, stamp_ns: int) -> bool:
        assert abs(stamp_ns - time.time_ns()) < 60 * 10**9  # wall time, also under simulated time
        got.append(body)
        return True

    endpoint.subscribe(TopicName(name), sink)
    return got


async def test_receives_from_rospy(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        ros.python("talker", publisher("/chat", "std_msgs/String", "m.String(f'hello {n}')"), "talker")
        await until(lambda: "/chat" in events.infos, "the topic is announced")
        info = events.infos[TopicName("/chat")]
        known = ros_types.topic_info("/chat", STRING, Encoding.ROS1)
        assert (info.type_name, info.type_hash, info.encoding) == (STRING, known.type_hash, Encoding.ROS1)
        assert info.definition.strip() == "string data" and not info.latched
        got = collect(endpoint, "/chat")
        await until(lambda: len(got) >= 20, "messages come")
        numbers = [int(body[4:].split()[1]) for body in got]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        await until(lambda: ros.subscribers("/chat") == ["/sern_test"], "we are registered")


async def test_a_publisher_that_unregisters_or_crashes_is_gone_and_others_go_on(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        ros.python("other", publisher("/other", "std_msgs/String", "m.String(f'x {n}')", rate_hz=100), "other")
        first = ros.python("first", publisher("/chat", "std_msgs/String", "m.String('one')"), "first")
        await until(lambda: {"/chat", "/other"} <= events.infos.keys(), "both are announced")
        other, chat = collect(endpoint, "/other"), collect(endpoint, "/chat")
        await until(lambda: chat and other, "both give")
        first.terminate()
        await until(lambda: "/chat" not in events.infos, "the one that said goodbye is gone")
        crash = ros.python("second", publisher("/chat", "std_msgs/String", "m.String('two')"), "second")
        await until(lambda: "/chat" in events.infos, "it is back")
        ros.kill(crash)
        await until(lambda: "/chat" not in events.infos, "the one that crashed is gone")
        assert ros.publishers("/chat") == ["/second"]  # as far as the master knows
        # Under the same name, at another port, while the dead one is still registered.
        ros.python("second_again", publisher("/chat", "std_msgs/String", "m.String('three')"), "second")
        await until(lambda: "/chat" in events.infos, "the node that came back is found")
        again = collect(endpoint, "/chat")
        await until(lambda: text("three") in again, "and gives messages")
        numbers = [int(body[4:].split()[1]) for body in other]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert events.added.count(TopicName("/other")) == 1 and "/other" not in events.removed


async def test_publishes_to_rospy_and_the_tools_byte_for_byte(tmp_path: Path) -> None:
    need("/usr/bin/rostopic", "/usr/bin/rosnode")
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        latched = endpoint.advertise(ros_types.topic_info("/map_name", STRING, Encoding.ROS1, latched=True))
        stream = endpoint.advertise(ros_types.topic_info("/chat", STRING, Encoding.ROS1))
        latched.publish(text("old"), 0)
        latched.publish(text("office"), 0)
        assert "office" in await ros.tool("rostopic", "echo", "-n", "1", "/map_name")
        ros.python("listener", SUBSCRIBER, "listener", "/chat", "/map_name")
        await until(lambda: len(ros.lines("listener")) == 1, "the latched message comes")
        await until(lambda: ros.subscribers("/chat") == ["/listener"], "the listener is registered")
        sent = [text(f"number {number} {'x' * (number * 4000 % 300_000)}") for number in range(200)]
        await until(lambda: any(link.topic == "/chat" for link in endpoint.bus_links()), "it connects")
        for body in sent:
            stream.publish(body, 0)
        await until(lambda: len(ros.lines("listener")) == 201, "all messages come")
        got = [line["crc"] for line in ros.lines("listener") if line["topic"] == "/chat"]
        assert got == [zlib.crc32(body) for body in sent]
        assert events.infos == {}  # what we publish is not announced
        assert endpoint.drops == {}

        info = await ros.tool("rosnode", "info", "/sern_test")
        assert "/chat [std_msgs/String]" in info and "/map_name [std_msgs/String]" in info and "to: /listener" in info
        assert "xmlrpc reply" in await ros.tool("rosnode", "ping", "-c", "1", "/sern_test")
        assert "/sern_test" in await ros.tool("rostopic", "info", "/chat")
        stream.close()
        latched.close()
        await until(lambda: ros.publishers("/chat") == [], "it is unregistered")


async def test_what_is_published_at_once_and_ended_reaches_who_was_there(tmp_path: Path) -> None:
    """Publish as a far side does that has one message only; its subscribers connect when the master has told them."""
    need("/usr/lib/rosbag/record")
    async with RosLab(tmp_path) as ros:
        endpoint, _ = await ros.started()
        ros.python("listener", SUBSCRIBER, "listener", "/chat")
        # It is of roscpp, and ends when it has read the third message.
        record = ros.spawn("record", "/usr/lib/rosbag/record", "-l", "3", "-O", "chat.bag", "/chat")
        await until(lambda: len(ros.subscribers("/chat")) == 2, "both have subscribed")
        for word in ("one", "two", "three"):
            stream = endpoint.advertise(ros_types.topic_info("/chat", STRING, Encoding.ROS1))
            stream.publish(text(word), 0)
            stream.close()
            await ros.until_printed("listener", text(word).hex())
            await until(lambda: ros.publishers("/chat") == [], "it is unregistered")
        await until(lambda: record.poll() is not None, "the bag is complete")
        sent = [text(word) for word in ("one", "two", "three")]
        assert [line["hex"] for line in ros.lines("listener")] == [body.hex() for body in sent]
        assert bodies(ros.directory / "chat.bag") == {"/chat": sent}
        assert endpoint.drops == {}


async def test_rostopic_hz_sees_the_rate(tmp_path: Path) -> None:
    need("/usr/bin/rostopic")
    async with RosLab(tmp_path) as ros:
        endpoint, _ = await ros.started()
        stream = endpoint.advertise(ros_types.topic_info("/chat", STRING, Encoding.ROS1))
        ros.spawn("hz", "/usr/bin/python3", "-u", "/usr/bin/rostopic", "hz", "-w", "20", "/chat")

        def sent() -> bool:
            stream.publish(text("tick"), 0)
            return "average rate" in ros.printed("hz")

        await until(sent, "rostopic hz measures")


async def test_a_plain_subscriber_with_another_md5sum_is_refused_loudly(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, _ = await ros.started()
        endpoint.advertise(ros_types.topic_info("/chat", "std_msgs/msg/Int32", Encoding.ROS1))
        ros.spawn("echo", "/usr/bin/python3", "-c",
                  "import rospy, std_msgs.msg\nrospy.init_node('wrong', disable_rosout=True)\n"
                  "rospy.Subscriber('/chat', std_msgs.msg.String)\nrospy.spin()")  # fmt: skip
        await until(lambda: "992ce8a1687cec8c8bd883ec73ca41d1" in caplog.text, "it is reported")
        line = next(r.getMessage() for r in caplog.records if "992ce8a1687cec8c8bd883ec73ca41d1" in r.getMessage())
        assert "/wrong" in line and "da5909fbe378aeaf85e547e830cc1bb7" in line and "std_msgs/Int32" in line
        assert caplog.text.count("992ce8a1687cec8c8bd883ec73ca41d1") == 1


async def test_a_second_publisher_of_another_type_is_reported_with_both_hashes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        ros.python("right", publisher("/chat", "std_msgs/String", "m.String('a')"), "right")
        await until(lambda: "/chat" in events.infos, "the first is announced")
        got = collect(endpoint, "/chat")
        ros.python("wrong", publisher("/chat", "std_msgs/Int32", "m.Int32(7)"), "wrong")
        await until(lambda: endpoint.counters.mismatches == 1, "the second is refused")
        line = next(r.getMessage() for r in caplog.records if r.levelname == "ERROR")
        assert "/wrong" in line and "da5909fbe378aeaf85e547e830cc1bb7" in line
        assert "992ce8a1687cec8c8bd883ec73ca41d1" in line
        seen = len(got)
        await until(lambda: len(got) > seen + 5, "the first goes on")
        assert set(got) == {text("a")}


async def test_messages_are_fetched_only_while_they_are_wanted(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        script = publisher("/chat", "std_msgs/String", "m.String(str(p.get_num_connections()))", rate_hz=50)
        ros.python("talker", script, "talker")
        await until(lambda: "/chat" in events.infos, "the topic is announced")
        got = collect(endpoint, "/chat")
        await until(lambda: len(got) > 3, "messages come")
        endpoint.interest(TopicName("/chat"), False)
        ros.python("listener", SUBSCRIBER, "listener", "/chat")
        await until(
            lambda: any(line["hex"][8:] == b"1".hex() for line in ros.lines("listener")), "only it is connected"
        )
        seen = len(got)
        endpoint.interest(TopicName("/chat"), True)
        await until(lambda: len(got) > seen, "messages come again")
        assert "/chat" not in events.removed


async def test_restarted_master_is_told_everything_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    need("/usr/bin/rostopic")
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        stream = endpoint.advertise(ros_types.topic_info("/back", STRING, Encoding.ROS1, latched=True))
        stream.publish(text("here"), 0)
        ros.python("talker", publisher("/chat", "std_msgs/String", "m.String('a')"), "talker")
        await until(lambda: "/chat" in events.infos, "the topic is announced")
        got = collect(endpoint, "/chat")
        await until(lambda: ros.publishers("/back") and ros.subscribers("/chat"), "all is registered")
        assert ros.master is not None
        ros.kill(ros.master)
        await until(lambda: not endpoint.connected, "the master is missed")
        seen = len(got)
        await until(lambda: len(got) > seen + 3, "what is connected goes on without a master")
        await ros.start_master()
        await until(lambda: ros.publishers("/back") == ["/sern_test"], "we are registered again")
        await until(lambda: endpoint.connected, "the master has answered all that was asked")
        assert "here" in await ros.tool("rostopic", "echo", "-n", "1", "/back")
        said = [r.getMessage() for r in caplog.records if "ROS master" in r.getMessage() and r.levelname == "WARNING"]
        lost, found = said
        assert "trying again until it works" in lost and f"{ros.uri} again, after " in found, said


async def test_a_master_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    need("/usr/bin/rostopic")
    async with RosLab(tmp_path) as ros:
        assert ros.master is not None
        ros.kill(ros.master)
        endpoint, events = await ros.started()
        stream = endpoint.advertise(ros_types.topic_info("/back", STRING, Encoding.ROS1, latched=True))
        stream.publish(text("early"), 0)
        await ros.start_master()
        await until(lambda: endpoint.connected, "the master is found")
        assert "early" in await ros.tool("rostopic", "echo", "-n", "1", "/back")
        assert "/back" not in events.added


async def test_two_masters_in_one_process_with_namespaces(tmp_path: Path) -> None:
    async with RosLab(tmp_path, "one") as one, RosLab(tmp_path, "two") as two:
        events = Events()
        first, second = one.endpoint("sern", namespace="robot1"), two.endpoint("sern", namespace="robot2")
        await first.start(events)
        await second.start(events)
        one.python("talker", publisher("/chat", "std_msgs/String", "m.String('one')"), "talker")
        two.python("talker", publisher("/chat", "std_msgs/String", "m.String('two')"), "talker")
        await until(lambda: {"/robot1/chat", "/robot2/chat"} <= events.infos.keys(), "both are announced")
        got1, got2 = collect(first, "/robot1/chat"), collect(second, "/robot2/chat")
        await until(lambda: got1 and got2, "both give")
        assert set(got1) == {text("one")} and set(got2) == {text("two")}
        first.advertise(ros_types.topic_info("/robot1/cmd", STRING, Encoding.ROS1))
        with pytest.raises(ConfigError, match="outside /robot2"):
            second.advertise(ros_types.topic_info("/robot1/cmd", STRING, Encoding.ROS1))
        await until(lambda: one.publishers("/cmd") == ["/sern"], "it is published without the namespace")


async def test_what_a_sern_endpoint_publishes_is_no_source_for_another(tmp_path: Path) -> None:
    """Two clients of one host at one master: what came over one link does not go back over the other."""
    async with RosLab(tmp_path) as ros:
        first, seen_by_first = await ros.started("left")
        second, seen_by_second = await ros.started("right")
        stream = first.advertise(ros_types.topic_info("/shared", STRING, Encoding.ROS1, latched=True))
        stream.publish(text("from the far side"), 0)
        await until(lambda: ros.publishers("/shared") == ["/left"], "it is registered")
        # A local publisher of the same topic is a source, for both, and only its messages are.
        ros.python("local", publisher("/shared", "std_msgs/String", "m.String('local')"), "local")
        await until(lambda: "/shared" in seen_by_first.infos and "/shared" in seen_by_second.infos, "local is seen")
        got1, got2 = collect(first, "/shared"), collect(second, "/shared")
        await until(lambda: len(got1) > 3 and len(got2) > 3, "its messages come")
        stream.publish(text("again"), 0)
        seen = len(got2)
        await until(lambda: len(got2) > seen + 3, "more come")
        assert set(got1) == set(got2) == {text("local")}


async def test_static_transforms_of_several_publishers_reach_every_late_joiner(tmp_path: Path) -> None:
    need("/usr/lib/python3/dist-packages/tf2_msgs", GEOMETRY_MSGS, "/usr/bin/rostopic")
    async with RosLab(tmp_path, "robot") as robot, RosLab(tmp_path, "site") as site:
        source, events = await robot.started()
        target, _ = await site.started()
        body = (
            "m.TFMessage([__import__('geometry_msgs.msg').msg.TransformStamped("
            "header=__import__('std_msgs.msg').msg.Header(frame_id='base'), child_frame_id={child!r})])"
        )
        for child in ("lidar", "camera", "imu"):
            script = publisher("/tf_static", "tf2_msgs/TFMessage", body.format(child=child), latch=True)
            robot.python(child, script, f"static_{child}")
        await until(lambda: "/tf_static" in events.infos, "it is announced")
        info = events.infos[TopicName("/tf_static")]
        assert info.latched
        stream = target.advertise(info)

        def sink(body: bytes, stamp_ns: int) -> bool:
            stream.publish(body, stamp_ns)
            return True

        source.subscribe(TopicName("/tf_static"), sink)
        await until(lambda: source.counters.received >= 3, "all three come")
        for _ in range(2):
            printed = await site.tool("rostopic", "echo", "-n", "1", "/tf_static")
            assert [printed.count(f'child_frame_id: "{child}"') for child in ("lidar", "camera", "imu")] == [1, 1, 1]


async def test_plays_a_real_bag_through_rosbag_play(tmp_path: Path) -> None:
    """C++ rosbag play of a Husky's drive, received byte for byte."""
    need("/usr/lib/rosbag/play")
    bag = recording("husky_gps_imu_odom.bag")
    expected = bodies(bag)
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        play = ros.spawn(
            "play", "/usr/lib/rosbag/play", "--pause", "--queue", "100000", "-r", "100", "-d", "0", str(bag),
            stdin=subprocess.PIPE,
        )  # fmt: skip
        await until(lambda: expected.keys() <= events.infos.keys(), "the topics are announced")
        got = {topic: collect(endpoint, topic) for topic in expected}
        await until(lambda: len(endpoint.bus_links()) == len(expected), "all are connected")
        assert play.stdin is not None
        play.stdin.write(b" ")
        play.stdin.flush()
        await until(lambda: all(len(got[t]) >= len(expected[t]) for t in expected), "all comes")
        play.stdin.close()
        assert got == expected


async def test_topic_tools_relay_between_us_and_a_listener(tmp_path: Path) -> None:
    need("/usr/lib/topic_tools/relay")
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        stream = endpoint.advertise(ros_types.topic_info("/chat", STRING, Encoding.ROS1, latched=True))
        ros.spawn("relay", "/usr/lib/topic_tools/relay", "/chat", "/chat_copy", "__name:=relay")
        stream.publish(text("copy me"), 0)
        # The copy is a local node's own topic: it is announced.
        await until(lambda: "/chat_copy" in events.infos, "the copy is announced")
        got = collect(endpoint, "/chat_copy")

        def came() -> bool:
            stream.publish(text("copy me"), 0)
            return bool(got)

        await until(came, "it comes back")
        assert got[0] == text("copy me")


async def test_simulated_time_is_carried_and_expires_nothing(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        ros.call("setParam", "/use_sim_time", True)
        endpoint, events = await ros.started()
        body = "m.Clock(__import__('rospy').Time(n, 5))"
        script = publisher("/clock", "rosgraph_msgs/Clock", body).replace(
            "r = rospy.Rate(20)", "import time\nclass R:\n def sleep(self): time.sleep(0.05)\nr = R()"
        )
        ros.python("clock", script, "clock")
        await until(lambda: "/clock" in events.infos, "the clock is announced")
        got = collect(endpoint, "/clock")  # checks that stamps are wall time
        await until(lambda: len(got) > 3, "it ticks")
        assert int.from_bytes(got[0][4:8], "little") == 5


async def test_rosnode_kill_ends_the_node_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    need("/usr/bin/rosnode")
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        endpoint.advertise(ros_types.topic_info("/back", STRING, Encoding.ROS1))
        ros.python("talker", publisher("/chat", "std_msgs/String", "m.String('a')"), "talker")
        await until(lambda: "/chat" in events.infos and ros.publishers("/back"), "all is registered")
        await ros.tool("rosnode", "kill", "/sern_test")
        await until(lambda: "/chat" not in events.infos, "its topics end")
        await until(lambda: not ros.publishers("/back"), "it leaves the master")
        assert endpoint.problem is not None and "told to shut down" in endpoint.problem


async def test_large_messages_are_dropped_and_counted(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started(max_message_bytes=1000)
        body = "m.String('x' * (100_000 if n % 2 else 10))"
        ros.python("talker", publisher("/chat", "std_msgs/String", body), "talker")
        await until(lambda: "/chat" in events.infos, "the topic is announced")
        got = collect(endpoint, "/chat")
        await until(lambda: len(got) > 3 and endpoint.drops.get(DropReason.TOO_LARGE, 0) > 3, "half is dropped")
        assert set(got) == {text("x" * 10)}
