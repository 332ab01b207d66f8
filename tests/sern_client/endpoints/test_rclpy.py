"""The rclpy endpoint with a stand-in for rclpy: what it makes of the graph, and which calls it makes.

With real nodes: `tests/peers/ros2`. The type checker compares the calls with `stubs/rclpy`.
"""

import asyncio
import dataclasses
import sys
import time
from collections import Counter
from collections.abc import Callable
from enum import Enum
from threading import Event
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sern_client.endpoints.base import Endpoint, Held
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.support import Events, until

CHAT = TopicName("/chatter")
STRING = "std_msgs/msg/String"


class History(Enum):
    KEEP_LAST = 1
    UNKNOWN = 3


class Reliability(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(Enum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Profile(SimpleNamespace):
    """A QoSProfile, with the durations that rclpy has where nobody named one."""

    lifespan = deadline = SimpleNamespace(nanoseconds=2**63 - 1)


class Graph:
    """What the stand-in's node sees, and what was done with it."""

    def __init__(self) -> None:
        self.nodes: dict[str, str] = {"sern": "/sern"}  # name -> enclave
        self.services: dict[str, dict[str, str]] = {}  # node -> service -> type
        self.servers: dict[str, Any] = {}
        self.readers = 0
        self.unnamed: list[str] = []  # services whose node is not known yet
        self.publishers: dict[str, list[tuple[str, str, Any]]] = {}  # topic -> (node, type, profile)
        self.subscriptions: dict[str, tuple[Callable[[bytes, dict[str, Any]], None], Any]] = {}
        self.published: list[tuple[str, bytes]] = []
        self.profiles: dict[str, Any] = {}
        self.ended = Event()
        self.failures: list[Exception] = []
        self.destroyed = False
        self.context: object = None

    def offer(
        self, topic: str, type_name: str = STRING, *, node: str = "talker", latched: bool = False, reliable: bool = True
    ) -> None:
        profile = Profile(
            reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
            durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
            history=History.UNKNOWN,
            depth=0,
        )
        if node:
            self.nodes.setdefault(node, "/")
        self.publishers.setdefault(topic, []).append((node, type_name, profile))

    def types(self) -> dict[str, list[str]]:
        """Types of the publishers of each topic."""
        return {name: [kind for _, kind, _ in offers] for name, offers in self.publishers.items()}

    # rclpy.node.Node

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        return [(name, "/", enclave) for name, enclave in self.nodes.items()]

    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]:
        unnamed = [(name, ["std_srvs/srv/SetBool"]) for name in self.unnamed]
        return unnamed + [(name, [kind]) for services in self.services.values() for name, kind in services.items()]

    def get_service_names_and_types_by_node(self, node: str, _namespace: str) -> list[tuple[str, list[str]]]:
        return [(name, [kind]) for name, kind in self.services.get(node, {}).items()]

    def count_publishers(self, topic: str) -> int:
        return len(self.publishers.get(topic, []))

    def get_subscriptions_info_by_topic(self, _topic: str) -> list[Any]:
        return []

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(name, sorted({kind for _, kind, _ in offers})) for name, offers in self.publishers.items()]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [
            SimpleNamespace(
                node_name=node, node_namespace="/", topic_type=kind, qos_profile=profile, topic_type_hash="INVALID"
            )
            for node, kind, profile in self.publishers.get(topic, [])
        ]

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[bytes, dict[str, Any]], None], profile: Any, *, raw: bool
    ) -> Any:
        assert raw, "bytes, not messages"
        assert kind.__module__ == "std_msgs.msg"
        self.subscriptions[topic] = (callback, profile)
        return (topic, callback)

    def destroy_subscription(self, subscription: tuple[str, Any]) -> bool:
        topic, callback = subscription
        if self.subscriptions[topic][0] is callback:  # else another one has replaced it
            del self.subscriptions[topic]
        return True

    def create_publisher(self, kind: type, topic: str, profile: Any) -> Any:
        self.offer(topic, f"std_msgs/msg/{kind.__name__}", node="sern")
        self.profiles[topic] = profile
        offer = self.publishers[topic][-1]
        return SimpleNamespace(
            topic=topic,
            offer=offer,
            publish=lambda body: self.published.append((topic, body)),
            get_subscription_count=lambda: self.readers,
        )

    def create_service(self, kind: type, name: str, callback: Any) -> Any:
        del kind
        self.servers[name] = SimpleNamespace(name=name, callback=callback, send_response=lambda *_: None)
        return self.servers[name]

    def destroy_service(self, service: Any) -> bool:
        del self.servers[service.name]
        return True

    def destroy_publisher(self, publisher: Any) -> bool:
        offers = self.publishers[publisher.topic]
        offers.remove(publisher.offer)
        if not offers:
            del self.publishers[publisher.topic]
        return True

    def create_guard_condition(self, callback: Callable[[], None]) -> Any:
        return SimpleNamespace(trigger=callback)

    def destroy_node(self) -> None:
        self.destroyed = True


