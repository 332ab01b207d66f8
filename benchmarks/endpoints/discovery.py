"""How soon a new ROS 1 topic is at the other master, and how soon it is gone there, with clients and relay in between.

A node begins to publish at one master, 100 messages a second. `first`: from there until its first message is at a node
of the other master; `gone`: from when it says goodbye until the other master has no publisher of it.
"""

import argparse
import asyncio
import statistics
import time
from typing import Final

from benchmarks import common
from benchmarks.endpoints.ros1 import ROSMASTER, Ros, need, running
from benchmarks.endpoints.ros1_roles import ODOM, TYPES, advertise, body
from benchmarks.endpoints.shared import CHAIN, HOST
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName
from sern_tools.harness.processes import Children

TOPICS: Final = 10
"""A round, one after the other."""
OBSERVE_HZ: Final = 100.0
"""How often the observer asks the other master: what it adds is a few milliseconds."""
PERIOD_S: Final = 0.01
TIMEOUT_S: Final = 30.0
CASE: Final = "ros1, a new topic"
LIMIT_MS: Final = 1000.0


class _Observer:
    """What there is at the other master, and when."""

    def __init__(self, uri: str) -> None:
        self.endpoint = Ros1Endpoint(Ros1Options(uri, HOST, "observer", poll_hz=OBSERVE_HZ, accept_bridged=True))
        self.first_s: dict[str, float] = {}
        self.gone_s: dict[str, float] = {}

    def topic_added(self, info: TopicInfo) -> None:
        def sink(_body: bytes, _stamp_ns: int) -> bool:
            self.first_s.setdefault(info.name, time.monotonic())
            return True

        self.endpoint.subscribe(info.name, sink)

    def topic_removed(self, name: TopicName) -> None:
        self.gone_s[name] = time.monotonic()


class _Nobody:
    def topic_added(self, info: TopicInfo) -> None: ...

    def topic_removed(self, name: TopicName) -> None: ...


async def _once(children: Children, source: Ros1Endpoint, observer: _Observer, topic: str) -> tuple[float, float]:
    """Seconds until its first message, and until it is gone."""
    began_s = time.monotonic()
    handle = advertise(source, topic, TYPES[ODOM])
    content = bytes(body(ODOM))

    async def first() -> None:
        while topic not in observer.first_s:
            handle.publish(content, 0)
            await asyncio.sleep(PERIOD_S)

    async def gone() -> None:
        while topic not in observer.gone_s:  # noqa: ASYNC110  the observer's events have no loop of their own
            await asyncio.sleep(PERIOD_S / 10)

    await children.within(first(), TIMEOUT_S, f"no message of {topic} got to the other master")
    handle.close()
    ended_s = time.monotonic()
    await children.within(gone(), TIMEOUT_S, f"{topic} was not gone from the other master")
    return observer.first_s[topic] - began_s, observer.gone_s[topic] - ended_s


async def _topics(ros: Ros, count: int) -> list[tuple[float, float]]:
    master, other = await ros.master(), await ros.master()
    await ros.chain(master, other)
    source, observer = Ros1Endpoint(Ros1Options(master, HOST, "source")), _Observer(other)
    await source.start(_Nobody())
    await observer.endpoint.start(observer)
    try:
        await _once(ros.children, source, observer, "/bench/before/odom")  # the daemons have found each other
        return [await _once(ros.children, source, observer, f"/bench/run{number}/odom") for number in range(count)]
    finally:
        await observer.endpoint.stop()
        await source.stop()


async def _measure(count: int) -> list[tuple[float, float]]:
    try:
        async with running() as ros:
            return await ros.children.beside(_topics(ros, count))
    except SernError as error:
        raise SernError(f"discovery: {error}") from error


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """MissingError where ROS 1 is not installed."""
    need(ROSMASTER)
    found = [times for _ in range(options.rounds) for times in asyncio.run(_measure(TOPICS))]
    first_s, gone_s = zip(*found, strict=True)
    report.row(
        CASE,
        CHAIN,
        first_p50_ms=1e3 * statistics.median(first_s),
        first_max_ms=1e3 * max(first_s),
        gone_p50_ms=1e3 * statistics.median(gone_s),
        gone_max_ms=1e3 * max(gone_s),
    )
    report.note(f"discovery: {len(found)} topics, {TOPICS} after each start of the daemons")
    for what in ("first", "gone"):
        report.reach(f"discovery: {what}, the slowest [ms]", report.value(CASE, CHAIN, f"{what}_max_ms"), LIMIT_MS)
