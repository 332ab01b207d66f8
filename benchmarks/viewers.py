"""What a viewer costs, and how late it sees what has come to its site.

Twenty topics with 5 MB/s of clouds, shown to a viewer of Foxglove's protocol in a process of its own on this machine.
`endpoint` is SERN's endpoint `foxglove`, door and all; `bare server` is foxglove-sdk's own, which is fed with the same
bodies at the same times. Latency is from the call that hands a body over, as the site does when it has come over the
link, until the viewer has the whole of it; CPU is that of the process that serves, whose feeding is the same in both.
"""

import argparse
import asyncio
import importlib.util
import json
import multiprocessing
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from random import Random
from typing import Any, Final, NamedTuple

import uvloop

from benchmarks import common, viewers_link
from benchmarks.common import Report
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

TOPICS: Final = 20
BYTES_PER_S: Final = 5_000_000
RATE_HZ: Final = 10.0
BODY_BYTES: Final = int(BYTES_PER_S / TOPICS / RATE_HZ)
STAMP_BYTES: Final = 8
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
SYSTEMS: Final = ("endpoint", "bare server")
MEDIAN_LIMIT_MS: Final = 1.5
WORST_LIMIT_MS: Final = 10.0
CPU_LIMIT: Final = 1.5
JOIN_S: Final = 30.0
WARM_S: Final = 0.5
PROTOCOL: Final = "foxglove.sdk.v1"
HEAD_BYTES: Final = 13

Show = Callable[[int, bytes], None]
"""`show(topic's number, body)`"""


class Seen(NamedTuple):
    """What one run gave. Latencies sorted, in ms; CPU of the serving process, in s."""

    latencies_ms: list[float]
    cpu_s: float
    sent: int


def infos() -> list[TopicInfo]:
    text = ros_types.describe(CLOUD, Encoding.CDR)
    assert text is not None
    return [
        TopicInfo(TopicName(f"/robot/points_{number}"), CLOUD, Encoding.CDR, text.type_hash, text.definition)
        for number in range(TOPICS)
    ]


async def _feed(show: Show, duration_s: float) -> int:
    """The same bodies at the same times, each with the time of its handing over."""
    loop = asyncio.get_running_loop()
    rest = Random(1).randbytes(BODY_BYTES - STAMP_BYTES)
    began_s = loop.time()
    count = int(duration_s * RATE_HZ * TOPICS)
    for number in range(count):
        await asyncio.sleep(max(0.0, began_s + number / (RATE_HZ * TOPICS) - loop.time()))
        show(number % TOPICS, time.monotonic_ns().to_bytes(STAMP_BYTES, "little") + rest)
    return count


async def _measured(show: Show, orders: Connection, duration_s: float) -> None:
    """Feed and tell: the viewer is there when an order comes."""
    await asyncio.get_running_loop().run_in_executor(None, orders.recv)
    await _feed(show, WARM_S)
    before_s = time.process_time()
    count = await _feed(show, duration_s)
    orders.send((time.process_time() - before_s, count))
    await asyncio.get_running_loop().run_in_executor(None, orders.recv)


async def _endpoint(orders: Connection, duration_s: float) -> None:
    from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
    from sern_client.endpoints.foxglove.options import FoxgloveOptions

    endpoint = FoxgloveEndpoint(FoxgloveOptions(listen="127.0.0.1:0"))
    await endpoint.start(_Nobody())
    try:
        publishers = [endpoint.advertise(info) for info in infos()]
        orders.send(endpoint.port)
        await _measured(lambda number, body: publishers[number].publish(body, 0), orders, duration_s)
    finally:
        await endpoint.stop()


async def _bare(orders: Connection, duration_s: float) -> None:
    import foxglove

    context = foxglove.Context()
    server = foxglove.start_server(port=0, context=context)
    try:
        channels = [
            foxglove.Channel(
                info.name, message_encoding="cdr", context=context,
                schema=foxglove.Schema(name=info.type_name, encoding="ros2msg", data=info.definition.encode()),
            )
            for info in infos()
        ]  # fmt: skip
        orders.send(server.port)
        await _measured(lambda number, body: channels[number].log(body), orders, duration_s)
    finally:
        server.stop()


class _Nobody:
    """`TopicEvents` of nobody."""

    def topic_added(self, info: TopicInfo) -> None:
        """Nobody publishes here."""

    def topic_removed(self, name: TopicName) -> None:
        """Nothing that was never published goes."""