class Packages:
    """Stands for packages of messages: every class of `std_msgs.msg`, and no file of it."""

    __file__ = None

    def __init__(self) -> None:
        self._classes: dict[str, type] = {}

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._classes.setdefault(name, type(name, (), {"__module__": "std_msgs.msg"}))


class ShutDownError(Exception):
    pass


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    made = Graph()

    class Context:
        def ok(self) -> bool:
            return True

    made.context = Context()

    class Executor:
        def __init__(self, *, context: object) -> None:
            assert isinstance(context, Context)

        def add_node(self, node: object) -> bool:
            assert node is made
            return True

        def spin(self) -> None:
            assert made.ended.wait(60)
            if made.failures:
                made.ended.clear()
                raise made.failures.pop(0)

        def shutdown(self, timeout_sec: float | None = None) -> bool:
            del timeout_sec
            made.ended.set()
            return True

    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda **_: None, "shutdown": lambda **_: None},
        "rclpy.context": {"Context": Context},
        "rclpy.duration": {"Duration": SimpleNamespace},
        "rclpy.executors": {"SingleThreadedExecutor": Executor, "ExternalShutdownException": ShutDownError},
        "rclpy.node": {"Node": lambda *_, **__: made, "NodeNameNonExistentError": LookupError},
        "rclpy.qos": {
            "QoSProfile": Profile,
            "HistoryPolicy": History,
            "ReliabilityPolicy": Reliability,
            "DurabilityPolicy": Durability,
        },
    }
    monkeypatch.delitem(sys.modules, "sern_client.endpoints.rclpy.executor", raising=False)  # of another test's rclpy
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("std_msgs", "std_msgs.msg", "std_srvs", "std_srvs.srv"):
        monkeypatch.setitem(sys.modules, name, Packages())
    return made


def about(stamp_ns: int = 5) -> dict[str, Any]:
    return {"source_timestamp": stamp_ns}


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
    callback(b"\0\x01\0\0one", about())
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
    before(b"waits for the loop", about(1))
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
    before(b"of the one before", about(2))
    callback(b"first", about(3))
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
    await until(lambda: graph.published == [(CHAT, b"one")], "written when who is there is known")
    assert graph.profiles[CHAT].durability is Durability.TRANSIENT_LOCAL
    assert graph.profiles[CHAT].reliability is Reliability.RELIABLE
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
    graph.offer("/two", "std_msgs/msg/Bool", node="other")
    await endpoint.start(events)
    assert {name: found.type_name for name, found in events.infos.items()} == {"/two": STRING}
    assert "/chatter: my_msgs/msg/Thing is not in this ROS 2 installation" in caplog.text
    assert "/two: /other publishes std_msgs/msg/Bool, others std_msgs/msg/String; /other is left out" in caplog.text
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
    await until(lambda: looks > 6)
    assert set(events.infos) == {CHAT, "/late"}, "what was there stays, what is new comes"
    assert not endpoint.validate(Held())
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
    await until(lambda: CHAT in events.infos)
    assert set(events.infos) == {CHAT} and endpoint.validate(Held()) == []
    assert caplog.text.count("the graph could not be looked at: no graph") == 1
    (watching,) = [task for task in asyncio.all_tasks() if task.get_name() == "rclpy-graph"]
    watching.cancel()
    await until(watching.done)
    assert [str(found) for found in endpoint.validate(Held())] == [
        "nobody looks at the graph any more; start the client again"
    ]
    await endpoint.stop()


