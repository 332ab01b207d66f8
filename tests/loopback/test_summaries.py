"""Summaries between real daemons: a robot's clouds, grids and transforms in, what a site recorded out."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.bag import BagEndpoint
from sern_client.endpoints.clouds import read_ply
from sern_client.endpoints.synthetic import LATE_S, SyntheticEndpoint
from sern_core.summaries.spec import SummaryLevel
from sern_core.summaries.voxel import thin_rows
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime import ros_types
from tests.daemons import START_NS, Lab, balance, bodies, endpoint_of, recording
from tests.sern_core.summaries import scenes
from tests.sern_core.summaries.test_patches import grid_body
from tests.sern_core.summaries.test_transforms import message as tf_message
from tests.sern_core.summaries.test_transforms import pairs, transform
from tests.support import until

FILES = {"ros1": ("site.bag", Encoding.ROS1), "cdr": ("site.mcap", Encoding.CDR)}


def robot_section(encoding: str, *topics: str, **settings: Any) -> dict[str, Any]:
    return {"kind": "synthetic", "role": "robot", "topics": list(topics), "encoding": encoding, **settings}


def bag_of(path: Path, messages: list[tuple[str, str, bytes]], *, latched: tuple[str, ...] = ()) -> Path:
    """A ROS 1 bag of (topic, type, body), 20 ms apart."""
    store = ros_types.typestore(Encoding.ROS1)
    with Writer1(path) as writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=store, latching=int(name in latched))
            for name, kind in dict.fromkeys((name, kind) for name, kind, _ in messages)
        }
        for number, (name, _, body) in enumerate(messages):
            writer.write(connections[name], START_NS + number * 20_000_000, body)
    return path


async def taken(robot: SyntheticEndpoint, count: int) -> None:
    """Wait until so many more messages of the simulated robot were taken."""
    before = robot.counters.accepted
    await until(lambda: robot.counters.accepted >= before + count, f"{count} more are taken")


async def delivered(site: ClientDaemon, topic: TopicName, count: int) -> None:
    """Wait until so many messages of a topic have arrived."""
    counters = site.core.received.topics
    await until(lambda: topic in counters and counters[topic].delivered >= count, f"{count} of {topic}")


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
async def test_clouds_arrive_as_thin_clouds_scans_and_masks(tmp_path: Path, encoding: str) -> None:
    files = [recording("lidar_scan_a.ply")]
    endpoint = robot_section(encoding, "/points", cloud_files=[str(file) for file in files], cloud_rate_hz=10.0)
    summaries = [
        {"kind": "voxel", "voxel_m": 0.2, "as": "thin"},
        {"kind": "scan"},
        {"kind": "occupancy_mask", "size_m": 10.0},
    ]
    rule = {"match": "/points", "class": "bulk", "reliability": "reliable", "summary": summaries}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/points.*"))
        robot = await lab.connected(lab.client_file("robot1", endpoint, topics=[rule]))
        arrived = site.core.received.topics
        names = [TopicName(f"/robot1/points/{kind}") for kind in ("thin", "scan", "mask")]
        await until(lambda: all(name in arrived and arrived[name].delivered >= 3 for name in names))
        assert TopicName("/robot1/points") not in arrived
        streams = {stream.stream.id.topic: stream.stream for stream in site.core.link.taking.streams.values()}
        assert streams[names[1]].attributes.items() >= {"summary": "scan", "summary_of": "/robot1/points"}.items()
        assert streams[names[0]].spec.priority == 2 and streams[names[1]].spec.priority == 1
        for summary in robot.bridge.outbound.summaries.topics:
            assert summary.profile.messages >= 3 and 0 < summary.profile.bytes_ratio < 0.15
            assert 0 < summary.profile.seconds_per_message < 1
        assert balance(robot.topics()) == []
        for daemon in (robot, site, relay):
            await lab.end(daemon)

    name, kind = FILES[encoding]
    found = bodies(tmp_path / name)
    cloud = scenes.read(found[names[0]][0], scenes.CLOUD, kind)
    _, means = thin_rows(read_ply(files[0])[:, :3], 0.2)
    assert means is not None
    assert np.array_equal(scenes.xyz_of(scenes.records(cloud)), means.astype(np.float32))
    scan = scenes.read(found[names[1]][0], scenes.SCAN, kind)
    mask = scenes.read(found[names[2]][0], scenes.GRID, kind)
    assert np.isfinite(scan.ranges).sum() > 500 and (np.asarray(mask.data) == 100).sum() > 200
    assert cloud.header.frame_id == scan.header.frame_id == mask.header.frame_id == "velodyne"
    stamps_s = [
        message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        for message in (scenes.read(body, scenes.SCAN, kind) for body in found[names[1]])
    ]
    # The clouds' own stamps. On a busy machine not each of them could be taken; a very late source goes on from now.
    steps = np.diff(stamps_s) / 0.1
    assert (steps > 0.5).all()
    assert (np.isclose(steps, np.round(steps), atol=1e-4) | (steps > 1 + LATE_S / 0.1)).all(), steps


async def test_the_level_may_change_at_any_time(tmp_path: Path) -> None:
    """A level changes between whole clouds and thin ones: nothing is lost or overtaken, by the clouds' own counts."""
    endpoint = robot_section("ros1", "/points", cloud_rate_hz=40.0, cloud_bytes=100_000)
    summary = {"kind": "voxel", "voxel_m": 1.0, "in_place": True}
    rule = {"match": "/points", "class": "bulk", "reliability": "reliable", "depth": 100, "summary": summary}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/points"))
        robot = await lab.connected(lab.client_file("robot1", endpoint, topics=[rule]))
        topic = TopicName("/robot1/points")
        handle = robot.bridge.outbound.summaries.topics[0]
        simulated: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        for _ in range(8):
            await taken(simulated, 10)
            handle.set_level(SummaryLevel.RAW if handle.level is SummaryLevel.SUMMARY else SummaryLevel.SUMMARY)
        robot.bridge.outbound.stop_sources()
        accepted = simulated.counters.accepted
        await delivered(site, topic, accepted)
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    clouds = [scenes.read(body, scenes.CLOUD, Encoding.ROS1) for body in bodies(tmp_path / "site.bag")[topic]]
    numbers = [cloud.header.seq for cloud in clouds]
    assert numbers == sorted(numbers) and len(set(numbers)) == len(numbers) == accepted
    sizes = {len(cloud.data) > 50_000 for cloud in clouds}
    assert sizes == {True, False}


