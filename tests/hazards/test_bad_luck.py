"""What happens to machines: processes that end, stand still or come back all at once, disks that are full or damaged,
clocks that jump."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from sern_runtime.durable.names import DURABLE_FILE
from tests.daemons import Lab, Process, bodies, delivered, metric, write_bag
from tests.hazards.field import field
from tests.hazards.kills import play

DURABLE: Final[list[dict[str, Any]]] = [{"match": "/chat", "class": "state", "durable": True}]
HOUR_S: Final = 3600
UNCONFIRMED: Final = 10
"""Messages that may be under way to a site, or recorded and not confirmed, when it is killed."""


# --- processes ------------------------------------------------------------------------------------------------------


async def test_kill_9_of_the_relay(tmp_path: Path) -> None:
    """The next relay has the same sessions again; nothing of a reliable stream is lost or doubled."""
    async with field(tmp_path) as world:
        world.relay.kill()
        world.relay = await world.lab.process(world.relay.config).ready()
        await world.goes_on()


async def test_kill_9_of_the_site(tmp_path: Path) -> None:
    """Its next process goes on where the last recording ends, or with what had not been confirmed of it."""
    async with field(tmp_path) as world:
        world.site.kill()
        world.site = await world.lab.process(world.lab.recorder_file("site", "/robot1/.*", path="second")).ready()
        world.recordings.append(tmp_path / "second.bag")
        world.again = UNCONFIRMED
        world.sessions["site"] = 2
        await world.goes_on()


async def test_kill_9_of_the_robot(tmp_path: Path) -> None:
    """Its site is told that it is gone, and what its next process sends arrives whole."""
    async with field(tmp_path) as world:
        world.robot.kill()
        await world.site.said("robot1 is gone")
        await world.site.stop()  # what the killed process had sent ends with it: the next one begins anew
        world.site = await world.lab.process(world.lab.recorder_file("site", "/robot1/.*", path="second")).ready()
        world.recordings = [tmp_path / "second.bag"]
        world.robot = await world.lab.process(world.robot.config).ready()
        world.sessions = {"robot1": 2, "site": 2}
        await world.goes_on()


async def test_kill_9_at_random_moments(tmp_path: Path) -> None:
    """Robot and relay are killed again and again, while they start too: what was acknowledged arrives, once and in
    order."""
    kills = await play(tmp_path, seed=1, count=6)
    assert kills.kills >= 6 and sum(kills.acknowledged) > 0


@pytest.mark.parametrize("who", ["relay", "robot", "site"])
async def test_stands_still(tmp_path: Path, who: str) -> None:
    """Who does not run for longer than a heartbeat is said to be gone, and goes on without a gap when it runs again."""
    async with field(tmp_path) as world:
        still: Process = getattr(world, who)
        still.signal(signal.SIGSTOP)
        other = world.site if who != "site" else world.relay
        words = {"relay": "does not answer now", "robot": "robot1 is gone", "site": "site does not answer"}[who]
        await other.said(words)
        still.signal(signal.SIGCONT)
        await world.goes_on()
        world.sessions = {client: world.came(client) for client in world.sessions}  # a session may have ended or not


async def test_many_come_at_once(tmp_path: Path) -> None:
    """A relay is gone while its clients go on. When it is there again all of them are back by themselves, and each
    stream is whole and in order."""
    names = [f"r{number}" for number in range(8)]
    bag = write_bag(tmp_path / "run.bag", {"/count": 400})
    async with Lab(tmp_path, "site", *names) as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        play = {"rate": 0.1}
        robots = [lab.process(lab.player_file(name, bag, play=play)) for name in names]
        await site.until(lambda: all(delivered(site, f"/{name}/count") > 20 for name in names), "hears all")
        relay.kill()
        for robot in robots:
            await robot.said("the connection to the relay was lost")
        relay = await lab.process(relay.config).ready()
        await site.until(lambda: delivered(site) == 400 * len(names), "has everything")
        for process in (*robots, site, relay):
            await process.stop()
    got = bodies(tmp_path / "site.bag")
    assert got == {f"/{name}/count": bodies(bag)["/count"] for name in names}


# --- disks ----------------------------------------------------------------------------------------------------------


@contextmanager
def small_disk(path: Path, size: str) -> Iterator[Path]:
    """A file system of its own; skips the test where none may be mounted."""
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)]
    if os.geteuid() != 0 or subprocess.run(command, check=False).returncode:
        pytest.skip("mounting a small file system needs root")
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", path], check=True)


async def test_disk_full(tmp_path: Path) -> None:
    """A full disk ends acknowledgements, and is said; what is live goes on; and with room there is an end to it."""
    bag = write_bag(tmp_path / "chat.bag", {"/chat": 2000, "/live": 2000})
    rules = [*DURABLE, {"match": "/live", "class": "state", "reliability": "reliable"}]
    with small_disk(tmp_path / "disk", "2m") as disk:
        async with Lab(tmp_path, "robot1", "site", "site2") as lab:
            relay = await lab.process(lab.relay_file()).ready()
            site = await lab.process(lab.recorder_file("site", "/robot1/live")).ready()
            other = await lab.process(lab.recorder_file("site2", "/robot1/chat", path="first")).ready()
            durable = {"directory": str(disk)}
            play = {"rate": 0.1, "loop": True}
            robot = lab.process(lab.player_file("robot1", bag, play=play, topics=rules, durable=durable))
            await other.until(lambda: delivered(other) > 50, "gets what is durable")
            await other.stop()  # what it is to get is kept for it
            with (disk / "filler").open("wb") as filler:
                while (room := shutil.disk_usage(disk).free) > 0:
                    filler.write(bytes(room))
                    filler.flush()
            await robot.until(lambda: metric(robot, "sern_durable_problem") == 1, "says that nothing is kept")
            await robot.said("full")
            stored, live = metric(robot, "sern_durable_stored_total"), delivered(site)
            await site.until(lambda: delivered(site) > live + 50, "goes on receiving what is live")
            assert metric(robot, "sern_durable_stored_total") == stored
            (disk / "filler").unlink()
            await robot.until(lambda: metric(robot, "sern_durable_problem") == 0, "stores again")
            await robot.until(lambda: metric(robot, "sern_durable_stored_total") > stored + 50, "acknowledges again")
            other = await lab.process(lab.recorder_file("site2", "/robot1/chat", path="second")).ready()
            await other.until(lambda: delivered(other) > stored, "gets what was stored, and goes on")
            for process in (robot, other, site, relay):
                await process.stop()
    sent = bodies(bag)["/chat"]
    got = [body for name in ("first", "second") for body in bodies(tmp_path / f"{name}.bag")["/robot1/chat"]]
    assert got == [sent[index % len(sent)] for index in range(len(got))]


@pytest.mark.parametrize("damage", ["torn tail", "flipped bits"])
async def test_damaged_store(tmp_path: Path, damage: str) -> None:
    """What can be read of a damaged file is sent, in order; the file is put aside, and what is lost is said."""
    bag, other = write_bag(tmp_path / "run.bag", {"/chat": 1000}), write_bag(tmp_path / "other.bag", {"/other": 1})
    durable = {"directory": "kept"}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 0.1}, topics=DURABLE, durable=durable))
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 50, "stores")
        relay.kill()
        await robot.until(lambda: metric(robot, "sern_durable_stored_total") > 400, "stores more, with no relay")
        robot.kill()
        file = tmp_path / "kept" / DURABLE_FILE
        content = bytearray(file.read_bytes())
        if damage == "torn tail":
            content = content[: len(content) * 3 // 4]
        else:
            for at in range(len(content) // 2, len(content), 9000):
                content[at] ^= 0x40
        file.write_bytes(content)
        relay = await lab.process(relay.config).ready()
        robot = lab.process(lab.player_file("robot1", other, play={"rate": 1}, topics=DURABLE, durable=durable))
        await robot.said("durable topics:", f"{DURABLE_FILE}.damaged-1")
        await robot.until(lambda: metric(robot, "sern_durable_damaged_total") > 0, "counts it")
        await robot.until(lambda: metric(robot, "sern_durable_kept_bytes") == 0, "has delivered what is left")
        for process in (robot, site, relay):
            await process.stop()
    assert (tmp_path / "kept" / f"{DURABLE_FILE}.damaged-1").exists()
    sent, got = bodies(bag)["/chat"], bodies(tmp_path / "site.bag")["/robot1/chat"]
    numbers = [sent.index(body) for body in got]
    assert numbers == sorted(set(numbers)) and len(numbers) > 50


# --- clocks ---------------------------------------------------------------------------------------------------------


class WallClock:
    """The wall clock of processes that are started with `before`."""

    def __init__(self, directory: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("needs a C compiler: install gcc")
        library = directory / "wall_clock.so"
        source = Path(__file__).with_name("wall_clock.c")
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
        self._file = directory / "wall_clock"
        self.step(0)
        self.before = ("env", f"LD_PRELOAD={library}", f"WALL_CLOCK_FILE={self._file}")

    def step(self, offset_s: int) -> None:
        """Have it jump to so far off."""
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(offset_s.to_bytes(8, sys.byteorder, signed=True))


@pytest.mark.parametrize("who", ["relay", "robot1", "site"])
async def test_clock_steps(tmp_path: Path, who: str) -> None:
    """A wall clock that jumps by an hour, forth and back, ends no session, loses no message, and stops no driving."""
    clock = WallClock(tmp_path)
    bag = write_bag(tmp_path / "loop.bag", {"/count": 500})
    rules = [
        {"match": "/count", "class": "state", "reliability": "reliable"},
        {"match": "/live", "class": "control", "lifespan_s": 0.3},
    ]
    live = write_bag(tmp_path / "live.bag", {"/live": 500})

    async with Lab(tmp_path, "robot1", "robot2", "site") as lab:

        async def start(config: Path) -> Process:
            return await lab.process(config, before=clock.before if config.stem == who else ()).ready()

        relay = await start(lab.relay_file())
        site = await start(lab.recorder_file("site", "/.*"))
        play = {"rate": 0.2, "loop": True}
        robot = await start(lab.player_file("robot1", bag, play=play, topics=rules))
        robot2 = await start(lab.player_file("robot2", live, play=play, topics=rules))
        for offset_s in (HOUR_S, -HOUR_S, 0):
            clock.step(offset_s)
            for topic in ("/robot1/count", "/robot2/live"):
                count = delivered(site, topic)
                await site.until(lambda t=topic, n=count: delivered(site, t) > n + 100, f"goes on receiving {topic}")
        rows = {row["name"]: row["sessions"] for row in relay.json("/api/clients")["clients"]}
        assert rows == {"robot1": 1, "robot2": 1, "site": 1}
        for process in (robot2, robot, site, relay):
            await process.stop()
    sent, got = bodies(bag)["/count"], bodies(tmp_path / "site.bag")["/robot1/count"]
    whole = [sent[index % len(sent)] for index in range(len(got))]
    # A recording is read in the order of its stamps, which are of the robot's clock.
    assert (sorted(got) == sorted(whole)) if who == "robot1" else (got == whole)
