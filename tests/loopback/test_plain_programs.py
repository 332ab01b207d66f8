"""The plain programs of deploy/examples/plain as people start them, at a real relay with a real robot."""

import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import zmq
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_geometry, ros_types
from sern_runtime.feed import FeedHeader
from sern_sim.models import LinkModel
from sern_tools.ports import free_ports
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, START_NS, Lab, endpoint_of
from tests.plain_programs import PROGRAMS, ROOT, Prepared, Program, Silence, running
from tests.support import child, until

ODOMETRY: Final = "/odometry/filtered"
POSE: Final = "/pose"
DELAY_S: Final = 0.2
"""Of the robot's link, one way."""


def robot(encoding: str = "ros1", *topics: str) -> dict[str, Any]:
    return {
        "kind": "synthetic",
        "role": "robot",
        "encoding": encoding,
        "patrol": True,
        "topics": list(topics),
        "pose_rate_hz": 20.0,
    }


class Feed:
    """The role of a relay's file, and a subscriber that keeps what is sent, to compare with what is printed."""

    def __init__(self) -> None:
        self.address, self.ingest_address = (f"tcp://{HOST}:{port}" for port in free_ports(2))
        self.role: dict[str, Any] = {"name": "viewer", "publish_endpoint": self.address, "subscribe": [".*"]}
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._sent: dict[int, tuple[FeedHeader, bytes]] = {}

    def close(self) -> None:
        self._socket.close(linger=0)
        self._context.term()

    def watch(self, topic: str) -> None:
        self._socket.subscribe(topic.encode() + b"\0")
        self._socket.connect(self.address)

    @property
    def sent(self) -> dict[int, tuple[FeedHeader, bytes]]:
        """Header and body by seq."""
        while self._socket.poll(0):
            _, packed, body = self._socket.recv_multipart()
            header = FeedHeader.parse(packed)
            assert header is not None
            self._sent[header.seq] = header, body
        return self._sent


@pytest.fixture
def feed() -> Iterator[Feed]:
    feed = Feed()
    yield feed
    feed.close()


@pytest.fixture(params=PROGRAMS)
def prepared(request: pytest.FixtureRequest, tmp_path: Path) -> Prepared:
    """feed.py, and Feed.cs over libzmq or NetMQ."""
    return PROGRAMS[request.param](tmp_path)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
async def test_it_prints_where_the_robot_is_and_how_old_that_is(
    tmp_path: Path, feed: Feed, prepared: Prepared, encoding: str
) -> None:
    """The age has the delay of the robot's link in it, and is no more than went by: both are on one machine here,
    so that their clocks can be compared. Waited for, as a relay that stood still meanwhile knows ages less well."""
    topic = f"/jackal1{ODOMETRY}"
    slow = LinkModel(rate_bps=10e6, delay_s=DELAY_S)
    async with Lab(tmp_path, "jackal1") as lab:
        await lab.relay(lab.relay_file(feed={"roles": [feed.role]}))
        feed.watch(topic)
        async with ShapingProxy(slow, slow, [Route((HOST, 0), (HOST, lab.port))], seed=1) as proxy:
            host, port = proxy.addresses[0]
            relay = {"endpoint": f"tcp://{host}:{port}", "udp": False}
            proxy.start()
            rules = [{"match": ODOMETRY, "class": "state", "lifespan_s": None}]  # else they are too old by then
            config = lab.client_file("jackal1", robot(encoding, ODOMETRY), relay=relay, topics=rules)
            client = await lab.client(config)
            with running(prepared, tmp_path, feed.address, topic) as program:
                await until(lambda: len(program.heard) >= 10, "it prints messages")
                heard = program.heard
                await until(lambda: {line.seq for line in heard} <= feed.sent.keys(), "the messages came here, too")

                def as_old_as_it_is() -> bool:
                    line, now_ns = program.heard[-1], time.time_ns()
                    found = feed.sent.get(line.seq)
                    return found is not None and DELAY_S / 2 < line.age_s < (now_ns - found[0].stamp_ns) * 1e-9

                await until(as_old_as_it_is, "the age is right")
            await lab.end(client)
    for line in heard:
        header, body = feed.sent[line.seq]
        place = ros_types.deserialise(body, "nav_msgs/msg/Odometry", Encoding(encoding)).pose.pose.position
        assert line.topic == topic
        assert line.position_m == pytest.approx((place.x, place.y, place.z), abs=0.001)
        assert line.age_s == pytest.approx(header.age_us * 1e-6, abs=0.001)
    assert len({line.position_m for line in heard}) > 1, "the robot drives"


