"""Which readers the dds endpoint has for a topic whose writers come and go."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from typing import Any
from uuid import UUID

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.common.stream import Stream
from sern_client.endpoints.dds import endpoint as module
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.dds.entities import Writer
from sern_client.endpoints.dds.graph import Remote
from sern_client.endpoints.dds.qos import EndpointQos, mismatches, reader_for, within_reach
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime.ros_types import topic_info
from tests.peers.dds.peer import free_domain
from tests.support import DEADLINE_S, Events, until

STRING = "std_msgs::msg::dds_::String_"
RELIABLE = EndpointQos(reliable=True)
HIDDEN = replace(RELIABLE, partitions=("x",))
EXCLUSIVE = replace(RELIABLE, exclusive=True)


@pytest.mark.parametrize(
    ("partitions", "reached"),
    [
        ((), True),
        (("",), True),
        (("x", ""), True),
        (("x",), False),
        (("*",), True),
        (("x", "**"), True),
        (("x*",), False),
    ],
)
def test_writers_in_other_partitions_are_out_of_reach(partitions: tuple[str, ...], reached: bool) -> None:
    writer = EndpointQos(partitions=partitions)
    assert (within_reach([writer]) == [writer]) is reached
    assert ("partition" not in mismatches(writer, EndpointQos())) is reached


@pytest.mark.parametrize(("shared", "exclusive"), [(2, 1), (1, 2), (1, 50), (1, 1), (0, 1), (0, 3), (2, 0)])
def test_exclusive_writers_take_no_reader_from_a_shared_one(shared: int, exclusive: int) -> None:
    writers = [RELIABLE] * shared + [EXCLUSIVE] * exclusive + [replace(EXCLUSIVE, partitions=("x",))] * 5
    reached = within_reach(writers)
    assert reached == ([RELIABLE] * shared or [EXCLUSIVE] * exclusive)
    assert all(not mismatches(writer, reader_for(reached)) for writer in reached)


def writer(number: int, **changed: Any) -> Remote:
    there = Remote(UUID(int=number), UUID(int=9), True, "rt/chat", STRING, RELIABLE, number)
    return replace(there, **changed)


def settle(endpoint: DdsEndpoint) -> int:
    """Have the endpoint heed all that changed. How many topics and services that were."""
    count = 1
    while endpoint.settle():
        count += 1
    return count


class Pair:
    """Two endpoints of this process in one domain; what `two` opens of readers is in `opened`."""

    def __init__(self, one: DdsEndpoint, two: DdsEndpoint, heard: Events, opened: list[EndpointQos]) -> None:
        self.one, self.two, self.opened = one, two, opened
        self.got: list[bytes] = []
        self._heard = heard

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        self.got.append(body)
        return True

    def add(self, remote: Remote) -> None:
        """A writer comes that `two` is told of."""
        self.two.graph.remote_added(remote)
        settle(self.two)

    async def announced(self) -> None:
        """/chat can be subscribed to at `two`: not as soon as its graph has the writer, but when it has heeded it."""
        await until(lambda: TopicName("/chat") in self._heard.infos)

    async def connect(self) -> Stream[Writer]:
        """Take /chat of `one` at `two`."""
        info = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
        publisher = self.one.advertise(replace(info, depth=500))
        await self.announced()
        self.two.subscribe(TopicName("/chat"), self.sink)
        await until(lambda: publisher.writer.matched == 1)
        assert not publisher.waits and len(self.opened) == 1
        return publisher


def body(number: int) -> bytes:
    return b"\0\x01\0\0\x08\0\0\0" + b"%07d\0" % number


@pytest.fixture
async def pair(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Pair]:
    monkeypatch.setattr(module, "LEARN_S", 0.0)  # nobody is waited for
    domain = DomainOptions(free_domain(), localhost_only=True)
    opened: list[EndpointQos] = []
    one, two = DdsEndpoint(DdsOptions(domain)), DdsEndpoint(DdsOptions(domain, accept_bridged=True, queue_depth=500))
    open_reader = two.entities.open_reader

    def counted(topic: str, resolved: Any, qos: EndpointQos, *rest: Any, **options: Any) -> Any:
        if topic == "rt/chat":
            opened.append(qos)
        return open_reader(topic, resolved, qos, *rest, **options)

    monkeypatch.setattr(two.entities, "open_reader", counted)
    heard = Events()
    await one.start(Events())
    await two.start(heard)
    yield Pair(one, two, heard, opened)
    await two.stop()
    await one.stop()


@pytest.mark.parametrize(
    "changed",
    [{"qos": HIDDEN}, {"qos": EXCLUSIVE}, {"type_name": "std_msgs::msg::dds_::Int32_", "qos": EndpointQos()}],
    ids=["partition", "ownership", "type"],
)
async def test_a_writer_that_never_matches_leaves_the_reader_alone(pair: Pair, changed: dict[str, Any]) -> None:
    publisher = await pair.connect()
    pair.add(writer(50))
    pair.add(writer(51, **changed))
    for number in range(60, 70):
        pair.add(writer(number))
        pair.two.graph.remote_removed(UUID(int=number))
        settle(pair.two)
    assert len(pair.opened) == 1
    publisher.publish(body(1), 1)
    await until(lambda: pair.got == [body(1)])
    assert len(pair.two.graph.complaints) == 1  # it is said whom it does not match


async def test_messages_survive_a_fault_in_discovery(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are taken already when it is asked whose they are."""
    publisher = await pair.connect()

    def fail(handle: int) -> bool:
        raise OSError("Cyclone DDS does not say")

    monkeypatch.setattr(pair.two.entities.worker._discovery, "find_writer", fail)
    publisher.publish(body(1), 1)
    await until(lambda: pair.got == [body(1)])
    held = Held(pair.two)  # what the others say of their nodes is a fault too, and is not to be counted in between
    assert pair.two.drops == {DropReason.UNDECODABLE: pair.two.entities.faults} and pair.two.entities.faults >= 1
    held.go()


