"""Who gets in: the ZAP handler, and the self-test that finds a server which admits everyone."""

import logging
import socket as socketlib

import pytest
import zmq

from sern_core.vocabulary.errors import SernError, UsageError
from sern_runtime.config.keys import SecretKey
from sern_runtime.monitor import EventKind, MonitorEvent, SocketMonitor
from sern_runtime.transport_watch import TransportWatch
from sern_runtime.zap import Refusal, TemporaryRefusal, ZapHandler, reachable, self_test
from sern_runtime.zmq_setup import make_client, make_server
from sern_runtime.zmq_socket import DealerSocket, RouterSocket
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]


class Site:
    """A server with a ZAP handler, and clients that watch their transport."""

    def __init__(self, context: Context, keys: SecretKey) -> None:
        self.context = context
        self.keys = keys
        self.known: dict[str, str | Refusal | TemporaryRefusal] = {}
        self.handler = ZapHandler(context)
        self.handler.add_domain("sern", lambda key, _address: self.known.get(key))
        self.seen: list[tuple[str, bytes]] = []
        server = make_server(context, ["tcp://127.0.0.1:*"], keys)
        self.endpoint = server.getsockopt_string(zmq.LAST_ENDPOINT)
        self.router = RouterSocket(server, lambda _id, user, body: self.seen.append((user, body)))
        self.clients: list[tuple[TransportWatch, DealerSocket]] = []

    def client(self, keys: SecretKey | None, server_key: str | None = None) -> tuple[DealerSocket, list[str]]:
        events: list[str] = []
        watches: list[TransportWatch] = []

        def watch(socket: "zmq.Socket[bytes]") -> None:
            watches.append(
                TransportWatch(
                    socket,
                    lambda handle: events.append(f"up {handle is not None}"),
                    lambda reason: events.append(f"down {reason}"),
                    lambda reason: events.append("rebuild"),
                    lambda reason: events.append("dead"),
                )
            )

        key = None if keys is None else server_key or self.keys.public_key
        dealer = DealerSocket(
            make_client(self.context, self.endpoint, keys, key, before_connect=watch), lambda _body: None
        )
        self.clients.append((watches[0], dealer))
        return dealer, events

    def close(self) -> None:
        for watch, dealer in self.clients:
            watch.close()
            dealer.close()
        self.router.close()
        self.handler.close()


@pytest.fixture
async def site(zmq_context: Context, relay_keys: SecretKey):  # type: ignore[no-untyped-def]
    site = Site(zmq_context, relay_keys)
    yield site
    site.close()


async def test_a_known_key_is_admitted_under_its_name(site: Site, robot_keys: SecretKey) -> None:
    site.known[robot_keys.public_key] = "robot1"
    dealer, events = site.client(robot_keys)
    await until(lambda: dealer.send(b"hello"))
    await until(lambda: site.seen == [("robot1", b"hello")])
    assert events == ["up True"]
    assert site.handler.counters.admitted == 1


async def test_an_unknown_key_is_refused_and_the_client_told_to_rebuild(
    site: Site, stranger_keys: SecretKey, caplog: pytest.LogCaptureFixture
) -> None:
    _, events = site.client(stranger_keys)
    await until(lambda: "rebuild" in events)
    assert events[0].startswith("down relay refused our key: ")
    assert site.handler.counters.unknown_key == 1
    assert site.seen == []
    assert stranger_keys.public_key in caplog.text
    assert stranger_keys.secret_key not in caplog.text


async def test_a_key_that_is_known_and_refused_is_not_called_unknown(
    site: Site, robot_keys: SecretKey, caplog: pytest.LogCaptureFixture
) -> None:
    site.known[robot_keys.public_key] = Refusal("the key of robot1 expired")
    _, events = site.client(robot_keys)
    await until(lambda: "rebuild" in events)
    assert site.handler.counters.unknown_key == 1
    assert "refused a connection from 127.0.0.1: the key of robot1 expired" in caplog.messages
    assert "unknown key" not in caplog.text


