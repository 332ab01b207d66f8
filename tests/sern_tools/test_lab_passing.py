"""A lab is handed out when datagrams get through it; a way that carries nothing is named."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from sern_tools.lab.host import LabError
from sern_tools.lab.passing import Way, await_passing


@pytest.fixture
def sockets() -> Iterator[list[socket.socket]]:
    """Three, bound on loopback."""
    with ExitStack() as stack:
        made = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)]
        for sock in made:
            sock.bind(("127.0.0.1", 0))
        yield made


def test_ways_that_carry_are_ready_and_left_empty(sockets: list[socket.socket]) -> None:
    a, b, c = sockets
    b.sendto(b"of somebody else", a.getsockname())
    await_passing([Way("a to b", a, b), Way("b to a", b, a), Way("a to c", a, c), Way("c to a", c, a)], within_s=30.0)
    for sock in sockets:
        sock.setblocking(False)
        with pytest.raises(BlockingIOError):
            sock.recv(100)


class Unheard(socket.socket):
    """Where it says it is, nobody listens."""

    elsewhere: tuple[str, int]

    def getsockname(self) -> tuple[str, int]:
        return self.elsewhere


def test_a_way_that_carries_nothing_is_named_in_one_line(sockets: list[socket.socket]) -> None:
    a, b, deaf = sockets
    with Unheard(socket.AF_INET, socket.SOCK_DGRAM) as lost:
        lost.bind(("127.0.0.1", 0))
        lost.elsewhere = deaf.getsockname()
        with pytest.raises(LabError) as raised:
            await_passing([Way("a to b", a, b), Way("a to lost", a, lost)], within_s=0.0)
    text = str(raised.value)
    assert "(a to lost)" in text
    assert "start the lab again" in text
    assert "\n" not in text


def test_what_a_socket_refuses_is_told(sockets: list[socket.socket]) -> None:
    a, b, _ = sockets
    a.close()
    with pytest.raises(LabError, match="the lab is not ready: a to b: Bad file descriptor"):
        await_passing([Way("a to b", a, b)])
