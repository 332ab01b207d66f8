"""The `unity` endpoint among scenes that speak the connector's protocol over real sockets."""

import asyncio
import json
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import replace
from typing import Any

import pytest

from sern_client.endpoints.base import Held, ServiceInfo, TopicNews
from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.unity.scene import Ended
from sern_client.endpoints.unity.topics import MAX_SUBSCRIPTIONS
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_services, ros_types
from tests.sern_client.endpoints.unity.a_scene import AScene, scene
from tests.support import DEADLINE_S, Events, until

STRING, ODOM = "std_msgs/msg/String", "nav_msgs/msg/Odometry"
TALK, MAP, POSE = TopicName("/robot1/talk"), TopicName("/robot1/map"), TopicName("/robot1/odom")
LAMP = TopicName("/robot1/lamp")


class Looking:
    """The `Viewed` of a client: keeps what is wanted, and says how old each topic is."""

    def __init__(self) -> None:
        self.wanted: dict[TopicName, bool] = {}
        self.ages_s: dict[TopicName, float | None] = {}

    def want(self, name: TopicName, wanted: bool) -> None:
        self.wanted[name] = wanted

    def topics(self) -> list[TopicNews]:
        return [TopicNews(name, age_s, {}) for name, age_s in self.ages_s.items()]


class Place:
    """An endpoint and its scenes."""

    def __init__(self, endpoint: UnityEndpoint, stack: AsyncExitStack) -> None:
        self.endpoint = endpoint
        self.events = Events()
        self.looking = Looking()
        self._stack = stack
        endpoint.use_viewed(self.looking)
        endpoint.watch_services(self.events)

    @property
    def encoding(self) -> Encoding:
        return self.endpoint.options.encoding

    async def scene(self) -> AScene:
        nul = self.encoding is Encoding.CDR
        made: AScene = await self._stack.enter_async_context(scene(self.endpoint.port, nul=nul))
        await until(lambda: made.told("handshake"))
        return made

    def info(self, name: TopicName, type_name: str = STRING, **more: Any) -> TopicInfo:
        return replace(ros_types.topic_info(name, type_name, self.encoding), **more)

    def text(self, said: str) -> bytes:
        return ros_types.serialise(ros_types.new(STRING, self.encoding, data=said), STRING, self.encoding)

    def said(self, body: bytes) -> str:
        return str(ros_types.deserialise(body, STRING, self.encoding).data)


@pytest.fixture
async def stack() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as made:
        yield made


async def place(stack: AsyncExitStack, **options: Any) -> Place:
    made = Place(UnityEndpoint(UnityOptions(**{"listen": "127.0.0.1:0", "publish": True, **options})), stack)
    await made.endpoint.start(made.events)
    stack.push_async_callback(made.endpoint.stop)
    return made


@pytest.mark.parametrize(("protocol", "spoken"), [("ros1", "ROS1"), ("ros2", "ROS2")])
async def test_a_scene_subscribes_byte_by_byte_and_gets_what_comes(
    stack: AsyncExitStack, protocol: str, spoken: str
) -> None:
    here = await place(stack, protocol=protocol)
    unity = await here.scene()
    hello = unity.told("handshake")[0]
    assert hello["version"] == "v0.7.0" and json.loads(hello["metadata"]) == {"protocol": spoken}
    here.endpoint.topic_offered(here.info(TALK))
    unity.slices = 1
    unity.subscribe(TALK, "std_msgs/String")
    await until(lambda: here.looking.wanted == {TALK: True}, "it is wanted over the link")
    publisher = here.endpoint.advertise(here.info(TALK, reliable=True))
    for number in range(3):
        publisher.publish(here.text(f"n{number}"), 0)
    await until(lambda: len(unity.got.get(TALK, [])) == 3)
    assert [here.said(body) for body in unity.got[TALK]] == ["n0", "n1", "n2"]
    assert here.endpoint.validate(Held(publishers={TALK: 1})) == [] and not unity.errors  # type: ignore[arg-type]
    unity.say("remove_subscriber", topic=TALK)
    await until(lambda: here.looking.wanted == {TALK: False}, "and no longer")
    publisher.publish(here.text("unheard"), 0)
    publisher.close()
    publisher.publish(here.text("late"), 0)
    assert here.endpoint.drops[DropReason.DISCONNECTED] == 1 and len(unity.got[TALK]) == 3


