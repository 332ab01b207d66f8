"""The relay daemon: composition root of hub, lane, access control, feed, HTTP and logs."""

import asyncio
import json
import logging
import secrets
import time
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import zmq
from prometheus_client import CollectorRegistry

from sern_core.objects.feed import PERIOD_S
from sern_core.relay.access import AccessTable
from sern_core.relay.hub import Hub, HubParams
from sern_core.relay.traces import Traces
from sern_core.vocabulary.errors import ConfigError
from sern_relay.admission import ZAP_DOMAIN, Admission, read_directory
from sern_relay.comings import Comings
from sern_relay.durable import DurableHolding
from sern_relay.enforcement import Enforcement
from sern_relay.feed_roles import FeedRoles
from sern_relay.hub_news import HubNews
from sern_relay.keyring import OwnKeys, RelayKeyring
from sern_relay.readers import Readers
from sern_relay.refusals import Refusals
from sern_relay.relay_metrics import register_relay
from sern_relay.revocations import FabricRevocations
from sern_relay.server import RelayServer
from sern_relay.transforms import TransformObjects
from sern_relay.transports import Transports
from sern_relay.udp import RelayLanes
from sern_relay.unconfirmed import wait_confirmed
from sern_relay.views import RelayViews
from sern_runtime import clock, ros_types
from sern_runtime.adaptation import Adaptation
from sern_runtime.codec_pool import CodecPool, make_coder
from sern_runtime.collector import CollectorWatch
from sern_runtime.config.fabric import FabricSection
from sern_runtime.config.keys import KeyDirectory, fingerprint
from sern_runtime.config.load import Loaded
from sern_runtime.config.relay import RelayFile, load_relay
from sern_runtime.datagram_watch import DatagramWatch
from sern_runtime.durable.disk import Disk
from sern_runtime.entry import blamed_on, end_tasks, log_warnings, serve
from sern_runtime.events import EventLog
from sern_runtime.http_routes import Health
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.loop import Shutdown
from sern_runtime.message_log import LoggedFates, MessageLog
from sern_runtime.metrics import Metrics
from sern_runtime.open_files import require_open_files
from sern_runtime.optional import OptionalParts
from sern_runtime.reload_state import ReloadState
from sern_runtime.sdnotify import Notifier, Watchdog
from sern_runtime.watching.live import Live
from sern_runtime.zap import ZapHandler, self_test

if TYPE_CHECKING:
    from sern_relay.fabric import RelayFabric
    from sern_runtime.http import HttpServer

SWEEP_S: Final = 1.0
OTHER_FILES: Final = 128
"""What a relay has open beside the connections of clients."""

_log = logging.getLogger(__name__)


async def run_relay(path: Path, shutdown: Shutdown) -> int:
    """Run until asked to stop. Raises ConfigError for what is wrong with the file or the machine."""
    loaded = load_relay(path)
    log_warnings(_log, loaded.warnings)
    daemon = RelayDaemon(loaded)
    try:
        await daemon.start()
        daemon.collector.settle()
        shutdown.on_reload = daemon.reload
        await serve(shutdown, daemon.tasks)
        daemon.notifier.stopping("draining")
        await daemon.drain()
    finally:
        await daemon.stop()
    return 0


