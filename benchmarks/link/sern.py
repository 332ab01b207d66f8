"""SERN's ends: the client's core, its lanes and its keys as the daemon joins them, without an endpoint in front."""

import asyncio
import random
import time
from collections.abc import Callable
from typing import Any, Final

import uvloop
import zmq

from benchmarks.link.load import HELLO_PERIOD_S, Kind, Load, Log, Orders, Spec, offer, ready
from sern_client.daemon import TICK_S
from sern_client.priority_lane import ClientPriorityLane
from sern_client.transport import RelayTransport
from sern_client.udp import ClientLane
from sern_core.site.client import ClientCore
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import KAPPA, Message, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_core.wire import framing
from sern_runtime import clock, logs
from sern_runtime.config.keys import load_public, load_secret
from sern_runtime.topics_view import both_ways

RELAY_PORT: Final = 5555
SAMPLE_S: Final = 0.02
"""How often the sender writes down what its link thinks."""
LIFESPANS_S: Final = {Kind.POSE: 1.0, Kind.MAP: 5.0, Kind.BULK: 5.0, Kind.FLOOD: 1.0}
CLASSES: Final = {
    Kind.POSE: PriorityClass.CONTROL,
    Kind.MAP: PriorityClass.STATE,
    Kind.BULK: PriorityClass.BULK,
    Kind.FLOOD: PriorityClass.CONTROL,
}
TOPICS: Final = {kind: TopicName(f"/bench/{kind.name.lower()}") for kind in Kind}
SAMPLE_COLUMNS: Final = ("at_ns", "rate_bps", "window_bytes", "inflight_bytes", "srtt_s", "queue_s", "udp", "stalled")


class End:
    """One client. What it is told goes into `log`."""

    def __init__(self, spec: Spec, log: Log) -> None:
        self.spec = spec
        self.log = log
        self.samples: list[tuple[float, ...]] = []
        self.wanted_topics: set[str] = set()
        self.problems: list[str] = []
        self.core = ClientCore(
            name=ClientName(spec.role),
            boot=random.getrandbits(63),
            events=self,
            link=LinkParams(),
            scheduler=SchedulerParams(),
            now=clock.now(),
        )
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._lane: ClientLane | None = None
        if spec.system == "sern-udp":
            self._lane = ClientLane(self.core, spec.address, kick=self.kick)
        server = load_public(spec.path / "relay.pub")
        self._transport = RelayTransport(
            self._context,
            self.core.link,
            f"tcp://{spec.address}:{RELAY_PORT}",
            load_secret(spec.path / f"{spec.role}.key"),
            tuple(key.key for key in server.valid_at(time.time())),
            heartbeat_timeout_s=LinkParams().heartbeat_timeout_s,
            random=random.Random(1),
            on_reason=self.problems.append,
            after=self.kick,
        )
        self._priority_lane = ClientPriorityLane(
            self.core, self._transport, LinkParams().redundancy, datagrams=self._lane is not None, kick=self.kick
        )

    def kick(self) -> None:
        self._transport.pump.kick()
        self._priority_lane.kick()
        if self._lane is not None:
            self._lane.kick()

    @property
    def connected(self) -> bool:
        """Whether it is connected over the lane that is to be measured."""
        link = self.core.link
        if self.spec.system == "sern-one":
            return link.established
        if self._lane is None:
            return link.established and link.lanes.priority_lane is not None
        return link.established and link.lane.name == "udp"

    async def tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            if self._lane is not None:
                self._lane.tick()
            if self.spec.system != "sern-one":
                self._priority_lane.tick()

    async def sample(self) -> None:
        while True:
            await asyncio.sleep(SAMPLE_S)
            lane = self.core.link.lane
            estimator, flight = lane.estimator, lane.flight
            queue_s = estimator.snapshot().get("queue_s") or 0.0
            self.samples.append(
                (
                    time.monotonic_ns(),
                    estimator.rate_bps or 0.0,
                    estimator.window_bytes,
                    flight.inflight_bytes,
                    flight.rtt.srtt_s,
                    queue_s,
                    lane.name == "udp",
                    lane.stalled,
                )
            )

    def close(self) -> None:
        self._priority_lane.close()
        self._transport.close()
        if self._lane is not None:
            self._lane.closed()
        self._context.destroy(linger=0)

    # --- ClientEvents -------------------------------------------------------------------------------------------------

    def link_up(self, *, resumed: bool) -> None:
        if self._lane is not None:
            self._lane.ask()
        self._priority_lane.begin()

    def link_down(self, reason: str) -> None:
        self.problems.append(reason)

    def rejected(self, code: str, text: str) -> None:
        self.problems.append(text)

    def lane_offered(self, parameters: framing.Envelope) -> None:
        if self._lane is not None:
            self._lane.offered(parameters)
        if self.spec.sends:  # for an attacker who has seen it on the wire, where it is in clear
            (self.spec.path / "session").write_text(str(parameters["sid"]))

    def lane_closed(self) -> None:
        if self._lane is not None:
            self._lane.closed()

    def keys_told(self, keys: RelayKeys) -> None: ...

    def stream_opened(self, stream: StreamInfo) -> None: ...

    def stream_closed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self.log.arrived(message.body)

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None: ...

    def skipped(self, stream: StreamInfo, count: int) -> None: ...

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        """The link's counters have it."""

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        if wanted:
            self.wanted_topics.add(stream.id.topic)

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        self.problems.append(text)

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        self.problems.append(problem)

    def fault(self, error: Exception) -> None:
        self.problems.append(repr(error))

    def object_refused(self, object_id: str, code: str, why: str) -> None:
        self.problems.append(why)

    def subscription_refused(self, code: str, text: str) -> None:
        self.problems.append(text)

    # --- result -------------------------------------------------------------------------------------------------------

    def seen(self) -> dict[str, Any]:
        topics = both_ways(self.core.link, self.core.received, now=clock.now())
        return {"samples": self.samples, "topics": topics, "problems": self.problems}


