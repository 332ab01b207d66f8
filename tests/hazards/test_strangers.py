"""Whoever has no key achieves nothing: it is counted, and nobody else notices."""

import re
import socket as socketlib
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle, pairwise
from pathlib import Path

import pytest
import zmq

from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import SecretKey
from sern_runtime.transport_watch import ENDED
from sern_tools.keygen import write_pair
from sern_tools.ports import free_ports
from tests.between import INSIDE, Repeater
from tests.daemons import HOST, Lab, Process, bodies, delivered, metric, rss_bytes, write_bag
from tests.hazards.field import Field, field
from tests.strangers import Stranger
from tests.support import until

MB = 2**20
CONFIG_ERROR = 2


def descriptors(process: Process) -> int:
    """Open file descriptors of a daemon."""
    return len(list(Path(f"/proc/{process.process.pid}/fd").iterdir()))


def connected(field: Field, source: str = HOST) -> socketlib.socket:
    """A TCP connection to the relay that says nothing yet."""
    sock = socketlib.create_connection((HOST, field.lab.port), source_address=(source, 0))
    sock.setblocking(False)
    return sock


@pytest.fixture
def open_files() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


async def test_unknown_key(tmp_path: Path, stranger_keys: SecretKey) -> None:
    """It is shut out, and the relay names the key and the address once."""
    async with field(tmp_path) as world:
        for _attempt in (1, 2):
            async with Stranger(world.lab, stranger_keys) as stranger:
                await until(lambda who=stranger: zmq.Event.HANDSHAKE_FAILED_AUTH in who.events)  # type: ignore[misc]
                assert stranger.received == []
        assert metric(world.relay, "sern_relay_auth_total", result="unknown_key") == 2
        lines = [line for line in world.relay.lines if "unknown key" in line]
        assert len(lines) == 2 and all(stranger_keys.public_key in line and HOST in line for line in lines)
        refused = world.relay.json("/api/clients")["refused"]
        assert [(row["address"], row["count"]) for row in refused] == [(HOST, 2)]


async def test_wrong_server_key(tmp_path: Path) -> None:
    """A client that expects another relay does not talk to this one, says which file to look at, and tries on."""
    async with field(tmp_path) as world:
        other = tmp_path / "other"
        other.mkdir()
        write_pair(ClientName("relay"), other, other)
        config = world.lab.client_file(
            "robot2", {"kind": "synthetic", "role": "robot"}, relay={"server_key_file": "other/relay.pub"}
        )
        robot2 = world.lab.process(config)
        await robot2.said("WARNING", ENDED)
        await world.refused("handshake")
        assert world.came("robot2") == 0
        await robot2.stop()


GREETINGS = {
    "NULL": b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01NULL" + bytes(48),
    "PLAIN": b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01PLAIN" + bytes(47),
    "ZMTP 2.0": b"\xff\0\0\0\0\0\0\0\x01\x7f\x01\x05\0\0",
    "ZMTP 1.0": b"\x01\0",
    "HTTP": b"GET / HTTP/1.1\r\nHost: relay\r\n\r\n",
    "noise": bytes(range(256)) * 64,
}


@pytest.mark.parametrize("kind", GREETINGS)
async def test_other_protocols(tmp_path: Path, open_files: ExitStack, kind: str) -> None:
    """The connection is closed before anything of it is read as a message."""
    async with field(tmp_path) as world:
        sock = open_files.enter_context(connected(world))
        sock.sendall(GREETINGS[kind])
        await until(lambda: closed(sock), "the relay closes it")
        await world.relay.until(
            lambda: sum(
                metric(world.relay, "sern_relay_connections_refused_total", reason=reason)
                for reason in ("handshake", "capped")
            ),
            "counts it",
        )
        assert "Traceback" not in world.relay.text


def closed(sock: socketlib.socket) -> bool:
    """Whether the far end has closed a connection."""
    try:
        return sock.recv(65536) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


async def test_port_scan(tmp_path: Path) -> None:
    """300 connections that end at once, half of them with a reset, leave nothing behind."""
    async with field(tmp_path) as world:
        before = descriptors(world.relay)
        for number in range(300):
            with connected(world) as sock:
                if number % 2:
                    sock.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_LINGER, struct.pack("ii", 1, 0))
        await world.relay.until(lambda: descriptors(world.relay) <= before + 2, "has closed its ends")
        assert "Traceback" not in world.relay.text


