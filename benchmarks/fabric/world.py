"""Relays of one fabric and their clients, all as installed, with keys and certificates, on this machine.

Robots play a recording again and again, in real time, and a site records what they send. What was offered and what came
is in the message logs of both, by this machine's clock.
"""

import asyncio
import itertools
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks.asking import delivered, ready
from benchmarks.child import environment
from benchmarks.fabric.router import Router
from benchmarks.link.figures import NEVER_S
from sern_client.endpoints.bag_files import BagFile
from sern_core.vocabulary.types import Encoding
from sern_runtime.ros_types import topic_info
from sern_tools.harness.fabric import FabricFiles, reached
from sern_tools.harness.files import client_content, write
from sern_tools.harness.processes import Child, Children, daemon, killed, python
from sern_tools.message_log import TopicLog, read_logs
from sern_tools.ports import HOST, free_ports

START_S: Final = 60.0
STOP_S: Final = 20.0
SITE: Final = "site"
PERIOD_S: Final = 1.0
FRESH_S: Final = 0.1
"""A message that is no older when it comes is fresh."""
SILENT_S: Final = 1.0
"""A stream of poses of which nothing came for so long at the end has ended."""
ENOUGH: Final = 20
"""A stream of which so many more messages have come flows."""


class Flow(NamedTuple):
    """A topic of a robot, and its rule."""

    topic: str
    nbytes: int
    rate_hz: int
    rule: dict[str, Any]


POSE: Final = Flow("/pose", 100, 50, {"class": "control", "lifespan_s": 0.5})
LOG: Final = Flow("/log", 100, 50, {"class": "state", "reliability": "reliable"})


