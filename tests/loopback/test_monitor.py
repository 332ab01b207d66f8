"""What happens to connections: the watch of a client, the table of a server, and the TCP socket underneath."""

import asyncio
import errno
import math
import os
import socket as socketlib
from pathlib import Path

import pytest
import zmq

from sern_runtime import transport_watch
from sern_runtime.config.keys import SecretKey
from sern_runtime.monitor import (
    HANDSHAKE_GRACE_S,
    ConnectionTable,
    EventKind,
    MonitorEvent,
    SocketHandle,
    TcpHandle,
    port_of,
)
from sern_runtime.transport_watch import CUT, ENDED, HALF_WAY, OTHER, SHUT, SILENT, UNFINISHED, TransportWatch
from sern_runtime.zap import ZapHandler
from sern_runtime.zmq_setup import HANDSHAKE_IVL_MS, make_client, make_server
from sern_runtime.zmq_socket import BATCH, DealerSocket, RouterSocket
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S, until

Context = zmq.Context[zmq.Socket[bytes]]


class Server:
    """A ROUTER that binds users to their connections, as a relay does at hello."""

    def __init__(
        self,
        context: Context,
        *,
        max_half_open_per_source: int = 32,
        max_half_open: int = 256,
        max_connections: int = 1024,
    ) -> None:
        socket = make_server(context, ["tcp://127.0.0.1:*"], None)
        self.endpoint = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self.now_s = 0.0
        self.table = ConnectionTable(
            socket,
            max_half_open_per_source=max_half_open_per_source,
            max_half_open=max_half_open,
            max_connections=max_connections,
            clock=lambda: self.now_s,
        )
        self.router = RouterSocket(socket, self._on_message)
        self.seen: list[bytes] = []

    def _on_message(self, _routing_id: bytes, _user: str, body: bytes) -> None:
        self.seen.append(body)
        self.table.bind_user(self.router.peer_details().fd, body.decode())

    @property
    def address(self) -> tuple[str, int]:
        port = port_of(self.endpoint)
        assert port is not None
        return "127.0.0.1", port

    def close(self) -> None:
        self.table.close()
        self.router.close()


class Client:
    def __init__(
        self,
        context: Context,
        endpoint: str,
        keys: tuple[SecretKey, str] | None = None,
        *,
        handshake_ivl_ms: int = HANDSHAKE_IVL_MS,
    ) -> None:
        self._handshake_ivl_ms = handshake_ivl_ms
        self.handles: list[TcpHandle | None] = []
        self.reasons: list[str] = []
        self.rebuilds: list[str] = []
        self.dealer = DealerSocket(
            make_client(context, endpoint, *(keys or (None, None)), before_connect=self._watch), lambda _body: None
        )

    def _watch(self, socket: "zmq.Socket[bytes]") -> None:
        socket.setsockopt(zmq.HANDSHAKE_IVL, self._handshake_ivl_ms)
        self.dead: list[str] = []
        self.watch = TransportWatch(
            socket, self.handles.append, self.reasons.append, self.rebuilds.append, self.dead.append
        )

    def close(self) -> None:
        self.watch.close()
        self.dealer.close()


async def test_up_down_and_up_again(zmq_context: Context) -> None:
    server = Server(zmq_context)
    client = Client(zmq_context, server.endpoint)
    await until(lambda: client.watch.up)
    await until(lambda: client.dealer.send(b"robot1"))
    await until(lambda: server.seen)
    assert server.table.cut_user("nobody") == 0
    assert server.table.cut_user("robot1") == 1
    await until(lambda: client.reasons)
    assert client.reasons == ["the connection to the relay was lost"]
    await until(lambda: len(client.handles) == 2)
    assert client.watch.up
    assert client.watch.reason == ""
    assert client.rebuilds == []
    client.close()
    server.close()


