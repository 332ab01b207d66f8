"""The client daemon: composition root of endpoint, bridge, connection, HTTP and logs."""

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

from sern_client.actions import GoalWatch
from sern_client.bridge import Bridge
from sern_client.checks import TableCheck
from sern_client.client_metrics import Counting, register_client
from sern_client.endpoints.base import (
    BothTold,
    Endpoint,
    ObjectEndpoint,
    ServedEndpoint,
    ShowingEndpoint,
    viewers_of,
)
from sern_client.factory import local_encoding, make_endpoint, make_link_topics
from sern_client.guard import Guard
from sern_client.link_news import SILENT
from sern_client.link_state import LinkState
from sern_client.making import durable_maker, keep_holders, make_e_stops, rule_of, services_maker, spool_maker
from sern_client.on_demand import OnDemand
from sern_client.operating import Operating
from sern_client.relays import Relays
from sern_client.scene.making import make_scene
from sern_client.site import Site
from sern_client.site_objects import CoreObjects
from sern_client.tables import Tables
from sern_client.told import ClientTold
from sern_client.views import ClientViews
from sern_core.bodies.lossy import missing
from sern_core.objects.feed import PERIOD_S
from sern_core.site.client import ClientCore
from sern_core.site.client_events import ClientEvents
from sern_core.topics.patterns import PatternSet, compile_pattern
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, ObjectKind
from sern_core.wire import framing
from sern_runtime import clock, ros_types
from sern_runtime.adaptation import Adaptation
from sern_runtime.codec_pool import CodecPool, make_coder
from sern_runtime.collector import CollectorWatch
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.load import Loaded
from sern_runtime.entry import blamed_on, end_tasks, log_warnings, serve
from sern_runtime.events import EventLog
from sern_runtime.http_routes import Health
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.loop import Shutdown
from sern_runtime.message_log import LoggedFates, MessageLog
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from sern_runtime.sdnotify import Notifier, Watchdog
from sern_runtime.topics_view import TopicView, both_ways
from sern_runtime.transport_watch import NOT_YET, WAITING
from sern_runtime.watching.live import Live

if TYPE_CHECKING:
    from sern_runtime.http import HttpServer

KEEP_PATIENCE_S: Final = 2.0
"""How long a stopping client waits for what it recorded to be flushed."""
TICK_S: Final = 0.5

_log = logging.getLogger(__name__)


async def run_client(path: Path, shutdown: Shutdown) -> int:
    """Run until asked to stop. Raises ConfigError for what is wrong with the file or the machine."""
    loaded = load_client(path)
    log_warnings(_log, loaded.warnings)
    daemon = ClientDaemon(loaded)
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


