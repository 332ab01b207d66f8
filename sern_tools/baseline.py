"""The same load over plain ZeroMQ: one PUB socket, one SUB socket, defaults; the picture most bridges start from.

It reads the same configuration file as `sern-client`, offers the same messages through the same endpoints, and writes
the same message log, so that one analysis serves both. Two favours are done to it: there are no keys and no
encryption, and its kernel buffers are held to 64 kB, because the defaults would hide further seconds of data.

Before the load it measures the idle link: small messages, a fiftieth of a second apart, in both directions.

Run as a process, one a side:  python -m sern_tools.baseline --config robot.yaml --publish tcp://... --subscribe tcp://...
(`bind:` before an address binds instead of connecting). It prints JSON lines and answers words on its standard input:
`floor` with the idle latency so far, `go` after starting the load, `count` with the messages and bytes so far,
`quiet` after stopping the load (what arrives is still taken).
The end of the input ends it, so that it never outlives whoever started it.
"""

import argparse
import asyncio
import json
import signal
import statistics
import struct
import sys
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import zmq
import zmq.asyncio

from sern_client.endpoints.base import Endpoint, Subscription
from sern_client.factory import make_endpoint
from sern_core.topics.rules import ResolvedTopic
from sern_core.vocabulary.errors import ConfigError, SernError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import to_global
from sern_core.vocabulary.types import CLASS_LABELS, TopicName
from sern_runtime.config.client import ClientFile, load_client
from sern_tools.message_log import Delivery, MessageLog, Offer

KERNEL_BUFFER_BYTES: Final = 32 * 1024
"""Bytes of the send buffer as requested; the kernel doubles it: 64 kB."""
PROBE_INTERVAL_S: Final = 0.02
PROBE_BYTES: Final = 100
PROBE_TOPIC: Final = b"\x00probe"
FLUSH_INTERVAL_S: Final = 1.0
_HEADER: Final = struct.Struct("!QqB")  # seq, origin wall ns, class
BIND: Final = "bind:"


@dataclass(slots=True)
class _Live:
    """Counters of one topic, for the live table."""

    priority: str
    offered: int = 0
    delivered: int = 0
    offered_bytes: int = 0
    delivered_bytes: int = 0
    newest_ns: int = 0  # stamp of the newest message that arrived


