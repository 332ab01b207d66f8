"""Store and forward, from a robot's endpoint to one recording at a site: real daemons with keys, some killed."""

import json
from pathlib import Path
from random import Random

from sern_client.endpoints.bag_files import BagFile
from sern_client.endpoints.leftovers import finish
from sern_client.spool.orders import Order, place
from sern_core.site.spool import Window
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.ros_types import topic_info
from sern_tools.spool_merge import Selection, merge
from tests.daemons import Json, Lab, Process, bodies, metric
from tests.loopback.test_durable import write_bag

COUNT = 3000
TOPIC = "/robot1/chat"
THINNED = [{"match": "/chat", "class": "state", "reliability": "best_effort", "max_rate_hz": 20}]
KEPT = {"directory": "kept", "topics": ["/chat"]}
FETCHED = {"directory": "filled", "fetch": ["/robot1/.*"]}
PLAY = {"rate": 1}


def heavy_bag(path: Path) -> Path:
    """Texts that nothing makes smaller, so that it takes a while to fetch them; together less than the buffer of what
    keeps them, however slow the disk is."""
    file, random = BagFile(path), Random(1)
    info = topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1)
    file.add(info)
    for number in range(COUNT):
        text = random.randbytes(4_000)
        file.write(info, 10**18 + number * 10**6, len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


def row(site: Process) -> Json:
    """What a site says of the topic; empty: nothing yet."""
    status, text = site.get("/api/spool")
    rows = json.loads(text)["fetch"] if status == 200 else []
    return next((row for row in rows if row["topic"] == TOPIC), {})


def kept(robot: Process) -> int:
    """Messages that a robot has kept safely."""
    status, text = robot.get("/api/spool")
    return sum(each["messages"] for each in json.loads(text)["kept"]) if status == 200 else 0


def whole(site: Process) -> bool:
    """Whether the site has all that the robot kept."""
    there = row(site)
    return bool(there) and there["kept_messages"] == COUNT and not there["missing_messages"]


def merged(directory: Path, *inputs: str) -> list[bytes]:
    """The bodies of one recording of several; what a killed process left is finished before."""
    for left in directory.glob("*.bag.active"):
        finish(left)
    out = directory / "whole.bag"
    done = merge([directory / name for name in inputs], out, Selection())
    found = bodies(out)
    assert list(found) == [TOPIC] and done.messages == len(found[TOPIC])
    return found[TOPIC]


async def test_a_site_ends_with_one_recording_of_all_that_its_robot_thinned(tmp_path: Path) -> None:
    """Fifty times thinned live. What was missing is fetched by itself, what arrived live is not, and the site's
    recording and what was fetched make one with every message once, by stamp."""
    bag = write_bag(tmp_path / "run.bag", "/chat", COUNT)
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay = lab.process(lab.relay_file())
        site = lab.process(lab.recorder_file("site1", TOPIC, spool=FETCHED))
        await site.said("connected to relay")
        robot = lab.process(lab.player_file("robot1", bag, play=PLAY, topics=THINNED, spool=KEPT))
        await site.until(lambda: whole(site), "has all of it")
        live = len(bodies(bag)["/chat"]) - row(site)["fetched_messages"]
        assert metric(robot, "sern_spool_sent_total") == row(site)["fetched_messages"] < COUNT
        assert 0 < live < COUNT // 10
        for name in ("sern_spool_unasked_total", "sern_spool_missing_messages", "sern_spool_problem"):
            assert metric(site, name) == 0
        await robot.stop()
        await site.stop()
        await relay.stop()
    assert len(bodies(tmp_path / "site1.bag")[TOPIC]) == live
    assert merged(tmp_path, "site1.bag", "filled") == bodies(bag)["/chat"]


async def test_robot_site_and_relay_are_killed_in_the_middle_and_nothing_is_missing_or_there_twice(
    tmp_path: Path,
) -> None:
    bag, other = heavy_bag(tmp_path / "run.bag"), write_bag(tmp_path / "other.bag", "/other", 1)
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay = lab.process(lab.relay_file())
        site_file = lab.recorder_file("site1", TOPIC, spool=FETCHED)
        robot = lab.process(
            lab.player_file("robot1", bag, play={"rate": 0, "wait_for": []}, topics=THINNED, spool=KEPT)
        )
        await robot.until(lambda: kept(robot) == COUNT, "keeps all")
        robot.kill()  # its file is not finished
        robot_file = lab.player_file("robot1", other, play=PLAY, topics=THINNED, spool=KEPT)
        robot = lab.process(robot_file)
        site = lab.process(site_file)
        await site.until(lambda: row(site).get("fetched_messages", 0) > 100, "has fetched some")
        site.kill()
        robot.kill()
        robot, site = (
            lab.process(robot_file),
            lab.process(lab.recorder_file("site1", TOPIC, path="later", spool=FETCHED)),
        )
        await site.until(lambda: row(site).get("fetched_messages", 0) > 10, "goes on")
        relay.kill()
        relay = lab.process(tmp_path / "relay.yaml")
        await site.until(lambda: whole(site), "has all of it")
        await robot.stop()
        await site.stop()
        await relay.stop()
    assert merged(tmp_path, "filled") == bodies(bag)["/chat"]


async def test_only_what_somebody_asks_for_is_fetched_and_only_by_whom_the_rules_let(tmp_path: Path) -> None:
    """site1 asks for a second of it while the robot is away; site2 may not have the topic, and hears of nothing."""
    bag, other = write_bag(tmp_path / "run.bag", "/chat", COUNT), write_bag(tmp_path / "other.bag", "/other", 1)
    everything = [".*"]
    access = [
        {"client": "robot1", "publish": everything},
        {"client": "site1", "subscribe": [TOPIC]},
        {"client": "site2", "subscribe": ["/robot1/odom"]},
    ]
    by_hand = FETCHED | {"automatic": False}
    async with Lab(tmp_path, "robot1", "site1", "site2") as lab:
        relay = lab.process(lab.relay_file(access=access))
        site = lab.process(lab.recorder_file("site1", "/robot1/other", spool=by_hand))
        beside = lab.process(lab.recorder_file("site2", "/robot1/odom", spool=FETCHED | {"directory": "beside"}))
        robot = lab.process(lab.player_file("robot1", bag, play=PLAY, topics=THINNED, spool=KEPT))
        await site.until(lambda: row(site).get("kept_messages") == COUNT, "knows what there is")
        there = row(site)
        await robot.stop()
        await site.until(lambda: row(site)["there"] is False, "knows that the robot is away")
        span = Window(there["first_ns"] + 10**9, there["first_ns"] + 2 * 10**9)
        order = place(Path(site.json("/api/spool")["directory"]), Order(TopicName(TOPIC), span))
        await site.until(lambda: bool(site.json("/api/spool")["orders"]), "has the order")
        robot = lab.process(lab.player_file("robot1", other, play=PLAY, topics=THINNED, spool=KEPT))
        await site.until(lambda: not order.exists(), "has done it")
        fetched = row(site)["fetched_messages"]
        assert row(site)["missing_messages"] == COUNT - fetched
        assert site.json("/api/link")[0]["spool"]["missing"] == {TOPIC: COUNT - fetched}  # and so `sern top` says
        assert beside.json("/api/spool")["fetch"] == []
        await robot.stop()
        await beside.stop()
        await site.stop()
        await relay.stop()
    got = merged(tmp_path, "filled")
    assert len(got) == fetched and 900 <= fetched <= 1100
    sent = bodies(bag)["/chat"]
    begin = sent.index(got[0])
    assert got == sent[begin : begin + fetched]
