"""The rclpy endpoint with a stand-in for rclpy: what it makes of the graph, and which calls it makes.

An installation of ROS 2 is not among the tests' peers; the type checker compares the calls with `stubs/rclpy`.
"""

import sys
from collections import Counter
from collections.abc import Callable
from enum import Enum
from threading import Event
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sern_client.endpoints.base import Endpoint, Held
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.support import Events, until

CHAT = TopicName("/chatter")
STRING = "std_msgs/msg/String"


class History(Enum):
    KEEP_LAST = 1


class Reliability(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(Enum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Graph:
    """What the stand-in's node sees, and what was done with it."""

    def __init__(self) -> None:
        self.publishers: dict[str, list[tuple[str, str, Any]]] = {}  # topic -> (node, type, profile)
        self.subscriptions: dict[str, tuple[Callable[[bytes], None], Any]] = {}
        self.published: list[tuple[str, bytes]] = []
        self.profiles: dict[str, Any] = {}
        self.ended = Event()
        self.destroyed = False

    def offer(self, topic: str, type_name: str = STRING, *, node: str = "talker", latched: bool = False) -> None:
        profile = SimpleNamespace(
            reliability=Reliability.RELIABLE,
            durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        )
        self.publishers.setdefault(topic, []).append((node, type_name, profile))

    # rclpy.node.Node

    def get_name(self) -> str:
        return "sern"

    def get_namespace(self) -> str:
        return "/"

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(name, sorted({kind for _, kind, _ in offers})) for name, offers in self.publishers.items()]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [
            SimpleNamespace(node_name=node, node_namespace="/", topic_type=kind, qos_profile=profile)
            for node, kind, profile in self.publishers.get(topic, [])
        ]

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[bytes], None], profile: Any, *, raw: bool
    ) -> Any:
        assert raw, "bytes, not messages"
        assert kind.__name__ in {"String", "Int32"}
        self.subscriptions[topic] = (callback, profile)
        return topic

    def destroy_subscription(self, subscription: str) -> bool:
        del self.subscriptions[subscription]
        return True

    def create_publisher(self, kind: type, topic: str, profile: Any) -> Any:
        self.offer(topic, f"std_msgs/msg/{kind.__name__}", node="sern")
        self.profiles[topic] = profile
        offer = self.publishers[topic][-1]
        return SimpleNamespace(topic=topic, offer=offer, publish=lambda body: self.published.append((topic, body)))

    def destroy_publisher(self, publisher: Any) -> bool:
        offers = self.publishers[publisher.topic]
        offers.remove(publisher.offer)
        if not offers:
            del self.publishers[publisher.topic]
        return True

    def destroy_node(self) -> None:
        self.destroyed = True


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    made = Graph()

    class Executor:
        def __init__(self, *, context: object) -> None:
            assert context is not None

        def add_node(self, node: object) -> bool:
            assert node is made
            return True

        def spin(self) -> None:
            assert made.ended.wait(60)

        def shutdown(self) -> bool:
            made.ended.set()
            return True

    def get_message(name: str) -> type:
        package, _, kind = name.rpartition("/")
        if package != "std_msgs/msg":
            raise ModuleNotFoundError(f"No module named {name.partition('/')[0]!r}")
        return type(kind, (), {})

    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda **_: None, "shutdown": lambda **_: None},
        "rclpy.context": {"Context": object},
        "rclpy.executors": {"SingleThreadedExecutor": Executor, "ExternalShutdownException": KeyError},
        "rclpy.node": {"Node": lambda *_, **__: made},
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "HistoryPolicy": History,
            "ReliabilityPolicy": Reliability,
            "DurabilityPolicy": Durability,
        },
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return made


