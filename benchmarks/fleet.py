"""Robots as clients' cores with connections of their own, many in a process: what they offer, and how it is offered.

Each message begins with the time at which it was offered, by this machine's clock (`STAMP`).
"""

import asyncio
import heapq
import random
import struct
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Final, NamedTuple

from benchmarks.loopback import Member
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, PriorityClass, Reliability, TopicName
from sern_runtime import clock

LOOK_S: Final = 0.5
"""How often a client looks after its connections."""
STAMP: Final = struct.Struct("!d")
TURN_S: Final = 0.02
"""The longest pause of who offers: how soon it sees that it is to stop."""


class Kind(NamedTuple):
    """Some topics of a robot."""

    priority: PriorityClass
    topics: int
    nbytes: int
    rate_hz: float
    reliable: bool = False


def topics_of(kinds: Sequence[Kind]) -> int:
    return sum(kind.topics for kind in kinds)


def rate_hz_of(kinds: Sequence[Kind]) -> float:
    """Messages a second of one robot."""
    return sum(kind.topics * kind.rate_hz for kind in kinds)


def announce(core: ClientCore, kinds: Sequence[Kind]) -> list[tuple[OutChannel, Kind]]:
    """A channel for each topic, `/NAME/topicN`."""
    channels: list[tuple[OutChannel, Kind]] = []
    for kind in kinds:
        for _ in range(kind.topics):
            info = TopicInfo(TopicName(f"/{core.name}/topic{len(channels)}"), "bench/Bytes", Encoding.RAW)
            spec = TopicSpec(priority=kind.priority)
            if kind.reliable:
                spec = replace(spec, reliability=Reliability.RELIABLE, lifespan_s=None)
            channels.append((core.publish(info, spec, now=clock.now()), kind))
    return channels


@asynccontextmanager
async def looked_after(members: Sequence[Member], tell: Callable[[], object]) -> AsyncIterator[None]:
    """Members that are connected; `tell` is called twice a second. They are closed in the end."""

    async def tick() -> None:
        while True:
            for member in members:
                member.connection.tick()
            tell()
            await asyncio.sleep(LOOK_S)

    ticks = asyncio.create_task(tick())
    try:
        yield
    finally:
        ticks.cancel()
        for member in members:
            member.connection.close()


async def offer(
    members: Sequence[Member], kinds: Sequence[Kind], seed: int, stopped: Callable[[], bool]
) -> list[OutChannel]:
    """Announce the topics of all of them, and offer their messages until it is stopped, each topic at its rate from a
    random moment on. Returns the channels."""
    rng = random.Random(seed)
    due: list[tuple[float, int, Member, OutChannel, Kind]] = []
    for member in members:
        for channel, kind in announce(member.core, kinds):
            due.append((clock.now() + rng.random() / kind.rate_hz, len(due), member, channel, kind))
    heapq.heapify(due)
    while not stopped():
        now = clock.now()
        while due[0][0] <= now:
            due_s, order, member, channel, kind = due[0]
            body = STAMP.pack(clock.now()).ljust(kind.nbytes, b"\0")
            member.core.send(channel, body, 0, now=now)
            member.connection.wake()
            heapq.heapreplace(due, (due_s + 1.0 / kind.rate_hz, order, member, channel, kind))
        await asyncio.sleep(min(TURN_S, max(0.0, due[0][0] - clock.now())))
    return [entry[3] for entry in due]
