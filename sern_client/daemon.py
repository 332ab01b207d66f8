"""The client daemon: composition root of endpoint, core, transport, HTTP and logs."""

import asyncio
import json
import logging
import secrets
import time
from contextlib import AsyncExitStack
from pathlib import Path
from random import Random
from typing import Final

import zmq
from prometheus_client import CollectorRegistry

from sern_client.actions import GoalWatch
from sern_client.bridge import Bridge
from sern_client.checks import TableCheck
from sern_client.endpoints.base import CountingEndpoint, Endpoint
from sern_client.endpoints.composite import with_services
from sern_client.express import ClientExpress
from sern_client.factory import make_endpoint, make_link_topics
from sern_client.guard import Guard
from sern_client.link_state import LinkState
from sern_client.relay_name import RelayName, name_in
from sern_client.services import ServiceBridge
from sern_client.summarise import register_summaries
from sern_client.transport import RelayTransport
from sern_client.udp import ClientLane
from sern_core.bodies.lossy import missing
from sern_core.link.handshake import NEW_SESSION
from sern_core.site.client import ClientCore
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, ObjectKind
from sern_runtime import clock, ros_types
from sern_runtime.adaptation import Adaptation
from sern_runtime.codec_pool import CodecPool, make_coder
from sern_runtime.collector import CollectorWatch
from sern_runtime.config.base import split_tcp
from sern_runtime.config.client import ClientFile, ServicesSection, load_client
from sern_runtime.config.keys import load_secret, load_server_keys
from sern_runtime.config.load import Loaded
from sern_runtime.datagram_watch import DatagramWatch
from sern_runtime.draining import Progress
from sern_runtime.entry import blamed_on, end_tasks, log_warnings, serve
from sern_runtime.http import Health, HttpServer
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.link_metrics import register_codecs, register_links, register_received
from sern_runtime.loop import Shutdown
from sern_runtime.message_log import LoggedFates, MessageLog
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from sern_runtime.outages import Outages
from sern_runtime.sdnotify import Notifier, Watchdog
from sern_runtime.topics_view import TopicView, both_ways
from sern_runtime.trace_view import of_client, trace_view
from sern_runtime.transport_watch import NOT_YET, WAITING

PATIENCE_S: Final = 2.0
"""How long a stopping client waits, beside some round trips, for the next sign that what it still owes gets further."""
STALL_PATIENCE_S: Final = 5.0
"""The same while it has more to send and a session: a path that has stalled often comes back."""
PATIENCE_RTTS: Final = 4.0
TICK_S: Final = 0.5
SILENT: Final = "the relay does not answer now; the session waits for it"

_log = logging.getLogger(__name__)


