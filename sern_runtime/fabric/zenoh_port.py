"""The fabric over zenoh: one session, an inbox, tokens for who is there.

zenoh calls from threads of its own. What it says there is put down and the loop is woken, no more: a callback of 20 ms
would hold up all that the session receives (measured). They are called straight from zenoh's receiving thread: another
thread and a queue of zenoh's in between gained no time (measured), and that queue would not be ours to bound.

The session is opened and closed in a thread of ours: zenoh waits there. Where there are several external routers, that
thread goes over to another one when its router is lost. Zenoh would try the lost one first, which takes `ROUTER_S` if
that stands still.
"""

import asyncio
import json
import logging
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event, Lock, Thread
from time import perf_counter
from types import ModuleType
from typing import Any, Final

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire.framing import MAX_DATAGRAM_BYTES
from sern_runtime.config.endpoints import installing
from sern_runtime.config.fabric import FabricSection
from sern_runtime.fabric import keys
from sern_runtime.fabric.port import FabricCounters, FabricDrop, FabricEvents, PeerRelay
from sern_runtime.fabric.zenoh_settings import RETRY_FIRST_S, RETRY_MAX_S, FabricOptions, settings

BATCH: Final = 200
"""Datagrams handed over in one turn of the loop: others get their turn."""
KNOWN_KEYS: Final = 4096
"""Keys of datagrams whose source is remembered rather than read anew."""
OWN_NAME_TEXT: Final = "another process of this fabric has the name of this relay, %s; give one of them another name"

_log = logging.getLogger(__name__)


def load_zenoh() -> ModuleType:
    """The zenoh module; ConfigError naming the command that installs it."""
    try:
        import zenoh
    except ImportError:
        raise ConfigError(f"needs the zenoh library: {installing('eclipse-zenoh')}") from None
    return zenoh


