"""Compression with the real daemons: real recordings arrive byte for byte, and nobody in between unpacks them."""

import asyncio
import threading
from pathlib import Path

import numpy as np
import pytest
import zmq

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.clouds import read_ply
from sern_core.bodies import lossy
from sern_core.bodies.codecs import Coder, Work
from sern_core.summaries.voxel import thin_rows
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.codec_pool import CodecPool, make_coder
from sern_runtime.config.client import load_client
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, bodies, recording, under
from tests.loopback.test_summaries import bag_of
from tests.sern_core.bodies.test_lossy import IMAGE, image_body, scene
from tests.support import until

CLOUDS = TopicName("/robot1/points")


def rule(match: str, compression: str) -> dict[str, object]:
    return {"match": match, "class": "state", "reliability": "reliable", "compression": compression}


async def test_a_recorded_drive_arrives_byte_for_byte(tmp_path: Path) -> None:
    bag = recording("jackal_imu_odom.bag")
    sent = {TopicName(name): content for name, content in under("robot1", bodies(bag)).items()}
    topics = [rule(".*/odom", "zstd"), rule("/imu/data", "lz4"), rule(".*", "none")]
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, topics=topics))
        arrived = site.core.received.topics
        await until(
            lambda: all(name in arrived and arrived[name].delivered >= len(sent[name]) for name in sent),
            "everything arrives",
            deadline_s=60.0,
        )
        views = robot.topics()
        passed = relay.hub.received.topics
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    assert bodies(tmp_path / "site.bag") == sent
    odom, imu = TopicName("/robot1/jackal_velocity_controller/odom"), TopicName("/robot1/imu/data")
    for name, mode, most in ((odom, "zstd", 0.25), (imu, "lz4", 0.6)):
        view = views[name]["compression"]
        raw_bytes = sum(map(len, sent[name]))
        assert view["setting"] == view["mode"] == mode
        assert view["bytes_raw"] == raw_bytes
        assert view["ratio"] < most
        assert set(view["profiles"]) == {"lz4", "zstd", "zstd_strong"}
        assert all(profile["speed_bytes_per_s"] > 0 for profile in view["profiles"].values())
        assert passed[name].delivered_bytes == view["bytes_encoded"] < most * raw_bytes
        assert arrived[name].delivered_bytes == raw_bytes


async def test_scans_are_unpacked_at_the_site_and_for_the_feed_alone(tmp_path: Path) -> None:
    endpoint = {
        "kind": "synthetic",
        "role": "robot",
        "topics": ["/points"],
        "cloud_files": [str(recording("lidar_scan_a.ply")), str(recording("lidar_scan_b.ply"))],
        "cloud_rate_hz": 10.0,
        "encoding": "ros1",
    }
    feed = f"tcp://{HOST}:{free_ports(1)[0]}"
    role = {"name": "viewer", "publish_endpoint": feed, "subscribe": ["/robot1/.*"]}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [role]}))
        site = await lab.connected(lab.recorder_file("site", "/robot1/points"))
        robot = await lab.connected(lab.client_file("robot1", endpoint, topics=[rule("/points", "zstd")]))
        arrived = site.core.received.topics
        await until(lambda: CLOUDS in arrived and arrived[CLOUDS].delivered >= 4)
        assert sum(c.messages for c in relay.coder.decoded.values()) == 0, "the relay unpacked what nobody there reads"
        seen: list[list[bytes]] = []
        with zmq.Context() as ctx, ctx.socket(zmq.SUB) as sub:
            sub.linger = 0
            sub.subscribe(b"")
            sub.connect(feed)

            def received() -> bool:
                while sub.poll(0):
                    seen.append(sub.recv_multipart())
                return len(seen) >= 4

            await until(received)
        await until(lambda: arrived[CLOUDS].delivered >= 12)
        assert robot.core.coder.encoded[Compression.ZSTD].elapsed_s > 0.0
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    recorded = bodies(tmp_path / "site.bag")[CLOUDS]
    assert len(recorded) >= 12
    assert {parts[2] for parts in seen} <= set(recorded)
    passed = relay.hub.received.topics[CLOUDS]
    assert passed.delivered_bytes < 0.8 * passed.delivered * min(map(len, recorded))


async def test_a_topic_that_allows_it_loses_points_and_stays_a_cloud(tmp_path: Path) -> None:
    pytest.importorskip("DracoPy", reason="the Python package DracoPy (extra lossy) is not installed")
    endpoint = {
        "kind": "synthetic",
        "role": "robot",
        "topics": ["/points"],
        "cloud_files": [str(recording("lidar_scan_a.ply"))],
        "cloud_rate_hz": 10.0,
        "encoding": "cdr",
    }
    topic = rule("/points", "voxel_draco") | {"lossy": ["voxel_draco", "jpeg"], "voxel_m": 0.2}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/points"))
        robot = await lab.connected(lab.client_file("robot1", endpoint, topics=[topic]))
        arrived = site.core.received.topics
        await until(lambda: CLOUDS in arrived and arrived[CLOUDS].delivered >= 5)
        # Every mode is tried beside the messages, and behind them.
        await until(lambda: "voxel_draco" in robot.topics()[CLOUDS]["compression"]["profiles"], "all modes were tried")
        passed = relay.hub.received.topics[CLOUDS]
        assert passed.delivered_bytes < 30_000 * passed.delivered
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    scan = read_ply(recording("lidar_scan_a.ply"))
    wanted = thin_rows(scan[:, :3], 0.2)[1]
    assert wanted is not None
    for body in bodies(tmp_path / "site.mcap")[CLOUDS]:
        cloud = ros_types.deserialise(body, "sensor_msgs/msg/PointCloud2", Encoding.CDR)
        assert cloud.header.frame_id == "velodyne"
        points = cloud.data.view("<f4").reshape(-1, 3)
        assert 0.95 * len(wanted) <= len(points) == cloud.width <= len(wanted)
        assert np.allclose(points.min(axis=0), wanted.min(axis=0), atol=0.0101)
        assert np.allclose(points.max(axis=0), wanted.max(axis=0), atol=0.0101)


