"""What is marked how on the wire (DSCP): each datagram by its class, and each connection."""

import asyncio
import socket as socketlib
import struct
from pathlib import Path
from typing import Any, Final

import pytest
from pydantic import ValidationError

from sern_client.daemon import ClientDaemon
from sern_core.path.lanes import LANE_UDP
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock
from sern_runtime.config.shared import DscpSection
from sern_runtime.dscp import Marks
from sern_runtime.priority_paths import CONNECTIONS
from sern_runtime.udp import UdpServer
from sern_runtime.udp_client import UdpClient
from sern_runtime.zmq_socket import SendResult
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab
from tests.loopback.test_udp_client import SIX
from tests.loopback.udp_support import OFFERED, ROBOT
from tests.support import until

INSIDE = "127.0.0.2"
PATIENT_S = 30.0
"""A busy machine's pause is no path that is gone: a client that takes it for one tries another address, and what it
sends for that is as long as data and has another mark."""
EF, CS0, CS1 = 46 << 2, 0, 8 << 2
IPV4, ETHERNET_BYTES, UDP_BYTES = 0x0800, 14, 8
"""EtherType, and the headers before and behind that of IP."""


def listening(host: str, port: int = 0) -> socketlib.socket:
    """A bound socket that is told the IP byte of each datagram."""
    family = socketlib.AF_INET6 if ":" in host else socketlib.AF_INET
    socket = socketlib.socket(family, socketlib.SOCK_DGRAM)
    if family == socketlib.AF_INET6:
        socket.setsockopt(socketlib.IPPROTO_IPV6, socketlib.IPV6_RECVTCLASS, 1)
    else:
        socket.setsockopt(socketlib.IPPROTO_IP, socketlib.IP_RECVTOS, 1)
    socket.setblocking(False)
    socket.bind((host, port))
    return socket


def take(socket: socketlib.socket) -> tuple[int, bytes, Any] | None:
    """The IP byte of the next datagram, the datagram, and whence it came; None: there is none."""
    try:
        data, ancillary, _, address = socket.recvmsg(2048, 64)
    except BlockingIOError:
        return None
    ((_, _, value),) = ancillary
    return int.from_bytes(value, "little"), data, address


