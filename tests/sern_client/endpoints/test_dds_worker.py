"""What the thread that waits for DDS hands over, and how the event loop serves it."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from functools import partial

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

from sern_client.endpoints.dds import node_info, raw
from sern_client.endpoints.dds import worker as module
from sern_client.endpoints.dds.discovery import AT_ONCE, CALLS, MOST_ROUNDS, WRITERS
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.dds.idl import TypeMaker
from sern_client.endpoints.dds.qos import EndpointQos
from sern_client.endpoints.dds.worker import MAX_FOUND, READER_HISTORY, SAME_S, SERVE_S, Arrived, Inbox, Sample, Worker
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime import ros_types
from tests.peers.dds.peer import free_domain
from tests.support import DEADLINE_S, Events, until


class Clock:
    """One that goes on by `step_s` whenever it is asked."""

    def __init__(self, step_s: float) -> None:
        self.now_s = 0.0
        self.step_s = step_s

    def __call__(self) -> float:
        self.now_s += self.step_s
        return self.now_s


@pytest.fixture
async def endpoint() -> AsyncIterator[DdsEndpoint]:
    endpoint = DdsEndpoint(DdsOptions(DomainOptions(free_domain(), localhost_only=True)))
    await endpoint.start(Events())
    yield endpoint
    await endpoint.stop()


@pytest.fixture
async def worker(endpoint: DdsEndpoint) -> Worker:
    await until(lambda: endpoint.graph.participants)  # of itself: what discovery has to say at first is said
    return endpoint.entities.worker


def inbox_of(count: int, deliver: Callable[[Sample], None]) -> Inbox:
    inbox = Inbox(count, deliver)
    inbox.samples.extend((number, Sample(b"", number, 7)) for number in range(1, count + 1))
    inbox.came = count
    return inbox


async def test_what_is_ready_does_not_hold_the_event_loop(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece takes 1 ms here; whoever else has something to do has a turn after a few of them."""
    monkeypatch.setattr(module, "now", Clock(0.001))
    log: list[str] = []
    inbox = inbox_of(60, lambda sample: log.append("sample"))
    for _ in range(40):
        worker._ready.append(partial(log.append, "event"))
    worker._ready.append(Arrived(inbox, 60))
    worker._hand_over(partial(log.append, "end"))

    def other() -> None:
        log.append("other")
        if "end" not in log:
            asyncio.get_running_loop().call_soon(other)

    other()
    await until(lambda: log[-1] == "other" and "end" in log)
    served = [one for one in log if one != "other"]
    assert served == ["event"] * 40 + ["sample"] * 60 + ["end"]
    runs = [len(run.split()) for run in " ".join(log).split("other")]
    assert max(runs) <= SERVE_S / 0.001 + 1


async def test_a_sample_waits_for_what_was_found_before_it(worker: Worker) -> None:
    """Between two times that an inbox is handed over, somebody may have come who speaks in it."""
    log: list[object] = []
    inbox = inbox_of(5, lambda sample: log.append(sample.stamp_ns))
    worker._ready.append(Arrived(inbox, 3))
    worker._ready.append(partial(log.append, "found"))
    worker._hand_over(Arrived(inbox, 5))
    await until(lambda: len(log) == 6)
    assert log == [1, 2, 3, "found", 4, 5] and not inbox.samples


async def test_a_fault_in_one_sample_keeps_no_other(worker: Worker) -> None:
    log: list[int] = []
    reported: list[str] = []

    def deliver(sample: Sample) -> None:
        if sample.stamp_ns == 2:
            raise ValueError("nobody knows this one")
        log.append(sample.stamp_ns)

    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda loop, context: reported.append(str(context.get("exception"))))
    worker._hand_over(Arrived(inbox_of(4, deliver), 4))
    await until(lambda: len(log) == 3)
    assert log == [1, 3, 4] and reported == ["nobody knows this one"]