class Baseline:
    """One side: publishes what its endpoints offer, logs what it offers and what arrives. Is the `TopicEvents`."""

    def __init__(self, config: ClientFile, endpoint: Endpoint, log: MessageLog) -> None:
        self._config = config
        self._rules = config.rules()
        self._discovery = config.discovery.filter()
        self._endpoint = endpoint
        self._log = log
        self._context = zmq.Context()
        self._publisher = self._context.socket(zmq.PUB)
        self._subscriber = zmq.asyncio.Socket(self._context, zmq.SUB)
        sockets: tuple[zmq.Socket[bytes] | zmq.asyncio.Socket, ...] = (self._publisher, self._subscriber)
        for socket in sockets:
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.SNDBUF, KERNEL_BUFFER_BYTES)
            socket.setsockopt(zmq.RCVBUF, KERNEL_BUFFER_BYTES)
        self._subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        self._sequence: dict[TopicName, int] = {}
        self._subscriptions: dict[TopicName, Subscription] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._probe: asyncio.Task[None] | None = None
        self._started = False
        self.idle_latencies_s: list[float] = []
        self._live: dict[str, _Live] = {}

    # -- life cycle ------------------------------------------------------------------------------------------------

    def open(self, publish: str, subscribe: str) -> None:
        """Bind or connect both sockets, receive from now on, and probe the idle link. Raises zmq.ZMQError."""
        sockets: tuple[tuple[zmq.Socket[bytes] | zmq.asyncio.Socket, str], ...]
        sockets = ((self._publisher, publish), (self._subscriber, subscribe))
        for socket, address in sockets:
            if address.startswith(BIND):
                socket.bind(address.removeprefix(BIND))
            else:
                socket.connect(address)
        self._tasks = [asyncio.create_task(self._receive()), asyncio.create_task(self._flush())]
        self._probe = asyncio.create_task(self._send_probes())

    async def go(self) -> None:
        """Stop probing and start the load."""
        await self._stop_probe()
        self._started = True
        await self._endpoint.start(self)

    async def quiet(self) -> None:
        """Offer nothing more; what was offered goes on being carried."""
        await self._stop_probe()
        for subscription in self._subscriptions.values():
            subscription.close()
        self._subscriptions.clear()
        if self._started:
            self._started = False
            await self._endpoint.stop()

    async def close(self) -> None:
        await self.quiet()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._publisher.close()
        self._subscriber.close()
        self._context.term()
        self._log.close()

    async def _stop_probe(self) -> None:
        if self._probe is not None:
            self._probe.cancel()
            await asyncio.gather(self._probe, return_exceptions=True)
            self._probe = None

    # -- sending ---------------------------------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        resolved = self._rules.resolve(info, local_name=info.name)
        if info.name in self._subscriptions or not resolved.direction.sends:
            return
        if not self._discovery.wants(info.name, info.type_name, listed=resolved.rule is not None):
            return
        name = to_global(resolved.name, self._config.namespace)
        self._subscriptions[info.name] = self._endpoint.subscribe(
            info.name, lambda body, _stamp_ns: self._offer(name, resolved, body)
        )
        self._endpoint.interest(info.name, wanted=True)  # the far side subscribes to everything

    def topic_removed(self, name: TopicName) -> None:
        subscription = self._subscriptions.pop(name, None)
        if subscription is not None:
            subscription.close()

    def _offer(self, name: TopicName, resolved: ResolvedTopic, body: bytes) -> bool:
        """Hand one message to ZMQ. A PUB socket takes everything: what it can not hold it drops without a word."""
        seq = self._sequence.get(name, 0) + 1
        self._sequence[name] = seq
        priority = resolved.spec.priority
        wall_ns = time.time_ns()
        offer = Offer(wall_ns, seq, len(body), zlib.crc32(body))
        self._log.offered(name, CLASS_LABELS[priority], offer)
        live = self._live_of(name, priority)
        live.offered += 1
        live.offered_bytes += len(body)
        self._publisher.send_multipart([name.encode(), _HEADER.pack(seq, wall_ns, priority), body], zmq.NOBLOCK)
        return True

    async def _send_probes(self) -> None:
        while True:
            header = struct.pack("!q", time.time_ns())
            self._publisher.send_multipart([PROBE_TOPIC, header, bytes(PROBE_BYTES)], zmq.NOBLOCK)
            await asyncio.sleep(PROBE_INTERVAL_S)

    # -- receiving -------------------------------------------------------------------------------------------------

    async def _receive(self) -> None:
        while True:
            topic, header, body = await self._subscriber.recv_multipart()
            wall_ns = time.time_ns()
            if topic == PROBE_TOPIC:
                self.idle_latencies_s.append((wall_ns - struct.unpack("!q", header)[0]) / 1e9)
                continue
            seq, stamp_ns, priority = _HEADER.unpack(header)
            delivery = Delivery(wall_ns, seq, len(body), zlib.crc32(body), stamp_ns, None)
            self._log.delivered(topic.decode(), CLASS_LABELS[priority], delivery)
            live = self._live_of(topic.decode(), priority)
            live.delivered += 1
            live.delivered_bytes += len(body)
            live.newest_ns = max(live.newest_ns, stamp_ns)

    def _live_of(self, topic: str, priority: int) -> "_Live":
        live = self._live.get(topic)
        if live is None:
            live = self._live[topic] = _Live(CLASS_LABELS[priority])
        return live

    def counts(self) -> dict[str, dict[str, object]]:
        """Per topic, the shape of a client's /api/topics; `age_s` is the age of the newest message that arrived."""
        now_ns = time.time_ns()
        return {
            topic: {
                "class": live.priority,
                "direction": "send" if live.offered else "receive",
                "offered": live.offered,
                "delivered": live.delivered,
                "bytes_offered": live.offered_bytes,
                "bytes_delivered": live.delivered_bytes,
                "dropped": {},
                "age_s": (now_ns - live.newest_ns) / 1e9 if live.newest_ns else None,
            }
            for topic, live in self._live.items()
        }

    async def _flush(self) -> None:
        while True:
            await asyncio.sleep(FLUSH_INTERVAL_S)
            self._log.flush()

    def idle_latency_s(self) -> float | None:
        """Median one-way latency of the probes that arrived here; None without any."""
        return statistics.median(self.idle_latencies_s) if self.idle_latencies_s else None


async def _serve(config: Path, publish: str, subscribe: str) -> None:
    loaded = load_client(config)
    if loaded.model.message_log is None:
        raise ConfigError(
            "is missing: the baseline writes what it offers and what arrives", file=str(config), key="message_log"
        )
    log = MessageLog(loaded.resolve(loaded.model.message_log))
    baseline = Baseline(loaded.model, make_endpoint(loaded), log)
    loop = asyncio.get_running_loop()
    words = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(words), sys.stdin)
    try:
        baseline.open(publish, subscribe)
        print(json.dumps({"ready": True}), flush=True)
        while word := (await words.readline()).decode().strip():
            print(json.dumps(await _answer(baseline, word)), flush=True)
    finally:
        await baseline.close()


async def _answer(baseline: Baseline, word: str) -> dict[str, object]:
    match word:
        case "floor":
            return {"floor_s": baseline.idle_latency_s()}
        case "go":
            await baseline.go()
        case "quiet":
            await baseline.quiet()
        case "count":
            return {"topics": baseline.counts()}
        case _:
            return {"error": f"unknown word {word!r}"}
    return {"done": word}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sern_tools.baseline", description="The load over plain ZMQ")
    parser.add_argument("--config", required=True, type=Path, metavar="FILE")
    parser.add_argument("--publish", required=True, metavar="[bind:]ADDRESS")
    parser.add_argument("--subscribe", required=True, metavar="[bind:]ADDRESS")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it, by closing its input
    try:
        asyncio.run(_serve(options.config, options.publish, options.subscribe))
    except (SernError, zmq.ZMQError) as error:
        print(f"baseline: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