class Tap:
    """Forwards datagrams between a client that sends to `INSIDE`:port and `HOST`:port, TCP connections too, and notes
    the IP byte and the size of each datagram."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.inner = listening(INSIDE, port)
        self.outer = listening("127.0.0.3")
        self.up: list[tuple[int, int]] = []
        self.down: list[tuple[int, int]] = []
        self._client: Any = None
        loop = asyncio.get_running_loop()
        loop.add_reader(self.inner, self._from_client)
        loop.add_reader(self.outer, self._from_relay)

    def _from_client(self) -> None:
        while (got := take(self.inner)) is not None:
            tos, data, self._client = got
            self.up.append((tos, len(data)))
            self.outer.sendto(data, (HOST, self.port))

    def _from_relay(self) -> None:
        while (got := take(self.outer)) is not None:
            tos, data, _ = got
            self.down.append((tos, len(data)))
            self.inner.sendto(data, self._client)

    def close(self) -> None:
        for socket in (self.inner, self.outer):
            asyncio.get_running_loop().remove_reader(socket)
            socket.close()


@pytest.mark.parametrize(
    ("url", "host"),
    [
        ("udp://127.0.0.1:*", "127.0.0.1"),
        pytest.param("udp://[::1]:*", "::1", marks=SIX),
        pytest.param("udp://[::]:*", "127.0.0.1", marks=SIX),
        pytest.param("udp://[::]:*", "::1", marks=SIX),
    ],
    ids=["IPv4", "IPv6", "both, over IPv4", "both, over IPv6"],
)
async def test_each_datagram_has_the_mark_it_was_sent_with(url: str, host: str) -> None:
    marks = [EF, EF, CS1, CS0, EF, CS1, CS1, None]
    server = UdpServer([url], lambda _session, _data, _now: None, tos=0xBB)
    session = server.open_session(ROBOT, OFFERED)
    far = listening(host)
    client = UdpClient(host, far.getsockname()[1], session.parameters, lambda _data, _now: None, tos=CS1 | 3)
    seen: list[tuple[int, bytes, Any]] = []

    def came() -> list[int]:
        """The marks of what was sent, in order."""
        while (one := take(far)) is not None:
            seen.append(one)
        return [tos for tos, data, _ in seen if len(data) < 200]

    def challenges() -> list[int]:
        return [tos for tos, data, _ in seen if len(data) >= 200]

    try:
        await until(lambda: client.socket is not None, "the client has a socket")
        await until(lambda: came() or challenges(), "its challenge is there")
        for tos in marks:
            assert client.send(b"x" * 100, tos) is SendResult.OK
        await until(lambda: len(came()) == len(marks), "all are there")
        assert came() == [CS1 if tos is None else tos for tos in marks]
        assert set(challenges()) == {CS1}, "ECN's two bits are not ours"
        seen.clear()
        listener = server.listeners[0]
        there = far.getsockname()[:2]
        if listener.socket.family == socketlib.AF_INET6 and ":" not in host:
            there = ("::ffff:" + host, there[1])  # as a socket of both families knows it
        for tos in (server.tos, CS1, EF):
            assert listener.send(b"from the relay", there, tos) is SendResult.OK
        await until(lambda: len(came()) == 3, "the server's own")
        assert came() == [0xB8, CS1, EF]
    finally:
        client.close()
        server.close()
        far.close()


class Capture:
    """Sees every packet of `HOST`:port as it is on the wire of the loopback interface, and notes the IP byte and the
    size of the datagrams to and from there. Needs root."""

    def __init__(self, port: int) -> None:
        self.up: list[tuple[int, int]] = []
        self.down: list[tuple[int, int]] = []
        self._port = port
        # Of this protocol only packets that come in are told, so none is seen twice.
        self._socket = socketlib.socket(socketlib.AF_PACKET, socketlib.SOCK_RAW, socketlib.htons(IPV4))
        self._socket.setblocking(False)
        self._socket.bind(("lo", IPV4))
        asyncio.get_running_loop().add_reader(self._socket, self._readable)

    def _readable(self) -> None:
        while True:
            try:
                packet = memoryview(self._socket.recv(65536))[ETHERNET_BYTES:]
            except BlockingIOError:
                return
            header_bytes = (packet[0] & 0xF) * 4
            if packet[9] != socketlib.IPPROTO_UDP:
                continue
            source, target, nbytes = struct.unpack_from(">HHH", packet, header_bytes)
            for port, way in ((target, self.up), (source, self.down)):
                if port == self._port:
                    way.append((packet[1], nbytes - UDP_BYTES))

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()


Seen = dict[PriorityClass, tuple[set[int], set[int]]]


async def marks_by_class(robot: ClientDaemon, relay: RelayDaemon, tap: Tap | Capture) -> Seen:
    """The IP bytes of a session's datagrams by class, up and down, as `tap` saw them. Bulk fills datagrams of 1200
    bytes, class control sends messages of 300 bytes: the sizes tell them apart."""
    await until(lambda: robot.core.link.lane.id == LANE_UDP, "datagrams are used")
    hub = relay.hub
    hub.streams.tap = lambda _stream: True
    now = clock.now()
    channels = {}
    for priority in PriorityClass:
        info = TopicInfo(TopicName(f"/robot1/{priority.name.lower()}"), "std_msgs/msg/String", Encoding.CDR)
        channels[priority] = robot.core.publish(info, TopicSpec(priority, depth=1000), now=now)
    hub.streams.refresh_interest(now=now)
    robot.core.subscribe(("/feed/.*",), now=now)
    down = {
        priority: hub.local.open(
            TopicInfo(TopicName(f"/feed/{priority.name.lower()}"), "std_msgs/msg/String", Encoding.CDR),
            TopicSpec(priority, depth=1000),
            ClientName("feed_x"),
            now=now,
        )
        for priority in PriorityClass
    }
    await until(lambda: all(channel.wanted for channel in channels.values()), "all are wanted")

    def clear() -> None:
        tap.up.clear()
        tap.down.clear()

    def enough() -> bool:
        """Sends one message each way; whether 40 datagrams that must hold such came through, each way."""
        body = b"x" * nbytes
        robot.core.send(channels[priority], body, 0, now=clock.now())
        hub.local.inject(down[priority], body, 0, now=clock.now())
        robot.connection.wake()
        relay.transports.after()
        return all(sum(size > least for _, size in way) >= 40 for way in (tap.up, tap.down))

    def quiet() -> bool:
        """Whether nothing of the class before is still to come, and nothing that the session says of its streams: that
        is as long as what is counted here, and of another class."""
        links = (robot.core.link, hub.links[ClientName("robot1")])
        mine = [channel for link in links for channel in link.sender.channels.values()]
        return all(link.control.settled for link in links) and not any(c.queue or c.flying for c in mine)

    seen: Seen = {}
    await until(lambda: len(robot.core.link.taking.incoming) == len(down), "all are announced")
    await until(quiet, "the session has said what there is to say")
    clear()
    for priority, nbytes in ((PriorityClass.CONTROL, 300), (PriorityClass.STATE, 500), (PriorityClass.BULK, 20_000)):
        least = min(nbytes, 1000)
        await until(enough, f"datagrams of class {priority.name}")
        up, back = ({tos for tos, size in way if size > least} for way in (tap.up, tap.down))
        seen[priority] = (up, back)
        await until(quiet, f"all of class {priority.name} has come")
        clear()
    return seen


DSCP: Final[dict[str, Any]] = {"control": "cs5", "state": 18, "bulk": "le"}


@pytest.mark.parametrize(
    ("ours", "theirs", "up", "down"),
    [
        ({}, {}, (EF, CS0, CS1), (EF, CS0, CS1)),
        ({"dscp": DSCP}, {"dscp": {"state": "af41"}}, (40 << 2, 18 << 2, 1 << 2), (EF, 34 << 2, CS1)),
    ],
    ids=["as they come", "of the file"],
)
async def test_the_classes_of_a_session_are_marked_both_ways(
    tmp_path: Path,
    ours: dict[str, Any],
    theirs: dict[str, Any],
    up: tuple[int, ...],
    down: tuple[int, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`ours` is the client's section `link`, `theirs` the relay's: each end marks what it sends."""
    monkeypatch.setattr("sern_core.path.flight.STALL_MIN_S", PATIENT_S)
    (port,) = free_ports(1)
    async with Lab(tmp_path, "robot1", relay_port=port) as lab:
        relay = await lab.relay(lab.relay_file(link=theirs))
        tap = Tap(port)
        forward = await asyncio.start_server(_pipe_to(port), INSIDE, port)
        try:
            there = {"endpoint": f"tcp://{INSIDE}:{port}"}
            operator = {"kind": "synthetic", "role": "operator"}
            robot = await lab.connected(lab.client_file("robot1", operator, relay=there, link=ours))
            seen = await marks_by_class(robot, relay, tap)
            assert seen == {p: ({up[p]}, {down[p]}) for p in PriorityClass}
            await lab.end(robot)
            await lab.end(relay)
        finally:
            forward.close()
            tap.close()


