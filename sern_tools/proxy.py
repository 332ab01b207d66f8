"""A proxy that makes a good link bad, fairly: the same badness for whoever is measured through it.

Bytes of all connections in one direction, and datagrams beside them (`--udp`), share one bottleneck (`shaping.Shaper`):
rate over time, delay, jitter, and a queue of 100 packets. When the queue is full datagrams are dropped, and the proxy
stops reading from connections; its socket buffers are fixed and small, so that a sender feels the link within a few
hundred milliseconds instead of hiding seconds of data in the kernel. The segment size is clamped to Ethernet's, because
on loopback a 64 kB segment lets the *sender's* buffer grow to megabytes. A blackout freezes bytes, datagrams and new
connections alike; established connections stay open and go on after it.

What it cannot show: packet loss under TCP. Those bytes are a stream, so the loss of a profile is applied to datagrams
only, and TCP's own loss recovery is not represented. Tests with tc netem do that.

Run as a process:  python -m sern_tools.proxy --listen 127.0.0.1:0 --target 127.0.0.1:5555 --profile demo --seed 1
It prints one JSON line when ready, and answers one JSON line per line on its control port:
{"do": "start", "at_s": <CLOCK_MONOTONIC>} puts time 0 of the profile there (until then the first rate holds);
{"do": "stats"} returns bytes carried over time.
"""

import argparse
import asyncio
import contextlib
import errno
import json
import math
import resource
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Final, Self

from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel
from sern_sim.profiles import LinkProfile
from sern_tools.proxy_datagrams import DatagramRoute, Loss
from sern_tools.shaping import SLOT_BYTES, Shaper

SOCKET_BUFFER_BYTES: Final = 32 * 1024
"""SO_RCVBUF and SO_SNDBUF as requested; the kernel doubles it for bookkeeping, so 64 kB in all."""
SEGMENT_BYTES: Final = 1448
"""TCP_MAXSEG: what an Ethernet path would use."""
UNDELIVERED_BYTES: Final = 64 * 1024
"""When a receiver leaves this much unread, the proxy stops reading from its sender."""
EARLY_S: Final = 0.0005
"""What is due within this time goes with the current burst: timers are no finer than a millisecond."""
READ_PACKETS: Final = 4
"""Packets one connection may take in a row before the next one has its turn."""
PORT_TRIES: Final = 32
"""Ports of the kernel's choice that are tried until one is free for connections and for datagrams."""
STATISTICS_BUCKET_S: Final = 0.1
NOT_STARTED_S: Final = 1e6
"""Before `start`, time 0 of the schedule lies this far ahead."""
FIN_BYTES: Final = 20
"""What closing a direction costs on the link, before the model's own overhead."""


@dataclass(frozen=True)
class Route:
    """Connections to `listen` end at `target`; port 0 in `listen` is chosen by the kernel."""

    listen: tuple[str, int]
    target: tuple[str, int]


class _Pipe:
    """One direction of one connection: what was read at `source` is written, later, to `sink`."""

    __slots__ = ("closed", "connection", "dead", "eof_pending", "finished", "out", "reading", "sink", "source")

    def __init__(self, connection: "_Connection", source: socket.socket, sink: socket.socket) -> None:
        self.connection = connection
        self.source = source
        self.sink = sink
        self.out = bytearray()  # arrived, not yet taken by the sink's kernel buffer
        self.reading = False  # has a reader registered
        self.eof_pending = False  # the end of the stream has arrived behind `out`
        self.finished = False  # the end has been passed on to the sink
        self.closed = False  # nothing more will be read from the source
        self.dead = False  # the sink is gone: what arrives is discarded


@dataclass(eq=False)
class _Connection:
    client: socket.socket
    server: socket.socket
    pipes: dict[str, _Pipe] = field(default_factory=dict)
    connected: bool = False
    ended: int = 0  # directions whose end has been delivered


