"""What the thread that waits for DDS hands over, and how the event loop serves it."""

import asyncio
from collections.abc import AsyncIterator, Callable
from functools import partial

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds import node_info
from sern_client.endpoints.dds import worker as module
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.dds.worker import SERVE_S, Arrived, Inbox, Sample, Worker
from sern_core.types import DropReason
from tests.peers.dds.peer import free_domain
from tests.support import Events, until


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
    assert endpoint._joined is not None
    await until(lambda: endpoint.graph.participants)  # of itself: what discovery has to say at first is said
    return endpoint._joined.worker


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
    endpoint._heed_nodes(Sample(body + bytes(node_info.MAX_BODY_BYTES), 1, 1))
    assert endpoint.drops == {DropReason.UNDECODABLE: 1}
    endpoint._heed_nodes(Sample(b"no such thing", 1, 1))  # of before Iron
    assert endpoint.drops == {DropReason.UNDECODABLE: 1}
