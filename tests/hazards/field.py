"""A robot whose numbered stream runs to a site by way of a relay, each a process with keys, while something happens."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

from sern_client.endpoints.bag_files import BagFile
from sern_client.endpoints.leftovers import finish
from sern_core.vocabulary.types import Encoding
from sern_runtime.ros_types import topic_info
from tests.daemons import HOST, START_NS, Lab, Process, bodies, delivered, metric, write_bag

OTHERS: Final = ("robot2", "site2")
"""Clients that have keys and are not there, unless the test starts them."""
COUNT: Final = 500
RATE: Final = 0.2
"""A message each 5 ms: the stream lasts, and leaves a busy machine some air."""


def write_numbers(path: Path, topic: str, count: int, *, run: int) -> Path:
    """A ROS 1 bag of texts "RUN NUMBER", from 0, one a millisecond."""
    file = BagFile(path)
    info = topic_info(topic, "std_msgs/msg/String", Encoding.ROS1)
    file.add(info)
    for number in range(count):
        text = f"{run} {number}".encode()
        file.write(info, START_NS + number * 1_000_000, len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


class Field:
    """`robot` plays its recording again and again; `site` records it as it comes."""

    def __init__(self, lab: Lab, relay: Process, site: Process, robot: Process) -> None:
        self.lab = lab
        self.relay = relay
        self.site = site
        self.robot = robot
        self.recordings: list[Path] = [lab.directory / "site.bag"]
        """The site's recordings, in their order."""
        self.again = 0
        """So many messages at the end of a recording may begin the next one, too: what a killed site had not confirmed
        it gets again."""
        self.sessions: dict[str, int] = {"robot1": 1, "site": 1}
        """How often each client has come to the relay by the end."""

    async def goes_on(self) -> None:
        """The stream is alive now."""
        count = delivered(self.site)
        await self.site.until(lambda: delivered(self.site) > count + 50, "goes on receiving")

    async def refused(self, reason: str, count: int = 1) -> None:
        """The relay has refused so many connections or messages for this reason."""
        name = "sern_relay_connections_refused_total"
        await self.relay.until(lambda: metric(self.relay, name, reason=reason) >= count, f"counts {reason}")

    def came(self, client: str) -> int:
        """How often a client has come to the relay."""
        rows: list[dict[str, Any]] = self.relay.json("/api/clients")["clients"]
        return sum(int(row["sessions"]) for row in rows if row["name"] == client)

    async def finish(self) -> None:
        """Stop all of them; the site has recorded the stream without a gap and without a double."""
        await self.goes_on()
        came = {client: self.came(client) for client in self.sessions}
        assert came == self.sessions, "somebody had to come again"
        for process in (self.robot, self.site, self.relay):
            await process.stop()
        self.check()

    def check(self) -> None:
        """What was recorded is the stream."""
        played = bodies(self.lab.directory / "loop.bag")["/count"]
        for path in self.recordings:
            left = path.with_name(f"{path.name}.active")  # of a process that was killed
            if left.exists():
                finish(left)
        arrived: list[bytes] = []
        for path in self.recordings:
            found = bodies(path).get("/robot1/count", [])
            twice = max(n for n in range(self.again + 1) if n == 0 or found[:n] == arrived[-n:])
            arrived += found[twice:]
        assert arrived == [played[index % COUNT] for index in range(len(arrived))]
        assert len(arrived) > 100


@asynccontextmanager
async def field(
    directory: Path,
    *,
    relay: dict[str, Any] | None = None,
    robot: dict[str, Any] | None = None,
    before_relay: tuple[str, ...] = (),
) -> AsyncIterator[Field]:
    """A field whose stream runs; it must run at the end, and be whole. `relay`, `robot`: sections of their files;
    `before_relay`: what the relay's command is run by."""
    bag = write_bag(directory / "loop.bag", {"/count": COUNT})
    async with Lab(directory, "robot1", "site", *OTHERS) as lab:
        relay_process = await lab.process(lab.relay_file(**(relay or {})), before=before_relay).ready()
        site = await lab.process(lab.recorder_file("site", "/robot1/.*")).ready()
        play = {"rate": RATE, "loop": True}
        robot_process = await lab.process(lab.player_file("robot1", bag, play=play, **(robot or {}))).ready()
        world = Field(lab, relay_process, site, robot_process)
        await world.goes_on()
        yield world
        await world.finish()


__all__ = ["COUNT", "HOST", "RATE", "Field", "field"]