class _Direction:
    """Everything that moves one way: the shaper, the packets on their way, the pipes that wait to be read."""

    def __init__(self, proxy: "ShapingProxy", shaper: Shaper, loss_seed: str) -> None:
        self.proxy = proxy
        self.shaper = shaper
        self.line: deque[tuple[float, _Pipe | Callable[[bytes], None], bytes | None]] = deque()
        """(arrival, pipe, bytes or end); of a datagram: what delivers it."""
        self.loss = Loss(shaper.model, Random(loss_seed))
        self.datagrams = self.datagrams_dropped = self.datagrams_lost = 0
        self.waiting: deque[_Pipe] = deque()  # pipes whose reading is paused for want of a slot
        self.delivered_bytes = 0
        self.buckets: dict[int, int] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._resume: asyncio.TimerHandle | None = None

    # -- reading ---------------------------------------------------------------------------------------------------

    def want(self, pipe: _Pipe) -> None:
        """Read from this pipe when the queue has room."""
        if pipe.closed or pipe.reading or pipe in self.waiting or len(pipe.out) >= UNDELIVERED_BYTES:
            return
        if self.shaper.free_slots(time.monotonic()) > 0:
            pipe.reading = True
            self.proxy.loop.add_reader(pipe.source, self._readable, pipe)
        else:
            self.waiting.append(pipe)
            self._arm_resume()

    def pause(self, pipe: _Pipe) -> None:
        if pipe.reading:
            pipe.reading = False
            self.proxy.loop.remove_reader(pipe.source)
        if pipe in self.waiting:
            self.waiting.remove(pipe)

    def _readable(self, pipe: _Pipe) -> None:
        now = time.monotonic()
        shaper = self.shaper
        slots = shaper.free_slots(now)
        if slots > 0:
            try:
                data = pipe.source.recv(min(slots, READ_PACKETS) * SLOT_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                data = b""  # a reset: the far side sees the end of the stream, after the same delay
            if not data:
                self.pause(pipe)
                pipe.closed = True
                self._put(shaper.admit(FIN_BYTES, now), pipe, None)
                return
            for start in range(0, len(data), SLOT_BYTES):
                chunk = data[start : start + SLOT_BYTES]
                self._put(shaper.admit(len(chunk), now), pipe, chunk)
            slots = shaper.free_slots(now)
        if slots <= 0:
            for connection in self.proxy.connections:
                for other in connection.pipes.values():
                    if other.reading and self.proxy.direction_of(other) is self:
                        self.pause(other)
                        if other is not pipe:
                            self.waiting.append(other)
            self.waiting.append(pipe)  # last in line: it has just been served
            self._arm_resume()

    def _arm_resume(self) -> None:
        if self._resume is not None:
            return
        now = time.monotonic()
        at = self.shaper.when_free(min(READ_PACKETS, self.shaper.slots), now)
        if math.isfinite(at):
            self._resume = self.proxy.loop.call_later(max(0.0, at - now), self._resume_reading)

    def _resume_reading(self) -> None:
        self._resume = None
        waiting, self.waiting = self.waiting, deque()
        for pipe in waiting:
            self.want(pipe)

    # -- delivering ------------------------------------------------------------------------------------------------

    def carry(self, datagram: bytes, deliver: Callable[[bytes], None]) -> None:
        """Queue a datagram; dropped where the queue is full, lost behind the bottleneck where the model says so."""
        now = time.monotonic()
        self.datagrams += 1
        if self.shaper.free_slots(now) <= 0:
            self.datagrams_dropped += 1
            return
        arrival = self.shaper.admit(len(datagram), now)
        if self.loss.strikes():
            self.datagrams_lost += 1
        else:
            self._put(arrival, deliver, datagram)

    def _put(self, arrival: float, pipe: _Pipe | Callable[[bytes], None], chunk: bytes | None) -> None:
        self.line.append((arrival, pipe, chunk))
        if self._timer is None:
            self._arm()

    def _arm(self) -> None:
        if self.line and math.isfinite(self.line[0][0]):
            delay = self.line[0][0] - time.monotonic()
            self._timer = self.proxy.loop.call_later(max(0.0, delay), self._deliver)

    def _deliver(self) -> None:
        self._timer = None
        now = time.monotonic()
        due = now + EARLY_S
        line = self.line
        burst: dict[_Pipe, list[bytes]] = {}
        ends: list[_Pipe] = []
        carried = 0
        while line and line[0][0] <= due:
            _, pipe, chunk = line.popleft()
            if chunk is not None:
                carried += len(chunk)
            if not isinstance(pipe, _Pipe):
                if chunk is not None:
                    pipe(chunk)
            elif chunk is None:
                ends.append(pipe)
            else:
                burst.setdefault(pipe, []).append(chunk)
        self.delivered_bytes += carried
        bucket = int((now - self.shaper.origin_s) // STATISTICS_BUCKET_S)
        self.buckets[bucket] = self.buckets.get(bucket, 0) + carried
        for pipe, chunks in burst.items():
            self.proxy.write(pipe, chunks)
        for pipe in ends:
            self.proxy.end(pipe)
        if self._timer is None:
            self._arm()

    def stop(self) -> None:
        for timer in (self._timer, self._resume):
            if timer is not None:
                timer.cancel()
        self._timer = self._resume = None
        self.line.clear()
        self.waiting.clear()


class ShapingProxy:
    """`async with ShapingProxy(profile.up, profile.down, routes, seed=1) as proxy:` listens until the block ends.

    `up` is what a client sends to the target, `down` the way back. `addresses` are the real listening addresses, in
    the order of `routes`. `start(at_s)` puts time 0 of the models' script at that CLOCK_MONOTONIC time. All routes
    share the one link; with `datagrams` they carry UDP on the same ports too. Raises OSError when an address cannot be
    listened on.
    """

    def __init__(
        self, up: LinkModel, down: LinkModel, routes: Sequence[Route], *, seed: int = 0, datagrams: bool = False
    ) -> None:
        self.routes = tuple(routes)
        self._carries_datagrams = datagrams
        self._datagrams: list[DatagramRoute] = []
        self.addresses: list[tuple[str, int]] = []
        self.connections: set[_Connection] = set()
        self.accepted = 0
        self._started = False
        self._rtt_s = up.delay_s + down.delay_s
        origin = time.monotonic() + NOT_STARTED_S
        self._directions = {
            name: _Direction(self, Shaper(model, rng=Random(f"{seed} {name}"), origin_s=origin), f"{seed} {name} loss")
            for name, model in (("up", up), ("down", down))
        }
        self._listeners: list[socket.socket] = []
        self._timers: set[asyncio.TimerHandle] = set()

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        return asyncio.get_running_loop()

    async def __aenter__(self) -> Self:
        try:
            for route in self.routes:
                self._listen(route)
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        for listener in self._listeners:
            self.loop.remove_reader(listener)
            listener.close()
        self._listeners.clear()
        for datagrams in self._datagrams:
            datagrams.close()
        self._datagrams.clear()
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        for connection in list(self.connections):
            self._drop(connection)
        for direction in self._directions.values():
            direction.stop()

    def start(self, at_s: float | None = None) -> float:
        """Put time 0 of the schedule at `at_s` (now by default) and return it. Only once."""
        if self._started:
            raise SernError("the proxy's profile has started already")
        self._started = True
        origin = time.monotonic() if at_s is None else at_s
        for direction in self._directions.values():
            direction.shaper.origin_s = origin
            direction.buckets.clear()
        return origin

    def direction_of(self, pipe: _Pipe) -> _Direction:
        return self._directions["up" if pipe.source is pipe.connection.client else "down"]

    def statistics(self) -> dict[str, object]:
        """Bytes carried in each `bucket_s` since time 0, and where the link is now."""
        now = time.monotonic()
        origin = self._directions["up"].shaper.origin_s
        usage = resource.getrusage(resource.RUSAGE_SELF)
        result: dict[str, object] = {
            "bucket_s": STATISTICS_BUCKET_S,
            "elapsed_s": now - origin if self._started else None,
            "connections": len(self.connections),
            "accepted": self.accepted,
            "cpu_s": usage.ru_utime + usage.ru_stime,
        }
        for name, direction in self._directions.items():
            last = max(direction.buckets, default=-1)
            shaper = direction.shaper
            result[name] = {
                "rate_bps": shaper.schedule.rate_bps(now - origin),
                "queue_packets": shaper.slots - shaper.free_slots(now),
                "delivered_bytes": direction.delivered_bytes,
                "datagrams": direction.datagrams,
                "datagrams_dropped": direction.datagrams_dropped,
                "datagrams_lost": direction.datagrams_lost,
                "bytes_per_bucket": [direction.buckets.get(i, 0) for i in range(last + 1)] if self._started else [],
            }
        return result

    # -- connections -----------------------------------------------------------------------------------------------

    def _listen(self, route: Route) -> None:
        up, down = self._directions["up"].carry, self._directions["down"].carry
        for left in reversed(range(PORT_TRIES if route.listen[1] == 0 else 1)):
            listener = _listening(route.listen)
            if self._carries_datagrams:
                try:
                    self._datagrams.append(DatagramRoute(listener.getsockname(), route.target, up=up, down=down))
                except OSError as error:
                    listener.close()
                    if left and error.errno == errno.EADDRINUSE:
                        continue  # the kernel chose a port that is free for connections only
                    raise
            break
        self._listeners.append(listener)
        self.addresses.append(listener.getsockname())
        self.loop.add_reader(listener, self._accept, listener, route)

    def _accept(self, listener: socket.socket, route: Route) -> None:
        now = time.monotonic()
        up = self._directions["up"].shaper
        if up.schedule.rate_bps(now - up.origin_s) == 0:
            self.loop.remove_reader(listener)  # a new connection waits for the link, like bytes do
            self._at(up.after(0.001, now), lambda: self.loop.add_reader(listener, self._accept, listener, route))
            return
        try:
            client, _ = listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        _small_buffers(server)
        server.setblocking(False)
        server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.accepted += 1
        connection = _Connection(client, server)
        connection.pipes = {"up": _Pipe(connection, client, server), "down": _Pipe(connection, server, client)}
        self.connections.add(connection)
        # The three-way handshake: the client may send after one round trip, the server sees it half a one later.
        self._at(up.after(self._rtt_s, now), lambda: self._want(connection, "up"))
        self._at(up.after(1.5 * self._rtt_s, now), lambda: self._connect(connection, route.target))

    def _at(self, when_s: float, action: Callable[[], None]) -> None:
        if math.isinf(when_s):
            return

        def run() -> None:
            self._timers.discard(timer)
            action()

        timer = self.loop.call_later(max(0.0, when_s - time.monotonic()), run)
        self._timers.add(timer)

    def _want(self, connection: _Connection, name: str) -> None:
        if connection in self.connections:
            self._directions[name].want(connection.pipes[name])

    def _connect(self, connection: _Connection, target: tuple[str, int]) -> None:
        if connection not in self.connections:
            return
        code = connection.server.connect_ex(target)
        if code in (0, errno.EINPROGRESS):
            self.loop.add_writer(connection.server, self._connected, connection)
        else:
            self._drop(connection)

    def _connected(self, connection: _Connection) -> None:
        self.loop.remove_writer(connection.server)
        if connection.server.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0:
            self._drop(connection)
            return
        connection.connected = True
        self._want(connection, "down")
        self._flush(connection.pipes["up"])

    def _drop(self, connection: _Connection) -> None:
        if connection not in self.connections:
            return
        self.connections.remove(connection)
        for name, pipe in connection.pipes.items():
            self._directions[name].pause(pipe)
            pipe.closed = pipe.dead = True
            self.loop.remove_writer(pipe.sink)
        connection.client.close()
        connection.server.close()

    # -- the sink side of a pipe -----------------------------------------------------------------------------------

    def write(self, pipe: _Pipe, chunks: list[bytes]) -> None:
        if pipe.dead:
            return
        blocked = bool(pipe.out)
        pipe.out += b"".join(chunks)
        if not blocked:
            self._flush(pipe)

    def end(self, pipe: _Pipe) -> None:
        """The end of the stream has arrived: pass it on behind the bytes before it."""
        pipe.eof_pending = True
        if pipe.dead:
            self._finish(pipe)
        elif not pipe.out:
            self._flush(pipe)

    def _flush(self, pipe: _Pipe) -> None:
        if pipe.dead or (pipe.sink is pipe.connection.server and not pipe.connection.connected):
            return
        try:
            if pipe.out:
                sent = pipe.sink.send(pipe.out)
                del pipe.out[:sent]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            pipe.dead = True  # the receiver is gone; its own end travels back in the other direction
            pipe.out.clear()
        if pipe.out:
            self.loop.add_writer(pipe.sink, self._flush, pipe)
            if len(pipe.out) >= UNDELIVERED_BYTES:
                self.direction_of(pipe).pause(pipe)
            return
        self.loop.remove_writer(pipe.sink)
        self.direction_of(pipe).want(pipe)
        if pipe.eof_pending:
            self._finish(pipe)

    def _finish(self, pipe: _Pipe) -> None:
        connection = pipe.connection
        if pipe.finished or connection not in self.connections:
            return
        pipe.finished = True
        with contextlib.suppress(OSError):
            pipe.sink.shutdown(socket.SHUT_WR)
        connection.ended += 1
        other = connection.pipes["down" if pipe is connection.pipes["up"] else "up"]
        if connection.ended == 2 or other.dead:
            self._drop(connection)


def _listening(address: tuple[str, int]) -> socket.socket:
    """A socket that listens for connections; raises OSError."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _small_buffers(listener)  # accepted sockets inherit them, and the window is announced from the first packet
        listener.setblocking(False)
        listener.bind(address)
        listener.listen(128)
    except OSError:
        listener.close()
        raise
    return listener


def _small_buffers(sock: socket.socket) -> None:
    """Make buffers small before listen or connect, so that the announced window is small from the first packet."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER_BYTES)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SLOT_BYTES)


async def _control(
    proxy: ShapingProxy, writers: set[asyncio.StreamWriter], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """One JSON object a line in, one out; a line that is not understood gets {"error": ...}."""
    writers.add(writer)
    try:
        while line := await reader.readline():
            writer.write(json.dumps(_answer(proxy, line)).encode() + b"\n")
            await writer.drain()
    except (ConnectionError, ValueError):  # gone, or a line beyond the stream's limit
        pass
    finally:
        writers.discard(writer)
        writer.close()


def _answer(proxy: ShapingProxy, line: bytes) -> dict[str, object]:
    try:
        request = json.loads(line)
        match request["do"]:
            case "start":
                at_s = request.get("at_s")
                return {"origin_s": proxy.start(None if at_s is None else float(at_s))}
            case "stats":
                return proxy.statistics()
            case other:
                return {"error": f"unknown request {other!r}: start and stats are known"}
    except (ValueError, TypeError, KeyError, SernError) as error:
        return {"error": f"{type(error).__name__}: {error}"}


def address(text: str) -> tuple[str, int]:
    """`host:port`; raises ValueError."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"{text!r} is not an address: give host:port")
    return host, int(port)


async def run(
    profile: LinkProfile, routes: Sequence[Route], *, seed: int, start_at_s: float | None, datagrams: bool
) -> None:
    """The process: serve until SIGTERM or SIGINT."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    async with ShapingProxy(profile.up, profile.down, routes, seed=seed, datagrams=datagrams) as proxy:
        writers: set[asyncio.StreamWriter] = set()
        control = await asyncio.start_server(lambda r, w: _control(proxy, writers, r, w), "127.0.0.1", 0)
        if start_at_s is not None:
            proxy.start(start_at_s)
        ready = {
            "listening": [f"{host}:{port}" for host, port in proxy.addresses],
            "control": control.sockets[0].getsockname()[1],
        }
        print(json.dumps(ready), flush=True)
        await stop.wait()
        control.close()
        for writer in list(writers):
            writer.close()
        await control.wait_closed()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sern_tools.proxy", description="A proxy with a bad link in it")
    parser.add_argument("--listen", action="append", required=True, type=address, metavar="HOST:PORT")
    parser.add_argument("--target", action="append", required=True, type=address, metavar="HOST:PORT")
    parser.add_argument("--profile", required=True, help="name of a link profile")
    parser.add_argument("--profiles", metavar="FILE", help="a file of profiles other than the shipped one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start-at", type=float, metavar="S", help="CLOCK_MONOTONIC time of the script's 0")
    parser.add_argument("--udp", action="store_true", help="carry datagrams too, on the same ports")
    options = parser.parse_args(arguments)
    if len(options.listen) != len(options.target):
        parser.error("give as many --target as --listen: they are pairs")
    from sern_runtime.profiles import load_profile

    try:
        profile = load_profile(options.profile, options.profiles)
        routes = [Route(*pair) for pair in zip(options.listen, options.target, strict=True)]
        asyncio.run(run(profile, routes, seed=options.seed, start_at_s=options.start_at, datagrams=options.udp))
    except (SernError, OSError) as error:
        print(f"proxy: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