async def test_what_several_scenes_want_is_wanted_until_the_last_has_gone(stack: AsyncExitStack) -> None:
    here = await place(stack)
    one, two = await here.scene(), await here.scene()
    for each in (one, two):
        each.subscribe("robot1/talk", "std_msgs/String")  # as people write it in Unity
    await until(lambda: all(TALK in made.spelled for made in here.endpoint.scenes) and len(here.endpoint.scenes) == 2)
    here.endpoint.advertise(here.info(TALK)).publish(here.text("to both"), 0)
    await until(lambda: "robot1/talk" in one.got and "robot1/talk" in two.got, "by the name that it uses")
    await one.leave()
    await until(lambda: len(here.endpoint.scenes) == 1)
    assert here.looking.wanted == {TALK: True}
    await two.leave()
    await until(lambda: here.looking.wanted == {TALK: False})
    assert here.endpoint.ended[Ended.CLOSED] == 2


async def test_who_comes_late_gets_what_is_latched(stack: AsyncExitStack) -> None:
    here = await place(stack)
    publisher = here.endpoint.advertise(here.info(MAP, latched=True, depth=2))
    for number in range(4):
        publisher.publish(here.text(f"map {number}"), 0)
    unity = await here.scene()
    unity.subscribe(MAP, "std_msgs/String")
    await until(lambda: len(unity.got.get(MAP, [])) == 2)
    assert [here.said(body) for body in unity.got[MAP]] == ["map 2", "map 3"]


async def test_a_wrong_type_and_an_unknown_one_are_errors_that_name_them(stack: AsyncExitStack) -> None:
    here = await place(stack)
    here.endpoint.topic_offered(here.info(TALK))
    unity = await here.scene()
    unity.subscribe(TALK, "nav_msgs/Odometry")
    unity.subscribe("/made/up", "my_msgs/Thing")
    unity.publish("/mine", "my_msgs/Thing")
    unity.subscribe("/no/type", "String")
    unity.subscribe("no name", "std_msgs/String")
    await until(lambda: len(unity.errors) == 5)
    assert (
        "/robot1/talk is std_msgs/msg/String, and the scene subscribes to it as nav_msgs/msg/Odometry" in unity.errors
    )
    assert any("/made/up: the type my_msgs/msg/Thing is not known here" in text for text in unity.errors)
    assert any("my_msgs/msg/Thing" in text and "/mine" not in text[:1] for text in unity.errors[2:3])
    assert any("'String' is no type" in text for text in unity.errors)
    assert any("topic name '/no name' is not a ROS name" in text for text in unity.errors)
    assert here.endpoint.faults == 5 and not unity.closed
    here.endpoint.advertise(here.info(TopicName("/made/up")))
    await until(lambda: len(unity.errors) == 6)
    assert "/made/up is std_msgs/msg/String" in unity.errors[-1]


async def test_a_scene_publishes_what_the_file_names_while_it_is_there(stack: AsyncExitStack) -> None:
    here = await place(stack, publish=("/robot1/.*",))
    unity = await here.scene()
    unity.publish(TALK, "std_msgs/String")
    unity.publish("/other", "std_msgs/String")
    await until(lambda: TALK in here.events.infos and unity.errors)
    info = here.events.infos[TALK]
    assert (info.type_name, info.encoding) == (STRING, Encoding.CDR) and info.type_hash.startswith("RIHS01_")
    assert "/other may not be published from here" in unity.errors[0]
    got: list[bytes] = []

    def sink(body: bytes, stamp_ns: int) -> bool:
        got.append(body)
        return stamp_ns > 0

    subscription = here.endpoint.subscribe(TALK, sink)
    unity.send(TALK, here.text("hello"))
    unity.send("/other", here.text("not heard"))
    await until(lambda: got and len(unity.errors) == 2)
    assert here.said(got[0]) == "hello" and "/other: a message without __publish before it" in unity.errors[1]
    assert here.endpoint.drops == {DropReason.UNKNOWN_CHANNEL: 1}
    subscription.close()
    second = await here.scene()
    second.publish(TALK, "std_msgs/String")
    second.publish(TALK, "nav_msgs/Odometry")
    await until(lambda: second.errors)
    assert "/robot1/talk is published as std_msgs/msg/String by another" in second.errors[0]
    unity.say("remove_publisher", topic=TALK)
    unity.say("topic_list")
    await until(lambda: unity.told("topic_list"))
    assert TALK in here.events.infos, "the other one publishes it still"
    await second.leave()
    await until(lambda: TALK not in here.events.infos)


