"""The processes of the ROS 1 benchmark: `python -m benchmarks.endpoints.ros1_roles ROLE ...`, lines of JSON out.

Odometry and clouds are real types. The header's `seq` counts and its `stamp` is the monotonic clock of this host at
publishing. The source is a node like any other: it does not say that it is a SERN endpoint.
"""

import asyncio
import json
import statistics
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import uvloop

from benchmarks import common
from benchmarks.endpoints.shared import HOST
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.frames import Frames
from sern_client.endpoints.ros1.header import BRIDGE_FIELD, encode_header
from sern_client.endpoints.ros1.publication import Handle
from sern_client.endpoints.ros1.xmlrpc import CallError, XmlRpcClient
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

ODOM, CLOUD = "/bench/odom", "/bench/cloud"
TYPES: Final = {ODOM: "nav_msgs/msg/Odometry", CLOUD: "sensor_msgs/msg/PointCloud2"}


def say(**content: Any) -> None:
    print(json.dumps(content), flush=True)


async def until(condition: Callable[[], bool]) -> None:
    while not condition():  # noqa: ASYNC110  the condition is somebody else's state
        await asyncio.sleep(0.005)


def body(topic: str, size_bytes: int = 0) -> bytearray:
    """A message without sequence number and stamp."""
    fields: dict[str, Any] = {"header": ros_types.header(0, "odom", Encoding.ROS1)}
    if topic == CLOUD:
        fields["data"] = np.zeros(size_bytes, dtype="uint8")
    return bytearray(ros_types.serialise(ros_types.new(TYPES[topic], Encoding.ROS1, **fields), TYPES[topic],
                                         Encoding.ROS1))  # fmt: skip


