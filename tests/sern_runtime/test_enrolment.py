"""Enrolment by a one-time code, among friends and strangers: without the code nobody learns or achieves anything."""

import asyncio
import re
import socket as socketlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.config.keys import SecretKey, fingerprint, generate
from sern_runtime.enrolment import (
    MAX_CONNECTIONS,
    MAX_WRONG,
    CodeError,
    CodeKeys,
    EnrolmentClient,
    EnrolmentServer,
    Offer,
    State,
    new_code,
)
from sern_tools.ports import free_ports
from tests.support import until

ROBOT = ClientName("robot1")
HOST = "127.0.0.1"


@pytest.fixture(scope="module")
def relay_keys() -> SecretKey:
    return generate(ClientName("relay"))


@pytest.fixture
def offer(relay_keys: SecretKey) -> Offer:
    return Offer(ROBOT, ClientName("relay"), (relay_keys.public_key,))


@asynccontextmanager
async def server(offer: Offer, code: str, *, valid_s: float = 600.0) -> AsyncIterator[EnrolmentServer]:
    made = EnrolmentServer(code, offer, f"tcp://{HOST}:*", valid_s=valid_s)
    try:
        yield made
    finally:
        made.close()


@asynccontextmanager
async def client(endpoint: str, code: str) -> AsyncIterator[EnrolmentClient]:
    made = EnrolmentClient(endpoint, code)
    try:
        yield made
    finally:
        made.close()


class Relayed:
    """Somebody in the middle, who passes bytes on, records them, and may change them."""

    def __init__(self, target: str) -> None:
        self.host, _, port = target.removeprefix("tcp://").rpartition(":")
        self.port = int(port)
        self.recorded = b""
        self.change: Callable[[bytes], bytes] = bytes
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> "Relayed":
        self._server = await asyncio.start_server(self._serve, HOST, 0)
        return self

    @property
    def endpoint(self) -> str:
        assert self._server is not None
        return f"tcp://{HOST}:{self._server.sockets[0].getsockname()[1]}"

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        there, back = await asyncio.open_connection(self.host, self.port)
        try:
            await asyncio.gather(self._pass(reader, back, record=True), self._pass(there, writer, record=False))
        finally:
            back.close()
            writer.close()

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, record: bool) -> None:
        while data := await source.read(65536):
            if record:
                self.recorded += data
            sink.write(self.change(data))
        sink.close()


def test_a_code_is_read_as_people_write_it() -> None:
    code = new_code()
    assert re.fullmatch(r"([0-9A-HJKMNP-TV-Z]{4}-){3}[0-9A-HJKMNP-TV-Z]{4}", code)
    assert new_code() != code
    sloppy = code.lower().replace("-", " ").replace("0", "o").replace("1", "l")
    assert CodeKeys.of(sloppy) == CodeKeys.of(code) != CodeKeys.of(new_code())
    for bad in ("", "1234", code + "A", code[:-1] + "U"):
        with pytest.raises(CodeError, match="four groups of four"):
            CodeKeys.of(bad)


async def test_both_ends_get_what_they_need_once_the_operator_has_accepted(offer: Offer) -> None:
    code, pair, told = new_code(), generate(ROBOT), asyncio.Event()
    async with server(offer, code) as relay, client(relay.endpoint, code) as robot:
        assert (await robot.offer())[0] == offer
        bringing = asyncio.create_task(robot.bring(pair.public_key, told=told.set))
        await told.wait()
        assert (relay.state, relay.key, relay.source) == (State.WAITING, pair.public_key, HOST)
        assert not bringing.done()
        relay.accept()
        await bringing
        await robot.finish(pair.public_key)
        assert relay.done and relay.strangers() == ""


