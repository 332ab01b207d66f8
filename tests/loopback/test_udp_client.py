"""The client's end of the UDP lane: it finds the relay, keeps its session when the network changes, and never dies."""

import errno
import socket as socketlib
from collections.abc import AsyncIterator
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_runtime import udp, udp_client
from sern_runtime.seal import Cipher, SessionParameters, Side, make_seals
from sern_runtime.udp import INNER_BYTES, TYPE_CHALLENGE, TYPE_RESPONSE
from sern_runtime.udp_socket import connected_socket
from sern_runtime.zmq_socket import SendResult
from sern_tools.ports import free_ports
from tests.loopback.udp_support import ROBOT, Client, Relay
from tests.support import until

NO_IPV6 = "the loopback has no IPv6 here: sysctl net.ipv6.conf.lo.disable_ipv6=0"


def has_ipv6() -> bool:
    try:
        with socketlib.socket(socketlib.AF_INET6, socketlib.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.fixture
async def relay() -> AsyncIterator[Relay]:
    relay = Relay(echo=True)
    yield relay
    relay.close()


@pytest.fixture
async def client(relay: Relay) -> AsyncIterator[Client]:
    client = Client(relay.open().parameters)
    yield client
    client.close()


async def test_round_trip(relay: Relay) -> None:
    client = Client(relay.open().parameters)
    assert client.udp.send(b"too early") is SendResult.FULL
    await client.validated()
    session = relay.server.sessions[client.udp.parameters.id]
    await until(lambda: session.validated)
    assert client.writable == 1
    assert client.paths == [
        (("127.0.0.1", session.parameters.port), False),
        (("127.0.0.1", session.parameters.port), True),
    ]
    assert relay.paths == [(ROBOT, client.local, False), (ROBOT, client.local, True)]
    for data in (b"1", b"2" * 1100, b""):
        assert client.udp.send(data)
    await until(lambda: client.received == [b"echo 1", b"echo " + b"2" * 1100, b"echo "])
    assert client.udp.problem == "" and client.udp.rebinds == 0
    client.close()


SIX = pytest.mark.skipif(not has_ipv6(), reason=NO_IPV6)


@SIX
async def test_ipv6() -> None:
    relay = Relay(["udp://127.0.0.1:*", "udp://[::1]:*"], echo=True)
    ports = relay.server.ports
    client = Client(relay.server.open_session(ROBOT, ("aes-256-gcm",), port=ports[1]).parameters, host="::1")
    await client.validated()
    client.udp.send(b"six")
    await until(lambda: client.received == [b"echo six"])
    assert relay.paths[0][1][0] == "::1"
    client.close()
    relay.close()


async def test_a_name_is_looked_up(relay: Relay) -> None:
    client = Client(relay.open().parameters, host="localhost")
    await client.validated()  # also where the name means ::1 first, at which nobody listens
    client.udp.rebind()
    await until(lambda: client.udp.rebinds and client.udp.validated)
    client.close()


async def test_a_rebind_in_the_middle_of_both_streams_loses_nothing(relay: Relay, client: Client) -> None:
    """What the relay was sending to the old address arrives as well; what it holds back leaves after the challenge."""
    await client.validated()
    session = relay.server.sessions[client.udp.parameters.id]
    await until(lambda: session.validated)
    count, down = 600, 0
    for number in range(count):
        await until(partial(client.udp.send, b"%d" % number))
        if session.ready() and session.send(b"down %d" % down):
            down += 1
        if number % 150 == 75:
            client.udp.rebind()
        if number % 10 == 0:  # so that kernel buffers never overflow
            await until(lambda: len(relay.received) > number - 10)  # noqa: B023 - awaited at once
    await until(lambda: len(relay.received) == count)
    assert sorted(relay.data(), key=int) == [b"%d" % number for number in range(count)]
    await until(lambda: session.validated and session.address == client.local)
    for number in range(down, count):
        await until(partial(session.send, b"down %d" % number))
    await until(lambda: sum(data.startswith(b"down") for data in client.received) == count)
    assert client.udp.rebinds == 4
    assert sorted(data for data in client.received if data.startswith(b"down")) == sorted(
        b"down %d" % number for number in range(count)
    )
    assert not any(relay.server.refused().values())


async def test_the_old_socket_is_left_after_a_while(
    relay: Relay, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp_client, "LINGER_S", 0.01)
    await client.validated()
    old = client.udp.socket
    client.udp.rebind()
    await until(lambda: client.udp.validated and client.udp._old is None)
    assert old is not None and old.socket.fileno() == -1


async def test_a_refused_port_is_not_fatal_and_the_relay_that_comes_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp_client, "REBIND_MIN_S", 0.01)
    monkeypatch.setattr(udp_client, "REBIND_MAX_S", 0.02)
    (port,) = free_ports(1)
    relay = Relay()
    session = relay.open()
    client = Client(session.parameters, port=port)
    await until(lambda: client.udp.rebinds > 2 and client.udp.send(b"x"), "new sockets after ECONNREFUSED")
    assert "connection refused" in client.udp.problem and not client.udp.validated
    sealer, opener = make_seals(session.parameters, Side.RELAY)
    with socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", port))
        late.setblocking(False)

        def answered() -> bool:
            with suppress(BlockingIOError):
                datagram, address = late.recvfrom(2000)
                inner = opener.open(datagram)
                assert inner is not None
                if inner[:1] == TYPE_CHALLENGE:
                    late.sendto(sealer.seal(TYPE_RESPONSE + inner[1:]), address)
            return client.udp.validated

        await until(answered)
    assert client.udp.problem == ""
    client.close()
    relay.close()