async def test_not_now_is_no_final_refusal(site: Site, robot_keys: SecretKey) -> None:
    site.known[robot_keys.public_key] = TemporaryRefusal("reloading")
    _, events = site.client(robot_keys)
    await until(lambda: site.handler.counters.not_now)
    assert "rebuild" not in events
    assert site.seen == []


async def test_a_lookup_that_raises_is_answered_and_the_handler_lives(
    site: Site, robot_keys: SecretKey, site_keys: SecretKey, caplog: pytest.LogCaptureFixture
) -> None:
    def lookup(key: str, _address: str) -> str:
        if key == robot_keys.public_key:
            raise RuntimeError("a fault of ours")
        return "site1"

    site.handler.add_domain("sern", lookup)
    site.client(robot_keys)
    await until(lambda: site.handler.counters.failed)
    dealer, _ = site.client(site_keys)
    await until(lambda: dealer.send(b"hello"))
    await until(lambda: site.seen == [("site1", b"hello")])
    assert "a fault of ours" in caplog.text


async def test_the_connection_cap_is_asked_first(zmq_context: Context, relay_keys: SecretKey) -> None:
    asked: list[str] = []

    def admit(address: str) -> bool:
        asked.append(address)
        return False

    handler = ZapHandler(zmq_context, admit=admit)
    handler.add_domain("sern", lambda _key, _address: "robot1")
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys)
    endpoint = server.getsockopt_string(zmq.LAST_ENDPOINT)
    client = make_client(zmq_context, endpoint, relay_keys, relay_keys.public_key)
    await until(lambda: handler.counters.capped)
    assert asked == ["127.0.0.1"]
    assert handler.counters.admitted == 0
    client.close()
    server.close()
    handler.close()


async def test_the_wrong_server_key_is_explained(site: Site, robot_keys: SecretKey, site_keys: SecretKey) -> None:
    site.known[robot_keys.public_key] = "robot1"
    _, events = site.client(robot_keys, site_keys.public_key)
    await until(lambda: events)
    assert "server_key_file" in events[0]
    assert site.handler.counters.admitted == 0


async def test_a_client_without_keys_is_explained(site: Site) -> None:
    _, events = site.client(None)
    await until(lambda: "rebuild" in events)
    assert "one side has keys configured" in events[0]


async def test_garbage_and_half_a_greeting_leave_the_server_alone(site: Site, robot_keys: SecretKey) -> None:
    site.known[robot_keys.public_key] = "robot1"
    address = ("127.0.0.1", int(site.endpoint.rpartition(":")[2]))
    crooked = [b"GET / HTTP/1.1\r\n\r\n", b"\xff\0\0\0\0\0\0\0\1\x7f", bytes(range(256)) * 8, b""]
    connections = [socketlib.create_connection(address) for _ in crooked]
    for connection, data in zip(connections, crooked, strict=True):
        connection.sendall(data)
    dealer, _ = site.client(robot_keys)
    await until(lambda: dealer.send(b"hello"))
    await until(lambda: site.seen == [("robot1", b"hello")])
    for connection in connections:
        connection.close()


async def test_ping_goes_through_the_handler(site: Site) -> None:
    for expected in (1, 2, 3):
        site.handler.ping()
        await until(lambda expected=expected: site.handler.counters.pings == expected)  # type: ignore[misc]
    assert site.handler.counters.unknown_key == 0
    assert site.handler.counters.malformed == 0


