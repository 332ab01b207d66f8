"""Recordings through a relay and its clients as their user runs them: byte for byte, in order, everything counted."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from tests.daemons import START_NS, Lab, balance, bodies, delivered, recording, rss_bytes, under, write_bag
from tests.notified import notified
from tests.support import until

HUSKY, JACKAL = "husky_gps_imu_odom.bag", "jackal_imu_odom.bag"


def size(content: dict[str, list[bytes]]) -> int:
    return sum(map(len, content.values()))


@pytest.mark.parametrize(
    "files",
    [{"husky": HUSKY}, {"husky": HUSKY, "jackal": JACKAL}, {}],
    ids=["husky", "husky and jackal", "generated"],
)
async def test_recordings_arrive_byte_for_byte_and_in_order(tmp_path: Path, files: dict[str, str]) -> None:
    bags = {name: recording(file) for name, file in files.items()}
    bags = bags or {"robot1": write_bag(tmp_path / "run.bag", {"/chat": 500, "/log": 300, "/map": 1}, latched=["/map"])}
    contents = {name: bodies(bag) for name, bag in bags.items()}
    async with Lab(tmp_path, *bags, "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        robots = [lab.process(lab.player_file(name, bag)) for name, bag in bags.items()]
        await site.until(lambda: delivered(site) >= sum(map(size, contents.values())), "has everything")
        for robot in robots:
            await robot.stop()
            topics = robot.summary()["topics"]
            assert balance(topics) == []
            sent = {topic: counters["delivered"] for topic, counters in topics.items()}
            assert sent == {topic: len(texts) for topic, texts in under(robot.name, contents[robot.name]).items()}
        await site.stop()
        await relay.stop()
        for counters in relay.summary()["links"].values():
            assert balance(counters) == []
    expected: dict[str, list[bytes]] = {}
    for name, content in contents.items():
        expected |= under(name, content)
    assert bodies(tmp_path / "site.bag") == expected


async def test_cdr_arrives_in_an_mcap(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    string = "std_msgs/msg/String"
    with Writer2(tmp_path / "ros2", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [writer.add_connection(name, string, typestore=store) for name in ("/chat", "/log")]
        for number in range(200):
            for connection in topics:
                body = store.serialize_cdr(store.types[string](data=f"{connection.topic} {number}"), string)
                writer.write(connection, START_NS + number * 1_000_000, body)
    [bag] = (tmp_path / "ros2").glob("*.mcap")
    content = bodies(bag)
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag))
        await until(lambda: delivered(site) == size(content))
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    assert bodies(tmp_path / "site.mcap") == under("robot1", content)
    assert not (tmp_path / "site.bag").exists()


async def test_one_recording_plays_as_many_robots(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 100, "/log": 50})
    content = bodies(bag)
    names = [f"r{number}" for number in range(1, 9)]
    async with Lab(tmp_path, "fleet", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/r[0-9]+/.*"))
        play = {"namespaces": names, "wait_for": [f"/{name}/chat" for name in names]}
        robots = await lab.connected(lab.player_file("fleet", bag, play=play, client={"namespace": "/"}))
        await until(lambda: delivered(site) == len(names) * size(content))
        for daemon in (robots, site, relay):
            await lab.end(daemon)
    expected: dict[str, list[bytes]] = {}
    for name in names:
        expected |= under(name, content)
    assert bodies(tmp_path / "site.bag") == expected


async def test_a_burst_of_small_messages_passes_whole(tmp_path: Path) -> None:
    """20,000 messages as fast as they are taken, to two sites: nothing stalls, nothing is lost or repeated."""
    bag = write_bag(tmp_path / "run.bag", {"/a": 10_000, "/b": 10_000})
    async with Lab(tmp_path, "robot1", "site1", "site2") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        sites = [await lab.connected(lab.recorder_file(name, "/.*")) for name in ("site1", "site2")]
        robot = await lab.connected(lab.player_file("robot1", bag))
        await until(lambda: all(delivered(site) == 20_000 for site in sites), "both sites have all")
        for daemon in (robot, *sites):
            await lab.end(daemon)
        await relay.stop()
        topics = relay.summary()
        assert all(balance(counters) == [] for counters in topics["links"].values())
        assert {name: entry["delivered"] for name, entry in topics["links"]["site2"].items()} == {
            "/robot1/a": 10_000,
            "/robot1/b": 10_000,
        }
    for name in ("site1", "site2"):
        assert bodies(tmp_path / f"{name}.bag") == under("robot1", bodies(bag))


@pytest.mark.parametrize("who", ["robot", "relay"])
async def test_sigterm_under_load_drains_and_everything_is_accounted_for(tmp_path: Path, who: str) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 2000, "/fresh": 2000})
    rules = [
        # What waits must be gone within `link.drain_s`, on a slow machine too.
        {"match": "/chat", "class": "state", "reliability": "reliable", "max_queue_bytes": 20_000},
        {"match": "/fresh", "class": "control", "reliability": "best_effort", "depth": 2},
    ]
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*", message_log="site.csv")).ready()
        play: dict[str, Any] = {"loop": True, "wait_for": ["/chat", "/fresh"]}
        robot = lab.process(lab.player_file("robot1", bag, play=play, topics=rules, message_log="robot1.csv"))
        await site.until(lambda: delivered(site) > 1000, "is being sent to")
        first, second = (robot, relay) if who == "robot" else (relay, robot)
        await first.stop()
        if who == "robot":
            chat = robot.summary()["topics"]["/robot1/chat"]
            assert chat["delivered"] == chat["offered"], "a stopping robot leaves nothing behind"
        await second.stop()
        await site.stop()
        for process, key in ((robot, "topics"), (site, "topics")):
            assert balance(process.summary()[key]) == []
        for counters in relay.summary()["links"].values():
            assert balance(counters) == []
        chat = robot.summary()["topics"]["/robot1/chat"]
    played, recorded = bodies(bag)["/chat"], bodies(tmp_path / "site.bag")["/robot1/chat"]
    assert recorded == [played[index % len(played)] for index in range(len(recorded))]
    if who == "robot":
        assert len(recorded) == chat["offered"]
    else:  # what the relay held had been confirmed when it went; nobody has more than was offered
        assert chat["delivered"] <= len(recorded) <= chat["offered"]


async def test_sockets_are_read_in_batches_and_never_by_the_safety_tick_alone(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 3000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        assert relay.transports.server is not None
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag))
        await until(lambda: delivered(site) == 3000)
        # Many small messages share a datagram, and many datagrams a look at the socket.
        assert relay.transports.server.socket.messages < 3000
        for daemon in (robot, site, relay):
            await lab.end(daemon)


async def test_memory_does_not_grow_with_what_passed_through(tmp_path: Path) -> None:
    """What a relay and a site have passed on they forget: the second half of a long run costs no more than noise."""
    bag = write_bag(tmp_path / "run.bag", {"/chat": 2000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*", message_log="site.csv")).ready()
        rule = {"match": "/chat", "class": "state", "reliability": "reliable", "max_queue_bytes": 20_000}
        robot = await lab.process(lab.player_file("robot1", bag, play={"loop": True}, topics=[rule])).ready()
        await site.until(lambda: delivered(site) > 10_000, "has warmed up")
        before = {process.name: rss_bytes(process) for process in (relay, site, robot)}
        for count_of in range(15_000, 40_001, 5000):  # a deadline each: how fast it goes is not what is asked
            await site.until(lambda least=count_of: delivered(site) > least, "has much more")
        grown = {process.name: rss_bytes(process) - before[process.name] for process in (relay, site, robot)}
        assert max(grown.values()) < 16 * 2**20, grown
        for process in (robot, site, relay):
            await process.stop()


async def test_the_relay_tells_systemd_what_it_does(tmp_path: Path) -> None:
    """Ready, reloading and stopping, over a socket as systemd makes it."""
    with notified() as systemd:
        async with Lab(tmp_path, "robot1") as lab:
            config = lab.relay_file()
            relay = systemd.process(lab, config)
            await until(lambda: systemd.says("READY=1"))
            relay.signal(signal.SIGHUP)
            await until(lambda: systemd.says("RELOADING=1") and systemd.says("STATUS=0 clients, 0 streams"))
            config.write_text(json.dumps({"relay": 1}))
            relay.signal(signal.SIGHUP)
            await until(lambda: systemd.says("; reload failed, the old configuration stays: "))
            await relay.stop()
            assert systemd.says("STOPPING=1")


async def test_a_topic_that_goes_both_ways_is_counted_both_ways(tmp_path: Path) -> None:
    """Two robots on one global /tf: each sends its own and records the other's."""
    bag = write_bag(tmp_path / "run.bag", {"/tf": 50})
    everywhere: dict[str, Any] = {"client": {"namespace": "/"}, "subscribe": ["/tf"]}
    async with Lab(tmp_path, "robot1", "robot2") as lab:
        relay = await lab.relay()
        robots = []
        for name in ("robot1", "robot2"):
            play = {"kind": "bag", "path": str(bag), "rate": 0, "wait_for": ["/tf"]}
            rule = {"match": "/tf", "class": "state", "reliability": "reliable"}
            config = lab.client_file(name, [play, {"kind": "record", "path": name}], topics=[rule], **everywhere)
            robots.append(await lab.connected(config))
        await until(lambda: all(delivered(robot) == 50 for robot in robots))
        await until(lambda: all(robot.topics()["/tf"]["delivered"] == 50 for robot in robots))
        for robot in robots:
            topics = robot.topics()
            assert balance(topics) == []
            assert topics["/tf"]["received"]["delivered"] == 50
        for robot in robots:
            await lab.end(robot)
        await lab.end(relay)
    assert bodies(tmp_path / "robot1.bag") == bodies(tmp_path / "robot2.bag") == bodies(bag)
