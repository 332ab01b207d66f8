"""A relay in a process of its own and clients in others, over loopback: what `relay` and `robots` share."""

import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import zmq

from benchmarks.child import Worker, await_workers
from sern_client.connection import Connection
from sern_client.transport import RelayTransport
from sern_core.path.lanes import LANE_NAMES
from sern_core.site.client import ClientCore
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire import framing
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock, logs
from sern_runtime.config.client import RelayConnection
from sern_runtime.config.keys import SecretKey, load_public, load_secret
from sern_runtime.config.relay import load_relay
from sern_runtime.config.shared import LinkSection
from sern_runtime.loop import Shutdown, run
from sern_tools.harness.files import RELAY


class IdleSite:
    """The shell of a client core in a benchmark: it answers nothing."""

    def link_up(self, *, resumed: bool) -> None: ...

    def link_down(self, reason: str) -> None: ...

    def lane_offered(self, parameters: framing.Envelope) -> None: ...

    def lane_closed(self) -> None: ...

    def keys_told(self, keys: RelayKeys) -> None: ...

    def rejected(self, code: str, text: str) -> None: ...

    def stream_opened(self, stream: StreamInfo) -> None: ...

    def stream_closed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None: ...

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None: ...

    def skipped(self, stream: StreamInfo, count: int) -> None: ...

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None: ...

    def wanted(self, stream: StreamInfo, wanted: bool) -> None: ...

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None: ...

    def undecodable(self, stream: StreamInfo, problem: str) -> None: ...

    def fault(self, error: Exception) -> None:
        raise SystemExit(f"an internal error: {error!r}")

    def object_refused(self, object_id: str, code: str, why: str) -> None: ...

    def subscription_refused(self, code: str, text: str) -> None: ...


def serve(config: Path, ready: Callable[[], object]) -> None:
    """A real relay daemon until SIGTERM; `ready` once it listens."""

    async def main(shutdown: Shutdown) -> None:
        daemon = RelayDaemon(load_relay(config))
        try:
            await daemon.start()
            ready()
            await shutdown.wait()
        finally:
            await daemon.stop()

    logs.configure(level="ERROR")
    run(main)


def connect(
    context: "zmq.Context[zmq.Socket[bytes]]",
    name: ClientName,
    events: IdleSite,
    address: str,
    key: SecretKey | None = None,
    server_keys: Sequence[str] = (),
) -> tuple[ClientCore, RelayTransport]:
    """A client's core with a transport of its own, which the caller closes; without a `key` no CURVE."""
    core = ClientCore(
        name=name,
        boot=random.getrandbits(63),
        events=events,
        link=LinkParams(),
        scheduler=SchedulerParams(),
        now=clock.now(),
    )
    transport = RelayTransport(
        context,
        core.link,
        address,
        key,
        server_keys,
        heartbeat_timeout_s=5.0,
        random=random.Random(1),
        on_reason=lambda _reason: None,
    )
    return core, transport


class Member(IdleSite):
    """A client's core with all the connections that its daemon would give it, with keys. `tick` twice a second."""

    def __init__(
        self,
        context: "zmq.Context[zmq.Socket[bytes]]",
        folder: Path,
        address: str,
        name: ClientName,
        *,
        udp: bool,
        relay: str = RELAY,
    ) -> None:
        """Its keys and those of `relay` are in `folder`. `udp`: whether it asks for the datagram lane."""
        link = LinkSection()
        section = RelayConnection(endpoint=address, server_key_file="-", secret_key_file="-", udp=udp)
        self.core = ClientCore(
            name=name,
            boot=random.getrandbits(63),
            events=self,
            link=link.params(),
            scheduler=SchedulerParams(),
            now=clock.now(),
        )
        self.connection = Connection(self.core, section, link, on_down=lambda _reason: None)
        valid = load_public(folder / f"{relay}.pub").valid_at(time.time())
        self.connection.open(context, load_secret(folder / f"{name}.key"), [key.key for key in valid])

    @property
    def lane(self) -> str:
        """Which lane its data takes now: a name of LANE_NAMES."""
        return LANE_NAMES[self.core.link.lanes.lane.id]

    def link_up(self, *, resumed: bool) -> None:
        self.connection.session_began()

    def lane_offered(self, parameters: framing.Envelope) -> None:
        self.connection.lane_offered(parameters)

    def lane_closed(self) -> None:
        self.connection.lane_closed()

    def keys_told(self, keys: RelayKeys) -> None: ...


@contextmanager
def running(
    relay: Worker, ends: Sequence[Worker], ready: Event, stopped: Any, within_s: float
) -> Iterator[tuple[Worker, ...]]:
    """The relay and, once it is `ready`, the ends: they end by themselves when `stopped` is set, which it is in the
    end."""
    workers = (relay, *ends)
    try:
        relay.start()
        await_workers(ready.is_set, workers, f"{relay.name} did not start", within_s)
        for worker in ends:
            worker.start()
        yield workers
    finally:
        stopped.value = True
        for worker in ends:
            worker.end(patient=True)
        relay.end(patient=False)


class Carried(NamedTuple):
    """What a relay did for some time. `cpu_s`: its process's, all threads; `rss_bytes`: its memory, afterwards."""

    messages: int
    seconds: float
    cpu_s: float
    rss_bytes: int

    @property
    def messages_hz(self) -> float:
        return self.messages / self.seconds

    @property
    def cpu_us(self) -> float:
        """CPU for each message."""
        return self.cpu_s / self.messages * 1e6


def watch(workers: Sequence[Worker], received: Any, duration_s: float, measuring: Any = None) -> Carried:
    """Look at `received` and at the first of the workers, the relay, before and after `duration_s`, during which
    `measuring` is set. SernError when one of them has ended."""
    watched = psutil.Process(workers[0].pid)
    start_s, start, start_cpu_s = clock.now(), received.value, _cpu_s(watched)
    if measuring is not None:
        measuring.value = True
    time.sleep(duration_s)
    if measuring is not None:
        measuring.value = False
    for worker in workers:
        worker.check()
    end_s, end, end_cpu_s = clock.now(), received.value, _cpu_s(watched)
    return Carried(end - start, end_s - start_s, end_cpu_s - start_cpu_s, watched.memory_info().rss)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)
