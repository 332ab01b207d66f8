"""Sockets drained in the loop: nothing stalls, and nobody speaks for another."""

import asyncio
import errno
import socket as socketlib
from collections.abc import Callable
from functools import partial

import pytest
import zmq

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.config.keys import SecretKey
from sern_runtime.zap import ZapHandler
from sern_runtime.zmq_setup import bind_all, is_local, make_client, make_server
from sern_runtime.zmq_socket import (
    BATCH,
    LAST_WORDS_DRAINS,
    VIEW_BYTES,
    DealerSocket,
    FrameSocket,
    RouterSocket,
    SendResult,
)
from tests.support import DEADLINE_S, until

Context = zmq.Context[zmq.Socket[bytes]]
FAR_S = 3600.0  # a tick that never comes: what arrives did so without it


def endpoint_of(socket: "zmq.Socket[bytes]") -> str:
    return socket.getsockopt_string(zmq.LAST_ENDPOINT)


async def pair(
    context: Context, on_router: Callable[[bytes, str, bytes], None], on_dealer: Callable[[bytes], None]
) -> tuple[RouterSocket, DealerSocket]:
    """A connected ROUTER and DEALER without CURVE and without a tick."""
    server = make_server(context, ["tcp://127.0.0.1:*"], None, sndhwm=100_000)
    router = RouterSocket(server, on_router, tick_s=FAR_S)
    client = make_client(context, endpoint_of(server), None, None, sndhwm=100_000)
    dealer = DealerSocket(client, on_dealer, tick_s=FAR_S)
    await until(lambda: dealer.send(b"hello"), "connected")
    return router, dealer


async def numbers(dealer: DealerSocket, count: int) -> list[bytes]:
    """Send so many; what was sent."""
    bodies = [b"%d" % number for number in range(count)]
    for body in bodies:
        await until(partial(dealer.send, body))
    return bodies


async def test_a_burst_arrives_whole_without_the_tick(zmq_context: Context) -> None:
    """Regression: a batch capped at 200 without `call_soon` for the rest stalled, as FD makes no new edge."""
    count = 5000
    seen: list[bytes] = []
    router, dealer = await pair(zmq_context, lambda _id, _user, body: seen.append(body), lambda _body: None)
    sent = await numbers(dealer, count)
    await until(lambda: len(seen) == count + 1, "every message")
    assert seen[1:] == sent
    assert count > 10 * BATCH
    router.close()
    dealer.close()


async def test_what_was_sent_last_is_taken_before_the_end_of_its_connection_is_told(zmq_context: Context) -> None:
    """A monitor may tell of the end first: here it does, as nothing is taken before."""
    seen: list[bytes] = []
    seen_at_end: list[bytes] = []
    router, dealer = await pair(zmq_context, lambda _id, _user, body: seen.append(body), lambda _body: None)
    await until(lambda: seen, "the first message")
    monitor = router.socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    await numbers(dealer, 20)
    dealer.linger_s = DEADLINE_S
    dealer.close()
    assert monitor.poll(int(1000 * DEADLINE_S))  # the loop stands still until the connection is over
    assert len(seen) < 21
    router.when_empty(lambda: seen_at_end.extend(seen))
    await until(lambda: seen_at_end, "the end is told")
    assert len(seen_at_end) == 21
    router.socket.disable_monitor()
    monitor.close()
    router.close()


async def test_an_end_is_told_also_where_more_and_more_comes(zmq_context: Context) -> None:
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)
    told: list[int] = []

    class Endless(RouterSocket):
        def _take(self, count: int) -> bool:
            return True

    router = Endless(server, lambda *_: None, tick_s=FAR_S)
    router.when_empty(lambda: told.append(router.drains))
    await until(lambda: told, "the end is told")
    assert told == [LAST_WORDS_DRAINS]
    router.close()


