"""One publisher, one relay, one subscriber, each a process of its own, over TCP on this machine.

Every system carries the same messages in closed loop: the publisher keeps a bounded number in flight, by a counter in
shared memory, so that nothing is dropped and the figure is what the relay carries, not what it loses. Systems are
measured in interleaved rounds; ratios are taken within a round and their median is reported.

    proxy         zmq.proxy between XSUB and XPUB, in C: the least a relay can cost
    proxy-curve   the same with CURVE on all connections
    feed          sern_runtime.feed: the same sockets and frames, with access rules, without keys
    sern          the scheduled link over TCP: sern-relay between two clients, acknowledged hop by hop, with keys as
                  installed
    sern-plain    the same without keys
    zenoh         a zenoh router and two clients, shared memory off, without TLS

A further system is one more subclass of `System` in `SYSTEMS`, and its limits in `CPU_LIMITS` and `RATE_LIMITS`.
"""

import argparse
import asyncio
import importlib.util
import json
import multiprocessing
import signal
import statistics
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from ctypes import c_bool, c_uint64
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import Any, Final, NamedTuple

import uvloop
import zmq

from benchmarks import common
from benchmarks.child import Worker, await_workers
from benchmarks.loopback import IdleSite, connect, running, serve, watch
from sern_core.site.client import ClientCore
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import Message, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_runtime import clock
from sern_runtime.config.keys import load_secret
from sern_runtime.feed import Feed, FeedHeader, topic_frame
from sern_runtime.loop import Shutdown, keep_freed_memory, run
from sern_runtime.pump import Pump
from sern_runtime.version import compiled
from sern_runtime.zmq_setup import connect_curve
from sern_tools.harness.files import RELAY, relay_content, write
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

SIZES: Final = {"100 B": 100, "1 kB": 1000, "64 kB": 64_000, "1 MB": 1_000_000}
IN_FLIGHT_MESSAGES: Final = 500
IN_FLIGHT_BYTES: Final = 8_000_000
BURST: Final = 16
START_S: Final = 20.0
"""How long processes may take to start and find each other."""
STALL_S: Final = 1.0
"""Without progress for this long, what is in flight counts as lost."""
HIGH_WATER: Final = 10_000  # above what is in flight: the closed loop alone decides

TOPIC: Final = "/bench/odom"
CLIENTS: Final = ("publisher", "subscriber")
CPU_LIMITS: Final = {
    ("feed", "1 kB"): ("proxy", 3.0),
    ("sern", "1 kB"): ("proxy-curve", 3.0 if compiled() else 6.0),
    ("sern-plain", "1 kB"): ("proxy", 8.0),
}
"""(system, case): relay CPU a message, at most so many times that of the other."""
RATE_LIMITS: Final = {("feed", "64 kB"): 0.8, ("sern-plain", "64 kB"): 1.0, ("sern-plain", "1 MB"): 1.0}
"""(system, case): MB/s, at least this share of zenoh's, which has no keys either."""


class Ports(NamedTuple):
    ingest: int
    publish: int
    keys: Path
    """The folder of the keys of `RELAY` and `CLIENTS`."""