class ClientDaemon:
    """`start`, then any time, then `drain` and `stop`; `stop` alone is safe at any point."""

    def __init__(self, loaded: Loaded[ClientFile]) -> None:
        self.loaded = loaded
        model = loaded.model
        self.notifier = Notifier.from_environment()
        endpoint = make_endpoint(loaded)
        self.errors = InternalErrors()
        self.collector = CollectorWatch()
        self.parts = OptionalParts(
            "adaptation",
            "codecs",
            "frames",
            "http",
            "link_state",
            "message_log",
            "metrics",
            "scene",
            "spool",
            "summaries",
            "watching",
        )
        self.message_log: MessageLog | None = None
        if model.message_log:
            self.message_log = MessageLog(loaded.resolve(model.message_log), partial(self.parts.ended, "message_log"))
        self.events = EventLog()
        self.site = Site(
            endpoint,
            model.rules(),
            model.namespace,
            kick=self._kick,
            frame_prefix=model.client.frame_prefix,
            log=self.message_log,
            parts=self.parts,
            events=self.events,
        )
        discovery = model.discovery.filter()
        now = clock.now()
        for index, section in enumerate(model.topics):
            for problem in filter(None, map(missing, section.lossy)):
                raise ConfigError(problem, file=str(loaded.path), key=f"topics.{index}.lossy")
        self.codecs = CodecPool(after=self._kick, parts=self.parts)
        self.guard = Guard.of(loaded)
        state = model.link_state
        self.bridge = Bridge(
            self.site,
            self._make_core,
            discovery,
            self,
            make_services=services_maker(loaded, endpoint, self._kick),
            guard=self.guard,
            goals=self._make_goals(),
            make_durable=durable_maker(loaded),
            make_spool=spool_maker(loaded, self.site),
            withdraws=state.withdraw_after_s is not None,
        )
        self.core = self.bridge.core
        objects = CoreObjects(self.core, self._kick)
        if isinstance(endpoint, ObjectEndpoint):
            endpoint.use_objects(objects)
        self.scene = make_scene(loaded, endpoint, self.site, objects, local_encoding(model))
        self.on_demand = self._make_on_demand(endpoint, objects)
        self.adaptation = self._make_adaptation()
        self.e_stops = make_e_stops(loaded, self.bridge, self.events)
        keep_holders(loaded, self.bridge)
        self.relays = Relays(loaded, self.core, self.events, on_down=self.link_down, kick=self._kick)
        self.news = self.relays.news
        self.operating = Operating(
            loaded,
            self.bridge,
            self.adaptation,
            self.events,
            self.notifier,
            e_stops=self.e_stops,
            status=self._status,
            reload_keys=self.relays.reload_keys,
        )
        self.link_state = LinkState(
            self.core,
            make_link_topics(model, self.site.advertise),
            self.bridge.inbound.withdrawal,
            period_s=state.period_s,
            withdraw_after_s=state.withdraw_after_s,
            reason=self.why,
            parts=self.parts,
            events=self.events,
        )
        self.views = ClientViews(
            model.name,
            self.bridge,
            self.news,
            self.link_state,
            self.events,
            reason=self.why,
            address=self._address,
            relay=self.relays.to_json,
            by_hand=self.operating.to_json,
        )
        if isinstance(endpoint, ShowingEndpoint):
            endpoint.show_link(self.link_words)
            if self.scene is not None:
                endpoint.show_scene(self.scene)
        self.check = TableCheck(Tables(self.bridge, self.link_state, self.scene), now=now)
        self.connection = self.relays.connection
        self.bridge.inbound.subscribed.add("asking", self.bridge.asking.topics)
        self.bridge.inbound.subscribed.begin(model.subscribe_patterns())
        self.core.subscribe_objects(model.object_selections(), now=now)
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None
        self._http: HttpServer | None = None
        self.live: Live | None = None
        self.tasks: list[asyncio.Task[None]] = []
        self._endpoint_started = False

    def _make_core(self, events: ClientEvents) -> ClientCore:
        model = self.loaded.model
        core = ClientCore(
            name=model.name,
            boot=secrets.randbits(63),
            events=events,
            link=model.link.params(),
            scheduler=model.scheduler.params(),
            trace=DecisionTrace(),
            now=clock.now(),
            coder=make_coder(model.link.params(), self.codecs),
        )
        if self.message_log is not None:
            core.link.end.fates = LoggedFates(self.message_log, self.parts)
        return core

    def reload(self) -> None:
        """SIGHUP: read the file and the keys anew."""
        self.operating.reload()

    def _make_goals(self) -> GoalWatch | None:
        sections = self.loaded.model.actions.use
        if not sections:
            return None
        rules = tuple((compile_pattern(section.match), section.timeout_s) for section in sections)
        return GoalWatch(rules, self.site.advertise)

    def _make_on_demand(self, endpoint: Endpoint, objects: CoreObjects) -> OnDemand | None:
        """What offers topics to an endpoint at which people look; None: this client has none such."""
        patterns, viewers = self.loaded.model.on_demand, viewers_of(endpoint)
        if not viewers:
            return None
        add = partial(self.bridge.inbound.subscribed.add, "on_demand")
        made = OnDemand(PatternSet(patterns), self.site, viewers, add=add, ledger=self.core.received)
        if patterns:
            objects.listen(made)
        return made

    def _make_adaptation(self) -> Adaptation | None:
        section = self.loaded.model.adaptation
        if section is None:
            return None
        coder = self.core.coder if self.core.link.sender.encoder is not None else None
        with blamed_on(self.loaded.path, "adaptation"):
            return Adaptation(
                section,
                lambda: [self.core.link],
                coder=coder,
                kick=self._kick,
                rules=self.site.rules.rules,
                summaries=lambda: self.bridge.outbound.summaries.topics,
                parts=self.parts,
            )

    async def start(self) -> None:
        self.errors.watch(asyncio.get_running_loop())
        self.collector.watch()
        ros_types.load()
        model = self.loaded.model
        self.relays.read()
        if model.http.listen is not None:
            with blamed_on(self.loaded.path, "http", "listen"):
                self._http = self._make_http(model.http.listen)
                await self._http.start()
        if self.bridge.durable is not None:  # before the endpoint, whose topics go on where they were
            with blamed_on(self.loaded.path, "durable", "directory"):
                self.bridge.durable.start(partial(rule_of, self.site))
        if self.bridge.spool is not None:  # before the endpoint, whose topics it keeps
            with blamed_on(self.loaded.path, "spool", "directory"):
                self.bridge.spool.start()
        # Before the transport: streams from the relay are advertised at the endpoint as soon as there is a session.
        events = self.bridge.outbound if self.scene is None else BothTold(self.bridge.outbound, self.scene)
        await self.site.endpoint.start(events)
        self._endpoint_started = True
        self.link_state.start()
        if self.guard is not None:
            self.guard.start()
        self._ctx = zmq.Context()
        relay = self.relays.current
        with blamed_on(self.loaded.path, *(("relays", 0) if model.relays else ("relay",)), "endpoint"):
            self.relays.open(self._ctx)
        self.tasks.append(asyncio.create_task(self.relays.run(), name="client-relays"))
        self.tasks.append(asyncio.create_task(self._tick(), name="client-tick"))
        self.tasks.append(asyncio.create_task(self._tell_objects(), name="client-objects"))
        if self.scene is not None:
            kept = self.parts.keep("scene", self.scene.run, reset=lambda: None)
            self.tasks.append(asyncio.create_task(kept, name="scene"))
        if self.adaptation is not None:
            kept = self.parts.keep("adaptation", self.adaptation.run, reset=self.adaptation.reset)
            self.tasks.append(asyncio.create_task(kept, name="adaptation"))
        if self.live is not None:
            kept = self.parts.keep("watching", self.live.run, reset=self.live.reset)
            self.tasks.append(asyncio.create_task(kept, name="watching"))
        await self.operating.start()
        self.notifier.ready(f"{model.name} -> {relay.address}")
        words = "client %s started, relay %s"
        self.events.say(_log, logging.INFO, "started", "", words, model.name, relay.address)

    def _kick(self) -> None:
        self.connection.wake()

    # --- Shell: what becomes of the link ------------------------------------------------------------------------------

    def keys_told(self, keys: RelayKeys) -> None:
        self.relays.keys_told(keys)

    def link_down(self, reason: str) -> None:
        if not self.core.link.established:
            self.relays.session_ended()
        self.link_state.soon()
        self.news.down(reason)

    def link_up(self) -> None:
        self.news.up()
        self.relays.arrived()
        self.link_state.soon()
        self._put_node()
        self.connection.session_began()

    def lane_offered(self, parameters: framing.Envelope) -> None:
        self.connection.lane_offered(parameters)

    def lane_closed(self) -> None:
        self.connection.lane_closed()

    def fault(self, error: Exception) -> None:
        self.errors.core(error)

    # ------------------------------------------------------------------------------------------------------------------

    async def _tick(self) -> None:
        progress = {"loop": lambda: int(clock.now() * 1e3)}
        if self.bridge.durable is not None:
            disk = self.bridge.durable.disk
            progress["store"] = lambda: disk.progress(now=clock.now())
        watchdog = Watchdog(self.notifier, progress)
        while True:
            await asyncio.sleep(TICK_S)
            if self.message_log is not None:
                with self.parts.survive("message_log"):
                    self.message_log.flush()
            self.connection.tick()
            self.relays.look_at_keys()
            self.check.tick(now=clock.now())
            self.link_state.look()
            self.bridge.outbound.leaving.look(now=clock.now())
            self.bridge.holding.look()
            if self.bridge.durable is not None:
                self.bridge.durable.look()
            if self.bridge.spool is not None:
                with self.parts.survive("spool"):
                    self.bridge.spool.look()
            if watchdog.interval_s is not None:
                watchdog.check()
            self.news.look()
            self.events.tick()
            self.notifier.status(self._status())

    def _status(self) -> str:
        """One line for systemd."""
        link = self.core.link
        state = "up" if link.established and not link.lane.stalled else f"down: {self.why()}"
        where = f" at relay {self.relays.current.words}" if self.relays.several and link.established else ""
        return self.operating.reloads.beside(f"link {state}{where}")

    async def _tell_objects(self) -> None:
        while True:
            await asyncio.sleep(PERIOD_S)
            if not self.core.objects.settled:
                self.core.objects.pump(now=clock.now())
                self._kick()

    def why(self) -> str:
        """Why there is no link, as far as it is known."""
        if self.core.link.established:
            return SILENT
        return f"{self._why_not()}; tried {self.relays.tried}" if self.relays.several else self._why_not()

    def _why_not(self) -> str:
        name = self.connection.name
        unresolved, at = (None, "") if name is None else (name.problem, name.at)
        where = f" ({at})" if at else ""
        if self.news.reason == NOT_YET and self.connection.waiting:
            return f"{WAITING}{where}"
        return unresolved or self.bridge.rejected_reason or f"{self.news.reason}{where}"

    def _address(self) -> str:
        """Where the relay is: its address in the file, and what that stands for, where it is a name."""
        name = self.connection.name
        return self.relays.current.address + (f" ({name.at})" if name is not None and name.at else "")

    def _put_node(self) -> None:
        """Tell the relay's registry who we are."""
        model = self.loaded.model
        self.core.objects.put(
            f"node:{model.name}",
            ObjectKind.NODE,
            "sern/client",
            attributes={
                "namespace": model.namespace,
                "endpoints": ",".join(section.kind for section in model.endpoints),
                "topics": str(len(self.core.link.sender.channels)),
            },
            wall_ns=time.time_ns(),
            now=clock.now(),
        )

    def _make_http(self, listen: str) -> "HttpServer":
        from sern_runtime.http import HttpServer
        from sern_runtime.watching.page import add_page

        registry = CollectorRegistry()
        metrics = Metrics(registry)
        adaptation = self.adaptation
        counting = Counting(
            bridge=self.bridge,
            relays=self.relays,
            link_state=self.link_state,
            check=self.check,
            guard=self.guard,
            adaptation=adaptation,
            errors=self.errors,
            collector=self.collector,
            scene=self.scene,
            operating=self.operating,
        )
        register_client(metrics, counting)
        server = HttpServer(
            listen,
            registry,
            health=lambda: Health(ok=True, reason="running"),
            ready=self.readiness,
            json_routes={
                **self.views.routes(),
                "/api/keys": self.relays.keys_json,
                **({} if self.bridge.spool is None else {"/api/spool": self.bridge.spool.to_json}),
                **({} if self.scene is None else {"/api/scene": self.scene.to_json}),
                **({} if adaptation is None else {"/api/mmcf": adaptation.view()}),
                **(self.site.endpoint.json_routes if isinstance(self.site.endpoint, ServedEndpoint) else {}),
            },
            access=self.loaded.model.http.access(self.loaded.path.parent),
            parts=self.parts,
        )
        server.register(metrics)
        self.live = Live(ClientTold(self.bridge, self.views, adaptation), self.events)
        add_page(server, self.live, metrics)
        return server

    def link_words(self) -> str:
        """How the link is, for people: /readyz with the time there and back."""
        flight = self.core.link.lane.flight
        rtt = f"; {flight.rtt.srtt_s * 1e3:.0f} ms there and back" if flight.rtt.samples else ""
        health = self.readiness()
        return f"{health.reason}{rtt if health.ok else ''}"

    def readiness(self) -> Health:
        """What `/readyz` says."""
        if self.core.link.established:
            if self.core.link.lane.stalled:
                return Health(ok=False, reason=SILENT)
            if self.check.found:
                return Health(ok=False, reason=f"what is here is not what should be: {self.check.found[0]}")
            # A site with one robot of three gone does its job for the other two.
            said = (f"connected to {self.core.link.peer}", self.link_state.detail())
            return Health(ok=True, reason="; ".join(filter(None, said)))
        return Health(ok=False, reason=self.why())

    def topics(self) -> dict[str, TopicView]:
        """Counters of every topic by global name, sent and received."""
        return both_ways(self.core.link, self.core.received, now=clock.now())

    async def drain(self) -> None:
        """Stop the sources, send what is owed while that gets anywhere, and say goodbye."""
        self.news.stopping()
        self.relays.stay()
        self.bridge.outbound.stop_sources()
        await self.connection.drain(lambda: self.bridge.outbound.pending, limit_s=self.loaded.model.link.drain_s)
        if self.bridge.inbound.keeping:
            await self._keep()
        await self.connection.leave()

    async def _keep(self) -> None:
        """Have what was recorded flushed, so that all of it is confirmed before we say goodbye, and read nothing more:
        what comes now the next process gets."""
        keeping = self.bridge.inbound.keeping
        self.core.link.handshake.reads = False
        keeping.flush()
        give_up_s = clock.now() + KEEP_PATIENCE_S
        while keeping.pending and clock.now() < give_up_s:  # noqa: ASYNC110  (its thread tells the loop)
            await asyncio.sleep(0.005)

    def _give_up(self) -> None:
        """Count what is left, so that every message has a fate."""
        link = self.core.link
        for channel in list(link.sender.channels.values()):
            link.outgoing.close(channel, DropReason.SHUTDOWN, now=clock.now())

    async def stop(self) -> None:
        """Ends whatever was started, the last first, also when a part of it fails."""
        async with AsyncExitStack() as stack:
            stack.callback(self.errors.unwatch, asyncio.get_running_loop())
            stack.callback(self.collector.close)
            stack.callback(self.notifier.close)
            stack.callback(self._write_summary)
            if self.message_log is not None:
                stack.callback(self.message_log.close)
            stack.callback(self._give_up)
            if self._ctx is not None:
                stack.callback(self._ctx.destroy, linger=0)
            if self._http is not None:
                stack.push_async_callback(self._http.stop)
            if self.live is not None:
                stack.callback(self.live.close)
            stack.callback(self.events.close)
            if self._endpoint_started:
                stack.push_async_callback(self.site.endpoint.stop)
            if self.guard is not None:
                stack.push_async_callback(self.guard.stop)
            if self.scene is not None:
                stack.callback(self.scene.close)
            if self.bridge.spool is not None:
                stack.push_async_callback(self.bridge.spool.close)
            stack.callback(self.bridge.close)
            if self.on_demand is not None:
                stack.callback(self.on_demand.close)
            stack.callback(self.link_state.close)
            if self.bridge.services is not None:
                stack.push_async_callback(self.bridge.services.stop)
            stack.callback(self.connection.close)
            stack.push_async_callback(self.relays.close)
            stack.callback(self.codecs.close)
            stack.push_async_callback(end_tasks, self.tasks)
            stack.push_async_callback(self.operating.stop)

    def _write_summary(self) -> None:
        name = self.loaded.model.summary
        if name is None:
            return
        content = {"client": self.loaded.model.name, "classes": list(CLASS_LABELS), "topics": self.topics()}
        path = self.loaded.resolve(name)
        try:
            path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            _log.error("%s: the summary could not be written: %s", path, error.strerror)