async def run_client(path: Path, shutdown: Shutdown) -> int:
    """Run until asked to stop. Raises ConfigError for what is wrong with the file or the machine."""
    loaded = load_client(path)
    log_warnings(_log, loaded.warnings)
    daemon = ClientDaemon(loaded)
    try:
        await daemon.start()
        daemon.collector.settle()
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
            "adaptation", "codecs", "frames", "http", "link_state", "message_log", "metrics", "summaries"
        )
        self.message_log = MessageLog(loaded.resolve(model.message_log)) if model.message_log else None
        self.bridge = Bridge(
            endpoint,
            model.rules(),
            model.discovery.filter(),
            model.namespace,
            frame_prefix=model.client.frame_prefix,
            log=self.message_log,
            kick=self._kick,
            on_up=self._link_up,
            on_down=self._link_down,
            on_fault=self.errors.core,
            parts=self.parts,
        )
        now = clock.now()
        for index, section in enumerate(model.topics):
            for problem in filter(None, map(missing, section.lossy)):
                raise ConfigError(problem, file=str(loaded.path), key=f"topics.{index}.lossy")
        self.codecs = CodecPool(after=self._kick, parts=self.parts)
        self.core = ClientCore(
            name=model.name,
            boot=secrets.randbits(63),
            events=self.bridge,
            link=model.link.params(),
            scheduler=model.scheduler.params(),
            trace=DecisionTrace(),
            now=now,
            coder=make_coder(model.link.params(), self.codecs),
        )
        if self.message_log is not None:
            self.core.link.end.fates = LoggedFates(self.message_log, self.parts)
        self.bridge.attach(self.core)
        self.bridge.guard = self.guard = Guard.of(loaded)
        self.check = TableCheck(self.bridge, now=now)
        self.core.subscribe(model.subscribe_patterns(), now=now)
        self._serve_services(endpoint)
        if model.actions.use:
            rules = tuple((compile_pattern(section.match), section.timeout_s) for section in model.actions.use)
            self.bridge.goals = GoalWatch(rules, lambda info: self.bridge.converter.advertise(endpoint, info))
        self.adaptation = self._make_adaptation()
        self.reason = NOT_YET
        state = model.link_state
        self.bridge.withdrawal.used = state.withdraw_after_s is not None
        self.bridge.link_state = self.link_state = LinkState(
            self.core,
            make_link_topics(model, lambda info: self.bridge.converter.advertise(endpoint, info)),
            self.bridge.withdrawal,
            period_s=state.period_s,
            withdraw_after_s=state.withdraw_after_s,
            reason=self._why,
            parts=self.parts,
        )
        self._said: set[str] = set()  # since the last session: an attempt that fails as before is no news
        self._down_since_s = now
        self._outages = Outages(_log, logging.WARNING)
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None
        self._transport: RelayTransport | None = None
        self._name: RelayName | None = None
        self._lane: ClientLane | None = None
        self.datagrams = DatagramWatch(
            lambda: [self.core.link],
            lambda link, within_s: self._lane.problem(link, within_s) if self._lane is not None else None,
            lambda link: link.end.name,
        )
        self._express: ClientExpress | None = None
        self._http: HttpServer | None = None
        self.tasks: list[asyncio.Task[None]] = []
        self._endpoint_started = False
        self._stopping = False

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
                rules=self.bridge.rules.rules,
                summaries=lambda: self.bridge.summaries.topics,
                parts=self.parts,
            )

    def _serve_services(self, endpoint: Endpoint) -> None:
        """Where the file has service rules, an endpoint must know services."""
        model = self.loaded.model
        offer, use = model.offered_services(), model.used_services()
        if not offer and not use:
            return
        known = with_services(endpoint)
        if known is None and model.services == ServicesSection():
            return  # actions of ROS 1 are topics
        with blamed_on(self.loaded.path, "services"):
            if known is None:
                kinds = " and ".join(dict.fromkeys(section.kind for section in model.endpoints))
                raise ConfigError(f"an endpoint of kind {kinds} has no services; leave the section out")
            self.bridge.services = ServiceBridge(
                self.core, known, offer=offer, use=use, namespace=model.namespace, kick=self._kick
            )

    async def start(self) -> None:
        self.errors.watch(asyncio.get_running_loop())
        self.collector.watch()
        ros_types.load()
        model = self.loaded.model
        relay = model.relay
        keys = load_secret(self.loaded.resolve(relay.secret_key_file)) if relay.secret_key_file else None
        server_keys: tuple[str, ...] = ()
        if relay.server_key_file:
            server_keys = load_server_keys(self.loaded.resolve(relay.server_key_file), at_s=time.time())
        if model.http.listen is not None:
            with blamed_on(self.loaded.path, "http", "listen"):
                self._http = self._make_http(model.http.listen)
                await self._http.start()
        # Before the transport: streams from the relay are advertised at the endpoint as soon as there is a session.
        await self.bridge.endpoint.start(self.bridge)
        self._endpoint_started = True
        self.link_state.start()
        if self.guard is not None:
            self.guard.start()
        self._ctx = zmq.Context()
        with blamed_on(self.loaded.path, "relay", "endpoint"):
            self._transport = RelayTransport(
                self._ctx,
                self.core.link,
                relay.endpoint,
                keys,
                server_keys,
                heartbeat_timeout_s=model.link.heartbeat_timeout_s,
                handshake_interval_s=relay.handshake_interval_s,
                random=Random(secrets.randbits(64)),
                on_reason=self._link_down,
                after=self._kick,
                marks=model.link.dscp.marks(),
            )
        named = name_in(relay.endpoint)
        if named is not None:
            self._name = RelayName(relay.endpoint, *named)
            self._name.tick(connected=False)
        address = split_tcp(relay.endpoint)
        if relay.udp and keys is not None and address is not None:
            self._lane = ClientLane(self.core, address[0], kick=self._kick, marks=model.link.dscp.marks())
            self.bridge.lane = self._lane
        if relay.express and address is not None:
            self._express = ClientExpress(
                self.core,
                self._transport,
                model.link.redundancy,
                datagrams=self._lane is not None,
                kick=self._kick,
            )
        self.tasks.append(asyncio.create_task(self._tick(), name="client-tick"))
        if self.adaptation is not None:
            kept = self.parts.keep("adaptation", self.adaptation.run, reset=self.adaptation.reset)
            self.tasks.append(asyncio.create_task(kept, name="adaptation"))
        self.notifier.ready(f"{model.name} -> {relay.endpoint}")
        _log.info("client %s started, relay %s", model.name, relay.endpoint)

    def _kick(self) -> None:
        if self._transport is not None:
            self._transport.pump.kick()
        if self._lane is not None:
            self._lane.kick()
        if self._express is not None:
            self._express.kick()

    def _link_down(self, reason: str) -> None:
        """Told by the transport and by the session on it, usually of the same thing."""
        self.reason = reason
        self.link_state.soon()
        silent_since_s = None
        if not self.core.link.established:  # else the session goes on over the other lane
            silent_since_s = self._outages.since_s(self.core.link.peer)
            self._outages.forget(self.core.link.peer)
        if self._stopping:
            return
        if not self._said:
            self._down_since_s = clock.now()
        if silent_since_s is not None:  # it began before anybody gave it up
            self._down_since_s = min(self._down_since_s, silent_since_s)
        if reason not in self._said:
            self._said.add(reason)
            then = "" if reason == NEW_SESSION else "; trying again until it works"
            _log.warning("%s: %s%s", self.loaded.model.relay.endpoint, reason, then)

    def _link_up(self) -> None:
        if self._said:  # in the words and at the level of the loss
            down_s = clock.now() - self._down_since_s
            _log.warning("%s: the link is there again, after %.0f s", self.loaded.model.relay.endpoint, down_s)
        self._said.clear()
        self.link_state.soon()
        self._put_node()
        if self._lane is not None:
            self._lane.ask()
        if self._express is not None:
            self._express.begin()

    async def _tick(self) -> None:
        watchdog = Watchdog(self.notifier, {"loop": lambda: int(clock.now() * 1e3)})
        while True:
            await asyncio.sleep(TICK_S)
            if self.message_log is not None:
                with self.parts.survive("message_log"):
                    self.message_log.flush()
            link = self.core.link
            if self._lane is not None:
                self._lane.tick()
            self.datagrams.tick()
            if self._express is not None:
                self._express.tick()
            self.check.tick(now=clock.now())
            self.link_state.look()
            self.bridge.leaving.look(now=clock.now())
            if watchdog.interval_s is not None:
                watchdog.check()
            if self._name is not None:
                self._name.tick(connected=link.established)
            self._look_at_link()
            state = "up" if link.established and not link.lane.stalled else f"down: {self._why()}"
            self.notifier.status(f"link {state}")

    def _look_at_link(self) -> None:
        """Say that the relay has been silent for a while in a session that goes on, and when it is not any more."""
        link = self.core.link
        if not link.established:
            return
        relay, now = self.loaded.model.relay.endpoint, clock.now()
        if self._said and link.handshake.transport_up:  # a session that outlived its connection has another now
            self._said.clear()
            _log.warning("%s: the connection is there again, after %.0f s", relay, now - self._down_since_s)
        self._outages.look(
            link.peer, lost=link.lane.stalled, now=now,
            gone=f"{relay}: {SILENT}", back=f"{relay}: the relay answers again",
        )  # fmt: skip

    def _why(self) -> str:
        """Why there is no link, as far as it is known."""
        if self.core.link.established:
            return SILENT
        unresolved, at = (None, "") if self._name is None else (self._name.problem, self._name.at)
        where = f" ({at})" if at else ""
        if self.reason == NOT_YET and self._transport is not None and self._transport.waiting:
            return f"{WAITING}{where}"
        return unresolved or self.bridge.rejected_reason or f"{self.reason}{where}"

    def _put_node(self) -> None:
        """Tell the relay's registry who we are."""
        model = self.loaded.model
        self.core.put_object(
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

    def _make_http(self, listen: str) -> HttpServer:
        registry = CollectorRegistry()
        metrics = Metrics(registry)
        link = self.core.link
        register_links(metrics, lambda: [link])
        self.datagrams.register(metrics)
        register_received(metrics, self.core.received, self.bridge.ages)
        register_codecs(metrics, self.core.coder)
        self.link_state.register(metrics)
        self.errors.register(metrics)
        self.collector.register(metrics)
        register_summaries(metrics, self.bridge.summaries)
        metrics.counter(
            "sern_patch_gaps_total",
            "Times a grid of patches could not go on, and waited for the next whole one.",
            read=lambda: [((), float(self.bridge.rebuilds.gaps))],
        )
        endpoint = self.bridge.endpoint

        def endpoint_drops() -> list[tuple[tuple[str], float]]:
            drops = endpoint.drops if isinstance(endpoint, CountingEndpoint) else {}
            return [((str(reason),), float(count)) for reason, count in drops.items()]

        metrics.counter(
            "sern_endpoint_dropped_total",
            "Messages that were dropped between this site's nodes and its endpoint.",
            ("reason",),
            endpoint_drops,
        )
        self.parts.register(metrics)
        metrics.gauge(
            "sern_endpoint_differences",
            "Differences between what this client holds open at its endpoint and what is open there, at the last look.",
            read=lambda: [((), float(len(self.check.found)))],
        )
        metrics.counter(
            "sern_endpoint_differences_total",
            "Differences that were ever found there; each is a line in the log.",
            read=lambda: [((), float(self.check.total))],
        )
        adaptation = self.adaptation
        if adaptation is not None:
            adaptation.register(metrics)
        metrics.counter(
            "sern_command_lease_expired_total",
            "Times a command topic went quiet and the stop command was published.",
            read=lambda: [((), float(self.bridge.leases_fired))],
        )
        metrics.counter(
            "sern_command_guard_stops_total",
            "Leases that ran out while the client was held up: its guard published the stop command.",
            read=lambda: [((), float(0 if self.guard is None else self.guard.stopped))],
        )
        metrics.counter(
            "sern_command_guard_restarts_total",
            "Times the guard of the command topics had ended and was started again.",
            read=lambda: [((), float(0 if self.guard is None else self.guard.restarts))],
        )
        metrics.counter(
            "sern_deadline_missed_total",
            "Gaps between messages longer than the topic's deadline_s.",
            ("topic",),
            lambda: [((topic,), float(count)) for topic, count in self.bridge.deadlines_missed.items()],
        )
        metrics.counter(
            "sern_frame_ids_unread_total",
            "Messages whose frame ids stayed without frame_prefix because their type or bytes could not be read.",
            read=lambda: [((), float(self.bridge.frames.unreadable))],
        )
        metrics.counter(
            "sern_conversion_failures_total",
            "Messages dropped because they could not be converted between ROS 1 and ROS 2.",
            read=lambda: [((), float(self.bridge.converter.failures))],
        )
        metrics.counter(
            "sern_service_calls_total",
            "Calls from here of services of other sites, by outcome: ok, error, timeout, cancelled.",
            ("service", "outcome"),
            self._service_calls,
        )
        metrics.counter(
            "sern_goals_given_up_total",
            "Goals of ROS 1 that were lost on their way, or not heard of for too long; their clients were told.",
            read=lambda: [((), float(0 if self.bridge.goals is None else self.bridge.goals.reported))],
        )
        metrics.counter(
            "sern_publish_failures_total",
            "Messages that arrived and could not be published here.",
            read=lambda: [((), float(self.bridge.publish_failures))],
        )
        metrics.counter(
            "sern_bad_frames_total",
            "Frames from the relay that were not valid.",
            read=lambda: [((), float(self._transport.bad_frames if self._transport else 0))],
        )
        metrics.counter(
            "sern_http_refused_total",
            "Requests to the HTTP server that were none.",
            read=lambda: [((), float(self._http.refused if self._http else 0))],
        )
        return HttpServer(
            listen,
            registry,
            health=lambda: Health(ok=True, reason="running"),
            ready=self._ready,
            json_routes={
                "/api/link": lambda: [{**link.snapshot(), "now_s": clock.now()}],
                "/api/peers": self.link_state.to_json,
                "/api/topics": self.topics,
                "/api/trace": trace_view(of_client(self.core.link, self.core.trace), clock.now),
                "/api/values": self.bridge.values.view(),
                **({} if adaptation is None else {"/api/mmcf": adaptation.to_json}),
            },
            parts=self.parts,
        )

    def _service_calls(self) -> list[tuple[tuple[str, str], float]]:
        services = self.bridge.services
        return [] if services is None else [(labels, float(count)) for labels, count in services.outcomes.items()]

    def _ready(self) -> Health:
        if self.core.link.established:
            if self.core.link.lane.stalled:
                return Health(ok=False, reason=SILENT)
            if self.check.found:
                return Health(ok=False, reason=f"what is here is not what should be: {self.check.found[0]}")
            # A site with one robot of three gone does its job for the other two.
            said = (f"connected to {self.core.link.peer}", self.link_state.detail())
            return Health(ok=True, reason="; ".join(filter(None, said)))
        return Health(ok=False, reason=self._why())

    def topics(self) -> dict[str, TopicView]:
        """Counters of every topic by global name, sent and received."""
        return both_ways(self.core.link, self.core.received, now=clock.now())

    async def drain(self) -> None:
        """Stop the sources, then go on sending what is owed while that gets anywhere, `link.drain_s` at most. What
        arrives meanwhile is taken.

        The relay must get everything; whether all subscribers confirm it is waited for as long as confirmations come,
        because a subscriber that is away is the relay's to wait for.
        """
        self._stopping = True
        self.bridge.stop_sources()
        link = self.core.link
        now = clock.now()
        progress = Progress()
        give_up_s = now + self.loaded.model.link.drain_s
        while now < give_up_s:
            channels = [channel for channel in link.sender.channels.values() if channel.wanted is not False]
            unsent = sum(len(c.queue) + len(c.flying) + (c.newest is not None) for c in channels) + self.bridge.pending
            unconfirmed = sum(len(channel.retained) for channel in channels)
            if not unconfirmed and (not unsent or not link.established or link.lane.stalled):
                break
            left = (unsent, unconfirmed, sum(nbytes for _messages, nbytes in link.sender.queued().values()))
            patience_s = STALL_PATIENCE_S if unsent and link.established else PATIENCE_S
            if progress.still_s(left, now=now) > patience_s + PATIENCE_RTTS * link.lane.flight.rtt.srtt_s:
                break
            self._kick()
            await asyncio.sleep(0.02)
            now = clock.now()
        unconfirmed = sum(len(channel.retained) for channel in link.sender.channels.values())
        if unconfirmed:
            _log.warning("stopping with %d reliable messages that not everyone has confirmed", unconfirmed)
        if self.bridge.keeping:
            await self._keep()
        if self._transport is not None:
            self._kick()
            await asyncio.sleep(0.02)  # what has arrived here is confirmed before we say goodbye
            self._transport.pump.run()
            link.close("client stops", now=clock.now())
            self._transport.pump.run()
            await asyncio.sleep(0.05)  # libzmq's thread takes it from here

    async def _keep(self) -> None:
        """Have what was recorded flushed, so that all of it is confirmed before we say goodbye, and read nothing more:
        what comes now the next process gets."""
        keeping = self.bridge.keeping
        self.core.link.handshake.reads = False
        keeping.flush()
        give_up_s = clock.now() + PATIENCE_S
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
            if self._endpoint_started:
                stack.push_async_callback(self.bridge.endpoint.stop)
            if self.guard is not None:
                stack.push_async_callback(self.guard.stop)
            stack.callback(self.bridge.close)
            stack.callback(self.link_state.close)
            if self.bridge.services is not None:
                stack.push_async_callback(self.bridge.services.stop)
            if self._transport is not None:
                stack.callback(self._transport.close)
            if self._express is not None:
                stack.callback(self._express.close)
            if self._lane is not None:
                stack.callback(self._lane.closed)
            if self._name is not None:
                stack.callback(self._name.close)
            stack.callback(self.codecs.close)
            stack.push_async_callback(end_tasks, self.tasks)

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