async def test_an_endless_list_of_nodes_is_counted_and_not_read(endpoint: DdsEndpoint) -> None:
    body = node_info.encode(endpoint.graph.own, "x", [], [])
    endpoint.entities.heed_nodes(Sample(body + bytes(node_info.MAX_BODY_BYTES), 1, 1))
    assert endpoint.drops == {DropReason.UNDECODABLE: 1}
    endpoint.entities.heed_nodes(Sample(b"no such thing", 1, 1))  # of before Iron
    assert endpoint.drops == {DropReason.UNDECODABLE: 1}


def took(inbox: Inbox, *stamps_ns: int, handle: int = 7) -> list[int]:
    """Those of the time stamps that are new to the inbox."""
    return [stamp_ns for stamp_ns in stamps_ns if inbox.is_new(b"body", stamp_ns, handle)]


def test_what_the_reader_before_took_is_skipped_once_each() -> None:
    before, inbox = Inbox(2, print), Inbox(2, print)
    assert took(before, 1, 1) == [1, 1]  # nobody is to come after it
    before.record()
    assert took(before, 2, 3, 3) == [2, 3, 3]
    inbox.follow(before)
    assert took(inbox, 2, handle=8) == [2] and inbox.is_new(b"other", 2, 7)
    assert took(inbox, 1, 2, 2, 3, 3, 3) == [1, 2, 3]


def test_a_third_reader_skips_what_the_second_was_still_to_skip() -> None:
    first, second, third = (Inbox(2, print) for _ in range(3))
    first.record()
    took(first, 1, 2)
    second.record()
    second.follow(first)
    assert took(second, 2, 3) == [3]
    third.follow(second)
    assert took(third, 1, 2, 3, 1, 2, 3, 4) == [1, 2, 3, 4]


def test_what_is_to_be_skipped_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(0.0)
    monkeypatch.setattr(module, "now", clock)
    inbox = Inbox(2, print)
    for _ in range(3):  # each in place of the one before
        before, inbox = inbox, Inbox(2, print)
        before.record()
        took(before, *range(5 * READER_HISTORY))
        inbox.follow(before)
        assert sum(inbox._skipped.values()) == READER_HISTORY
    clock.now_s = SAME_S
    assert took(inbox, 5 * READER_HISTORY - 1) and not inbox._skipped


def test_no_reader_comes_after_all() -> None:
    volatile, transient_local, inbox = Inbox(2, print), Inbox(2, print, repeats=True), Inbox(2, print)
    for before in (volatile, transient_local):
        before.record()
        before.record(on=False)
        took(before, 1)
    inbox.follow(volatile)
    assert took(inbox, 1) == [1]
    inbox.follow(transient_local)
    assert took(inbox, 1) == []