async def test_without_an_installation_the_error_names_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(
        ConfigError, match=r"rclpy cannot be imported .* the Python that it was built for \(this is 3\."
    ):
        await RclpyEndpoint(RclpyOptions()).start(Events())


async def test_reliability_is_always_offered_and_depth_is_that_of_the_stream(graph: Graph) -> None:
    endpoint = RclpyEndpoint(RclpyOptions())
    await endpoint.start(Events())
    info = ros_types.topic_info(CHAT, STRING, Encoding.CDR, latched=True, reliable=False)
    publisher = endpoint.advertise(dataclasses.replace(info, depth=50))
    profile = graph.profiles[CHAT]
    assert (profile.reliability, profile.depth) == (Reliability.RELIABLE, 50)
    publisher.close()
    await endpoint.stop()


async def test_a_publisher_that_would_not_match_is_taken_as_well_and_nothing_comes_twice(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    graph.offer(CHAT)
    await endpoint.start(events)
    got: list[tuple[bytes, int]] = []

    def take(body: bytes, stamp_ns: int) -> bool:
        got.append((body, stamp_ns))
        return True

    subscription = endpoint.subscribe(CHAT, take)
    first, profile = graph.subscriptions[CHAT]
    assert profile.reliability is Reliability.RELIABLE
    graph.offer(CHAT, node="best", reliable=False)
    await until(lambda: graph.subscriptions[CHAT][0] is not first, "another one, which matches both")
    second, profile = graph.subscriptions[CHAT]
    assert profile.reliability is Reliability.BEST_EFFORT
    first(b"to both", about(7))
    second(b"to both", about(7))
    second(b"to both", about(8))
    await until(lambda: len(got) >= 2)
    assert got == [(b"to both", 7), (b"to both", 8)]
    subscription.close()
    await endpoint.stop()


async def test_what_we_published_is_not_taken_back(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions()), Events()
    graph.offer(CHAT)
    await endpoint.start(events)
    got: list[bytes] = []

    def take(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    subscription = endpoint.subscribe(CHAT, take)
    heard, _ = graph.subscriptions[CHAT]
    publisher = endpoint.advertise(ros_types.topic_info(CHAT, STRING, Encoding.CDR))
    began_ns = time.time_ns()
    publisher.publish(b"ours", 1)
    await until(lambda: graph.published == [(CHAT, b"ours")])
    heard(b"ours", {"source_timestamp": 0})  # a middleware that has no stamps: as many as we published
    heard(b"ours", {"source_timestamp": began_ns - 10**9})
    heard(b"theirs", {"source_timestamp": time.time_ns()})
    await until(lambda: b"theirs" in got)
    assert got == [b"ours", b"theirs"], "the equal one of another time is not ours"
    subscription.close()
    publisher.close()
    await endpoint.stop()


async def test_nodes_of_sern_and_nodes_without_a_name(graph: Graph, caplog: pytest.LogCaptureFixture) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    graph.nodes["bridge"] = "/sern"
    graph.offer("/from_afar", node="bridge")
    graph.offer("/both", node="bridge")
    graph.offer("/both")
    graph.offer("/guarded", node="bridge_guard")
    graph.nodes["bridge_guard"] = "/sern"
    graph.offer("/guarded")
    graph.offer("/early", node="")
    graph.services["bridge"] = {"/lamp": "std_srvs/srv/SetBool"}
    await endpoint.start(events)
    endpoint.watch_services(events)
    assert set(events.infos) == {"/guarded"} and not events.services
    assert "/both is published by /talker and by the SERN endpoint /bridge" in caplog.text
    await until(lambda: "/early" in events.infos, "its writer is of no node, and it is waited for no longer")
    del graph.publishers["/both"][0]
    graph.services["talker"] = {"/horn": "std_srvs/srv/SetBool"}
    await until(lambda: "/both" in events.infos and "/horn" in events.services)
    assert "/from_afar" not in events.infos and "/lamp" not in events.services
    await endpoint.stop()


async def test_a_service_whose_node_is_known_later_is_found(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100)), Events()
    endpoint.watch_services(events)
    graph.nodes["talker"] = "/"
    graph.unnamed = ["/horn"]
    await endpoint.start(events)
    assert not events.services
    graph.unnamed, graph.services["talker"] = [], {"/horn": "std_srvs/srv/SetBool"}
    await until(lambda: "/horn" in events.services, "by name and type nothing has changed")
    await endpoint.stop()


async def test_services_only_leaves_topics_alone(graph: Graph) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(poll_hz=100, services_only=True)), Events()
    endpoint.watch_services(events)
    graph.offer(CHAT)
    graph.services["talker"] = {"/horn": "std_srvs/srv/SetBool"}
    await endpoint.start(events)
    assert not events.infos and set(events.services) == {"/horn"}
    with pytest.raises(ConfigError, match="services_only"):
        endpoint.advertise(ros_types.topic_info(CHAT, STRING, Encoding.CDR))
    await endpoint.stop()