async def test_without_a_network_it_waits_for_one(
    relay: Relay, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    await client.validated()
    monkeypatch.setattr(udp_client, "REBIND_MIN_S", 0.01)

    def no_way(*_: object, **__: object) -> socketlib.socket:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(udp_client, "connected_socket", no_way)
    client.udp.rebind()
    assert client.udp.problem == "no way to 127.0.0.1: network is unreachable"
    assert client.udp.send(b"the old socket stays in use")
    monkeypatch.setattr(udp_client, "connected_socket", connected_socket)
    await until(lambda: client.udp.rebinds == 1 and client.udp.validated)
    assert client.udp.problem == ""


async def test_what_is_no_name_is_a_problem_and_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp_client, "REBIND_MIN_S", 0.001)
    parameters = SessionParameters(1, bytes(32), Cipher.AES_256_GCM, 5555)
    client = Client(parameters, host="no..host")
    await until(lambda: client.udp.problem)
    assert client.udp.problem == "cannot find no..host: not a host name"
    assert client.udp.send(b"x") is SendResult.FULL and not client.udp.ready()
    client.close()
    client.close()
    assert client.udp.send(b"x") is SendResult.GONE


async def test_closed_during_the_lookup(relay: Relay) -> None:
    client = Client(relay.open().parameters, host="localhost")
    client.udp.rebind()
    assert client.udp._lookup is not None
    client.close()
    assert client.udp.socket is None and client.paths == []


async def test_the_next_address_of_a_host_is_tried_when_one_is_silent(
    relay: Relay, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp_client, "PATH_TIMEOUT_S", 0.05)
    monkeypatch.setattr(udp_client, "PROBE_MIN_S", 0.01)
    parameters = relay.open().parameters
    asked: list[object] = []
    with socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.2", parameters.port))

        def two(*arguments: object, **__: object) -> list[Any]:
            asked.append(arguments)
            if len(asked) > 1:  # the address that answers has all the time that it takes
                monkeypatch.setattr(udp_client, "PATH_TIMEOUT_S", 3600.0)
            return [
                (socketlib.AF_INET, socketlib.SOCK_DGRAM, 17, "", (host, parameters.port))
                for host in ("127.0.0.2", "127.0.0.1")
            ]

        monkeypatch.setattr(socketlib, "getaddrinfo", two)
        client = Client(parameters)
        await client.validated()
        assert [(address[0], validated) for address, validated in client.paths] == [
            ("127.0.0.2", False),
            ("127.0.0.1", False),
            ("127.0.0.1", True),
        ]
        client.udp.rebind()  # the one that answered stays
        await client.validated()
        assert client.udp.address == ("127.0.0.1", parameters.port)
        client.close()


async def test_an_error_of_the_network_costs_a_datagram_and_brings_a_new_socket(
    relay: Relay, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp_client, "REBIND_MIN_S", 0.01)
    await client.validated()
    client.udp._rebind_delay_s = 0.01
    socket = client.udp.socket
    assert socket is not None
    real = socket.socket

    class Broken:
        def send(self, _data: bytes) -> None:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

    socket.socket = Broken()  # type: ignore[assignment]  # the loopback is always reachable
    for _ in range(3):
        assert client.udp.send(b"lost") is SendResult.OK
    socket.socket = real
    assert socket.send_errors == 3 and client.udp.problem == "the network says: network is unreachable"
    await until(lambda: client.udp.rebinds == 1 and client.udp.validated)
    assert client.udp.send(b"found")
    await until(lambda: relay.data() == [b"found"])


async def test_other_errors_cost_a_datagram_only(client: Client) -> None:
    await client.validated()
    socket = client.udp.socket
    assert socket is not None
    real = socket.socket

    class Broken:
        def send(self, _data: bytes) -> None:
            raise OSError(errno.EMSGSIZE, "Message too long")

    socket.socket = Broken()  # type: ignore[assignment]
    assert client.udp.send(b"lost") is SendResult.OK
    socket.socket = real
    assert socket.send_errors == 1 and client.udp._again is None and client.udp.problem == ""


async def test_a_full_send_buffer_is_told_and_its_end(client: Client) -> None:
    await client.validated()
    socket = client.udp.socket
    assert socket is not None
    real = socket.socket

    class FullSocket:
        def send(self, _data: bytes) -> None:
            raise BlockingIOError(errno.EAGAIN, "full")

    before = client.writable
    socket.socket = FullSocket()  # type: ignore[assignment]
    assert client.udp.send(b"x") is SendResult.FULL and not client.udp.ready()
    socket.socket = real
    await until(lambda: client.writable == before + 1)
    assert client.udp.ready()


async def test_the_relay_that_lost_its_clients_address_finds_it(
    relay: Relay, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay's challenge to a moved client is answered from the new address without the owner's help."""
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 0.01)
    await client.validated()
    session = relay.server.sessions[client.udp.parameters.id]
    for _ in range(5):
        client.udp.rebind()
        await until(lambda: session.validated and session.address == client.local and client.udp.validated)


async def test_closed_in_its_own_callback(relay: Relay) -> None:
    ending = Client(relay.open().parameters, on_data=lambda _data: ending.close())
    await ending.validated()
    ending.udp.send(b"1")
    ending.udp.send(b"2")
    await until(lambda: ending.udp.closed)
    assert ending.received == [b"echo 1"]


async def test_limits(client: Client) -> None:
    await client.validated()
    with pytest.raises(UsageError, match="1172 bytes do not fit the UDP lane: at most 1171"):
        client.udp.send(bytes(INNER_BYTES + 1))
    client.udp.sealer.counter = client.udp.sealer._limit
    assert client.udp.rekey_due and client.udp.send(b"x") is SendResult.GONE
