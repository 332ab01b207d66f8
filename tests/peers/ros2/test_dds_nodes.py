"""The `dds` endpoint among real rclpy nodes of Jazzy and Kilted with their default middleware, rmw_fastrtps."""

import logging
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.base import Publisher
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.peers.dds.peer import free_domain
from tests.peers.ros2.sourced import DISTROS, PLACES, RosNode, RosNodes, until_answered
from tests.sern_client.messages import made_up
from tests.support import Events, until

PACKAGES: Final = ("test_msgs", "std_msgs", "sensor_msgs", "geometry_msgs", "nav_msgs")
NAMED: Final = {"test_msgs/msg/WStrings"}
"""Types that docs/ros2-dds.md says do not pass."""
STRING: Final = "std_msgs/msg/String"
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
CHAT: Final = TopicName("/chat")


class Heard(Events):
    """What a site hears that has no rule for services."""

    def wants_service(self, name: TopicName) -> bool:
        return False


class Place:
    """Nodes of a distribution, and endpoints that read its definitions."""

    def __init__(self, distro: str, nodes: RosNodes, stack: AsyncExitStack) -> None:
        self.distro = distro
        self.nodes = nodes
        self.share = PLACES / distro / "share"
        self._stack = stack

    async def endpoint(self, domain: int, **options: Any) -> tuple[DdsEndpoint, Heard]:
        paths = tuple(self.share / package for package in PACKAGES)
        settings = DomainOptions(domain, localhost_only=True)
        endpoint, heard = DdsEndpoint(DdsOptions(settings, type_paths=paths, **options)), Heard()
        endpoint.watch_services(heard)
        await endpoint.start(heard)
        self._stack.push_async_callback(endpoint.stop)
        return endpoint, heard


@pytest.fixture(params=DISTROS)
async def place(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Place]:
    async with AsyncExitStack() as stack:
        nodes = await stack.enter_async_context(RosNodes(tmp_path, request.param))
        yield Place(request.param, nodes, stack)


def types_of(share: Path) -> Iterator[str]:
    for package in PACKAGES:
        yield from (f"{package}/msg/{file.stem}" for file in sorted((share / package / "msg").glob("*.msg")))


def body_of(endpoint: DdsEndpoint, type_name: str, seed: int) -> bytes:
    """A message of random content, by the definition that the endpoint finds."""
    text = endpoint.types.message(type_name)
    resolved = ros_types.resolve(type_name, text.definition, Encoding.CDR)
    message = made_up(resolved.store, resolved.name, Random(seed))
    return bytes(resolved.store.serialize_cdr(message, resolved.name))


def onwards(far: Publisher) -> Callable[[bytes, int], bool]:
    """A sink that publishes elsewhere."""

    def sink(body: bytes, stamp_ns: int) -> bool:
        far.publish(body, stamp_ns)
        return True

    return sink


def named(type_name: str, caplog: pytest.LogCaptureFixture) -> Callable[[], bool]:
    return lambda: any(type_name in line for line in caplog.messages)  # a list of what there is, made at each look


async def matched(node: RosNode, topic: str, count: int = 1) -> None:
    await until_answered(lambda: node.do("matched", topic=topic), count)


