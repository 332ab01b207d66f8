"""Offers an endpoint's topics to the link: discovery, rules, names, and what is made of their messages before."""

import logging
from collections import Counter
from collections.abc import Callable, Collection, KeysView
from dataclasses import replace
from typing import Final

from sern_client.actions import GoalWatch
from sern_client.durable import DurableTopics
from sern_client.endpoints.base import Difference, Sink, Subscription
from sern_client.frames import Rewrite
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
from sern_core.topics.rules import Discovery, ResolvedTopic
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.names import to_global
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, Encoding, TopicName
from sern_runtime import clock

CLOSED: Final = "it is offered to nobody: its channel is closed"

_log = logging.getLogger(__name__)


class Outgoing:
    """A local topic that is offered to the link; `source` makes something else of it before. Its messages go to
    `sink`."""

    __slots__ = ("channel", "name", "sink", "source", "subscription")

    def __init__(
        self, name: TopicName, channel: OutChannel, subscription: Subscription, source: Source | None, sink: Sink
    ) -> None:
        self.name = name
        self.channel = channel
        self.sink = sink
        self.subscription = subscription
        self.source = source

    @property
    def streams(self) -> set[StreamId]:
        """All that its messages go to, in whatever form."""
        own = {self.channel.stream.id}
        return own if self.source is None else own | self.source.streams


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
        self._topics: dict[TopicName, Outgoing] = {}
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
        self.summaries.close()
        self.stored.close_all()
        self._topics.clear()
        self._by_stream.clear()
        self.leaving.close()

    # --- TopicEvents: from the endpoint -----------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        if info.name in self._topics or self._stopped:
            return
        self.leaving.come_back(info.name)
        rules = self._site.rules
        listed = rules.find(info.type_name, info.name) is not None
        if not self._discovery.wants(info.name, info.type_name, listed=listed):
            if self._discovery.wants(info.name, info.type_name, listed=True):  # only a rule is missing
                self._say_unnamed(info)
            return
        try:
            resolved = rules.resolve(info, local_name=info.name)
        except ConfigError as error:
            _log.error("%s", error)
            return
        if not resolved.direction.sends:
            return
        name = to_global(resolved.name, self._site.namespace)
        try:
            channel, source = self._offer(info, resolved, name)
        except UsageError as error:
            _log.error("%s cannot be offered as %s: %s", info.name, name, error)
            return
        if self._durable is not None and resolved.spec.durable:
            sink = self._kept(info, channel, self._durable)
        else:
            sink = self._sink(channel, self._site.frames.outgoing(info)) if source is None else source.sink
        if resolved.dead_reckoning and source is None and info.encoding is not Encoding.RAW:
            sink = self._reckoned(info, sink)
        if self._goals is not None:
            sink = self._goals.outgoing(info, channel, sink)
        if self._spooled(info.name, resolved, info.encoding) and self._taps is not None:
            sink = self._taps.open(channel, self._site.frames.outgoing(info), sink)
        try:
            subscription = self._site.endpoint.subscribe(info.name, sink)
        except UsageError as error:
            _log.error("%s cannot be taken: %s", info.name, error)
            self._withdraw(channel, source)
            return
        outgoing = self._topics[info.name] = Outgoing(info.name, channel, subscription, source, sink)
        self._by_stream.update(dict.fromkeys(outgoing.streams, outgoing))
        _log.info(
            "offering %s (%s) as %s: class %s, %s", info.name, info.type_name, name,
            CLASS_LABELS[channel.spec.priority], "reliable" if channel.spec.reliable else "best effort",
        )  # fmt: skip
        self._site.kick()

    def topic_removed(self, name: TopicName) -> None:
        outgoing = self._topics.pop(name, None)
        if outgoing is not None:
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

    def _sink(self, channel: OutChannel, rewrite: Rewrite | None) -> Sink:
        send = self._send(channel, rewrite)
        return lambda body, stamp_ns: send(body, stamp_ns, None)

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
                    outgoing.subscription = self._site.endpoint.subscribe(name, outgoing.sink)
                except UsageError as error:
                    _log.error("%s cannot be taken again: %s", name, error)
                    self.topic_removed(name)
