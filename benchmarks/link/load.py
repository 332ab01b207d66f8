"""What is offered, message by message, and what the two ends write down about it.

Every message begins with its kind, its number (from 1; 0 is a hello before the run) and the time at which it was
handed to the system, by the host's monotonic clock, which all network namespaces share.
"""

import asyncio
import json
import os
import random
import select
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from heapq import merge
from pathlib import Path
from struct import Struct
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

READY: Final = b"ready"
HELLO: Final = 0
HELLO_PERIOD_S: Final = 0.05
POLL_S: Final = 0.02
JITTER_S: Final = 0.020
"""Large messages come up to so much later than their period says, or each would always meet the same poses."""
_HEAD: Final = Struct("!BIQ")

Records = NDArray[np.int64]


class Kind(IntEnum):
    """Most urgent first; the values of the first three are those of `PriorityClass`."""

    POSE = 0
    MAP = 1
    BULK = 2
    FLOOD = 3
    """Class control as well, as much of it as the case wants."""


class Flow(NamedTuple):
    kind: Kind
    rate_hz: float
    size_bytes: int


POSES: Final = Flow(Kind.POSE, 50.0, 100)
MAPS: Final = Flow(Kind.MAP, 5.0, 20_000)
HEARTBEATS: Final = Flow(Kind.POSE, 10.0, 50)
FLOOD_BYTES: Final = 1000
FLOOD_PAUSE_S: Final = 0.002
"""Several are offered at once rather than a processor kept busy: a loop's timers are no finer than a millisecond."""


@dataclass(frozen=True)
class Load:
    """Poses at 50 Hz; beside them clouds, unless `cloud_bytes` is 0, and `maps`. With `flood_bps` heartbeats in place
    of the poses, and messages of the same class beside them. With `even_hz` messages of `even_bytes` alone, as evenly
    as they can be sent."""

    cloud_bytes: int = 0
    cloud_hz: float = 10.0
    maps: bool = True
    seed: int = 1
    flood_bps: float = 0.0
    even_hz: float = 0.0
    even_bytes: int = 0

    @property
    def flows(self) -> tuple[Flow, ...]:
        if self.even_hz:
            return (Flow(Kind.POSE, self.even_hz, self.even_bytes),)
        if self.flood_bps:
            flood = Flow(Kind.FLOOD, self.flood_bps / (8 * FLOOD_BYTES), FLOOD_BYTES)
            return (HEARTBEATS, flood, *self._clouds)
        return (POSES, *((MAPS,) if self.maps else ()), *self._clouds) if self.cloud_bytes else (POSES,)

    @property
    def _clouds(self) -> tuple[Flow, ...]:
        return (Flow(Kind.BULK, self.cloud_hz, self.cloud_bytes),) if self.cloud_bytes else ()

    def schedule(self, duration_s: float) -> Iterator[tuple[float, Flow, int]]:
        """(seconds since the start, flow, number), in order of time."""
        return merge(*(self._times(flow, duration_s) for flow in self.flows), key=lambda item: item[0])

    def _times(self, flow: Flow, duration_s: float) -> Iterator[tuple[float, Flow, int]]:
        chance = random.Random(f"{self.seed} {flow.kind}")
        for number in range(1, int(duration_s * flow.rate_hz) + 1):
            late_s = chance.random() * JITTER_S if flow.kind in (Kind.MAP, Kind.BULK) else 0.0
            yield (number - 1) / flow.rate_hz + late_s, flow, number


class Log:
    """What one end saw: rows of kind, number, stamp, time and size; `COLUMNS` names them. Times in ns."""

    COLUMNS: Final = ("kind", "number", "stamp_ns", "at_ns", "nbytes")

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, int, int]] = []
        self.heard = False

    def sent(self, flow: Flow, number: int, stamp_ns: int, due_ns: int) -> None:
        self.rows.append((flow.kind, number, stamp_ns, due_ns, flow.size_bytes))

    def arrived(self, body: bytes | memoryview) -> None:
        at_ns = time.monotonic_ns()
        kind, number, stamp_ns = _HEAD.unpack_from(body)
        if number == HELLO:
            self.heard = True
        else:
            self.rows.append((kind, number, stamp_ns, at_ns, len(body)))

    def save(self, path: Path) -> None:
        np.save(path, np.array(self.rows, dtype=np.int64).reshape(-1, len(self.COLUMNS)))


