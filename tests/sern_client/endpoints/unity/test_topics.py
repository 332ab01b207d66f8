"""Topics that come for scenes, and those that scenes publish."""

import json
import struct

import pytest

from sern_client.endpoints.base import Held, TopicNews
from sern_client.endpoints.unity.faults import Fault
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.sern_client.endpoints.unity.conftest import Started
from tests.sern_client.endpoints.unity.scene import FakeViewed, PlayedScene, Sinks, text_body
from tests.support import Events, until

CHAT = ros_types.topic_info("/robot1/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
MAP = ros_types.topic_info("/map", "nav_msgs/msg/OccupancyGrid", Encoding.CDR, latched=True)
TF_STATIC = ros_types.topic_info("/tf_static", "tf2_msgs/msg/TFMessage", Encoding.CDR, latched=True)


@pytest.mark.parametrize(("protocol", "said"), [("ros1", "ROS1"), ("ros2", "ROS2")])
async def test_the_handshake_comes_first_and_says_what_bodies_are(
    started: Started, port: int, protocol: str, said: str
) -> None:
    endpoint = await started(protocol=protocol)
    assert endpoint.encoding is (Encoding.ROS1 if protocol == "ros1" else Encoding.CDR)
    async with PlayedScene(port, ros2=protocol == "ros2") as scene:
        await until(lambda: scene.frames)
        destination, body = scene.frames[0]
        assert destination == "__handshake"
        given = json.loads(body)
        assert given["version"].startswith("v0.7.")
        assert json.loads(given["metadata"]) == {"protocol": said}


async def test_a_second_of_silence_is_filled_with_keep_alives(started: Started, port: int) -> None:
    await started()
    async with PlayedScene(port) as scene:
        await until(lambda: scene.keep_alives >= 3)
        assert [name for name, _ in scene.frames] == ["__handshake"]
        await scene.send(bytes(8))
        await scene.caught_up()
        assert not scene.errors


@pytest.mark.parametrize("ros2", [True, False])
@pytest.mark.parametrize("piece_bytes", [None, 1, 7])
async def test_what_is_subscribed_to_is_wanted_and_comes(
    started: Started, port: int, viewed: FakeViewed, ros2: bool, piece_bytes: int | None
) -> None:
    endpoint = await started(protocol="ros2" if ros2 else "ros1")
    info = ros_types.topic_info("/robot1/chat", "std_msgs/String", endpoint.encoding)
    endpoint.topic_offered(info)
    async with PlayedScene(port, ros2=ros2, piece_bytes=piece_bytes) as scene:
        await scene.subscribe("/robot1/chat")
        await until(lambda: viewed.wanted == {"/robot1/chat"})
        publisher = endpoint.advertise(info)
        publisher.publish(text_body("hello", ros2=ros2), 1)
        await until(lambda: scene.bodies("/robot1/chat") == [text_body("hello", ros2=ros2)])
        await scene.command("__remove_subscriber", topic="/robot1/chat")
        await until(lambda: not viewed.wanted)
        publisher.publish(text_body("nobody", ros2=ros2), 2)
        await scene.caught_up()
        assert len(scene.bodies("/robot1/chat")) == 1
        publisher.close()
        publisher.publish(b"late", 3)
        assert endpoint.drops == {DropReason.DISCONNECTED: 1}


async def test_a_topic_may_be_subscribed_to_before_it_is_there(started: Started, port: int, viewed: FakeViewed) -> None:
    endpoint = await started()
    async with PlayedScene(port) as scene:
        await scene.subscribe("/robot1/chat")
        await scene.caught_up()
        assert not viewed.calls and not scene.errors
        for again in range(2):
            endpoint.topic_offered(CHAT)
            assert viewed.calls[again:] == [(CHAT.name, True)]
            endpoint.topic_withdrawn(CHAT.name)
        endpoint.topic_offered(CHAT)
    await until(lambda: not viewed.wanted)
    assert viewed.calls == [(CHAT.name, True)] * 3 + [(CHAT.name, False)]


async def test_several_scenes_want_one_topic_once(started: Started, port: int, viewed: FakeViewed) -> None:
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    async with PlayedScene(port) as one:
        await one.subscribe("/robot1/chat")
        async with PlayedScene(port) as other:
            await other.subscribe("robot1/chat")  # as the tutorials write names
            await other.caught_up()
            await one.caught_up()
            endpoint.advertise(CHAT).publish(text_body("both"), 1)
            await until(lambda: one.bodies("/robot1/chat") and other.bodies("robot1/chat"))
            await one.command("__remove_subscriber", topic="/robot1/chat")
            await one.caught_up()
        assert viewed.calls == [(CHAT.name, True)]
        await until(lambda: len(endpoint.scenes) == 1)
        assert viewed.calls == [(CHAT.name, True), (CHAT.name, False)]


async def test_another_type_is_an_error_that_names_both(started: Started, port: int, viewed: FakeViewed) -> None:
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/robot1/chat", "std_msgs/Int32")
        text = await scene.told("/robot1/chat")
        assert "std_msgs/Int32" in text and "std_msgs/String" in text
        assert not viewed.calls
        endpoint.advertise(CHAT).publish(text_body("not for it"), 1)
        await scene.subscribe("/robot1/chat")
        await until(lambda: viewed.wanted)
        assert not scene.bodies("/robot1/chat")
        assert endpoint.faults.counts[Fault.OTHER_TYPE] >= 1
        # The topic is another one than before.
        endpoint.topic_withdrawn(CHAT.name)
    assert {name for name, _ in viewed.calls} == {CHAT.name}


async def test_a_topic_that_becomes_of_another_type_is_not_wanted(
    started: Started, port: int, viewed: FakeViewed
) -> None:
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/robot1/chat")
        await until(lambda: viewed.wanted)
        endpoint.topic_offered(ros_types.topic_info(CHAT.name, "std_msgs/Int32", Encoding.CDR))
        assert viewed.calls == [(CHAT.name, True), (CHAT.name, False)]
        await scene.told("std_msgs/Int32")


async def test_an_unknown_type_is_an_error_and_the_topic_comes_when_a_site_has_it(
    started: Started, port: int, viewed: FakeViewed, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = await started()
    async with PlayedScene(port) as scene:
        for _ in range(2):
            await scene.subscribe("/gadget", "my_msgs/Gadget")
            await scene.told("my_msgs/Gadget")
            await scene.command("__remove_subscriber", topic="/gadget")
        await scene.subscribe("/gadget", "my_msgs/Gadget")
        await until(lambda: endpoint.faults.counts[Fault.UNKNOWN_TYPE] == 3)
        assert len(scene.errors) == 1
        assert sum("my_msgs/Gadget" in record.message for record in caplog.records) == 1
        info = TopicInfo(TopicName("/gadget"), "my_msgs/msg/Gadget", Encoding.CDR, "", "int32 knobs\n")
        endpoint.topic_offered(info)
        assert viewed.wanted == {"/gadget"}
        endpoint.advertise(info).publish(b"\0\1\0\0\7\0\0\0", 1)
        await until(lambda: scene.bodies("/gadget") == [b"\0\1\0\0\7\0\0\0"])


async def test_who_subscribes_late_gets_what_is_latched(started: Started, port: int) -> None:
    endpoint = await started()
    first, second = endpoint.advertise(MAP), endpoint.advertise(MAP)
    first.publish(b"\0\1\0\0old", 1)
    first.publish(b"\0\1\0\0one", 2)
    second.publish(b"\0\1\0\0two", 3)
    endpoint.advertise(CHAT).publish(text_body("past"), 4)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/map", "nav_msgs/OccupancyGrid")
        await scene.subscribe("/robot1/chat")
        await until(lambda: len(scene.bodies("/map")) == 2)
        assert scene.bodies("/map") == [b"\0\1\0\0one", b"\0\1\0\0two"]
        await scene.subscribe("/map", "nav_msgs/OccupancyGrid")
        second.close()
        await scene.command("__remove_subscriber", topic="/map")
        await scene.subscribe("/map", "nav_msgs/OccupancyGrid")
        await until(lambda: len(scene.bodies("/map")) == 3)
        await scene.caught_up()
        assert scene.bodies("/map")[2:] == [b"\0\1\0\0one"]
        assert not scene.bodies("/robot1/chat")


async def test_static_transforms_of_all_come_as_one(started: Started, port: int) -> None:
    def static(child: str) -> bytes:
        new = ros_types.new
        transform = new("geometry_msgs/msg/TransformStamped", Encoding.CDR, child_frame_id=child)
        message = new("tf2_msgs/msg/TFMessage", Encoding.CDR, transforms=[transform])
        return ros_types.serialise(message, "tf2_msgs/msg/TFMessage", Encoding.CDR)

    endpoint = await started()
    stream = endpoint.advertise(TF_STATIC)
    stream.publish(static("lidar"), 1)
    stream.publish(static("camera"), 2)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/tf_static", "tf2_msgs/TFMessage")
        await until(lambda: scene.bodies("/tf_static"))
        await scene.caught_up()
        (body,) = scene.bodies("/tf_static")
        message = ros_types.deserialise(body, "tf2_msgs/msg/TFMessage", Encoding.CDR)
        assert [each.child_frame_id for each in message.transforms] == ["lidar", "camera"]


async def test_bodies_of_the_other_ros_and_a_second_type_are_refused_to_the_bridge(started: Started) -> None:
    endpoint = await started()
    with pytest.raises(ConfigError, match="ros1 messages"):
        endpoint.advertise(ros_types.topic_info("/chat", "std_msgs/String", Encoding.ROS1))
    endpoint.advertise(CHAT)
    with pytest.raises(ConfigError, match=r"std_msgs/msg/Int32, and std_msgs/msg/String"):
        endpoint.advertise(ros_types.topic_info(CHAT.name, "std_msgs/Int32", Encoding.CDR))


async def test_topics_and_their_types_are_listed(started: Started, port: int) -> None:
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    endpoint.advertise(MAP)
    async with PlayedScene(port) as scene:
        await scene.publish("/goal", "geometry_msgs/PoseStamped")
        await scene.caught_up()
        assert scene.commands("__topic_list") == [
            {
                "topics": ["/goal", "/map", "/robot1/chat"],
                "types": ["geometry_msgs/PoseStamped", "nav_msgs/OccupancyGrid", "std_msgs/String"],
            }
        ]


async def test_ages_come_to_who_asks_and_grow_while_nothing_comes(
    started: Started, port: int, viewed: FakeViewed
) -> None:
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    viewed.news = [TopicNews(CHAT.name, 1.5, {}), TopicNews(TopicName("/other"), 9.0, {})]
    async with PlayedScene(port) as scene:
        await scene.subscribe("/robot1/chat/sern/age", "std_msgs/Float32")

        def ages() -> list[float]:
            return [struct.unpack("<4xf", body)[0] for body in scene.bodies("/robot1/chat/sern/age")]

        await until(lambda: len(ages()) >= 2)
        assert not viewed.calls, "to ask for the age of a topic does not make it wanted"
        assert 1.5 <= ages()[0] < 1.6
        viewed.news = []  # the robot is gone, and with it the topic
        last = ages()[-1]
        await until(lambda: ages()[-1] > last + 0.3)
        await scene.command("__remove_subscriber", topic="/robot1/chat/sern/age")
        await scene.caught_up()
        before = len(ages())
        await scene.subscribe("/robot1/chat/sern/age", "std_msgs/String")
        await scene.told("std_msgs/Float32")
        assert len(ages()) == before
    await until(lambda: not endpoint.scenes)


async def test_a_topic_of_that_name_goes_before_the_age(started: Started, port: int, viewed: FakeViewed) -> None:
    endpoint = await started()
    age = ros_types.topic_info("/twin/sern/age", "std_msgs/Float32", Encoding.CDR)
    async with PlayedScene(port) as scene:
        await scene.subscribe(age.name, "std_msgs/Float32")
        await scene.caught_up()
        endpoint.topic_offered(age)
        assert viewed.wanted == {age.name}
        endpoint.advertise(age).publish(b"\0\1\0\0real", 1)
        await until(lambda: scene.bodies(age.name) == [b"\0\1\0\0real"])


# --- what scenes publish -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ros2", [True, False])
@pytest.mark.parametrize("piece_bytes", [None, 1])
async def test_what_a_scene_publishes_goes_out(
    started: Started, port: int, events: Events, ros2: bool, piece_bytes: int | None
) -> None:
    endpoint = await started(protocol="ros2" if ros2 else "ros1")
    sinks = Sinks()
    async with PlayedScene(port, ros2=ros2, piece_bytes=piece_bytes) as scene:
        await scene.publish("/cmd_vel", "geometry_msgs/Twist")
        await until(lambda: events.added == ["/cmd_vel"])
        info = events.infos[TopicName("/cmd_vel")]
        assert info == ros_types.topic_info("/cmd_vel", "geometry_msgs/msg/Twist", endpoint.encoding)
        endpoint.subscribe(info.name, sinks.of(info.name))
        body = ros_types.serialise(
            ros_types.new("geometry_msgs/msg/Twist", endpoint.encoding), "geometry_msgs/msg/Twist", endpoint.encoding
        )
        await scene.message("/cmd_vel", body)
        await until(lambda: sinks["/cmd_vel"] == [body])
        assert endpoint.validate(Held(subscriptions=+endpoint.publications.subscriptions.names)) == []
        endpoint.interest(info.name, False)
        await scene.message("/cmd_vel", body)
        await scene.caught_up()
        assert len(sinks["/cmd_vel"]) == 1
        await scene.command("__remove_publisher", topic="/cmd_vel")
        await until(lambda: events.removed == ["/cmd_vel"])
        with pytest.raises(UsageError, match="no such topic"):
            endpoint.subscribe(info.name, sinks.of(info.name))
        await scene.message("/cmd_vel", body)
        await scene.told("'/cmd_vel'")
        assert endpoint.drops == {DropReason.FORBIDDEN: 1}


async def test_the_last_message_of_a_latched_topic_is_there_for_the_bridge(
    started: Started, port: int, events: Events
) -> None:
    endpoint = await started()
    sinks = Sinks()
    async with PlayedScene(port) as scene:
        await scene.publish("/plan", latch=True)
        await scene.message("/plan", text_body("a"))
        await scene.message("/plan", text_body("b"))
        await scene.caught_up()
        assert events.infos[TopicName("/plan")].latched
        endpoint.subscribe(TopicName("/plan"), sinks.of("/plan"))
        await until(lambda: sinks["/plan"] == [text_body("b")])
    await until(lambda: events.removed == ["/plan"])


async def test_nothing_may_be_published_unless_the_file_names_it(started: Started, port: int, events: Events) -> None:
    endpoint = await started(publish=("/goal", "/markers/.*"))
    async with PlayedScene(port) as scene:
        for name in ("/goal", "/markers/one", "/cmd_vel"):
            await scene.publish(name)
        text = await scene.told("/cmd_vel")
        assert "publish of the unity endpoint" in text
        assert events.added == ["/goal", "/markers/one"]
        assert endpoint.faults.counts == {Fault.NOT_ALLOWED: 1}


async def test_what_two_scenes_publish_is_one_topic(
    started: Started, port: int, events: Events, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    endpoint = await started()
    sinks = Sinks()
    async with PlayedScene(port) as one:
        await one.publish("/goal")
        await one.caught_up()
        endpoint.subscribe(TopicName("/goal"), sinks.of("/goal"))
        async with PlayedScene(port) as other:
            await other.publish("goal")
            await other.publish("/goal", "std_msgs/Int32")
            assert "std_msgs/Int32" in await other.told("std_msgs/String")
            await one.message("/goal", text_body("one"))
            await other.message("goal", text_body("other"))
            await until(lambda: sorted(sinks["/goal"]) == [text_body("one"), text_body("other")])
        await until(lambda: len(endpoint.scenes) == 1)
        assert events.removed == []
        await one.command("__remove_publisher", topic="/goal")
        await until(lambda: events.removed == ["/goal"])
    said = [record.message for record in caplog.records if "/goal" in record.message and "2 scenes" in record.message]
    assert said == ["/goal: 2 scenes publish it; what they say goes out as one topic"]


async def test_a_type_that_nobody_knows_is_not_published(
    started: Started, port: int, events: Events, tmp_path_factory: pytest.TempPathFactory
) -> None:
    types = tmp_path_factory.mktemp("types")
    (types / "my_msgs" / "msg").mkdir(parents=True)
    (types / "my_msgs" / "msg" / "Known.msg").write_text("int32 knobs\n")
    endpoint = await started(type_paths=(types,))
    async with PlayedScene(port) as scene:
        await scene.publish("/gadget", "my_msgs/Gadget")
        assert "type_paths" in await scene.told("my_msgs/Gadget")
        await scene.publish("/known", "my_msgs/Known")
        await until(lambda: events.added == ["/known"])
        assert events.infos[TopicName("/known")].definition == "int32 knobs\n"
        assert endpoint.faults.counts == {Fault.UNKNOWN_TYPE: 1}


async def test_a_body_of_the_other_ros_is_dropped(started: Started, port: int, events: Events) -> None:
    endpoint = await started()
    sinks = Sinks()
    async with PlayedScene(port) as scene:
        await scene.publish("/goal")
        await scene.caught_up()
        endpoint.subscribe(TopicName("/goal"), sinks.of("/goal"))
        for body in (b"", b"\0\1", text_body("one", ros2=False)):
            await scene.message("/goal", body)
        await scene.caught_up()
        assert endpoint.drops == {DropReason.UNDECODABLE: 3}
        await scene.message("/goal", text_body("two"))
        await until(lambda: sinks["/goal"] == [text_body("two")])


async def test_scenes_come_back_and_so_does_the_daemon(
    started: Started, port: int, viewed: FakeViewed, events: Events
) -> None:
    scene = PlayedScene(port)
    for _ in range(2):
        endpoint = await started()
        endpoint.topic_offered(CHAT)
        stream = endpoint.advertise(CHAT)
        for _ in range(2):
            await scene.connect()
            await scene.subscribe("/robot1/chat")
            await scene.publish("/goal")
            await until(lambda: viewed.wanted and "/goal" in events.infos)
            before = len(scene.bodies("/robot1/chat"))
            stream.publish(text_body("again"), 1)
            await until(lambda before=before: len(scene.bodies("/robot1/chat")) > before)  # type: ignore[misc]
            await scene.leave()
            scene.frames.clear()
            await until(lambda there=endpoint.scenes: not there)  # type: ignore[misc]
            assert not viewed.wanted and not events.infos
        await scene.connect()
        await until(lambda there=endpoint.scenes: there)  # type: ignore[misc]
        await endpoint.stop()
        await until(scene.ended.is_set)
        await scene.leave()
        scene.ended.clear()
        scene.frames.clear()
