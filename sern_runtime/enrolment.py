"""Enrolment: a client that has nothing but a one-time code gets the relay's public key, and the relay gets its own.

Both ends derive two CURVE key pairs from the code, one for either side of the enrolment, and connect with them. CURVE's
handshake (ZeroMQ RFC 26) is then what proves the code, in both directions: whoever does not know it can neither open
what the client says first nor say anything that either end takes, and a recording cannot be played again, since every
connection has fresh keys. What goes through are public keys and names.

The code has 80 bits, so that it cannot be found by trying, not even by who has recorded an exchange (each guess takes a
scrypt): a password-authenticated key exchange, which makes short codes safe, is not needed. It is good for one client
key, for `MAX_WRONG` wrong tries, and for the time that the operator gave it. That the right client has it is what the
operator confirms, by the fingerprint that both ends show.
"""

import asyncio
import hashlib
import json
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import zmq
from zmq.utils import z85

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.config.keys import SecretKey, fingerprint, is_key
from sern_runtime.monitor import ConnectionTable, EventKind, MonitorEvent, SocketMonitor
from sern_runtime.zap import TemporaryRefusal, ZapHandler
from sern_runtime.zmq_setup import apply_common_options, connect_curve, make_server
from sern_runtime.zmq_socket import DealerSocket, RouterSocket

CODE_BITS: Final = 80
MAX_WRONG: Final = 5
"""Handshakes whose sealed parts do not open, after which a code is burnt."""
MAX_MESSAGE_BYTES: Final = 4096
MAX_CONNECTIONS: Final = 16
MAX_HALF_OPEN_PER_SOURCE: Final = 8
SILENT_S: Final = 20.0
"""A connection that has not said anything for so long is closed."""
ASK_S: Final = 0.5
ANSWER_S: Final = 15.0
"""How long the other end may take for a handshake, or an answer."""
MAX_LOST: Final = 20
"""Connections of an enrolment that may end before its client gives up."""
DONE_S: Final = 30.0
"""How long the relay waits for the client to say that it has its files."""
MAX_CLOCK_DIFFERENCE_S: Final = 60.0
DOMAIN: Final = "sern-enrol"
_USER: Final = "enrols"
_ALPHABET: Final = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"  # Crockford's: no I, L, O, U
_READ_AS: Final = str.maketrans({"I": "1", "L": "1", "O": "0", "-": "", " ": ""})
_SALT: Final = b"SERN enrolment 1"
_SCRYPT_N: Final = 2**15


class CodeError(UsageError):
    """This is no code."""


def new_code() -> str:
    """A code of four groups of four letters and digits."""
    number = secrets.randbits(CODE_BITS)
    text = "".join(_ALPHABET[number >> shift & 31] for shift in range(CODE_BITS - 5, -1, -5))
    return "-".join(text[start : start + 4] for start in range(0, len(text), 4))


@dataclass(frozen=True, slots=True)
class CodeKeys:
    """The two pairs that stand for a code."""

    relay: SecretKey
    client: SecretKey

    @classmethod
    def of(cls, code: str) -> "CodeKeys":
        """Takes a tenth of a second, and 32 MB while it does. CodeError when it cannot be a code."""
        plain = code.upper().translate(_READ_AS)
        if len(plain) * 5 != CODE_BITS or any(sign not in _ALPHABET for sign in plain):
            raise CodeError("that is no code: it has four groups of four letters and digits, as the relay shows it")
        made = hashlib.scrypt(plain.encode(), salt=_SALT, n=_SCRYPT_N, r=8, p=1, maxmem=2**26, dklen=64)
        return cls(_pair(made[:32]), _pair(made[32:]))


def _pair(secret: bytes) -> SecretKey:
    text = z85.encode(secret)
    return SecretKey(ClientName(_USER), zmq.curve_public(text).decode(), text.decode())


class State(StrEnum):
    """How far an enrolment is, as the relay says it to the client."""

    OPEN = "open"
    WAITING = "waiting"
    ACCEPTED = "accepted"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Offer:
    """What a client gets: its name, and the public key file of the relay."""

    name: ClientName
    relay: ClientName
    relay_keys: tuple[str, ...]


