"""Ends connections on which bytes arrive and no message ever does.

libzmq bounds the size of a frame and counts the messages of a pipe, but has no bound for the frames of one message: it
keeps them all, 64 bytes and more for each, and hands over none before the last. So nothing that reads messages can
count them in time: a message of two million frames costs 130 to 270 MB in libzmq's own thread. What does show is the
kernel's count of the bytes that were read from a connection: a SERN datagram is one frame of at most 64 KiB, so where
more than `limit_bytes` were read since the last message came out, no message of ours is on its way, and the connection
is cut; libzmq then throws the frames away.

What the C library keeps of them is bounded (`keep_little_memory`), and given back to the system (`trim_memory`).
"""

import asyncio
import ctypes
import resource
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar

from sern_runtime.clock import now

LIMIT_BYTES: Final = 256 * 1024
"""Four of the largest datagrams."""
PERIOD_S: Final = 0.05
"""Between two looks. In that time a connection can bring some 100 000 tiny frames, about 10 MB of memory."""
LOOK_S: Final = 3e-6
"""What a look at one connection takes; the period grows with their number so that looking takes below 1 %."""
SHARE: Final = 0.005
FORGIVEN_BYTES_PER_S: Final = 1024.0
"""Heartbeats of an idle connection: they bring bytes and no message."""
TRIM_AFTER_S: Final = (1.0, 4.0, 16.0)
"""From one time to the next."""
KEPT_BYTES: Final = 8 * 2**20
"""Free memory at the end of a thread's heap above which glibc gives it back."""
MAPPED_BYTES: Final = 4 * 2**20
"""From this size on glibc maps a block by itself and gives it back when it is freed."""
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3


class Handle(Protocol):
    """A TCP connection that belongs to libzmq; `sern_runtime.monitor.TcpHandle`."""

    def read_bytes(self) -> int | None: ...

    def cut(self) -> bool: ...


H = TypeVar("H", bound=Handle)


class Socket(Protocol):
    """What reads the connections; `sern_runtime.zmq_socket.DrainedSocket`."""

    messages: int
    emptied: int

    def drain(self) -> None: ...


class _Look:
    """What was seen of one connection."""

    __slots__ = ("base_bytes", "read_bytes", "taken")

    def __init__(self, taken: int, read_bytes: int, *, since: int) -> None:
        self.taken = taken  # messages that have come out of it
        self.base_bytes = float(since)  # what had been read when the last of them was seen
        self.read_bytes = read_bytes  # what had been read at the last look


class Inflow(Generic[H]):
    """Looks at the connections of a socket. `connections` says which there are, each with the messages that came out
    of it; `on_endless` is told of one before it is cut. `close` before the socket.
    """

    def __init__(
        self,
        socket: Socket,
        connections: Callable[[], Iterable[tuple[H, int]]],
        on_endless: Callable[[H], None],
        *,
        limit_bytes: int = LIMIT_BYTES,
        period_s: float = PERIOD_S,
        clock: Callable[[], float] = now,
    ) -> None:
        keep_little_memory()
        self.endless = 0
        """Connections that were cut."""
        self.suspects: set[H] = set()
        """Connections that are held to `LIMIT_BYTES` whatever the limit of the others; set in `connections`."""
        self._socket = socket
        self._connections = connections
        self._on_endless = on_endless
        self._limit_bytes = limit_bytes
        self._period_s = period_s
        self._loop = asyncio.get_running_loop()
        self._clock = clock
        self._at_s = clock()
        self._progress = socket.emptied, socket.messages
        self._seen: dict[H, _Look] = {}
        self._ended: set[H] = set()
        self._timer: asyncio.TimerHandle | None = self._loop.call_later(period_s, self._tick)

    def close(self) -> None:
        """Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self.look(now=self._clock())
        period_s = max(self._period_s, len(self._seen) * LOOK_S / SHARE)
        self._timer = self._loop.call_later(period_s, self._tick)

    def look(self, *, now: float) -> None:
        """Look at every connection once.

        What had been read at the last look is compared with the messages that have come out by this one, and only when
        each connection had its turn in between: what waits for us in libzmq is not the connection's fault.
        """
        self._socket.drain()
        emptied, messages = self._progress
        if self._socket.emptied == emptied and self._socket.messages - messages < 2 * len(self._seen):
            return
        self._progress = self._socket.emptied, self._socket.messages
        forgiven = (now - self._at_s) * FORGIVEN_BYTES_PER_S
        self._at_s = now
        seen: dict[H, _Look] = {}
        ended: set[H] = set()
        for handle, taken in list(self._connections()):
            if handle in self._ended:
                ended.add(handle)  # libzmq reads on what had arrived, and lists it until then
                continue
            read_bytes = handle.read_bytes()
            if read_bytes is None:
                continue
            known = self._seen.get(handle)
            if known is None or known.taken != taken:
                seen[handle] = _Look(taken, read_bytes, since=read_bytes if taken else 0)
                continue
            known.base_bytes = min(known.base_bytes + forgiven, float(read_bytes))
            limit_bytes = LIMIT_BYTES if handle in self.suspects else self._limit_bytes
            if known.read_bytes - known.base_bytes > limit_bytes:
                self.endless += 1
                self._on_endless(handle)
                handle.cut()
                trim_memory()
                ended.add(handle)
                continue
            known.read_bytes = read_bytes
            seen[handle] = known
        self._seen = seen
        self._ended = ended


def resident_bytes() -> int:
    """Memory of this process; 0 where the system does not say. Takes some 10 µs."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


class Trimmer:
    """Asks the C library to give freed memory back to the system, beside the loop and several times: libzmq frees what
    it had read of a connection in a thread of its own, on a busy machine long after the connection was cut.
    """

    def __init__(self, trim: Callable[[], object], sleep: Callable[[float], object] = time.sleep) -> None:
        self._trim = trim
        self._sleep = sleep
        self._lock = threading.Lock()
        self._delays_s: list[float] = []
        self._running = False

    def __call__(self) -> None:
        """Trim after each of `TRIM_AFTER_S`, counted anew when called again meanwhile."""
        with self._lock:
            self._delays_s = list(TRIM_AFTER_S)
            if self._running:
                return
            self._running = True
        threading.Thread(target=self._run, name="trim-memory", daemon=True).start()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._delays_s:
                    self._running = False
                    return
                delay_s = self._delays_s.pop(0)
            self._sleep(delay_s)
            self._trim()


def keep_little_memory() -> None:
    """Keep glibc from raising its bounds. Idempotent; nothing with another C library.

    Whenever a large block is freed it keeps twice as much as that, up to 64 MiB, at the end of each heap of a thread,
    where `malloc_trim` does not reach.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "gnu_get_libc_version"):
        library.mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
        library.mallopt(_M_MMAP_THRESHOLD, MAPPED_BYTES)


def _malloc_trim() -> None:
    """Nothing where the C library has no such function."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


trim_memory: Final = Trimmer(_malloc_trim)
"""The one of this process."""