def stamped(template: bytearray, seq: int) -> bytes:
    now_ns = time.monotonic_ns()
    template[0:4] = seq.to_bytes(4, "little")
    template[4:8] = (now_ns // 10**9).to_bytes(4, "little")
    template[8:12] = (now_ns % 10**9).to_bytes(4, "little")
    return bytes(template)


class _Nothing:
    def topic_added(self, info: TopicInfo) -> None: ...

    def topic_removed(self, name: TopicName) -> None: ...


def advertise(endpoint: Ros1Endpoint, topic: str, type_name: str) -> Handle:
    """Advertise a topic as an ordinary node does, which does not say that it is a SERN endpoint."""
    handle = endpoint.advertise(ros_types.topic_info(topic, type_name, Encoding.ROS1))
    for publication in endpoint._publications.values():
        publication.answer.pop(BRIDGE_FIELD, None)
    return handle


async def source(master: str, odom_hz: float, cloud_bytes: int, cloud_hz: float) -> None:
    """Publishes from when both topics have a subscriber, until it is ended."""
    endpoint = Ros1Endpoint(Ros1Options(master, HOST, "source"))
    await endpoint.start(_Nothing())
    handles = {topic: advertise(endpoint, topic, TYPES[topic]) for topic in TYPES}
    templates = {ODOM: body(ODOM), CLOUD: body(CLOUD, cloud_bytes)}
    periods_s = {ODOM: 1 / odom_hz} | ({CLOUD: 1 / cloud_hz} if cloud_hz else {})
    say(ready=True)
    await until(lambda: {link.topic for link in endpoint.bus_links()} >= set(periods_s))
    start_s = time.monotonic()
    sent = dict.fromkeys(periods_s, 0)
    while True:
        for topic, period_s in periods_s.items():
            while start_s + sent[topic] * period_s <= time.monotonic():
                sent[topic] += 1
                handles[topic].publish(stamped(templates[topic], sent[topic]), 0)
        await asyncio.sleep(max(0.0, min(start_s + sent[t] * p for t, p in periods_s.items()) - time.monotonic()))


class _Sink(Frames):
    """A subscriber that notes sequence number and latency."""

    def __init__(self) -> None:
        super().__init__(1 << 30)
        self.noted: list[tuple[int, int]] = []

    def header(self, fields: dict[str, str]) -> None:
        if "error" in fields:
            raise WireError(fields["error"])

    def message(self, body: bytes) -> None:
        sent_ns = int.from_bytes(body[4:8], "little") * 10**9 + int.from_bytes(body[8:12], "little")
        self.noted.append((int.from_bytes(body[0:4], "little"), time.monotonic_ns() - sent_ns))

    def too_large(self, size_bytes: int) -> None: ...

    def failed(self, error: WireError) -> None:
        say(problem=str(error))


async def _connect(master: XmlRpcClient, topic: str) -> _Sink:
    loop = asyncio.get_running_loop()
    while True:
        try:
            state = await master.call("getSystemState", "/sink")
            node = next(nodes[0] for name, nodes in state[0] if name == topic)
            client = XmlRpcClient(await master.call("lookupNode", "/sink", node))
            _, host, port = await client.call("requestTopic", "/sink", topic, [["TCPROS"]])
            client.close()
        except (CallError, StopIteration):
            await asyncio.sleep(0.05)
            continue
        _, sink = await loop.create_connection(_Sink, host, port)
        assert sink.transport is not None
        sink.transport.write(
            encode_header({"callerid": "/sink", "topic": topic, "md5sum": "*", "type": "*", "tcp_nodelay": "1"})
        )
        return sink


def figures(name: str, noted: Sequence[tuple[int, int]]) -> dict[str, float]:
    """What came of a topic, from the (number, latency in ns) of each message. Lost is what is missing between the least
    and the largest number. Where nothing came there is neither latency nor loss to tell."""
    if not noted:
        return {f"{name}_received": 0}
    lags_ms = sorted(lag_ns / 1e6 for _, lag_ns in noted)
    numbers = [number for number, _ in noted]
    return {
        f"{name}_p50_ms": statistics.median(lags_ms),
        f"{name}_p99_ms": common.percentile(lags_ms, 0.99),
        f"{name}_received": len(noted),
        f"{name}_lost": max(numbers) - min(numbers) + 1 - len(set(numbers)),
    }


async def sink(master_uri: str, odom: str, cloud: str, warm_s: float, measure_s: float) -> None:
    """Measures for a while, and says when that begins and what was found; then it waits to be ended. `cloud` may be
    empty."""
    master = XmlRpcClient(master_uri)
    # Topics may appear with their first message, which the source sends when both have a subscriber.
    topics = [topic for topic in (odom, cloud) if topic]
    sinks = dict(zip(topics, await asyncio.gather(*(_connect(master, topic) for topic in topics)), strict=True))
    master.close()
    first = sinks[odom]
    await until(lambda: all(each.noted for each in sinks.values()))
    await asyncio.sleep(warm_s)
    for each in sinks.values():
        each.noted.clear()
    say(begin=True)
    await asyncio.sleep(measure_s)
    say(end=True)
    if first.noted:
        found = [figures(name, each.noted) for name, each in zip(("odom", "cloud"), sinks.values(), strict=False)]
        say(found={metric: value for each in found for metric, value in each.items()})
    else:
        say(problem=f"nothing of {odom} arrived in {measure_s:g} s")
    await asyncio.Event().wait()


class _Forward(_Nothing):
    def __init__(self, here: Ros1Endpoint, there: Ros1Endpoint) -> None:
        self._here = here
        self._there = there

    def topic_added(self, info: TopicInfo) -> None:
        handle = self._there.advertise(info)

        def pass_on(body: bytes, stamp_ns: int) -> bool:
            handle.publish(body, stamp_ns)
            return True

        self._here.subscribe(info.name, pass_on)


async def bridge(master: str, other: str) -> None:
    """Everything of one master to another, endpoint to endpoint."""
    here, there = (Ros1Endpoint(Ros1Options(uri, HOST, "bridge")) for uri in (master, other))
    await there.start(_Nothing())
    await here.start(_Forward(here, there))
    await asyncio.Event().wait()


async def many(master: str, count: int) -> None:
    """A node with many topics."""
    endpoint = Ros1Endpoint(Ros1Options(master, HOST, "many", poll_hz=0.5))
    await endpoint.start(_Nothing())
    for number in range(count):
        advertise(endpoint, f"/bench/topic_{number}", "std_msgs/msg/String")
    await until(lambda: len(endpoint._graph._registered) >= count)
    say(ready=True)
    await asyncio.Event().wait()


async def follow(master: str, count: int) -> None:
    """An endpoint at a master of many topics, none of which anybody wants; says when it has found them all."""
    found: set[str] = set()

    class Events(_Nothing):
        def topic_added(self, info: TopicInfo) -> None:
            found.add(info.name)

    began_s = time.monotonic()
    endpoint = Ros1Endpoint(Ros1Options(master, HOST, "follower"))
    await endpoint.start(Events())
    await until(lambda: len(found) >= count)
    say(found_s=time.monotonic() - began_s)
    await asyncio.Event().wait()


def poll(master: str) -> None:
    """The bare poller: asks a master for its state as often as an endpoint does, by Python's own client."""
    asked, period_s = xmlrpc.client.ServerProxy(master), 1 / Ros1Options(master, HOST, "poller").poll_hz
    while True:
        asked.getSystemState("/poller")
        time.sleep(period_s)


def main(role: str, *arguments: str) -> None:
    if role in ("source", "sink"):
        common.pin_cpu()
    match role, arguments:
        case "source", (master, odom_hz, cloud_bytes, cloud_hz):
            uvloop.run(source(master, float(odom_hz), int(cloud_bytes), float(cloud_hz)))
        case "sink", (master, odom, cloud, warm_s, measure_s):
            uvloop.run(sink(master, odom, cloud, float(warm_s), float(measure_s)))
        case "bridge", (master, other):
            uvloop.run(bridge(master, other))
        case "many", (master, count):
            uvloop.run(many(master, int(count)))
        case "follow", (master, count):
            uvloop.run(follow(master, int(count)))
        case "poll", (master,):
            poll(master)
        case _:
            raise SystemExit(f"no role {role} with {len(arguments)} arguments")


if __name__ == "__main__":
    main(*sys.argv[1:])
