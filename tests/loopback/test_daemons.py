"""Recordings through a relay and its clients as their user runs them: byte for byte, in order, and everything counted."""

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from sern_client.endpoints.record import RecordEndpoint
from tests.daemons import START_NS, Lab, Process, balance, bodies, endpoint_of, recording, under, write_bag
from tests.support import until


def written(site: Process, name: str, count: int) -> bool:
    """Whether a site has been delivered `count` messages."""
    topics = site.json("/api/topics")
    return count <= sum(int(topic["delivered"]) for topic in topics.values() if topic["direction"] == "receive")


async def carried(lab: Lab, players: dict[str, Path], site: Process) -> None:
    """Play bags, each from a robot of its name, until the site has everything; then stop everybody in order."""
    count = sum(len(texts) for bag in players.values() for texts in bodies(bag).values())
    robots = [lab.process(lab.player_file(name, bag)) for name, bag in players.items()]
    await site.until(lambda: written(site, site.name, count), f"has {count} messages")
    for robot in robots:
        await robot.stop()
        summary = robot.summary()["topics"]
        assert balance(summary) == []
        assert sum(topic["delivered"] for topic in summary.values()) == sum(map(len, bodies(players[robot.name]).values()))
    await site.stop()


@pytest.mark.parametrize(
    "bag_of", [{"husky": "husky_gps_imu_odom.bag"}, {"jackal": "jackal_imu_odom.bag"},
               {"husky": "husky_gps_imu_odom.bag", "jackal": "jackal_imu_odom.bag"}, {}],
    ids=["husky", "jackal", "both", "generated"],
)  # fmt: skip
async def test_recordings_arrive_byte_for_byte_and_in_order(tmp_path: Path, bag_of: dict[str, str]) -> None:
    bags = {name: recording(file) for name, file in bag_of.items()}
    bags = bags or {"robot1": write_bag(tmp_path / "run.bag", {"/chat": 500, "/log": 300, "/map": 1}, latched=["/map"])}
    async with Lab(tmp_path, *bags, "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        await carried(lab, bags, site)
        await relay.stop()
        expected = {topic: texts for name, bag in bags.items() for topic, texts in under(name, bodies(bag)).items()}
        assert bodies(tmp_path / "site.bag") == expected
        for counters in relay.summary()["links"].values():
            assert balance(counters) == []