def write_bag(path: Path, flows: Sequence[Flow]) -> Path:
    """A second of all flows, in the order of time."""
    file = BagFile(path)
    infos = {flow.topic: topic_info(flow.topic, "std_msgs/msg/String", Encoding.ROS1) for flow in flows}
    for info in infos.values():
        file.add(info)
    due = [(number * PERIOD_S / flow.rate_hz, flow) for flow in flows for number in range(flow.rate_hz)]
    for at_s, flow in sorted(due, key=lambda each: each[0]):
        text = bytes(flow.nbytes)
        file.write(infos[flow.topic], 10**18 + round(1e9 * at_s), len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


class World:
    """`start` relays before clients. Made by `world`."""

    def __init__(self, children: Children, files: FabricFiles, routers: Sequence[str]) -> None:
        self.children = children
        self.files = files
        self.folder = files.directory
        self._routers = tuple(routers)
        self._http: dict[str, str] = {}
        self._logs: list[tuple[str, Path]] = []

    # --- processes --------------------------------------------------------------------------------------------------

    async def router(self, name: str) -> Child:
        command = python(*Router.of(self.files, name, self._routers).command())
        return await self.children.start(name, command, environment=environment())

    async def relay(self, name: str, **sections: Any) -> Child:
        return await self._start("relay", name, self.files.relay(name, http=self._listen(name), **sections))

    async def robot(self, name: str, flows: Sequence[Flow], *relays: str) -> Child:
        """One that is at the first of the relays, and goes to the others as its file says by default."""
        bag = write_bag(self.folder / f"{name}.bag", flows)
        topics = [flow.topic for flow in flows]
        play = {"kind": "bag", "path": str(bag), "rate": 1, "loop": True, "wait_for": topics}
        rules = [{"match": flow.topic, **flow.rule} for flow in flows]
        return await self._client(name, play, relays, topics=rules)

    async def site(self, *relays: str, patterns: Sequence[str] = (".*",)) -> Child:
        record = {"kind": "record", "path": "got", "overwrite": True}
        wants: dict[str, Any] = {"client": {"namespace": "/"}, "subscribe": list(patterns)}
        return await self._client(SITE, record, relays, **wants)

    async def _client(self, name: str, endpoint: object, relays: Sequence[str], **sections: Any) -> Child:
        log = self.folder / f"{name}.csv"
        self._logs.append((name, log))
        said: dict[str, Any] = {"http": self._listen(name), "message_log": log.name, "local": {"listen": False}}
        content = client_content(name, "", endpoint, **said, **sections)
        if len(relays) == 1:
            content["relay"] |= self.files.at(relays[0])
        else:
            content = self.files.several(content, relays)
        return await self._start("client", name, write(self.folder, name, content))

    def _listen(self, name: str) -> dict[str, str]:
        self._http[name] = f"{HOST}:{free_ports(1)[0]}"
        return {"listen": self._http[name]}

    async def _start(self, program: str, name: str, file: Path) -> Child:
        return await self.children.start(name, daemon(program, file), environment=environment())

    # --- waiting ----------------------------------------------------------------------------------------------------

    async def ready(self, *names: str) -> None:
        """Wait until these daemons say that they are."""

        async def all_ready() -> bool:
            return await asyncio.to_thread(lambda: all(ready(self._http[name]) for name in names))

        await self.children.until(all_ready, START_S, f"{', '.join(names)}: not ready")

    async def connected(self, names: Sequence[str], *, every_s: float = 0.1) -> None:
        """Wait until every two of these relays have a session with each other."""

        async def all_connected() -> bool:
            logs = {name: (self.folder / f"{name}.log").read_text(errors="replace") for name in names}
            return all(reached(log) >= {*names} - {name} for name, log in logs.items())

        await self.children.until(all_connected, START_S, "the relays did not find each other", every_s=every_s)

    async def flow(self, *topics: str) -> None:
        """Wait until more of each topic has come to the site."""
        before = await asyncio.to_thread(delivered, self._http[SITE])

        async def more() -> bool:
            now = await asyncio.to_thread(delivered, self._http[SITE])
            return all(now.get(topic, 0) >= before.get(topic, 0) + ENOUGH for topic in topics)

        await self.children.until(more, START_S, f"{', '.join(topics)}: nothing came to the site")

    def logs(self) -> dict[str, TopicLog]:
        """What the clients wrote down, by topic; once they have ended."""
        return read_logs(self._logs)


@asynccontextmanager
async def world(
    names: Sequence[str], clients: Sequence[str] = (), *, routers: Sequence[str] = (), tls: bool = True
) -> AsyncIterator[World]:
    """A place for relays of these names and their clients. Whoever runs in the end is killed."""
    with tempfile.TemporaryDirectory(prefix="sern-fabric-") as temporary:
        folder = Path(temporary)
        files = FabricFiles(folder, names, routers=routers, tls=tls)
        files.admit(clients)
        async with killed(folder) as children:
            yield World(children, files, routers)


# --- what came ------------------------------------------------------------------------------------------------------


class Fate(NamedTuple):
    """What became of a reliable stream. `swapped`: came after a later one."""

    lost: int
    doubled: int
    swapped: int


def fate(log: TopicLog) -> Fate:
    seqs = [each.seq for each in log.deliveries]
    swapped = sum(later < earlier for earlier, later in itertools.pairwise(seqs))
    return Fate(len(log.offers.keys() - log.refused - set(seqs)), len(seqs) - len(set(seqs)), swapped)


def ages_s(log: TopicLog, from_ns: int, until_ns: int) -> list[float]:
    """How old the messages that were offered in that time were when they came, in order of age."""
    came = ((each.wall_ns, log.offers[each.seq].wall_ns) for each in log.deliveries if each.seq in log.offers)
    return sorted((at_ns - offered_ns) / 1e9 for at_ns, offered_ns in came if from_ns <= offered_ns < until_ns)


def pause(log: TopicLog, from_ns: int, until_ns: int) -> tuple[float, float]:
    """The longest time without a fresh message, in seconds, and how long after `from_ns` it ended. NEVER_S for both
    where none came any more."""
    fresh = sorted(
        each.wall_ns for each in log.deliveries
        if each.seq in log.offers and each.wall_ns - log.offers[each.seq].wall_ns <= 1e9 * FRESH_S
    )  # fmt: skip
    before = [at_ns for at_ns in fresh if at_ns <= from_ns]
    marks = [*before[-1:], *(at_ns for at_ns in fresh if from_ns < at_ns <= until_ns)]
    if len(marks) < 2 or until_ns - marks[-1] > 1e9 * SILENT_S:
        return NEVER_S, NEVER_S
    took_ns, ended_ns = max((later - one, later) for one, later in itertools.pairwise(marks))
    return took_ns / 1e9, (ended_ns - from_ns) / 1e9
