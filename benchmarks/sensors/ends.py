"""A process at one end of the link: `python -m benchmarks.sensors.ends SPEC` (JSON, `Spec`).

The sender hands over each message when it is due, sensor by sensor: what one of them waits for is not the other's
trouble. To SERN's daemons both ends speak as nodes of rmw_zenoh do, over loopback; zenoh itself goes over the link. An
end says `ready` on standard output when messages pass, and leaves ROLE.npy.
"""

import asyncio
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Thread
from typing import Any, Final

import numpy as np

from benchmarks.link.load import HELLO, HELLO_PERIOD_S, Orders, ready
from benchmarks.sensors.bodies import TOPICS, Sensor, Tag, bodies, tag_of, tagged
from benchmarks.zenoh_session import open_session
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

SERN: Final = "sern"
ZENOH: Final = "zenoh"
"""zenoh as it comes: one connection, one priority."""
ZENOH_TUNED: Final = "zenoh-tuned-bbr"
"""The scan first and at once, then the camera, clouds last; a connection for each half of the priorities, BBR."""
ALL: Final = (SERN, ZENOH, ZENOH_TUNED)
PORT: Final = 7447
OUR_PORT, THEIR_PORT = 7460, 7461
"""Where the end and the daemon beside it listen."""
PREFIX: Final = "/robot"
"""Before the names of the topics at the site."""
POLL_S: Final = 0.02
LARGE_EVERY: Final = 10
"""How many hellos of a scan there are for each of an image and of a cloud."""
COLUMNS: Final = ("sensor", "number", "stamp_ns", "at_ns", "nbytes")

Send = Callable[[Sensor, bytes], object]


@dataclass(frozen=True)
class Spec:
    """What an end is told. `address` is the site's; `port` is where zenoh listens there. `whole`: the site's is ready
    when it has heard of every sensor, in whatever form, and not of the scan alone."""

    system: str
    sends: bool
    address: str
    directory: str
    duration_s: float
    port: int = PORT
    our_port: int = OUR_PORT
    their_port: int = THEIR_PORT
    whole: bool = False

    @property
    def awaited(self) -> set[Sensor]:
        """The sensors of which a hello must have come."""
        return set(Sensor) if self.whole else {Sensor.SCAN}

    @property
    def role(self) -> str:
        return "robot" if self.sends else "site"


