"""Topics between the dds endpoint and Fast DDS: bytes, policies, coming and going."""

import asyncio
import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from random import Random

import pytest

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import topic_info
from tests.peers.dds.conftest import MakeEndpoint, MakePeer, Recorder
from tests.sern_client.messages import made_up
from tests.support import until

CDR = Encoding.CDR
STRING = "std_msgs::msg::dds_::String_"
ODOMETRY = "nav_msgs::msg::dds_::Odometry_"
CLOUD = "sensor_msgs::msg::dds_::PointCloud2_"
STAMP_NS = 1_700_000_000_123_456_789
TYPES = {ODOMETRY: "nav_msgs/msg/Odometry", CLOUD: "sensor_msgs/msg/PointCloud2", STRING: "std_msgs/msg/String"}


def body_of(dds_type: str, seed: int = 1) -> bytes:
    name = TYPES[dds_type]
    return ros_types.serialise(made_up(ros_types.typestore(CDR), name, Random(seed)), name, CDR)


def cloud(size_bytes: int) -> bytes:
    name = TYPES[CLOUD]
    data = bytearray(Random(5).randbytes(size_bytes))
    import numpy as np

    message = ros_types.new(name, CDR, data=np.frombuffer(data, dtype="uint8"), width=7, is_dense=True)
    return ros_types.serialise(message, name, CDR)


def same(body: bytes, other: bytes) -> bool:
    """DDS pads bodies to four bytes."""
    short, long = sorted((body, other), key=len)
    return len(long) - len(short) < 4 and long[: len(short)] == short and not any(long[len(short) :])


def strangers(got: list[bytes], bodies: list[bytes]) -> dict[int, list[int] | bytes]:
    """What came at a wrong place: by that place the numbers it should have, or the bytes where nobody wrote them."""
    assert len(got) == len(bodies)
    return {
        place: [number for number, body in enumerate(bodies) if same(one, body)] or one
        for place, one in enumerate(got)
        if not same(one, bodies[place])
    }


def _has(recorder: Recorder, count: int) -> bool:
    return len(recorder.got) == count


@pytest.mark.parametrize("dds_type", [ODOMETRY, CLOUD, STRING])
async def test_from_ros2_to_the_link(
    dds_type: str, domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint
) -> None:
    """Found by itself, with definition and hash; the bytes and the time stamp are the publisher's."""
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do(f"pub a rt/robot/data {dds_type} reliable depth=1")
    await until(lambda: TopicName("/robot/data") in recorder.infos)
    info = recorder.infos[TopicName("/robot/data")]
    known = topic_info("/robot/data", TYPES[dds_type], CDR, reliable=True)
    assert info == known
    subscription = endpoint.subscribe(info.name, recorder.sink)
    await peer.line("matched a 1")
    await until(lambda: subscription.matched == 1)  # each side finds the other by itself
    bodies = [body_of(dds_type, seed) for seed in range(10)] * 2
    for number, body in enumerate(bodies, 1):  # one after the other: the publisher's buffers are used again
        await peer.do(f"write a {body.hex()}")
        await until(partial(_has, recorder, number))
    assert strangers([got for got, _ in recorder.got], bodies) == {}
    assert all(stamp_ns > STAMP_NS for _, stamp_ns in recorder.got)
    assert endpoint.counters.received == len(bodies) and endpoint.entities.overruns() == 0
    subscription.close()
    await peer.line("matched a 0")
    await peer.do("close a")
    await until(lambda: recorder.removed == [info.name])


@pytest.mark.parametrize("dds_type", [ODOMETRY, CLOUD, STRING])
async def test_from_the_link_to_ros2(
    dds_type: str, domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint
) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    publisher = endpoint.advertise(topic_info("/from/afar", TYPES[dds_type], CDR, reliable=True))
    await peer.do(f"sub b rt/from/afar {dds_type} reliable")
    await peer.line("matched b 1")
    await until(lambda: publisher.writer.matched == 1)  # each side finds the other by itself
    bodies = [body_of(dds_type, seed) for seed in range(10)]
    for body in bodies:
        publisher.publish(body, STAMP_NS)
    await peer.line("got b ", 9)
    assert strangers(peer.got("b"), bodies) == {}
    assert {words[3] for words in peer.lines("got b ")} == {str(STAMP_NS)}
    assert recorder.infos == {}  # what it itself publishes is no news
    publisher.close()
    publisher.close()
    publisher.publish(bodies[0], 1)
    await peer.line("matched b 0")
    assert endpoint.counters.written >= 10


