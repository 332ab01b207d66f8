"""The relay daemon: composition root of hub, lane, access control, feed, HTTP and logs."""

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import zmq
from prometheus_client import CollectorRegistry

from sern_core.link.link import Link
from sern_core.objects.feed import PERIOD_S
from sern_core.relay.access import AccessTable
from sern_core.relay.hub import Hub, HubParams
from sern_core.relay.traces import Traces
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import ClientKeys, KeyRevocation
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.names import PEER_SIGN, is_peer
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import ZAP_DOMAIN, Admission, read_directory
from sern_relay.comings import Comings
from sern_relay.durable import DurableHolding
from sern_relay.feed import RelayFeed
from sern_relay.keyring import OwnKeys, RelayKeyring
from sern_relay.readers import Readers
from sern_relay.refusals import Refusals
from sern_relay.relay_metrics import register_relay
from sern_relay.revocations import FabricRevocations
from sern_relay.server import RelayServer
from sern_relay.transforms import TransformObjects
from sern_relay.udp import RelayLanes
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
from sern_runtime.draining import Progress
from sern_runtime.durable.disk import Disk
from sern_runtime.entry import blamed_on, end_tasks, log_warnings, serve
from sern_runtime.events import EventLog
from sern_runtime.fabric.port import FabricCounters
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

PATIENCE_S: Final = 5.0
"""How long a stopping relay waits for the next sign that what it holds for connected clients gets further."""
SWEEP_S: Final = 1.0
OTHER_FILES: Final = 128
"""What a relay has open beside the connections of clients."""
RULES: Final = "rules"
"""The kind of events of other relays' access rules."""
OTHER_CODE: Final = "other"
REFUSAL_CODES: Final = frozenset({
    "bad_announcement", "bad_id", "bad_name", "bad_object", "bad_pattern", "displaced", "forbidden",
    "bad_rules", "internal_error", "name_taken", "not_owner", "old_boot", "origin", "registry_full", "too_large",
    "too_many_objects", "too_many_patterns", "too_many_rules", "too_many_streams", "type_mismatch",
})  # fmt: skip
"""What a refusal is counted under; a code that a client made up is counted as `other`."""

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


def _unconfirmed(link: Link, channel: OutChannel, last: int) -> bool:
    """Whether a connected client has yet to confirm messages up to `last`."""
    return link.established and bool(channel.retained) and channel.retained[0].seq <= last