def read_log(path: Path) -> Records:
    """Shape (messages, len(Log.COLUMNS))."""
    records: Records = np.load(path)
    return records


class Send(Protocol):
    """Hands one message to the system."""

    def __call__(self, kind: Kind, body: bytes) -> object: ...


class Orders:
    """What the benchmark says on standard input: one line `go START_NS`; its end is the order to stop."""

    def __init__(self) -> None:
        self._text = b""
        self.start_ns: int | None = None
        self.stopped = False

    def poll(self) -> None:
        while not self.stopped and select.select([0], [], [], 0)[0]:
            data = os.read(0, 4096)
            self.stopped = not data
            self._text += data
            line, newline, rest = self._text.partition(b"\n")
            if newline:
                self._text = rest
                self.start_ns = int(line.split()[1])


def ready() -> None:
    """Tell the benchmark that this end works."""
    os.write(1, READY + b"\n")


async def take_all(orders: Orders, log: Log) -> None:
    """Say `ready` once something has arrived, and return when the run is over."""
    said = False
    while not orders.stopped:
        await asyncio.sleep(POLL_S)
        if log.heard and not said:
            said = True
            ready()
        orders.poll()


def offer(load: Load, duration_s: float, orders: Orders, log: Log, send: Send) -> Iterator[float]:
    """The sender's life, as pauses in seconds for its caller to keep: hellos until told to go, the load, the end."""
    hello = _HEAD.pack(Kind.POSE, HELLO, 0).ljust(POSES.size_bytes, b"\0")
    while orders.start_ns is None and not orders.stopped:
        send(Kind.POSE, hello)
        yield HELLO_PERIOD_S
        orders.poll()
    padding = {flow.kind: os.urandom(flow.size_bytes - _HEAD.size) for flow in load.flows}
    start_ns = orders.start_ns or 0
    least_s = FLOOD_PAUSE_S if load.flood_bps else 0.0
    for at_s, flow, number in load.schedule(duration_s):
        if orders.stopped:
            return
        due_ns = start_ns + int(at_s * 1e9)
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            yield max(left_ns / 1e9, least_s)
        stamp_ns = time.monotonic_ns()
        log.sent(flow, number, stamp_ns, due_ns)
        send(flow.kind, _HEAD.pack(flow.kind, number, stamp_ns) + padding[flow.kind])
    while not orders.stopped:
        yield HELLO_PERIOD_S
        orders.poll()


@dataclass(frozen=True)
class Spec:
    """What an end is told, as JSON: which system, which role, where, and what to do."""

    system: str
    sends: bool
    address: str
    """The address of the site."""
    own_address: str
    directory: str
    duration_s: float
    load: dict[str, Any]

    @property
    def path(self) -> Path:
        return Path(self.directory)

    @property
    def role(self) -> str:
        return "robot" if self.sends else "site"


End = Callable[[Spec, Load, Orders, Log], dict[str, Any]]
"""One end of a system: plays its part until it is told to stop, and returns what it saw beside the messages."""


def play(ends: Mapping[str, tuple[End, End]]) -> None:
    """Be the end that the first argument says: of a system its sender or its receiver."""
    spec = Spec(**json.loads(sys.argv[1]))
    sender, receiver = ends[spec.system]
    log = Log()
    seen = (sender if spec.sends else receiver)(spec, Load(**spec.load), Orders(), log)
    log.save(spec.path / f"{spec.role}.npy")
    (spec.path / f"{spec.role}.json").write_text(json.dumps(seen))
