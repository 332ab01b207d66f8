"""The `rclpy` endpoint among real nodes. No pytest collects it by itself: `test_rclpy_endpoint.py` runs it sourced."""

import asyncio
import logging
import os
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from sern_client.endpoints.base import Held, ServiceInfo
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.peers.dds.peer import free_domain
from tests.peers.ros2.sourced import RosNode, RosNodes, until_answered
from tests.support import DEADLINE_S, Events, until

STRING = "std_msgs/msg/String"

# Fast DDS keeps some sockets for the process from its first participant on: they are there before the tests count.
_first = Context()
rclpy.init(args=[], context=_first, domain_id=free_domain())
Node("first", context=_first).destroy_node()
rclpy.shutdown(context=_first)

MANY = TopicName("/many")
MAP = TopicName("/map")


def body(said: str) -> bytes:
    return ros_types.serialise(ros_types.new(STRING, Encoding.CDR, data=said), STRING, Encoding.CDR)


def said(body: bytes) -> str:
    return str(ros_types.deserialise(body, STRING, Encoding.CDR).data)


class Heard(Events):
    def __init__(self) -> None:
        super().__init__()
        self.got: list[str] = []
        self.stamps_ns: list[int] = []

    async def appeared(self, name: TopicName) -> None:
        await until(lambda: name in self.infos)

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        self.got.append(said(body))
        self.stamps_ns.append(stamp_ns)
        return True


class Place:
    """Endpoints and nodes of a test."""

    def __init__(self, nodes: RosNodes, stack: AsyncExitStack) -> None:
        self.nodes = nodes
        self._stack = stack

    async def endpoint(self, domain: int, **options: Any) -> tuple[RclpyEndpoint, Heard]:
        endpoint, heard = RclpyEndpoint(RclpyOptions(domain=domain, poll_hz=20.0, **options)), Heard()
        endpoint.watch_services(heard)
        await endpoint.start(heard)
        self._stack.push_async_callback(endpoint.stop)
        return endpoint, heard


@pytest.fixture
async def place(tmp_path: Path) -> AsyncIterator[Place]:
    async with AsyncExitStack() as stack:
        nodes = await stack.enter_async_context(RosNodes(tmp_path, os.environ["ROS_DISTRO"]))
        yield Place(nodes, stack)


def info(name: TopicName, **more: Any) -> TopicInfo:
    return replace(ros_types.topic_info(name, STRING, Encoding.CDR, reliable=True), **more)


async def write(node: RosNode, topic: str, text: str) -> None:
    await node.do("write", topic=topic, body=body(text).hex())


async def matched(node: RosNode, topic: str, count: int) -> None:
    await until_answered(lambda: node.do("matched", topic=topic), count)


async def test_a_topic_of_many_writers_has_no_echo(place: Place) -> None:
    """Ours and the node's, some of them equal byte for byte; then a best-effort publisher beside the reliable one."""
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    await node.do("pub", topic=MANY, type=STRING, depth=1000)
    await node.do("sub", topic=MANY, type=STRING, depth=1000)
    endpoint, heard = await place.endpoint(domain)
    await until(lambda: MANY in heard.infos)
    endpoint.subscribe(MANY, heard.sink)
    ours = endpoint.advertise(info(MANY, depth=1000))
    await matched(node, MANY, 2)
    began_ns = time.time_ns()
    for number in range(20):
        ours.publish(body("same"), 0)
        ours.publish(body(f"ours {number}"), 0)
        await write(node, MANY, f"theirs {number}")
        await write(node, MANY, "same")
    await node.event("got", 80, topic=MANY)
    await until(lambda: len(heard.got) >= 40)
    expected = [text for number in range(20) for text in (f"theirs {number}", "same")]
    assert heard.got == expected
    assert all(began_ns <= stamp_ns <= time.time_ns() for stamp_ns in heard.stamps_ns), "source stamps"
    assert heard.stamps_ns == sorted(heard.stamps_ns)

    other = await place.nodes.start(domain, "best")
    await other.do("pub", topic=MANY, type=STRING, best_effort=True)
    await matched(other, MANY, 1)  # ours: the node asks for reliable
    await write(other, MANY, "from best effort")
    await write(node, MANY, "from reliable")
    await until(lambda: len(heard.got) >= 42)
    assert sorted(heard.got[40:]) == ["from best effort", "from reliable"], "each once"


