"""Whatever connects and whatever it says: its connection ends or it is told, and everything else goes on."""

import asyncio
import json
import resource
import struct

import pytest

from sern_client.endpoints.unity import scene as scene_module
from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_client.endpoints.unity.faults import Fault
from sern_client.endpoints.unity.incoming import MAX_SUBSCRIPTIONS
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.unity.publications import MAX_PUBLICATIONS
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.sern_client.endpoints.unity.conftest import Started
from tests.sern_client.endpoints.unity.scene import FakeViewed, PlayedScene, Sinks, text_body
from tests.support import Events, until

CHAT = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
POSE = ros_types.topic_info("/pose", "std_msgs/msg/String", Encoding.CDR, reliable=False)
TF = ros_types.topic_info("/tf", "tf2_msgs/msg/TFMessage", Encoding.CDR, reliable=False)


def framed(destination: bytes, body: bytes) -> bytes:
    return struct.pack("<I", len(destination)) + destination + struct.pack("<I", len(body)) + body


FATAL = {
    "a page of a browser": b"POST / HTTP/1.1\r\nHost: 127.0.0.1:10000\r\n\r\n",
    "a destination of 4 GiB": b"\xff\xff\xff\xff/chat",
    "a destination of less than none": struct.pack("<i", -5) + b"/chat",
    "a body of 4 GiB": struct.pack("<I", 5) + b"/chat\xff\xff\xff\xff",
    "a command of a megabyte": struct.pack("<I", 12) + b"__subscribe\0" + struct.pack("<I", 1 << 20),
    "no UTF-8": framed(b"\xff\xfe/chat", b""),
}
TOLD = {
    "no JSON": framed(b"__subscribe\0", b"{topic: 1\0"),
    "JSON that is no UTF-8": framed(b"__subscribe\0", b'{"topic": "\xff"}\0'),
    "a list": framed(b"__subscribe\0", b"[1, 2]\0"),
    "a depth of 16000": framed(b"__subscribe\0", b"[" * 16000),
    "a number of 16000 digits": framed(b"__request\0", b'{"srv_id": ' + b"9" * 16000 + b"}"),
    "a topic that is a number": framed(b"__subscribe\0", b'{"topic": 5, "message_name": "std_msgs/String"}\0'),
    "no type": framed(b"__publish\0", b'{"topic": "/chat"}\0'),
    "a latch that is a text": framed(
        b"__publish\0", b'{"topic": "/a", "message_name": "std_msgs/String", "latch": "yes"}\0'
    ),
    "a number that is true": framed(b"__response\0", b'{"srv_id": true}\0'),
    "a number of 64 bits": framed(b"__request\0", b'{"srv_id": 9223372036854775807}\0'),
    "a command that nobody knows": framed(b"__dance\0", b"{}\0"),
    "a command without a name": framed(b"__", b""),
    "a name with spaces": framed(b"__subscribe\0", b'{"topic": "/a b", "message_name": "std_msgs/String"}\0'),
    "an empty name": framed(b"__publish\0", b'{"topic": "", "message_name": "std_msgs/String"}\0'),
    "a name of 10000 characters": framed(
        b"__subscribe\0", json.dumps({"topic": "/" + "a" * 10000, "message_name": "std_msgs/String"}).encode()
    ),
    "no name of a type": framed(b"__subscribe\0", b'{"topic": "/a", "message_name": "String"}\0'),
    "an empty type": framed(b"__unity_service\0", b'{"topic": "/a", "message_name": ""}\0'),
    "a service of no name": framed(b"__ros_service\0", b'{"topic": "//", "message_name": "std_srvs/Empty"}\0'),
    "a message of nothing that it has": framed(b"/nothing\0", b"\0\1\0\0"),
    "a call of nothing": framed(b"__request\0", b'{"srv_id": 1}\0') + framed(b"/nothing\0", b""),
    "an answer to nothing": framed(b"__response\0", b'{"srv_id": 1}\0'),
}


@pytest.mark.parametrize("piece_bytes", [None, 1])
@pytest.mark.parametrize("what", FATAL)
async def test_what_is_no_frame_ends_its_connection_alone(
    started: Started, port: int, caplog: pytest.LogCaptureFixture, what: str, piece_bytes: int | None
) -> None:
    endpoint = await started()
    async with PlayedScene(port) as other, PlayedScene(port, piece_bytes=piece_bytes) as scene:
        await other.subscribe("/chat")
        await other.caught_up()
        try:
            await scene.send(FATAL[what])
        except ConnectionError:
            assert piece_bytes == 1, "it may end before all of it has left"
        await until(scene.ended.is_set)
        endpoint.advertise(CHAT).publish(text_body("on"), 1)
        await until(lambda: other.bodies("/chat"))
    assert endpoint.faults.counts == {Fault.FRAMING: 1}
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1


