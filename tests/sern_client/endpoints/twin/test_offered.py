"""Topics that the client of the twins makes itself."""

import asyncio
from collections import Counter

import pytest

from sern_client.endpoints.base import Held
from sern_client.endpoints.twin.endpoint import TwinEndpoint
from sern_client.endpoints.twin.options import RobotOptions, TwinOptions
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.support import Events

MAP = ros_types.topic_info("/twin/scene/map", "nav_msgs/msg/OccupancyGrid", Encoding.CDR, latched=True)
UPDATES = ros_types.topic_info("/twin/scene/map_updates", "map_msgs/msg/OccupancyGridUpdate", Encoding.CDR)


async def endpoint_with(events: Events) -> TwinEndpoint:
    endpoint = TwinEndpoint(TwinOptions((RobotOptions("jackal1", "/jackal1/odom"),)))
    endpoint.offer(MAP).publish(b"early", 1)
    await endpoint.start(events)
    return endpoint


async def test_what_is_offered_is_announced_and_who_comes_late_gets_the_last_of_a_latched_one() -> None:
    events = Events()
    endpoint = await endpoint_with(events)
    got: list[tuple[str, bytes, int]] = []
    try:
        updates = endpoint.offer(UPDATES)
        assert {MAP.name, UPDATES.name} <= events.infos.keys()
        updates.publish(b"before", 2)
        taken = [
            endpoint.subscribe(name, lambda body, stamp_ns, name=name: got.append((name, body, stamp_ns)) or True)  # type: ignore[misc, func-returns-value]
            for name in (MAP.name, UPDATES.name)
        ]
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        updates.publish(b"after", 3)
        assert got == [(MAP.name, b"early", 1), (UPDATES.name, b"after", 3)]
        held = Held()
        held.publishers.update((MAP.name, UPDATES.name))
        held.subscriptions.update((MAP.name, UPDATES.name))
        assert endpoint.validate(held) == []
        assert [str(each.name) for each in endpoint.validate(Held())] == [MAP.name, UPDATES.name] * 2
        taken[1].close()
        updates.publish(b"nobody", 4)
        updates.close()
        assert UPDATES.name not in events.infos and len(got) == 2
        with pytest.raises(UsageError, match="/twin/scene/map_updates"):
            endpoint.subscribe(UPDATES.name, lambda _body, _stamp: True)
    finally:
        await endpoint.stop()
    assert endpoint.validate(Held(Counter([MAP.name]))) == [], "its subscription ended with it"


async def test_what_a_queue_refuses_is_counted() -> None:
    events = Events()
    endpoint = await endpoint_with(events)
    try:
        endpoint.subscribe(MAP.name, lambda _body, _stamp: False)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert endpoint.drops[DropReason.REFUSED] == 1
    finally:
        await endpoint.stop()


async def test_a_name_that_the_twins_have_is_not_to_be_had() -> None:
    endpoint = TwinEndpoint(TwinOptions((RobotOptions("jackal1", "/jackal1/odom"),)))
    endpoint.offer(MAP)
    for name in ("/twin/jackal1/odom", MAP.name):
        with pytest.raises(ConfigError, match=f"{name}: the twins have such a topic already"):
            endpoint.offer(ros_types.topic_info(name, "std_msgs/msg/Float32", Encoding.CDR))
    with pytest.raises(UsageError):
        endpoint.subscribe(TopicName("/elsewhere"), lambda _body, _stamp: True)