async def test_nobody_listening_is_said_once(zmq_context: Context) -> None:
    endpoint = f"tcp://127.0.0.1:{free_ports(1)[0]}"
    client = Client(zmq_context, endpoint)
    await until(lambda: client.reasons)
    server_socket = zmq_context.socket(zmq.ROUTER)
    server_socket.bind(endpoint)
    await until(lambda: client.watch.up)
    assert client.reasons == ["the relay does not answer: connecting failed"]
    client.close()
    server_socket.close()


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00CURVE" + bytes(47)
"""What a CURVE peer of ZMTP 3.0 says first (RFC 23)."""


async def keep(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, says: bytes, *, ends: bool) -> None:
    writer.write(says)
    await reader.readexactly(10)  # the client's signature
    if ends:
        if len(says) >= len(GREETING):  # as a relay whose key is another one: at the client's HELLO
            await reader.readexactly(54 + 200)
        writer.close()
    else:
        await reader.read()
        writer.close()


@pytest.mark.parametrize(
    ("says", "ends", "reasons", "dead"),
    [
        (b"", False, {SILENT}, False),
        (b"", True, {SHUT}, False),
        (GREETING[:12], True, {SHUT}, False),
        (GREETING, False, {HALF_WAY}, False),
        (GREETING, True, {ENDED}, False),
        (b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n", True, {OTHER}, True),
        (b"SSH-2.0-OpenSSH_9.2\r\n", False, {OTHER}, True),
    ],
    ids=["silent", "shut", "shut in its greeting", "hangs half way", "another key", "http", "ssh"],
)
async def test_what_listens_in_place_of_a_relay_is_told_apart(
    zmq_context: Context, robot_keys: SecretKey, says: bytes, ends: bool, reasons: set[str], dead: bool
) -> None:
    server = await asyncio.start_server(lambda r, w: keep(r, w, says, ends=ends), "127.0.0.1", 0)
    endpoint = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    hangs = not ends and not dead
    handshake_ivl_ms = 500 if hangs else HANDSHAKE_IVL_MS
    client = Client(zmq_context, endpoint, (robot_keys, robot_keys.public_key), handshake_ivl_ms=handshake_ivl_ms)
    try:
        await until(lambda: client.reasons)
        # How many bytes came is not known of a connection that libzmq has closed before we look: then it says less.
        less = {SILENT, UNFINISHED} if hangs else set() if dead else {CUT}
        assert client.reasons[0] in reasons | less
        await until(lambda: reasons & set(client.reasons) and bool(client.dead) == dead)
        assert client.rebuilds == []
    finally:
        client.close()
        server.close()


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EINTR])
def test_a_handshake_that_ran_out_of_time_is_one_also_after_a_standstill(number: int) -> None:
    """A process that is continued finds its wait interrupted: libzmq has this errno when its timer comes next."""
    told = [transport_watch._unfinished(number, received) for received in (0, 64, None)]
    assert told == [SILENT, HALF_WAY, UNFINISHED]
    assert transport_watch._unfinished(errno.EPIPE, 0) == SHUT


async def test_connections_are_counted_until_they_end(zmq_context: Context) -> None:
    server = Server(zmq_context)
    clients = [Client(zmq_context, server.endpoint) for _ in range(3)]
    await until(lambda: len(server.table) == 3)
    assert server.table.half_open == 3
    for number, client in enumerate(clients):
        await until(lambda client=client, number=number: client.dealer.send(b"c%d" % number))  # type: ignore[misc]
    await until(lambda: server.table.half_open == 0)
    assert [len(server.table.handles_of(f"c{number}")) for number in range(3)] == [1, 1, 1]
    for client in clients:
        client.close()
    await until(lambda: len(server.table) == 0)
    assert server.table.accepted == 3
    server.close()


async def test_all_that_has_happened_is_taken_in_at_once(zmq_context: Context) -> None:
    """A message of the last of many connections must not be taken for one of a connection that is not known."""
    server = Server(zmq_context, max_half_open_per_source=0, max_half_open=0)
    connections = []
    for _ in range(BATCH + 10):
        connections.append(socketlib.create_connection(server.address))
        assert connections[-1].recv(1) == b"\xff"  # it is accepted
    assert len(server.table) == 0
    server.table.take_in()
    assert len(server.table) == len(server.table.items()) == BATCH + 10
    for connection in connections:
        connection.close()
    server.close()


