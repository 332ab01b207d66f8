"""The recordings that benchmarks play, and what is made up in their place where they are not beside the checkout.

Looked for in `../shared/data`: a drive of a Husky (pose, IMU and GNSS) and two LiDAR scans of 70,000 points. What is
made up comes from the simulated Jackal: messages of the same types, at the rates of the recording, and scans of as many
points. Figures of made-up bodies say so: whoever reports them adds `note()` to the report.
"""

import tempfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from sern_client.endpoints.clouds import read_ply
from sern_client.endpoints.jackal import JACKAL, JackalSource, Plan, Sizes
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_sim.robot import SimulatedJackal
from sern_tools.explain_replay import read_bag

DATA: Final = Path(__file__).resolve().parents[2] / "shared" / "data"
DRIVE: Final = "husky_gps_imu_odom.bag"
SCANS: Final = ("lidar_scan_a.ply", "lidar_scan_b.ply")
MADE_DRIVE_S: Final = 30.0
MADE_POINTS: Final = 70_000
MADE_TOPICS: Final = (
    ("/imu/data", "/imu/data", 30.0),
    ("/odometry/filtered", "/odom", 10.0),
    ("/navsat/fix", "/fix", 2.5),
)
"""(of the simulated Jackal, here, Hz)."""
_START_NS: Final = 1_700_000_000_000_000_000


def absent(data: Path = DATA) -> list[str]:
    """The names of what is made up, as it is not there."""
    return [name for name in (DRIVE, *SCANS) if not (data / name).exists()]


def note(data: Path = DATA) -> str:
    """What was played, for a report."""
    made = absent(data)
    if not made:
        return "the Husky's recording with LiDAR scans"
    return f"made-up bodies in place of what is not beside the checkout ({', '.join(made)})"


def drive_file(directory: Path, data: Path = DATA) -> Path:
    """The drive as a ROS 1 bag; where it is absent, one that is made up in `directory`."""
    if (data / DRIVE).exists():
        return (data / DRIVE).resolve()
    path = directory / "made_drive.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    source = JackalSource(Random(1), Encoding.ROS1, Sizes(), patrol=True)
    with Writer(path) as writer:
        connections = {
            name: writer.add_connection(name, _plan(original).type_name, typestore=store)
            for original, name, _ in MADE_TOPICS
        }
        for at_s, original, name in _due():
            source.advance(at_s)
            stamp_ns = _START_NS + int(at_s * 1e9)
            writer.write(connections[name], stamp_ns, source.body(_plan(original), stamp_ns))
    return path


def _due() -> Iterator[tuple[float, str, str]]:
    """(time, topic of the Jackal, its name here), by time."""
    ticks = (
        (number / rate_hz, original, name)
        for original, name, rate_hz in MADE_TOPICS
        for number in range(int(MADE_DRIVE_S * rate_hz))
    )
    yield from sorted(ticks)


def _plan(topic: str) -> Plan:
    return next(plan for plan in JACKAL if plan.name == topic)


def drive(duration_s: float, data: Path = DATA) -> tuple[dict[str, TopicInfo], list[tuple[float, str, bytes]]]:
    """The drive's topics, and (seconds from the first, topic, body) of the first `duration_s` seconds.

    A made-up drive begins again at its end.
    """
    with tempfile.TemporaryDirectory(prefix="sern-drive-") as name:
        path = drive_file(Path(name), data)
        infos, found = read_bag(path, duration_s)
    messages = [(message.at_s, message.topic, message.body) for message in found]
    if DRIVE in absent(data):
        rounds = int(duration_s // MADE_DRIVE_S) + 1
        messages = [(n * MADE_DRIVE_S + at_s, topic, body) for n in range(rounds) for at_s, topic, body in messages]
    return infos, [message for message in messages if message[0] <= duration_s]


def scans(data: Path = DATA) -> list[NDArray[np.float32]]:
    """Two scans, each (n, 4) x y z intensity; made up, all of them, where one is absent."""
    if all((data / name).exists() for name in SCANS):
        return [read_ply(data / name) for name in SCANS]
    return list(islice(_made_scans(), len(SCANS)))


def points(nbytes: int, data: Path = DATA) -> bytes:
    """About so many bytes of a scan's points, evenly thinned, or of several scans: x y z intensity as float32."""
    scan = scans(data)[0]
    wanted = max(1, nbytes // scan[0].nbytes)
    if wanted <= len(scan):
        return bytes(scan[:: len(scan) // wanted][:wanted].tobytes())
    return bytes(scan.tobytes() * (wanted // len(scan) + 1))[: wanted * scan[0].nbytes]


def _made_scans() -> Iterator[NDArray[np.float32]]:
    """What a robot that drives on sees every two seconds, without the rays that met nothing."""
    robot = SimulatedJackal(Random(1), patrol=True)
    for number in range(1, 1000):
        while robot.state.time_s < 2.0 * number:
            robot.step()
        cloud = robot.cloud(MADE_POINTS * 2)
        yield cloud[~np.isnan(cloud).any(axis=1)][:MADE_POINTS]


def write_scan(points: NDArray[np.float32], into: Path) -> None:
    """A scan as `.ply`, binary little endian."""
    names = ("x", "y", "z", "intensity")[: points.shape[1]]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [*(f"property float {name}" for name in names), "end_header", ""]
    into.write_bytes("\n".join(head).encode() + np.ascontiguousarray(points, dtype="<f4").tobytes())