async def test_images_arrive_as_images_through_jpeg(tmp_path: Path) -> None:
    """A recorded camera: header, size and encoding survive, the pixels nearly, and the link carries a fraction."""
    pytest.importorskip("PIL", reason="the Python package Pillow (extra lossy) is not installed")
    view = scene(240, 320, 3)
    shots = [image_body(np.roll(view, 4 * shot, axis=1), "rgb8", Encoding.ROS1, padding=8) for shot in range(12)]
    bag = bag_of(tmp_path / "camera.bag", [("/camera", IMAGE, body) for body in shots])
    play = {"kind": "bag", "path": str(bag), "rate": 1.0, "wait_for": ["/camera"], "start_delay_s": 0.2}
    topic = rule("/camera", "jpeg") | {"lossy": ["jpeg"], "jpeg_quality": 85}
    name = TopicName("/robot1/camera")
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", name))
        robot = await lab.connected(lab.client_file("robot1", play, topics=[topic]))
        arrived = site.core.received.topics
        await until(lambda: name in arrived and arrived[name].delivered == len(shots), "all images are there")
        passed = relay.hub.received.topics[name]
        assert passed.delivered_bytes < 0.2 * sum(map(len, shots))
        assert robot.topics()[name]["compression"]["mode"] == "jpeg"
        assert robot.core.coder.unencodable == 0
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    found = bodies(tmp_path / "site.bag")[name]
    for sent, body in zip(shots, found, strict=True):
        before, after = (ros_types.deserialise(one, IMAGE, Encoding.ROS1) for one in (sent, body))
        assert (after.header.frame_id, after.height, after.width, after.encoding) == ("camera", 240, 320, "rgb8")
        assert after.header.stamp == before.header.stamp
        assert after.step == 3 * 320  # the padding at the end of rows is gone
        pixels = before.data.reshape(240, before.step)[:, : after.step].astype(float)
        assert np.abs(after.data.reshape(240, after.step) - pixels).mean() < 4.0


async def test_an_absent_library_is_said_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lossy, "find_spec", lambda _name: None)
    topic = rule("/points", "auto") | {"lossy": ["voxel_draco"]}
    lab = Lab(tmp_path, "robot1")
    path = lab.client_file("robot1", {"kind": "synthetic", "role": "robot"}, topics=[topic])
    with pytest.raises(ConfigError, match=r"topics.0.lossy: .*pip install DracoPy"):
        ClientDaemon(load_client(path))


class Job(Work):
    """Notes where it ran; the first waits until it may."""

    def __init__(self, priority: int, done: list[int], gate: threading.Event | None = None) -> None:
        self.priority = priority
        self.thread = 0
        self._done = done
        self._gate = gate

    def run(self) -> None:
        self.thread = threading.get_ident()
        if self._gate is not None:
            assert self._gate.wait(20.0)

    def done(self, *, now: float) -> None:
        assert threading.get_ident() != self.thread
        self._done.append(self.priority)


class Fault(Job):
    def run(self) -> None:
        raise MemoryError


async def test_urgent_work_goes_first_and_a_fault_ends_nothing() -> None:
    done: list[int] = []
    gate = threading.Event()
    after: list[int] = []
    pool = CodecPool(after=lambda: after.append(len(done)), workers=1)
    try:
        pool.take(Job(9, done, gate))
        for job in (Job(2, done), Fault(1, done), Job(0, done)):
            pool.take(job)
        gate.set()
        await until(lambda: len(done) == 4)
    finally:
        pool.close()
    assert done == [9, 0, 1, 2]
    assert after == [1, 2, 3, 4]
    pool.close()


async def test_work_that_ends_after_the_pool_is_forgotten() -> None:
    done: list[int] = []
    pool = CodecPool(after=lambda: None)
    pool.take(Job(0, done))
    pool.close()
    turned = asyncio.Event()
    asyncio.get_running_loop().call_soon_threadsafe(turned.set)  # behind whatever the pool's threads have asked for
    await turned.wait()
    assert done == []


async def test_the_coder_of_a_daemon_measures_time() -> None:
    pool = CodecPool(after=lambda: None)
    try:
        coder: Coder = make_coder(LinkParams(), pool)
        assert coder.encode(Compression.ZSTD, b"robot " * 10_000).elapsed_s > 0.0
    finally:
        pool.close()