async def test_what_a_reader_has_received_outlives_it(pair: Pair) -> None:
    """A best-effort writer comes, so that the reader is made anew, while messages wait for the event loop."""
    publisher = await pair.connect()
    bodies = [body(number) for number in range(300)]
    for one in bodies:
        publisher.publish(one, 1)
    pair.add(writer(50, qos=EndpointQos()))
    assert [qos.reliable for qos in pair.opened] == [True, False]
    await until(lambda: pair.got == bodies, "all that was written")
    await until(lambda: not pair.two.entities.leaving, "the end of the reader")
    assert pair.two.drops == {}


class Held:
    """Keeps a worker's thread in a job until `go`."""

    def __init__(self, endpoint: DdsEndpoint) -> None:
        self._began, self._end = threading.Event(), threading.Event()
        endpoint.entities.worker._do(self._wait)
        assert self._began.wait(DEADLINE_S)

    def _wait(self) -> None:
        self._began.set()
        assert self._end.wait(DEADLINE_S)

    def go(self) -> None:
        self._end.set()


async def in_the_end(pair: Pair, publisher: Stream[Writer]) -> list[bytes]:
    """All that came, when what is written last has come and no reader is being let go."""
    last = body(9999)
    await until(
        lambda: publisher.writer.matched == 1 and not pair.two.entities.leaving, "the end of the readers before"
    )
    publisher.publish(last, 1)
    await until(lambda: last in pair.got, "the last message")
    return pair.got[:-1]


