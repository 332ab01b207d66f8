"""What is published before its subscribers have connected."""

import logging
from dataclasses import replace

import pytest

from sern_client.endpoints.ros1 import first_messages, returning
from sern_client.endpoints.ros1.xmlrpc import XmlRpcClient
from sern_core.vocabulary.types import DropReason
from tests.sern_client.endpoints.ros1.fakes import STRING, FakeMaster, listening, running, text
from tests.support import until

EARLY = [text(f"early {number}") for number in range(10)]


@pytest.fixture
def known(master: FakeMaster) -> FakeMaster:
    """A master that lists a subscriber of /chat, which the tests connect when they like."""
    master.add(1, "/chat", "/listener", "http://127.0.0.1:1/")
    return master


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine must not make a subscriber come too late."""
    monkeypatch.setattr(first_messages, "FIRST_MESSAGES_S", 60.0)
    monkeypatch.setattr(returning, "TOLD_S", 60.0)


async def known_to_subscribe(master: FakeMaster) -> None:
    """The endpoint is registered for /chat, and has read from the master who subscribes."""
    await until(lambda: master.tables[0].get("/chat") == ["/sern"])
    asked = master.calls["getSystemState"]
    # A poll begins once the one before has been read, and the first of these two was answered with us in it.
    await until(lambda: master.calls["getSystemState"] >= asked + 2)


@pytest.mark.parametrize("latched", [False, True])
async def test_a_known_subscriber_gets_what_was_published_before_it_came(known: FakeMaster, latched: bool) -> None:
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(replace(STRING, latched=latched))
        for body in EARLY:
            stream.publish(body, 0)
        await known_to_subscribe(known)
        async with (
            listening(endpoint, topic="/chat", callerid="/stranger") as stranger,
            listening(endpoint, topic="/chat") as listener,
        ):
            await stranger.header()
            await listener.header()
            await until(lambda: endpoint.waited_for == 0)
            await until(lambda: len(endpoint.bus_links()) == 2)
            stream.publish(text("live"), 0)
            assert [await listener.frame() for _ in range(11)] == [*EARLY, text("live")]
            if latched:
                assert await stranger.frame() == EARLY[-1]
            assert await stranger.frame() == text("live")
        async with listening(endpoint, topic="/chat") as again:
            await again.header()
            await until(lambda: len(endpoint.bus_links()) == 1)
            stream.publish(text("later"), 0)
            if latched:
                assert await again.frame() == text("live")
            assert await again.frame() == text("later")
        assert endpoint.drops == {}


async def test_who_comes_before_the_master_has_told_who_subscribes_gets_it_too(known: FakeMaster) -> None:
    """It may be one of those that the master has just told of us: no message of theirs must be lost."""
    async with running(known) as (endpoint, _):
        known.mute = "getSystemState"
        stream = endpoint.advertise(STRING)
        for body in EARLY:
            stream.publish(body, 0)
        async with (
            listening(endpoint, topic="/chat", callerid="/quick") as quick,
            listening(endpoint, topic="/chat") as listener,
        ):
            for subscriber in (quick, listener):
                await subscriber.header()
                assert [await subscriber.frame() for _ in range(10)] == EARLY
            known.mute = ""
            await until(lambda: endpoint.waited_for == 0)
        assert endpoint.drops == {}


async def test_a_topic_that_has_ended_stays_until_its_message_is_there(known: FakeMaster) -> None:
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        stream.publish(text("only"), 0)
        stream.close()
        await until(lambda: known.tables[0].get("/chat") == ["/sern"])
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            assert await listener.frame() == text("only")
            assert await listener.reader.read() == b""
        await until(lambda: not known.tables[0])
        assert endpoint.drops == {}


async def test_who_has_not_heard_of_the_end_gets_nothing_that_it_would_throw_away(known: FakeMaster) -> None:
    """Connections that end are made again by themselves, and given up for another when the master has told of both."""
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        stream.publish(text("one"), 0)
        stream.close()
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            assert await listener.frame() == text("one") and await listener.reader.read() == b""
        await until(lambda: not known.tables[0])
        stream = endpoint.advertise(STRING)
        stream.publish(text("two"), 0)
        stream.close()
        await until(lambda: known.tables[0].get("/chat") == ["/sern"])
        async with listening(endpoint, topic="/chat") as again:
            assert await again.reader.read() == b"", "it has not heard that the topic has ended"
        node = XmlRpcClient(known.nodes["/sern"])
        try:
            answer = await node.call("requestTopic", "/listener", "/chat", [["TCPROS"]])
            assert answer == ["TCPROS", *endpoint.tcpros_address()]
        finally:
            node.close()
        async with listening(endpoint, topic="/chat") as anew:
            await anew.header()
            assert await anew.frame() == text("two") and await anew.reader.read() == b""
        await until(lambda: not known.tables[0])
        assert endpoint.drops == {}


async def test_another_type_need_not_wait_for_one_that_has_ended(known: FakeMaster) -> None:
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        stream.publish(text("only"), 0)
        stream.close()
        other = endpoint.advertise(replace(STRING, latched=True))
        async with listening(endpoint, topic="/chat") as listener:
            assert (await listener.header())["latching"] == "1"
        other.close()


async def test_what_is_held_is_bounded_and_counted(known: FakeMaster) -> None:
    async with running(known, queue_messages=3) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        for body in EARLY:
            stream.publish(body, 0)
        await until(lambda: endpoint.drops == {DropReason.QUEUE_FULL: 7})
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            assert [await listener.frame() for _ in range(3)] == EARLY[-3:]


async def test_of_a_best_effort_topic_the_newest_is_held(known: FakeMaster) -> None:
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(replace(STRING, reliable=False, depth=1))
        for body in EARLY:
            stream.publish(body, 0)
        await until(lambda: endpoint.drops == {DropReason.SUPERSEDED: 9})
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            assert await listener.frame() == EARLY[-1]


async def test_nothing_comes_later_than_it_may(known: FakeMaster) -> None:
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        stream.publish_within(text("go"), 0, 0.0)
        stream.publish_within(text("stop"), 0, 60.0)
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            assert await listener.frame() == text("stop")
        await until(lambda: endpoint.drops == {DropReason.LIFESPAN: 1})


async def test_without_subscribers_nothing_is_held_and_nothing_lost(master: FakeMaster) -> None:
    async with running(master, queue_messages=3) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        for body in EARLY:
            stream.publish(body, 0)
        await until(lambda: endpoint.waited_for == 0)
        stream.close()
        await until(lambda: not master.tables[0])
        assert endpoint.drops == {}


async def test_a_dead_subscriber_is_waited_for_only_so_long(
    known: FakeMaster, caplog: pytest.LogCaptureFixture
) -> None:
    known.add(1, "/chat", "/leaving", "http://127.0.0.1:1/")
    async with running(known) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        publication = endpoint._publications["/chat"]
        await known_to_subscribe(known)
        known.remove(1, "/chat", "/leaving")
        stream.publish(text("one"), 0)
        asked = known.calls["getSystemState"]
        await until(lambda: known.calls["getSystemState"] >= asked + 2, "it has read who subscribes now")
        stream.close()
        assert endpoint.drops == {} and known.tables[0]["/chat"] == ["/sern"]
        with caplog.at_level(logging.WARNING):
            publication.first_messages._timed_out()  # as after FIRST_MESSAGES_S
            await until(lambda: not known.tables[0])
        assert endpoint.drops == {DropReason.DISCONNECTED: 1}
    assert "/chat: /listener has not connected within 60 s; it missed 1 message" in caplog.messages