async def test_topics_are_listed_with_their_types_and_their_ages(stack: AsyncExitStack) -> None:
    here = await place(stack)
    here.endpoint.topic_offered(here.info(TALK))
    unity = await here.scene()
    unity.say("topic_list")
    await until(lambda: unity.told("topic_list"))
    listed = unity.told("topic_list")[0]
    assert dict(zip(listed["topics"], listed["types"], strict=True)) == {
        TALK: "std_msgs/String", f"{TALK}/sern/age": "std_msgs/Float32"
    }  # fmt: skip
    here.endpoint.topic_withdrawn(TALK)
    unity.say("topic_list")
    await until(lambda: len(unity.told("topic_list")) == 2)
    assert unity.told("topic_list")[1] == {"topics": [], "types": []}


async def test_the_age_of_a_topic_is_one_that_does_not_bring_it(stack: AsyncExitStack) -> None:
    here = await place(stack)
    here.endpoint.topic_offered(here.info(POSE, ODOM))
    here.looking.ages_s[POSE] = 1.5
    unity = await here.scene()
    unity.subscribe(f"{POSE}/sern/age", "std_msgs/Float32")
    await until(lambda: len(unity.got.get(f"{POSE}/sern/age", [])) >= 2)
    assert unity.got[f"{POSE}/sern/age"][0] == b"\0\1\0\0" + struct.pack("<f", 1.5)
    assert POSE not in here.looking.wanted and not unity.errors


async def test_scenes_call_services_of_other_sites(stack: AsyncExitStack) -> None:
    here = await place(stack)
    answers: dict[bytes, bytes | Exception] = {b"on": b"lit", b"off": ServiceError("no light")}

    async def handler(request: bytes) -> bytes:
        answer = answers[request]
        if isinstance(answer, Exception):
            raise answer
        return answer

    text = ros_services.resolve("std_srvs/srv/SetBool", "", Encoding.CDR).text
    server = here.endpoint.serve(
        ServiceInfo(LAMP, "std_srvs/srv/SetBool", Encoding.CDR, text.type_hash, text.definition), handler
    )
    unity = await here.scene()
    unity.say("ros_service", topic=LAMP, message_name="std_srvs/SetBool")
    for number, request in ((7, b"on"), (8, b"off")):
        unity.say("request", srv_id=number)
        unity.send(LAMP, request)
    await until(lambda: unity.told("response") and unity.errors)
    assert unity.told("response") == [{"srv_id": 7}] and unity.got[LAMP] == [b"lit"]
    assert unity.errors == ["/robot1/lamp: the call fails: no light"]
    unity.say("ros_service", topic=LAMP, message_name="std_srvs/Empty")
    await until(lambda: len(unity.errors) == 2)
    assert "/robot1/lamp is std_srvs/srv/SetBool, not std_srvs/srv/Empty" in unity.errors[1]
    server.close()
    unity.say("request", srv_id=9)
    unity.send(LAMP, b"on")
    await until(lambda: len(unity.errors) == 3)
    assert unity.errors[2] == "/robot1/lamp: no site offers this service"
    with pytest.raises(ConfigError, match="bodies cannot be served"):
        here.endpoint.serve(ServiceInfo(LAMP, "std_srvs/srv/SetBool", Encoding.ROS1, "", ""), handler)


async def test_other_sites_call_services_of_scenes(stack: AsyncExitStack) -> None:
    here = await place(stack)
    unity = await here.scene()
    unity.say("unity_service", topic="horn", message_name="std_srvs/SetBool")
    horn = TopicName("/horn")
    await until(lambda: horn in here.events.services)
    info = here.events.services[horn]
    assert info.type_name == "std_srvs/srv/SetBool" and info.type_hash.startswith("RIHS01_")
    call = asyncio.create_task(here.endpoint.call(horn, b"blow", timeout_s=DEADLINE_S))
    await until(lambda: unity.told("request") and unity.got.get("horn"))
    number = unity.told("request")[0]["srv_id"]
    assert unity.got["horn"] == [b"blow"]
    unity.say("response", srv_id=number + 1)
    unity.send("horn", b"of nobody")
    unity.say("response", srv_id=number)
    unity.send("horn", b"blown")
    assert await call == b"blown"
    assert here.endpoint.faults == 1
    with pytest.raises(ServiceError, match=r"did not answer within 0\.01 s"):
        await here.endpoint.call(horn, b"", timeout_s=0.01)
    last = asyncio.create_task(here.endpoint.call(horn, b"again", timeout_s=DEADLINE_S))
    await until(lambda: len(unity.got["horn"]) == 3)
    await unity.leave()
    with pytest.raises(ServiceError, match="has gone"):
        await last
    await until(lambda: horn not in here.events.services)
    with pytest.raises(ServiceError, match="no scene here has such a service"):
        await here.endpoint.call(horn, b"", timeout_s=1.0)


