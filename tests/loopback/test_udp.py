"""The relay's end of the UDP lane, against a client made by hand: who may send, and where the relay sends to."""

import asyncio
import errno
import socket as socketlib
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from sern_core.vocabulary.errors import ConfigError, RefusedError, UsageError
from sern_runtime import udp, udp_socket
from sern_runtime.seal import UDP_PAYLOAD_BYTES, Cipher, SessionParameters, Side
from sern_runtime.udp import (
    AMPLIFICATION,
    INNER_BYTES,
    TOKEN_BYTES,
    TYPE_CHALLENGE,
    TYPE_DATA,
    TYPE_RESPONSE,
    UdpServer,
)
from sern_runtime.zmq_socket import SendResult
from tests.loopback.test_udp_client import SIX
from tests.loopback.udp_support import OFFERED, ROBOT, SITE, RawClient, Relay
from tests.support import until


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is challenged again or given up while a test waits; those that ask for it set times of their own."""
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 3600.0)
    monkeypatch.setattr(udp, "PATH_TIMEOUT_S", 3600.0)


@pytest.fixture
async def relay() -> AsyncIterator[Relay]:
    relay = Relay()
    yield relay
    relay.close()


@contextmanager
def raw_client(parameters: SessionParameters, *, side: Side = Side.CLIENT) -> Iterator[RawClient]:
    client = RawClient(parameters, side=side)
    try:
        yield client
    finally:
        client.close()


@pytest.fixture
def client(relay: Relay) -> Iterator[RawClient]:
    with raw_client(relay.open().parameters) as client:
        yield client


def has(relay: Relay, data: bytes) -> bool:
    return data in relay.data()


async def barrier(relay: Relay, client: RawClient, mark: bytes = b"barrier") -> None:
    """What was sent before this has been looked at: datagrams on the loopback stay in order."""
    client.send(mark)
    await until(lambda: mark in relay.data(), "the barrier")


async def settle(relay: Relay, client: RawClient, index: int = 0) -> None:
    """The client is at that address, and validated."""
    client.send(b"here", index)
    await client.answer_challenge(index)
    await until(lambda: relay.paths[-1:] == [(ROBOT, client.address(index), True)], "validated")


@pytest.mark.parametrize("cipher", list(Cipher))
async def test_round_trip(cipher: Cipher) -> None:
    relay = Relay(echo=True, ciphers=[cipher])
    with raw_client(relay.open().parameters) as client:
        assert client.parameters.cipher is cipher
        for data in (b"x", b"y" * INNER_BYTES):
            client.send(data)
            await until(partial(has, relay, data))
        await until(lambda: b"echo x" in client.inner(TYPE_DATA))
    relay.close()


async def test_two_clients_share_a_socket(relay: Relay) -> None:
    robot, site = relay.open(ROBOT), relay.open(SITE)
    assert robot.parameters.port == site.parameters.port and robot.parameters.secret != site.parameters.secret
    with raw_client(robot.parameters) as first, raw_client(site.parameters) as second:
        for number in range(50):
            first.send(b"r%d" % number)
            second.send(b"s%d" % number)
        await until(lambda: len(relay.received) == 100)
        assert relay.data(ROBOT) == [b"r%d" % number for number in range(50)]
        assert relay.data(SITE) == [b"s%d" % number for number in range(50)]
        assert (robot.address, site.address) == (first.address(), second.address())
        assert robot.send(b"to the robot") and site.send(b"to the site")
        await until(lambda: first.inner(TYPE_DATA) == [b"to the robot"] and second.inner(TYPE_DATA) == [b"to the site"])
        second.parameters = SessionParameters(robot.id, site.parameters.secret, site.parameters.cipher, 1)
        first.put(struct.pack("!I", robot.id) + second.seal(b"not mine")[4:])
        await barrier(relay, first)
        assert b"not mine" not in relay.data(ROBOT)
        assert robot.opener.bad_tags == 1


@pytest.mark.parametrize(
    "position", [0, 3, 4, 11, 12, 20, -17, -16, -1], ids=lambda position: f"byte{position}".replace("-", "_")
)
async def test_a_changed_byte_is_refused(relay: Relay, client: RawClient, position: int) -> None:
    datagram = bytearray(client.seal(b"a message of some length"))
    datagram[position] ^= 1
    client.put(bytes(datagram))
    await barrier(relay, client)
    assert relay.data() == [b"barrier"]


@pytest.mark.parametrize(
    "make",
    [
        lambda client: b"",
        lambda client: client.seal(b"x")[:20],
        lambda client: client.sealer.seal(b""),  # sealed, but without an inner type
        lambda client: client.seal(b"x" * INNER_BYTES) + b"\0",
        lambda client: struct.pack("!I", client.parameters.id) + bytes(60_000),
    ],
    ids=["empty", "cut", "no type", "one too long", "huge"],
)
async def test_a_wrong_length_is_refused(relay: Relay, client: RawClient, make: Callable[[RawClient], bytes]) -> None:
    client.put(make(client))
    await barrier(relay, client)
    assert relay.data() == [b"barrier"]


async def test_unknown_inner_types_are_ignored(relay: Relay, client: RawClient) -> None:
    client.send(b"?", kind=b"\x07")
    await barrier(relay, client)
    assert relay.data() == [b"barrier"]


async def test_replays_are_counted_and_dropped(relay: Relay, client: RawClient) -> None:
    sent = [client.seal(b"%d" % number) for number in range(1200)]
    for number in (0, 2, 1, 2, 0, 1199, 1199, 5):
        client.put(sent[number])
    await barrier(relay, client)
    assert relay.data() == [b"0", b"2", b"1", b"1199", b"barrier"]
    assert relay.server.refused() == {"unknown": 0, "short": 0, "foreign": 0, "old": 1, "replayed": 3, "bad_tag": 0}


async def test_a_wrong_direction_or_cipher_does_not_open(relay: Relay) -> None:
    session = relay.open()
    other = next(cipher for cipher in Cipher if cipher is not session.parameters.cipher)
    wrong = SessionParameters(session.id, session.parameters.secret, other, session.parameters.port)
    with (
        raw_client(session.parameters) as client,
        raw_client(session.parameters, side=Side.RELAY) as mirror,
        raw_client(wrong) as stranger,
    ):
        mirror.send(b"my own words")
        stranger.send(b"another cipher")
        client.send(b"right")
        await until(lambda: relay.data() == [b"right"])
        await until(lambda: session.opener.bad_tags == 2)
        assert session.address == client.address()


async def test_a_flood_of_unknown_sessions_does_not_touch_a_real_one(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    flood = socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM)
    with flood:
        flood.connect(("127.0.0.1", client.parameters.port))
        for number in range(200):
            for junk in range(20):
                flood.send(struct.pack("!IQ", client.parameters.id ^ (junk + 1), number) + bytes(1188))
            client.send(b"%d" % number)
            await until(partial(has, relay, b"%d" % number))
    assert relay.data() == [b"here", *(b"%d" % number for number in range(200))]
    (listener,) = relay.server.listeners
    assert relay.server.unknown + listener.kernel_drops == 4000
    assert relay.server.unknown == 0 or not listener._filtered


async def test_without_the_filter_unknown_sessions_are_counted(relay: Relay, client: RawClient) -> None:
    (listener,) = relay.server.listeners
    listener.only(range(1000))  # more than the kernel compares one by one
    for number in range(100):
        client.put(struct.pack("!IQ", client.parameters.id ^ 1, number) + bytes(100))
    await barrier(relay, client)
    assert relay.server.unknown == 100 == relay.server.refused()["unknown"]
    assert listener.junk == 100 and listener.datagrams == 101


async def test_bad_tags_in_a_flood_are_read_in_batches(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    (listener,) = relay.server.listeners
    forged = bytearray(client.seal(bytes(1000)))
    forged[-1] ^= 1
    for number in range(300):
        client.put(bytes(forged))
        if number % 100 == 0:
            client.send(b"%d" % number)
        if number % 50 == 49:  # the usual receive buffer of a kernel holds some 180 of them
            await until(lambda count=number + 1: relay.server.refused()["bad_tag"] == count)  # type: ignore[misc]
    await barrier(relay, client)
    assert relay.data() == [b"here", b"0", b"100", b"200", b"barrier"]
    assert relay.server.refused()["bad_tag"] == 300
    assert listener.pauses > 0
    await until(lambda: listener._paused is None, "watched again")
    await barrier(relay, client, b"and at once")


async def test_the_client_is_followed_when_it_moves(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    session = relay.server.sessions[client.parameters.id]
    there = client.elsewhere()
    client.send(b"from there", there)
    await until(lambda: session.address == client.address(there))
    assert not session.validated
    assert session.send(b"small")  # within three times what came
    await client.answer_challenge(there)
    await until(lambda: session.validated)
    for _ in range(20):
        assert session.send(bytes(INNER_BYTES))
    await until(lambda: client.inner(TYPE_DATA, there) == [b"small", *[bytes(INNER_BYTES)] * 20])
    assert relay.paths == [
        (ROBOT, client.address(0), False),
        (ROBOT, client.address(0), True),
        (ROBOT, client.address(there), False),
        (ROBOT, client.address(there), True),
    ]
    assert client.inner(TYPE_DATA, 0) == []


async def test_only_the_newest_datagram_moves_the_client(relay: Relay, client: RawClient) -> None:
    """A datagram that was late on its way from the old address is taken, and does not lead the relay back."""
    late = client.seal(b"late")
    await settle(relay, client)
    there = client.elsewhere()
    client.put(late, there)
    await until(lambda: b"late" in relay.data())
    assert relay.server.sessions[client.parameters.id].address == client.address(0)
    assert len(relay.paths) == 2


async def test_a_replay_from_elsewhere_moves_nothing(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    there = client.elsewhere()
    seen = client.send(b"seen on the path")
    await until(lambda: b"seen on the path" in relay.data())
    client.put(seen, there)
    await barrier(relay, client)
    session = relay.server.sessions[client.parameters.id]
    assert session.address == client.address(0) and session.validated
    assert session.opener.replayed == 1
    assert client.bytes_at(there) == 0


async def test_a_copy_that_overtakes_the_original_is_undone_by_the_next(relay: Relay, client: RawClient) -> None:
    """Whoever forwards a datagram faster than the path is challenged, gets little, and loses the session again."""
    await settle(relay, client)
    session = relay.server.sessions[client.parameters.id]
    attacker = client.elsewhere()
    client.put(client.seal(b"copied"), attacker)
    await until(lambda: session.address == client.address(attacker))
    assert relay.paths[-1] == (ROBOT, client.address(attacker), False)
    client.send(b"the next one")
    await until(
        lambda: session.address == client.address(0) and session.validated, "no new challenge: it answered before"
    )
    assert session.send(bytes(INNER_BYTES))
    await until(lambda: client.inner(TYPE_DATA, 0))


async def test_at_most_three_times_the_bytes_go_to_an_address_that_has_not_answered(
    relay: Relay, client: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 0.005)
    session = relay.server.sessions[client.parameters.id]
    assert session.send(b"nobody there yet") is SendResult.FULL
    received = len(client.send(bytes(200)))
    await until(lambda: client.inner(TYPE_CHALLENGE))
    while session.send(bytes(10)) is not SendResult.FULL:
        assert client.bytes_at(0) <= AMPLIFICATION * received
    assert not session.ready()
    for number in range(20):  # challenges go on being sent, but not above that
        received += len(client.send(b"%d" % number))
        await until(partial(has, relay, b"%d" % number))
        session.send(bytes(10))
        assert client.bytes_at(0) <= AMPLIFICATION * received
    assert relay.writable == []
    received += len(client.send(bytes(800)))
    await until(lambda: relay.writable == [ROBOT], "there is room for a whole datagram again")
    while session.send(bytes(INNER_BYTES)) is not SendResult.FULL:
        assert client.bytes_at(0) <= AMPLIFICATION * received
    await client.answer_challenge()
    await until(lambda: session.validated)
    await until(lambda: relay.writable == [ROBOT, ROBOT])
    for _ in range(50):
        assert session.send(bytes(INNER_BYTES))


async def test_challenges_have_the_full_size_where_they_may(relay: Relay, client: RawClient) -> None:
    client.send(bytes(INNER_BYTES), kind=TYPE_CHALLENGE)  # as the client begins
    await until(lambda: client.inner(TYPE_CHALLENGE) and client.inner(TYPE_RESPONSE))
    assert [size for _, size, _ in client.got] == [UDP_PAYLOAD_BYTES, UDP_PAYLOAD_BYTES]
    assert client.inner(TYPE_RESPONSE) == [bytes(INNER_BYTES)]


@pytest.mark.parametrize("token", [b"", b"\0" * TOKEN_BYTES, b"short"])
async def test_a_wrong_response_validates_nothing(relay: Relay, client: RawClient, token: bytes) -> None:
    client.send(b"here")
    await until(lambda: client.inner(TYPE_CHALLENGE))
    client.send(token, kind=TYPE_RESPONSE)
    await barrier(relay, client)
    assert not relay.server.sessions[client.parameters.id].validated


async def test_the_response_to_an_earlier_address_does_not_validate_a_later_one(
    relay: Relay, client: RawClient
) -> None:
    client.send(b"here")
    await until(lambda: client.inner(TYPE_CHALLENGE))
    first = client.inner(TYPE_CHALLENGE)[-1]
    there = client.elsewhere()
    client.send(b"there", there)
    client.send(first, there, TYPE_RESPONSE)
    client.send(b"after", there)
    await until(lambda: b"after" in relay.data())
    session = relay.server.sessions[client.parameters.id]
    assert session.address == client.address(there) and not session.validated


async def test_a_lost_challenge_is_sent_again(relay: Relay, client: RawClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 0.005)
    client.send(bytes(1000))
    await until(lambda: len(client.inner(TYPE_CHALLENGE)) > 2)
    assert {challenge[:TOKEN_BYTES] for challenge in client.inner(TYPE_CHALLENGE)} == {
        client.inner(TYPE_CHALLENGE)[0][:TOKEN_BYTES]
    }


async def test_an_address_that_never_answers_is_given_up_for_the_last_good_one(
    relay: Relay, client: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    await settle(relay, client)
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 0.005)
    session = relay.server.sessions[client.parameters.id]
    there = client.elsewhere()
    client.put(client.seal(b"copied"), there)
    await until(lambda: session.address == client.address(there))
    while session.send(bytes(5)) is not SendResult.FULL:
        assert client.bytes_at(there) <= AMPLIFICATION * 100
    monkeypatch.setattr(udp, "PATH_TIMEOUT_S", 0.0)
    await until(lambda: session.address == client.address(0))
    assert session.validated and relay.writable == [ROBOT]
    assert relay.paths[-1] == (ROBOT, client.address(0), True)
    assert session.send(b"back")
    await until(lambda: client.inner(TYPE_DATA, 0) == [b"back"])


async def test_a_first_address_that_did_not_answer_is_challenged_again_when_it_speaks(
    relay: Relay, client: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "CHALLENGE_INTERVAL_S", 0.005)
    monkeypatch.setattr(udp, "PATH_TIMEOUT_S", 0.0)
    session = relay.server.sessions[client.parameters.id]
    client.send(b"here")
    await until(lambda: client.inner(TYPE_CHALLENGE) and session._retry is None, "given up")
    challenges = len(client.inner(TYPE_CHALLENGE))
    client.send(b"here again")
    await until(lambda: len(client.inner(TYPE_CHALLENGE)) > challenges)
    await client.answer_challenge()
    await until(lambda: session.validated)


async def test_a_closed_session_is_over_in_both_directions(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    session = relay.server.sessions[client.parameters.id]
    forged = bytearray(client.seal(b"x"))
    forged[-1] ^= 1
    client.put(bytes(forged))
    await until(lambda: session.opener.bad_tags == 1)
    relay.server.close_session(session)
    relay.server.close_session(session)
    assert session.closed and session.send(b"x") is SendResult.GONE and not session.ready()
    before = relay.data()
    client.send(b"too late")
    with raw_client(relay.open().parameters) as other:
        other.send(b"of the next session")
        await until(lambda: b"of the next session" in relay.data())
    assert relay.data() == [*before, b"of the next session"]
    assert relay.server.refused()["bad_tag"] == 1, "counts outlive their session"


@pytest.mark.parametrize("end_on", ["path", "datagram"])
async def test_the_server_may_be_closed_in_its_callbacks(end_on: str) -> None:
    seen: list[str] = []

    def ends(what: str) -> None:
        seen.append(what)
        if what == end_on:
            server.close()

    server = UdpServer(
        ["udp://127.0.0.1:*"],
        lambda _session, _data, _now: ends("datagram"),
        on_path=lambda _session, _address, _validated: ends("path"),
    )
    with raw_client(server.open_session(ROBOT, OFFERED).parameters) as client:
        client.send(b"1")
        client.send(b"2")
        await until(lambda: end_on in seen)
        assert seen[-1] == end_on


async def test_an_exhausted_key_is_gone_and_announced(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    session = relay.server.sessions[client.parameters.id]
    due = [session.rekey_due]
    session.sealer.counter = session.sealer._limit * 3 // 4
    due.append(session.rekey_due)
    assert due == [False, True]
    assert session.send(b"still")
    session.sealer.counter = session.sealer._limit
    assert session.send(b"x") is SendResult.GONE


async def test_more_than_fits_is_the_callers_mistake(relay: Relay) -> None:
    with pytest.raises(UsageError, match="1172 bytes do not fit the UDP lane: at most 1171"):
        relay.open().send(bytes(INNER_BYTES + 1))


async def test_no_cipher_in_common_opens_no_session(relay: Relay) -> None:
    with pytest.raises(RefusedError):
        relay.open(offered=["rot13"])
    assert relay.server.sessions == {}


async def test_a_handler_that_raises_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: problems.append(context["exception"]))
    seen: list[bytes] = []

    def picky(_session: object, data: bytes, _now: float) -> None:
        seen.append(data)
        if data == b"bad":
            raise ValueError(data)

    server = UdpServer(["udp://127.0.0.1:*"], picky)
    with raw_client(server.open_session(ROBOT, OFFERED).parameters) as client:
        for data in (b"1", b"bad", b"2", b"bad", b"3"):
            client.send(data)
        await until(lambda: len(seen) == 5)
        for _ in range(200):  # and in the pause of a flood, too
            client.put(struct.pack("!IQ", client.parameters.id, 10**6) + bytes(50))
        client.send(b"bad")
        client.send(b"4")
        await until(lambda: seen[-1] == b"4")
    server.close()
    assert [str(problem) for problem in problems] == ["b'bad'"] * 3


async def test_a_full_send_buffer_is_told_and_its_end(relay: Relay, client: RawClient) -> None:
    await settle(relay, client)
    session = relay.server.sessions[client.parameters.id]
    (listener,) = relay.server.listeners
    real = listener.socket

    class FullSocket:
        def sendto(self, _data: bytes, _address: object) -> None:
            raise BlockingIOError(errno.EAGAIN, "full")

    listener.socket = FullSocket()  # type: ignore[assignment]  # the loopback is never full
    assert session.ready()
    assert session.send(b"x") is SendResult.FULL
    assert not session.ready()
    listener.socket = real
    await until(lambda: relay.writable == [ROBOT])
    assert session.ready() and session.send(b"y")


async def test_several_listeners_serve_the_same_sessions() -> None:
    relay = Relay(["udp://127.0.0.1:*", "udp://127.0.0.1:*"])
    session = relay.open()
    first, second = relay.server.ports
    with raw_client(session.parameters) as client:
        client.send(b"at the first")
        await client.answer_challenge()
        await until(lambda: session.validated)
        client.parameters = SessionParameters(session.id, session.parameters.secret, session.parameters.cipher, second)
        client.send(b"at the second")
        await until(lambda: not session.validated, "the same address, seen by another listener, is another path")
        await until(lambda: len(client.inner(TYPE_CHALLENGE)) >= 2)
        assert relay.server.open_session(SITE, OFFERED, port=second).parameters.port == second != first
    relay.close()


@pytest.mark.parametrize(
    ("endpoint", "problem"),
    [
        ("tcp://127.0.0.1:5555", "not a UDP endpoint"),
        ("udp://127.0.0.1", "not a UDP endpoint"),
        ("udp://:5555", "not a UDP endpoint"),
        ("udp://127.0.0.1:65536", "not a UDP endpoint"),
        ("udp://::1:5555", "not a UDP endpoint"),
        ("udp://[127.0.0.1:5555", "not a UDP endpoint"),
        ("udp://no..host:5555", "cannot find the address"),
        ("udp://192.0.2.1:5555", "cannot listen on udp://192.0.2.1:5555"),
    ],
)
async def test_a_bad_endpoint_is_one_line(endpoint: str, problem: str) -> None:
    with pytest.raises(ConfigError) as error:
        UdpServer(["udp://127.0.0.1:*", endpoint], lambda _session, _data, _now: None)
    assert problem in str(error.value) and endpoint in str(error.value) and "\n" not in str(error.value)


async def test_every_address_is_ipv4_where_the_kernel_has_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    class FourOnly(socketlib.socket):
        def __init__(self, family: int = -1, *rest: Any, **kwargs: Any) -> None:
            if family == socketlib.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
            super().__init__(family, *rest, **kwargs)

    monkeypatch.setattr(socketlib, "socket", FourOnly)
    with udp_socket.bound_socket("udp://*:*") as socket:
        assert socket.getsockname()[0] == "0.0.0.0"
    with pytest.raises(ConfigError, match=r"cannot listen on udp://\[::\]:1: address family not supported"):
        udp_socket.bound_socket("udp://[::]:1")


async def test_a_port_in_use_is_named(relay: Relay) -> None:
    endpoint = f"udp://127.0.0.1:{relay.server.ports[0]}"
    with pytest.raises(ConfigError, match=f"cannot listen on {endpoint}: address already in use"):
        UdpServer([endpoint], lambda _session, _data, _now: None)


@pytest.mark.parametrize(
    ("endpoint", "host"),
    [
        ("udp://0.0.0.0:*", "0.0.0.0"),
        pytest.param("udp://[::]:*", "::", marks=SIX),
        pytest.param("udp://*:*", "::", marks=SIX),
        pytest.param("udp://[::ffff:127.0.0.1]:*", "::ffff:127.0.0.1", marks=SIX),
    ],
)
async def test_the_socket_is_set_up(endpoint: str, host: str) -> None:
    server = UdpServer([endpoint], lambda _session, _data, _now: None)
    socket = server.listeners[0].socket
    assert socket.getsockname()[0] == host
    assert socket.getsockopt(socketlib.IPPROTO_IP, 10) == 3, "Don't Fragment, and no ICMP believed"
    if socket.family == socketlib.AF_INET6:
        assert socket.getsockopt(socketlib.IPPROTO_IPV6, 23) == 3, "the same for IPv6"
        assert not socket.getsockopt(socketlib.IPPROTO_IPV6, socketlib.IPV6_V6ONLY)
    assert not socket.getblocking()
    server.close()
    server.close()
    assert server.ports == ()
    with pytest.raises(UsageError):
        server.open_session(ROBOT, OFFERED)