async def test_what_is_to_be_done_of_a_response_is_done_at_once(graph: Graph) -> None:
    from sern_client.endpoints.rclpy.executor import Executor

    done: list[tuple[int, int]] = []
    executor: Any = Executor(sys.modules["rclpy.node"].Node())
    assert executor.create_task(lambda one, two: done.append((one, two)), 1, two=2) is None
    assert done == [(1, 2)]


async def test_a_callback_that_fails_is_said_once_and_an_executor_that_ends_ends_the_domain(
    graph: Graph, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, events = RclpyEndpoint(RclpyOptions(domain=7, poll_hz=100)), Events()
    endpoint.watch_services(events)
    graph.offer(CHAT)
    graph.services["talker"] = {"/horn": "std_srvs/srv/SetBool"}
    graph.failures = [RuntimeError("one callback"), RuntimeError("one callback")]
    await endpoint.start(events)
    graph.ended.set()
    await until(lambda: len(graph.failures) == 1)
    graph.ended.set()
    await until(lambda: not graph.failures)
    assert endpoint.validate(Held()) == []
    assert set(events.infos) == {CHAT} and set(events.services) == {"/horn"}
    publisher = endpoint.advertise(ros_types.topic_info(TopicName("/ours"), STRING, Encoding.CDR))
    graph.ended.set()
    await until(lambda: not events.infos and not events.services)
    assert caplog.text.count("a callback of rclpy failed: one callback") == 1
    assert caplog.text.count("domain 7: the executor of rclpy was shut down by something else in this process") == 1
    assert any("was shut down" in str(found) for found in endpoint.validate(Held()))
    with pytest.raises(ConfigError, match="was shut down"):
        endpoint.advertise(ros_types.topic_info(CHAT, STRING, Encoding.CDR))
    with pytest.raises(ServiceError, match="no such service"):
        await endpoint.call(TopicName("/horn"), b"", timeout_s=60.0)
    publisher.publish(b"late", 1)
    publisher.close()
    await until(lambda: endpoint.drops == {DropReason.DISCONNECTED: 1})
    await endpoint.stop()
