"""Topics that are described some time after they were offered, as when a site is there before its robot."""

from dataclasses import replace

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.viewers import bridge, viewer

CLOUD = ros_types.topic_info("/robot/points", "sensor_msgs/msg/PointCloud2", Encoding.CDR)
OTHER = ros_types.topic_info("/robot/scan", "sensor_msgs/msg/LaserScan", Encoding.CDR)


async def test_a_type_that_was_known_before_it_was_described_keeps_its_channel() -> None:
    """The server has one channel for two that are the same: to end one of them ends it."""
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(replace(CLOUD, definition="", type_hash=""))
        await person.look(CLOUD.name)
        await run.looked_at(CLOUD.name)
        first = person.channels[CLOUD.name]["id"]
        run.endpoint.topic_offered(CLOUD)
        publisher = run.endpoint.advertise(CLOUD)
        publisher.publish(b"cloud", 1)
        assert await person.got_of(CLOUD.name) == [b"cloud"]
        run.endpoint.topic_offered(OTHER)
        await person.look(OTHER.name)  # all that was said before it has come
        assert person.channels[CLOUD.name]["id"] == first