async def test_topics_of_others_come_and_go_and_bytes_pass(graph: Graph) -> None:
    endpoint: Endpoint = RclpyEndpoint(RclpyOptions(poll_hz=20))
    events = Events()
    graph.offer(CHAT, latched=True)
    await endpoint.start(events)
    assert events.infos == {CHAT: ros_types.topic_info(CHAT, STRING, Encoding.CDR, latched=True, reliable=True)}

    got: list[bytes] = []

    def take(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    subscription = endpoint.subscribe(CHAT, take)
    callback, profile = graph.subscriptions[CHAT]
    assert (profile.reliability, profile.durability) == (Reliability.RELIABLE, Durability.TRANSIENT_LOCAL)
    callback(b"\0\x01\0\0one")
    await until(lambda: got == [b"\0\x01\0\0one"], "passed on")
    with pytest.raises(UsageError, match="no such topic"):
        endpoint.subscribe(TopicName("/other"), take)
    subscription.close()
    assert graph.subscriptions == {}

    graph.offer("/late")
    await until(lambda: "/late" in events.infos, "found by the next look")
    del graph.publishers[CHAT]
    await until(lambda: CHAT not in events.infos, "gone")
    await endpoint.stop()
    assert graph.ended.is_set() and graph.destroyed


async def test_what_nobody_wants_has_no_subscription(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    latched = TopicName("/map")
    graph.offer(CHAT)
    graph.offer(latched, latched=True)
    await endpoint.start(events)
    got: list[bytes] = []

    def take(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    opened = [endpoint.subscribe(name, take) for name in (CHAT, latched)]
    before, _ = graph.subscriptions[CHAT]
    before(b"waits for the loop")
    for name in (CHAT, latched):
        endpoint.interest(name, False)
    assert set(graph.subscriptions) == {latched}, "what is latched must be there for whoever comes"
    graph.offer("/late")
    await until(lambda: "/late" in events.infos, "the graph is looked at all the same")
    assert set(events.infos) == {CHAT, latched, "/late"}
    held = Held(subscriptions=Counter([CHAT, latched]))
    assert endpoint.validate(held) == [] and got == []

    graph.offer(CHAT, node="another", latched=True)
    del graph.publishers[CHAT][0]
    endpoint.interest(CHAT, True)
    callback, profile = graph.subscriptions[CHAT]
    assert profile.durability is Durability.TRANSIENT_LOCAL, "what the publishers of now offer is asked for"
    before(b"of the one before")
    callback(b"first")
    await until(lambda: got == [b"first"], "passed on")
    for subscription in opened:
        subscription.close()
    assert graph.subscriptions == {} and endpoint.validate(Held()) == []
    await endpoint.stop()


async def test_what_we_publish_is_not_announced_to_us(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=20)), Events()
    await endpoint.start(events)
    publisher = endpoint.advertise(ros_types.topic_info(CHAT, STRING, Encoding.CDR, latched=True))
    publisher.publish(b"one", 1)
    assert graph.published == [(CHAT, b"one")]
    assert graph.profiles[CHAT].durability is Durability.TRANSIENT_LOCAL
    graph.offer("/marker")
    await until(lambda: "/marker" in events.infos, "the graph was looked at")
    assert CHAT not in events.infos
    publisher.close()
    publisher.publish(b"two", 2)
    assert graph.published == [(CHAT, b"one")]
    await endpoint.stop()


async def test_a_type_that_is_not_installed_is_one_line(graph: Graph, caplog: pytest.LogCaptureFixture) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions()), Events()
    graph.offer(CHAT, "my_msgs/msg/Thing")
    graph.offer("/two")
    graph.offer("/two", "std_msgs/msg/Bool")
    await endpoint.start(events)
    assert events.infos == {}
    assert "/chatter: my_msgs/msg/Thing is not in this ROS 2 installation" in caplog.text
    assert "/two is published with several types (std_msgs/msg/Bool, std_msgs/msg/String)" in caplog.text
    with pytest.raises(ConfigError, match=r"/chatter: my_msgs/msg/Thing is not in this ROS 2 installation"):
        endpoint.advertise(TopicInfo(CHAT, "my_msgs/msg/Thing", Encoding.CDR))
    await endpoint.stop()


async def test_a_topic_that_cannot_be_looked_at_costs_no_other(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    graph.offer(CHAT)
    await endpoint.start(events)
    look, looks = graph.get_publishers_info_by_topic, 0

    def broken(topic: str) -> list[Any]:
        nonlocal looks
        looks += 1
        if topic == CHAT:
            raise ValueError("Invalid topic name")
        return look(topic)

    monkeypatch.setattr(graph, "get_publishers_info_by_topic", broken)
    graph.offer("/late")
    await until(lambda: looks > 6 or endpoint._task.done())
    assert set(events.infos) == {CHAT, "/late"}, "what was there stays, what is new comes"
    assert caplog.text.count("/chatter could not be looked at: Invalid topic name") == 1
    await endpoint.stop()


async def test_a_graph_that_cannot_be_looked_at_is_looked_at_again(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    await endpoint.start(events)
    look, looks = graph.get_topic_names_and_types, 0

    def broken() -> list[tuple[str, list[str]]]:
        nonlocal looks
        looks += 1
        if looks < 4:
            raise RuntimeError("no graph")
        return look()

    monkeypatch.setattr(graph, "get_topic_names_and_types", broken)
    graph.offer(CHAT)
    await until(lambda: CHAT in events.infos or endpoint._task.done())
    assert set(events.infos) == {CHAT} and endpoint.validate(Held()) == []
    assert caplog.text.count("the graph could not be looked at: no graph") == 1
    endpoint._task.cancel()
    await until(endpoint._task.done)
    assert [str(found) for found in endpoint.validate(Held())] == [
        "nobody looks at the graph any more; start the client again"
    ]
    await endpoint.stop()


async def test_without_an_installation_the_error_names_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ConfigError, match="needs a sourced ROS 2 installation"):
        await RclpyEndpoint(RclpyOptions()).start(Events())
