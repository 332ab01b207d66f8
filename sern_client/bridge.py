"""Joins an endpoint to the client core: discovery, names, rules, leases; what comes in goes out on the other side."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Final

from sern_client.actions import GoalWatch
from sern_client.endpoints.base import (
    Difference,
    Endpoint,
    Held,
    Publisher,
    Sink,
    Subscription,
    keepers_of,
    publisher_within,
)
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.conversion import Converter
from sern_client.frames import FramePrefixer, Rewrite
from sern_client.guard import Guard
from sern_client.keeping import Keeping
from sern_client.latest import LatestValues
from sern_client.leaving import Leaving
from sern_client.link_state import LinkState
from sern_client.rebuild import Rebuilds
from sern_client.services import ServiceBridge
from sern_client.summarise import Send, Source, Summaries, streams_of
from sern_client.tf_merge import LatchedTransforms, MergedTransforms
from sern_client.udp import ClientLane
from sern_client.update_topics import UpdateTopics
from sern_client.withdrawal import Kept, Withdrawable, Withdrawal
from sern_core.link.handshake import DISPLACED
from sern_core.site.client import ClientCore
from sern_core.site.lease import CommandLease
from sern_core.site.services import parse as parse_service
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.transforms import is_static
from sern_core.topics.rules import Discovery, ResolvedTopic, RuleSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.ledger import MAX_TOPICS, OTHER_TOPIC
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.names import to_global
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from sern_core.wire import framing
from sern_runtime import clock, ros_types
from sern_runtime.fine_timer import fine_timer
from sern_runtime.link_metrics import AgeHistograms
from sern_runtime.loop import Timer
from sern_runtime.message_log import MessageLog
from sern_runtime.optional import OptionalParts

MAX_PROBLEMS: Final = 256
AGAIN_S: Final = (1.0, 60.0)
"""First and longest pause before a stream that could not be published here is tried again."""

_log = logging.getLogger(__name__)


class Outgoing:
    """A local topic that is offered to the link; `source` makes something else of it before. Its messages go to
    `sink`."""

    __slots__ = ("channel", "sink", "source", "subscription")

    def __init__(self, channel: OutChannel, subscription: Subscription, source: Source | None, sink: Sink) -> None:
        self.channel = channel
        self.sink = sink
        self.subscription = subscription
        self.source = source

    @property
    def streams(self) -> set[StreamId]:
        """All that its messages go to, in whatever form."""
        own = {self.channel.stream.id}
        return own if self.source is None else own | self.source.streams


class Incoming:
    """A stream from elsewhere that is published here, as `info`. `stop` is the body that a lost link makes us publish.
    `publisher` None: it is of use to another stream only. `guarded`: what the guard calls it; None: it has none."""

    __slots__ = ("guarded", "info", "kept", "lease", "local", "publish", "publisher", "rewrite", "stop", "withdrawn")

    def __init__(
        self,
        info: TopicInfo,
        publisher: Publisher | None,
        lease: CommandLease | None,
        stop: bytes | None,
        rewrite: Rewrite | None,
    ) -> None:
        self.info = info
        self.local = info.name
        self.use(publisher)
        self.lease = lease
        self.stop = stop
        self.rewrite = rewrite
        self.guarded: int | None = None
        self.kept: Kept | None = None
        self.withdrawn: ClientName | None = None

    def use(self, publisher: Publisher | None) -> None:
        self.publisher = publisher
        self.publish = None if publisher is None else publisher_within(publisher)


class Bridge:
    """`ClientEvents` on one side, `TopicEvents` on the other. `attach` the core before anything is called."""

    def __init__(
        self,
        endpoint: Endpoint,
        rules: RuleSet,
        discovery: Discovery,
        namespace: str,
        *,
        frame_prefix: str | None = None,
        log: MessageLog | None,
        kick: Callable[[], None],
        on_up: Callable[[], None],
        on_down: Callable[[str], None],
        on_fault: Callable[[Exception], None],
        parts: OptionalParts | None = None,
    ) -> None:
        self.parts = parts or OptionalParts()
        self.endpoint = endpoint
        self.rules = rules
        self.discovery = discovery
        self.namespace = namespace
        self.frames = FramePrefixer(frame_prefix)
        self.converter = endpoint.converter if isinstance(endpoint, CompositeEndpoint) else Converter()
        self.ages = AgeHistograms()
        self.rejected_reason: str | None = None
        self.lane: ClientLane | None = None
        """The datagram lane, where there is one; set by the daemon."""
        self.services: ServiceBridge | None = None
        """Services offered and used, where there are rules for them; set by the daemon."""
        self.goals: GoalWatch | None = None
        """Goals of ROS 1 that this site gives to others, where there are rules for them; set by the daemon."""
        self.link_state: LinkState | None = None
        """Says at the endpoint who is there; set by the daemon."""
        self.guard: Guard | None = None
        """Publishes stop commands while this process cannot; set by the daemon."""
        self.refusals = 0
        self.subscription_problems: dict[str, str] = {}
        """What the relay does not let us have, in its words, with the code."""
        self.deadlines_missed: dict[TopicName, int] = {}
        self.leases_fired = 0
        self.publish_failures = 0
        self._log = log
        self._kick = kick
        self._on_up = on_up
        self._on_down = on_down
        self._on_fault = on_fault
        self._sources_stopped = False
        self._closed = False
        self._core: ClientCore | None = None
        self._outgoing: dict[TopicName, Outgoing] = {}
        self._by_stream: dict[StreamId, tuple[TopicName, Outgoing]] = {}  # the same, by each stream it goes to
        self.leaving = Leaving(self._unpublish)
        self.values = LatestValues()
        self._incoming: dict[StreamId, Incoming] = {}
        self.withdrawal = Withdrawal(self._incoming, self._advertise, self._close_publisher)
        """Ends the topics of who is not there."""
        self._last_arrival_s: dict[StreamId, float] = {}
        self._timer = fine_timer(self._leases_due)  # one that is due while the machine sleeps is due when it wakes
        self.summaries = Summaries(self._sender, self.parts)
        self._unnamed: set[TopicName] = set()  # local topics without a rule, of which it was said
        self._unreceived: dict[StreamId, str] = {}  # streams that could not be published here, and why
        self._again = Timer(self._reconsider)
        self._again_s = AGAIN_S[0]
        self.rebuilds = Rebuilds(self._grid_shown, self._settle)
        self._updates = UpdateTopics(lambda: self.core.patterns, self._subscribe)
        self.keeping = Keeping(keepers_of(endpoint), self._hold, self._release_kept, self._keep_in)
        self._keep_timer = Timer(self.keeping.keep_soon)

    def attach(self, core: ClientCore) -> None:
        self._core = core

    @property
    def core(self) -> ClientCore:
        if self._core is None:
            raise UsageError("the bridge has no core yet")
        return self._core

    def stop_sources(self) -> None:
        """Offer nothing more to the link; what arrives is still published here. Idempotent."""
        self._sources_stopped = True
        for outgoing in self._outgoing.values():
            outgoing.subscription.close()

    @property
    def pending(self) -> int:
        """Messages that something else is being made of, and that are not offered to the link yet."""
        return sum(outgoing.source.pending for outgoing in self._outgoing.values() if outgoing.source is not None)

    def close(self) -> None:
        """Before the endpoint is stopped: a robot that is being commanded is told to stand still."""
        self.stop_sources()
        self._closed = True
        for outgoing in self._outgoing.values():
            if outgoing.source is not None:
                outgoing.source.close()
                for channel in outgoing.source.own:
                    self._unpublish(channel)
        self.summaries.close()
        self._outgoing.clear()
        self._by_stream.clear()
        self.leaving.close()
        self._timer.close()
        self._keep_timer.cancel()
        self._again.cancel()
        self.rebuilds.close()
        self._updates.close()
        if self.goals is not None:
            self.goals.close()
        for incoming in self._incoming.values():
            self._release(incoming)
        self._incoming.clear()

    def _release(self, incoming: Incoming) -> None:
        """No more commands will come from there: the last one must not stand."""
        if incoming.lease is not None and incoming.stop is not None and incoming.lease.deadline() is not None:
            self._publish(incoming, incoming.stop, time.time_ns())
        if self.guard is not None and incoming.guarded is not None:
            self.guard.closed(incoming.guarded)
        self._close_publisher(incoming)

    def _close_publisher(self, incoming: Withdrawable) -> None:
        if incoming.publisher is not None:
            try:
                incoming.publisher.close()
            except Exception:  # noqa: BLE001  a fault of one topic, as in `_publish`
                self.publish_failures += 1
                _log.exception("%s could not be ended here", incoming.info.name)

    def _publish(self, incoming: Incoming, body: bytes, stamp_ns: int, left_s: float = inf) -> None:
        """`left_s`: how much longer the message is young enough."""
        if incoming.withdrawn is not None:
            self.withdrawal.restore_one(incoming)
        if incoming.publish is None:
            return
        try:
            incoming.publish(body, stamp_ns, left_s)
        except Exception:  # noqa: BLE001  (a fault of one topic; the link below must finish what it was doing)
            self.publish_failures += 1
            _log.exception("%s could not be published here", incoming.local)

    # --- TopicEvents: from the endpoint -----------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        if info.name in self._outgoing or self._sources_stopped:
            return
        self.leaving.come_back(info.name)
        listed = self.rules.find(info.type_name, info.name) is not None
        if not self.discovery.wants(info.name, info.type_name, listed=listed):
            if self.discovery.wants(info.name, info.type_name, listed=True):  # only a rule is missing
                self._say_unnamed(info)
            return
        try:
            resolved = self.rules.resolve(info, local_name=info.name)
        except ConfigError as error:
            _log.error("%s", error)
            return
        if not resolved.direction.sends:
            return
        name = to_global(resolved.name, self.namespace)
        try:
            channel, source = self._offer(info, resolved, name)
        except UsageError as error:
            _log.error("%s cannot be offered as %s: %s", info.name, name, error)
            return
        sink = self._sink(channel, self.frames.outgoing(info)) if source is None else source.sink
        if self.goals is not None:
            sink = self.goals.outgoing(info, channel, sink)
        try:
            subscription = self.endpoint.subscribe(info.name, sink)
        except UsageError as error:
            _log.error("%s cannot be taken: %s", info.name, error)
            self._withdraw(channel, source)
            return
        outgoing = self._outgoing[info.name] = Outgoing(channel, subscription, source, sink)
        self._by_stream.update(dict.fromkeys(outgoing.streams, (info.name, outgoing)))
        self._kick()

    def _say_unnamed(self, info: TopicInfo) -> None:
        """Said once for each name: a rule with a typing error looks like a robot without the topic."""
        if info.name not in self._unnamed and len(self._unnamed) < MAX_TOPICS:
            self._unnamed.add(info.name)
            _log.info("%s (%s) stays here: no rule in `topics` names it (discovery.mode: manual)", info.name,
                      info.type_name)  # fmt: skip

    def _withdraw(self, channel: OutChannel, source: Source | None) -> None:
        """Offer a topic no more."""
        self._forget_source(source)
        for each in streams_of(channel, source):
            self._unpublish(each)

    def _unpublish(self, channel: OutChannel) -> None:
        self.values.forget(channel.stream.id)
        self.core.unpublish(channel, now=clock.now())

    def _forget_source(self, source: Source | None) -> None:
        if source is not None:
            source.close()
            self.summaries.forget(source)

    def _offer(self, info: TopicInfo, resolved: ResolvedTopic, name: TopicName) -> tuple[OutChannel, Source | None]:
        """Offer a topic to the link, with what its rule makes of it. UsageError when it cannot be."""
        core, spec = self.core, resolved.spec
        if resolved.rule is not None and resolved.summaries:
            opened = self.summaries.open(core, info, resolved, self.rules.rules[resolved.rule], name)
            if opened is not None:
                return opened
        merge = resolved.merge_tf and info.encoding is not Encoding.RAW
        static = info.latched or is_static(info.name)
        capped_hz = spec.max_rate_hz
        if merge:
            # A message of all static transforms replaces the ones before; every other one counts.
            spec = replace(spec, max_rate_hz=None, depth=1 if static else spec.depth)
        channel = core.publish(replace(info, name=name), spec, now=clock.now())
        if not merge:
            return channel, None
        send = self._sender(channel, info)
        if static:
            return channel, LatchedTransforms(core, channel, send, info.name, info.encoding)
        return channel, MergedTransforms(core, channel, send, info.name, info.encoding, max_rate_hz=capped_hz)

    def topic_removed(self, name: TopicName) -> None:
        outgoing = self._outgoing.pop(name, None)
        if outgoing is not None:
            for stream in outgoing.streams:
                del self._by_stream[stream]
            if self.goals is not None:
                self.goals.withdrawn(name)
            outgoing.subscription.close()
            self._forget_source(outgoing.source)
            self.leaving.leave(name, *streams_of(outgoing.channel, outgoing.source), now=clock.now())
            self._kick()

    def _sink(self, channel: OutChannel, rewrite: Rewrite | None) -> Callable[[bytes, int], bool]:
        send = self._send(channel, rewrite)
        return lambda body, stamp_ns: send(body, stamp_ns, None)

    def _sender(self, channel: OutChannel, info: TopicInfo) -> Send:
        """What puts bodies of the type `info` into a channel; for topics of which something else is made."""
        return self._send(channel, self.frames.outgoing(info))

    def _send(self, channel: OutChannel, rewrite: Rewrite | None) -> Callable[[bytes, int, float | None], bool]:
        core, kick, log, stream, parts = self.core, self._kick, self._log, channel.stream, self.parts
        passed = self.values.passed

        def send(body: bytes, stamp_ns: int, born_s: float | None) -> bool:
            seq = channel.next_seq
            if rewrite is not None:
                body = rewrite(body)
            accepted = core.send(channel, body, stamp_ns, born_s=born_s, now=clock.now())
            if accepted:
                passed(stream, seq, body)
            if log is not None:
                try:
                    log.offered(stream, seq, body, stamp_ns, accepted=accepted)
                except Exception as error:  # noqa: BLE001  (of the log alone)
                    parts.failed("message_log", error)
            kick()
            return accepted

        return send

    # --- ClientEvents: from the link --------------------------------------------------------------------------------

    def link_up(self, *, resumed: bool) -> None:
        self.rejected_reason = None
        _log.info("connected to %s%s", self.core.link.peer, " again" if resumed else "")
        self._on_up()

    def link_down(self, reason: str) -> None:
        self._on_down(reason)

    def rejected(self, code: str, text: str) -> None:
        # It is asked again every few seconds; of a session that was taken from us `link_down` has said it.
        if text != self.rejected_reason and code != DISPLACED:
            _log.error("the relay refuses us (%s): %s", code, text)
        self.rejected_reason = text

    def lane_offered(self, parameters: framing.Envelope) -> None:
        if self.lane is not None:
            self.lane.offered(parameters)

    def lane_closed(self) -> None:
        if self.lane is not None:
            self.lane.closed()

    def stream_opened(self, stream: StreamInfo) -> None:
        if parse_service(stream.id.topic) is not None:
            if self.services is None:
                raise ConfigError(f"{stream.id.topic} is of a service; nothing in `services` here")
            self.services.stream_opened(stream)
            return
        local = self.rules.inward(stream.id.topic, namespace=self.namespace)
        info = replace(stream.info, name=local)
        try:
            resolved = self.rules.resolve(info, local_name=local)
            if not resolved.direction.receives:
                raise ConfigError(f"{local} is only sent from here (direction: send); not received")
            publisher = None
            if self._published_here(stream):
                publisher = self._advertise(info)
        except ConfigError as error:
            self._not_received(stream, str(error))
            raise
        self._unreceived.pop(stream.id, None)
        lease = stop = None
        if resolved.lease is not None:
            stop = ros_types.zero_message(info.type_name, info.encoding)
            if stop is None:
                _log.error("%s is %s: on_link_loss cannot stop it; no lease", local, info.type_name)
            else:
                lease = CommandLease(resolved.lease.after_s)
        incoming = Incoming(info, publisher, lease, stop, self.frames.incoming(info))
        incoming.kept = self.withdrawal.kept(stream)
        if self.guard is not None and stop is not None:
            incoming.guarded = self.guard.opened(info, stop)
        self._incoming[stream.id] = incoming
        if self.goals is not None:
            self.goals.opened(info, lambda body: self._publish(incoming, body, time.time_ns()))
        updates = self.rebuilds.opened(stream, lambda body, stamp_ns: self._show(incoming, body, stamp_ns))
        if updates is not None:
            self._updates.opened(stream.id, updates)
        _log.info("receiving %s from %s as %s", stream.id.topic, stream.id.origin, local)

    def _advertise(self, info: TopicInfo) -> Publisher:
        """ConfigError whatever goes wrong: the streams beside it must go on."""
        try:
            return self.converter.advertise(self.endpoint, info)
        except ConfigError:
            raise
        except Exception as error:
            self.publish_failures += 1
            _log.exception("%s cannot be published here", info.name)
            raise ConfigError(f"{info.name}: cannot be published here: {ros_types.one_line(error)}") from error

    def _not_received(self, stream: StreamInfo, problem: str) -> None:
        """Said once; tried again, because what is in its way may go: another stream of that name, for one."""
        if self._unreceived.get(stream.id) != problem:
            _log.error("%s from %s is not received: %s", stream.id.topic, stream.id.origin, problem)
        self._unreceived[stream.id] = problem
        if self._again.deadline_s is None and not self._closed:
            self._again.arm(clock.now() + self._again_s)

    def _reconsider(self) -> None:
        refused = self.core.refused
        self._unreceived = {stream: problem for stream, problem in self._unreceived.items() if stream in refused}
        self._again_s = min(2 * self._again_s, AGAIN_S[1])
        self.core.reconsider(now=clock.now())
        self._kick()

    def _published_here(self, stream: StreamInfo) -> bool:
        """Whether a stream is published: updates of patches are taken to make whole grids of them, unless somebody here
        has asked for them."""
        return not self.rebuilds.is_updates(stream) or self._updates.of_site(stream.id.topic)

    def _subscribe(self, patterns: tuple[str, ...]) -> None:
        self.core.subscribe(patterns, now=clock.now())
        self._kick()

    def _show(self, incoming: Incoming, body: bytes, stamp_ns: int, left_s: float = inf) -> None:
        """Publish what came, or was put together here."""
        if incoming.rewrite is not None:
            try:
                body = incoming.rewrite(body)
            except Exception as error:  # noqa: BLE001  (as it came is better than not at all)
                self.parts.failed("frames", error)
        self._publish(incoming, body, stamp_ns, left_s)
        if incoming.kept is not None:
            incoming.kept.append((body, stamp_ns))

    def stream_closed(self, stream: StreamInfo) -> None:
        self.rebuilds.closed(stream)
        self._updates.closed(stream.id)
        if self.core.refused and not self._closed:  # it may have been in their way
            self._again_s = AGAIN_S[0]
            self._again.arm(clock.now())
        if self.services is not None:
            self.services.stream_closed(stream)
        incoming = self._incoming.pop(stream.id, None)
        self.values.forget(stream.id)
        self._last_arrival_s.pop(stream.id, None)
        if incoming is not None:
            if self.goals is not None:
                self.goals.ended(incoming.local)
            self._release(incoming)
            _log.info("%s from %s has ended", stream.id.topic, stream.id.origin)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        incoming = self._incoming.get(stream.id)
        if incoming is None:
            if self.services is not None:
                self.services.message(stream, message)
            return
        self.values.passed(stream, message.seq, message.body)
        age_s = now - message.born_s
        if incoming.lease is not None:
            incoming.lease.renew(born_s=message.born_s)
            self._arm()
            self._tell_guard(incoming)  # before it is published: no stop command of before may come after it
        mark = self.keeping.mark() if stream.spec.reliable and self.keeping else None
        if not self.rebuilds.message(stream, message, owed=mark is not None):
            lifespan_s = stream.spec.lifespan_s
            left_s = inf if lifespan_s is None else max(lifespan_s - age_s, 0.0)
            self._show(incoming, message.body, message.stamp_ns, left_s)
        if mark is None:
            pass
        elif self.rebuilds.owes(stream, message.seq):
            self._hold(stream.id, message.seq)
        else:
            self.keeping.published(stream.id, message.seq, mark)
        if self.goals is not None:
            self.goals.message(incoming.local, stream.info.encoding, message.body)
        try:
            self.ages.observe(stream.spec.priority, age_s)
            if stream.spec.deadline_s is not None:
                self._check_deadline(stream, now)
        except Exception as error:  # noqa: BLE001  (of what is counted alone)
            self.parts.failed("metrics", error)
        try:
            if self._log is not None:
                self._log.delivered(stream, message, age_s)
        except Exception as error:  # noqa: BLE001  (of the log alone)
            self.parts.failed("message_log", error)

    def _grid_shown(self, publish: Callable[[], None], owed: Sequence[tuple[StreamId, int]]) -> None:
        """Publish a grid; the updates in it are kept when it is."""
        mark = self.keeping.mark()
        publish()
        self._settle([(stream, seq) for stream, seq in owed if not self.keeping.published(stream, seq, mark)])

    def _settle(self, owed: Sequence[tuple[StreamId, int]]) -> None:
        for stream, seq in owed:
            self.core.release(stream, seq, now=clock.now())

    def _hold(self, stream: StreamId, seq: int) -> None:
        self.core.hold(stream, seq)

    def _keep_in(self, delay_s: float) -> None:
        self._keep_timer.arm(clock.now() + delay_s)

    def _release_kept(self, stream: StreamId, seq: int, lost: DropReason | None) -> None:
        self.core.release(stream, seq, lost=lost, now=clock.now())
        self._kick()

    def _check_deadline(self, stream: StreamInfo, now: float) -> None:
        last_s = self._last_arrival_s.get(stream.id)
        self._last_arrival_s[stream.id] = now
        deadline_s = stream.spec.deadline_s
        if last_s is not None and deadline_s is not None and now - last_s > deadline_s:
            topic = stream.id.topic
            known = topic in self.deadlines_missed or len(self.deadlines_missed) < MAX_TOPICS
            counted = topic if known else OTHER_TOPIC
            self.deadlines_missed[counted] = self.deadlines_missed.get(counted, 0) + 1
            _log.warning("%s: %.3f s between messages, deadline %.3f s", topic, now - last_s, deadline_s)

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        if self._log is not None:
            self._log.expired(stream, seq, reason)
        _log.warning("%s: reliable message %d was dropped on its way: %s", stream.id.topic, seq, reason)

    def skipped(self, stream: StreamInfo, count: int) -> None:
        _log.warning("%s: %d reliable messages were given up while we were away", stream.id.topic, count)

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        found = self._by_stream.get(stream.id)
        if found is None:
            return
        local, outgoing = found
        source = outgoing.source
        if source is None:
            self.endpoint.interest(local, wanted)
            return
        if wanted:
            source.audience_changed()
        self.endpoint.interest(local, source.wanted)

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        found = self._by_stream.get(stream.id)
        if found is not None and found[1].source is not None:
            found[1].source.lost(stream.id)
        if self.services is not None:
            self.services.send_dropped(stream, first, count, reason)
        if self.goals is not None:
            self.goals.send_dropped(stream.id, first, count, reason)
        if not stream.spec.reliable or self._closed:  # what is left at the end was said in one line
            return
        name, last = stream.id.topic, first + count - 1
        if reason is DropReason.UNWANTED:  # who wanted it has left or unsubscribed: counted, and no loss to anybody
            _log.debug("%s: nobody wants our reliable messages %d to %d any more", name, first, last)
        elif count == 1 and where:
            _log.warning("%s: our reliable message %d was dropped for %s: %s", name, first, where, reason)
        elif count == 1:
            _log.warning("%s: our reliable message %d was dropped here: %s", name, first, reason)
        elif where:
            _log.warning("%s: our reliable messages %d to %d were dropped for %s: %s", name, first, last, where, reason)
        else:
            _log.warning("%s: our reliable messages %d to %d were dropped here: %s", name, first, last, reason)

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        self.refusals += 1
        _log.error("the relay refuses %s (%s): %s", stream.id.topic, code, text)

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        _log.error("%s from %s cannot be decoded and is dropped: %s", stream.id.topic, stream.id.origin, problem)

    def fault(self, error: Exception) -> None:
        self._on_fault(error)

    def subscription_refused(self, code: str, text: str) -> None:
        if text not in self.subscription_problems:  # it is said again in every session
            _log.error("the relay refuses a subscription (%s): %s", code, text)
            if len(self.subscription_problems) < MAX_PROBLEMS:
                self.subscription_problems[text] = code

    # --- consistency ------------------------------------------------------------------------------------------------

    def validate(self) -> list[Difference]:
        """Compare our tables with the core's and the endpoint's: what is not as it should be. Something under way may
        show for a moment."""
        streams = {stream for stream in self.core.opened if parse_service(stream.topic) is None}
        halves = (("the core", streams - self._incoming.keys()), ("the bridge", self._incoming.keys() - streams))
        found = [
            Difference(stream.topic, f"a stream of {stream.origin} is open in {where} only")
            for where, only_there in halves
            for stream in sorted(only_there)
        ]
        found += [
            Difference(name, "it is offered to nobody: its channel is closed")
            for name, outgoing in self._outgoing.items()
            if outgoing.channel.stream.id not in self.core.link.outgoing.by_stream
        ]
        publishers = Counter(incoming.local for incoming in self._incoming.values() if incoming.publisher is not None)
        if self.link_state is not None:
            publishers += self.link_state.held
        return found + self.endpoint.validate(Held(publishers, Counter(self._outgoing.keys())))

    def repair(self, differences: Sequence[Difference]) -> None:
        """Open anew at the endpoint what is not open there as it should be."""
        odd = {difference.name for difference in differences if difference.kind == "publisher"}
        if self.link_state is not None:
            self.link_state.repair(odd)
        for name in odd:
            for incoming in [each for each in self._incoming.values() if each.local == name]:
                if incoming.publisher is not None:
                    self._close_publisher(incoming)
                    try:
                        incoming.use(self._advertise(incoming.info))
                    except ConfigError as error:
                        _log.error("%s cannot be published again: %s", name, error)
        for name in {difference.name for difference in differences if difference.kind == "subscription"}:
            outgoing = self._outgoing.get(name)
            if outgoing is not None:
                outgoing.subscription.close()
                try:
                    outgoing.subscription = self.endpoint.subscribe(name, outgoing.sink)
                except UsageError as error:
                    _log.error("%s cannot be taken again: %s", name, error)
                    self.topic_removed(name)

    # --- leases -----------------------------------------------------------------------------------------------------

    def _arm(self) -> None:
        deadlines = [
            deadline_s
            for incoming in self._incoming.values()
            if incoming.lease is not None and (deadline_s := incoming.lease.deadline()) is not None
        ]
        self._timer.arm(min(deadlines) if deadlines else None)

    def _tell_guard(self, incoming: Incoming) -> None:
        if self.guard is not None and incoming.guarded is not None and incoming.lease is not None:
            self.guard.lease(incoming.guarded, incoming.lease.deadline())

    def _leases_due(self) -> None:
        now = clock.now()
        for stream, incoming in self._incoming.items():
            lease = incoming.lease
            if lease is None or incoming.stop is None:
                continue
            first = not lease.expired
            if lease.due(now=now):
                self._publish(incoming, incoming.stop, time.time_ns())
                self._tell_guard(incoming)
                if first:
                    self.leases_fired += 1
                    self.core.lease_expired(stream, lease.after_s, now=now)
                    _log.warning("%s: no fresh command; publishing the stop command", incoming.local)
        self._arm()