@dataclass
class Flow:
    """What the three processes share: how much arrived, and when to end."""

    size_bytes: int
    received: Any = field(default_factory=lambda: RawValue(c_uint64, 0))
    stopped: Any = field(default_factory=lambda: RawValue(c_bool, False))

    @property
    def window(self) -> int:
        return max(4, min(IN_FLIGHT_MESSAGES, IN_FLIGHT_BYTES // self.size_bytes))

    def drive(self, send: Callable[[], object]) -> None:
        """The publisher's loop: first until it is heard, then with a full window, until stopped."""
        received, stopped = self.received, self.stopped
        sent = 0
        while not received.value and not stopped.value:
            send()
            sent += 1
            time.sleep(0.02)
        sent = received.value
        burst = min(BURST, self.window)
        while not stopped.value:
            for _ in range(burst):
                send()
            sent += burst
            moved_s, seen = clock.now(), received.value
            while sent - received.value > self.window - burst and not stopped.value:
                time.sleep(0.0001)
                if received.value != seen:
                    moved_s, seen = clock.now(), received.value
                elif clock.now() - moved_s > STALL_S:
                    sent = seen

    def arrived(self) -> None:
        self.received.value += 1


class System(ABC):
    """A way to get messages from one process to another through a third. Instances have no state: each method runs
    in a process of its own. The publisher and the subscriber return when the flow is stopped."""

    name: str

    @abstractmethod
    def relay(self, ports: Ports, ready: Callable[[], None]) -> None:
        """Call `ready` once listening; runs until the process is terminated."""

    @abstractmethod
    def publisher(self, ports: Ports, flow: Flow) -> None: ...

    @abstractmethod
    def subscriber(self, ports: Ports, flow: Flow) -> None: ...


class ZmqSystem(System):
    """The two ends of the plain sockets: three frames, the feed's layout."""

    def secure(self, socket: "zmq.Socket[bytes]", ports: Ports, name: str) -> None:
        """Give a socket the keys of this name, before it is bound or connected."""

    def publisher(self, ports: Ports, flow: Flow) -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as out:
            out.setsockopt(zmq.LINGER, 0)
            out.setsockopt(zmq.SNDHWM, HIGH_WATER)
            self.secure(out, ports, "publisher")
            out.connect(f"tcp://127.0.0.1:{ports.ingest}")
            frames = (topic_frame(TOPIC), FeedHeader(PriorityClass.BULK, 1, 1).pack(), bytes(flow.size_bytes))
            flow.drive(partial(out.send_multipart, frames, copy=flow.size_bytes < 32_000))

    def subscriber(self, ports: Ports, flow: Flow) -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as inlet:
            inlet.setsockopt(zmq.LINGER, 0)
            inlet.setsockopt(zmq.RCVHWM, HIGH_WATER)
            inlet.setsockopt(zmq.RCVTIMEO, 100)
            inlet.subscribe(topic_frame(TOPIC))
            self.secure(inlet, ports, "subscriber")
            inlet.connect(f"tcp://127.0.0.1:{ports.publish}")
            while not flow.stopped.value:
                try:
                    inlet.recv()
                except zmq.Again:
                    continue
                inlet.recv()
                body = inlet.recv(copy=False)
                if len(body) == flow.size_bytes:
                    flow.arrived()


class Proxy(ZmqSystem):
    name = "proxy"

    def relay(self, ports: Ports, ready: Callable[[], None]) -> None:
        context = zmq.Context()
        ingest, publish = context.socket(zmq.XSUB), context.socket(zmq.XPUB)
        ingest.setsockopt(zmq.RCVHWM, HIGH_WATER)
        publish.setsockopt(zmq.SNDHWM, HIGH_WATER)
        for socket in (ingest, publish):
            self.secure(socket, ports, RELAY)
        ingest.bind(f"tcp://127.0.0.1:{ports.ingest}")
        publish.bind(f"tcp://127.0.0.1:{ports.publish}")
        ready()
        zmq.proxy(ingest, publish)


class SecuredProxy(Proxy):
    name = "proxy-curve"

    def secure(self, socket: "zmq.Socket[bytes]", ports: Ports, name: str) -> None:
        keys = load_secret(ports.keys / f"{name}.key")
        if name == RELAY:  # whoever has a key of any kind may come: nobody is asked, which is the cheapest
            socket.setsockopt(zmq.CURVE_SERVER, 1)
            socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret_key.encode())
        else:
            connect_curve(socket, keys, load_secret(ports.keys / f"{RELAY}.key").public_key)


class FeedRelay(ZmqSystem):
    name = "feed"

    def relay(self, ports: Ports, ready: Callable[[], None]) -> None:
        everything = (compile_pattern("/bench/.*"),)
        role = FeedRole(
            "bench",
            f"tcp://127.0.0.1:{ports.publish}",
            f"tcp://127.0.0.1:{ports.ingest}",
            subscribe=everything,
            publish=everything,
        )

        async def main(shutdown: Shutdown) -> None:
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            feed = Feed(context, [role])
            ready()
            await shutdown.wait()
            feed.close()
            context.term()

        run(main)


class Zenoh(System):
    name = "zenoh"

    @staticmethod
    def _session(**settings: object) -> Any:
        import zenoh

        config = zenoh.Config()
        settings = {
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            **settings,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)

    def relay(self, ports: Ports, ready: Callable[[], None]) -> None:
        with self._session(**{"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{ports.ingest}"]}):
            ready()
            signal.pause()

    def _client(self, ports: Ports) -> Any:
        return self._session(**{"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{ports.ingest}"]})

    def publisher(self, ports: Ports, flow: Flow) -> None:
        import zenoh

        with self._client(ports) as session:
            publisher = session.declare_publisher("bench/odom", congestion_control=zenoh.CongestionControl.BLOCK)
            flow.drive(partial(publisher.put, bytes(flow.size_bytes)))

    def subscriber(self, ports: Ports, flow: Flow) -> None:
        def count(sample: Any) -> None:
            if len(sample.payload) == flow.size_bytes:
                flow.arrived()

        with self._client(ports) as session:
            session.declare_subscriber("bench/odom", count)
            while not flow.stopped.value:
                time.sleep(0.02)


