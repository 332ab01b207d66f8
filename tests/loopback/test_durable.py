"""Durable topics at their origin: real daemons, killed without a word."""

from pathlib import Path

from sern_client.endpoints.bag_files import BagFile
from sern_core.vocabulary.types import Encoding
from sern_runtime.ros_types import topic_info
from tests.daemons import Lab, bodies, metric

COUNT = 3000
TOPIC = "/robot1/chat"
RULES = [{"match": "/chat", "class": "state", "durable": True}]


def write_bag(path: Path, name: str, count: int) -> Path:
    """Numbered texts on one topic, one a millisecond."""
    file = BagFile(path)
    info = topic_info(name, "std_msgs/msg/String", Encoding.ROS1)
    file.add(info)
    for number in range(count):
        text = f"message {number:05}".encode()
        file.write(info, 10**18 + number * 10**6, len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


async def test_what_a_killed_robot_has_stored_arrives_once_and_in_order(tmp_path: Path) -> None:
    """The relay is gone, then the robot is killed. Its next process, which has no such publisher any more, and another
    relay bring what was on disk to the site that never left: all of it, once, in order."""
    bag, other = write_bag(tmp_path / "run.bag", "/chat", COUNT), write_bag(tmp_path / "other.bag", "/other", 1)
    sent = bodies(bag)["/chat"]
    durable = {"directory": "kept"}
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay = lab.process(lab.relay_file())
        site = lab.process(lab.recorder_file("site1", "/.*"))
        await site.said("connected to relay")
        play = {"rate": 0.1}
        robot = lab.process(lab.player_file("robot1", bag, play=play, topics=RULES, durable=durable))
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 50, "has stored some")
        relay.kill()
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 250, "has stored more, with no relay")
        stored = metric(robot, "sern_durable_stored_total")
        robot.kill()
        relay = lab.process(tmp_path / "relay.yaml")
        again = lab.process(lab.player_file("robot1", other, play={"rate": 1}, topics=RULES, durable=durable))
        await again.said("messages of an earlier run are sent now")
        await again.until(lambda: metric(again, "sern_durable_kept_bytes") == 0, "has had all of it delivered")
        await again.stop()
        await site.stop()
        await relay.stop()
    got = bodies(tmp_path / "site1.bag")[TOPIC]
    assert got == sent[: len(got)] and len(got) >= stored


async def test_what_a_killed_relay_has_stored_reaches_a_site_that_was_away(tmp_path: Path) -> None:
    """The relay holds for a site that is away what its robot need not keep any more. Then robot and relay are killed:
    the next relay delivers it, once and in order, though the robot never comes back."""
    bag = write_bag(tmp_path / "run.bag", "/chat", COUNT)
    sent = bodies(bag)["/chat"]
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay_file = lab.relay_file(durable={"directory": "held"})
        relay = lab.process(relay_file)
        site = lab.process(lab.recorder_file("site1", "/.*"))
        await site.said("connected to relay")
        play = {"rate": 0.1}
        config = lab.player_file("robot1", bag, play=play, topics=RULES, durable={"directory": "kept"})
        robot = lab.process(config)
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 50, "has stored some")
        await site.stop()
        first = bodies(tmp_path / "site1.bag")[TOPIC]
        await relay.until(lambda: metric(relay, "sern_durable_stored_total") > len(first) + 100, "has stored some more")
        robot.kill()
        stored = metric(relay, "sern_durable_stored_total")
        relay.kill()
        relay = lab.process(relay_file)
        await relay.said("messages of durable topics of an earlier run wait for their clients")
        site = lab.process(lab.recorder_file("site1", "/.*", path="later"))
        await relay.until(lambda: metric(relay, "sern_durable_kept_bytes") == 0, "has delivered all of it")
        await site.stop()
        await relay.stop()
    got = [*first, *bodies(tmp_path / "later.bag")[TOPIC]]
    assert got == sent[: len(got)] and len(got) >= stored


async def test_robot_and_relay_go_on_together_after_both_were_killed(tmp_path: Path) -> None:
    """What the relay has, the robot's next process need not send; what it lacks comes from the robot."""
    bag, other = write_bag(tmp_path / "run.bag", "/chat", COUNT), write_bag(tmp_path / "other.bag", "/other", 1)
    sent = bodies(bag)["/chat"]
    async with Lab(tmp_path, "robot1", "site1") as lab:
        relay_file = lab.relay_file(durable={"directory": "held"})
        relay = lab.process(relay_file)
        site = lab.process(lab.recorder_file("site1", "/.*"))
        await site.said("connected to relay")
        durable = {"directory": "kept"}
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 0.1}, topics=RULES, durable=durable))
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 50, "has stored some")
        await site.stop()
        first = bodies(tmp_path / "site1.bag")[TOPIC]
        await relay.until(lambda: metric(relay, "sern_durable_stored_total") > len(first) + 100, "has stored some more")
        relay.kill()
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > len(first) + 250, "goes on")
        stored = metric(robot, "sern_durable_stored_total")
        robot.kill()
        relay = lab.process(relay_file)
        await relay.said("messages of durable topics of an earlier run wait for their clients")
        robot = lab.process(lab.player_file("robot1", other, play={"rate": 1}, topics=RULES, durable=durable))
        await robot.said("messages of an earlier run are sent now")
        await robot.until(lambda: metric(robot, "sern_durable_kept_bytes") == 0, "has had all of it stored")
        site = lab.process(lab.recorder_file("site1", "/.*", path="later"))
        await relay.until(lambda: metric(relay, "sern_durable_kept_bytes") == 0, "has delivered all of it")
        await site.stop()
        await robot.stop()
        await relay.stop()
    got = [*first, *bodies(tmp_path / "later.bag")[TOPIC]]
    assert got == sent[: len(got)] and len(got) >= stored