@pytest.mark.parametrize("depth", [500, 3000])
async def test_a_reader_made_anew_takes_nothing_twice(pair: Pair, depth: int) -> None:
    """Both readers receive while the thread is busy; of the same messages some have the same time stamp."""
    pair.two.entities.queue_depth = depth
    publisher = await pair.connect()
    held = Held(pair.two)
    bodies = [body(number) for number in range(depth // 2)] + [body(7), body(7)]
    for one in bodies[:100]:
        publisher.publish(one, 1)
    pair.add(writer(50, qos=EndpointQos()))
    assert [qos.reliable for qos in pair.opened] == [True, False]
    for one in bodies[100:]:
        publisher.publish(one, 1)
    held.go()
    assert await in_the_end(pair, publisher) == bodies
    assert pair.two.drops == {}


async def test_history_is_not_delivered_again(pair: Pair) -> None:
    """A transient-local reader gets what there was; one made in its place gets it too, but it was delivered."""
    info = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
    publisher = pair.one.advertise(replace(info, depth=500, latched=True))
    bodies = [body(number) for number in range(40)]
    for one in bodies[:10]:
        publisher.publish(one, 1)
    await pair.announced()
    pair.two.subscribe(TopicName("/chat"), pair.sink)
    await until(lambda: pair.got == bodies[:10])
    publisher.publish(bodies[10], 1)
    await until(lambda: pair.got == bodies[:11])
    held = Held(pair.two)
    for one in bodies[11:20]:
        publisher.publish(one, 1)
    pair.add(writer(50, qos=EndpointQos(durability=1)))
    for one in bodies[20:30]:
        publisher.publish(one, 1)
    pair.add(writer(51, qos=EndpointQos()))  # and once more, before the thread had its turn
    for one in bodies[30:]:
        publisher.publish(one, 1)
    held.go()
    assert [(qos.reliable, qos.durability) for qos in pair.opened] == [(True, 1), (False, 1), (False, 0)]
    assert await in_the_end(pair, publisher) == bodies


async def test_nothing_is_lost_between_two_readers(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread does all that it has to do, and a message comes, just before there is the new reader."""
    publisher = await pair.connect()
    make = pair.two.entities.make

    def after_a_message(*given: Any, **options: Any) -> Any:
        Held(pair.two).go()
        publisher.publish(body(1), 1)
        return make(*given, **options)

    monkeypatch.setattr(pair.two.entities, "make", after_a_message)
    pair.add(writer(50, qos=EndpointQos()))
    assert len(pair.opened) == 2
    assert await in_the_end(pair, publisher) == [body(1)]


async def test_the_reader_before_stays_where_dds_gives_no_other(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    publisher = await pair.connect()

    def refuse(*given: Any, **options: Any) -> Any:
        raise ConfigError("out of resources")

    with monkeypatch.context() as patch:
        patch.setattr(pair.two.entities, "make", refuse)
        pair.add(writer(50, qos=EndpointQos()))
    publisher.publish(body(1), 1)
    await until(lambda: pair.got == [body(1)])
    pair.add(writer(51, qos=EndpointQos()))
    assert [qos.reliable for qos in pair.opened] == [True, False, False]
    assert await in_the_end(pair, publisher) == [body(1)]


async def test_what_dds_refuses_is_asked_for_again_once_a_second(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """However often the writers of the topic changed meanwhile."""
    await pair.connect()
    again: list[Callable[[], object]] = []

    def later(_delay_s: float, call: Callable[..., object], *given: object) -> None:
        again.append(partial(call, *given))

    def refuse(*given: Any, **options: Any) -> Any:
        raise ConfigError("out of resources")

    with monkeypatch.context() as patch:
        patch.setattr(pair.two.entities, "make", refuse)
        patch.setattr(asyncio.get_running_loop(), "call_later", later)
        for number in range(50, 60):
            pair.add(writer(number, qos=EndpointQos()))
        assert len(again) == 1
        again.pop()()
        assert len(again) == 1
    again.pop()()
    assert not again and pair.opened[-1] == replace(pair.opened[0], reliable=False, durability=0)


def test_many_writers_of_unknown_types_are_looked_up_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Each type and version is, each time that anything of the topic changed; a line is worded only if it is said."""
    endpoint, heard = DdsEndpoint(DdsOptions()), Events()
    endpoint._events = heard
    lookups: list[tuple[str, str]] = []
    owners: list[Remote] = []
    message, owner = endpoint.types.message, endpoint.graph.owner

    def counted(type_name: str, type_hash: str = "") -> Any:
        lookups.append((type_name, type_hash))
        return message(type_name, type_hash)

    def named(remote: Remote) -> str:
        owners.append(remote)
        return owner(remote)

    monkeypatch.setattr(endpoint.types, "message", counted)
    monkeypatch.setattr(endpoint.graph, "owner", named)
    unknown = [writer(k, type_name="x::msg::dds_::T_", qos=replace(RELIABLE, type_hash=str(k % 2))) for k in range(300)]
    for one in unknown[:200]:
        endpoint.graph.remote_added(one)
    assert not lookups and settle(endpoint) == 1
    assert lookups == [("x/msg/T", "0"), ("x/msg/T", "1")] and owners == unknown[:2]
    for one in unknown[200:]:
        endpoint.graph.remote_added(one)
    endpoint.graph.remote_added(writer(400, topic="rt/other", type_name="no type"))
    assert settle(endpoint) == 2 and len(lookups) == 4 and len(owners) == 2 and heard.infos == {}
    assert len(caplog.messages) == 3 and caplog.messages[0].startswith("/chat of participant without a name")
    endpoint.graph.remote_added(writer(500))
    settle(endpoint)
    assert list(heard.infos) == ["/chat"]


def test_many_readers_of_unknown_services_are_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, heard = DdsEndpoint(DdsOptions()), Events()
    endpoint._events = heard
    endpoint.watch_services(heard)
    lookups: list[str] = []
    service = endpoint.types.service

    def counted(type_name: str, request_hash: str = "") -> Any:
        lookups.append(type_name)
        return service(type_name, request_hash)

    monkeypatch.setattr(endpoint.types, "service", counted)
    endpoint.graph.remote_added(writer(0, topic="rr/addReply", type_name="x::srv::dds_::S_Response_"))
    for k in range(200):
        endpoint.graph.remote_added(
            writer(k + 1, writer=False, topic="rq/addRequest", type_name="x::srv::dds_::S_Request_")
        )
    assert settle(endpoint) == 1 and lookups == ["x/srv/S"] and heard.services == {}
