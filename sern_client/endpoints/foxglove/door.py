"""The port that viewers connect to. Who may not come in does not reach the server behind it.

The SDK's server asks nobody who they are: it takes every page of every browser that finds it. So it listens where none
looks, at an address of loopback that is drawn at each start, and viewers come in by this door, which asks for the
token or where a page is from, and speaks TLS. (Who has an account on this machine can find the server all the same.)
"""

import asyncio
import logging
import socket
import ssl
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final, cast

from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.foxglove import frames, handshake
from sern_client.endpoints.foxglove.frames import Fault
from sern_client.endpoints.foxglove.handshake import RefusedError, Rules, Turned
from sern_client.endpoints.foxglove.viewer import FLUSH_S, ServerSide, Viewer
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason

HANDSHAKE_S: Final = 10.0
MAX_VIEWERS: Final = 64
MAX_ARRIVING: Final = 64
"""Connections that have not said what they want."""
_GONE: Final = 1001

_log = logging.getLogger(__name__)


class Shared:
    """What is counted of all viewers, and who wants to know of them."""

    def __init__(self) -> None:
        self.dropped: Counter[DropReason] = Counter()
        self.faults: Counter[Fault] = Counter()
        self.turned: Counter[Turned] = Counter()
        self.falls_behind = 0
        self.viewers: set[Viewer] = set()
        self.say_once = SayOnce(_log)
        self._looking: dict[int, dict[Viewer, int]] = {}  # their own numbers, by channel
        self.on_subscribed: Callable[[Viewer, int, int], None] = lambda _viewer, _subscription, _channel: None
        self.on_changed: Callable[[], None] = lambda: None

    def show(self, channel: int, body: bytes, *, must: bool) -> None:
        """Show a message to all who look at a channel. Its time is when it came: clocks of its origins may differ."""
        looking = self._looking.get(channel)
        if looking:
            now_ns = time.time_ns()
            for viewer, subscription in list(looking.items()):
                viewer.show(subscription, now_ns, body, must=must)

    def subscribed(self, viewer: Viewer, subscription: int, channel: int) -> None:
        self._looking.setdefault(channel, {})[viewer] = subscription
        self.on_subscribed(viewer, subscription, channel)

    def ended(self, channel: int) -> None:
        """There is no such channel any more. Some viewers never say that they do not look at it."""
        for viewer, subscription in self._looking.pop(channel, {}).items():
            viewer.forget(subscription, channel)

    def unsubscribed(self, viewer: Viewer, channel: int) -> None:
        looking = self._looking.get(channel, {})
        looking.pop(viewer, None)
        if not looking:
            self._looking.pop(channel, None)

    def fault(self, fault: Fault, problem: str, peer: str = "") -> None:
        self.faults[fault] += 1
        self.say_once(f"{peer} {problem}".strip(), peer.rpartition(":")[0], problem)

    def behind(self, viewer: Viewer) -> None:
        self.falls_behind += 1
        problem = "takes less than what comes: its oldest messages are dropped"
        self.say_once(f"{viewer.peer} {problem}", viewer.peer.rpartition(":")[0], problem)

    def gone(self, viewer: Viewer) -> None:
        self.viewers.discard(viewer)
        self.on_changed()

    def refuse(self, peer: str, error: RefusedError) -> None:
        self.turned[error.why] += 1
        self.say_once(f"{peer.rpartition(':')[0]} was refused: {error}")