async def test_what_the_operator_does_not_accept_is_told_with_the_reason(offer: Offer) -> None:
    code = new_code()
    async with server(offer, code) as relay, client(relay.endpoint, code) as robot:
        told = asyncio.Event()
        bringing = asyncio.create_task(robot.bring(generate(ROBOT).public_key, told=told.set))
        await told.wait()
        relay.refuse("the fingerprints differ")
        with pytest.raises(SernError, match="does not accept the key: the fingerprints differ"):
            await bringing
        assert relay.told


async def test_wrong_codes_are_counted_and_burn_the_right_one(offer: Offer) -> None:
    code = new_code()
    async with server(offer, code) as relay:
        for tried in range(1, MAX_WRONG + 1):
            assert not relay.burnt
            async with client(relay.endpoint, new_code()) as guess:
                with pytest.raises(SernError, match="the code is wrong, used or over"):
                    await guess.offer()
            await until(lambda tried=tried: relay.connections.forged == tried)  # type: ignore[misc]
        assert relay.burnt == f"{MAX_WRONG} wrong codes were tried" and relay.key is None
        assert f"{MAX_WRONG} with a wrong code" in relay.strangers()
        relay._zap.counters.not_now = 0
        async with client(relay.endpoint, code) as late:
            asking = asyncio.create_task(late.offer())
            await until(lambda: relay._zap.counters.not_now > 0, "the right code comes too late")
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
        assert relay.key is None


async def test_a_code_is_over_at_its_time(offer: Offer, monkeypatch: pytest.MonkeyPatch) -> None:
    async with server(offer, new_code(), valid_s=600.0) as relay:
        relay.look()
        assert (relay.burnt, relay.state) == ("", State.OPEN)
        with monkeypatch.context() as patch:
            patch.setattr(clock, "now", lambda: relay.ends_s)
            relay.look()
        assert (relay.burnt, relay.state) == ("its time is over", State.REFUSED)


async def test_two_keys_with_one_code_burn_it(offer: Offer) -> None:
    """Somebody else has the code: the operator must not have to choose."""
    code, first, second = new_code(), generate(ROBOT).public_key, generate(ROBOT).public_key
    async with (
        server(offer, code) as relay,
        client(relay.endpoint, code) as robot,
        client(relay.endpoint, code) as thief,
    ):
        told = asyncio.Event()
        bringing = asyncio.create_task(robot.bring(first, told=told.set))
        await told.wait()
        with pytest.raises(SernError, match="somebody else has the code"):
            await thief.bring(second, told=pytest.fail)
        with pytest.raises(SernError, match="somebody else has the code"):
            await bringing
        assert fingerprint(first) in relay.burnt and fingerprint(second) in relay.burnt


async def test_who_is_in_the_middle_and_has_no_code_gets_nothing(offer: Offer) -> None:
    """It offers its own keys to the client, as a relay with another code, and changes what passes."""
    code, other = new_code(), Offer(ROBOT, ClientName("relay"), (generate(ClientName("relay")).public_key,))
    async with server(other, new_code()) as impostor:
        async with client(impostor.endpoint, code) as robot:
            with pytest.raises(SernError, match="the code is wrong, used or over, or what listens there"):
                await robot.offer()
        assert impostor.key is None and impostor.connections.forged == 1
    async with server(offer, code) as relay, Relayed(relay.endpoint) as middle:
        # The last byte of each piece: inside a sealed box, also in the very first.
        middle.change = lambda data: data if len(data) <= 64 else data[:-1] + bytes([data[-1] ^ 1])
        async with client(middle.endpoint, code) as robot:
            with pytest.raises(SernError, match="the code is wrong"):
                await robot.offer()
        assert relay.key is None