async def test_large_messages_come_as_views_where_they_are_taken(zmq_context: Context) -> None:
    seen: list[bytes] = []
    views: list[memoryview] = []
    answers: list[memoryview] = []
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)

    def on_view(routing_id: bytes, user: str, body: memoryview) -> None:
        assert user == ""
        views.append(body)
        router.send_to(routing_id, body.tobytes())

    router = RouterSocket(server, lambda _id, _user, body: seen.append(body), on_view=on_view, identified=False)
    client = make_client(zmq_context, endpoint_of(server), None, None)
    dealer = DealerSocket(client, seen.append, on_view=answers.append)
    small, large = bytes(VIEW_BYTES - 1), bytes(range(256)) * (VIEW_BYTES // 256)
    await until(lambda: dealer.send(small), "connected")
    await until(lambda: dealer.send(large))
    await until(lambda: bool(answers))
    assert seen == [small]
    assert views == [large] and answers == [large]
    router.close()
    dealer.close()
    assert views == [large], "a view outlives the socket"


async def test_one_message_a_callback_does_not_stall(zmq_context: Context) -> None:
    """Regression: one receive per readable callback stalled at message 1 of 5000."""
    seen: list[bytes] = []
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)
    router = RouterSocket(server, lambda _id, _user, body: seen.append(body), batch=1, tick_s=FAR_S)
    client = make_client(zmq_context, endpoint_of(server), None, None, sndhwm=10_000)
    dealer = DealerSocket(client, lambda _body: None, tick_s=FAR_S)
    await until(lambda: dealer.send(b"0"))
    for number in range(1, 5000):
        await until(partial(dealer.send, b"%d" % number))
    await until(lambda: len(seen) == 5000)
    router.close()
    dealer.close()


async def test_messages_that_arrived_while_sending_are_found(zmq_context: Context) -> None:
    """Sending takes commands off the mailbox, and with them the edge of what has arrived."""
    rounds = 3000
    echoed: list[bytes] = []
    router, dealer = await pair(
        zmq_context, lambda rid, _user, body: assert_sent(router.send_to(rid, body)), echoed.append
    )
    await until(lambda: echoed == [b"hello"])
    for number in range(rounds):
        await until(partial(dealer.send, b"%d" % number))
        if number % 7 == 0:
            await asyncio.sleep(0)
    await until(lambda: len(echoed) == rounds + 1, "every echo")
    router.close()
    dealer.close()


def claim(routing_id: bytes) -> Callable[["zmq.Socket[bytes]"], None]:
    def before_connect(socket: "zmq.Socket[bytes]") -> None:
        socket.setsockopt(zmq.ROUTING_ID, routing_id)

    return before_connect


def assert_sent(result: SendResult) -> None:
    assert result is SendResult.OK


async def test_the_tick_finds_what_a_careless_user_of_the_socket_hid(zmq_context: Context) -> None:
    seen: list[bytes] = []
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)
    router = RouterSocket(server, lambda _id, _user, body: seen.append(body), tick_s=0.01)
    client = make_client(zmq_context, endpoint_of(server), None, None)
    dealer = DealerSocket(client, lambda _body: None)
    await until(lambda: dealer.send(b"first"))
    await until(lambda: seen == [b"first"])
    late = router.late  # a tick may have been before the loop
    asyncio.get_running_loop().remove_reader(int(server.FD))
    assert dealer.send(b"second")
    await until(lambda: seen == [b"first", b"second"])
    assert router.late == late + 1
    router.close()
    dealer.close()


async def test_a_handler_that_raises_loses_only_its_own_message(zmq_context: Context) -> None:
    seen: list[bytes] = []
    problems: list[dict[str, object]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: problems.append(context))

    def handle(_id: bytes, _user: str, body: bytes) -> None:
        if body == b"bad":
            raise ValueError("handler")
        seen.append(body)

    router, dealer = await pair(zmq_context, handle, lambda _body: None)
    for body in (b"a", b"bad", b"b"):
        assert dealer.send(body)
    await until(lambda: seen == [b"hello", b"a", b"b"])
    assert [str(problem["exception"]) for problem in problems] == ["handler"]
    router.close()
    dealer.close()