async def test_late_joiners_get_what_is_latched(place: Place) -> None:
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    await node.do("pub", topic=MAP, type=STRING, latched=True, depth=50)
    sent = [f"map {number}" for number in range(50)]
    for text in sent:
        await write(node, MAP, text)
    endpoint, heard = await place.endpoint(domain)
    await until(lambda: MAP in heard.infos)
    assert heard.infos[MAP].latched and heard.infos[MAP].reliable
    endpoint.subscribe(MAP, heard.sink)
    await until(lambda: len(heard.got) >= 50)
    assert heard.got == sent

    far = TopicName("/far")
    ours = endpoint.advertise(info(far, latched=True, depth=50))
    for text in sent:
        ours.publish(body(text), 0)
    late = await place.nodes.start(domain, "late")
    await late.do("sub", topic=far, type=STRING, latched=True, depth=50)
    await late.event("got", 50, topic=far)
    assert [text.partition("data='")[2].rstrip("')") for text in late.got(far)] == sent


async def test_topics_and_services_of_a_node_that_crashed_are_gone(place: Place) -> None:
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    await node.do("pub", topic=MANY, type=STRING)
    await node.do("serve", service="/lamp")
    endpoint, heard = await place.endpoint(domain)
    await until(lambda: MANY in heard.infos and "/lamp" in heard.services)
    assert heard.services[TopicName("/lamp")].type_name == "std_srvs/srv/SetBool"
    with pytest.raises(ServiceError, match="the request cannot be read"):
        await endpoint.call(TopicName("/lamp"), b"\0\1", timeout_s=60.0)
    assert await endpoint.call(TopicName("/lamp"), b"\0\1\0\0\1", timeout_s=60.0)
    place.nodes.kill("machine")
    await until(lambda: MANY not in heard.infos and "/lamp" not in heard.services, "the lease of Fast DDS is 20 s")
    with pytest.raises(ServiceError, match="no such service"):
        await endpoint.call(TopicName("/lamp"), b"\0\1\0\0\1", timeout_s=60.0)


async def test_a_domain_whose_executor_is_shut_down_ends_alone(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    domains = free_domain(), free_domain()
    nodes = [await place.nodes.start(domain, f"machine{index}") for index, domain in enumerate(domains)]
    for node in nodes:
        await node.do("pub", topic=MANY, type=STRING)
    (one, heard_one), (two, heard_two) = [await place.endpoint(domain) for domain in domains]
    for endpoint, heard in ((one, heard_one), (two, heard_two)):
        await heard.appeared(MANY)
        endpoint.subscribe(MANY, heard.sink)
    for index, node in enumerate(nodes):
        await matched(node, MANY, 1)
        await write(node, MANY, f"of {index}")
    await until(lambda: (heard_one.got, heard_two.got) == (["of 0"], ["of 1"]), "each domain its own")
    ours = one.advertise(info(TopicName("/ours")))

    opened = one.domain._open
    assert opened is not None
    with caplog.at_level(logging.ERROR):
        await asyncio.to_thread(opened.executor.shutdown)
        await until(lambda: MANY not in heard_one.infos)
    lines = [record.getMessage() for record in caplog.records if f"domain {domains[0]}" in record.getMessage()]
    assert len(lines) == 1 and "the executor of rclpy was shut down" in lines[0]
    before = one.drops.get(DropReason.DISCONNECTED, 0)
    ours.publish(body("nobody hears this"), 0)
    ours.close()
    assert sum(one.drops.values()) >= before
    with pytest.raises(ConfigError, match="was shut down"):
        one.advertise(info(TopicName("/more")))
    assert any("was shut down" in str(found) for found in one.validate(Held()))

    await write(nodes[1], MANY, "still there")
    await until(lambda: heard_two.got[-1] == "still there")


async def test_an_executor_that_is_about_to_wait_ends_all_the_same(place: Place) -> None:
    """It has looked whether it is to end, and comes to wait only after it was told to."""
    endpoint, _ = await place.endpoint(free_domain())
    opened = endpoint.domain._open
    assert opened is not None
    executor, spinning = opened.executor, opened.thread
    about_to_wait, told = Event(), Event()
    get_nodes, shutdown, trigger = executor.get_nodes, SingleThreadedExecutor.shutdown, executor._leaving.trigger

    def nodes() -> list[Node]:
        found = get_nodes()
        about_to_wait.set()
        told.wait()
        return found

    def before_going_on(call: Callable[..., object]) -> Callable[..., object]:
        def called(*args: Any) -> object:
            answer = call(*args)
            told.set()
            return answer

        return called

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "get_nodes", nodes)
        patch.setattr(executor._leaving, "trigger", before_going_on(trigger))
        patch.setattr(SingleThreadedExecutor, "shutdown", before_going_on(shutdown))
        executor.wake()
        await asyncio.to_thread(about_to_wait.wait)
        await asyncio.wait_for(endpoint.stop(), DEADLINE_S)
    assert not spinning.is_alive()


