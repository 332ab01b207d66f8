"""Streams that end and begin faster than the master is asked, and a master that does not know what it should."""

from dataclasses import replace

import pytest

from sern_client.endpoints.base import Difference, Held
from sern_client.endpoints.ros1 import graph
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.sern_client.endpoints.ros1.fakes import STRING, FakeMaster, listening, running, text
from tests.support import until

CHAT = TopicName("/chat")
NUMBER = ros_types.topic_info("/chat", "std_msgs/msg/Int32", Encoding.ROS1)


async def test_a_stream_that_begins_as_soon_as_it_ended_is_published(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        first = endpoint.advertise(STRING)
        await until(lambda: endpoint.waited_for == 0 and master.tables[0].get("/chat") == ["/sern"])
        first.close()
        again = endpoint.advertise(STRING)
        assert endpoint.published() == [("/chat", "std_msgs/String")]
        async with listening(endpoint, topic="/chat") as listener:
            assert "error" not in await listener.header()
            await until(lambda: len(endpoint.bus_links()) == 1)
            again.publish(text("still here"), 0)
            assert await listener.frame() == text("still here")
        held = Held()
        held.publishers[CHAT] = 1
        assert endpoint.validate(held) == []


async def registered(master: FakeMaster, times: int) -> None:
    await until(lambda: master.calls["registerPublisher"] == times)


async def test_subscribers_are_told_of_a_topic_that_ended_and_begins_again(master: FakeMaster) -> None:
    """They lost their connections, and rospy looks for a publisher only when the master says that there is one."""
    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        await until(lambda: endpoint.waited_for == 0 and master.tables[0].get("/chat") == ["/sern"])
        for told in range(2, 5):
            stream.close()
            stream = endpoint.advertise(STRING)
            await registered(master, told)
        assert endpoint.advertise(STRING) and master.calls.get("unregisterPublisher", 0) == 0


async def test_the_master_is_told_of_another_type(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        first = endpoint.advertise(STRING)
        await until(lambda: master.types == {"/chat": "std_msgs/String"})
        first.close()
        endpoint.advertise(NUMBER)
        await until(lambda: master.types == {"/chat": "std_msgs/Int32"})


async def test_what_the_master_lists_in_vain_is_unregistered(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        master.add(0, "/gone", "/sern", "http://127.0.0.1:1/")
        master.add(1, "/gone", "/sern", "http://127.0.0.1:1/")
        await until(lambda: not master.tables[0] and not master.tables[1])
        assert endpoint.validate(Held()) == []


async def test_what_the_master_has_lost_is_registered_again(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        for _ in range(3):
            await until(lambda: master.tables[0].get("/chat") == ["/sern"])
            master.remove(0, "/chat", "/sern")
        await until(lambda: master.tables[0].get("/chat") == ["/sern"])


async def test_a_registration_that_was_refused_is_tried_again(
    master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph, "RECONCILE_S", 0.05)
    master.refused.add("registerPublisher")
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        await until(lambda: master.calls.get("registerPublisher", 0) >= 2)
        held = Held()
        held.publishers[CHAT] = 1
        listed = Difference(CHAT, f"/sern is not listed as its publisher at {master.uri}")
        assert endpoint.validate(held) == [listed]
        master.refused.clear()
        await until(lambda: endpoint.validate(held) == [])
        assert master.tables[0] == {"/chat": ["/sern"]}


async def test_a_message_that_can_reach_nobody_is_counted(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        closed, shut = endpoint.advertise(STRING), endpoint.advertise(replace(STRING, name=TopicName("/other")))
        closed.close()
        closed.publish(text("one"), 0)
        assert endpoint.drops == {DropReason.DISCONNECTED: 1}
        endpoint.told_to_shut_down("another node took our name")
        shut.publish(text("two"), 0)
        assert endpoint.drops == {DropReason.DISCONNECTED: 2}
        held = Held()
        held.publishers[TopicName("/other")] = 1
        assert [each.name for each in endpoint.validate(held)] == ["", "/other"]
        with pytest.raises(ConfigError, match="told to shut down"):
            endpoint.advertise(STRING)