async def test_half_open_connections_are_capped_and_age_out(zmq_context: Context) -> None:
    server = Server(zmq_context, max_half_open_per_source=4)
    silent = [socketlib.create_connection(server.address) for _ in range(10)]
    await until(lambda: server.table.accepted == 10)
    assert server.table.capped == 6
    await until(lambda: len(server.table) == 4)
    assert server.table.half_open == 4
    server.now_s = 10.1  # libzmq would have ended those that did not finish their handshake
    assert server.table.half_open == 0
    client = Client(zmq_context, server.endpoint)
    await until(lambda: client.dealer.send(b"robot1"))
    await until(lambda: server.seen == [b"robot1"])
    for connection in silent:
        connection.close()
    client.close()
    await until(lambda: len(server.table) == 0)
    server.close()


class FakeHandle:
    """A connection that libzmq notices the end of when the test says so."""

    def __init__(self, source: str) -> None:
        self.peer = (source, 1)
        self.was_cut = False

    def cut(self) -> bool:
        self.was_cut = True
        return True


class Crowd:
    """Connections of a table that come and end in the order of the test."""

    def __init__(self, context: Context, monkeypatch: pytest.MonkeyPatch, **caps: int) -> None:
        self.server = Server(context, **caps)
        self.table = self.server.table
        self._monkeypatch = monkeypatch
        self._fd = 10_000

    def comes(self, source: str = "192.0.2.1") -> tuple[int, FakeHandle]:
        handle = FakeHandle(source)
        self._monkeypatch.setattr(TcpHandle, "of", lambda *_args, **_kwargs: handle)
        self._fd += 1
        self.table._on_event(MonitorEvent(EventKind.ACCEPTED, self._fd, self.server.endpoint))
        return self._fd, handle