@pytest.mark.parametrize(
    "frames",
    [
        [b"", b"1.0"],
        [b"", b"1.0", b"1", b"sern", b"127.0.0.1", b"", b"CURVE"],
        [b"", b"1.0", b"1", b"sern", b"127.0.0.1", b"", b"NULL"],
        [b"", b"1.0", b"1", b"sern", b"127.0.0.1", b"", b"PLAIN", b"user", b"password"],
        [b"", b"2.0", b"1", b"sern", b"127.0.0.1", b"", b"CURVE", bytes(32)],
        [b"x", b"1.0", b"1", b"sern", b"127.0.0.1", b"", b"CURVE", bytes(32)],
        [b"", b"1.0", b"1", b"sern", b"127.0.0.1", b"", b"CURVE", bytes(31)],
    ],
)
async def test_malformed_requests_are_counted_and_never_admitted(site: Site, frames: list[bytes]) -> None:
    site.handler.add_domain("sern", lambda _key, _address: "anyone")
    socket = site.context.socket(zmq.DEALER)
    socket.connect("inproc://zeromq.zap.01")
    dealer = DealerSocket(socket, lambda _body: None)
    assert dealer.send_frames(frames)
    counters = site.handler.counters
    await until(lambda: counters.malformed + counters.failed)
    assert counters.admitted == 0
    dealer.close()


async def test_the_self_test_passes_and_raises_no_alarm(
    site: Site, relay_keys: SecretKey, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    await self_test(site.context, site.handler, [site.endpoint], relay_keys.public_key)
    assert site.handler.counters.probes == 1
    assert site.handler.counters.unknown_key == 0
    assert caplog.text == ""


async def test_the_self_test_finds_a_directory_that_admits_anyone(site: Site, relay_keys: SecretKey) -> None:
    site.handler.add_domain("sern", lambda _key, _address: "anyone")
    with pytest.raises(SernError, match=r"refusing to start: .* admits an unknown key"):
        await self_test(site.context, site.handler, [site.endpoint], relay_keys.public_key)


async def test_the_self_test_finds_a_server_that_asks_nobody(site: Site, relay_keys: SecretKey) -> None:
    """CURVE alone, in a context without a handler: libzmq admits every key, in silence."""
    with zmq.Context() as other, other.socket(zmq.ROUTER) as socket:
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, relay_keys.secret_key.encode())
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind("tcp://127.0.0.1:*")
        endpoint = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        with pytest.raises(SernError, match="admits an unknown key"):
            await self_test(site.context, site.handler, [site.endpoint, endpoint], relay_keys.public_key)


async def test_a_server_of_ours_admits_nobody_without_a_handler(
    zmq_context: Context, relay_keys: SecretKey, robot_keys: SecretKey
) -> None:
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys)
    seen: list[bytes] = []
    router = RouterSocket(server, lambda _id, _user, body: seen.append(body))
    endpoint = server.getsockopt_string(zmq.LAST_ENDPOINT)
    client = make_client(zmq_context, endpoint, robot_keys, relay_keys.public_key)
    monitored: list[MonitorEvent] = []
    monitor = SocketMonitor(server, monitored.append)
    await until(lambda: any(event.kind is EventKind.HANDSHAKE_FAILED_NO_DETAIL for event in monitored))
    assert not any(event.kind is EventKind.HANDSHAKE_SUCCEEDED for event in monitored)
    monitor.close()
    client.close()
    router.close()


async def test_the_self_test_finds_someone_else_at_the_port(site: Site, relay_keys: SecretKey) -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(SernError, match=r"did not answer the self-test within 0\.2 s"):
            await self_test(site.context, site.handler, [endpoint], relay_keys.public_key, timeout_s=0.2)


@pytest.mark.parametrize(
    ("bound", "expected"),
    [
        ("tcp://0.0.0.0:5555", "tcp://127.0.0.1:5555"),
        ("tcp://*:5555", "tcp://127.0.0.1:5555"),
        ("tcp://[::]:5555", "tcp://[::1]:5555"),
        ("tcp://192.168.0.3:5555", "tcp://192.168.0.3:5555"),
        ("ipc:///run/sern", "ipc:///run/sern"),
    ],
)
def test_reachable(bound: str, expected: str) -> None:
    assert reachable(bound) == expected


async def test_one_handler_a_context_and_no_empty_domain(site: Site) -> None:
    with pytest.raises(UsageError, match="has a ZAP handler already"):
        ZapHandler(site.context)
    with pytest.raises(UsageError, match="empty ZAP domain"):
        site.handler.add_domain("", lambda _key, _address: None)