@pytest.mark.parametrize("piece_bytes", [None, 1])
@pytest.mark.parametrize("what", TOLD)
async def test_what_means_nothing_is_told_and_the_connection_goes_on(
    started: Started, port: int, caplog: pytest.LogCaptureFixture, what: str, piece_bytes: int | None
) -> None:
    endpoint = await started()
    async with PlayedScene(port, piece_bytes=piece_bytes if len(TOLD[what]) < 1000 else None) as scene:
        await scene.send(TOLD[what])
        await until(lambda: scene.errors)
        await scene.send(TOLD[what])
        await scene.caught_up()
        assert len(scene.errors) == 1 and scene.errors[0].isprintable() and len(scene.errors[0]) < 400
    assert endpoint.faults.counts.total() == 2
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1


async def test_half_a_frame_and_silence(
    started: Started, port: int, monkeypatch: pytest.MonkeyPatch, viewed: FakeViewed
) -> None:
    monkeypatch.setattr(scene_module, "FIRST_S", 0.05)
    endpoint = await started()
    _reader, writer = await asyncio.open_connection("127.0.0.1", port)
    await until(lambda: endpoint.faults.counts[Fault.FRAMING] == 1)  # says nothing at all
    writer.transport.abort()
    endpoint.topic_offered(CHAT)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/chat")
        await scene.send(framed(b"/chat", b"whole")[:-3])
        await until(lambda: viewed.wanted)
    await until(lambda: not endpoint.scenes)
    assert not viewed.wanted


async def test_a_message_above_the_limit_is_read_over(started: Started, port: int, events: Events) -> None:
    endpoint = await started(max_message_bytes=1000)
    sinks = Sinks()
    async with PlayedScene(port) as scene:
        await scene.publish("/image")
        await scene.caught_up()
        endpoint.subscribe(TopicName("/image"), sinks.of("/image"))
        await scene.message("/image", bytes(5_000_000))
        await scene.message("/image", text_body("small"))
        await until(lambda: sinks["/image"] == [text_body("small")])
        await scene.told("max_message_bytes is 1000")
        assert endpoint.drops == {DropReason.TOO_LARGE: 1}


async def test_10000_subscriptions_and_publications(started: Started, port: int, viewed: FakeViewed) -> None:
    endpoint = await started()
    for number in range(10_000):
        endpoint.topic_offered(ros_types.topic_info(f"/t{number}", "std_msgs/String", Encoding.CDR))
    async with PlayedScene(port) as scene:
        for kind in ("__subscribe", "__publish"):
            flood = b"".join(
                scene.frame(kind, json.dumps({"topic": f"/t{number}", "message_name": "std_msgs/String"}).encode())
                for number in range(10_000)
            )
            await scene.send(flood)
        await scene.told(f"more than {MAX_SUBSCRIPTIONS} topics")
        await scene.told(f"more than {MAX_PUBLICATIONS} topics")
        await scene.caught_up()
        assert len(viewed.wanted) == MAX_SUBSCRIPTIONS
        assert endpoint.faults.counts == {Fault.TOO_MANY: 20_000 - MAX_SUBSCRIPTIONS - MAX_PUBLICATIONS}
    await until(lambda: not viewed.wanted)


async def test_while_one_floods_the_loop_has_its_turns(started: Started, port: int, viewed: FakeViewed) -> None:
    """A flood is served in turns of a few milliseconds: counted, so that a busy machine is no failure."""
    endpoint = await started()
    endpoint.topic_offered(CHAT)
    async with PlayedScene(port) as scene:
        on = scene.frame("__subscribe", b'{"topic": "/chat", "message_name": "std_msgs/String"}')
        off = scene.frame("__remove_subscriber", b'{"topic": "/chat"}')
        task = asyncio.create_task(scene.send((on + off) * 20_000))
        turns = 0
        while len(viewed.calls) < 40_000:
            await asyncio.sleep(0)
            turns += 1
        await task
        assert turns > 40, "the loop came round while 40,000 commands were served"
    assert viewed.calls == [(CHAT.name, True), (CHAT.name, False)] * 20_000


async def test_one_scene_too_many_is_told_so_and_sent_away(started: Started, port: int) -> None:
    endpoint = await started(max_connections=2)
    async with PlayedScene(port) as one, PlayedScene(port) as two:
        await one.caught_up()
        await two.caught_up()
        async with PlayedScene(port) as three:
            await three.told("2 scenes are connected already (max_connections)")
            await until(three.ended.is_set)
        assert len(endpoint.scenes) == 2
    await until(lambda: not endpoint.scenes)
    async with PlayedScene(port) as four:
        await four.caught_up()