async def test_a_middle_that_only_passes_on_learns_no_key_and_cannot_play_it_again(offer: Offer) -> None:
    code, pair = new_code(), generate(ROBOT)
    async with server(offer, code) as relay, Relayed(relay.endpoint) as middle:
        told = asyncio.Event()
        async with client(middle.endpoint, code) as robot:
            bringing = asyncio.create_task(robot.bring(pair.public_key, told=told.set))
            await told.wait()
            relay.refuse("it was recorded")
            await asyncio.gather(bringing, return_exceptions=True)
        assert pair.public_key.encode() not in middle.recorded
        admitted = relay._zap.counters.admitted
        recorded = middle.recorded
    async with server(offer, code) as again:  # even where the same code is opened once more
        reader, writer = await asyncio.open_connection(HOST, int(again.endpoint.rpartition(":")[2]))
        writer.write(recorded)
        while await reader.read(65536):
            pass
        writer.close()
        await until(lambda: again.connections.handshake_failed > 0)
        assert admitted == 1 and again._zap.counters.admitted == 0
        assert again.state is State.OPEN and again.key is None


GARBAGE = [
    b"GET / HTTP/1.1\r\nHost: relay\r\n\r\n",
    bytes(range(256)) * 64,
    b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01NULL" + bytes(50),
    b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01CURVE" + bytes(47) + b"\x06\xff" + b"\x7f" * 8,
]


async def test_garbage_burns_no_code_and_is_told_in_one_line(offer: Offer) -> None:
    code = new_code()
    async with server(offer, code) as relay:
        port = int(relay.endpoint.rpartition(":")[2])
        knocking = [socketlib.create_connection((HOST, port)) for _ in GARBAGE]
        try:
            for connection, data in zip(knocking, GARBAGE, strict=True):
                connection.sendall(data)
            await until(lambda: relay.connections.handshake_failed > 0)
            assert not relay.burnt and relay.connections.forged == 0
            async with client(relay.endpoint, code) as robot:
                assert (await robot.offer())[0] == offer
            assert re.fullmatch(r"turned away: \d that spoke something else, or nothing", relay.strangers())
        finally:
            for connection in knocking:
                connection.close()


async def test_many_who_say_nothing_leave_a_place_for_the_client(offer: Offer) -> None:
    code = new_code()
    async with server(offer, code) as relay:
        port = int(relay.endpoint.rpartition(":")[2])
        knocking = [socketlib.create_connection((HOST, port)) for _ in range(4 * MAX_CONNECTIONS)]
        try:
            await until(lambda: relay.connections.accepted == len(knocking) and relay.connections.capped > 0)
            assert len(relay.connections) - relay.connections.capped <= MAX_CONNECTIONS
            assert "too many at a time" in relay.strangers()
        finally:
            for connection in knocking:
                connection.close()
        await until(lambda: len(relay.connections) == 0)
        async with client(relay.endpoint, code) as robot:
            assert (await robot.offer())[0] == offer


@pytest.mark.parametrize(
    "said", [b"", b"[]", b"{", b'{"public_key": 7}', b'{"public_key": "short"}', b"[" * 4000, bytes(4000)]
)
async def test_what_no_client_says_ends_its_connection(offer: Offer, said: bytes) -> None:
    code = new_code()
    async with server(offer, code) as relay, client(relay.endpoint, code) as robot:
        await robot.offer()
        line: Any = robot._line
        line._socket.send(said)
        await until(lambda: relay.malformed == 1)
        await line.lost.wait()
        assert relay.state is State.OPEN


async def test_a_client_goes_on_over_a_connection_that_was_cut(offer: Offer) -> None:
    code, pair, told = new_code(), generate(ROBOT), asyncio.Event()
    async with server(offer, code) as relay, client(relay.endpoint, code) as robot:
        bringing = asyncio.create_task(robot.bring(pair.public_key, told=told.set))
        await told.wait()
        assert relay.connections.cut_user("enrols") == 1
        relay.accept()
        await bringing
        assert robot._lost == 1


async def test_nobody_there_is_one_line() -> None:
    free_endpoint = f"tcp://{HOST}:{free_ports(1)[0]}"
    async with client(free_endpoint, new_code()) as robot:
        with pytest.raises(SernError, match=r"^tcp://127.0.0.1:\d+: nobody listens there: is sern enroll open running"):
            await robot.offer()
