"""Who may connect: the ZAP handler (ZeroMQ RFC 27), in the same event loop.

libzmq asks one handler per context, at inproc://zeromq.zap.01, about every connection of a socket that has a ZAP
domain. The answer's status decides what the client sees:

    200   admitted; the User-Id (the client's name and key) is attached to every frame of the connection
    400   unknown key: libzmq never retries by itself, the client must rebuild its socket
    300   not now (a cap, a reload, a fault of ours): the client is told nothing, and libzmq ends the handshake after
          HANDSHAKE_IVL; then it tries again by itself

A handler that dies leaves every later connection hanging, so a lookup that raises is answered 300 and counted, and
`ZapHandler.ping` puts a request through the whole path for the watchdog.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import zmq
from zmq.utils import z85

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_runtime.addresses import plain_host
from sern_runtime.config.keys import fingerprint
from sern_runtime.monitor import EventKind, MonitorEvent, SocketMonitor
from sern_runtime.zmq_setup import connect_curve
from sern_runtime.zmq_socket import DealerSocket, FrameSocket

ENDPOINT: Final = "inproc://zeromq.zap.01"
SELF_TEST_TIMEOUT_S: Final = 10.0
_VERSION: Final = b"1.0"
_REQUEST_FRAMES: Final = 7  # version, request id, domain, address, identity, mechanism, key; after the envelope of 2
_PING_DOMAIN: Final = b"\0ping"  # no socket can have it: libzmq takes domains from C strings
_log = logging.getLogger(__name__)


class Refusal:
    """A lookup's answer about a key that is known and does not hold: as for an unknown one the client is told 400.
    `reason` is for the log."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


class TemporaryRefusal:
    """A lookup's answer "not now": the client is told 300 and tries again by itself. `reason` is for the log."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


Lookup = Callable[[str, str], "str | Refusal | TemporaryRefusal | None"]
"""`lookup(public_key_z85, address) -> User-Id`, None for an unknown key, or a refusal."""

Told = Callable[[str, str, str], None]
"""`told(address, public_key_z85, why)`: a connection is refused."""

Admit = Callable[[str], bool]
"""`admit(address) -> bool`: the connection cap, asked before the lookup. False is answered 300."""


@dataclass(slots=True)
class ZapCounters:
    """What was answered, from start on. `probes` are the self-test's own refusals, kept apart from real ones."""

    admitted: int = 0
    unknown_key: int = 0
    not_now: int = 0
    capped: int = 0
    failed: int = 0
    malformed: int = 0
    probes: int = 0
    pings: int = 0


class ZapHandler:
    """The ZAP handler of a context. Make it before the first server socket; `close()` after the last."""

    def __init__(
        self, ctx: "zmq.Context[zmq.Socket[bytes]]", *, admit: Admit | None = None, refused: Told | None = None
    ) -> None:
        """`refused` is told of every refusal, in place of the log."""
        self.counters = ZapCounters()
        self._refused = refused or _log_refusal
        self._ctx = ctx
        self._admit = admit
        self._lookups: dict[bytes, Lookup] = {}
        self._expected: set[str] = set()
        self._pinger: DealerSocket | None = None
        socket = ctx.socket(zmq.ROUTER)
        try:
            socket.bind(ENDPOINT)
        except zmq.ZMQError as error:
            socket.close(linger=0)
            raise UsageError(f"this context has a ZAP handler already ({error.strerror})") from error
        self._socket = FrameSocket(socket, self._on_request, max_frames=_REQUEST_FRAMES + 8)

    def add_domain(self, domain: str, lookup: Lookup) -> None:
        """Let `lookup` decide about connections to sockets with this ZAP domain; replaces an earlier one."""
        if not domain:
            raise UsageError("an empty ZAP domain is never asked about: libzmq would let anyone in")
        self._lookups[domain.encode()] = lookup

    def expect_refusal(self, public_key: str) -> None:
        """Count the refusal of this key as a probe, so that the self-test raises no alarm."""
        self._expected.add(public_key)

    def ping(self) -> None:
        """Send a request of our own through the handler; `counters.pings` goes up when its answer is back."""
        if self._pinger is None:
            socket = self._ctx.socket(zmq.DEALER)
            socket.connect(ENDPOINT)
            self._pinger = _Pinger(socket, self._on_pong)
        self._pinger.send_frames([b"", _VERSION, b"ping", _PING_DOMAIN, b"", b"", b"NULL"])

    def close(self) -> None:
        """Answer nobody any more. Connections being made hang until their handshake times out."""
        if self._pinger is not None:
            self._pinger.close()
        self._socket.close()

    def _on_pong(self) -> None:
        self.counters.pings += 1

    def _on_request(self, frames: list[zmq.Frame]) -> None:
        parts = [frame.bytes for frame in frames]
        if len(parts) < 4 or parts[1] != b"":
            self.counters.malformed += 1
            return
        envelope, request_id = parts[0], parts[3]
        status, text, user = self._decide(parts[2:])
        self._socket.send_frames([envelope, b"", _VERSION, request_id, status, text, user, b""])

    def _decide(self, request: list[bytes]) -> tuple[bytes, bytes, bytes]:
        """Status, text and User-Id for one request. Never raises."""
        counters = self.counters
        if len(request) > 2 and request[2] == _PING_DOMAIN:
            return b"400", b"ping", b""
        if len(request) != _REQUEST_FRAMES or request[0] != _VERSION or request[5] != b"CURVE":
            counters.malformed += 1
            return b"400", b"only CURVE is accepted", b""
        domain, address = request[2], plain_host(request[3].decode("ascii", "replace"))
        try:
            public_key = z85.encode(request[6]).decode("ascii")
            probe = public_key in self._expected
            if not probe and self._admit is not None and not self._admit(address):
                counters.capped += 1
                self._refused(address, public_key, "too many connections")
                return b"300", b"too many connections", b""
            lookup = self._lookups.get(domain)
            answer = None if lookup is None else lookup(public_key, address)
        except Exception:  # noqa: BLE001  (a fault of ours must not end the only authority on who may connect)
            counters.failed += 1
            _log.exception("the lookup of a key failed; %s is told to try again", address)
            return b"300", b"internal error", b""
        if probe and not isinstance(answer, str):
            counters.probes += 1
            self._expected.discard(public_key)
            return b"400", b"no such key", b""
        if isinstance(answer, Refusal) or not answer:
            counters.unknown_key += 1
            unknown = f"unknown key {public_key} (fingerprint {fingerprint(public_key)})"
            why = answer.reason if isinstance(answer, Refusal) else unknown
            self._refused(address, public_key, why)
            return b"400", b"no such key", b""
        if isinstance(answer, TemporaryRefusal):
            counters.not_now += 1
            self._refused(address, public_key, f"for now: {answer.reason}")
            return b"300", b"not now", b""
        counters.admitted += 1
        return b"200", b"OK", answer.encode()


