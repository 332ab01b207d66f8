"""The bridges of the DDS benchmark: `python -m benchmarks.endpoints.dds_roles ROLE ...`.

bridge SOURCE TARGET           everything of one domain to another, endpoint to endpoint
to-zenoh DOMAIN LOCATOR        odometry and clouds of a domain to zenoh; connects
from-zenoh DOMAIN LOCATOR      what comes by zenoh to a domain; listens
"""

import asyncio
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

from benchmarks.endpoints.rospy_roles import qualities
from benchmarks.zenoh_session import open_session
from sern_client.endpoints.common.handover import Handover
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

TYPES: Final = {"/bench/odom": "nav_msgs/msg/Odometry", "/bench/cloud": "sensor_msgs/msg/PointCloud2"}
DEPTHS: Final = {"/bench/odom": 1000, "/bench/cloud": 20}


def endpoint_in(domain: str, node_name: str) -> DdsEndpoint:
    return DdsEndpoint(DdsOptions(DomainOptions(int(domain), localhost_only=True), node_name=node_name))


class _Topics:
    """`TopicEvents`: tells each topic once. The run ends before any is gone."""

    def __init__(self, added: Callable[[TopicInfo], None]) -> None:
        self.topic_added = added

    def topic_removed(self, name: TopicName) -> None:
        """Nothing is to be done."""


def ignore(_info: TopicInfo) -> None:
    """The bridges go in one direction."""


async def bridge(source_domain: str, target_domain: str) -> None:
    source, target = endpoint_in(source_domain, "sern"), endpoint_in(target_domain, "sern_target")

    def added(info: TopicInfo) -> None:
        publisher = target.advertise(info)

        def sink(body: bytes, stamp_ns: int) -> bool:
            publisher.publish(body, stamp_ns)
            return True

        source.subscribe(info.name, sink)

    await target.start(_Topics(ignore))
    await source.start(_Topics(added))
    await asyncio.Event().wait()


async def to_zenoh(domain: str, locator: str) -> None:
    """A thread a topic hands over to zenoh, which may block: what is urgent does not wait behind a cloud."""
    source = endpoint_in(domain, "sern_to_zenoh")
    with open_session([locator], listens=False) as session:

        def added(info: TopicInfo) -> None:
            if info.name not in TYPES:
                return
            waiting: SimpleQueue[bytes] = SimpleQueue()
            out = session.declare_publisher(info.name.strip("/"), **qualities(info.name))

            def put() -> None:
                while True:
                    out.put(waiting.get())

            def sink(body: bytes, _stamp_ns: int) -> bool:
                waiting.put(bytes(body))
                return True

            Thread(target=put, name=info.name, daemon=True).start()
            source.subscribe(info.name, sink)

        await source.start(_Topics(added))
        await asyncio.Event().wait()


async def from_zenoh(domain: str, locator: str) -> None:
    target = endpoint_in(domain, "sern_from_zenoh")
    await target.start(_Topics(ignore))
    handover = Handover(asyncio.get_running_loop())
    with open_session([locator], listens=True) as session:
        for name, type_name in TYPES.items():
            info = ros_types.topic_info(name, type_name, Encoding.CDR, reliable=True)
            publisher = target.advertise(replace(info, depth=DEPTHS[name]))

            def take(sample: Any, publish: Callable[[bytes, int], None] = publisher.publish) -> None:
                body = sample.payload.to_bytes()
                handover.put(partial(publish, body, 0), len(body))

            session.declare_subscriber(name.strip("/"), take)
        await asyncio.Event().wait()


ROLES: Final = {"bridge": bridge, "to-zenoh": to_zenoh, "from-zenoh": from_zenoh}

if __name__ == "__main__":
    asyncio.run(ROLES[sys.argv[1]](*sys.argv[2:]))