@pytest.mark.root
@pytest.mark.parametrize("dscp", [{}, DSCP], ids=["as they come", "of the file"])
async def test_the_classes_are_marked_on_the_wire(
    tmp_path: Path, dscp: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a switch sees: the header of each packet, and not what the kernel tells a socket of it."""
    monkeypatch.setattr("sern_core.path.flight.STALL_MIN_S", PATIENT_S)
    marks = DscpSection.model_validate(dscp).marks().tos
    async with Lab(tmp_path, "robot1") as lab:
        try:
            capture = Capture(lab.port)
        except PermissionError as error:
            pytest.skip(f"packets are captured by root alone: {error.strerror}")
        try:
            relay = await lab.relay(lab.relay_file(link={"dscp": dscp}))
            operator = {"kind": "synthetic", "role": "operator"}
            robot = await lab.connected(lab.client_file("robot1", operator, link={"dscp": dscp}))
            seen = await marks_by_class(robot, relay, capture)
            assert seen == {p: ({marks[p]}, {marks[p]}) for p in PriorityClass}
            if not dscp:
                assert (seen[PriorityClass.CONTROL][0], seen[PriorityClass.BULK][0]) == ({46 << 2}, {8 << 2})
            await lab.end(robot)
            await lab.end(relay)
        finally:
            capture.close()


def _pipe_to(port: int) -> Any:
    async def pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        finally:
            writer.close()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection(HOST, port)
        await asyncio.gather(pipe(reader, far_writer), pipe(far_reader, writer), return_exceptions=True)

    return connected


async def test_connections_have_the_marks_of_the_file(tmp_path: Path) -> None:
    """Both ends of the stream, and of the connections for class control alone."""
    dscp = {"control": "cs5", "state": 18}
    priority_lane, stream = 40 << 2, 18 << 2
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(link={"dscp": dscp}))
        file = lab.client_file(
            "robot1", {"kind": "synthetic", "role": "robot"}, relay={"udp": False}, link={"dscp": dscp}
        )
        robot = await lab.connected(file)
        lane = robot.connection.priority_lane
        assert lane is not None
        await until(lambda: len(lane.paths) == CONNECTIONS, "all are joined")
        server = relay.transports.server
        assert server is not None
        await until(lambda: len(server.priority_lanes.joined) == CONNECTIONS, "the relay knows that they are")
        marked = []
        for handle in server.connections.handles():
            with handle._connection() as socket:
                assert socket is not None
                marked.append(socket.getsockopt(socketlib.IPPROTO_IP, socketlib.IP_TOS))
        assert sorted(marked) == [stream, priority_lane, priority_lane]
        assert robot.connection.transport is not None
        ours = [robot.connection.transport.dialer, *(each.dialer for each in lane.connections)]
        marked = []
        for dialer in ours:
            assert dialer._handle is not None
            with dialer._handle._connection() as socket:
                assert socket is not None
                marked.append(socket.getsockopt(socketlib.IPPROTO_IP, socketlib.IP_TOS))
        assert marked == [stream, priority_lane, priority_lane]


def test_the_marks_of_a_file() -> None:
    assert DscpSection().marks() == Marks() == Marks(control=46, state=0, bulk=8)
    assert Marks().tos == (EF, CS0, CS1)
    section = DscpSection.model_validate({"control": "cs5", "state": "af41", "bulk": 63})
    assert section.marks() == Marks(40, 34, 63)
    for wrong in ("EF", "af44", 64, -1, True, 1.0, None):
        with pytest.raises(ValidationError, match="a DSCP: a name such as ef, af41 or cs1, or 0 to 63"):
            DscpSection.model_validate({"bulk": wrong})
