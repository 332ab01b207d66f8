"""Offers an endpoint's topics to the link: discovery, rules, names, and what is made of their messages before."""

import logging
from collections import Counter
from collections.abc import Callable, Collection, KeysView, Mapping
from dataclasses import replace
from typing import Final

from sern_client.actions import GoalWatch
from sern_client.durable import DurableTopics
from sern_client.e_stop import EStops
from sern_client.endpoints.base import Difference, Sink, Subscription
from sern_client.entry import Entry
from sern_client.frames import Rewrite
from sern_client.holding import Holding
from sern_client.leaving import Leaving
from sern_client.site import CAPPED, Site
from sern_client.spool.keeping import Taps
from sern_client.stored_topics import StoredTopics
from sern_client.summaries.client_summaries import Summaries
from sern_client.summaries.source import Source, streams_of
from sern_client.summaries.topic_summary import Send
from sern_client.tf_merge import LatchedTransforms, MergedTransforms
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.transforms import is_static
from sern_core.topics.rules import Discovery, ResolvedTopic, RuleSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.names import to_global
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, Encoding, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

CHANGING_S: Final = 0.02
"""How often a reliable topic is looked at that is to be offered otherwise once all is delivered."""
CLOSED: Final = "it is offered to nobody: its channel is closed"

_log = logging.getLogger(__name__)


class Outgoing:
    """A local topic that is offered to the link, as `resolved` says; `source` makes something else of it before. Its
    messages go to `entry`."""

    __slots__ = ("channel", "entry", "info", "name", "resolved", "source", "subscription")

    def __init__(
        self,
        info: TopicInfo,
        resolved: ResolvedTopic,
        channel: OutChannel,
        source: Source | None,
        entry: Entry,
        subscription: Subscription,
    ) -> None:
        self.info = info
        self.name = info.name
        self.resolved = resolved
        self.channel = channel
        self.source = source
        self.entry = entry
        self.subscription = subscription

    @property
    def streams(self) -> set[StreamId]:
        """All that its messages go to, in whatever form."""
        own = {self.channel.stream.id}
        return own if self.source is None else own | self.source.streams


def _essence(resolved: ResolvedTopic) -> ResolvedTopic:
    """What the rules say of a topic that leaves here, wherever the rule stands among the others."""
    return replace(resolved, rule=None, lease=None)


def _without_birth(send: Callable[[bytes, int, float | None], bool]) -> Sink:
    """What takes messages that are born as they come."""
    return lambda body, stamp_ns: send(body, stamp_ns, None)