async def test_every_type_crosses_to_a_late_joiner(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    """Latched, from one domain through two endpoints of this process to a node that comes last; equal by value."""
    domains = free_domain(), free_domain()
    one, heard = await place.endpoint(domains[0])
    two, _ = await place.endpoint(domains[1])
    machine = await place.nodes.start(domains[0], "machine")
    names = {type_name: TopicName("/" + type_name.replace("/", "_")) for type_name in types_of(place.share)}
    assert len(names) > 100
    sent: dict[TopicName, str] = {}
    for seed, (type_name, name) in enumerate(names.items()):
        await machine.do("pub", topic=name, type=type_name, latched=True, depth=1)
        if type_name not in NAMED:
            body = body_of(one, type_name, seed)
            sent[name] = (await machine.do("write", topic=name, body=body.hex()))["value"]
    await until(lambda: sent.keys() <= heard.infos.keys())
    for name in sent:
        far = two.advertise(replace(heard.infos[name], depth=1))
        one.subscribe(name, onwards(far))
    desk = await place.nodes.start(domains[1], "desk")
    for type_name, name in names.items():
        if name in sent:
            await desk.do("sub", topic=name, type=type_name, latched=True, depth=1)
    await until(lambda: len(desk.of("got")) >= len(sent))
    assert {each["topic"]: each["value"] for each in desk.of("got")} == sent
    assert len(desk.of("got")) == len(sent), "each once"
    for type_name in NAMED:
        await until(named(type_name, caplog))


async def test_nodes_that_name_no_quality_of_service_hear_a_best_effort_stream(place: Place) -> None:
    """Clouds of 1 MB, none lost, and both ways; nothing comes back."""
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    await node.do("sub", topic="/points", type=CLOUD, sized=True)
    endpoint, heard = await place.endpoint(domain)
    info = ros_types.topic_info("/points", CLOUD, Encoding.CDR, reliable=False)
    stream = endpoint.advertise(info)
    cloud = ros_types.new(CLOUD, Encoding.CDR)
    cloud.data = np.zeros(10**6, "uint8")
    body = ros_types.serialise(cloud, CLOUD, Encoding.CDR)
    for count in range(1, 11):
        stream.publish(body, 0)
        await node.event("got", count, topic="/points")
    await node.do("pub", topic=CHAT, type=STRING)
    await until(lambda: CHAT in heard.infos)
    got: list[bytes] = []

    def sink(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    endpoint.subscribe(CHAT, sink)
    await matched(node, CHAT)
    text = ros_types.serialise(ros_types.new(STRING, Encoding.CDR, data="hello"), STRING, Encoding.CDR)
    await node.do("write", topic=CHAT, body=text.hex())
    await until(lambda: len(got) == 1)
    assert ros_types.deserialise(got[0], STRING, Encoding.CDR).data == "hello"
    assert heard.added.count(CHAT) == 1 and "/points" not in heard.added and endpoint.drops == {}


async def test_the_first_message_of_a_stream_arrives(place: Place) -> None:
    domain = free_domain()
    node = await place.nodes.start(domain, "machine")
    await node.do("sub", topic="/goal", type=STRING)
    endpoint, _ = await place.endpoint(domain)
    await until(lambda: bool(endpoint.graph.readers("rt/goal")))
    info = ros_types.topic_info("/goal", STRING, Encoding.CDR, reliable=True)
    for number in range(5):
        said = ros_types.serialise(ros_types.new(STRING, Encoding.CDR, data=f"goal {number}"), STRING, Encoding.CDR)
        stream = endpoint.advertise(info)
        stream.publish(said, 0)
        await node.event("got", number + 1, topic="/goal")
        stream.close()
    assert [text.count("goal") for text in node.got("/goal")] == [1] * 5
    assert endpoint.drops == {}


async def test_what_does_not_fit_is_said_of_nodes_by_name(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    """A durability, a type and a hash that do not match; nobody's parameter services are spoken of."""
    domain = free_domain()
    endpoint, heard = await place.endpoint(domain)
    node = await place.nodes.start(domain, "machine")
    with caplog.at_level(logging.INFO):
        endpoint.advertise(ros_types.topic_info("/map", STRING, Encoding.CDR))
        await node.do("sub", topic="/map", type=STRING, latched=True)
        await until(lambda: any("node /machine" in line and "durability" in line for line in caplog.messages))
        other = await place.nodes.start(domain, "other")
        await other.do("sub", topic="/map", type="std_msgs/msg/Int32")
        await until(lambda: any("node /other" in line and "type (std_msgs" in line for line in caplog.messages))
        await node.do("pub", topic=CHAT, type=STRING)
        await until(lambda: CHAT in heard.infos)
    wrong = replace(heard.infos[CHAT], name=TopicName("/wrong"), type_hash="RIHS01_" + "1" * 64)
    with pytest.raises(ConfigError, match="/wrong: std_msgs/msg/String came with hash RIHS01_1"):
        endpoint.advertise(wrong)
    assert not [line for line in caplog.messages if "parameter" in line]
    assert heard.services == {}


async def test_a_node_that_crashes_is_gone_after_its_lease(place: Place) -> None:
    """20 s with rmw_fastrtps, as docs/ros2.md says; what others publish stays."""
    domain = free_domain()
    crashing, other = [await place.nodes.start(domain, name) for name in ("crashing", "other")]
    await crashing.do("pub", topic=CHAT, type=STRING)
    await other.do("pub", topic="/other", type=STRING)
    _, heard = await place.endpoint(domain)
    await until(lambda: {CHAT, "/other"} <= heard.infos.keys())
    place.nodes.kill("crashing")
    await until(lambda: CHAT not in heard.infos)
    assert "/other" in heard.infos


async def test_nodes_see_one_node_of_ours(place: Place) -> None:
    domain = free_domain()
    endpoint, _ = await place.endpoint(domain, node_name="bridge")
    endpoint.advertise(ros_types.topic_info("/map", STRING, Encoding.CDR))
    node = await place.nodes.start(domain, "machine")

    async def names() -> dict[str, Any]:
        return {"count": (await node.do("nodes"))["names"].count("/bridge")}

    await until_answered(names, 1)
