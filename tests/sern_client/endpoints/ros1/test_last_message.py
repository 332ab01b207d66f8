"""The last messages of a topic that ends: roscpp throws away what it has not read when it hears of the end."""

from collections.abc import Callable

import pytest

from sern_client.endpoints.ros1 import publication
from tests.sern_client.endpoints.ros1.fakes import STRING, FakeMaster, listening, running, text
from tests.support import until

LAST = text("stop")


async def asked_twice(master: FakeMaster) -> None:
    """A poll of the master, and whatever it leads to, is over."""
    asked = master.calls["getSystemState"]
    await until(lambda: master.calls["getSystemState"] >= asked + 2)


async def test_the_master_hears_of_the_end_once_its_subscribers_have_read_all(
    master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publication, "LAST_READ_S", 60.0)  # a busy machine must not make a subscriber read too late
    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as slow, listening(endpoint, topic="/chat") as quick:
            await until(lambda: len(endpoint.bus_links()) == 2 and endpoint.waited_for == 0)
            stream.publish(LAST, 0)
            stream.close()
            for subscriber in (quick, slow):
                await asked_twice(master)
                assert master.tables[0] == {"/chat": ["/sern"]}, "one of them may not have read it"
                await subscriber.header()
                assert await subscriber.frame() == LAST and await subscriber.reader.read() == b""
                subscriber.writer.close()
            await until(lambda: not master.tables[0])
        assert endpoint.published() == [] and endpoint.drops == {}


async def test_a_subscriber_that_does_not_read_is_waited_for_only_so_long(
    master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publication, "LAST_READ_S", 0.05)
    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as listener:
            await until(lambda: len(endpoint.bus_links()) == 1 and endpoint.waited_for == 0)
            stream.publish(LAST, 0)
            stream.close()
            await until(lambda: not master.tables[0])
            await listener.header()
            assert await listener.frame() == LAST and await listener.reader.read() == b""


async def test_a_topic_that_begins_again_meanwhile_is_another(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        first = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as old:
            await until(lambda: len(endpoint.bus_links()) == 1 and endpoint.waited_for == 0)
            registered = master.calls["registerPublisher"]
            first.publish(LAST, 0)
            first.close()
            second = endpoint.advertise(STRING)
            await until(lambda: master.calls["registerPublisher"] > registered)
            async with listening(endpoint, topic="/chat") as new:
                await new.header()
                await until(lambda: len(endpoint.bus_links()) == 1)
                second.publish(text("go"), 0)
                assert await new.frame() == text("go")
            await old.header()
            assert await old.frame() == LAST and await old.reader.read() == b""
            old.writer.close()
            await asked_twice(master)
            assert master.tables[0] == {"/chat": ["/sern"]} and "unregisterPublisher" not in master.calls
        second.close()


@pytest.mark.parametrize("reads", [True, False])
async def test_a_node_that_ends_waits_for_its_subscribers_too(
    master: FakeMaster, reads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publication, "LAST_READ_S", 60.0 if reads else 0.05)
    listed: list[bool] = []
    """Whether nobody read any more when the master heard of an end."""
    unregister: Callable[..., None] = master.remove

    def removed(kind: int, name: str, node: str) -> None:
        listed.append(not endpoint._ended.leaving)
        unregister(kind, name, node)

    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as listener:
            await until(lambda: len(endpoint.bus_links()) == 1 and endpoint.waited_for == 0)
            stream.publish(LAST, 0)
            monkeypatch.setattr(master, "remove", removed)
            if reads:
                await listener.header()
                assert await listener.frame() == LAST
                listener.writer.close()
            await endpoint.stop()
        assert listed == [True] and not master.tables[0]
