"""Real LiDAR scans as PointCloud2 at 10 Hz: what arrives is what was scanned, point for point and byte for byte."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sern_client.endpoints.clouds import read_ply
from sern_client.endpoints.synthetic import LATE_S, SyntheticEndpoint
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_tools.message_log import read_logs
from tests.daemons import Lab, bodies, endpoint_of, recording
from tests.support import until

CLOUDS = TopicName("/robot1/points")
RATE_HZ = 4.0
"""What a busy machine carries as well. A starved one does not: then the source is refused some, and goes on."""
SCANS = ("lidar_scan_a.ply", "lidar_scan_b.ply")


def points(cloud: Any) -> Any:
    """The (n, 3) or (n, 4) floats of a PointCloud2."""
    width = cloud.point_step // 4
    return np.frombuffer(cloud.data.tobytes(), dtype="<f4").reshape(cloud.width, width)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
async def test_two_scans_arrive_identical(tmp_path: Path, encoding: str) -> None:
    files = [recording(name) for name in SCANS]
    endpoint = {
        "kind": "synthetic",
        "role": "robot",
        "topics": ["/points"],
        "cloud_files": [str(file) for file in files],
        "cloud_rate_hz": RATE_HZ,
        "encoding": encoding,
    }
    rule = {"match": "/points", "class": "bulk", "reliability": "reliable"}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/points", message_log="site.csv"))
        robot = await lab.connected(
            lab.client_file("robot1", endpoint, topics=[rule], message_log="robot1.csv")
        )  # fmt: skip
        arrived = site.core.received.topics
        await until(lambda: CLOUDS in arrived and arrived[CLOUDS].delivered >= 8)
        simulated: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        for daemon in (robot, site, relay):
            await lab.end(daemon)

    name, kind = ("site.bag", Encoding.ROS1) if encoding == "ros1" else ("site.mcap", Encoding.CDR)
    scans = [read_ply(file) for file in files]
    clouds = [ros_types.deserialise(b, "sensor_msgs/msg/PointCloud2", kind) for b in bodies(tmp_path / name)[CLOUDS]]
    assert len(clouds) >= 8
    which = [[np.array_equal(points(cloud), scan, equal_nan=True) for scan in scans] for cloud in clouds]
    assert all(sum(equal) == 1 for equal in which) and {equal.index(True) for equal in which} == {0, 1}
    if not simulated.counters.refused:  # else one of the turn is missing
        assert all(equal[index % 2] for index, equal in enumerate(which))
    stamps_s = [cloud.header.stamp.sec + cloud.header.stamp.nanosec * 1e-9 for cloud in clouds]
    steps_s = np.diff(stamps_s)  # a source that is very late goes on from now
    assert (np.isclose(steps_s, 1.0 / RATE_HZ, atol=1e-6) | (steps_s > 1.0 / RATE_HZ + LATE_S)).all(), steps_s
    log = read_logs([("robot1", tmp_path / "robot1.csv"), ("site", tmp_path / "site.csv")])[CLOUDS]
    sent = sorted(log.offers)[: len(log.deliveries)]  # what was under way at the end may be unconfirmed
    assert [(d.seq, d.crc32) for d in log.deliveries] == [(seq, log.offers[seq].crc32) for seq in sent]
