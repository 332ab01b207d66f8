"""`python -m tests.hazards.kills`: robot and relay are killed (SIGKILL) at random moments, again and again.

A robot publishes numbered messages on a durable topic; robot and relay keep them on disk. In each round the robot, the
relay or both are killed, at any moment from their start on, and started again. What was acknowledged before a kill must
be in the site's recording at the end, once, and in order.
"""

import argparse
import asyncio
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any, Final

from tests.daemons import Lab, Process, bodies, metric
from tests.hazards.field import write_numbers

RULES: Final[list[dict[str, Any]]] = [{"match": "/chat", "class": "state", "durable": True}]
MESSAGES: Final = 400
"""Messages of each run of the robot: more than it gets to in its life."""
LONGEST_S: Final = 1.0
WHEN_IT_STORES: Final = 0.7
"""This share of the kills comes after the robot has begun to store; the others come at any moment from its start on."""
TOPIC: Final = "/robot1/chat"
QUIET: Final = "/other"


class Kills:
    """`acknowledged[n]`: so many messages of the robot's n-th run were acknowledged before it was killed."""

    def __init__(self, lab: Lab, random: Random) -> None:
        self.acknowledged: list[int] = []
        self.kills = 0
        self._lab = lab
        self._random = random
        self._relay_file = lab.relay_file(durable={"directory": "held"})
        self._relay = lab.process(self._relay_file)

    async def rounds(self, count: int, *, said: bool = False) -> None:
        """Kill so many times."""
        robot: Process | None = None
        while self.kills < count:
            if robot is None:
                robot = self._start(len(self.acknowledged))
                self.acknowledged.append(0)
            if self._random.random() < WHEN_IT_STORES:
                await robot.until(lambda p=robot: metric(p, "sern_durable_stored_total") > 0, "stores")
            await asyncio.sleep(self._random.uniform(0.0, LONGEST_S))
            who = self._random.choice(("robot", "robot", "relay", "both"))
            if who != "relay":
                self._count(robot)
                robot.kill()
                robot = None
            if who != "robot":
                self._relay.kill()
                self._relay = self._lab.process(self._relay_file)
            self.kills += 2 if who == "both" else 1
            if said:
                acknowledged = sum(self.acknowledged)
                print(f"\r{self.kills} of {count} kills, {acknowledged} acknowledged", end="", flush=True)
        if robot is not None:
            self._count(robot)
            robot.kill()

    def _count(self, robot: Process) -> None:
        """What is counted was on disk, and said to be: whatever comes between here and the kill is more."""
        self.acknowledged[-1] = max(self.acknowledged[-1], metric(robot, "sern_durable_stored_total"))

    def _start(self, number: int) -> Process:
        bag = write_numbers(self._lab.directory / "run.bag", "/chat", MESSAGES, run=number)
        play = {"rate": 1, "wait_for": []}
        durable = {"directory": "kept"}
        return self._lab.process(self._lab.player_file("robot1", bag, play=play, topics=RULES, durable=durable))

    async def finish(self) -> None:
        """One more run of the robot, that has nothing to publish, delivers what is left."""
        bag = write_numbers(self._lab.directory / "run.bag", QUIET, 1, run=0)
        durable = {"directory": "kept"}
        robot = self._lab.process(self._lab.player_file("robot1", bag, play={"rate": 1}, topics=RULES, durable=durable))
        await robot.ready()
        await self._relay.ready()
        for process in (robot, self._relay):
            await process.until(lambda p=process: metric(p, "sern_durable_kept_bytes") == 0, "has delivered everything")
        await robot.stop()

    async def stop(self) -> None:
        await self._relay.stop()

    def check(self, recorded: Sequence[bytes]) -> None:
        """Raises AssertionError where something acknowledged is missing, twice, or out of order."""
        runs: dict[int, list[int]] = {}
        for body in recorded:
            run, number = map(int, body[4:].decode().split())
            runs.setdefault(run, []).append(number)
        for run, acknowledged in enumerate(self.acknowledged):
            got = runs.get(run, [])
            assert got == sorted(set(got)), f"run {run}: twice, or out of order: {got}"
            missing = set(range(acknowledged)) - set(got)
            assert not missing, f"run {run}: {acknowledged} were acknowledged, and are missing: {sorted(missing)[:10]}"


async def play(directory: Path, seed: int, count: int, *, said: bool = False) -> Kills:
    """Kill `count` times, check, and return what was done."""
    async with Lab(directory, "robot1", "site") as lab:
        kills = Kills(lab, Random(seed))
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        await kills.rounds(count, said=said)
        await kills.finish()
        await site.stop()
        await kills.stop()
    kills.check(bodies(directory / "site.bag").get(TOPIC, []))
    return kills


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hazards.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    directory = Path(tempfile.mkdtemp(prefix="sern-kills-"))
    try:
        kills = asyncio.run(play(directory, options.seed, options.kills, said=True))
    except AssertionError:
        print(f"\nlogs, disks and the recording are in {directory}")
        raise
    shutil.rmtree(directory)
    told = f"{sum(kills.acknowledged)} acknowledged messages of {len(kills.acknowledged)} runs"
    print(f"\n{kills.kills} kills: {told}, none lost or doubled")
    return 0


if __name__ == "__main__":
    sys.exit(main())