async def test_closing_inside_a_handler_is_allowed(zmq_context: Context) -> None:
    router, dealer = await pair(zmq_context, lambda _id, _user, _body: router.close(), lambda _body: None)
    await until(lambda: router.closed)
    router.close()
    dealer.close()
    assert router.socket.closed


async def test_what_was_sent_may_leave_after_the_socket_is_closed(zmq_context: Context) -> None:
    seen: list[bytes] = []
    router, dealer = await pair(zmq_context, lambda _id, _user, body: seen.append(body), lambda _body: None)
    sent = await numbers(dealer, 5000)
    dealer.linger_s = DEADLINE_S
    dealer.close()
    await until(lambda: len(seen) > len(sent), "every message")
    assert seen == [b"hello", *sent]
    router.close()


async def test_full_and_gone_are_told_apart(zmq_context: Context) -> None:
    peers: list[bytes] = []
    router, dealer = await pair(zmq_context, lambda rid, _user, _body: peers.append(rid), lambda _body: None)
    await until(lambda: peers)
    assert router.send_to(peers[0], b"x") is SendResult.OK
    assert router.send_to(b"\0nobo", b"x") is SendResult.GONE
    dealer.close()
    await until(lambda: router.send_to(peers[0], b"x") is SendResult.GONE)
    assert not SendResult.GONE
    assert not SendResult.FULL
    assert SendResult.OK
    router.close()


async def test_a_full_pipe_reports_when_it_can_be_used_again(zmq_context: Context) -> None:
    client = make_client(zmq_context, "tcp://127.0.0.1:1", None, None)  # nothing listens there
    writable: list[bool] = []
    dealer = DealerSocket(client, lambda _body: None, on_writable=lambda: writable.append(True))
    assert dealer.send(b"x") is SendResult.FULL
    await until(lambda: writable)
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)
    seen: list[bytes] = []
    router = RouterSocket(server, lambda _id, _user, body: seen.append(body))

    def retry() -> None:
        if not seen:
            dealer.send(b"at last")

    dealer.on_writable = retry
    dealer.send(b"not yet")
    client.connect(endpoint_of(server))
    await until(lambda: b"at last" in seen)
    router.close()
    dealer.close()


async def test_frames_behind_the_body_are_not_a_message_of_their_own(zmq_context: Context) -> None:
    """Taken in pairs, the third frame would pass for a routing id, and the fourth for a body of that peer."""
    seen: list[tuple[bytes, bytes]] = []
    router, dealer = await pair(zmq_context, lambda rid, _user, body: seen.append((rid, body)), lambda _body: None)
    await until(lambda: seen)
    victim = seen[0][0]
    assert dealer.send_frames([b"bait", victim, b"forged"])
    assert dealer.send(b"honest")
    await until(lambda: len(seen) > 1)
    assert [body for _, body in seen] == [b"hello", b"honest"]
    assert router.malformed == 1
    router.close()
    dealer.close()


async def test_too_many_frames_are_dropped_whole(zmq_context: Context) -> None:
    seen: list[list[bytes]] = []
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None)
    router = FrameSocket(server, lambda frames: seen.append([frame.bytes for frame in frames[1:]]), max_frames=4)
    dealer = DealerSocket(make_client(zmq_context, endpoint_of(server), None, None), lambda _body: None)
    await until(lambda: dealer.send_frames([b"1", b"2", b"3"]))
    assert dealer.send_frames([b"1", b"2", b"3", b"4"])
    assert dealer.send_frames([b"1"] * 50)
    assert dealer.send_frames([b"last"])
    await until(lambda: len(seen) == 2)
    assert seen == [[b"1", b"2", b"3"], [b"last"]]
    assert router.malformed == 2
    router.close()
    dealer.close()


