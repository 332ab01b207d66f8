"""Restarts of everybody at any time: who is left connects again, and reliable streams go on where they were."""

import shutil
import signal
from pathlib import Path

import pytest

from sern_core.path.lanes import LANE_UDP
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime.config.keys import PublicKey, PublicKeys, load_public, write_public
from tests.daemons import Lab, Process, bodies, delivered, under, write_bag
from tests.support import until

CHAT = TopicName("/robot1/chat")
STEADY = {"rate": 1}  # a message of each topic every millisecond


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "kill -9"])
async def test_a_reliable_stream_goes_on_over_a_restart_of_the_relay(
    tmp_path: Path, number: signal.Signals, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    bag = write_bag(tmp_path / "run.bag", {"/chat": 2000, "/log": 2000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, play=STEADY))
        for _restart in (1, 2):
            least = min(delivered(site, CHAT) + 200, 1999)
            await until(lambda least=least: delivered(site, CHAT) > least)  # type: ignore[misc]
            relay.signal(number)
            assert await relay.ended() == (0 if number is signal.SIGTERM else -number)
            relay = await lab.process(relay.config).ready()
        await until(lambda: delivered(site, CHAT) == 2000 and delivered(site, "/robot1/log") == 2000)
        assert caplog.text.count("dropped") == 0
        await lab.end(robot)
        await lab.end(site)
        await relay.stop()
    assert bodies(tmp_path / "site.bag") == under("robot1", bodies(bag))


async def test_a_new_server_key_is_taken_up_without_loss(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 2000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        old = load_public(tmp_path / "relay.pub").keys[0].key
        config = lab.relay_file()
        relay = await lab.process(config).ready()
        old_secret = shutil.copy(tmp_path / "relay.key", tmp_path / "old.key")
        new = lab.make_relay_keys()  # announced to the clients before the relay uses it
        shutil.copy(tmp_path / "relay.key", tmp_path / "new.key")
        shutil.move(old_secret, tmp_path / "relay.key")
        keys = (PublicKey(old), PublicKey(new.public_key))
        write_public(tmp_path / "relay.pub", PublicKeys(ClientName("relay"), keys), replace=True)
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, play=STEADY))
        await until(lambda: delivered(site, CHAT) > 200)
        shutil.move(tmp_path / "new.key", tmp_path / "relay.key")
        await relay.stop()
        relay = await lab.process(config).ready()
        await until(lambda: delivered(site, CHAT) == 2000, "everything arrives over the relay with its new key")
        await lab.end(robot)
        await lab.end(site)
        await relay.stop()
    assert bodies(tmp_path / "site.bag") == under("robot1", bodies(bag))


async def test_a_site_that_restarts_misses_nothing_and_gets_nothing_twice(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 2500})
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        robot = await lab.client(lab.player_file("robot1", bag, play=STEADY))
        arrived: list[bytes] = []
        for path in ("first", "second", "third"):
            site = await lab.process(lab.recorder_file("site", "/.*", path=path)).ready()
            wanted = min(len(arrived) + 400, 2500) if path != "third" else 2500
            more = wanted - len(arrived)
            await site.until(lambda site=site, more=more: delivered(site, CHAT) >= more, "has more")
            await site.stop()
            recording = tmp_path / f"{path}.bag"
            if recording.exists():  # on a slow machine the earlier ones may have had everything
                arrived += bodies(recording).get("/robot1/chat", [])
        await lab.end(robot)
    assert arrived == bodies(bag)["/chat"]


def confirmed(robot: Process) -> int:
    topics = robot.json("/api/topics")
    return int(topics["/robot1/chat"]["delivered"])


async def test_a_robot_that_is_killed_begins_a_new_stream(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 1000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        robot = lab.process(lab.player_file("robot1", bag, play=STEADY))
        await until(lambda: delivered(site, CHAT) > 200)
        robot.kill()
        await until(lambda: not relay.hub.links[ClientName("robot1")].snapshot()["up"], "the relay notices")
        robot = await lab.process(robot.config).ready()
        await robot.until(lambda: confirmed(robot) == 1000, "has the whole recording delivered")
        await robot.stop()
        await lab.end(site)
        await lab.end(relay)
    played, arrived = bodies(bag)["/chat"], bodies(tmp_path / "site.bag")["/robot1/chat"]
    before = len(arrived) - len(played)
    assert before > 200
    assert arrived == played[:before] + played


@pytest.mark.parametrize("robot_leaves", [False, True], ids=["robot there", "robot away"])
async def test_late_joiners_get_what_is_latched(tmp_path: Path, robot_leaves: bool) -> None:
    sizes = {"/map": 3, "/tf_static": 1, "/chat": 5}
    bag = write_bag(tmp_path / "run.bag", sizes, latched=["/map", "/tf_static"])
    rules = [{"match": "/map|/tf_static", "class": "state", "durability": "transient_local", "depth": 1}]
    async with Lab(tmp_path, "robot1", "early", "late", "later") as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.player_file("robot1", bag, play={"wait_for": []}, topics=rules))
        early = relay.hub.received.topics
        await until(lambda: all(TopicName(n) in early and early[TopicName(n)].delivered for n in
                                ("/robot1/map", "/robot1/tf_static")))  # fmt: skip
        await until(lambda: early[TopicName("/robot1/map")].delivered == 3)
        if robot_leaves:
            await lab.end(robot)
        expected = {"/robot1/map": bodies(bag)["/map"][-1:], "/robot1/tf_static": bodies(bag)["/tf_static"]}
        for name in ("late", "later"):
            site = await lab.connected(lab.recorder_file(name, "/.*"))
            await until(lambda site=site: set(expected) <= set(site.core.received.topics))  # type: ignore[misc]
            await lab.end(site)
            found = bodies(tmp_path / f"{name}.bag")
            found.pop("/robot1/chat", None)
            assert found == expected
        if not robot_leaves:
            await lab.end(robot)
        await lab.end(relay)


async def test_a_killed_client_is_away_on_both_lanes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Its connection ends at once, its datagrams cease: the relay says so after the heartbeat's time, not a minute."""
    caplog.set_level("INFO")
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(link={"heartbeat_timeout_s": 2.0}))
        robot = lab.process(lab.client_file("robot1", {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}))
        name = ClientName("robot1")
        await until(lambda: name in relay.hub.links and relay.hub.links[name].lane.id == LANE_UDP)
        robot.kill()
        await until(lambda: not relay.hub.links[name].established)
        words = "robot1 is away: its connection is gone and no datagram came for"
        assert any(words in message for message in caplog.messages)
        await lab.end(relay)