async def test_large_messages_arrive_whole(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do(f"pub a rt/points {CLOUD} reliable")
    await peer.do(f"sub b rt/echo {CLOUD} reliable")
    await until(lambda: bool(recorder.infos))
    subscription = endpoint.subscribe(TopicName("/points"), recorder.sink)
    publisher = endpoint.advertise(topic_info("/echo", TYPES[CLOUD], CDR, reliable=True))
    await peer.line("matched a 1")
    await peer.line("matched b 1")
    await until(lambda: publisher.writer.matched == subscription.matched == 1)
    body = cloud(1_000_000)
    await peer.do(f"write a {body.hex()}")
    await until(lambda: len(recorder.got) == 1)
    assert same(recorder.got[0][0], body)
    publisher.publish(recorder.got[0][0], 5)
    await peer.line("got b ")
    assert same(peer.got("b")[0], body)


async def test_a_late_joiner_gets_the_latched(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    """Both ways: transient_local is taken over from a publisher and offered for a latched stream."""
    peer = await make_peer(domain)
    await peer.do(f"pub map rt/map {STRING} reliable transient_local depth=1")
    for text in ("old", "new"):
        body = ros_types.serialise(ros_types.new("std_msgs/msg/String", CDR, data=text), "std_msgs/msg/String", CDR)
        await peer.do(f"write map {body.hex()}")
    endpoint, recorder = await make_endpoint(domain)
    await until(lambda: TopicName("/map") in recorder.infos)
    assert recorder.infos[TopicName("/map")].latched
    endpoint.subscribe(TopicName("/map"), recorder.sink)
    await until(lambda: len(recorder.got) == 1)
    assert same(recorder.got[0][0], body)

    publisher = endpoint.advertise(topic_info("/tf_static", "std_msgs/msg/String", CDR, latched=True, reliable=True))
    publisher.publish(body, STAMP_NS)
    await peer.do(f"sub late rt/tf_static {STRING} reliable transient_local")
    await peer.line("got late ")
    assert same(peer.got("late")[0], body)


async def test_a_peer_that_crashes_is_missed(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    """It leaves when its lease ends, here after 3 s, and what it published with it."""
    _, recorder = await make_endpoint(domain)
    peer = await make_peer(domain, lease_s=3.0)
    other = await make_peer(domain)
    await peer.do(f"pub a rt/chat {STRING}")
    await other.do(f"pub b rt/other {STRING}")
    await until(lambda: len(recorder.infos) == 2)
    await peer.crash()
    await until(lambda: list(recorder.infos) == [TopicName("/other")])
    # On a busy machine it may have been missed before, and have come back.
    assert set(recorder.removed) == {TopicName("/chat")}


async def test_policies_that_do_not_match_are_named(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain)
    endpoint.advertise(topic_info("/chat", "std_msgs/msg/String", CDR, reliable=False))
    with caplog.at_level(logging.WARNING):
        await peer.do(f"sub a rt/chat {STRING} reliable transient_local deadline_ms=100")
        await peer.line("incompatible a ")
        await until(lambda: bool(caplog.records), "it waits for the name of a node, which this peer does not tell")
    (line,) = endpoint.graph.complaints.values()
    assert line.startswith("/chat: the subscriber of participant peer (010f")
    assert "reliability" not in line, "which is always offered"
    assert "durability (offered volatile, asked for transient_local)" in line
    assert "deadline (offered none, asked for 0.1 s)" in line
    assert [record.message for record in caplog.records] == [line]
    await peer.do("close a")
    await until(lambda: not endpoint.graph.complaints)
    await peer.do(f"sub b rt/chat {STRING}")
    await peer.line("matched b 1")
    assert not endpoint.graph.complaints


async def test_a_reader_stoops_to_the_least_of_its_writers(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint
) -> None:
    """First only a reliable, latched publisher; then a best-effort one beside it: both are heard."""
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do(f"pub a rt/chat {STRING} reliable transient_local lifespan_ms=5000 deadline_ms=2000")
    await until(lambda: bool(recorder.infos))
    info = recorder.infos[TopicName("/chat")]
    assert (info.reliable, info.latched, info.lifespan_s, info.deadline_s) == (True, True, 5.0, 2.0)
    subscription = endpoint.subscribe(info.name, recorder.sink)
    await peer.line("matched a 1")
    await peer.do(f"pub b rt/chat {STRING}")
    await peer.line("matched b 1")
    await until(lambda: subscription.matched == 2)
    await peer.do(f"write b {body_of(STRING, 2).hex()}")
    await until(lambda: any(same(body, body_of(STRING, 2)) for body, _ in recorder.got))
    await peer.until(lambda: len(peer.lines("matched a 1")) == 2)
    await peer.do(f"write a {body_of(STRING, 3).hex()}")
    await until(lambda: any(same(body, body_of(STRING, 3)) for body, _ in recorder.got))
    assert not endpoint.graph.complaints


async def test_deadline_is_offered(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain)
    info = TopicInfo(TopicName("/beat"), "std_msgs/msg/String", CDR, deadline_s=0.05, reliable=False)
    endpoint.advertise(info)
    await peer.do(f"sub a rt/beat {STRING} deadline_ms=100")
    await peer.line("matched a 1")


async def test_two_sern_endpoints_beside_each_other_make_no_loop(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint
) -> None:
    """What one brings from afar, the other does not offer to the link; a robot's own messages reach both."""
    peer = await make_peer(domain)
    one, heard_one = await make_endpoint(domain, node_name="sern_one")
    two, heard_two = await make_endpoint(domain, node_name="sern_two")
    chain, heard_chain = await make_endpoint(domain, node_name="chain", accept_bridged=True)
    await peer.do(f"pub a rt/tf {STRING} reliable")
    for recorder in (heard_one, heard_two, heard_chain):
        await until(lambda recorder=recorder: TopicName("/tf") in recorder.infos)  # type: ignore[misc]
    publisher = one.advertise(topic_info("/tf", "std_msgs/msg/String", CDR, reliable=True))
    only_ours = one.advertise(topic_info("/only/ours", "std_msgs/msg/String", CDR, reliable=True))
    subscriptions = [
        endpoint.subscribe(TopicName("/tf"), recorder.sink)
        for endpoint, recorder in ((one, heard_one), (two, heard_two), (chain, heard_chain))
    ]
    await peer.do(f"sub b rt/tf {STRING} reliable")
    await until(lambda: publisher.writer.matched == 3)  # the peer, and the readers of the other two
    await peer.line("matched a 4")  # those of all three, and its own
    # Our own writer is not among those of `one`; the others' readers have the peer's and that one.
    await until(lambda: [subscription.matched for subscription in subscriptions] == [1, 2, 2])
    await until(lambda: TopicName("/only/ours") in heard_chain.infos)
    publisher.publish(body_of(STRING, 1), 1)
    await peer.do(f"write a {body_of(STRING, 2).hex()}")
    await until(lambda: len(heard_chain.got) == 2)
    for recorder in (heard_one, heard_two):
        await until(lambda recorder=recorder: len(recorder.got) == 1)  # type: ignore[misc]
        assert same(recorder.got[0][0], body_of(STRING, 2))
        assert list(recorder.infos) == [TopicName("/tf")]
    only_ours.close()


async def test_a_topic_whose_name_is_no_text_hides_no_other(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    """It is said once and left out, whether it was there before us or comes later."""
    before = await make_peer(domain)
    await before.do(f"pub bad rt/a\udcff {STRING}")
    await before.do(f"pub good rt/good {STRING}")
    endpoint, heard = await make_endpoint(domain)
    await until(lambda: TopicName("/good") in heard.infos)
    await before.do(f"pub worse rt/b\udcff {STRING}")
    await before.do(f"pub later rt/later {STRING}")
    await until(lambda: TopicName("/later") in heard.infos)
    subscription = endpoint.subscribe(TopicName("/later"), heard.sink)
    await before.line("matched later 1")
    await until(lambda: subscription.matched == 1)
    await before.do(f"write later {body_of(STRING, 7).hex()}")
    await until(lambda: len(heard.got) == 1)
    assert set(heard.infos) == {TopicName("/good"), TopicName("/later")}
    assert len([text for text in caplog.messages if "announces what cannot be read" in text]) == 2
    assert endpoint.drops == {DropReason.UNDECODABLE: 2}
    await endpoint.stop()
    assert endpoint.drops == {DropReason.UNDECODABLE: 2}


async def test_several_domains_in_one_process(make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    from tests.peers.dds.peer import free_domain

    first, second = free_domain(), free_domain()
    peer_one, peer_two = await make_peer(first), await make_peer(second)
    one, heard_one = await make_endpoint(first)
    two, heard_two = await make_endpoint(second)
    await peer_one.do(f"pub a rt/first {STRING}")
    await peer_two.do(f"pub b rt/second {STRING}")
    await until(lambda: list(heard_one.infos) == [TopicName("/first")])
    await until(lambda: list(heard_two.infos) == [TopicName("/second")])
    publisher = two.advertise(topic_info("/first", "std_msgs/msg/String", CDR))
    subscription = one.subscribe(TopicName("/first"), heard_one.sink)
    publisher.publish(body_of(STRING), 1)
    await peer_one.line("matched a 1")
    await until(lambda: subscription.matched == 1)
    await peer_one.do(f"write a {body_of(STRING, 4).hex()}")
    await until(lambda: len(heard_one.got) == 1)
    assert same(heard_one.got[0][0], body_of(STRING, 4))


async def test_nothing_stays_behind(domain: int, make_endpoint: MakeEndpoint) -> None:
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))  # never a second thread
    before = threading.active_count()
    endpoint, _ = await make_endpoint(domain)
    endpoint.advertise(topic_info("/x", "std_msgs/msg/String", CDR))
    assert any(thread.name == "sern-dds" for thread in threading.enumerate())
    await endpoint.stop()
    await endpoint.stop()
    assert not any(thread.name == "sern-dds" for thread in threading.enumerate())
    assert threading.active_count() <= before + 1  # a thread of the loop's pool may wait for more work
    with pytest.raises(UsageError, match="not running"):
        endpoint.advertise(topic_info("/x", "std_msgs/msg/String", CDR))


async def test_nobody_wants_it(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do(f"pub a rt/chat {STRING}")
    await until(lambda: bool(recorder.infos))
    endpoint.subscribe(TopicName("/chat"), recorder.sink)
    await peer.line("matched a 1")
    endpoint.interest(TopicName("/chat"), False)
    await peer.line("matched a 0")
    endpoint.interest(TopicName("/chat"), True)
    await peer.line("matched a 1", 1)


async def test_refusals_are_counted(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    recorder.accepts = False
    await peer.do(f"pub a rt/chat {STRING} reliable")
    await until(lambda: bool(recorder.infos))
    subscription = endpoint.subscribe(TopicName("/chat"), recorder.sink)
    await peer.line("matched a 1")
    await until(lambda: subscription.matched == 1)
    await peer.do(f"write a {body_of(STRING).hex()}")
    await until(lambda: endpoint.counters.refused == 1)


async def test_what_cannot_be_advertised(domain: int, make_endpoint: MakeEndpoint) -> None:
    endpoint, _ = await make_endpoint(domain)
    endpoint.advertise(topic_info("/chat", "std_msgs/msg/String", CDR))
    for info, said in (
        (topic_info("/x", "std_msgs/msg/String", Encoding.ROS1), "ros1 bodies cannot be published"),
        (TopicInfo(TopicName("/x"), "no_msgs/msg/Such", CDR), "type_paths"),
        (
            TopicInfo(TopicName("/x"), "std_msgs/msg/String", CDR, "RIHS01_0", "string data\n"),
            "came with hash RIHS01_0",
        ),
        (topic_info("/chat", "std_msgs/msg/Int32", CDR), "in use here with type std_msgs::msg::dds_::String_"),
    ):
        with pytest.raises(ConfigError, match=said) as caught:
            endpoint.advertise(info)
        assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match="no such topic"):
        endpoint.subscribe(TopicName("/nowhere"), lambda body, stamp_ns: True)