async def test_it_says_how_long_nothing_has_come(tmp_path: Path, feed: Feed, prepared: Prepared) -> None:
    """Before the robot is there, after it has gone, and no more when it is back."""
    topic = f"/jackal1{ODOMETRY}"

    def silences(program: Program) -> list[Silence]:
        """Those after the last message."""
        said = program.said
        last = max((at for at, line in enumerate(said) if not isinstance(line, Silence)), default=-1)
        return [line for line in said[last + 1 :] if isinstance(line, Silence)]

    async with Lab(tmp_path, "jackal1") as lab:
        await lab.relay(lab.relay_file(feed={"roles": [feed.role]}))
        with running(prepared, tmp_path, feed.address, topic) as program:
            await until(lambda: len(silences(program)) >= 2, "nothing has come yet")
            first, second = silences(program)[:2]
            assert first.age_s is second.age_s is None
            assert 1 <= first.for_s <= second.for_s

            config = lab.client_file("jackal1", robot("ros1", ODOMETRY))
            client = await lab.client(config)
            await until(lambda: program.heard, "the robot is there")
            await lab.end(client)
            await until(lambda: len(silences(program)) >= 3, "the robot has gone")
            gone = silences(program)[:3]
            ages = [line.age_s for line in gone if line.age_s is not None]
            assert ages == sorted(set(ages)) and len(ages) == 3, "the age grows"
            assert all(age_s > line.for_s - 0.6 for age_s, line in zip(ages, gone, strict=True)), "as long at the least"

            count = len(program.heard)
            await lab.client(config)
            await until(lambda: len(program.heard) > count, "the robot is back")


async def test_ctrl_c_ends_feed_py_without_a_word(tmp_path: Path, feed: Feed) -> None:
    with running(PROGRAMS["python"](tmp_path), tmp_path, feed.address, "/nothing") as program:
        await until(lambda: program.said, "it runs")
        program.process.send_signal(signal.SIGINT)
        await until(lambda: program.process.poll() is not None, "it ends")
        assert program.process.returncode == -signal.SIGINT
    assert "Traceback" not in (tmp_path / "printed.txt").read_text()


def pose_bag(path: Path) -> Path:
    """Recorded years ago."""
    store = get_typestore(Stores.ROS1_NOETIC)
    name = "geometry_msgs/msg/PoseStamped"
    with Writer(path) as writer:
        connection = writer.add_connection(POSE, name, typestore=store)
        for number in range(50):
            stamp_ns = START_NS + number * 10**8
            header = ros_types.header(stamp_ns, "odom", Encoding.ROS1, number)
            pose = ros_geometry.pose(Encoding.ROS1, number, -number)
            message = ros_types.new(name, Encoding.ROS1, header=header, pose=pose)
            writer.write(connection, stamp_ns, ros_types.serialise(message, name, Encoding.ROS1))
    return path


async def test_the_age_is_right_where_the_robot_has_another_clock(
    tmp_path: Path, feed: Feed, prepared: Prepared
) -> None:
    topic = f"/jackal1{POSE}"
    feed.watch(topic)
    async with Lab(tmp_path, "jackal1") as lab:
        await lab.relay(lab.relay_file(feed={"roles": [feed.role]}))
        with running(prepared, tmp_path, feed.address, topic) as program:
            await until(lambda: program.said, "it runs")
            began_s = time.monotonic()
            play = {"stamps": "bag", "rate": 1, "loop": True}
            await lab.client(lab.player_file("jackal1", pose_bag(tmp_path / "old.bag"), play=play))
            await until(lambda: len(program.heard) >= 5, "it prints messages")
            heard = program.heard
            await until(lambda: {line.seq for line in heard} <= feed.sent.keys(), "the messages came here, too")
            assert all(feed.sent[line.seq][0].stamp_ns < START_NS + 10**10 for line in heard)
            assert all(line.age_s <= time.monotonic() - began_s for line in heard)
            assert all(line.position_m[0] == -line.position_m[1] for line in heard)


def block(language: str) -> str:
    """The guide's only block of this language."""
    guide = (ROOT / "docs" / "plain.md").read_text()
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", guide, flags=re.M | re.S)
    return str(found)


async def test_the_guide_drives_a_robot(tmp_path: Path, feed: Feed) -> None:
    """Its lines for the relay's file and its program, with other ports."""
    (role,) = YAML(typ="safe").load(block("yaml"))["feed"]["roles"]
    ingest = role["ingest_endpoint"]
    assert ingest in block("python")
    role |= {"publish_endpoint": feed.address, "ingest_endpoint": feed.ingest_address}
    program = tmp_path / "drive.py"
    program.write_text(block("python").replace(ingest, feed.ingest_address))
    async with Lab(tmp_path, "jackal1") as lab:
        await lab.relay(lab.relay_file(feed={"roles": [role]}))
        topics = [{"match": "/cmd_vel", "class": "control", "direction": "receive"}]
        config = lab.client_file("jackal1", robot("ros1", ODOMETRY) | {"patrol": False}, topics=topics)
        endpoint = endpoint_of(await lab.connected(config), SyntheticEndpoint)
        start_m = endpoint.state().pose.x_m
        with child([sys.executable, "-I", str(program)]) as driver:
            await until(lambda: abs(endpoint.state().pose.x_m - start_m) > 0.2, "the robot moves")
            assert driver.poll() is None