class EnrolmentServer:
    """The relay's end, for one code. Make it in a running loop; `close` it in the end.

    `changed` is set whenever something has happened. Raises ConfigError where it cannot listen.
    """

    def __init__(self, code: str, offer: Offer, listen: str, *, valid_s: float) -> None:
        self.offer = offer
        self.state = State.OPEN
        self.key: str | None = None
        """The client's public key, once it has asked."""
        self.source = ""
        """Where it asked from."""
        self.done = False
        """The client has its files."""
        self.told = False
        """The client has been told how it ended."""
        self.burnt = ""
        """Why the code is good for nothing any more; empty: it is."""
        self.malformed = 0
        self.changed = asyncio.Event()
        self.ends_s = clock.now() + valid_s
        keys = CodeKeys.of(code)
        self._client_key = keys.client.public_key
        self._why = ""
        self._ctx: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._zap = ZapHandler(self._ctx)
        self._zap.add_domain(DOMAIN, self._lookup)
        try:
            raw = make_server(self._ctx, (listen,), keys.relay, DOMAIN, max_message_bytes=MAX_MESSAGE_BYTES)
        except ConfigError:
            self._zap.close()
            self._ctx.destroy(linger=0)
            raise
        self.endpoint = raw.getsockopt_string(zmq.LAST_ENDPOINT)
        self.connections = ConnectionTable(
            raw,
            max_half_open_per_source=MAX_HALF_OPEN_PER_SOURCE,
            max_half_open=MAX_CONNECTIONS,
            max_connections=MAX_CONNECTIONS,
            on_change=self._look,
        )
        self._socket = RouterSocket(raw, self._received)
        self._socket.on_refused = lambda _why: self._cut()

    def close(self) -> None:
        """What was said last has a moment to leave."""
        self.connections.close()
        self._socket.linger_s = 0.5
        self._socket.close()
        self._zap.close()
        self._ctx.destroy(linger=500)

    def look(self) -> None:
        """See to the time. Call a few times a second."""
        self.connections.cut_silent(SILENT_S)
        if clock.now() >= self.ends_s and self.state is not State.ACCEPTED:
            self._burn("its time is over")

    def accept(self) -> None:
        """The operator has confirmed the fingerprint, and the relay has the key."""
        self._become(State.ACCEPTED)

    def refuse(self, why: str) -> None:
        self._why = why
        self._become(State.REFUSED)

    def strangers(self) -> str:
        """One line on who knocked and had no business here; empty: nobody."""
        table = self.connections
        other = table.handshake_failed - table.forged
        counts = {
            f"{table.forged} with a wrong code": table.forged,
            f"{other} that spoke something else, or nothing": other,
            f"{table.capped} too many at a time": table.capped,
            f"{self.malformed} with the code that said what no client says": self.malformed,
        }
        found = [text for text, count in counts.items() if count]
        return f"turned away: {', '.join(found)}" if found else ""

    def _become(self, state: State) -> None:
        self.state = state
        self.changed.set()

    def _burn(self, why: str) -> None:
        if not self.burnt:
            self.burnt = why
            self.refuse(why)

    def _look(self) -> None:
        if self.connections.forged >= MAX_WRONG and self.state is not State.ACCEPTED:
            self._burn(f"{MAX_WRONG} wrong codes were tried")

    def _lookup(self, public_key: str, _address: str) -> str | TemporaryRefusal | None:
        if public_key != self._client_key:
            return None
        return TemporaryRefusal(f"the code is burnt: {self.burnt}") if self.burnt else _USER

    def _cut(self) -> None:
        self.malformed += 1
        self.connections.cut(self._socket.peer_details().fd)

    def _received(self, routing_id: bytes, _user: str, body: bytes) -> None:
        details = self._socket.peer_details()
        said = _decoded(body)
        if said is None:
            self._cut()
            return
        self.connections.bind_user(details.fd, _USER)
        key, done = said.get("public_key", ""), said.get("done", False)
        if not isinstance(key, str) or (key and not is_key(key)) or not isinstance(done, bool):
            self._cut()
            return
        if key:
            self._asked(key, details.address)
        if done and self.state is State.ACCEPTED and key == self.key:
            self.done = True
            self.changed.set()
        offer = self.offer
        answer = {
            "state": self.state.value,
            "why": self._why,
            "name": offer.name,
            "relay": offer.relay,
            "relay_keys": offer.relay_keys,
            "time_s": time.time(),
        }
        self._socket.send_to(routing_id, json.dumps(answer).encode())
        if self.state in (State.ACCEPTED, State.REFUSED):
            self.told = True
            self.changed.set()

    def _asked(self, key: str, source: str) -> None:
        if self.key is None and self.state is State.OPEN:
            self.key, self.source = key, source
            self._become(State.WAITING)
        elif key != self.key and self.state is State.WAITING:
            self._burn(
                f"two keys were brought with it, {fingerprint(self.key or key)} from {self.source} and "
                f"{fingerprint(key)} from {source}: somebody else has the code"
            )


def _decoded(body: bytes) -> dict[str, Any] | None:
    try:
        said = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return said if isinstance(said, dict) else None