class RelayDaemon:
    """`start`, then any time, then `drain` and `stop`; `stop` alone is safe at any point. It is the hub's shell."""

    def __init__(self, loaded: Loaded[RelayFile]) -> None:
        self.loaded = loaded
        model = loaded.model
        self.notifier = Notifier.from_environment()
        self.admission = Admission(self._directory(loaded))
        self.errors = InternalErrors()
        self.collector = CollectorWatch()
        self.refusals = dict.fromkeys((*sorted(REFUSAL_CODES), OTHER_CODE), 0)
        self.reloads = ReloadState()
        self.events = EventLog()
        self.turned_away = Refusals(self.events)
        self.hub = Hub(
            name=model.name,
            boot=secrets.randbits(63),
            access=AccessTable(model.access_rules()),
            known=self.admission.known,
            events=self,
            link=model.link.params(),
            scheduler=model.scheduler.params(),
            params=HubParams(cache_bytes=model.replay.cache_bytes, resume_s=model.replay.resume_s),
            wall_ns=lambda _now: time.time_ns(),
            traces=Traces(),
            now=clock.now(),
        )
        self.hub.after = self._after
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
        self.message_log: MessageLog | None = None
        if model.message_log:
            self.message_log = MessageLog(loaded.resolve(model.message_log), partial(self.parts.ended, "message_log"))
        self.fates: LoggedFates | None = None
        if self.message_log is not None:
            self.fates = self.hub.forwarding.fates = LoggedFates(self.message_log, self.parts)
        self.codecs = CodecPool(after=self._after, parts=self.parts)
        self.coder = make_coder(model.link.params(), self.codecs)
        self.readers = Readers(self.coder, self.parts, self.errors)
        self._comings = Comings(self.events, relay=model.name, remembered=self.admission.named, address=self._address)
        self.revocations = FabricRevocations(self.hub, self.admission, self.events, enforce=self._enforce)
        self.views = RelayViews(
            model.name, self.hub, self._comings, self.turned_away, self.events, self.admission, self._address
        )
        self.adaptation: Adaptation | None = None
        if model.adaptation is not None:
            with blamed_on(loaded.path, "adaptation"):
                self.adaptation = Adaptation(
                    model.adaptation,
                    lambda: list(self.hub.links.values()),
                    coder=None,
                    kick=self._after,
                    parts=self.parts,
                )
        self.durable: DurableHolding | None = None
        if model.durable is not None:
            self.durable = self._make_durable(
                Disk.within(loaded.resolve(model.durable.directory), max_bytes=model.durable.max_bytes, shared=True)
            )
        self.zap: ZapHandler | None = None
        self.server: RelayServer | None = None
        self.keyring: RelayKeyring | None = None
        self.lanes: RelayLanes | None = None
        self.fabric: RelayFabric | None = None
        self.datagrams = DatagramWatch(
            self.hub.clients.of_clients,
            lambda link, within_s: self.lanes.problem(link, within_s) if self.lanes is not None else None,
            lambda link: link.peer,
        )
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None
        self._http: HttpServer | None = None
        self.live: Live | None = None
        self.tasks: list[asyncio.Task[None]] = []
        self._ready = False
        self._flush_due: asyncio.Handle | None = None

    @staticmethod
    def _directory(loaded: Loaded[RelayFile]) -> KeyDirectory | None:
        clients_dir = loaded.model.relay.clients_dir
        return read_directory(None if clients_dir is None else loaded.resolve(clients_dir))

    def _make_durable(self, disk: Disk) -> DurableHolding:
        known, after = self.admission.known, self._after
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
            self.keyring = RelayKeyring(
                self.hub,
                self.admission,
                own,
                overlap_s=relay.overlap_s,
                session_key=lambda client: self.server.session_key(client) if self.server is not None else None,
                after=self._after,
                relays=lambda: {} if self.fabric is None else self.fabric.reached(),
            )
        self.revocations.read()
        with blamed_on(self.loaded.path, "relay", "listen"):
            self.server = RelayServer(
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
                after=self._after,
                marks=model.link.dscp.marks(),
                turned_away=self.turned_away.note,
            )
        if keys is not None and relay.udp:
            with blamed_on(self.loaded.path, "relay", "listen"):
                self.lanes = RelayLanes(
                    self.hub,
                    relay.listen,
                    port_of=self.server.local_port,
                    after=self._after,
                    marks=model.link.dscp.marks(),
                )
        if model.fabric is not None:
            with blamed_on(self.loaded.path, "fabric"):
                self.fabric = self._make_fabric(model.fabric)
                await self.fabric.start()
        if keys is not None and self.zap is not None:
            await self_test(self._ctx, self.zap, relay.listen, keys.public_key)
            _log.info("self-test passed: a stranger's key is refused on %s", ", ".join(relay.listen))
        else:
            _log.warning("insecure: true: clients are not authenticated and nothing is encrypted")
        if model.feed.roles:
            with blamed_on(self.loaded.path, "feed", "roles"):
                self.readers.feed = self._make_feed(self._ctx, model.feed_roles())
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

    def _end_lapsed(self) -> None:
        """Cut the connections that were made with a key that was taken away or has expired. A session that another
        connection holds by now goes on. Whose those are that have not said anything yet is not known: they go, too."""
        lapsed = self.admission.take_lapsed()
        if not lapsed or self.server is None:
            return
        self.server.cut_unbound()
        for client, keys in lapsed.items():
            stays = self.server.session_key(client) in self.admission.valid().get(client, frozenset())
            cut = self.server.cut_keys(client, keys) if stays else self.server.cut_client(client)
            self.events.say(_log, logging.WARNING, "key_lost", client, "%s lost a key; %d connections cut", client, cut)
            if not stays:
                self.hub.clients.end_session(client, "the key no longer holds", now=clock.now())

    def _enforce(self) -> None:
        """End what was made with keys, or under names, that hold no more."""
        if self.server is not None:
            self.server.cut_unbound()  # admitted by the old keys, and silent so far
        self._end_lapsed()
        for client in [name for name in self.hub.links if not (is_peer(name) or self.admission.known(name))]:
            self.events.say(
                _log, logging.WARNING, "key_lost", client,
                "%s is in the directory no more; what was held for it is dropped", client,
            )  # fmt: skip
            self.hub.forget(client, "the name is revoked", now=clock.now())
        self._after()

    def _after(self) -> None:
        """Something came in: before the loop comes round again, whoever has something to send sends it."""
        if self._flush_due is None:
            self._flush_due = asyncio.get_running_loop().call_soon(self._flush)

    def _flush(self) -> None:
        self._flush_due = None
        # All are kicked before any sends: the lanes of a link share one sign that there is something to send.
        if self.lanes is not None:  # first: where there is one it has the messages
            self.lanes.flush()
        if self.server is not None:
            self.server.flush()
        if self.fabric is not None:
            self.fabric.flush()

    async def _tick(self) -> None:
        progress = {"socket": lambda: self.server.socket.drains if self.server else 0}
        if self.zap is not None:
            progress["zap"] = lambda: self.zap.counters.pings if self.zap else 0
            self.zap.ping()  # answered by the first sweep, which would else take it for stuck
        if self.durable is not None:
            disk = self.durable.disk
            progress["store"] = lambda: disk.progress(now=clock.now())
        watchdog = Watchdog(self.notifier, progress)
        while True:
            await asyncio.sleep(SWEEP_S)
            self._end_lapsed()
            now = clock.now()
            self.hub.sweep(now=now)
            more = True
            while more:  # the others have their turns in between
                await asyncio.sleep(0)
                more = self.hub.lapse(now=clock.now())
            if self.server is not None:
                self.server.look()
            self.datagrams.tick()
            if self.message_log is not None:
                with self.parts.survive("message_log"):
                    self.message_log.flush()
            if self.readers.feed is not None:
                with self.parts.survive("feed"):
                    self.readers.feed.sweep(now=now)
                    self._retry_feed(now)
                    if self.readers.feed.over:
                        feed, self.readers.feed = self.readers.feed, None
                        feed.close()
            self._flush()
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

    def _address(self, client: ClientName) -> str:
        """Where a client comes from now; empty: it has no connection."""
        by_tcp = self.server.address(client) if self.server is not None else ""
        return by_tcp or (self.lanes.address(client) if self.lanes is not None else "")

    def clients_up(self) -> int:
        """Clients with a session."""
        return sum(link.established for link in self.hub.clients.of_clients())

    @property
    def fabric_counters(self) -> FabricCounters | None:
        """The counters of the port to other relays; None: it is not there yet."""
        return None if self.fabric is None else self.fabric.port.counters

    @property
    def relays(self) -> "RelayFabric | None":
        """Other relays; None: there is no fabric, or not yet."""
        return self.fabric

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
            self._update_feed(loaded.model, now)
        if own is not None:
            self._use_keys(own, loaded.model)
        self._enforce()
        self.notifier.ready(self._status())
        self._in_force(now)
        words = "reloaded keys, access rules and feed roles; other changes need a restart"
        self.events.say(_log, logging.INFO, "reloaded", "", words)

    def _use_keys(self, own: OwnKeys, model: RelayFile) -> None:
        """What the relay proves itself with from now on, and what clients are told of it."""
        if self.keyring is None or self.server is None:
            return
        if own.now != self.keyring.own.now:
            self.server.rekey(own.now, ZAP_DOMAIN)
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

    def _make_feed(self, ctx: "zmq.Context[zmq.Socket[bytes]]", roles: tuple[FeedRole, ...]) -> RelayFeed:
        return RelayFeed(ctx, self.hub, roles, after=self._after, refused=self.refused)

    def _update_feed(self, model: RelayFile, now: float) -> None:
        """Make the feed's roles those of `model`. The first one brings the feed; it goes soon after the last one."""
        roles = model.feed_roles()
        if self.readers.feed is None:
            if not roles or self._ctx is None:
                return
            self.readers.feed = self._make_feed(self._ctx, ())  # then as any other: what can be had is in force
        try:
            self.readers.feed.update(roles, now=now)
        except ConfigError as error:
            self.reloads.failed_in_part("feed.roles", str(error), now=now)
            _log.error("%s: feed.roles: not all of them are in force: %s", self.loaded.path, error)

    def _retry_feed(self, now: float) -> None:
        """What was in use at a reload may be free by now; that it was not has been said and counted."""
        if self.readers.feed is not None and self.readers.feed.feed.missing and self.readers.feed.open_missing():
            self.reloads.part_in_force()
            self._in_force(now)

    async def drain(self) -> None:
        """Go on with what connected clients have not confirmed while that gets anywhere, then end their sessions."""
        now = clock.now()
        progress = Progress()
        give_up_s = now + self.loaded.model.link.drain_s
        # What comes in from now on its sources keep until the next relay confirms it.
        unconfirmed = [
            (link, channel, channel.next_seq - 1)
            for link in self.hub.links.values()
            for channel in link.sender.channels.values()
            if channel.retained
        ]
        while now < give_up_s:
            unconfirmed = [item for item in unconfirmed if _unconfirmed(*item)]
            if not unconfirmed:
                break
            left = (
                sum(len(channel.retained) for _link, channel, _last in unconfirmed),
                sum(nbytes for link in self.hub.links.values() for _messages, nbytes in link.sender.queued().values()),
            )
            if progress.still_s(left, now=now) > PATIENCE_S:
                break
            await asyncio.sleep(0.02)
            now = clock.now()
        for link in self.hub.links.values():
            link.close("relay stops", now=clock.now())
        if self.server is not None:
            self.server.run_all()
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
            for part in (self.zap, self.server, self.lanes, self.readers):
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
            if self.fabric is not None:
                stack.push_async_callback(self.fabric.close)
            stack.callback(self._cancel_flush)
            stack.push_async_callback(end_tasks, self.tasks)

    def _cancel_flush(self) -> None:
        if self._flush_due is not None:
            self._flush_due.cancel()

    def _write_summary(self) -> None:
        name = self.loaded.model.summary
        if name is None:
            return
        path = self.loaded.resolve(name)
        try:
            path.write_text(json.dumps({"relay": self.loaded.model.name, **self.views.topics()}, indent=1) + "\n")
        except OSError as error:
            _log.error("%s: the summary could not be written: %s", path, error.strerror)

    # --- HubEvents ----------------------------------------------------------------------------------------------------

    def client_up(self, client: ClientName, *, resumed: bool) -> None:
        self._comings.up(client, resumed=resumed)

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None:
        if self.lanes is not None:
            self.lanes.asked(client, ciphers)

    def lane_closed(self, client: ClientName) -> None:
        if self.lanes is not None:
            self.lanes.closed(client)

    def keys_asked(self, client: ClientName) -> None:
        if self.keyring is not None:
            self.keyring.asked(client)

    def keys_told(self, client: ClientName, keys: ClientKeys) -> None:
        if self.keyring is not None:
            self.keyring.told(client, keys)

    def fault(self, client: ClientName | None, error: Exception) -> None:
        self.errors.core(error, client or "")

    def peer_up(self, peer: ClientName) -> None:
        _log.info("connected to the relay %s", peer.removeprefix(PEER_SIGN))

    def peer_down(self, peer: ClientName, reason: str) -> None:
        _log.warning("not connected to the relay %s: %s", peer.removeprefix(PEER_SIGN), reason)

    def went_over(self, client: ClientName, peer: ClientName, *, came: bool) -> None:
        self._comings.went_over(client, peer.removeprefix(PEER_SIGN), came=came)

    def revoked(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        self.revocations.told(peer, revocations)

    def rules_compared(self, peer: ClientName, *, same: bool) -> None:
        relay = peer.removeprefix(PEER_SIGN)
        if same:
            self.events.say(_log, logging.INFO, RULES, relay, "the relay %s has the access rules of this one", relay)
        else:
            words = "the relay %s has other access rules than this one: what goes between them both must grant"
            self.events.say(_log, logging.WARNING, RULES, relay, words, relay)

    def client_down(self, client: ClientName, reason: str) -> None:
        self._comings.down(client, reason)
        if self.keyring is not None:
            self.keyring.left(client)

    def stream_added(self, stream: StreamInfo) -> None:
        _log.info("%s announces %s (%s)", stream.id.origin, stream.id.topic, stream.info.type_name)
        self.readers.owners_changed()

    def stream_removed(self, stream: StreamInfo) -> None:
        _log.info("%s of %s has ended", stream.id.topic, stream.id.origin)
        self.readers.stream_removed(stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self.readers.message(stream, message, now=now)

    def refused(self, client: ClientName, code: str, text: str) -> None:
        self.refusals[code if code in REFUSAL_CODES else OTHER_CODE] += 1
        self._comings.refused(client, code, text)