async def test_a_scene_offers_what_is_known_and_nobody_else_has(stack: AsyncExitStack) -> None:
    here = await place(stack)
    one, two = await here.scene(), await here.scene()
    one.say("unity_service", topic="/horn", message_name="std_srvs/SetBool")
    await until(lambda: "/horn" in here.events.services)
    two.say("unity_service", topic="/horn", message_name="std_srvs/SetBool")
    two.say("unity_service", topic="/mine", message_name="my_srvs/Thing")
    await until(lambda: len(two.errors) == 2)
    assert two.errors[0] == "/horn is a service of another scene" and "my_srvs/srv/Thing" in two.errors[1]
    one.say("remove_unity_service", topic="/horn")
    await until(lambda: not here.events.services)


async def test_signs_of_life_go_both_ways(stack: AsyncExitStack) -> None:
    here = await place(stack)
    unity = await here.scene()
    unity.writer.write(b"\0" * 8 * 3)
    await until(lambda: unity.signs_of_life >= 2)
    assert not unity.errors and here.endpoint.faults == 0


async def test_a_scene_that_reads_nothing_keeps_the_newest_and_is_ended(stack: AsyncExitStack) -> None:
    here = await place(stack, max_waiting_bytes=300_000, stalled_s=1.0)
    with socket.create_connection(("127.0.0.1", here.endpoint.port)) as stopped:
        stopped.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        reading = await here.scene()
        for name in (TALK, MAP):
            reading.subscribe(name, "std_msgs/String")
            command = json.dumps({"topic": name, "message_name": "std_msgs/String"}).encode()
            stopped.sendall(reading.frame("__subscribe", command))
        await until(lambda: len([each for each in here.endpoint.scenes if len(each.spelled) == 2]) == 2)
        lost = next(each for each in here.endpoint.scenes if each.address.endswith(f":{stopped.getsockname()[1]}"))
        newest, all_of_it = (here.endpoint.advertise(here.info(TALK, reliable=False)),
                             here.endpoint.advertise(here.info(MAP, reliable=True)))  # fmt: skip
        for number in range(200):
            newest.publish(here.text(f"{number:05}" + 100_000 * "x"), 0)
            all_of_it.publish(here.text(f"{number:05}" + 50_000 * "y"), 0)
            assert lost.waiting.nbytes < 600_000, "what waits is bounded"
            await asyncio.sleep(0)
        await until(lambda: here.said(reading.got[TALK][-1]).startswith("00199"), "it costs the other one nothing")
        await until(lambda: here.endpoint.ended[Ended.STALLED] == 1, deadline_s=DEADLINE_S)
    drops = here.endpoint.drops
    assert drops[DropReason.SUPERSEDED] > 100 and drops[DropReason.QUEUE_FULL] > 100 and drops[DropReason.DISCONNECTED]