async def test_identity_is_the_key_and_not_the_routing_id(
    zmq_context: Context, relay_keys: SecretKey, robot_keys: SecretKey, site_keys: SecretKey
) -> None:
    """A client with a key of its own that claims the routing id of another gets no traffic and says nothing."""
    names = {robot_keys.public_key: "robot1", site_keys.public_key: "site1"}
    handler = ZapHandler(zmq_context)
    handler.add_domain("sern", lambda key, _address: names.get(key))
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys)
    seen: list[tuple[bytes, str, bytes]] = []
    router = RouterSocket(server, lambda rid, user, body: seen.append((rid, user, body)))
    robot_seen: list[bytes] = []
    robot = DealerSocket(
        make_client(zmq_context, endpoint_of(server), robot_keys, relay_keys.public_key), robot_seen.append
    )
    await until(lambda: robot.send(b"hello"))
    await until(lambda: seen)
    routing_id = seen[0][0]
    assert seen[0] == (routing_id, "robot1", b"hello")

    thief_seen: list[bytes] = []
    stolen: list[DealerSocket] = []
    for claimed in (routing_id, b"robot1"):
        thief = make_client(
            zmq_context,
            endpoint_of(server),
            site_keys,
            relay_keys.public_key,
            before_connect=claim(claimed),
        )
        stolen.append(DealerSocket(thief, thief_seen.append))
    for dealer in stolen:
        await until(partial(dealer.send, b"I am robot1"))
    await until(lambda: router.refused_routing_ids == 1)  # the name; the clash is ignored by the ROUTER itself
    assert router.send_to(routing_id, b"for the robot") is SendResult.OK
    assert robot.send(b"still here")
    await until(lambda: robot_seen == [b"for the robot"])
    await until(lambda: (routing_id, "robot1", b"still here") in seen)
    assert {user for _, user, _ in seen} == {"robot1"}
    assert thief_seen == []

    # Once the id is free a claim of it succeeds, but not in the name of its former owner. GONE comes a little before
    # the ROUTER forgets the id, and a claim in between is ignored for good: so another heir comes until one is heard.
    robot.close()
    await until(lambda: router.send_to(routing_id, b"x") is SendResult.GONE)
    heirs: list[DealerSocket] = []

    def heard() -> bool:
        if not heirs or heirs[-1].send(b"I am robot1 too"):
            heir = make_client(
                zmq_context, endpoint_of(server), site_keys, relay_keys.public_key, before_connect=claim(routing_id)
            )
            heirs.append(DealerSocket(heir, thief_seen.append))
        return seen[-1][2] == b"I am robot1 too"

    await until(heard)
    assert seen[-1][:2] == (routing_id, "site1")
    for drained in (*heirs, *stolen, router):
        drained.close()
    handler.close()


async def test_peer_details_name_address_and_descriptor(zmq_context: Context) -> None:
    details = []
    router, dealer = await pair(zmq_context, lambda *_: details.append(router.peer_details()), lambda _body: None)
    await until(lambda: details)
    assert details[0].address == "127.0.0.1"
    with socketlib.socket(fileno=socketlib.dup(details[0].fd)) as connection:
        assert connection.getpeername()[0] == "127.0.0.1"
    with pytest.raises(UsageError, match="inside on_message"):
        router.peer_details()
    router.close()
    dealer.close()


async def test_several_endpoints_on_one_router(zmq_context: Context) -> None:
    seen: list[bytes] = []
    socket = zmq_context.socket(zmq.ROUTER)
    bound = bind_all(socket, ["tcp://127.0.0.1:*", "tcp://127.0.0.1:*"])
    router = RouterSocket(socket, lambda _id, _user, body: seen.append(body))
    clients = [DealerSocket(make_client(zmq_context, at, None, None), lambda _body: None) for at in bound]
    for number, client in enumerate(clients):
        await until(partial(client.send, b"%d" % number))
    await until(lambda: sorted(seen) == [b"0", b"1"])
    for drained in (router, *clients):
        drained.close()