async def test_discoveries_wait_in_dds_while_the_event_loop_is_behind(endpoint: DdsEndpoint, worker: Worker) -> None:
    """Nothing is served until somebody awaits: the thread may look as often as it likes meanwhile."""
    count = 3 * MAX_FOUND
    text = ros_types.describe("std_msgs/msg/String", Encoding.CDR)
    assert text is not None
    resolved = ros_types.resolve("std_msgs/msg/String", text.definition, Encoding.CDR)
    other = DomainParticipant(endpoint.options.domain.domain)
    topic, subscriber = Topic(other, "rt/chat", TypeMaker().make(resolved)), Subscriber(other)
    readers = [DataReader(subscriber, topic) for _ in range(count)]
    for _ in range(2 * count // (AT_ONCE * CALLS)):
        looked = threading.Event()
        worker._do(looked.set)
        assert looked.wait(DEADLINE_S)
    assert MAX_FOUND <= len(worker._ready) <= MAX_FOUND + AT_ONCE * CALLS * (MOST_ROUNDS + 1)
    await until(lambda: len(endpoint.graph.readers("rt/chat")) == count, "all of them")
    readers.clear()
    await until(lambda: not endpoint.graph.readers("rt/chat"), "none of them")


async def test_messages_wait_in_dds_while_the_event_loop_is_behind(endpoint: DdsEndpoint, worker: Worker) -> None:
    """Their writers could not be found. A reader that is let go is emptied all the same, and nothing is lost."""
    got: list[bytes] = []
    info = ros_types.resolve("std_msgs/msg/String", "string data", Encoding.CDR)
    opened = [
        endpoint.entities.open_reader("rt/chat", info, EndpointQos(), lambda sample: got.append(sample.body))
        for _ in range(2)
    ]
    other = DomainParticipant(endpoint.options.domain.domain)
    writer = DataWriter(Publisher(other), Topic(other, "rt/chat", TypeMaker().make(info)))
    await until(lambda: all(reader.matched for reader in opened))
    full = threading.Event()

    def find() -> None:
        for _ in range(MAX_FOUND):
            worker._hand_over(lambda: None)
        full.set()

    worker._do(find)
    assert full.wait(DEADLINE_S)
    body = b"\0\x01\0\0\x04\0\0\0abc\0"
    raw.write(writer, body, 1)
    opened[0].close(rest=True)
    for _ in range(3):
        looked = threading.Event()
        worker._do(looked.set)
        assert looked.wait(DEADLINE_S)
    assert sum(isinstance(item, Arrived) for item in worker._ready) == 1  # of the one that was let go
    await until(lambda: got == [body, body])


async def test_messages_arrive_during_a_flood_of_discoveries(
    endpoint: DdsEndpoint, worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever the event loop has caught up, there are so many more that it is behind again."""
    got: list[bytes] = []
    info = ros_types.resolve("std_msgs/msg/String", "string data", Encoding.CDR)
    reader = endpoint.entities.open_reader("rt/chat", info, EndpointQos(), lambda sample: got.append(sample.body))
    other = DomainParticipant(endpoint.options.domain.domain)
    writer = DataWriter(Publisher(other), Topic(other, "rt/chat", TypeMaker().make(info)))
    await until(lambda: reader.matched and endpoint.graph.writers("rt/chat"))
    wait, begun, over = worker._waiter.wait, threading.Event(), threading.Event()

    def ready() -> list[int]:
        return sorted({WRITERS, *wait(1_000_000)}) if not over.is_set() else wait()

    def discover(_number: int) -> None:
        worker._ready.extend([lambda: None] * MAX_FOUND)  # at once: the event loop comes to none of them meanwhile
        worker._found += MAX_FOUND
        worker._hand_over(lambda: None)
        begun.set()

    monkeypatch.setattr(worker, "_discover", discover)
    monkeypatch.setattr(worker._waiter, "wait", ready)
    worker._do(lambda: None)  # it may be waiting as before
    await until(begun.is_set)
    body = b"\0\x01\0\0\x04\0\0\0abc\0"
    raw.write(writer, body, 1)
    await until(lambda: got == [body])
    over.set()


async def test_changes_are_heeded_once_a_turn(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    """All that came in one turn is heeded in the next ones, before what came later, and others have turns between."""
    left, log = 0, list[str]()
    clock = Clock(0.0)

    def come() -> None:
        nonlocal left
        left = 7
        log.append("came")

    def heed() -> bool:
        nonlocal left
        if not left:
            return False  # DDS itself had found something
        left -= 1
        log.append("heeded")
        return left > 0

    monkeypatch.setattr(module, "now", clock)
    worker._settle = heed
    worker._ready.extend([come] * 3)
    worker._hand_over(come)
    await until(lambda: len(log) == 11)
    assert log == ["came"] * 4 + ["heeded"] * 7
    clock.step_s = SERVE_S  # no time for a second step
    for _ in range(2):
        worker._hand_over(come)
    await until(lambda: len(log) == 27)
    assert log[11:] == ["came", *["heeded"] * 7] * 2