class Outbound:
    """`TopicEvents` of the endpoint. The core's news of our own streams come to it as well. `goals`: those of ROS 1
    that this site gives to others, where there are rules for them; `durable`: what keeps topics on disk, where there is
    a place for them; `taps`: of topics that are kept whether they are sent or not, where there are such."""

    def __init__(
        self,
        site: Site,
        core: ClientCore,
        discovery: Discovery,
        *,
        goals: GoalWatch | None = None,
        durable: DurableTopics | None = None,
        taps: Taps | None = None,
    ) -> None:
        self.refusals = 0
        """Publications that the relay did not take."""
        self.refused: dict[TopicName, str] = {}
        """Those of the session, by global name, in the relay's words."""
        self.reckoned = 0
        """Poses that were not sent, because whoever receives them is right without."""
        self.holding: Holding | None = None
        """Who of several operators sends commands; None: all do."""
        self.e_stops: EStops | None = None
        """What is to be told of messages of its topics; None: this site has no e-stop."""
        self.summaries = Summaries(self._sender, site.parts)
        self.leaving = Leaving(self._unpublish)
        self._site = site
        self._core = core
        self._discovery = discovery
        self._goals = goals
        self._durable = durable
        self._taps = taps
        self.stored = StoredTopics(site.advertise)
        """What says of durable topics how much of them is on disk."""
        self._stopped = False
        self._closed = False
        self._known: dict[TopicName, TopicInfo] = {}  # at the endpoint, offered or not
        self._topics: dict[TopicName, Outgoing] = {}
        self._changing: dict[TopicName, ResolvedTopic] = {}  # reliable ones that are to be offered otherwise
        self._change_timer = Timer(self._look_at_changing)
        self._by_stream: dict[StreamId, Outgoing] = {}  # the same, by each stream it goes to
        self.unnamed: dict[TopicName, None] = {}
        """Local topics that stay here because no rule names them, as far as that was said."""

    @property
    def streams(self) -> KeysView[StreamId]:
        """Every stream that a local topic goes to now."""
        return self._by_stream.keys()

    @property
    def pending(self) -> int:
        """Messages that something else is being made of, and that are not offered to the link yet."""
        made = sum(outgoing.source.pending for outgoing in self._topics.values() if outgoing.source is not None)
        return made + (0 if self._durable is None else self._durable.pending)

    def stop_sources(self) -> None:
        """Offer nothing more to the link. Idempotent."""
        self._stopped = True
        for outgoing in self._topics.values():
            outgoing.subscription.close()

    def close(self) -> None:
        """End whatever makes something of messages; before the endpoint is stopped."""
        self.stop_sources()
        self._closed = True
        for outgoing in self._topics.values():
            if self._taps is not None:
                self._taps.close(outgoing.channel.stream.id)
            if outgoing.source is not None:
                outgoing.source.close()
                for channel in outgoing.source.own:
                    self._unpublish(channel)
        self._change_timer.cancel()
        self._changing.clear()
        self.summaries.close()
        self.stored.close_all()
        self._topics.clear()
        self._by_stream.clear()
        self.leaving.close()

    # --- TopicEvents: from the endpoint -----------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        self._known[info.name] = info
        if info.name in self._topics or self._stopped:
            return
        self.leaving.come_back(info.name)
        resolved = self._wanted(info)
        if resolved is None:
            return
        opened = self._open(info, resolved)
        if opened is None:
            return
        channel, source, entry = opened
        try:
            subscription = self._site.endpoint.subscribe(info.name, entry.take)
        except UsageError as error:
            _log.error("%s cannot be taken: %s", info.name, error)
            self._withdraw(channel, source)
            return
        outgoing = self._topics[info.name] = Outgoing(info, resolved, channel, source, entry, subscription)
        self._offered(outgoing)

    def _offered(self, outgoing: Outgoing) -> None:
        self._by_stream.update(dict.fromkeys(outgoing.streams, outgoing))
        channel = outgoing.channel
        _log.info(
            "offering %s (%s) as %s: class %s, %s", outgoing.name, outgoing.info.type_name, channel.stream.id.topic,
            CLASS_LABELS[channel.spec.priority], "reliable" if channel.spec.reliable else "best effort",
        )  # fmt: skip
        self._site.kick()

    def _wanted(self, info: TopicInfo) -> ResolvedTopic | None:
        """What the rules make of a topic at the endpoint; None: it is not offered."""
        rules = self._site.rules
        listed = rules.find(info.type_name, info.name) is not None
        if not self._discovery.wants(info.name, info.type_name, listed=listed):
            if self._discovery.wants(info.name, info.type_name, listed=True):  # only a rule is missing
                self._say_unnamed(info)
            return None
        try:
            resolved = rules.resolve(info, local_name=info.name)
        except ConfigError as error:
            _log.error("%s", error)
            return None
        return resolved if resolved.direction.sends else None

    def _open(self, info: TopicInfo, resolved: ResolvedTopic) -> tuple[OutChannel, Source | None, Entry] | None:
        """Offer a topic to the link; None: it cannot be, which has been said."""
        name = to_global(resolved.name, self._site.namespace)
        try:
            channel, source = self._offer(info, resolved, name)
        except UsageError as error:
            _log.error("%s cannot be offered as %s: %s", info.name, name, error)
            return None
        rewrite = self._site.frames.outgoing(info)
        send = None
        if self._durable is not None and resolved.spec.durable:
            plain = sink = self._kept(info, channel, self._durable)
        elif source is None:
            send = self._send(channel, rewrite)
            plain = sink = _without_birth(send)
        else:
            plain = sink = source.sink
        if resolved.dead_reckoning and source is None and info.encoding is not Encoding.RAW:
            sink = self._reckoned(info, sink)
        if self._goals is not None:
            sink = self._goals.outgoing(info, channel, sink)
        if self.holding is not None and resolved.hold_lapse_s is not None:
            sink = self.holding.sink(channel, sink)
        if self.e_stops is not None and info.name in self.e_stops.topics:
            sink = self.e_stops.sink(info, sink)
        if self._taps is not None and self._spooled(info.name, resolved, info.encoding):
            sink = self._taps.open(channel, rewrite, sink)
        return channel, source, Entry(sink, channel, send if sink is plain else None)

    # --- other rules ------------------------------------------------------------------------------------------------

    @property
    def known(self) -> Mapping[TopicName, TopicInfo]:
        """The topics of the endpoint, offered or not, by local name."""
        return self._known

    @property
    def changing(self) -> KeysView[TopicName]:
        """Reliable topics that are offered as before until what they owe is delivered."""
        return self._changing.keys()

    def use(self, rules: RuleSet, discovery: Discovery) -> None:
        """Have other rules in force, at once. Topics for which they say the same are not touched.

        A reliable topic goes on as before until all that it owes is delivered, and what comes meanwhile waits here: no
        message of it is lost, unless more waits than its queue may hold, which is refused to its publisher. A topic
        that is kept on disk stays as it is until the next start."""
        self._site.rules, self._discovery = rules, discovery
        for info in [] if self._stopped else list(self._known.values()):
            outgoing = self._topics.get(info.name)
            if outgoing is None:
                self.topic_added(info)
                continue
            wanted = self._wanted(info)
            if wanted is None:
                self._remove(info.name)
            elif _essence(wanted) == _essence(outgoing.resolved):
                self._changing.pop(info.name, None)
                outgoing.resolved = wanted
                outgoing.entry.open()
            elif self._durable is not None and (wanted.spec.durable or outgoing.channel.spec.durable):
                _log.warning("%s is kept on disk: what the new rules say of it holds from the next start on", info.name)
            else:
                self._changing[info.name] = wanted
        for name in [name for name in self.unnamed if name in self._topics]:
            del self.unnamed[name]
        self._look_at_changing()

    def _look_at_changing(self) -> None:
        for name, wanted in list(self._changing.items()):
            outgoing = self._topics[name]
            if outgoing.channel.retained:
                outgoing.entry.hold(outgoing.channel.spec.max_queue_bytes)
                continue
            del self._changing[name]
            self._change(outgoing, wanted)
        if self._changing:
            self._change_timer.arm(clock.now() + CHANGING_S)

    def _change(self, outgoing: Outgoing, wanted: ResolvedTopic) -> None:
        """Offer a topic otherwise, with the subscription that it has."""
        waiting, latched = outgoing.entry.take_waiting(), self._core.latched(outgoing.channel)
        for stream in outgoing.streams:
            del self._by_stream[stream]
        if self._goals is not None:
            self._goals.withdrawn(outgoing.name)
        self._withdraw(outgoing.channel, outgoing.source)
        opened = self._open(outgoing.info, wanted)
        if opened is None:
            del self._topics[outgoing.name]
            outgoing.subscription.close()
            return
        outgoing.channel, outgoing.source, entry = opened
        outgoing.resolved = wanted
        outgoing.entry.become(entry)
        if outgoing.source is None and wanted.spec.latched:
            for message in latched:  # as the bodies have left before
                self._core.send(
                    outgoing.channel, message.body, message.stamp_ns, born_s=message.born_s, now=clock.now()
                )
        outgoing.entry.replay(waiting)
        self._offered(outgoing)

    def topic_removed(self, name: TopicName) -> None:
        self._known.pop(name, None)
        self._remove(name)

    def _remove(self, name: TopicName) -> None:
        outgoing = self._topics.pop(name, None)
        if outgoing is not None:
            if self._changing.pop(name, None) is not None:
                outgoing.entry.open()
            for stream in outgoing.streams:
                del self._by_stream[stream]
            if self._goals is not None:
                self._goals.withdrawn(name)
            outgoing.subscription.close()
            if self._taps is not None:
                self._taps.close(outgoing.channel.stream.id)
            self.stored.close(name)
            self._forget_source(outgoing.source)
            self.leaving.leave(name, *streams_of(outgoing.channel, outgoing.source), now=clock.now())
            self._site.kick()

    def _spooled(self, name: TopicName, resolved: ResolvedTopic, encoding: Encoding) -> bool:
        """Whether all messages of a topic are kept. Of a durable one none is ever dropped, and bodies that are no ROS
        messages no recording holds."""
        known = self._taps is not None and self._taps.wants(name)
        return known and not resolved.spec.durable and encoding is not Encoding.RAW

    def _say_unnamed(self, info: TopicInfo) -> None:
        """Said once for each name: a rule with a typing error looks like a robot without the topic."""
        if info.name not in self.unnamed and len(self.unnamed) < MAX_TOPICS:
            self.unnamed[info.name] = None
            _log.info("%s (%s) stays here: no rule in `topics` names it (discovery.mode: manual)", info.name,
                      info.type_name)  # fmt: skip

    def _withdraw(self, channel: OutChannel, source: Source | None) -> None:
        """Offer a topic no more."""
        if self._taps is not None:
            self._taps.close(channel.stream.id)
        self._forget_source(source)
        for each in streams_of(channel, source):
            self._unpublish(each)

    def _unpublish(self, channel: OutChannel) -> None:
        if self._durable is not None and self._durable.leave(channel):
            return
        self._site.values.forget(channel.stream.id)
        self._core.unpublish(channel, now=clock.now())

    def _forget_source(self, source: Source | None) -> None:
        if source is not None:
            source.close()
            self.summaries.forget(source)

    def _offer(self, info: TopicInfo, resolved: ResolvedTopic, name: TopicName) -> tuple[OutChannel, Source | None]:
        """Offer a topic to the link, with what its rule makes of it. UsageError when it cannot be."""
        core, spec = self._core, resolved.spec
        if self._durable is not None and not spec.durable:
            self._durable.give_way(name)
        if resolved.summaries:
            rule = None if resolved.rule is None else self._site.rules.rules[resolved.rule]
            opened = self.summaries.open(core, info, resolved, rule, name)
            if opened is not None:
                return opened
        merge = resolved.merge_tf and info.encoding is not Encoding.RAW
        static = info.latched or is_static(info.name)
        capped_hz = spec.max_rate_hz
        if merge:
            # A message of all static transforms replaces the ones before; every other one counts.
            spec = replace(spec, max_rate_hz=None, depth=1 if static else spec.depth)
        if self._durable is not None and spec.durable:
            return self._durable.publish(replace(info, name=name), spec), None
        capped = {} if spec.reliable or spec.max_rate_hz is None else {CAPPED: f"{spec.max_rate_hz:g}"}
        channel = core.publish(replace(info, name=name), spec, now=clock.now(), attributes=capped)
        if not merge:
            return channel, None
        send = self._sender(channel, info)
        if static:
            return channel, LatchedTransforms(core, channel, send, info.name, info.encoding)
        return channel, MergedTransforms(core, channel, send, info.name, info.encoding, max_rate_hz=capped_hz)

    def _kept(self, info: TopicInfo, channel: OutChannel, durable: DurableTopics) -> Sink:
        """What keeps messages, and sends them when they are on disk."""
        rewrite = self._site.frames.outgoing(info)
        keep = durable.sender(channel, self._send(channel, None, forced=True), self.stored.of(info))
        return lambda body, stamp_ns: keep(body if rewrite is None else rewrite(body), stamp_ns, None)

    def _reckoned(self, info: TopicInfo, sink: Sink) -> Sink:
        from sern_client.reckoned import ReckonedPoses  # who does not ask for it need not load it

        def kept() -> None:
            self.reckoned += 1

        return ReckonedPoses(info.name, info.encoding, sink, kept).sink

    def _sender(self, channel: OutChannel, info: TopicInfo) -> Send:
        """What puts bodies of the type `info` into a channel; for topics of which something else is made."""
        return self._send(channel, self._site.frames.outgoing(info))

    def _send(
        self, channel: OutChannel, rewrite: Rewrite | None, *, forced: bool = False
    ) -> Callable[[bytes, int, float | None], bool]:
        core, kick, log, stream, parts = self._core, self._site.kick, self._site.log, channel.stream, self._site.parts
        passed, taps = self._site.values.passed, self._taps

        def send(body: bytes, stamp_ns: int, born_s: float | None) -> bool:
            seq, offered = channel.next_seq, body
            if rewrite is not None:
                body = rewrite(body)
            accepted = core.send(channel, body, stamp_ns, born_s=born_s, now=clock.now(), forced=forced)
            if accepted:
                passed(stream, seq, body)
                if taps is not None:
                    taps.sent(stream.id, seq, offered, body)
            if log is not None:
                try:
                    log.offered(stream, seq, body, stamp_ns, accepted=accepted)
                except Exception as error:  # noqa: BLE001  (of the log alone)
                    parts.failed("message_log", error)
            kick()
            return accepted

        return send

    # --- from the core ----------------------------------------------------------------------------------------------

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        """Whether anybody at the far side wants a stream of ours."""
        if wanted:
            self.refused.pop(stream.id.topic, None)
        outgoing = self._by_stream.get(stream.id)
        if outgoing is None:
            return
        endpoint, source = self._site.endpoint, outgoing.source
        kept = self._taps is not None and self._taps.taken(outgoing.channel.stream.id)  # whoever wants it
        if source is None:
            endpoint.interest(outgoing.name, wanted or kept)
            return
        if wanted:
            source.audience_changed()
        endpoint.interest(outgoing.name, source.wanted or kept)

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        """Messages of ours were dropped, as `ClientEvents` says: log what somebody wanted."""
        outgoing = self._by_stream.get(stream.id)
        if outgoing is not None and outgoing.source is not None:
            outgoing.source.lost(stream.id)
        if self._goals is not None:
            self._goals.send_dropped(stream.id, first, count, reason)
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
        """The relay does not take a stream of ours."""
        self.refusals += 1
        topic = stream.id.topic
        if len(self.refused) < MAX_TOPICS:
            self.refused[topic] = text
        words = "the relay refuses %s (%s): %s"
        self._site.events.say(_log, logging.ERROR, "denied", topic, words, topic, code, text, code=code)

    # --- consistency ------------------------------------------------------------------------------------------------

    @property
    def held(self) -> Counter[TopicName]:
        """Our subscriptions at the endpoint, by local name."""
        return Counter(self._topics.keys())

    def validate(self) -> list[Difference]:
        """Compare our table with the core's: what is not as it should be."""
        return [
            Difference(name, CLOSED)
            for name, outgoing in self._topics.items()
            if outgoing.channel.stream.id not in self._core.link.outgoing.by_stream
        ]

    def repair(self, names: Collection[TopicName]) -> None:
        """Take these topics from the endpoint anew."""
        for name in names:
            outgoing = self._topics.get(name)
            if outgoing is not None:
                outgoing.subscription.close()
                try:
                    outgoing.subscription = self._site.endpoint.subscribe(name, outgoing.entry.take)
                except UsageError as error:
                    _log.error("%s cannot be taken again: %s", name, error)
                    self.topic_removed(name)