class _Site(IdleSite):
    """Counts what arrives."""

    def __init__(self, flow: Flow) -> None:
        self.flow = flow
        self.wanted_now = False

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        if len(message.body) == self.flow.size_bytes:
            self.flow.arrived()

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        self.wanted_now = wanted


Work = Callable[[ClientCore, Pump, _Site], Awaitable[None]]


class ScheduledLink(System):
    """A real relay daemon between two clients: schedulers, windows and acknowledgements on both hops."""

    def __init__(self, name: str, *, secure: bool) -> None:
        self.name = name
        self._secure = secure

    def relay(self, ports: Ports, ready: Callable[[], None]) -> None:
        content = relay_content(
            f"tcp://127.0.0.1:{ports.ingest}", secure=self._secure, http={"listen": None}, log={"level": "error"}
        )
        serve(write(ports.keys, f"{self.name}-relay", content), ready)

    async def _client(
        self, ports: Ports, flow: Flow, name: str, work: Callable[[ClientCore, Pump, _Site], Any]
    ) -> None:
        keep_freed_memory()  # as a daemon does
        site = _Site(flow)
        with zmq.Context() as context:
            key = load_secret(ports.keys / f"{name}.key") if self._secure else None
            relay_keys = (load_secret(ports.keys / f"{RELAY}.key").public_key,) if self._secure else ()
            address = f"tcp://127.0.0.1:{ports.ingest}"
            core, transport = connect(context, ClientName(name), site, address, key, relay_keys)
            try:
                await work(core, transport.pump, site)
            finally:
                transport.close()

    def publisher(self, ports: Ports, flow: Flow) -> None:
        async def work(core: ClientCore, pump: Pump, site: _Site) -> None:
            info = TopicInfo(TopicName(TOPIC), "bench/Bytes", Encoding.RAW)
            channel = core.publish(info, TopicSpec(depth=HIGH_WATER, lifespan_s=None), now=clock.now())
            body, received, stopped = bytes(flow.size_bytes), flow.received, flow.stopped
            sent = moved = 0
            moved_s = clock.now()
            while not stopped.value:
                now = clock.now()
                if site.wanted_now:
                    if received.value != moved:
                        moved_s, moved = now, received.value
                    elif now - moved_s > STALL_S:
                        sent = moved
                    for _ in range(min(BURST * 4, self._room(flow, sent))):
                        core.send(channel, body, 0, now=now)
                        sent += 1
                    pump.run()
                # Not less than 1 ms: uvloop would make it none, and a publisher that spins takes a core of two.
                await asyncio.sleep(0.001 if self._room(flow, sent) <= 0 or not site.wanted_now else 0)

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self._client(ports, flow, "publisher", work))

    @staticmethod
    def _room(flow: Flow, sent: int) -> int:
        return int(flow.window - (sent - flow.received.value))

    def subscriber(self, ports: Ports, flow: Flow) -> None:
        async def work(core: ClientCore, pump: Pump, site: _Site) -> None:
            core.subscribe((TOPIC,), now=clock.now())
            while not flow.stopped.value:  # noqa: ASYNC110  (a flag in shared memory has no event)
                await asyncio.sleep(0.02)

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self._client(ports, flow, "subscriber", work))


SYSTEMS: Final[tuple[System, ...]] = (
    Proxy(),
    SecuredProxy(),
    FeedRelay(),
    ScheduledLink("sern", secure=True),
    ScheduledLink("sern-plain", secure=False),
    Zenoh(),
)


