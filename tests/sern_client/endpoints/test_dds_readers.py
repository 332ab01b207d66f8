"""Which readers the dds endpoint has for a topic whose writers come and go."""

from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any
from uuid import UUID

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds import endpoint as module
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.dds.graph import Remote
from sern_client.endpoints.dds.qos import EndpointQos, mismatches, reader_for, within_reach
from sern_client.endpoints.dds.stream import Stream
from sern_core.types import DropReason, Encoding, TopicName
from sern_runtime.ros_types import topic_info
from tests.peers.dds.peer import free_domain
from tests.support import Events, until

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


class Pair:
    """Two endpoints of this process in one domain; what `two` opens of readers is in `opened`."""

    def __init__(self, one: DdsEndpoint, two: DdsEndpoint, opened: list[EndpointQos]) -> None:
        self.one, self.two, self.opened = one, two, opened
        self.got: list[bytes] = []

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        self.got.append(body)
        return True

    async def connect(self) -> Stream:
        """Take /chat of `one` at `two`."""
        info = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
        publisher = self.one.advertise(replace(info, depth=500))
        await until(lambda: self.two.graph.writers("rt/chat"))
        self.two.subscribe(TopicName("/chat"), self.sink)
        await until(lambda: publisher.matched == 1)
        assert publisher.first.over and len(self.opened) == 1
        return publisher


def body(number: int) -> bytes:
    return b"\0\x01\0\0\x04\0\0\0" + b"%03d\0" % number


@pytest.fixture
async def pair(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Pair]:
    monkeypatch.setattr(module, "LEARN_S", 0.0)  # nobody is waited for
    domain = DomainOptions(free_domain(), localhost_only=True)
    opened: list[EndpointQos] = []
    one, two = DdsEndpoint(DdsOptions(domain)), DdsEndpoint(DdsOptions(domain, heed_sern=True, queue_depth=500))
    open_reader = two.open_reader

    def counted(topic: str, resolved: Any, qos: EndpointQos, *rest: Any, **options: Any) -> Any:
        if topic == "rt/chat":
            opened.append(qos)
        return open_reader(topic, resolved, qos, *rest, **options)

    monkeypatch.setattr(two, "open_reader", counted)
    await one.start(Events())
    await two.start(Events())
    yield Pair(one, two, opened)
    await two.stop()
    await one.stop()


@pytest.mark.parametrize(
    "changed",
    [{"qos": HIDDEN}, {"qos": EXCLUSIVE}, {"type_name": "std_msgs::msg::dds_::Int32_", "qos": EndpointQos()}],
    ids=["partition", "ownership", "type"],
)
async def test_a_writer_that_never_matches_leaves_the_reader_alone(pair: Pair, changed: dict[str, Any]) -> None:
    publisher = await pair.connect()
    pair.two.remote_added(writer(50))
    pair.two.remote_added(writer(51, **changed))
    for number in range(60, 70):
        pair.two.remote_added(writer(number))
        pair.two.remote_removed(UUID(int=number))
    assert len(pair.opened) == 1
    publisher.publish(body(1), 1)
    await until(lambda: pair.got == [body(1)])
    assert len(pair.two.graph.complaints) == 1  # it is said whom it does not match


async def test_messages_survive_a_fault_in_discovery(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are taken already when it is asked whose they are."""
    publisher = await pair.connect()

    def fail(handle: int) -> bool:
        raise OSError("Cyclone DDS does not say")

    assert pair.two._joined is not None
    monkeypatch.setattr(pair.two._joined.worker._discovery, "find_writer", fail)
    publisher.publish(body(1), 1)
    await until(lambda: pair.got == [body(1)])
    assert pair.two.drops == {DropReason.UNDECODABLE: pair.two.faults} and pair.two.faults >= 1


async def test_what_a_reader_has_received_outlives_it(pair: Pair) -> None:
    """A best-effort writer comes, so that the reader is made anew, while messages wait for the event loop."""
    publisher = await pair.connect()
    bodies = [body(number) for number in range(300)]
    for one in bodies:
        publisher.publish(one, 1)
    pair.two.remote_added(writer(50, qos=EndpointQos()))
    assert [qos.reliable for qos in pair.opened] == [True, False]
    await until(lambda: pair.got == bodies, "all that was written")
    await until(lambda: not pair.two._leaving, "the end of the reader")
    assert pair.two.drops == {}