def _log_refusal(address: str, _public_key: str, why: str) -> None:
    _log.warning("refused a connection from %s: %s", address, why)


class _Pinger(DealerSocket):
    """Takes the answers to our own pings, whose frames are many and of no interest."""

    def __init__(self, socket: "zmq.Socket[bytes]", on_answer: Callable[[], None]) -> None:
        super().__init__(socket, lambda _body: None)
        self._on_answer = on_answer

    def skip_rest(self, frame: zmq.Frame) -> None:
        super().skip_rest(frame)
        self._on_answer()


def reachable(endpoint: str) -> str:
    """An endpoint as bound, turned into one that this machine can connect to (a wildcard becomes loopback)."""
    for wildcard, loopback in (("tcp://0.0.0.0:", "tcp://127.0.0.1:"), ("tcp://*:", "tcp://127.0.0.1:")):
        if endpoint.startswith(wildcard):
            return loopback + endpoint[len(wildcard) :]
    if endpoint.startswith("tcp://[::]:"):
        return "tcp://[::1]:" + endpoint[len("tcp://[::]:") :]
    return endpoint


async def self_test(
    ctx: "zmq.Context[zmq.Socket[bytes]]",
    handler: ZapHandler,
    endpoints: Sequence[str],
    server_key: str,
    *,
    timeout_s: float = SELF_TEST_TIMEOUT_S,
) -> None:
    """Try a throwaway key on each bound endpoint, all at once: it must be refused as unknown.

    Run it before accepting traffic. `endpoints` as `bind_all` returned them. Raises SernError of one line: refuse to
    start. A misconfigured CURVE server admits everyone in silence, so this is found by trying alone.
    """
    tests = [_must_refuse(ctx, handler, endpoint, server_key, timeout_s) for endpoint in endpoints]
    for outcome in await asyncio.gather(*tests, return_exceptions=True):  # all have ended, and closed their sockets
        if isinstance(outcome, BaseException):
            raise outcome


async def _must_refuse(
    ctx: "zmq.Context[zmq.Socket[bytes]]", handler: ZapHandler, endpoint: str, server_key: str, timeout_s: float
) -> None:
    public, secret = zmq.curve_keypair()
    handler.expect_refusal(public.decode())
    outcome: asyncio.Future[MonitorEvent] = asyncio.get_running_loop().create_future()

    def on_event(event: MonitorEvent) -> None:
        if event.kind in (EventKind.HANDSHAKE_SUCCEEDED, EventKind.HANDSHAKE_FAILED_AUTH) and not outcome.done():
            outcome.set_result(event)

    socket = ctx.socket(zmq.DEALER)
    monitor = SocketMonitor(socket, on_event)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        if "[" in endpoint:
            socket.setsockopt(zmq.IPV6, 1)
        connect_curve(socket, _Throwaway(public.decode(), secret.decode()), server_key)
        try:
            socket.connect(reachable(endpoint))
        except zmq.ZMQError as error:
            raise ConfigError(f"cannot try {endpoint} from this machine: {error.strerror}") from error
        try:
            async with asyncio.timeout(timeout_s):
                event = await outcome
        except TimeoutError as error:
            raise SernError(
                f"refusing to start: {endpoint} did not answer the self-test within {timeout_s:g} s; "
                "check that nothing else listens there"
            ) from error
        if event.kind is EventKind.HANDSHAKE_SUCCEEDED:
            raise SernError(f"refusing to start: {endpoint} admits an unknown key; check zap_domain and the keys")
    finally:
        monitor.close()
        socket.close(linger=0)


@dataclass(frozen=True, slots=True)
class _Throwaway:
    public_key: str
    secret_key: str
