"""Publishes streams from elsewhere at the endpoint: names, rebuilt grids, what is kept. Commands: commands.py."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Collection, KeysView, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from typing import Final

from sern_client.actions import GoalWatch
from sern_client.commands import Commands
from sern_client.e_stop import EStops
from sern_client.endpoints.base import Difference, Publisher, keepers_of, publisher_within, teller_of_age
from sern_client.frames import Rewrite
from sern_client.guard import Guard
from sern_client.keeping import Keeping
from sern_client.rebuild import Rebuilds
from sern_client.site import Site
from sern_client.spool.fetching import SpoolFetching
from sern_client.subscribed import Subscribed
from sern_client.update_topics import UpdateTopics
from sern_client.withdrawal import Kept, Withdrawable, Withdrawal
from sern_core.site.client import ClientCore
from sern_core.site.services import parse as parse_service
from sern_core.topics.rules import ResolvedTopic
from sern_core.topics.spool_names import parse as parse_spooled
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.ledger import MAX_TOPICS, OTHER_TOPIC
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, DropReason, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.link_metrics import AgeHistograms
from sern_runtime.loop import Timer

MAX_PROBLEMS: Final = 256
AGAIN_S: Final = (1.0, 60.0)
"""First and longest pause before a stream that could not be published here is tried again."""

_log = logging.getLogger(__name__)


class Incoming:
    """A stream from elsewhere that is published here, as `info`. `publisher` None: it is of use to another stream only.
    `commands`: it has a lease."""

    __slots__ = (
        "aged",
        "commands",
        "info",
        "kept",
        "local",
        "publish",
        "publisher",
        "resolved",
        "rewrite",
        "withdrawn",
    )

    def __init__(
        self,
        info: TopicInfo,
        resolved: ResolvedTopic,
        publisher: Publisher | None,
        rewrite: Rewrite | None,
        *,
        commands: bool,
        kept: Kept | None,
    ) -> None:
        self.info = info
        self.local = info.name
        self.resolved = resolved
        self.use(publisher)
        self.rewrite = rewrite
        self.commands = commands
        self.kept = kept
        self.withdrawn: ClientName | None = None

    def use(self, publisher: Publisher | None) -> None:
        self.publisher = publisher
        self.publish = None if publisher is None else publisher_within(publisher)
        self.aged = None if publisher is None else teller_of_age(publisher)


class Inbound:
    """Is told by the core of streams from elsewhere, those of services excepted.

    `guard` publishes stop commands while this process cannot. `goals`: those of ROS 1 that this site gives to others.
    `withdraws`: topics of an origin that is not there may be ended (`withdrawal`), so what is latched in them is kept.
    `fetching`: what fetches what did not come; it must know what did.
    """

    def __init__(
        self,
        site: Site,
        core: ClientCore,
        *,
        guard: Guard | None = None,
        goals: GoalWatch | None = None,
        withdraws: bool = False,
        fetching: SpoolFetching | None = None,
    ) -> None:
        self.ages = AgeHistograms()
        self.subscription_problems: dict[str, str] = {}
        """What the relay does not let us have, in its words, with the code."""
        self.deadlines_missed: dict[TopicName, int] = {}
        self.publish_failures = 0
        self.e_stops: EStops | None = None
        """What is to be told of every message; None: this site has no e-stop."""
        self.elsewhere: Callable[[TopicName], bool] = lambda _name: False
        """Whether a topic is not published here but taken by another part."""
        self.commands = Commands(site, core, guard)
        """Those that are published here, and what is said when they stay away."""
        self._site = site
        self._core = core
        self._goals = goals
        self._fetching = fetching
        self._closed = False
        self._streams: dict[StreamId, Incoming] = {}
        self.withdrawal = Withdrawal(self._streams, self._advertise, self._close_publisher, used=withdraws)
        """Ends the topics of who is not there."""
        self._last_arrival_s: dict[StreamId, float] = {}
        self._unreceived: dict[StreamId, str] = {}  # streams that could not be published here, and why
        self._again = Timer(self._reconsider)
        self._again_s = AGAIN_S[0]
        self.rebuilds = Rebuilds(self._grid_shown, self._settle)
        self.subscribed = Subscribed(self._subscribe)
        """What the relay is asked for."""
        self._updates = UpdateTopics(self.subscribed.covers, partial(self.subscribed.add, "updates"))
        self.keeping = Keeping(keepers_of(site.endpoint), core.hold, self._release_kept, self._keep_in)
        self._keep_timer = Timer(self.keeping.keep_soon)

    @property
    def streams(self) -> KeysView[StreamId]:
        """Every stream that is taken here."""
        return self._streams.keys()

    def close(self) -> None:
        """Call this before the endpoint is stopped: it tells a robot that is being commanded to stand still."""
        self._closed = True
        self._keep_timer.cancel()
        self._again.cancel()
        self.rebuilds.close()
        self._updates.close()
        self.commands.close()
        for incoming in self._streams.values():
            self._close_publisher(incoming)
        self._streams.clear()

    # --- streams begin and end --------------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo) -> None:
        """Publish a stream here from now on. Raises ConfigError if that cannot be; it is tried again then."""
        local = self._site.rules.inward(stream.id.topic, namespace=self._site.namespace)
        info = replace(stream.info, name=local)
        try:
            resolved = self._site.rules.resolve(info, local_name=local)
            if not resolved.direction.receives:
                raise ConfigError(f"{local} is only sent from here (direction: send); not received")
            publisher = None
            if self._published_here(stream):
                publisher = self._advertise(info)
        except ConfigError as error:
            self._not_received(stream, str(error))
            raise
        self._unreceived.pop(stream.id, None)
        stop = None
        if resolved.lease is not None:
            stop = ros_types.zero_message(info.type_name, info.encoding)
            if stop is None:
                _log.error("%s is %s: on_link_loss cannot stop it; no lease", local, info.type_name)
        rewrite, kept = self._site.frames.incoming(info), self.withdrawal.kept(stream)
        incoming = Incoming(info, resolved, publisher, rewrite, commands=stop is not None, kept=kept)
        self._streams[stream.id] = incoming
        if resolved.lease is not None and stop is not None:
            self.commands.opened(
                stream.id, info, resolved.lease, stop,
                publish=partial(self._publish, incoming), close=partial(self._close_publisher, incoming),
            )  # fmt: skip
        if self._goals is not None:
            self._goals.opened(info, lambda body: self._publish(incoming, body, time.time_ns()))
        updates = self.rebuilds.opened(stream, lambda body, stamp_ns: self._show(incoming, body, stamp_ns))
        if updates is not None:
            self._updates.opened(stream.id, updates)
        _log.info("receiving %s from %s as %s", stream.id.topic, stream.id.origin, local)

    def stream_closed(self, stream: StreamInfo) -> None:
        """A stream, taken here or not, has ended."""
        self.rebuilds.closed(stream)
        self._updates.closed(stream.id)
        if self._core.refused and not self._closed:  # it may have been in their way
            self._again_s = AGAIN_S[0]
            self._again.arm(clock.now())
        incoming = self._streams.pop(stream.id, None)
        self._site.values.forget(stream.id)
        self._last_arrival_s.pop(stream.id, None)
        if incoming is not None:
            if self._goals is not None:
                self._goals.ended(incoming.local)
            if not self.commands.ended(stream.id, incoming.local):
                self._close_publisher(incoming)
            _log.info("%s from %s has ended", stream.id.topic, stream.id.origin)

    def rules_changed(self) -> None:
        """The site has other rules: publish those streams anew for which they say something else here."""
        rules, namespace = self._site.rules, self._site.namespace
        changed = set()
        for identity, incoming in self._streams.items():
            local = rules.inward(identity.topic, namespace=namespace)
            try:
                resolved = rules.resolve(replace(incoming.info, name=local), local_name=local)
            except ConfigError:
                changed.add(identity)  # why is said when it is opened
                continue
            said, before = (resolved.lease, resolved.direction), (incoming.resolved.lease, incoming.resolved.direction)
            if local != incoming.local or said != before:
                changed.add(identity)
        self._core.reopen(changed, now=clock.now())
        self._reconsider()

    def _advertise(self, info: TopicInfo) -> Publisher:
        """ConfigError whatever goes wrong: the streams beside it must go on."""
        try:
            return self._site.advertise(info)
        except ConfigError:
            raise
        except Exception as error:
            self.publish_failures += 1
            _log.exception("%s cannot be published here", info.name)
            raise ConfigError(f"{info.name}: cannot be published here: {ros_types.one_line(error)}") from error

    def _published_here(self, stream: StreamInfo) -> bool:
        """Whether a stream is published: updates of patches are taken to make whole grids of them, unless somebody here
        has asked for them."""
        return not self.rebuilds.is_updates(stream) or self._updates.of_site(stream.id.topic)

    def _not_received(self, stream: StreamInfo, problem: str) -> None:
        """Said once; tried again, because what is in its way may go: another stream of that name, for one."""
        if self._unreceived.get(stream.id) != problem:
            _log.error("%s from %s is not received: %s", stream.id.topic, stream.id.origin, problem)
        self._unreceived[stream.id] = problem
        if self._again.deadline_s is None and not self._closed:
            self._again.arm(clock.now() + self._again_s)

    def _reconsider(self) -> None:
        refused = self._core.refused
        self._unreceived = {stream: problem for stream, problem in self._unreceived.items() if stream in refused}
        self._again_s = min(2 * self._again_s, AGAIN_S[1])
        self._core.reconsider(now=clock.now())
        self._site.kick()

    def _subscribe(self, patterns: tuple[str, ...]) -> None:
        self._core.subscribe(patterns, now=clock.now())
        self._site.kick()

    def _close_publisher(self, incoming: Withdrawable) -> None:
        if incoming.publisher is not None:
            try:
                incoming.publisher.close()
            except Exception:  # noqa: BLE001  a fault of one topic, as in `_publish`
                self.publish_failures += 1
                _log.exception("%s could not be ended here", incoming.info.name)

    # --- messages ---------------------------------------------------------------------------------------------------

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> DropReason | None:
        """A message of one of our `streams` has its turn. Returns why it is not published; None: it was."""
        incoming = self._streams[stream.id]
        refused = self.commands.refuses(stream.id, incoming.local, born_s=message.born_s, now=now)
        if refused is not None:
            return refused
        if self.e_stops is not None:
            self.e_stops.heard(incoming.info, message.body, where=stream.id.origin)
        self._site.values.passed(stream, message.seq, message.body)
        age_s = now - message.born_s
        if incoming.commands:
            self.commands.renew(stream.id, self._local(incoming, message.body), born_s=message.born_s, now=now)
        mark = self.keeping.mark() if stream.spec.reliable and self.keeping else None
        fetched = None if self._fetching is None else self._fetching.mark(stream.id)
        if not self.rebuilds.message(stream, message, owed=mark is not None):
            lifespan_s = stream.spec.lifespan_s
            left_s = inf if lifespan_s is None else max(lifespan_s - age_s, 0.0)
            if incoming.aged is not None:
                incoming.aged(age_s)
            self._show(incoming, message.body, message.stamp_ns, left_s)
        if fetched is not None and self._fetching is not None:
            self._fetching.published(stream.id, message.seq, fetched)
        if mark is None:
            pass
        elif self.rebuilds.owes(stream, message.seq):
            self._core.hold(stream.id, message.seq)
        else:
            self.keeping.published(stream.id, message.seq, mark)
        if self._goals is not None:
            self._goals.message(incoming.local, stream.info.encoding, message.body)
        try:
            self.ages.observe(stream.spec.priority, age_s)
            if stream.spec.deadline_s is not None:
                self._check_deadline(stream, now)
        except Exception as error:  # noqa: BLE001  (of what is counted alone)
            self._site.parts.failed("metrics", error)
        try:
            if self._site.log is not None:
                self._site.log.delivered(stream, message, age_s)
        except Exception as error:  # noqa: BLE001  (of the log alone)
            self._site.parts.failed("message_log", error)
        return None

    def _show(self, incoming: Incoming, body: bytes, stamp_ns: int, left_s: float = inf) -> None:
        """Publish what came, or was put together here."""
        body = self._local(incoming, body)
        self._publish(incoming, body, stamp_ns, left_s)
        if incoming.kept is not None:
            incoming.kept.append((body, stamp_ns))

    def _local(self, incoming: Incoming, body: bytes) -> bytes:
        """What came, with the frame ids of this site."""
        if incoming.rewrite is None:
            return body
        try:
            return incoming.rewrite(body)
        except Exception as error:  # noqa: BLE001  (as it came is better than not at all)
            self._site.parts.failed("frames", error)
            return body

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

    def _check_deadline(self, stream: StreamInfo, now: float) -> None:
        last_s = self._last_arrival_s.get(stream.id)
        self._last_arrival_s[stream.id] = now
        deadline_s = stream.spec.deadline_s
        if deadline_s is None:
            return
        topic = stream.id.topic
        known = topic in self.deadlines_missed or len(self.deadlines_missed) < MAX_TOPICS
        missed = last_s is not None and now - last_s > deadline_s
        counted = topic if known else OTHER_TOPIC
        self.deadlines_missed[counted] = self.deadlines_missed.get(counted, 0) + missed  # 0 at first, for the metric
        if last_s is not None and missed:
            _log.warning("%s: %.3f s between messages, deadline %.3f s", topic, now - last_s, deadline_s)

    # --- what is confirmed later ------------------------------------------------------------------------------------

    def _grid_shown(self, publish: Callable[[], None], owed: Sequence[tuple[StreamId, int]]) -> None:
        """Publish a grid; the updates in it are kept when it is."""
        mark = self.keeping.mark()
        publish()
        self._settle([(stream, seq) for stream, seq in owed if not self.keeping.published(stream, seq, mark)])

    def _settle(self, owed: Sequence[tuple[StreamId, int]]) -> None:
        for stream, seq in owed:
            self._core.release(stream, seq, now=clock.now())

    def _keep_in(self, delay_s: float) -> None:
        self._keep_timer.arm(clock.now() + delay_s)

    def _release_kept(self, stream: StreamId, seq: int, lost: DropReason | None) -> None:
        self._core.release(stream, seq, lost=lost, now=clock.now())
        self._site.kick()

    # --- what is said of streams from elsewhere ---------------------------------------------------------------------

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        """A reliable message was dropped on its way here."""
        if self._site.log is not None:
            self._site.log.expired(stream, seq, reason)
        _log.warning("%s: reliable message %d was dropped on its way: %s", stream.id.topic, seq, reason)

    def skipped(self, stream: StreamInfo, count: int) -> None:
        """Reliable messages were given up before this site was told of their stream again."""
        _log.warning("%s: %d reliable messages were given up while we were away", stream.id.topic, count)

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        """The body of a message could not be decoded."""
        _log.error("%s from %s cannot be decoded and is dropped: %s", stream.id.topic, stream.id.origin, problem)

    def subscription_refused(self, code: str, text: str) -> None:
        """The relay does not let us have something that we asked for. Said once, as it is told in every session."""
        if text not in self.subscription_problems:
            words = "the relay refuses a subscription (%s): %s"
            self._site.events.say(_log, logging.ERROR, "denied", "", words, code, text, code=code)
            if len(self.subscription_problems) < MAX_PROBLEMS:
                self.subscription_problems[text] = code

    # --- consistency ------------------------------------------------------------------------------------------------

    @property
    def held(self) -> Counter[TopicName]:
        """Our publishers at the endpoint, by local name."""
        held = Counter(incoming.local for incoming in self._streams.values() if incoming.publisher is not None)
        held.update(self.commands.ending)
        return held

    def validate(self) -> list[Difference]:
        """Compare our table with the core's: what is not as it should be."""
        opened = {stream for stream in self._core.opened if parse_service(stream.topic) is None}
        opened = {stream for stream in opened if parse_spooled(stream.topic) is None}
        streams = {stream for stream in opened if not self.elsewhere(stream.topic)}
        halves = (("the core", streams - self._streams.keys()), ("the bridge", self._streams.keys() - streams))
        return [
            Difference(stream.topic, f"a stream of {stream.origin} is open in {where} only")
            for where, only_there in halves
            for stream in sorted(only_there)
        ]

    def repair(self, names: Collection[TopicName]) -> None:
        """Publish these topics at the endpoint anew."""
        for name in names:
            for incoming in [each for each in self._streams.values() if each.local == name]:
                if incoming.publisher is not None:
                    self._close_publisher(incoming)
                    try:
                        incoming.use(self._advertise(incoming.info))
                    except ConfigError as error:
                        _log.error("%s cannot be published again: %s", name, error)