async def test_a_port_that_is_taken_is_one_line(started: Started, port: int, events: Events) -> None:
    await started()
    second = UnityEndpoint(UnityOptions(listen=f"127.0.0.1:{port}"))
    with pytest.raises(ConfigError, match=rf"cannot listen on 127\.0\.0\.1:{port} .*another port") as raised:
        await second.start(events)
    assert "\n" not in str(raised.value)
    await second.stop()
    other_process = UnityEndpoint(UnityOptions(listen=f"127.0.0.1:{port}", second=True))
    await other_process.start(Events())
    await other_process.stop()


# --- scenes that do not read --------------------------------------------------------------------------------------


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


async def stopped(scene: PlayedScene, endpoint: UnityEndpoint, names: tuple[str, ...]) -> None:
    """A scene that subscribes and then reads nothing, not even what has come."""
    await scene.connect(reads=False)
    scene.writer.transport.set_write_buffer_limits(high=0)
    scene.reader._transport.pause_reading()  # type: ignore[attr-defined]
    for name in names:
        await scene.subscribe(name)
    await until(lambda: len(endpoint.scenes) == 2)


async def test_a_scene_that_does_not_read_costs_nobody_else_anything(
    started: Started, port: int, viewed: FakeViewed
) -> None:
    limit = 4 * 2**20
    endpoint = await started(queue_bytes=limit, stalled_s=3600.0)
    endpoint.topic_offered(CHAT)
    endpoint.topic_offered(POSE)
    chat, pose = endpoint.advertise(CHAT), endpoint.advertise(POSE)
    scene = PlayedScene(port)
    sent = 0
    async with PlayedScene(port) as reads:
        await reads.subscribe("/pose")
        await reads.caught_up()
        await stopped(scene, endpoint, ("/chat", "/pose"))
        await until(lambda: viewed.wanted == {"/chat", "/pose"})
        own = str(scene.writer.get_extra_info("sockname")[1])
        (still,) = [each for each in endpoint.scenes if each.peer.endswith(own)]
        before = peak_bytes()
        most = 0
        while sent < 256 * 2**20 or still.kept_bytes < limit // 2:
            for publisher in (chat, pose):
                publisher.publish(text_body("x" * 100_000), 1)
                sent += 100_000
            await until(lambda count=sent // 200_000: len(reads.bodies("/pose")) >= count)  # type: ignore[misc]
            reads.frames = [(name, b"") for name, _ in reads.frames]
            most = max(most, still.kept_bytes)
        assert most <= limit + 1_000_000, "what waits, and the pieces that are being written"
        assert peak_bytes() - before < 64 * 2**20
        assert endpoint.drops[DropReason.QUEUE_FULL] > 100
        assert endpoint.drops[DropReason.SUPERSEDED] > 100
    await scene.leave()
    await until(lambda: not endpoint.scenes)
    assert endpoint.drops[DropReason.DISCONNECTED] >= 1


async def test_a_scene_that_does_not_read_is_ended_after_its_time(
    started: Started, port: int, caplog: pytest.LogCaptureFixture, viewed: FakeViewed
) -> None:
    endpoint = await started(stalled_s=0.2)
    endpoint.topic_offered(CHAT)
    chat = endpoint.advertise(CHAT)
    scene = PlayedScene(port)
    async with PlayedScene(port) as reads:
        await reads.caught_up()
        await stopped(scene, endpoint, ("/chat",))
        await until(lambda: viewed.wanted)

        def published() -> bool:
            chat.publish(text_body("x" * 100_000), 1)
            return len(endpoint.scenes) == 1

        await until(published)
        assert endpoint.faults.counts == {Fault.STALLED: 1}
        assert endpoint.drops[DropReason.DISCONNECTED] >= 1
        assert [record.message for record in caplog.records if "has read nothing for 0.2 s" in record.message]
        await reads.caught_up()
    await scene.leave()


async def test_a_slow_scene_gets_the_newest_pose_and_all_transforms(started: Started, port: int) -> None:
    """What waits is in the outbox, where the newest takes the place of the others; nothing was sent meanwhile."""
    endpoint = await started()
    pose, tf = endpoint.advertise(POSE), endpoint.advertise(TF)
    async with PlayedScene(port) as scene:
        await scene.subscribe("/pose")
        await scene.subscribe("/tf", "tf2_msgs/TFMessage")
        await scene.caught_up()
        for number in range(50):  # in one turn of the loop
            pose.publish(text_body(f"{number}"), 1)
            tf.publish(b"\0\1\0\0%d" % number, 1)
        await until(lambda: scene.bodies("/pose") and len(scene.bodies("/tf")) == 50)
        await scene.caught_up()
        assert scene.bodies("/pose") == [text_body("49")]
        assert endpoint.drops == {DropReason.SUPERSEDED: 49}