async def test_a_frame_above_the_limit_closes_the_connection(zmq_context: Context) -> None:
    seen: list[bytes] = []
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], None, max_message_bytes=1000)
    router = RouterSocket(server, lambda _id, _user, body: seen.append(body))
    dealer = DealerSocket(make_client(zmq_context, endpoint_of(server), None, None), lambda _body: None)
    await until(lambda: dealer.send(bytes(1000)))
    await until(lambda: seen == [bytes(1000)])
    dealer.send(bytes(1001))
    await until(lambda: dealer.send(b"again") and seen[-1] == b"again", "reconnected")
    assert bytes(1001) not in seen
    router.close()
    dealer.close()


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp://127.0.0.1:5555", True),
        ("tcp://[::1]:5555", True),
        ("tcp://localhost:5555", True),
        ("ipc:///run/sern.sock", True),
        ("tcp://0.0.0.0:5555", False),
        ("tcp://*:5555", False),
        ("tcp://192.168.1.2:5555", False),
        ("tcp://relay.example:5555", False),
        ("tcp://127.0.0.1.example:5555", False),
    ],
)
def test_local_endpoints(endpoint: str, expected: bool) -> None:
    assert is_local(endpoint) is expected


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tcp://nosuchif0:5555", "no such interface"),
        ("tcp://192.0.2.1:5555", "no such interface or address"),
        ("tcp://127.0.0.1", "not an endpoint"),
        ("http://127.0.0.1:80", "not an endpoint"),
        ("ipc:///no/such/directory/socket", "no such directory"),
    ],
)
def test_an_endpoint_that_cannot_be_had(zmq_context: Context, relay_keys: SecretKey, endpoint: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_server(zmq_context, [endpoint], relay_keys)
    assert str(caught.value).startswith(f"cannot listen on {endpoint}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_port_in_use(zmq_context: Context, relay_keys: SecretKey) -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(ConfigError, match="the port is in use; stop the other process"):
            make_server(zmq_context, [endpoint], relay_keys)


def test_no_keys_on_the_network_is_refused(zmq_context: Context) -> None:
    with pytest.raises(ConfigError, match="open to the network"):
        make_server(zmq_context, ["tcp://127.0.0.1:*", "tcp://0.0.0.0:*"], None)
    with pytest.raises(ConfigError, match="open to the network"):
        make_client(zmq_context, "tcp://relay.example:5555", None, None)


def test_an_empty_zap_domain_is_refused(zmq_context: Context, relay_keys: SecretKey) -> None:
    with pytest.raises(UsageError, match="let anyone in"):
        make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys, "")


def test_options_follow_their_constants(zmq_context: Context, relay_keys: SecretKey, robot_keys: SecretKey) -> None:
    server = make_server(zmq_context, ["tcp://127.0.0.1:*"], relay_keys, heartbeat_timeout_ms=7000)
    client = make_client(zmq_context, endpoint_of(server), robot_keys, relay_keys.public_key, tos=0xB8)
    for socket in (server, client):
        assert socket.getsockopt(zmq.LINGER) == 0
        assert socket.getsockopt(zmq.IMMEDIATE) == 1
        assert socket.getsockopt(zmq.HEARTBEAT_IVL) == 500
        assert socket.getsockopt(zmq.HANDSHAKE_IVL) == 10_000
        assert socket.getsockopt(zmq.MAXMSGSIZE) == 65536
        assert socket.getsockopt(zmq.ROUTING_ID) == b""
    assert server.getsockopt(zmq.HEARTBEAT_TIMEOUT) == 7000
    assert server.getsockopt(zmq.ZAP_DOMAIN) == b"sern"
    assert server.getsockopt(zmq.ZAP_ENFORCE_DOMAIN) == 1
    assert client.getsockopt(zmq.TOS) == 0xB8
    server.close()
    client.close()


async def test_an_unexpected_error_is_not_taken_for_fullness(zmq_context: Context) -> None:
    socket = zmq_context.socket(zmq.DEALER)
    dealer = DealerSocket(socket, lambda _body: None)
    dealer.close()
    with pytest.raises(zmq.ZMQError) as caught:
        dealer.send(b"x")
    assert caught.value.errno in (errno.ENOTSOCK, zmq.ENOTSOCK)