async def test_2000_half_open_connections(tmp_path: Path, open_files: ExitStack) -> None:
    """There are never more than the caps say, by source and in all, and who has a key comes in all the same."""
    async with field(tmp_path) as world:
        before = descriptors(world.relay)
        sources = cycle([f"127.0.1.{number}" for number in range(1, 41)])
        for _ in range(2000):
            open_files.enter_context(connected(world, next(sources)))
        await world.refused("capped", 2000 - 256 - 40)
        await world.relay.until(lambda: descriptors(world.relay) <= before + 270, "keeps no more than 256 of them")
        robot2 = world.lab.process(world.lab.client_file("robot2", {"kind": "synthetic", "role": "robot", "topics": 1}))
        await robot2.said("connected to relay")
        assert descriptors(world.relay) <= before + 280, "the robot has some as well"
        await robot2.stop()


async def test_giant_frame_before_the_handshake(tmp_path: Path, open_files: ExitStack) -> None:
    """Eight strangers announce 4 GB each and send what is taken: the relay grows by less than 5 MB."""
    async with field(tmp_path) as world:
        greeting = b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01CURVE" + bytes(47)
        socks = [open_files.enter_context(connected(world)) for _ in range(8)]
        before = rss_bytes(world.relay)
        for sock in socks:
            sock.sendall(greeting + b"\x06" + (2**32).to_bytes(8, "big"))
        body = bytes(MB)

        def all_closed() -> bool:
            for sock in list(socks):
                try:
                    sock.send(body)
                except BlockingIOError:
                    continue
                except OSError:
                    socks.remove(sock)
                    continue
                if closed(sock):
                    socks.remove(sock)
            return not socks

        await until(all_closed, "the relay closes them")
        await world.goes_on()
        assert rss_bytes(world.relay) - before < 5 * MB


async def test_too_few_descriptors(tmp_path: Path) -> None:
    """A relay that may not open as many files as its caps let others use does not start, and says what to change."""
    async with Lab(tmp_path, "robot1") as lab:
        config = lab.relay_file()
        relay = lab.process(config, before=("prlimit", "--nofile=900:900"))
        assert await relay.ended() == CONFIG_ERROR
        [line] = relay.lines
        place = rf"sern-relay: {re.escape(str(config))}:\d+: relay\.max_connections"
        assert re.match(place + ": this process may open 900 files and connections, and needs 984", line), line


async def test_descriptors_are_used_up(tmp_path: Path, open_files: ExitStack) -> None:
    """1,000 connections come at once to a relay that may have fewer: it uses its reserve to cut them off, and who has a
    key comes in while they are there."""
    async with field(tmp_path, before_relay=("prlimit", "--nofile=984:984")) as world:
        for number in range(1000):
            open_files.enter_context(connected(world, f"127.0.1.{1 + number % 40}"))
        await world.refused("capped", 700)
        robot2 = world.lab.process(world.lab.client_file("robot2", {"kind": "synthetic", "role": "robot", "topics": 1}))
        await robot2.said("connected to relay")
        failed = metric(world.relay, "sern_relay_connections_refused_total", reason="accept")
        await world.goes_on()
        assert metric(world.relay, "sern_relay_connections_refused_total", reason="accept") == failed
        await robot2.stop()


async def test_datagrams_that_come_again(tmp_path: Path) -> None:
    """Somebody on the way sends each datagram of an operator twice at once, and again later: no command is obeyed
    twice, or after a later one."""
    (port,) = free_ports(1)
    bag = write_bag(tmp_path / "commands.bag", {"/command": 1000})
    rules = [{"match": "/command", "class": "control", "lifespan_s": 5.0, "depth": 5}]
    between = Repeater(port)
    async with Lab(tmp_path, "robot2", "site", relay_port=port) as lab:
        try:
            relay = await lab.process(lab.relay_file()).ready()
            await between.start()
            robot = await lab.process(lab.recorder_file("robot2", "/site/command")).ready()
            inside = {"endpoint": f"tcp://{INSIDE}:{port}"}
            config = lab.player_file("site", bag, play={"rate": 0.2, "loop": True}, topics=rules, relay=inside)
            site = await lab.process(config).ready()
            await relay.said("site is reached over UDP")
            before = between.repeated
            await robot.until(lambda: between.repeated > before + 500 and delivered(robot) > 500, "is commanded")
            for process in (site, robot, relay):
                await process.stop()
        finally:
            await between.close()
    sent, got = bodies(bag)["/command"], bodies(tmp_path / "robot2.bag")["/site/command"]
    numbers = [sent.index(body) for body in got]
    rounds = sum(later < earlier for earlier, later in pairwise(numbers))
    assert all(later != earlier for earlier, later in pairwise(numbers))
    assert rounds <= len(numbers) // 900, "an older command came after a newer one"