class _Line:
    """One connection of a client to an enrolment."""

    def __init__(self, ctx: "zmq.Context[zmq.Socket[bytes]]", endpoint: str, keys: CodeKeys) -> None:
        loop = asyncio.get_running_loop()
        self.up: asyncio.Future[None] = loop.create_future()
        self.lost = asyncio.Event()
        self._answer: asyncio.Future[dict[str, Any]] | None = None
        self._connected = False
        raw = ctx.socket(zmq.DEALER)
        apply_common_options(raw, max_message_bytes=MAX_MESSAGE_BYTES)
        raw.setsockopt(zmq.RECONNECT_IVL, -1)
        if "[" in endpoint:
            raw.setsockopt(zmq.IPV6, 1)
        connect_curve(raw, keys.client, keys.relay.public_key)
        self._monitor = SocketMonitor(raw, self._on_event)
        self._socket = DealerSocket(raw, self._received)
        try:
            raw.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise UsageError(f"{endpoint} is not an address: write tcp://RELAY:PORT") from error

    def close(self) -> None:
        self._monitor.close()
        self._socket.linger_s = 0.5
        self._socket.close()
        if self.up.done() and not self.up.cancelled():
            self.up.exception()  # it was said already, or nobody waits
        self.up.cancel()

    def _on_event(self, event: MonitorEvent) -> None:
        match event.kind:
            case EventKind.CONNECTED:
                self._connected = True
            case EventKind.HANDSHAKE_SUCCEEDED:
                if not self.up.done():
                    self.up.set_result(None)
            case _:
                self.lost.set()
                if not self.up.done():
                    self.up.set_exception(SernError(WRONG if self._connected else NOBODY))
                if self._answer is not None and not self._answer.done():
                    self._answer.cancel()

    def _received(self, body: bytes) -> None:
        said = _decoded(body)
        if said is not None and self._answer is not None and not self._answer.done():
            self._answer.set_result(said)

    async def ask(self, said: dict[str, object]) -> dict[str, Any] | None:
        """The answer; None: the connection is gone. Raises SernError when none comes."""
        if self.lost.is_set():
            return None
        self._answer = asyncio.get_running_loop().create_future()
        self._socket.send(json.dumps(said).encode())
        done, _ = await asyncio.wait([self._answer], timeout=ANSWER_S)
        if not done:
            raise SernError(f"the relay has not answered for {ANSWER_S:g} s")
        return None if self._answer.cancelled() else self._answer.result()


NOBODY: Final = (
    "nobody listens there: is sern enroll open running on the relay, is the address right, and is its port open?"
)
WRONG: Final = (
    "the code is wrong, used or over, or what listens there is no sern enroll open; compare it, or have another made"
)


class EnrolmentClient:
    """The client's end: `open`, then `offer`, then `bring` with its key, then `finish`; `close` at any time."""

    def __init__(self, endpoint: str, code: str) -> None:
        self._endpoint = endpoint
        self._keys = CodeKeys.of(code)
        self._ctx: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._line: _Line | None = None
        self._lost = 0

    def close(self) -> None:
        if self._line is not None:
            self._line.close()
        self._ctx.destroy(linger=500)

    async def _connect(self) -> _Line:
        """A connection that has proved the code. Raises SernError."""
        if self._line is not None:
            self._line.close()
        self._line = _Line(self._ctx, self._endpoint, self._keys)
        done, _ = await asyncio.wait([self._line.up], timeout=ANSWER_S)
        if not done:
            raise SernError(f"{self._endpoint}: no answer within {ANSWER_S:g} s; {NOBODY}")
        try:
            self._line.up.result()
        except SernError as error:
            raise SernError(f"{self._endpoint}: {error}") from None
        return self._line

    async def _ask(self, **said: object) -> dict[str, Any]:
        """What the relay says, over as many connections as it takes, one a second."""
        while True:
            line = self._line
            if line is not None and line.lost.is_set():
                self._lost += 1
                if self._lost > MAX_LOST:
                    raise SernError(f"{self._endpoint}: the connection ends again and again; begin anew")
                await asyncio.sleep(2 * ASK_S)
                line = None
            if line is None:
                line = await self._connect()
            answer = await line.ask(said)
            if answer is not None:
                return answer

    async def offer(self) -> tuple[Offer, float]:
        """What the relay offers, and how far this machine's clock is ahead of its own, s. Raises SernError."""
        said = await self._ask()
        try:
            names = client_name(said["name"]), client_name(said["relay"])
            keys, time_s = tuple(said["relay_keys"]), float(said["time_s"])
            good = 0 < len(keys) <= 4 and all(isinstance(key, str) and is_key(key) for key in keys)
        except (KeyError, TypeError, ValueError, SernError) as error:
            raise SernError(f"{self._endpoint}: the relay's answer cannot be read; is it another release?") from error
        if not good:
            raise SernError(f"{self._endpoint}: the relay's answer holds no keys; is it another release?")
        return Offer(*names, keys), time.time() - time_s

    async def bring(self, public_key: str, *, told: Callable[[], None]) -> None:
        """Hand the public key over, and wait for the operator. `told` once it is there. Raises SernError when it is not
        accepted."""
        said = False
        while True:
            answer = await self._ask(public_key=public_key)
            state = answer.get("state")
            if state == State.ACCEPTED:
                return
            if state != State.WAITING:
                raise SernError(f"the relay does not accept the key: {str(answer.get('why', ''))[:300]}")
            if not said:
                said = True
                told()
            await asyncio.sleep(ASK_S)

    async def finish(self, public_key: str) -> None:
        """Tell the relay that all is written."""
        await self._ask(public_key=public_key, done=True)