def _serve(system: str, orders: Connection, duration_s: float) -> None:
    uvloop.run((_endpoint if system == "endpoint" else _bare)(orders, duration_s))


def _view(port: int, told: Connection) -> None:
    """A viewer, until the connection ends: how late each message was."""
    latencies_ns: list[int] = []

    async def look() -> None:
        import websockets

        async with websockets.connect(
            f"ws://127.0.0.1:{port}", subprotocols=[websockets.Subprotocol(PROTOCOL)], max_size=None, compression=None,
            proxy=None,
        ) as connection:  # fmt: skip
            channels: list[int] = []
            while len(channels) < TOPICS:
                said = json.loads(await connection.recv())
                if said["op"] == "advertise":
                    channels += [each["id"] for each in said["channels"] if "/age" not in each["topic"]]
            listed = [{"id": number, "channelId": number} for number in channels]
            await connection.send(json.dumps({"op": "subscribe", "subscriptions": listed}))
            told.send("looks")
            async for message in connection:
                if isinstance(message, bytes):
                    stamp_ns = int.from_bytes(message[HEAD_BYTES : HEAD_BYTES + STAMP_BYTES], "little")
                    latencies_ns.append(time.monotonic_ns() - stamp_ns)

    asyncio.run(look())
    told.send([each / 1e6 for each in latencies_ns])


def measure(system: str, duration_s: float) -> Seen:
    """One run. SernError where a process does not answer."""
    spawn = multiprocessing.get_context("spawn")
    orders, theirs = spawn.Pipe()
    told, viewers = spawn.Pipe()
    server = spawn.Process(target=_serve, args=(system, theirs, duration_s))
    server.start()
    try:
        viewer = spawn.Process(target=_view, args=(_answer(orders, system), viewers))
        viewer.start()
        try:
            _answer(told, "the viewer")
            orders.send("begin")
            cpu_s, sent = _answer(orders, system, more_s=2 * duration_s)
            orders.send("end")
            latencies_ms = _answer(told, "the viewer")
        finally:
            viewer.terminate()
            viewer.join()
    finally:
        server.join(JOIN_S)
        if server.is_alive():
            server.kill()
            server.join()
    warm = int(WARM_S * RATE_HZ * TOPICS)
    return Seen(sorted(latencies_ms[warm:]), cpu_s, sent)


def _answer(connection: Connection, who: str, *, more_s: float = 0.0) -> Any:
    if not connection.poll(JOIN_S + more_s):
        raise SernError(f"{who} did not answer within {JOIN_S + more_s:g} s")
    return connection.recv()


def run(options: argparse.Namespace, report: Report) -> None:
    for package in ("foxglove", "websockets"):
        if importlib.util.find_spec(package) is None:
            raise SernError(f"{package} is not installed: pip install '.[dev,foxglove]'")
    rounds, duration_s = common.repetitions(options, (5, 20.0), (1, 4.0))
    systems = {system: partial(measure, system, duration_s) for system in SYSTEMS}
    runs = common.interleaved(systems, rounds)
    case = f"{TOPICS} topics, {BYTES_PER_S / 1e6:g} MB/s"
    for system in SYSTEMS:
        metrics = common.medians([_metrics(seen, duration_s) for seen in runs[system]])
        report.row(case, system, **metrics)
    ours = "endpoint"
    report.reach("median until a viewer has it, ms", report.value(case, ours, "p50_ms"), MEDIAN_LIMIT_MS)
    report.reach("99 % of them, ms", report.value(case, ours, "p99_ms"), WORST_LIMIT_MS)
    cpu = [report.value(case, system, "cpu_percent") for system in SYSTEMS]
    report.reach("CPU by that of the SDK's bare server", cpu[0] / cpu[1], CPU_LIMIT)
    report.reach("messages that a viewer got, %", report.value(case, ours, "got_percent"), 100.0, at_least=True)
    asyncio.run(viewers_link.measure(report, seconds=2.0 if options.quick else 10.0, times=3 if options.quick else 50))


def _metrics(seen: Seen, duration_s: float) -> dict[str, float]:
    return {
        "p50_ms": common.percentile(seen.latencies_ms, 0.5),
        "p99_ms": common.percentile(seen.latencies_ms, 0.99),
        "cpu_percent": 100 * seen.cpu_s / duration_s,
        "got_percent": 100 * len(seen.latencies_ms) / seen.sent,
    }


if __name__ == "__main__":
    sys.exit(common.main("viewers", run, description=__doc__, arguments=common.repetition_arguments))
