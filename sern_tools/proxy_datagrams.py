"""Datagrams in the shaping proxy: a NAT in front of the target, whose packets go through the same bottleneck as TCP.

Each client address has a socket of its own towards the target, its mapping. A datagram that finds the queue full is
dropped, and one that the model loses is lost after it has taken its share of the rate.
"""

import asyncio
import socket
from collections.abc import Callable
from random import Random
from typing import Final

from sern_sim.models import LinkModel

DATAGRAM_BYTES: Final = 65_536
BATCH: Final = 64
"""Datagrams taken in a row before others have their turn."""
MAPPINGS: Final = 64
"""The most that are kept; then the oldest is forgotten."""
BUFFER_BYTES: Final = 1 << 20
"""What may wait for the proxy while it is busy; the queue of the link is its own."""

Address = tuple[str, int]
Carry = Callable[[bytes, Callable[[bytes], None]], None]
"""Takes a datagram and what delivers it, later or never."""


class Loss:
    """Draws the fate of each packet: independent losses, and those of a Gilbert-Elliott channel."""

    def __init__(self, model: LinkModel, rng: Random) -> None:
        self._loss = model.loss
        self._burst = model.burst_loss
        self._rng = rng
        self._bad = False

    def strikes(self) -> bool:
        """Whether the next packet is lost."""
        draw = self._rng.random
        lost = bool(self._loss) and draw() < self._loss
        burst = self._burst
        if burst is not None:
            if draw() < (burst.leave if self._bad else burst.enter):
                self._bad = not self._bad
            lost = draw() < (burst.bad_loss if self._bad else burst.good_loss) or lost
        return lost


class DatagramRoute:
    """Datagrams to `listen` go to `target` through `up`, and answers back through `down`. Raises OSError. Close it."""

    def __init__(self, listen: Address, target: Address, *, up: Carry, down: Carry) -> None:
        self._target = target
        self._up = up
        self._down = down
        self._loop = asyncio.get_running_loop()
        self._mappings: dict[Address, socket.socket] = {}
        self._inner = _socket()
        try:
            self._inner.bind(listen)
        except OSError:
            self._inner.close()
            raise
        self._loop.add_reader(self._inner, self._from_client)

    @property
    def clients(self) -> int:
        return len(self._mappings)

    def close(self) -> None:
        """Idempotent."""
        for client in list(self._mappings):
            self._forget(client)
        if self._inner.fileno() >= 0:
            self._loop.remove_reader(self._inner)
            self._inner.close()

    def _from_client(self) -> None:
        for _ in range(BATCH):
            try:
                data, client = self._inner.recvfrom(DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # an earlier answer found nobody; reading took the error off
            outer = self._mappings.get(client)
            if outer is None:
                outer = self._map(client)
            self._up(data, lambda datagram, outer=outer: _put(outer, datagram))  # type: ignore[misc]

    def _map(self, client: Address) -> socket.socket:
        if len(self._mappings) >= MAPPINGS:
            self._forget(next(iter(self._mappings)))
        outer = self._mappings[client] = _socket()
        outer.connect(self._target)
        self._loop.add_reader(outer, self._from_target, outer, client)
        return outer

    def _from_target(self, outer: socket.socket, client: Address) -> None:
        for _ in range(BATCH):
            try:
                data = outer.recv(DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # nobody listens at the target; reading took the error off
            self._down(data, lambda datagram: _put(self._inner, datagram, client))

    def _forget(self, client: Address) -> None:
        outer = self._mappings.pop(client)
        self._loop.remove_reader(outer)
        outer.close()


def _socket() -> socket.socket:
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    found.setblocking(False)
    return found


def _put(sock: socket.socket, datagram: bytes, address: Address | None = None) -> None:
    """What the kernel does not take is lost, as on any network; so is what comes for a mapping that is forgotten."""
    if sock.fileno() < 0:
        return
    try:
        if address is None:
            sock.send(datagram)
        else:
            sock.sendto(datagram, address)
    except OSError:
        return
