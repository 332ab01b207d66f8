"""Several endpoints as one."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.base import (
    Difference,
    Endpoint,
    Held,
    Publisher,
    ServiceEndpoint,
    ServiceInfo,
    Sink,
    Subscription,
    TopicEvents,
)
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime.ros_types import topic_info
from tests.fake_services import Services
from tests.support import Events as SeenServices

Make = Callable[..., Path]
Until = Callable[[Callable[[], bool]], Awaitable[None]]
CHAT = TopicName("/chat")
STRING = topic_info(CHAT, "std_msgs/msg/String", Encoding.ROS1)


class Fake:
    """An endpoint under the test's hand."""

    def __init__(self, problem: str = "", takes: Encoding | None = None) -> None:
        self.problem = problem
        self.takes = takes
        self.events: TopicEvents | None = None
        self.sinks: list[Sink] = []
        self.got: list[bytes] = []
        self.interests: list[tuple[TopicName, bool]] = []
        self.stopped = 0

    async def start(self, events: TopicEvents) -> None:
        if self.problem == "start":
            raise ConfigError("cannot start")
        self.events = events

    async def stop(self) -> None:
        self.stopped += 1
        if self.problem == "stop":
            raise ConfigError("cannot stop")

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        self.sinks.append(sink)
        fake = self

        class Part:
            def close(self) -> None:
                fake.sinks.remove(sink)

        return Part()

    def validate(self, held: Held) -> list[Difference]:
        del held
        return []

    def interest(self, name: TopicName, wanted: bool) -> None:
        self.interests.append((name, wanted))

    def advertise(self, info: TopicInfo) -> Publisher:
        if self.problem == "advertise":
            raise ConfigError("takes nothing")
        fake = self

        class Out:
            def publish(self, body: bytes, stamp_ns: int) -> None:
                fake.got.append(body)

            def close(self) -> None:
                fake.got.append(b"closed")

        return Out()

    @property
    def encoding(self) -> Encoding | None:
        return self.takes

    @property
    def exhausted(self) -> bool:
        return self.problem == "exhausted"


def test_is_an_endpoint() -> None:
    members: list[Endpoint] = [Fake(), BagEndpoint(BagOptions(Path("x.bag"))), RecordEndpoint(RecordOptions(Path("x")))]
    members.append(SyntheticEndpoint(SyntheticOptions(topics=0)))
    whole: Endpoint = CompositeEndpoint(members)
    assert not whole.exhausted
    assert CompositeEndpoint([Fake("exhausted"), RecordEndpoint(RecordOptions(Path("x")))]).exhausted


async def test_bag_plus_robot_plus_recorder(make_bag: Make, tmp_path: Path, events: Any, until: Until) -> None:
    robot = SyntheticEndpoint(SyntheticOptions(topics=("/pose",)))
    bag = BagEndpoint(BagOptions(make_bag("bag"), rate=0, namespaces=("r1",)))
    recorder = RecordEndpoint(RecordOptions(tmp_path / "out.bag"))
    whole = CompositeEndpoint([bag, robot, recorder])
    await whole.start(events)
    assert {"/r1/chat", "/pose"} <= set(events.infos)
    got: list[bytes] = []

    def sink(body: bytes, stamp_ns: int) -> bool:
        got.append(body)
        return True

    whole.subscribe(TopicName("/r1/chat"), sink)
    publisher = whole.advertise(topic_info("/cmd_vel", "geometry_msgs/msg/Twist", Encoding.ROS1))
    publisher.publish(bytes(48), 1)
    publisher.close()
    await until(lambda: len(got) == 10 and bag.exhausted)
    received = robot.received("/cmd_vel")
    assert received is not None and received.count == 1
    assert not whole.exhausted
    await whole.stop()
    assert recorder.counters.written == 1
    with pytest.raises(UsageError):
        whole.subscribe(TopicName("/nothing"), sink)