@pytest.mark.parametrize("late", [False, True])
async def test_patches_arrive_as_whole_grids(tmp_path: Path, late: bool) -> None:
    """Also for a site that comes when all is over, and that has asked for the map only."""
    random = np.random.default_rng(5)
    cells = np.full((300, 400), -1, np.int8)
    grids = []
    for number in range(40):
        if number == 25:
            cells = np.pad(cells, ((0, 20), (0, 0)), constant_values=-1)  # the map has grown
        y, x = int(random.integers(0, 280)), int(random.integers(0, 380))
        cells[y : y + 12, x : x + 9] = random.integers(-1, 101, (12, 9))
        grids.append(grid_body(cells, number, Encoding.ROS1))
    bag = bag_of(tmp_path / "map.bag", [("/map", scenes.GRID, body) for body in grids], latched=("/map",))
    play = {"kind": "bag", "path": str(bag), "rate": 1.0, "wait_for": ["/map"], "start_delay_s": 0.2}
    rule = {"match": "/map", "class": "state", "summary": {"kind": "patches"}}
    topic = TopicName("/robot1/map")
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = None if late else await lab.connected(lab.recorder_file("site", "/robot1/map"))
        robot = await lab.connected(lab.client_file("robot1", play, topics=[rule]))
        await until(lambda: endpoint_of(robot, BagEndpoint).exhausted and not robot.bridge.outbound.pending)
        updates = robot.core.link.sender.ledger.topics[TopicName("/robot1/map_updates")]
        await until(lambda: updates.offered and updates.delivered == updates.offered, "updates are delivered")
        if site is None:
            site = await lab.connected(lab.recorder_file("site", "/robot1/map"))
        rebuilds = site.bridge.inbound.rebuilds
        updates_topic = TopicName("/robot1/map_updates")
        if late:  # what came after the last whole grid, which is the one at which the map grew
            await delivered(site, topic, 1)
            owed = relay.hub.links[ClientName("site")].sender.ledger.topics

            def caught_up() -> bool:
                counters = owed.get(updates_topic)
                return counters is not None and 0 < counters.offered == counters.delivered

            await until(caught_up, "the updates are delivered")
        else:
            await delivered(site, updates_topic, updates.offered)
        assert rebuilds.gaps == rebuilds.undecodable == 0
        sent = robot.core.link.sender.ledger.topics
        wire_bytes = sent[topic].delivered_bytes + updates.delivered_bytes
        assert wire_bytes < sum(len(body) for body in grids) / 5
        assert balance(robot.topics()) == []
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    found = bodies(tmp_path / "site.bag")
    assert list(found) == [topic]  # the updates are not published: nobody asked for them
    assert found[topic][-1] == grids[-1]
    order = [grids.index(body) for body in found[topic]]
    assert order == sorted(order)  # as many of them as could be taken


