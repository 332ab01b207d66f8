"""The ends of a link's run: when one is ready, and what its sender of datagrams survives."""

import select
import socket
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks.link.peers import send_datagram
from benchmarks.link.runs import until_ready
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Children, python
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S, Patience


async def test_one_that_is_ready_is_heard_and_told(tmp_path: Path) -> None:
    program = "import sys; print('hello'); print('ready', flush=True); sys.exit(int(sys.stdin.readline()))"
    async with Children(tmp_path) as children:
        robot = await children.start("robot", python("-c", program), talks=True)
        await children.within(until_ready(robot), DEADLINE_S, "it was not ready")
        await robot.say("3")
        await robot.process.wait()
        await robot.say("go")
        with pytest.raises(SernError, match=r"robot ended \(exit status 3\) and said nothing"):
            await children.within(until_ready(robot), DEADLINE_S, "it was not ready")


def send_until_told(sender: socket.socket) -> None:
    """Send until an error tells of a datagram before, which may come a moment later."""
    patience = Patience()
    while not patience.over():
        sender.send(b"nobody is there")


def test_the_sender_of_bare_datagrams_outlives_a_receiver_that_is_not_there() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            address = "127.0.0.1", free_ports(1)[0]  # which nobody else takes while nobody listens there
            receiver.bind(address)
            sender.connect(address)
        with pytest.raises(ConnectionRefusedError):
            send_until_told(sender)
        for _ in range(4):
            send_datagram(sender, b"nobody is there")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(address)
            patience = Patience()
            got = b""
            while got != b"heard":  # the kernel may hand over late what was sent before
                assert not patience.over(), "a receiver that is there again is heard of"
                send_datagram(sender, b"heard")
                if select.select([receiver], [], [], 0.01)[0]:
                    got = receiver.recv(100)