def options_of(
    section: FabricSection, base_dir: Path, *, name: ClientName, boot: int, rules: str = ""
) -> FabricOptions:
    """What the section of a relay's file means for the process that read it. `rules`: the hash of its access rules."""
    return FabricOptions(
        name=name,
        boot=boot,
        rules=rules,
        listen=section.listen,
        peers=section.peers,
        relays=section.others,
        certificates=section.certificate_files(base_dir, name),
        external=section.external,
        lease_s=section.lease_s,
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def _report(thread: "Future[None]") -> None:
    """An error of ours in the thread must not pass unseen."""
    if not thread.cancelled() and (error := thread.exception()) is not None:
        _log.error("the fabric's session is not looked after any more; restart this relay", exc_info=error)


class ZenohPort:
    """A `FabricPort`; `events` is told. All calls on the thread of the loop that `start` ran in."""

    def __init__(self, options: FabricOptions, events: FabricEvents, *, most_bytes: int = MAX_DATAGRAM_BYTES) -> None:
        """`most_bytes`: the largest datagram that is sent."""
        self._most_bytes = most_bytes
        self.counters = FabricCounters()
        self._zenoh = load_zenoh()
        self._options = options
        self._events = events
        self._session: Any = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = False
        self._leaving = Event()
        self._stir = Event()  # the thread has something to do: we leave, or the router is lost
        self._opened = 0  # sessions so far; what an earlier one tells is not believed
        self._keeps: list[Any] = []  # what zenoh undeclares when nobody has it any more
        zenoh = self._zenoh
        self._priorities = {
            PriorityClass.CONTROL: zenoh.Priority.REAL_TIME,
            PriorityClass.STATE: zenoh.Priority.DATA,
            PriorityClass.BULK: zenoh.Priority.BACKGROUND,
        }
        self._keys: dict[tuple[ClientName, PriorityClass], Any] = {}
        # Towards the loop. Each of the numbers is written by one thread alone.
        self._woken = False
        self._inbox: deque[tuple[str, bytes]] = deque()
        self._put_bytes = self._taken_bytes = 0
        self._inbox_full = 0
        self._news: dict[str, bool] = {}
        self._news_full = 0
        self._alive: set[str] = set()  # tokens that are there, as the session said
        self._news_lock = Lock()
        # What the loop knows.
        self._sources: dict[str, ClientName] = {}
        self._peers: dict[tuple[ClientName, int], PeerRelay] = {}
        self._boots: dict[ClientName, int] = {}  # how many processes of that name are there
        self._told_own_name = False
        self._opening = ThreadPoolExecutor(1, thread_name_prefix="fabric")

    # --- life -------------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Raises ConfigError of one line."""
        self._loop = asyncio.get_running_loop()
        try:
            config = self._config(self._options)
            if self._options.external:
                self._opening.submit(self._stay_at_a_router).add_done_callback(_report)
            else:
                await self._open_now(self._loop.run_in_executor(self._opening, self._open, config))
        except self._zenoh.ZError as error:
            await self.close()
            raise ConfigError(f"zenoh does not start: {_one_line(error)}") from error

    async def _open_now(self, opening: asyncio.Future[None]) -> None:
        try:
            await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait([opening])
            await self.close()
            raise

    def _config(self, options: FabricOptions) -> Any:
        config = self._zenoh.Config()
        for key, value in settings(options).items():
            config.insert_json5(key, json.dumps(value))
        return config

    def _stay_at_a_router(self) -> None:
        """Stay at a router until `close`, in the thread: what else waits for that waits for the session as well."""
        routers, said, pause_s = list(self._options.peers), False, RETRY_FIRST_S
        while not self._leaving.is_set():
            try:
                router = self._open_one_of(routers)
            except self._zenoh.ZError as error:
                if not said:
                    said = True
                    where = ", ".join(routers)
                    _log.warning("no router of the fabric answers at %s, tried on: %s", where, _one_line(error))
                self._stir.wait(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
            else:
                said, pause_s = False, RETRY_FIRST_S
                if len(routers) == 1:
                    return  # zenoh goes back to it by itself
                self._stir.wait()
                if not self._leaving.is_set():
                    _log.info("the router %s of the fabric is lost; going on to another one", router)
                    routers.remove(router)
                    routers.append(router)
                    self._forget_session()
            self._stir.clear()

    def _open_one_of(self, routers: Sequence[str]) -> str:
        """Open a session at the first that answers, in the thread; ZError: the last did not either."""
        *others, last = routers
        for router in others:
            try:
                self._open_at(router)
            except self._zenoh.ZError:
                if self._leaving.is_set():
                    raise
            else:
                return router
        self._open_at(last)
        return last

    def _open_at(self, router: str) -> None:
        """Open a session at a router, in the thread. Raises ZError."""
        try:
            self._open(self._config(replace(self._options, peers=(router,))))
        except self._zenoh.ZError:
            if self._session is not None:  # it answered, and was lost before all was declared
                self._forget_session()
            raise

    def _forget_session(self) -> None:
        """Forget what the session told, in the thread. The session is closed beside, as zenoh may wait there."""
        self._opened += 1
        keeps, self._keeps = self._keeps, []
        session, self._session = self._session, None

        def close() -> None:
            keeps.clear()
            session.close()

        Thread(target=close, name="fabric-close", daemon=True).start()
        with self._news_lock:
            for key in self._alive:
                self._news.pop(key, None)
                self._news[key] = False
            self._alive.clear()
        self._wake()

    def _open(self, config: Any) -> None:
        """Open a session, in the thread. The inbox comes before the token: whoever sees that may send."""
        zenoh, options = self._zenoh, self._options
        session = self._session = zenoh.open(config)
        self._opened += 1
        straight = zenoh.handlers.Callback
        if options.external:
            lost = straight(partial(self._on_router, self._opened), indirect=False)
            self._keeps.append(session.info.declare_transport_events_listener(lost, history=False))
            if not session.info.routers_zid():
                self._stir.set()  # before anybody listened
        inbox = straight(self._on_datagram, indirect=False)
        self._keeps.append(session.declare_subscriber(keys.inbox(options.name), inbox))
        liveliness = session.liveliness()
        news = straight(partial(self._on_token, self._opened), indirect=False)
        self._keeps.append(liveliness.declare_subscriber(keys.RELAY_TOKENS, news, history=True))
        self._keeps.append(liveliness.declare_token(keys.relay_token(options.itself)))

    async def close(self) -> None:
        """The others see at once that we are gone; `events` is told that they are. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._leaving.set()
        self._stir.set()
        if self._loop is not None:
            await self._loop.run_in_executor(self._opening, self._leave)
        self._opening.shutdown()
        self._inbox.clear()
        self._news.clear()
        for peer in list(self._peers.values()):
            self._forget_peer(peer)

    def _leave(self) -> None:
        self._keeps.clear()
        session, self._session = self._session, None
        if session is not None:
            session.close()

    # --- out --------------------------------------------------------------------------------------------------------

    def send(self, destination: ClientName, priority: PriorityClass, datagram: bytes) -> bool:
        counters, session = self.counters, self._session
        if session is None or self._closed:
            return self._drop(FabricDrop.CLOSED)
        if destination not in self._boots:
            return self._drop(FabricDrop.NO_PEER)
        if len(datagram) > self._most_bytes:
            return self._drop(FabricDrop.TOO_LARGE)
        key = self._keys.get((destination, priority))
        zenoh = self._zenoh
        if key is None:
            text = keys.hop_key(destination, self._options.name, priority)
            key = self._keys[destination, priority] = zenoh.KeyExpr(text)
        began_s = perf_counter()
        try:
            session.put(
                key,
                datagram,
                priority=self._priorities[priority],
                congestion_control=zenoh.CongestionControl.DROP,
                express=False,  # it gained nothing (measured), and a batch for each small datagram fills queues
                allowed_destination=zenoh.Locality.REMOTE,
            )
        except zenoh.ZError:
            return self._drop(FabricDrop.REFUSED)
        finally:
            took_s = perf_counter() - began_s
            counters.send_block_s += took_s
            if took_s > counters.send_block_max_s:
                counters.send_block_max_s = took_s
        counters.sent += 1
        counters.sent_bytes += len(datagram)
        return True

    def _drop(self, reason: FabricDrop) -> bool:
        self.counters.dropped[reason] += 1
        return False

    # --- in, on zenoh's threads -------------------------------------------------------------------------------------

    def _on_datagram(self, sample: Any) -> None:
        data = sample.payload.to_bytes()
        waiting_bytes = self._put_bytes - self._taken_bytes
        options = self._options
        if len(self._inbox) >= options.inbox_datagrams or waiting_bytes + len(data) > options.inbox_bytes:
            self._inbox_full += 1
        else:
            self._put_bytes += len(data)
            self._inbox.append((str(sample.key_expr), data))
        self._wake()

    def _on_router(self, opened: int, event: Any) -> None:
        if opened == self._opened and event.kind == self._zenoh.SampleKind.DELETE:
            self._stir.set()

    def _on_token(self, opened: int, sample: Any) -> None:
        key, alive = str(sample.key_expr), sample.kind == self._zenoh.SampleKind.PUT
        with self._news_lock:
            if opened != self._opened:
                return
            if not alive:
                self._alive.discard(key)
            elif len(self._alive) < self._options.tokens:
                self._alive.add(key)
            self._news.pop(key, None)  # to the end: news of another token may have come in between
            most = self._options.tokens * (1 if alive else 2)  # what goes has the better claim to be heard
            if len(self._news) < most:
                self._news[key] = alive
            else:
                self._news_full += 1
        self._wake()

    def _wake(self) -> None:
        if self._woken or self._closed or self._loop is None:
            return
        self._woken = True
        try:
            self._loop.call_soon_threadsafe(self._take)
        except RuntimeError:  # the loop is closed
            self._closed = True

    # --- in, on the loop --------------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Hand over what has come. What an event raises goes to the loop's handler; the rest follows all the same."""
        self._woken = False  # first: what comes from now on wakes again
        if self._closed:
            return
        try:
            self._take_news()
            for _ in range(min(BATCH, len(self._inbox))):
                key, data = self._inbox.popleft()
                self._taken_bytes += len(data)
                source = self._sources.get(key) or self._source(key)
                if source is not None:
                    self.counters.received += 1
                    self.counters.received_bytes += len(data)
                    self._events.arrived(source, data)
        finally:
            self.counters.dropped[FabricDrop.INBOX_FULL] = self._inbox_full
            if (self._inbox or self._news) and not self._woken and not self._closed:
                self._woken = True
                asyncio.get_running_loop().call_soon(self._take)

    def _source(self, key: str) -> ClientName | None:
        source = keys.parse_source(key, self._options.name)
        if source is None or not self._known(source):
            self._drop(FabricDrop.BAD_KEY)
            return None
        if source == self._options.name:
            self._drop(FabricDrop.OWN_NAME)
            return None
        if len(self._sources) >= KNOWN_KEYS:
            self._sources.clear()
        self._sources[key] = source
        return source

    def _known(self, relay: ClientName) -> bool:
        """Whether the relay may take part. Where there are certificates zenoh has seen to it already."""
        relays = self._options.relays
        return relays is None or relay in relays or relay == self._options.name

    def _take_news(self) -> None:
        if not self._news:
            return
        with self._news_lock:
            news, self._news = self._news, {}
        while news:
            key = next(iter(news))
            alive = news.pop(key)
            try:
                self._told(key, alive)
            except BaseException:
                with self._news_lock:  # what came meanwhile is the newer
                    self._news = {**news, **self._news}
                raise
        self.counters.dropped[FabricDrop.NEWS_FULL] = self._news_full

    def _told(self, key: str, alive: bool) -> None:
        peer = keys.parse_token(key)
        if peer is None:
            self._drop(FabricDrop.BAD_KEY)
        elif peer.name == self._options.name:
            self._own(peer, alive)
        elif not self._known(peer.name):
            self._drop(FabricDrop.BAD_KEY)
        else:
            self._told_peer(peer, alive)

    def _own(self, peer: PeerRelay, alive: bool) -> None:
        """Our own token comes back to us, too; or somebody else has our name."""
        if peer.boot == self._options.boot or not alive:
            return
        self._drop(FabricDrop.OWN_NAME)
        if not self._told_own_name:
            self._told_own_name = True
            _log.error(OWN_NAME_TEXT, self._options.name)

    def _told_peer(self, peer: PeerRelay, alive: bool) -> None:
        known = self._peers.get((peer.name, peer.boot))
        if not alive:
            if known == peer:
                self._forget_peer(peer)
        elif known is None:
            if len(self._peers) >= self._options.tokens:
                self._drop_news()
                return
            self._peers[peer.name, peer.boot] = peer
            self._boots[peer.name] = self._boots.get(peer.name, 0) + 1
            self.counters.peers_up = len(self._boots)
            self._events.peer_up(peer)

    def _forget_peer(self, peer: PeerRelay) -> None:
        del self._peers[peer.name, peer.boot]
        self._boots[peer.name] -= 1
        if not self._boots[peer.name]:
            del self._boots[peer.name]
        self.counters.peers_up = len(self._boots)
        self._events.peer_down(peer.name, peer.boot)

    def _drop_news(self) -> None:
        with self._news_lock:
            self._news_full += 1