@pytest.mark.parametrize(
    "sent",
    [
        struct.pack("<I", 2**32 - 1),
        struct.pack("<I", 2**31) + b"x",
        struct.pack("<I", 4) + b"/abc" + struct.pack("<I", 2**32 - 1),
        struct.pack("<I", 2) + b"\xff\xfe" + struct.pack("<I", 0),
        struct.pack("<I", 11) + b"__subscribe" + struct.pack("<I", 3) + b"{{{",
        struct.pack("<I", 11) + b"__subscribe" + struct.pack("<I", 2) + b"[]",
        struct.pack("<I", 11) + b"__subscribe" + struct.pack("<I", 11) + b'{"topic":7}',
        struct.pack("<I", 9) + b"__request" + struct.pack("<I", 15) + b'{"srv_id":true}',
        struct.pack("<I", 9) + b"__request" + struct.pack("<I", 100_000) + b"[" * 100_000,
    ],
)
async def test_what_is_no_frame_ends_its_connection_alone(
    stack: AsyncExitStack, sent: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    here = await place(stack)
    other, wrong = await here.scene(), await here.scene()
    other.subscribe(TALK, "std_msgs/String")
    wrong.writer.write(sent)
    await until(lambda: wrong.closed)
    assert here.endpoint.ended == {Ended.MALFORMED: 1} and here.endpoint.faults == 1
    assert caplog.text.count("the connection is closed") == 1
    await until(lambda: here.looking.wanted)
    here.endpoint.advertise(here.info(TALK)).publish(here.text("goes on"), 0)
    await until(lambda: TALK in other.got)


async def test_half_a_frame_and_an_unknown_command_cost_nothing(stack: AsyncExitStack) -> None:
    here = await place(stack)
    unity = await here.scene()
    unity.say("dance", topic="/x")
    await until(lambda: unity.errors)
    assert unity.errors == ["'__dance' is no command that is known here"]
    unity.writer.write(struct.pack("<I", 100) + b"half")
    await unity.writer.drain()
    unity.writer.write_eof()
    await until(lambda: here.endpoint.ended[Ended.CLOSED] == 1)
    assert here.endpoint.faults == 2


async def _send_without_end(connection: socket.socket, data: bytes) -> None:
    while True:
        await asyncio.get_running_loop().sock_sendall(connection, data)


async def test_floods_of_subscriptions_and_questions_are_bounded(stack: AsyncExitStack) -> None:
    here = await place(stack)
    unity = await here.scene()
    for number in range(MAX_SUBSCRIPTIONS + 500):
        unity.subscribe(f"/t{number}", "std_msgs/String")
    await until(lambda: here.endpoint.faults == 500)
    assert sum(here.looking.wanted.values()) == MAX_SUBSCRIPTIONS and len(unity.errors) <= 100
    await unity.leave()
    await until(lambda: not any(here.looking.wanted.values()))
    for number in range(300):
        here.endpoint.topic_offered(here.info(TopicName(f"/robot1/some/longer/name/{number}")))
    with socket.create_connection(("127.0.0.1", here.endpoint.port)) as asks:
        asks.setblocking(False)
        with pytest.raises(ConnectionError):
            await _send_without_end(asks, unity.frame("__topic_list", b"{}") * 100)
    assert here.endpoint.ended[Ended.UNREAD] == 1


async def test_a_second_endpoint_on_the_same_port_is_one_line(stack: AsyncExitStack) -> None:
    here = await place(stack)
    second = UnityEndpoint(UnityOptions(listen=f"127.0.0.1:{here.endpoint.port}"))
    with pytest.raises(ConfigError, match=r"endpoint unity: cannot listen on .*: the port is in use"):
        await second.start(Events())
    await second.stop()


async def test_the_network_is_let_in_only_where_that_is_meant() -> None:
    endpoint = UnityEndpoint(UnityOptions(listen="0.0.0.0:0"))
    with pytest.raises(ConfigError, match=r"0\.0\.0\.0:0 is open to the network"):
        await endpoint.start(Events())
    await endpoint.stop()


async def test_no_more_scenes_than_so_many(stack: AsyncExitStack, caplog: pytest.LogCaptureFixture) -> None:
    here = await place(stack, max_connections=1)
    first = await here.scene()
    async with scene(here.endpoint.port) as second:
        await until(lambda: second.closed)
    assert here.endpoint.refused == 1 and not first.closed and "more than 1 scenes" in caplog.text


async def test_scene_and_daemon_come_back_in_any_order(stack: AsyncExitStack) -> None:
    here = await place(stack)
    unity = await here.scene()
    unity.subscribe(TALK, "std_msgs/String")
    await until(lambda: here.looking.wanted.get(TALK))
    port = here.endpoint.port
    await here.endpoint.stop()
    await until(lambda: unity.closed)
    again = await place(stack, listen=f"127.0.0.1:{port}")
    back = await again.scene()
    back.subscribe(TALK, "std_msgs/String")
    await until(lambda: again.looking.wanted.get(TALK))
    again.endpoint.advertise(again.info(TALK)).publish(again.text("again"), 0)
    await until(lambda: TALK in back.got)
    with pytest.raises(ConfigError, match="ros1 bodies are no messages of ros2"):
        again.endpoint.advertise(ros_types.topic_info(MAP, STRING, Encoding.ROS1))