async def test_a_topic_of_two_members(events: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Announced once, heard from both, also when the second comes later; removed with the last."""
    one, two, odd = Fake(), Fake(), Fake()
    whole = CompositeEndpoint([one, two, odd])
    await whole.start(events)
    assert one.events is not None and two.events is not None and odd.events is not None
    one.events.topic_added(STRING)
    got: list[bytes] = []
    joined = whole.subscribe(CHAT, lambda body, stamp_ns: bool(got.append(body)))  # type: ignore[func-returns-value]
    two.events.topic_added(STRING)
    two.events.topic_added(STRING)
    with caplog.at_level(logging.WARNING):
        odd.events.topic_added(topic_info(CHAT, "std_msgs/msg/Bool", Encoding.ROS1))
    assert len(caplog.records) == 1 and "left out" in caplog.records[0].getMessage()
    assert [len(member.sinks) for member in (one, two, odd)] == [1, 1, 0]
    one.sinks[0](b"1", 0)
    two.sinks[0](b"2", 0)
    assert got == [b"1", b"2"]
    one.events.topic_removed(CHAT)
    odd.events.topic_removed(CHAT)
    assert events.removed == [] and [len(member.sinks) for member in (one, two)] == [0, 1]
    joined.close()
    assert two.sinks == []
    two.events.topic_removed(CHAT)
    assert events.removed == [CHAT]
    await whole.stop()


async def test_publishes_to_all_that_accept(events: Any) -> None:
    one, deaf, two = Fake(), Fake("advertise"), Fake()
    whole = CompositeEndpoint([one, deaf, two])
    await whole.start(events)
    publisher = whole.advertise(STRING)
    publisher.publish(b"x", 1)
    publisher.close()
    assert one.got == two.got == [b"x", b"closed"]
    await whole.stop()
    with pytest.raises(ConfigError, match="takes nothing"):
        CompositeEndpoint([deaf]).advertise(STRING)
    with pytest.raises(ConfigError, match=r"^takes nothing$"):
        CompositeEndpoint([deaf, Fake("advertise")]).advertise(STRING)


async def test_failures_leave_nothing_running(events: Any) -> None:
    good, bad, never = Fake(), Fake("start"), Fake()
    with pytest.raises(ConfigError, match="cannot start"):
        await CompositeEndpoint([good, bad, never]).start(events)
    assert (good.stopped, bad.stopped, never.stopped) == (1, 0, 0)
    first, second = Fake(), Fake("stop")
    whole = CompositeEndpoint([first, second])
    await whole.start(events)
    with pytest.raises(ConfigError, match="cannot stop"):
        await whole.stop()
    assert (first.stopped, second.stopped) == (1, 1)
    await whole.stop()  # again is harmless
    assert (first.stopped, second.stopped) == (1, 1)
    with pytest.raises(UsageError):
        CompositeEndpoint([])
    assert len(asyncio.all_tasks()) == 1


async def test_the_far_side_s_interest_reaches_those_that_give_the_topic(events: Any) -> None:
    provider, other = Fake(), Fake()
    endpoint = CompositeEndpoint([provider, other])
    await endpoint.start(events)
    assert provider.events is not None
    provider.events.topic_added(STRING)
    endpoint.interest(STRING.name, True)
    endpoint.interest(TopicName("/unknown"), True)
    assert provider.interests == [(STRING.name, True)]
    assert other.interests == []
    endpoint.interest(STRING.name, False)
    endpoint.subscribe(STRING.name, lambda _body, _stamp_ns: True)
    assert other.events is not None
    other.events.topic_added(STRING)
    assert other.interests == [(STRING.name, False)], "one that joins later is told what the others were"
    endpoint.interest(STRING.name, True)
    assert provider.interests[-1] == other.interests[-1] == (STRING.name, True)

    endpoint.interest(STRING.name, False)
    provider.events.topic_removed(STRING.name)
    other.events.topic_removed(STRING.name)
    other.interests.clear()
    other.events.topic_added(STRING)
    endpoint.subscribe(STRING.name, lambda _body, _stamp_ns: True)
    assert other.interests == [], "a topic that begins anew is wanted"
    await endpoint.stop()


def test_each_member_gets_the_encoding_it_takes() -> None:
    one, two = Fake(takes=Encoding.ROS1), Fake(takes=Encoding.CDR)
    whole = CompositeEndpoint([one, two])
    whole.advertise(STRING).publish(b"\x02\0\0\0hi", 1)
    assert one.got == [b"\x02\0\0\0hi"]
    assert two.got == [b"\0\x01\0\0\x03\0\0\0hi\0"]
    assert whole.encoding is None and whole.converter.failures == 0


async def test_services_are_called_where_they_are_and_served_where_they_are_taken() -> None:
    added: list[ServiceInfo] = []
    removed: list[TopicName] = []

    class Events:
        def service_added(self, info: ServiceInfo) -> None:
            added.append(info)

        def wants_service(self, name: TopicName) -> bool:
            return True

        def service_removed(self, name: TopicName) -> None:
            removed.append(name)

    first, second = Services(), Services()
    composite = CompositeEndpoint([Fake(), first, second])
    assert isinstance(composite, ServiceEndpoint)
    composite.watch_services(Events())
    assert first.events is not None and second.events is not None
    mode = ServiceInfo(TopicName("/mode"), "std_srvs/srv/Trigger", Encoding.ROS1, "")
    with pytest.raises(ServiceError, match="no service /mode"):
        await composite.call(mode.name, b"x", timeout_s=1)

    second.events.service_added(mode)
    first.events.service_added(mode)
    assert added == [mode], "once, though two members have it"
    assert await composite.call(mode.name, b"x", timeout_s=1) == b"re: x"
    assert (first.calls, second.calls) == ([], [(mode.name, b"x")])
    second.events.service_removed(mode.name)
    assert await composite.call(mode.name, b"y", timeout_s=1) == b"re: y"
    assert first.calls == [(mode.name, b"y")]
    assert removed == []
    first.events.service_removed(mode.name)
    assert removed == [mode.name]

    first.refuse = "not here"
    server = composite.serve(mode, first.echo)
    assert (list(first.served), list(second.served)) == ([], [mode.name])
    server.close()
    assert second.served == {}
    second.refuse = "nor here"
    with pytest.raises(ConfigError, match="not here; nor here"):
        composite.serve(mode, first.echo)


async def test_who_was_left_out_has_its_turn_when_the_first_is_gone(events: Any) -> None:
    first, second = Fake(), Fake()
    composite = CompositeEndpoint([first, second])
    await composite.start(events)
    assert first.events is not None and second.events is not None
    first.events.topic_added(TopicInfo(TopicName("/a"), "std_msgs/msg/String", Encoding.ROS1))
    second.events.topic_added(TopicInfo(TopicName("/a"), "std_msgs/msg/Int32", Encoding.ROS1))
    assert events.infos[TopicName("/a")].type_name == "std_msgs/msg/String"
    first.events.topic_removed(TopicName("/a"))
    assert events.infos[TopicName("/a")].type_name == "std_msgs/msg/Int32"
    second.events.topic_removed(TopicName("/a"))
    assert events.infos == {}
    await composite.stop()


async def test_a_member_that_fails_keeps_no_message_from_the_others() -> None:
    class Broken(Fake):
        def advertise(self, info: TopicInfo) -> Publisher:
            class Out:
                def publish(self, body: bytes, stamp_ns: int) -> None:
                    raise OSError("no room")

                def close(self) -> None:
                    raise OSError("no way")

            return Out()

    sound = Fake()
    composite = CompositeEndpoint([Broken(), sound])
    publisher = composite.advertise(TopicInfo(TopicName("/a"), "std_msgs/msg/String", Encoding.ROS1))
    with pytest.raises(OSError, match="no room"):
        publisher.publish(b"body", 0)
    assert sound.got == [b"body"]
    with pytest.raises(OSError, match="no way"):
        publisher.close()
    assert composite.validate(Held()) == []


async def test_a_member_whose_services_are_anothers_has_topics_only() -> None:
    topics, both = Services(), Services()
    composite = CompositeEndpoint([topics, both], no_services_of=[topics])
    heard = SeenServices()
    composite.watch_services(heard)
    assert topics.events is None and both.events is not None

    async def handler(request: bytes) -> bytes:
        return request

    mode = ServiceInfo(TopicName("/mode"), "std_srvs/srv/Trigger", Encoding.ROS1, "")
    composite.serve(mode, handler)
    assert (list(topics.served), list(both.served)) == ([], [mode.name]), "a call is answered once"
    both.events.service_added(mode)
    assert list(heard.services) == [mode.name]
    assert not CompositeEndpoint([topics], no_services_of=[topics]).has_services


async def test_a_member_with_services_only_is_given_no_topics(caplog: pytest.LogCaptureFixture) -> None:
    topics, services = Fake(), Fake()
    composite = CompositeEndpoint([topics, services], no_topics_of=[services])
    info = TopicInfo(TopicName("/a"), "std_msgs/msg/String", Encoding.ROS1)
    with caplog.at_level(logging.INFO):
        publisher = composite.advertise(info)
    publisher.publish(b"body", 0)
    assert (topics.got, services.got, caplog.messages) == ([b"body"], [], [])
    publisher.close()
    with pytest.raises(ConfigError, match="/a: the endpoints here have services only"):
        CompositeEndpoint([services], no_topics_of=[services]).advertise(info)


def test_services_need_a_member_that_knows_them() -> None:
    class Nobody:
        def service_added(self, info: ServiceInfo) -> None:
            raise AssertionError(info)

        def wants_service(self, name: TopicName) -> bool:
            return True

        def service_removed(self, name: TopicName) -> None:
            raise AssertionError(name)

    with pytest.raises(ConfigError, match="none of the endpoints has services"):
        CompositeEndpoint([Fake()]).watch_services(Nobody())


def test_drops_are_those_of_all_members() -> None:
    class Counting(Fake):
        def __init__(self, drops: dict[DropReason, int]) -> None:
            super().__init__()
            self.drops = drops

    one = Counting({DropReason.QUEUE_FULL: 2, DropReason.TOO_LARGE: 1})
    composite = CompositeEndpoint([one, Fake(), Counting({DropReason.QUEUE_FULL: 3})])
    assert composite.drops == {DropReason.QUEUE_FULL: 5, DropReason.TOO_LARGE: 1}