async def _send(end: End, load: Load, orders: Orders) -> None:
    channels = {
        flow.kind: end.core.publish(
            TopicInfo(TOPICS[flow.kind], "bench/Bytes", Encoding.RAW),
            TopicSpec(
                priority=CLASSES[flow.kind],
                weight=KAPPA[CLASSES[flow.kind]],
                lifespan_s=LIFESPANS_S[flow.kind],
            ),
            now=clock.now(),
        )
        for flow in load.flows
    }

    def send(kind: Kind, body: bytes) -> None:
        end.core.send(channels[kind], body, 0, now=clock.now())
        end.kick()

    await _until(lambda: end.connected and len(end.wanted_topics) == len(channels), orders)
    ready()
    sampling = asyncio.create_task(end.sample())
    for pause_s in offer(load, end.spec.duration_s, orders, end.log, send):
        await asyncio.sleep(pause_s)
    sampling.cancel()


async def _receive(end: End, load: Load, orders: Orders) -> None:
    end.core.subscribe(("/bench/.*",), now=clock.now())
    await _until(lambda: end.connected and end.log.heard, orders)
    ready()
    await _until(lambda: False, orders)


async def _until(condition: Callable[[], bool], orders: Orders) -> None:
    while not condition() and not orders.stopped:
        await asyncio.sleep(HELLO_PERIOD_S)
        orders.poll()


def _run(spec: Spec, load: Load, orders: Orders, log: Log, work: Any) -> dict[str, Any]:
    async def life() -> dict[str, Any]:
        end = End(spec, log)
        ticking = asyncio.create_task(end.tick())
        try:
            await work(end, load, orders)
        finally:
            ticking.cancel()
            end.close()
        return end.seen()

    logs.configure(level="ERROR")
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(life())


def sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    return _run(spec, load, orders, log, _send)


def receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    return _run(spec, load, orders, log, _receive)
