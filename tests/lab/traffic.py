"""Senders and receivers of known traffic, on both sides of a lab at once: sockets of this process in its namespaces.

Arrival times are the kernel's, so that they do not depend on when this process is scheduled.
"""

import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from sern_tools.lab.lab import Node
from tests.support import Patience

HEADERS_BYTES: Final = 42
"""Ethernet, IPv4 and UDP: what netem counts beside the payload of a datagram."""
PORT: Final = 9000
_TIMESTAMPNS: Final = 35
_RCVBUFFORCE: Final = 33
_BUFFER_BYTES: Final = 2**23
_QUIET_S: Final = 0.4
_AGAIN_S: Final = 0.05
_BURST: Final = 20


@dataclass(frozen=True)
class Arrival:
    number: int
    sent_s: float
    at_s: float

    @property
    def delay_s(self) -> float:
        return self.at_s - self.sent_s


@contextmanager
def _pair(source: Node, target: Node) -> Iterator[tuple[socket.socket, socket.socket]]:
    with source.socket() as sender, target.socket() as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
        receiver.setsockopt(socket.SOL_SOCKET, _RCVBUFFORCE, _BUFFER_BYTES)
        receiver.bind((target.address, PORT))
        sender.connect((target.address, PORT))
        yield sender, receiver


def datagrams(
    source: Node,
    target: Node,
    count: int,
    *,
    size_bytes: int = 100,
    gap_s: float = 0.0,
    quiet_s: float = _QUIET_S,
    then: Callable[[], object] = lambda: None,
    passes: bool = True,
) -> list[Arrival]:
    """Send `count` numbered datagrams, `gap_s` apart, then call `then`; what arrives until nothing does for `quiet_s`.

    A sender that stood still catches up with `_BURST` at most: queues beside the link's would not hold many more.
    A link that stands still is waited for: one more datagram is sent behind them, again and again until it has come
    as well, unless the way is closed (`passes`).
    """
    with _pair(source, target) as (sender, receiver):
        began_s = time.time()
        due_s = time.monotonic()
        for number in range(count):
            # Busy waiting, because sleeping is too coarse for some thousand a second.
            while gap_s and time.monotonic() < due_s:
                time.sleep(gap_s / 4)
            due_s = max(due_s, time.monotonic() - _BURST * gap_s) + gap_s
            sender.send(struct.pack("Id", number, time.time()).ljust(size_bytes, b"\0"))
        then()
        patience = Patience()
        again_s = time.monotonic() if passes else math.inf
        arrivals: list[Arrival] = []
        while True:
            if time.monotonic() >= again_s:
                assert not patience.over(), f"nothing more comes from {source.name} to {target.name}"
                sender.send(struct.pack("Id", count, time.time()).ljust(size_bytes, b"\0"))
                again_s = time.monotonic() + _AGAIN_S
            receiver.settimeout(quiet_s if again_s == math.inf else _AGAIN_S)
            try:
                data, control, _, _ = receiver.recvmsg(2048, 128)
            except TimeoutError:
                if again_s == math.inf:
                    return arrivals
                continue
            number, sent_s = struct.unpack_from("Id", data)
            if sent_s < began_s:
                continue  # it was still under way from an earlier call
            if number == count:
                again_s = math.inf
                continue
            seconds, nanoseconds = struct.unpack("qq", control[0][2])
            arrivals.append(Arrival(number, sent_s, seconds + nanoseconds / 1e9))


def rate_bps(arrivals: list[Arrival], size_bytes: int) -> float:
    """The rate at which datagrams have left the link, headers included."""
    span_s = arrivals[-1].at_s - arrivals[0].at_s
    return (len(arrivals) - 1) * 8 * (size_bytes + HEADERS_BYTES) / span_s


def reaches(source: Node, target: Node, *, within_s: float = 0.5) -> bool:
    """Whether one datagram gets through. False means little on a machine that stands still: see `comes_to_reach`."""
    return bool(datagrams(source, target, 1, quiet_s=within_s, passes=False))


def comes_to_reach(source: Node, target: Node) -> bool:
    """Whether one of some datagrams gets through before a deadline."""
    patience = Patience()
    while not reaches(source, target):
        if patience.over():
            return False
    return True


def stream(source: Node, target: Node, count_bytes: int) -> float:
    """Carry bytes over one TCP connection; how long it took from the first byte to the last."""
    with target.socket(socket.SOCK_STREAM) as listener, source.socket(socket.SOCK_STREAM) as sender:
        listener.bind((target.address, PORT))
        listener.listen()
        listener.settimeout(20)
        sender.settimeout(20)
        sender.connect((target.address, PORT))
        connection, _ = listener.accept()
        thread = threading.Thread(target=sender.sendall, args=(bytes(count_bytes),))
        thread.start()
        try:
            with connection:
                connection.settimeout(20)
                left = count_bytes - len(connection.recv(1))
                began_s = time.monotonic()
                while left:
                    chunk = connection.recv(min(left, 65536))
                    assert chunk, "the connection ended early"
                    left -= len(chunk)
                return time.monotonic() - began_s
        finally:
            thread.join()