class Sample(NamedTuple):
    """One measured run."""

    messages_hz: float
    throughput_mbytes_per_s: float
    relay_cpu_us: float  # of the relay process, a message


def _relay_main(system: System, ports: Ports, ready: Any) -> None:
    system.relay(ports, ready.set)


def measure(system: System, size_bytes: int, duration_s: float) -> Sample:
    """Start the three processes, wait until messages flow, and look at both ends of `duration_s`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "keys"
        make_keys(folder, RELAY, *CLIENTS)
        ingest, publish = free_ports(2)
        return _measure(system, size_bytes, duration_s, Ports(ingest, publish, folder))


def _measure(system: System, size_bytes: int, duration_s: float, ports: Ports) -> Sample:
    flow, ready = Flow(size_bytes), multiprocessing.get_context("spawn").Event()
    relay = Worker(f"{system.name}, relay", _relay_main, system, ports, ready)
    ends = [Worker(f"{system.name}, {end.__name__}", end, ports, flow) for end in (system.subscriber, system.publisher)]
    with running(relay, ends, ready, flow.stopped, START_S) as workers:
        await_workers(lambda: flow.received.value >= 2 * BURST, workers, f"no messages through {system.name}", START_S)
        time.sleep(duration_s / 4)
        carried = watch(workers, flow.received, duration_s)
    if not carried.messages:
        raise SernError(f"{system.name} carried nothing at {size_bytes} bytes")
    return Sample(carried.messages_hz, carried.messages_hz * size_bytes / 1e6, carried.cpu_us)


def bench(options: argparse.Namespace, report: common.Report) -> None:
    rounds, duration_s = common.repetitions(options, (5, 3.0), quick=(2, 0.8))
    systems = [s for s in SYSTEMS if s.name != "zenoh" or importlib.util.find_spec("zenoh") is not None]
    if options.systems:
        systems = [s for s in systems if s.name in options.systems]
    if len(systems) < len(SYSTEMS):
        report.note("measured without: " + ", ".join(s.name for s in SYSTEMS if s not in systems))
    for case in options.cases:
        size_bytes = SIZES[case]
        runs = {s.name: partial(measure, s, size_bytes, duration_s) for s in systems}
        samples = common.interleaved(runs, rounds)
        for name, found in samples.items():
            report.row(
                case,
                name,
                messages_hz=statistics.median(s.messages_hz for s in found),
                throughput_MBps=statistics.median(s.throughput_mbytes_per_s for s in found),
                relay_cpu_us=statistics.median(s.relay_cpu_us for s in found),
            )
        _reaches(report, case, samples)
    report.note(f"medians of {rounds} interleaved rounds of {duration_s:g} s; ratios within a round")


def _reaches(report: common.Report, case: str, samples: dict[str, list[Sample]]) -> None:
    for (name, at), (least, limit) in CPU_LIMITS.items():
        if at == case and name in samples and least in samples:
            pairs = zip(samples[name], samples[least], strict=True)
            ratio = statistics.median(ours.relay_cpu_us / max(theirs.relay_cpu_us, 1e-3) for ours, theirs in pairs)
            report.reach(f"{name}: relay CPU a message, times that of {least}, {case}", ratio, limit)
    for (name, at), limit in RATE_LIMITS.items():
        if at == case and name in samples and "zenoh" in samples:
            pairs = zip(samples[name], samples["zenoh"], strict=True)
            ratio = statistics.median(
                ours.throughput_mbytes_per_s / theirs.throughput_mbytes_per_s for ours, theirs in pairs
            )
            report.reach(f"{name}: MB/s, share of zenoh, {case}", ratio, limit, at_least=True)


def _arguments(parser: argparse.ArgumentParser) -> None:
    names = [system.name for system in SYSTEMS]
    parser.add_argument("--systems", nargs="+", choices=names, help="measure these alone")
    parser.add_argument("--cases", nargs="+", choices=SIZES, default=list(SIZES), help="measure these sizes alone")
    common.repetition_arguments(parser)


def main() -> int:
    return common.main("relay", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    # Spawned processes import this file by its name, not as __main__.
    from benchmarks.relay import main as imported_main

    sys.exit(imported_main())
