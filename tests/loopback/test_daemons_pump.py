"""The pump between a port of the core and a socket, at its limits."""

import asyncio
import math
import time

from sern_runtime.pump import BLOCKED_S, FULL_S, Pump
from sern_runtime.zmq_socket import SendResult
from tests.support import until


class Port:
    """Gives numbered datagrams; its deadline is always in the past, as when an acknowledgement is overdue."""

    def __init__(self, count: int) -> None:
        self.left = count
        self.given = 0
        self.timeouts = 0

    def next_datagram(self, *, now: float) -> bytes | None:
        del now
        if not self.left:
            return None
        self.left -= 1
        self.given += 1
        return str(self.given).encode()

    def next_deadline(self) -> float | None:
        return 0.0 if self.left else None

    def handle_timeout(self, *, now: float) -> None:
        del now
        self.timeouts += 1


class Socket:
    """Takes datagrams unless it is full; then it reports a change at once, as libzmq does."""

    def __init__(self) -> None:
        self.result = SendResult.OK
        self.taken: list[bytes] = []
        self.tries = 0
        self.pump: Pump | None = None

    def send(self, datagram: bytes) -> SendResult:
        self.tries += 1
        if self.result is SendResult.OK:
            self.taken.append(datagram)
        elif self.pump is not None:
            self.pump.kick()
        return self.result


def make(count: int) -> tuple[Port, Socket, Pump, list[str]]:
    gone: list[str] = []
    port, socket = Port(count), Socket()
    pump = Pump(port, socket.send, on_gone=lambda: gone.append("gone"))
    socket.pump = pump
    return port, socket, pump, gone


async def test_a_full_socket_is_not_tried_at_every_turn_and_loses_nothing() -> None:
    _port, socket, pump, gone = make(300)
    socket.result = SendResult.FULL
    began_s = time.monotonic()
    pump.kick()
    for _ in range(500):
        pump.kick()
        await asyncio.sleep(0)
    doublings = math.ceil(math.log2(BLOCKED_S / FULL_S))
    assert 1 <= socket.tries <= 2 + doublings + (time.monotonic() - began_s) / BLOCKED_S
    socket.result = SendResult.OK
    await until(lambda: len(socket.taken) == 300)
    assert socket.taken == [str(number).encode() for number in range(1, 301)]
    assert not gone
    pump.close()


async def test_a_new_transport_forgets_what_was_held_for_the_old_one() -> None:
    _port, socket, pump, _gone = make(2)
    socket.result = SendResult.FULL
    pump.run()
    assert socket.tries == 1
    pump.reset()
    socket.result = SendResult.OK
    pump.run()
    assert socket.taken == [b"2"]
    pump.close()


async def test_a_peer_that_is_gone_is_reported_and_nothing_more_is_sent() -> None:
    _port, socket, pump, gone = make(5)
    socket.result = SendResult.GONE
    pump.run()
    assert gone == ["gone"]
    assert socket.tries == 1
    pump.close()
    pump.kick()
    pump.run()
    assert socket.tries == 1
