"""A client with a key that is hostile or broken harms nobody but itself."""

import signal
from pathlib import Path

import pytest

from sern_core.wire import framing
from sern_runtime.config.keys import load_secret
from tests.daemons import delivered, metric, rss_bytes, write_bag
from tests.hazards.field import Field, field
from tests.strangers import BAD, Stranger, hello, oversize
from tests.support import until

MB = 2**20


def insider(world: Field, *, identity: bytes = b"") -> Stranger:
    """A program of its own with the key of robot2."""
    return Stranger(world.lab, load_secret(world.lab.directory / "robot2.key"), identity=identity)


async def test_spoofed_name(tmp_path: Path) -> None:
    """Who calls himself robot1 with the key of robot2 is told whose key it is, and is nobody."""
    async with field(tmp_path) as world, insider(world) as impostor:
        await impostor.send(hello("robot1"))
        await until(lambda: impostor.received, "it is answered")
        answer = framing.decode_handshake(impostor.received[0])
        assert answer == {"code": "name", "why": "your key belongs to robot2, not to robot1"}
        assert world.came("robot2") == 0


async def test_spoofed_routing_id(tmp_path: Path) -> None:
    """Who names its connection as it likes is cut before it is heard."""
    async with field(tmp_path) as world, insider(world, identity=b"robot1") as impostor:
        await impostor.send(hello("robot2"))
        await impostor.cut()
        assert impostor.received == []
        await world.refused("routing_id")


@pytest.mark.parametrize("kind", BAD)
async def test_bad_frame(tmp_path: Path, kind: str) -> None:
    """Its connection ends, and is counted; nothing of what was announced is made."""
    async with field(tmp_path) as world:
        before = rss_bytes(world.relay)
        async with insider(world) as broken:
            for datagram in BAD[kind]():
                await broken.send(datagram)
            await broken.cut()
        assert metric(world.relay, "sern_bad_frames_total") == 1
        assert rss_bytes(world.relay) - before < 20 * MB
        await world.relay.said("WARNING", "robot2", "bad frame")


async def test_large_and_many_frames(tmp_path: Path) -> None:
    """A frame above the limit, and a message of many frames, end their connection unread."""
    async with field(tmp_path) as world:
        async with insider(world) as broken:
            await broken.send(*oversize())
            await broken.cut()
        async with insider(world) as broken:
            await broken.send(*[hello("robot2")] * 20)
            await world.refused("multipart")
            await broken.cut()
            assert broken.received == []


async def test_what_is_forbidden(tmp_path: Path) -> None:
    """What a client may not publish or have is refused to it by name, at once and for what is latched."""
    access = [
        {"client": "robot1", "publish": ["/{self}/.*"]},
        {"client": "site", "subscribe": ["/robot1/.*"]},
        {"client": "robot2", "publish": ["/{self}/mine"], "subscribe": []},
    ]
    bag = write_bag(tmp_path / "other.bag", {"/mine": 5, "/secret": 5}, latched=["/secret"])
    async with field(tmp_path, relay={"access": access}) as world:
        robot2 = world.lab.process(
            world.lab.player_file("robot2", bag, play={"wait_for": []}, subscribe=["/robot1/.*"])
        )
        await robot2.said("the relay refuses /robot2/secret (forbidden): robot2 may not publish")
        refusals = "sern_relay_refusals_total"
        await world.relay.until(lambda: metric(world.relay, refusals, code="forbidden") == 1, "refuses it")
        site2 = await world.lab.process(world.lab.recorder_file("site2", "/.*")).ready()
        await robot2.ready()
        await world.goes_on()
        assert delivered(robot2) == 0 and delivered(site2) == 0
        await robot2.stop()
        await site2.stop()


async def test_slow_subscriber(tmp_path: Path) -> None:
    """A site that stands still loses what is its own, by class: the newest of its state is kept, and the other site,
    which has all of the same topics, misses nothing."""
    rules = [
        {"match": "/count", "class": "state", "reliability": "reliable"},
        {"match": "/bulk", "class": "bulk", "reliability": "best_effort", "depth": 5},
    ]
    bag = write_bag(tmp_path / "other.bag", {"/bulk": 500})
    async with field(tmp_path) as world:
        slow = world.lab.process(world.lab.recorder_file("site2", "/robot[12]/.*"))
        await slow.said("connected to relay")
        play = {"rate": 1, "loop": True}
        robot2 = world.lab.process(world.lab.player_file("robot2", bag, play=play, topics=rules))
        await slow.until(lambda: delivered(slow, "/robot2/bulk") > 100, "has some bulk")
        slow.signal(signal.SIGSTOP)

        def shed() -> int:
            links = world.relay.json("/api/topics")["links"]
            return sum(links["site2"].get("/robot2/bulk", {}).get("dropped", {}).values())

        await world.relay.until(lambda: shed() > 1000, "drops bulk of the slow one")
        await world.goes_on()
        links = world.relay.json("/api/topics")["links"]
        assert sum(sum(row["dropped"].values()) for row in links["site"].values()) == 0
        assert sum(links["site2"].get("/robot1/count", {}).get("dropped", {}).values()) == 0, "reliable waits"
        slow.signal(signal.SIGCONT)
        await slow.until(lambda: delivered(slow) > 0, "is there again")
        await robot2.stop()
        await slow.stop()


async def test_bulk_flood(tmp_path: Path) -> None:
    """A robot that sends 13 times what it may has the rest dropped, counted for it, and every command of another robot
    passes."""
    access = [
        {"client": "robot2", "publish": [".*"], "max_bytes_per_s": 100_000.0},
        {"client": ".*", "publish": [".*"], "subscribe": [".*"]},
    ]
    flood = {"kind": "synthetic", "role": "robot", "topics": ["/points"], "cloud_bytes": 130_000, "cloud_rate_hz": 10}
    async with field(tmp_path, relay={"access": access}) as world:
        robot2 = world.lab.process(world.lab.client_file("robot2", flood))
        site2 = await world.lab.process(world.lab.recorder_file("site2", "/robot2/.*")).ready()
        await site2.until(lambda: delivered(site2) > 3, "gets what the robot may send")

        def dropped() -> int:
            return sum(world.relay.json("/api/topics")["received"]["/robot2/points"]["dropped"].values())

        count = delivered(world.site)
        await world.relay.until(lambda: dropped() > 50, "drops the rest")
        assert delivered(world.site) > count
        links = world.relay.json("/api/topics")["links"]
        assert sum(sum(row["dropped"].values()) for row in links["site"].values()) == 0
        await robot2.stop()
        await site2.stop()