class Log:
    """What one end saw; `COLUMNS` names what is in a row. Times in ns of the monotonic clock."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, int, int]] = []
        self.heard: set[Sensor] = set()
        """The sensors of which a hello has come."""

    def arrived(self, sensor: Sensor, body: bytes | memoryview) -> None:
        at_ns, tag = time.monotonic_ns(), tag_of(body)
        if tag.number == HELLO:
            self.heard.add(sensor)
        else:
            self.rows.append((sensor, tag.number, tag.stamp_ns, at_ns, len(body)))

    def save(self, path: Path) -> None:
        np.save(path, np.array(self.rows, dtype=np.int64).reshape(-1, len(COLUMNS)))


# --- the sender -------------------------------------------------------------------------------------------------------


async def offer(spec: Spec, orders: Orders, log: Log, send: Send) -> None:
    """Hellos until told to go, then the load, then nothing until told to stop."""
    made = {sensor: bodies(sensor) for sensor in Sensor}
    ready()
    turn = 0
    while orders.start_ns is None and not orders.stopped:
        for sensor in Sensor:
            if sensor is Sensor.SCAN or turn % LARGE_EVERY == sensor:
                send(sensor, tagged(made[sensor][0], Tag(HELLO, 0)))
        turn += 1
        await asyncio.sleep(HELLO_PERIOD_S)
        orders.poll()
    start_ns = orders.start_ns or 0

    async def sense(sensor: Sensor) -> None:
        rate_hz = TOPICS[sensor].rate_hz
        for number in range(1, int(spec.duration_s * rate_hz) + 1):
            due_ns = start_ns + int((number - 1) / rate_hz * 1e9)
            await asyncio.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            stamp_ns = time.monotonic_ns()
            body = tagged(made[sensor][number % len(made[sensor])], Tag(number, stamp_ns))
            log.rows.append((sensor, number, stamp_ns, due_ns, len(body)))
            send(sensor, body)

    await asyncio.gather(*(sense(sensor) for sensor in Sensor))
    await until_stopped(orders)


async def until_stopped(orders: Orders) -> None:
    while not orders.stopped:
        await asyncio.sleep(HELLO_PERIOD_S)
        orders.poll()


async def until_heard(spec: Spec, orders: Orders, log: Log) -> None:
    while not log.heard >= spec.awaited and not orders.stopped:
        await asyncio.sleep(HELLO_PERIOD_S)
        orders.poll()
    if log.heard >= spec.awaited:
        ready()


# --- nodes beside SERN's daemons --------------------------------------------------------------------------------------


class _Topics:
    """`TopicEvents`: tells of each topic that comes."""

    def __init__(self, added: Callable[[TopicInfo], None]) -> None:
        self.topic_added = added

    def topic_removed(self, name: TopicName) -> None:
        """The run ends before any is gone."""


async def beside_sern(spec: Spec, orders: Orders, log: Log) -> None:
    listen, connect = f"tcp/127.0.0.1:{spec.our_port}", f"tcp/127.0.0.1:{spec.their_port}"
    session = SessionOptions(connect=(connect,), listen=(listen,))
    node = ZenohEndpoint(ZenohOptions(session, node_name=f"sensors_{spec.role}", accept_bridged=True, enclave="/"))
    names = {TopicName(PREFIX + topic.name): sensor for sensor, topic in TOPICS.items()}

    def added(info: TopicInfo) -> None:
        sensor = names.get(info.name)
        if sensor is not None and not spec.sends:

            def sink(body: bytes, _stamp_ns: int) -> bool:
                log.arrived(sensor, body)
                return True

            node.subscribe(info.name, sink)

    await node.start(_Topics(added))
    try:
        if spec.sends:
            out = {
                sensor: node.advertise(ros_types.topic_info(topic.name, topic.type_name, Encoding.CDR, reliable=False))
                for sensor, topic in TOPICS.items()
            }
            await offer(spec, orders, log, lambda sensor, body: out[sensor].publish(body, 0))
        else:
            await until_heard(spec, orders, log)
            await until_stopped(orders)
    finally:
        await node.stop()


# --- zenoh over the link ----------------------------------------------------------------------------------------------


def _session(spec: Spec) -> Any:
    host = spec.address if spec.sends else "0.0.0.0"
    ends = [f"tcp/{host}:{spec.port}"]
    if spec.system == ZENOH_TUNED:
        ends = [f"{ends[0]}?prio=0-3", f"tcp/{host}:{spec.port + 1}?prio=4-7"]
    return open_session(ends, listens=not spec.sends)


def _quality(spec: Spec, sensor: Sensor) -> dict[str, Any]:
    import zenoh

    drop = {"congestion_control": zenoh.CongestionControl.DROP}
    if spec.system == ZENOH:
        return drop
    order = (zenoh.Priority.REAL_TIME, zenoh.Priority.DATA_HIGH, zenoh.Priority.BACKGROUND)
    return drop | {"priority": order[sensor], "express": sensor is Sensor.SCAN}


def _publishing(session: Any, spec: Spec) -> Send:
    """A thread a sensor hands over to zenoh, which may block; the newest message waits, and no other."""
    waiting: dict[Sensor, Queue[bytes]] = {sensor: Queue(1) for sensor in Sensor}

    def put(sensor: Sensor) -> None:
        out = session.declare_publisher(f"bench{TOPICS[sensor].name}", **_quality(spec, sensor))
        while True:
            out.put(waiting[sensor].get())

    def send(sensor: Sensor, body: bytes) -> None:
        while True:
            try:
                waiting[sensor].put_nowait(body)
                return
            except Full:
                try:
                    waiting[sensor].get_nowait()
                except Empty:
                    continue

    threads = [Thread(target=put, args=(sensor,), name=sensor.name, daemon=True) for sensor in Sensor]
    for thread in threads:
        thread.start()
    return send


async def over_zenoh(spec: Spec, orders: Orders, log: Log) -> None:
    """The session stays open: it would first send what waits, which may take minutes."""
    session = _session(spec)
    if spec.sends:
        await offer(spec, orders, log, _publishing(session, spec))
        return
    for sensor, topic in TOPICS.items():

        def take(sample: Any, sensor: Sensor = sensor) -> None:
            log.arrived(sensor, sample.payload.to_bytes())

        session.declare_subscriber(f"bench{topic.name}", take)
    await until_heard(spec, orders, log)
    await until_stopped(orders)


def main() -> None:
    spec = Spec(**json.loads(sys.argv[1]))
    log = Log()
    asyncio.run((beside_sern if spec.system == SERN else over_zenoh)(spec, Orders(), log))
    log.save(Path(spec.directory) / f"{spec.role}.npy")
    if spec.system != SERN:
        os._exit(0)


if __name__ == "__main__":
    main()