async def test_transforms_of_many_nodes_become_one_message(tmp_path: Path) -> None:
    ros1 = Encoding.ROS1
    messages = [
        ("/tf_static", scenes.TF, tf_message(transform("base", f"sensor{n}", 1, n, ros1), encoding=ros1))
        for n in range(12)
    ]
    for step in range(100):
        for node in range(4):
            move = transform("base", f"joint{node}", 10 + step * 0.08, step, ros1)
            messages.append(("/tf", scenes.TF, tf_message(move, encoding=ros1)))
    bag = bag_of(tmp_path / "tf.bag", messages, latched=("/tf_static",))
    play = {"kind": "bag", "path": str(bag), "rate": 4.0, "wait_for": ["/tf"], "start_delay_s": 0.2}
    rule = {"match": "/tf|/tf_static", "class": "state", "reliability": "reliable", "max_rate_hz": 10.0}
    async with Lab(tmp_path, "robot1", "site", "late") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/tf", "/tf_static"))
        robot = await lab.connected(lab.client_file("robot1", play, client={"namespace": "/"}, topics=[rule]))
        await until(lambda: endpoint_of(robot, BagEndpoint).exhausted and not robot.bridge.outbound.pending)
        late = await lab.connected(lab.recorder_file("late", "/tf_static"))
        arrived = site.core.received.topics
        sent = robot.core.link.sender.ledger.topics[TopicName("/tf")]
        await until(lambda: TopicName("/tf_static") in late.core.received.topics)
        await until(lambda: sent.offered and TopicName("/tf") in arrived)
        await until(lambda: arrived[TopicName("/tf")].delivered == sent.offered)
        for daemon in (robot, site, late, relay):
            await lab.end(daemon)
    static = bodies(tmp_path / "late.bag")["/tf_static"]
    assert len(static) == 1 and len(pairs(static[0], ros1)) == 12
    merged = [pairs(body, ros1) for body in bodies(tmp_path / "site.bag")["/tf"]]
    assert len(merged) < 200  # of 400 messages, each of one transform, in about 2 s
    for node in range(4):
        values = [message[("base", f"joint{node}")] for message in merged if ("base", f"joint{node}") in message]
        assert values == sorted(set(values)) and values[-1] == 99  # in order, none twice, and the last one


async def test_what_cannot_be_read_is_counted_and_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    ros1 = Encoding.ROS1
    whole = scenes.cloud_body(scenes.structured(np.eye(3, dtype=np.float32)), ros1)
    cloud = [("/points", scenes.CLOUD, body) for body in (whole, whole[:40], whole[:50], whole)]
    grid = grid_body(np.zeros((5, 6)), 3, ros1)
    maps = [("/map", scenes.GRID, body) for body in (grid, grid[:30])]
    transforms = tf_message(transform("a", "b", 1, 1, ros1), encoding=ros1)
    moves = [("/tf", scenes.TF, body) for body in (b"\x01\x02", transforms)]
    bag = bag_of(tmp_path / "odd.bag", [*cloud, *maps, *moves])
    play = {"kind": "bag", "path": str(bag), "rate": 1.0, "wait_for": ["/points", "/map", "/tf"], "start_delay_s": 0.2}
    rules = [
        {"match": "/points", "reliability": "reliable", "summary": {"kind": "voxel"}},
        {"match": "/map", "reliability": "reliable", "summary": {"kind": "patches"}},
        {"match": "/tf", "class": "state", "reliability": "reliable", "merge_tf": True},
        {"match": "/odom", "summary": {"kind": "scan"}},
    ]
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/points/voxel", "/robot1/map", "/robot1/tf"))
        robot = await lab.connected(lab.client_file("robot1", play, topics=rules))
        await until(lambda: endpoint_of(robot, BagEndpoint).exhausted and not robot.bridge.outbound.pending)
        for name, count in (("points/voxel", 2), ("map", 2), ("tf", 2)):
            await delivered(site, TopicName(f"/robot1/{name}"), count)
        view = robot.topics()["/robot1/points/voxel"]
        assert view["dropped"] == {"undecodable": 2}
        assert balance(robot.topics()) == []
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    found = bodies(tmp_path / "site.bag")
    assert found["/robot1/map"] == [grid, grid[:30]]  # as it came
    assert found["/robot1/tf"] == [b"\x01\x02", transforms]
    said = [record.getMessage() for record in caplog.records if "such messages are" in record.getMessage()]
    assert len(said) == 3 and all("\n" not in line for line in said)