async def test_what_was_cut_takes_no_place_of_a_source(zmq_context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    """However fast somebody comes again and again, faster than the ends of what was cut are noticed."""
    crowd = Crowd(zmq_context, monkeypatch, max_half_open_per_source=4)
    first = [crowd.comes() for _ in range(4)]
    assert all(crowd.comes()[1].was_cut for _ in range(100))
    assert crowd.table.half_open == 4 and crowd.table.capped == 100
    crowd.table._on_event(MonitorEvent(EventKind.DISCONNECTED, first[0][0], crowd.server.endpoint))
    assert not crowd.comes()[1].was_cut, "there is a place"
    assert crowd.comes()[1].was_cut and not any(handle.was_cut for _, handle in first)
    crowd.server.close()


async def test_the_oldest_of_a_source_gives_way_when_it_had_its_time(
    zmq_context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowd = Crowd(zmq_context, monkeypatch, max_half_open_per_source=4)
    other = crowd.comes("192.0.2.2")
    bound = crowd.comes()
    crowd.table.bind_user(bound[0], "robot1")
    old = [crowd.comes() for _ in range(4)]
    crowd.server.now_s = HANDSHAKE_GRACE_S - 0.1
    assert crowd.comes()[1].was_cut and not any(handle.was_cut for _, handle in old)
    crowd.server.now_s = HANDSHAKE_GRACE_S
    for number in range(4):
        assert not crowd.comes()[1].was_cut
        assert [handle.was_cut for _, handle in old] == [each <= number for each in range(4)], "the oldest alone"
        assert crowd.table.half_open == 5
    assert crowd.comes()[1].was_cut, "those that came just now have their time, too"
    assert not other[1].was_cut and not bound[1].was_cut
    assert crowd.table.capped == 6
    crowd.server.close()


async def test_the_oldest_of_all_gives_way_when_it_had_its_time(
    zmq_context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowd = Crowd(zmq_context, monkeypatch, max_half_open=4)
    old = [crowd.comes(f"192.0.2.{number}") for number in range(4)]
    assert crowd.comes("192.0.2.9")[1].was_cut
    crowd.server.now_s = HANDSHAKE_GRACE_S
    assert not crowd.comes("192.0.2.9")[1].was_cut
    assert [handle.was_cut for _, handle in old] == [True, False, False, False]
    assert crowd.table.half_open == 4
    crowd.server.close()


async def test_whoever_says_nothing_is_cut_after_a_while(zmq_context: Context) -> None:
    server = Server(zmq_context)
    client = Client(zmq_context, server.endpoint)
    await until(lambda: client.dealer.send(b"robot1"))
    await until(lambda: server.seen == [b"robot1"])
    silent = [socketlib.create_connection(server.address) for _ in range(3)]
    await until(lambda: server.table.accepted == 4)
    server.now_s = 19.9
    assert server.table.cut_silent(20.0) == 0
    server.now_s = 20.0
    assert server.table.cut_silent(20.0) == 3
    assert server.table.cut_silent(20.0) == 0, "each is counted once"
    await until(lambda: len(server.table) == 1)
    assert len(server.table.handles_of("robot1")) == 1
    for connection in silent:
        connection.close()
    client.close()
    server.close()


async def test_all_connections_are_capped(zmq_context: Context) -> None:
    server = Server(zmq_context, max_connections=2, max_half_open_per_source=0, max_half_open=0)
    first = [Client(zmq_context, server.endpoint) for _ in range(2)]
    await until(lambda: len(server.table) == 2)
    late = socketlib.create_connection(server.address)
    await until(lambda: server.table.capped == 1)
    with late:
        late.settimeout(DEADLINE_S)
        while late.recv(64):  # libzmq may have greeted it before it is cut
            pass
    await until(lambda: len(server.table) == 2, "it is gone")
    await until(lambda: all(client.watch.up for client in first), "the first two are connected")
    assert not any(client.reasons for client in first)
    for client in first:
        client.close()
    server.close()


async def test_hundreds_of_half_open_connections_do_not_keep_a_client_out(zmq_context: Context) -> None:
    server = Server(zmq_context, max_half_open_per_source=64, max_half_open=0)
    crowd = []
    for _ in range(500):
        connection = socketlib.socket()
        connection.setblocking(False)
        connection.connect_ex(server.address)
        crowd.append(connection)
    await until(lambda: server.table.accepted >= 400)
    server.table.max_half_open_per_source = 10_000  # the honest client comes from another address in life
    client = Client(zmq_context, server.endpoint)
    await until(lambda: client.dealer.send(b"robot1"))
    await until(lambda: b"robot1" in server.seen)
    assert server.table.capped > 300
    for connection in crowd:
        connection.close()
    client.close()
    await until(lambda: len(server.table) == 0)
    server.close()


async def test_the_tcp_socket_underneath(zmq_context: Context) -> None:
    server = Server(zmq_context)
    client = Client(zmq_context, server.endpoint)
    await until(lambda: client.handles)
    handle = client.handles[0]
    assert handle is not None
    assert handle.peer == server.address
    info = handle.info()
    assert info is not None
    assert 0 < info.rtt_s < 5
    assert info.sent_segments >= 1
    assert info.congestion_window_segments >= 1
    name = handle.congestion()
    assert name
    assert handle.set_congestion(name)
    assert not handle.set_congestion("no_such_thing")
    assert handle.set_user_timeout(12.5)
    assert handle.set_rto_max() in (True, False)  # kernels before 6.15 do not know it
    with socketlib.socket(fileno=os.dup(handle.fd)) as connection:
        assert connection.getsockopt(socketlib.IPPROTO_TCP, socketlib.TCP_USER_TIMEOUT) == 12500
    assert handle.cut()
    await until(lambda: client.reasons)
    client.close()
    server.close()


def test_a_handle_never_touches_another_socket_under_its_number() -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as listener:
        first = socketlib.create_connection(listener.getsockname())
        handle = TcpHandle.of(first.fileno())
        assert handle is not None
        number = first.fileno()
        first.close()
        assert handle.info() is None
        with socketlib.create_connection(listener.getsockname()) as other:
            assert other.fileno() == number  # the lowest free number is taken first
            assert handle.info() is None
            assert handle.congestion() is None
            assert not handle.set_user_timeout(1.0)
            assert not handle.cut()
            other.sendall(b"alive")


def test_what_is_no_tcp_connection_gives_no_handle() -> None:
    left, right = socketlib.socketpair()
    with left, right, socketlib.create_server(("127.0.0.1", 0)) as listener:
        assert TcpHandle.of(left.fileno()) is None
        assert TcpHandle.of(listener.fileno()) is None
        assert TcpHandle.of(10_000) is None
        with socketlib.create_connection(listener.getsockname()) as connection:
            port = listener.getsockname()[1]
            assert TcpHandle.of(connection.fileno(), peer_port=port) is not None
            assert TcpHandle.of(connection.fileno(), peer_port=port + 1) is None
            assert TcpHandle.of(connection.fileno(), local_port=port) is None


def test_a_handle_at_a_path_is_of_what_was_accepted_there_alone(tmp_path: Path) -> None:
    left, right = socketlib.socketpair()
    places: list[tuple[str | bytes, str]] = [
        (f"{tmp_path}/one", f"ipc://{tmp_path}/one"),
        (b"\0sern-test-one", "ipc://@sern-test-one"),
    ]
    for address, endpoint in places:
        with socketlib.socket(socketlib.AF_UNIX) as listener, socketlib.socket(socketlib.AF_UNIX) as peer:
            listener.bind(address)
            listener.listen()
            peer.connect(address)
            accepted = listener.accept()[0]
            assert SocketHandle.at_path(left.fileno(), endpoint) is None
            assert SocketHandle.at_path(accepted.fileno(), endpoint + "x") is None
            handle = SocketHandle.at_path(accepted.fileno(), endpoint)
            assert handle is not None and handle.cut()
            assert peer.recv(1) == b"", "it has ended"
            accepted.close()
            assert not handle.cut()
    with left, right:
        left.sendall(b"alive")
        assert right.recv(5) == b"alive"


async def test_an_address_that_was_let_go_of_counts_as_such_also_when_the_time_is_over(zmq_context: Context) -> None:
    """The process stood still for longer than it wanted to wait; libzmq's thread had said it by then."""
    server = Server(zmq_context)
    server.router.socket.unbind(server.endpoint)
    await until(lambda: server.table.await_unbound(-math.inf))
    assert server.table.unbound
    server.close()


async def test_a_revoked_user_loses_the_connection_and_is_refused(
    zmq_context: Context, relay_keys: SecretKey, robot_keys: SecretKey
) -> None:
    names = {robot_keys.public_key: "robot1"}
    handler = ZapHandler(zmq_context)
    handler.add_domain("sern", lambda key, _address: names.get(key))
    socket = make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys)
    table = ConnectionTable(socket)
    seen: list[str] = []

    def on_message(_routing_id: bytes, user: str, _body: bytes) -> None:
        seen.append(user)
        table.bind_user(router.peer_details().fd, user)

    router = RouterSocket(socket, on_message)
    rebuilds: list[str] = []
    reasons: list[str] = []
    watches: list[TransportWatch] = []
    dealer = DealerSocket(
        make_client(
            zmq_context,
            socket.getsockopt_string(zmq.LAST_ENDPOINT),
            robot_keys,
            relay_keys.public_key,
            before_connect=lambda s: watches.append(
                TransportWatch(s, lambda _handle: None, reasons.append, rebuilds.append, rebuilds.append)
            ),
        ),
        lambda _body: None,
    )
    await until(lambda: dealer.send(b"hello"))
    await until(lambda: seen == ["robot1"])
    names.clear()
    assert table.cut_user("robot1") == 1
    await until(lambda: rebuilds)
    assert reasons[0] == "the connection to the relay was lost"
    assert reasons[-1].startswith("relay refused our key")
    watches[0].close()
    dealer.close()
    table.close()
    router.close()
    handler.close()


@pytest.mark.parametrize(
    ("endpoint", "port"), [("tcp://127.0.0.1:5555", 5555), ("tcp://[::1]:80", 80), ("ipc:///x:1", None), ("", None)]
)
def test_port_of(endpoint: str, port: int | None) -> None:
    assert port_of(endpoint) == port