async def test_what_came_over_a_link_is_not_taken(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    domain = free_domain()
    bridge = await place.nodes.start(domain, "bridge", "--ros-args", "--enclave", "/sern")
    await bridge.do("pub", topic=MAP, type=STRING)
    await bridge.do("pub", topic=MANY, type=STRING)
    await bridge.do("serve", service="/lamp")
    node = await place.nodes.start(domain, "machine")
    await node.do("pub", topic="/own", type=STRING)
    endpoint, heard = await place.endpoint(domain)
    await until(lambda: "/own" in heard.infos)
    await node.do("pub", topic=MANY, type=STRING)
    await until(lambda: "does not tell their messages apart" in caplog.text)
    assert not {MAP, MANY} & heard.infos.keys()
    assert "/lamp" not in heard.services
    await bridge.do("unpub", topic=MANY)
    await until(lambda: MANY in heard.infos, "nobody else publishes it any more")
    _, chained = await place.endpoint(domain, node_name="chained", accept_bridged=True)
    await until(lambda: {MAP, MANY} <= chained.infos.keys() and "/lamp" in chained.services)
    assert endpoint.validate(Held()) == []


async def test_what_cannot_be_bridged_is_one_line(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    domain = free_domain()
    endpoint, heard = await place.endpoint(domain)
    with pytest.raises(ConfigError, match="nowhere_msgs/msg/Thing is not in this ROS 2 installation"):
        endpoint.advertise(TopicInfo(MANY, "nowhere_msgs/msg/Thing", Encoding.CDR))
    with pytest.raises(ConfigError, match="is no type of a message"):
        endpoint.advertise(TopicInfo(MANY, "std_srvs/srv/SetBool", Encoding.CDR))
    with pytest.raises(ConfigError, match="both sides need the same version of the type"):
        endpoint.advertise(info(MANY, type_hash="RIHS01_" + "1" * 64))

    async def never(_request: bytes) -> bytes:
        raise AssertionError("nobody calls")

    wrong = ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.CDR, "RIHS01_" + "1" * 64)
    with pytest.raises(ConfigError, match="both sides need the same version of the type"):
        endpoint.serve(wrong, never)
    node = await place.nodes.start(domain, "machine")
    await node.do("pub", topic=MANY, type=STRING)
    await until(lambda: MANY in heard.infos)
    other = await place.nodes.start(domain, "other")
    await other.do("pub", topic=MANY, type="std_msgs/msg/Int32")
    await until(lambda: "/other publishes std_msgs/msg/Int32, others std_msgs/msg/String" in caplog.text)
    endpoint.subscribe(MANY, heard.sink)
    await matched(node, MANY, 1)
    await node.do("write_raw", topic=MANY, body=b"\0\1\0\0\x02\0\0\0a".hex())  # not a whole one: passed as it is
    await write(node, MANY, "whole")
    await until(lambda: heard.got[-1:] == ["whole"])


async def test_a_failure_and_garbage_from_afar_leave_a_call_unanswered(place: Place) -> None:
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    endpoint, _ = await place.endpoint(domain, services_only=True)
    answers: list[bytes | ServiceError] = [ServiceError("lost"), b"\0\1\0", b"\0\1\0\0\1\0\0\0\3\0\0\0ok\0"]

    async def handler(request: bytes) -> bytes:
        answer = answers.pop(0)
        if isinstance(answer, ServiceError):
            raise answer
        return answer

    server = endpoint.serve(ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.CDR, ""), handler)
    for key in ("first", "second", "third"):
        await node.do("call", service="/lamp", data=True, key=key)
    assert (await node.event("answered"))["text"] == "ok"
    assert [each["key"] for each in node.of("answered")] == ["third"]
    with pytest.raises(ConfigError, match="services_only"):
        endpoint.advertise(info(MANY))
    server.close()
