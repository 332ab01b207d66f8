"""The shipped files of a Husky, its relay and its sites, with what a real Husky publishes: a recording of one drives
them. Where it is not beside the checkout, one with the same topics does, made of a simulated robot."""

from pathlib import Path
from random import Random
from typing import Any, Final

import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from sern_client.endpoints.jackal import JACKAL, JackalSource, Sizes
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.daemons import Lab, bodies, recording
from tests.support import until

EXAMPLES: Final = Path(__file__).resolve().parents[2] / "deploy" / "examples"
NEEDED: Final = {
    "/fix": "sensor_msgs/msg/NavSatFix",
    "/husky_velocity_controller/odom": "nav_msgs/msg/Odometry",
    "/imu/data": "sensor_msgs/msg/Imu",
}
"""What an operator drives by: where it is on the map, how it moves, and how it leans. This robot fuses none of it."""


MADE: Final = {"/fix": "/navsat/fix", "/husky_velocity_controller/odom": "/odometry/filtered", "/imu/data": "/imu/data"}
"""What the simulated robot calls them."""


def made(path: Path) -> Path:
    """A recording of the topics of NEEDED, 20 messages each."""
    store, source = get_typestore(Stores.ROS1_NOETIC), JackalSource(Random(1), Encoding.ROS1, Sizes(), patrol=True)
    plans = {name: next(plan for plan in JACKAL if plan.name == original) for name, original in MADE.items()}
    with Writer(path) as writer:
        connections = {name: writer.add_connection(name, kind, typestore=store) for name, kind in NEEDED.items()}
        for number in range(20):
            source.advance(0.1 * number)
            stamp_ns = 1_700_000_000_000_000_000 + number * 100_000_000
            for name, plan in plans.items():
                writer.write(connections[name], stamp_ns, source.body(plan, stamp_ns))
    return path


def shipped(name: str) -> dict[str, Any]:
    content: dict[str, Any] = YAML(typ="safe").load((EXAMPLES / f"{name}.yaml").read_text())
    return content


def here(lab: Lab, name: str, endpoint: dict[str, object]) -> Path:
    """A shipped client file with nothing changed but where its relay, its topics and its HTTP server are."""
    content = shipped(name)
    client = content.pop("client")
    content.pop("relay")
    content.pop("http")
    own = content.pop("endpoint")
    assert (own if isinstance(own, list) else [own])[0]["kind"] in {"ros1", "dds"}
    # `client_file` adds keys, the address of the relay and a free port for HTTP.
    return lab.client_file(client["name"], endpoint, **{"discovery": {"mode": "manual"}, **content}, client=client)


@pytest.mark.parametrize("drive", ["real", "made"])
@pytest.mark.parametrize("site", ["site-noetic", "site-jazzy"])
async def test_what_an_operator_needs_of_a_husky_arrives(tmp_path: Path, site: str, drive: str) -> None:
    bag = recording("husky_gps_imu_odom.bag") if drive == "real" else made(tmp_path / "made.bag")
    with Reader(bag) as reader:
        assert {connection.topic for connection in reader.connections} == NEEDED.keys()
    async with Lab(tmp_path, "husky1", "site1") as lab:
        relay = await lab.relay(lab.relay_file(access=shipped("relay")["access"]))
        # A recorder takes both encodings, so the site of ROS 2 is tested without a conversion.
        target = await lab.connected(here(lab, site, {"kind": "record", "path": "site1", "overwrite": True}))
        play = {"kind": "bag", "path": str(bag), "rate": 0, "wait_for": sorted(NEEDED)}
        robot = await lab.connected(here(lab, "husky-noetic", play))
        await until(lambda: {s.topic for s in relay.hub.relayed} >= {f"/husky1{name}" for name in NEEDED})
        received = target.core.received.topics
        wanted = {TopicName(f"/husky1{name}") for name in NEEDED}
        await until(
            lambda: {name for name, counters in received.items() if counters.delivered} == wanted,
            "every topic that an operator needs arrives",
        )
        await lab.end(robot)
        await lab.end(target)
    arrived = bodies(tmp_path / "site1.bag")
    assert arrived.keys() == {f"/husky1{name}" for name in NEEDED}
    sent = bodies(bag)
    for name, type_name in NEEDED.items():
        original = [ros_types.deserialise(body, type_name, Encoding.ROS1) for body in sent[name]]
        stamps = {(m.header.stamp.sec, m.header.stamp.nanosec): m for m in original}
        for body in arrived[f"/husky1{name}"]:
            message = ros_types.deserialise(body, type_name, Encoding.ROS1)
            source = stamps[message.header.stamp.sec, message.header.stamp.nanosec]
            assert message.header.frame_id == f"husky1/{source.header.frame_id.removeprefix('/')}"