class _Arrival(asyncio.Protocol):
    """A connection at the door, and the viewer that comes of it."""

    def __init__(self, door: "Door") -> None:
        self._door = door
        self._received = bytearray()
        self._transport: asyncio.Transport | None = None
        self._viewer: Viewer | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._joining: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._door.connections.add(self)
        self._door.arrivals.add(self)
        if len(self._door.arrivals) > MAX_ARRIVING:
            self._refuse(RefusedError(Turned.FULL, HTTPStatus.SERVICE_UNAVAILABLE, "too many connect at once"))
            return
        self._timer = asyncio.get_running_loop().call_later(HANDSHAKE_S, self._too_long)

    def data_received(self, data: bytes) -> None:
        if self._viewer is not None and self._joining is None:
            self._viewer.hear(data)
            return
        self._received += data
        if self._joining is not None:
            if len(self._received) > frames.MAX_TEXT_BYTES:
                self.abort()
            return
        try:
            request = handshake.read(bytes(self._received))
            if request is None:
                return
            handshake.check(request, self._door.rules)
            if len(self._door.shared.viewers) >= MAX_VIEWERS:
                raise RefusedError(
                    Turned.FULL, HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers are connected already"
                )
        except RefusedError as error:
            self._refuse(error)
            return
        self._received = bytearray(request.rest)
        assert self._transport is not None
        self._viewer = Viewer(
            self.peer,
            self._transport,
            self._door.shared,
            protocol=handshake.protocols_of(request)[0],
            max_waiting_bytes=self._door.max_bytes,
        )
        self._door.shared.viewers.add(self._viewer)
        self._joining = self._door.begin(self._join(self._viewer, request))

    async def _join(self, viewer: Viewer, request: handshake.Request) -> None:
        host, port = self._door.server
        loop = asyncio.get_running_loop()
        connection = socket.socket()
        connection.setblocking(False)
        try:
            await loop.sock_connect(connection, self._door.server)
            server, _ = await loop.create_connection(lambda: ServerSide(viewer, connection), sock=connection)
        except OSError as error:
            connection.close()
            _log.error("the server behind the door does not answer: %s", error.strerror)
            viewer.close()
            return
        finally:
            self._arrived()
            self._joining = None
        if viewer.closed:
            server.abort()
            return
        server.write(handshake.passed_on(request, f"{host}:{port}"))
        viewer.hear(bytes(self._received))
        self._received.clear()
        self._door.shared.on_changed()

    @property
    def peer(self) -> str:
        found = None if self._transport is None else self._transport.get_extra_info("peername")
        return f"{found[0]}:{found[1]}" if found else "somebody"

    def pause_writing(self) -> None:
        if self._viewer is not None:
            self._viewer.pause()

    def resume_writing(self) -> None:
        if self._viewer is not None:
            self._viewer.resume()

    def connection_lost(self, error: Exception | None) -> None:
        self._arrived()
        if self._viewer is not None:
            self._viewer.close()
        self._door.left(self)

    def abort(self) -> None:
        self._arrived()
        if self._transport is not None:
            self._transport.abort()

    def _arrived(self) -> None:
        self._door.arrivals.discard(self)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _refuse(self, error: RefusedError) -> None:
        self._door.shared.refuse(self.peer, error)
        assert self._transport is not None
        self._transport.write(error.answer())
        self._transport.close()
        self._arrived()

    def _too_long(self) -> None:
        problem = f"no request came within {HANDSHAKE_S:g} s"
        self._door.shared.refuse(self.peer, RefusedError(Turned.REQUEST, HTTPStatus.REQUEST_TIMEOUT, problem))
        self.abort()


class Door:
    """`open` once, `close` once. `server`: where the server behind it listens."""

    def __init__(self, shared: Shared, rules: Rules, *, max_bytes: int) -> None:
        self.shared = shared
        self.rules = rules
        self.max_bytes = max_bytes
        self.arrivals: set[_Arrival] = set()
        self.server = ("", 0)
        self.connections: set[_Arrival] = set()
        self._emptied = asyncio.Event()
        self._joining: set[asyncio.Task[None]] = set()
        self._listening: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """The port in use, also when 0 was asked for."""
        assert self._listening is not None
        return int(self._listening.sockets[0].getsockname()[1])

    async def open(self, host: str, port: int, tls: ssl.SSLContext | None) -> None:
        """ConfigError when it cannot listen there."""
        loop = asyncio.get_running_loop()
        try:
            self._listening = await loop.create_server(
                lambda: _Arrival(self), host, port, ssl=tls, ssl_handshake_timeout=HANDSHAKE_S if tls else None
            )
        except OSError as error:
            raise ConfigError(
                f"cannot listen on {host}:{port} for viewers: {error.strerror or error}; choose another in listen"
            ) from None

    async def close(self) -> None:
        """Every viewer is told that this ends."""
        if self._listening is None:
            return
        self._listening.close()
        for viewer in list(self.shared.viewers):
            viewer.cut(_GONE, "this end of the bridge stops")
        for connection in list(self.arrivals):
            connection.abort()
        try:
            async with asyncio.timeout(FLUSH_S):
                while self.connections:
                    await self._emptied.wait()
        except TimeoutError:
            for connection in list(self.connections):
                connection.abort()
        while self._joining:
            await asyncio.wait(self._joining)
        await self._listening.wait_closed()
        self._listening = None

    def begin(self, joining: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        task = asyncio.get_running_loop().create_task(joining, name="sern-foxglove-join")
        self._joining.add(task)
        task.add_done_callback(self._joining.discard)
        return task

    def left(self, connection: _Arrival) -> None:
        """One is no more."""
        self.connections.discard(connection)
        if not self.connections:
            self._emptied.set()


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """ConfigError when the files cannot be used."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, OSError, ValueError) as error:
        raise ConfigError(f"{certificate} and {key} cannot be used for TLS: {error}") from None
    return context