class RelayDaemon:
    """`start`, then any time, then `drain` and `stop`; `stop` alone is safe at any point."""

    def __init__(self, loaded: Loaded[RelayFile]) -> None:
        self.loaded = loaded
        model = loaded.model
        self.notifier = Notifier.from_environment()
        self.admission = Admission(self._directory(loaded))
        self.errors = InternalErrors()
        self.collector = CollectorWatch()
        self.reloads = ReloadState()
        self.events = EventLog()
        self.turned_away = Refusals(self.events)
        self.transports = Transports()
        self.parts = OptionalParts(
            "adaptation",
            "codecs",
            "feed",
            "http",
            "message_log",
            "metrics",
            "objects",
            "summary",
            "watching",
        )
        self.codecs = CodecPool(after=self.transports.after, parts=self.parts)
        self.coder = make_coder(model.link.params(), self.codecs)
        self.readers = Readers(self.coder, self.parts, self.errors)
        self._comings = Comings(
            self.events, relay=model.name, remembered=self.admission.named, address=self.transports.address
        )
        self.news = HubNews(self._comings, self.readers, self.transports, self.events, self.errors)
        self.hub = Hub(
            name=model.name,
            boot=secrets.randbits(63),
            access=AccessTable(model.access_rules()),
            known=self.admission.known,
            events=self.news,
            link=model.link.params(),
            scheduler=model.scheduler.params(),
            params=HubParams(cache_bytes=model.replay.cache_bytes, resume_s=model.replay.resume_s),
            wall_ns=lambda _now: time.time_ns(),
            traces=Traces(),
            now=clock.now(),
        )
        self.hub.after = self.transports.after
        self.message_log: MessageLog | None = None
        if model.message_log:
            self.message_log = MessageLog(loaded.resolve(model.message_log), partial(self.parts.ended, "message_log"))
        self.fates: LoggedFates | None = None
        if self.message_log is not None:
            self.fates = self.hub.forwarding.fates = LoggedFates(self.message_log, self.parts)
        self.enforcement = Enforcement(self.hub, self.admission, self.transports, self.events)
        self.revocations = self.news.revocations = FabricRevocations(
            self.hub, self.admission, self.events, enforce=self.enforcement.enforce
        )
        self.feed_roles = FeedRoles(
            loaded.path,
            self.hub,
            self.readers,
            self.reloads,
            in_force=self._in_force,
            after=self.transports.after,
            refused=self.news.refused,
        )
        self.views = RelayViews(
            model.name,
            self.hub,
            self._comings,
            self.turned_away,
            self.events,
            self.admission,
            self.transports.address,
        )
        self.adaptation: Adaptation | None = None
        if model.adaptation is not None:
            with blamed_on(loaded.path, "adaptation"):
                self.adaptation = Adaptation(
                    model.adaptation,
                    lambda: list(self.hub.links.values()),
                    coder=None,
                    kick=self.transports.after,
                    parts=self.parts,
                )
        self.durable: DurableHolding | None = None
        if model.durable is not None:
            self.durable = self._make_durable(
                Disk.within(loaded.resolve(model.durable.directory), max_bytes=model.durable.max_bytes, shared=True)
            )
        self.zap: ZapHandler | None = None
        self.keyring: RelayKeyring | None = None
        self.datagrams = DatagramWatch(
            self.hub.clients.of_clients, self.transports.datagram_problem, lambda link: link.peer
        )
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None
        self._http: HttpServer | None = None
        self.live: Live | None = None
        self.tasks: list[asyncio.Task[None]] = []
        self._ready = False

    @staticmethod
    def _directory(loaded: Loaded[RelayFile]) -> KeyDirectory | None:
        clients_dir = loaded.model.relay.clients_dir
        return read_directory(None if clients_dir is None else loaded.resolve(clients_dir))

    def _make_durable(self, disk: Disk) -> DurableHolding:
        known, after = self.admission.known, self.transports.after
        return DurableHolding(disk, self.hub, known=known, now=clock.now, after=after)

    def _make_fabric(self, section: FabricSection) -> "RelayFabric":
        from sern_relay.fabric import RelayFabric

        model = self.loaded.model
        return RelayFabric(section, self.loaded.path.parent, self.hub, rules=model.access_rules())

    def _own_keys(self) -> OwnKeys | None:
        """The relay's own keys as its files say now. Raises ConfigError."""
        file = self.loaded.model.relay.secret_key_file
        return None if file is None else OwnKeys.read(self.loaded.resolve(file))

    async def start(self) -> None:
        self.errors.watch(asyncio.get_running_loop())
        self.collector.watch()
        ros_types.load()
        model = self.loaded.model
        relay = model.relay
        own = self._own_keys()
        keys = None if own is None else own.now
        if model.http.listen is not None:
            with blamed_on(self.loaded.path, "http", "listen"):
                self._http = self._make_http(model.http.listen)
                await self._http.start()
        if self.durable is not None:
            with blamed_on(self.loaded.path, "durable", "directory"):
                self.durable.start()
        with blamed_on(self.loaded.path, "relay", "max_connections"):
            require_open_files(relay.max_connections + OTHER_FILES)
        self._ctx = zmq.Context()
        self.readers.transforms = TransformObjects(
            self.hub.objects, parts=self.parts, elsewhere=lambda stream: self.hub.routing.via(stream) is not None
        )
        if own is not None:
            self.zap = ZapHandler(self._ctx, refused=self.turned_away.refuse)
            self.zap.add_domain(ZAP_DOMAIN, self.admission.lookup)
            self.keyring = self.news.keyring = RelayKeyring(
                self.hub,
                self.admission,
                own,
                overlap_s=relay.overlap_s,
                session_key=self.transports.session_key,
                after=self.transports.after,
                relays=self.transports.reached,
            )
        self.revocations.read()
        with blamed_on(self.loaded.path, "relay", "listen"):
            server = self.transports.server = RelayServer(
                self._ctx,
                self.hub,
                relay.listen,
                keys,
                ZAP_DOMAIN,
                key_status=self.admission.status,
                heartbeat_timeout_s=model.link.heartbeat_timeout_s,
                handshake_interval_s=relay.handshake_interval_s,
                max_connections=relay.max_connections,
                redundancy=model.link.redundancy,
                after=self.transports.after,
                marks=model.link.dscp.marks(),
                turned_away=self.turned_away.note,
            )
        if keys is not None and relay.udp:
            with blamed_on(self.loaded.path, "relay", "listen"):
                self.transports.lanes = RelayLanes(
                    self.hub,
                    relay.listen,
                    port_of=server.local_port,
                    after=self.transports.after,
                    marks=model.link.dscp.marks(),
                )
        if model.fabric is not None:
            with blamed_on(self.loaded.path, "fabric"):
                fabric = self.transports.fabric = self._make_fabric(model.fabric)
                await fabric.start()
        if keys is not None and self.zap is not None:
            await self_test(self._ctx, self.zap, relay.listen, keys.public_key)
            _log.info("self-test passed: a stranger's key is refused on %s", ", ".join(relay.listen))
        else:
            _log.warning("insecure: true: clients are not authenticated and nothing is encrypted")
        with blamed_on(self.loaded.path, "feed", "roles"):
            self.feed_roles.start(self._ctx, model.feed_roles())
        self.tasks.append(asyncio.create_task(self._tick(), name="relay-tick"))
        self.tasks.append(asyncio.create_task(self._tell_objects(), name="relay-objects"))
        if self.adaptation is not None:
            kept = self.parts.keep("adaptation", self.adaptation.run, reset=self.adaptation.reset)
            self.tasks.append(asyncio.create_task(kept, name="adaptation"))
        if self.live is not None:
            kept = self.parts.keep("watching", self.live.run, reset=self.live.reset)
            self.tasks.append(asyncio.create_task(kept, name="watching"))
        self._ready = True
        self.notifier.ready(f"{model.name} on {', '.join(relay.listen)}")
        self.events.say(
            _log, logging.INFO, "started", "", "relay %s listens on %s", model.name, ", ".join(relay.listen)
        )

    async def _tick(self) -> None:
        transports = self.transports
        progress = {"socket": lambda: transports.server.socket.drains if transports.server else 0}
        if self.zap is not None:
            progress["zap"] = lambda: self.zap.counters.pings if self.zap else 0
            self.zap.ping()  # answered by the first sweep, which would else take it for stuck
        if self.durable is not None:
            disk = self.durable.disk
            progress["store"] = lambda: disk.progress(now=clock.now())
        watchdog = Watchdog(self.notifier, progress)
        while True:
            await asyncio.sleep(SWEEP_S)
            self.enforcement.end_lapsed()
            now = clock.now()
            self.hub.sweep(now=now)
            more = True
            while more:  # the others have their turns in between
                await asyncio.sleep(0)
                more = self.hub.lapse(now=clock.now())
            if transports.server is not None:
                transports.server.look()
            self.datagrams.tick()
            if self.message_log is not None:
                with self.parts.survive("message_log"):
                    self.message_log.flush()
            with self.parts.survive("feed"):
                self.feed_roles.look(now=now)
            transports.flush()
            if self.zap is not None:
                self.zap.ping()
            if watchdog.interval_s is not None:
                watchdog.check()
            self._comings.look(self.hub.links, now)
            self.events.tick()
            self.notifier.status(self._status())

    async def _tell_objects(self) -> None:
        while True:
            await asyncio.sleep(PERIOD_S)
            if self.hub.exchange.feeds or self.hub.peers.names:
                self.hub.tell_objects(now=clock.now())

    def _status(self) -> str:
        """One line for `systemctl status`."""
        return self.reloads.beside(f"{self.clients_up()} clients, {len(self.hub.relayed)} streams")

    def readiness(self) -> Health:
        """What `/readyz` says."""
        return Health(ok=self._ready, reason=self.reloads.beside("listening" if self._ready else "starting"))

    def clients_up(self) -> int:
        """Clients with a session."""
        return sum(link.established for link in self.hub.clients.of_clients())

    @property
    def takeovers(self) -> int:
        """Sessions that another process took under its client's name."""
        return self._comings.takeovers

    def reload(self) -> None:
        """SIGHUP: read keys, access rules and the feed's roles anew; all or nothing. What was revoked ends now."""
        self.notifier.reloading()
        try:
            loaded = load_relay(self.loaded.path)
            directory = self._directory(loaded)
            access = AccessTable(loaded.model.access_rules())
            own = self._own_keys()
        except ConfigError as error:
            self.reloads.failed(str(error), now=clock.now())
            self.events.say(
                _log, logging.ERROR, "reload_failed", "", "reload failed, the old configuration stays: %s", error
            )
            self.notifier.ready(self._status())
            return
        self.reloads.read()
        log_warnings(_log, loaded.warnings)
        self.admission.replace(directory)
        self.revocations.read()
        now = clock.now()
        self.hub.revoke(access, now=now)
        with self.parts.survive("feed"):
            self.feed_roles.use(loaded.model.feed_roles(), now=now)
        if own is not None:
            self._use_keys(own, loaded.model)
        self.enforcement.enforce()
        self.notifier.ready(self._status())
        self._in_force(now)
        words = "reloaded keys, access rules and feed roles; other changes need a restart"
        self.events.say(_log, logging.INFO, "reloaded", "", words)

    def _use_keys(self, own: OwnKeys, model: RelayFile) -> None:
        """What the relay proves itself with from now on, and what clients are told of it."""
        if self.keyring is None or self.transports.server is None:
            return
        if own.now != self.keyring.own.now:
            self.transports.server.rekey(own.now, ZAP_DOMAIN)
            _log.warning("the relay has a new key, %s: clients connect anew", fingerprint(own.now.public_key))
        self.keyring.use(own, overlap_s=model.relay.overlap_s)

    def _in_force(self, now: float) -> None:
        failed_s = self.reloads.take_recovery_s(now=now)
        if failed_s is not None:
            _log.error("the reload works again: what had failed before is in force, after %.0f s", failed_s)

    def _make_http(self, listen: str) -> "HttpServer":
        from sern_runtime.http import HttpServer
        from sern_runtime.watching.page import add_page

        registry = CollectorRegistry()
        metrics = Metrics(registry)
        register_relay(metrics, self, fabric=self.loaded.model.fabric is not None)
        server = HttpServer(
            listen,
            registry,
            health=lambda: Health(ok=True, reason="running"),
            ready=self.readiness,
            json_routes={
                **self.views.routes(self.adaptation),
                "/api/keys": lambda: {} if self.keyring is None else self.keyring.to_json(),
            },
            access=self.loaded.model.http.access(self.loaded.path.parent),
            parts=self.parts,
        )
        server.register(metrics)
        self.live = Live(self.views.told(self.adaptation), self.events)
        add_page(server, self.live, metrics)
        return server

    async def drain(self) -> None:
        """Go on with what connected clients have not confirmed while that gets anywhere, then end their sessions."""
        await wait_confirmed(self.hub.links, limit_s=self.loaded.model.link.drain_s)
        for link in self.hub.links.values():
            link.close("relay stops", now=clock.now())
        if self.transports.server is not None:
            self.transports.server.run_all()
            await asyncio.sleep(0.05)  # libzmq's thread takes it from here

    async def stop(self) -> None:
        """Ends whatever was started, the last first, also when a part of it fails."""
        self._ready = False
        async with AsyncExitStack() as stack:
            stack.callback(self.errors.unwatch, asyncio.get_running_loop())
            stack.callback(self.collector.close)
            stack.callback(self.notifier.close)
            stack.callback(self._write_summary)
            if self.message_log is not None and self.fates is not None:
                stack.callback(self.message_log.close)
                stack.callback(self.fates.all_held, self.hub.links.values())
            if self._ctx is not None:
                stack.callback(self._ctx.destroy, linger=0)
            for part in (self.zap, self.transports.server, self.transports.lanes, self.readers):
                if part is not None:
                    stack.callback(part.close)
            if self._http is not None:
                stack.push_async_callback(self._http.stop)
            if self.live is not None:
                stack.callback(self.live.close)
            stack.callback(self.events.close)
            stack.callback(self.codecs.close)
            if self.durable is not None:
                stack.callback(self.durable.close)
            if self.keyring is not None:
                stack.push_async_callback(self.keyring.close)
            stack.push_async_callback(self.revocations.close)
            if self.transports.fabric is not None:
                stack.push_async_callback(self.transports.fabric.close)
            stack.callback(self.transports.cancel)
            stack.push_async_callback(end_tasks, self.tasks)

    def _write_summary(self) -> None:
        name = self.loaded.model.summary
        if name is None:
            return
        path = self.loaded.resolve(name)
        try:
            path.write_text(json.dumps({"relay": self.loaded.model.name, **self.views.topics()}, indent=1) + "\n")
        except OSError as error:
            _log.error("%s: the summary could not be written: %s", path, error.strerror)
