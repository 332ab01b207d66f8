"""What zenoh does not take in time, without a network."""

import asyncio

import pytest

pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install 'sern[zenoh]'")

from sern_client.endpoints.zenoh import session as module
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint, ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions
from sern_core.types import DropReason
from tests.support import Events, until


async def test_a_writer_that_is_behind_drops_the_oldest_messages_and_no_news(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING_BYTES", 30)
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=("tcp/127.0.0.1:0",))))
    done: list[str] = []
    session = endpoint.session
    session.put(lambda: done.append("end of one"), 0)
    for number in range(6):
        session.put(lambda number=number: done.append(f"message {number}"), 10)  # type: ignore[misc]
    session.put(lambda: done.append("end of another"), 0)
    assert endpoint.drops == {DropReason.QUEUE_FULL: 3}

    def refused() -> None:
        raise session.zenoh.ZError("the session is closed")

    session.put(refused, 0)  # an end of something that is gone
    session.put(refused, 10)
    await endpoint.start(Events())
    try:
        await until(lambda: endpoint.drops == {DropReason.QUEUE_FULL: 4, DropReason.DISCONNECTED: 1})
        assert done == ["end of one", "message 4", "message 5", "end of another"]
    finally:
        await endpoint.stop()


async def test_a_loop_that_is_behind_counts_what_it_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=("tcp/127.0.0.1:0",))))
    await endpoint.start(Events())
    try:
        monkeypatch.setattr(endpoint.session.handover, "_max_bytes", 15)
        for _ in range(3):
            endpoint.session.handover.put(lambda: None, 10)
        await asyncio.sleep(0)
        assert endpoint.drops == {DropReason.QUEUE_FULL: 2}
    finally:
        await endpoint.stop()
