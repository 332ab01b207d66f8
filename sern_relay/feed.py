"""The relay's plain feed: what the clients' streams carry, for any ZeroMQ program on the local network, and back.

What a program publishes goes to the feed's own subscribers. Where the role says what the topic is (`types`), it is also
a stream of the relay like any client's: it owns its name, obeys lifespan and access rules, and reaches clients and the
object registry. Its name is taken with the first message and given back after `IDLE_S` of silence, as a publisher of
plain ZeroMQ does not say that it has gone.

Topics of the clients of other relays are known by their objects. Those that a subscriber wants, and its role may see,
are asked for by name, or, where they are very many, by the roles' patterns.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Final

import zmq

from sern_core.relay.hub import Hub
from sern_core.relay.hub_events import Relayed
from sern_core.topics.rules import FeedRole, FeedTopic, RuleSet
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, Durability, PriorityClass, TopicName
from sern_runtime import ros_types
from sern_runtime.clock import now
from sern_runtime.feed import Feed, FeedHeader

IDLE_S: Final = 30.0
INTEREST_STREAMS: Final = 200
"""Streams whose origins are told in one go what the feed wants now; about 2 ms."""
MOST_FAR: Final = 256
"""Topics of other relays that are asked for by name. Where more are wanted, all are asked for that the roles may see:
those that nobody wants are announced then, and not sent."""
INTEREST_REST_S: Final = 0.004
"""Between two such goes: the others in the loop get their turn."""
MAX_TOLD: Final = 1024
"""Lines about topics that are logged once each."""

_log = logging.getLogger(__name__)

OnRefused = Callable[[ClientName, str, str], None]


@dataclass(slots=True)
class InjectCounters:
    """What became of messages that a role published and the feed accepted, from start on."""

    injected: int = 0  # went on to the clients
    untyped: int = 0  # stayed within the feed: no entry in `types`
    dropped: int = 0  # too old, or a reliable queue was full; the topic's counters say which
    refused: int = 0  # times a name was refused: its owner is another, or access rules forbid it


@dataclass(slots=True)
class _Source:
    """A topic that a role publishes now."""

    handle: Relayed
    topic: FeedTopic
    last_s: float

    @property
    def latched(self) -> bool:
        return self.topic.rule.durability is Durability.TRANSIENT_LOCAL


class RelayFeed:
    """Publishes what passes the hub to the roles that may see it, and makes their interest the hub's.

    A subscriber of the feed is a subscriber like any other: without one the robot need not send the stream.
    `refused` is told of names that a role may not have; `after` is called when something came in.
    """

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        hub: Hub,
        roles: tuple[FeedRole, ...],
        *,
        after: Callable[[], None],
        refused: OnRefused,
        clock: Callable[[], float] = now,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._hub = hub
        self._after = after
        self._refused = refused
        self._clock = clock
        self._wall_ns = wall_ns
        self._sources: dict[tuple[str, TopicName], _Source] = {}
        self._roles = roles
        self._told: set[tuple[str, TopicName, str]] = set()
        self._untold: list[StreamId] = []  # whose origins have yet to hear of what the feed wants
        self._going_on: asyncio.TimerHandle | None = None
        self._again = False  # it has changed since then
        self._far = hub.exchange.peers.far
        self._far.on_topic = self._far_topic
        self._far_wanted: set[TopicName] = set()  # topics of clients of other relays
        self._unlooked: dict[TopicName, None] = {}  # of those, to be looked at
        hub.peers.also = self._far_asked
        self.counters: dict[str, InjectCounters] = {role.name: InjectCounters() for role in roles}
        hub.local_owners.update(role.owner for role in roles if role.ingest_endpoint is not None)
        self.feed = Feed(ctx, roles, on_publish=self._published, on_interest=self._interest, accept=self._may_own)
        hub.streams.tap = self._wants

    def close(self) -> None:
        if self._going_on is not None:
            self._going_on.cancel()
            self._going_on = None
        self._hub.streams.tap = lambda _stream: False
        self._hub.peers.also = tuple
        self._far.on_topic = lambda _topic: None
        self.feed.close()

    def open_missing(self) -> bool:
        """Try again for endpoints that could not be had; returns whether there are none left."""
        return self.feed.open_missing() is None

    @property
    def over(self) -> bool:
        """Whether it has no role any more, and the origins have been told."""
        return not self._roles and self._going_on is None

    def update(self, roles: tuple[FeedRole, ...], *, now: float) -> None:
        """Make these the roles, end what they no longer say, and tell the origins what is wanted now. Raises
        ConfigError (see `Feed.update`)."""
        for role in roles:
            self.counters.setdefault(role.name, InjectCounters())
        self._hub.local_owners.update(role.owner for role in roles if role.ingest_endpoint is not None)
        self._roles = roles
        known = {role.name: role for role in roles}
        for (role_name, name), source in self._sources.items():
            current = known.get(role_name)
            if current is None or current.topic(name) != source.topic:
                self._hub.local.close(source.handle, now=now)  # with its next message it opens anew, if it may
        try:
            self.feed.update(roles)
        finally:
            self._interest()  # who subscribes is as before, and what that comes to is not

    def publish(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """Send it to the roles' subscribers. They have had what came in through the feed itself."""
        if stream.id.origin in self._hub.local_owners:
            return
        age_us = max(0, int((now - message.born_s) * 1e6))
        header = FeedHeader(stream.spec.priority, message.seq, message.stamp_ns, age_us)
        self.feed.publish(stream.id.topic, header, message.body)

    def results(self) -> Iterator[tuple[tuple[str, str], int]]:
        """(role, what became of messages) and how many, for metrics."""
        for name, fed in self.feed.counters().items():
            injected = self.counters[name]
            for result, count in (
                ("sent", fed.sent),
                ("received", fed.received),
                ("forbidden", fed.forbidden),
                ("malformed", fed.malformed),
                ("limited", fed.limited),
                ("endless", fed.endless),
                ("capped", fed.capped),
                ("crowded", fed.crowded),
                ("injected", injected.injected),
                ("untyped", injected.untyped),
                ("dropped", injected.dropped),
            ):
                yield (name, result), count

    def owners_changed(self) -> None:
        """A stream came or went: who may publish what is asked anew."""
        self.feed.refresh()

    def sweep(self, *, now: float) -> None:
        """Give back the names of topics that have gone quiet. Call about once a second."""
        for key, source in list(self._sources.items()):
            if not source.latched and now - source.last_s > IDLE_S:
                self._hub.local.close(source.handle, now=now)
            if not self._hub.local.is_open(source.handle):
                self._sources.pop(key, None)

    def _wants(self, stream: StreamInfo) -> bool:
        return self.feed.wants(stream.id.topic)

    def _interest(self) -> None:
        """What the feed wants has changed: the origins are told, in slices. One pass ends before the next begins, so
        that no stream is never reached; what is announced meanwhile is told by itself."""
        if self._going_on is not None:
            self._again = True
            return
        self._untold = list(self._hub.relayed)
        self._unlooked = dict.fromkeys(self._far.topics)
        self._tell_origins()

    def _far_asked(self) -> Collection[str]:
        if len(self._far_wanted) <= MOST_FAR:
            return self._far_wanted
        return {pattern.pattern for role in self._roles for pattern in role.subscribe}

    def _far_topic(self, topic: TopicName) -> None:
        """A topic of other relays has come or gone."""
        self._unlooked[topic] = None
        if self._going_on is None:
            self._going_on = asyncio.get_running_loop().call_later(INTEREST_REST_S, self._tell_origins)

    def _tell_origins(self) -> None:
        told = [self._untold.pop() for _ in range(min(INTEREST_STREAMS, len(self._untold)))]
        for _ in range(min(INTEREST_STREAMS, len(self._unlooked))):
            name, _ = self._unlooked.popitem()
            wanted = name in self._far.topics and self.feed.wants(name)
            (self._far_wanted.add if wanted else self._far_wanted.discard)(name)
        more = bool(self._untold or self._unlooked)
        if not more and self._again:
            self._again, more = False, True
            self._untold = list(self._hub.relayed)
            self._unlooked = dict.fromkeys(self._far.topics)
        loop = asyncio.get_running_loop()
        self._going_on = loop.call_later(INTEREST_REST_S, self._tell_origins) if more else None
        self._hub.streams.refresh_interest(told, now=self._clock())
        self._after()

    def _may_own(self, role: FeedRole, name: TopicName) -> bool:
        """A name that a client owns is not published by the feed as well; what has a type takes the name now."""
        if not role.may_publish(name, PriorityClass.BULK):
            return False  # in no class at all
        topic = role.topic(name)
        if topic is not None:
            return self._source(role, name, topic) is not None
        owners = self._hub.routing.owners(name)
        if owners:
            self._refuse(role, name, "name_taken", f"{role.owner} may not publish {name}: {owners[0]} owns that name")
        return not owners

    def _source(self, role: FeedRole, name: TopicName, topic: FeedTopic) -> _Source | None:
        """The stream of this topic, opened when there is none; None: refused."""
        key = (role.name, name)
        source = self._sources.get(key)
        if source is not None and self._hub.local.is_open(source.handle):
            return source
        latched = topic.rule.durability is Durability.TRANSIENT_LOCAL
        info = ros_types.topic_info(name, topic.type_name, topic.encoding, latched=latched)
        spec = RuleSet((topic.rule,)).resolve(info, local_name=name).spec
        now = self._clock()
        try:
            handle = self._hub.local.open(info, spec, role.owner, now=now)
        except RefusedError as refusal:
            self._refuse(role, name, refusal.code, str(refusal))
            return None
        source = self._sources[key] = _Source(handle, topic, now)
        self._after()
        return source

    def _refuse(self, role: FeedRole, name: TopicName, code: str, text: str) -> None:
        self.counters[role.name].refused += 1
        if self._first(role, name, code):
            self._refused(role.owner, code, text)

    def _first(self, role: FeedRole, name: TopicName, what: str) -> bool:
        """Whether this is to be said: once for each topic, and not for any number of them."""
        key = (role.name, name, what)
        if key in self._told or len(self._told) >= MAX_TOLD:
            return False
        self._told.add(key)
        return True

    def _published(self, role: FeedRole, name: TopicName, header: FeedHeader, body: bytes) -> None:
        """A message came in; the feed's own subscribers have it."""
        counters = self.counters[role.name]
        topic = role.topic(name)
        if topic is None:
            counters.untyped += 1
            if self._first(role, name, "untyped"):
                _log.info("%s of feed role %s has no entry in types: it stays within the feed", name, role.name)
            return
        source = self._source(role, name, topic)
        if source is None:
            counters.dropped += 1
            return
        now = self._clock()
        wall_ns = self._wall_ns()
        age_s = header.age_us * 1e-6
        if header.stamp_ns > 0:  # 0: the publisher does not say when
            age_s = max(age_s, (wall_ns - header.stamp_ns) * 1e-9)
        source.last_s = now
        stamp_ns = header.stamp_ns if header.stamp_ns > 0 else wall_ns
        if self._hub.local.inject(source.handle, body, stamp_ns, now=now, age_s=age_s):
            counters.injected += 1
            self._after()
            return
        counters.dropped += 1
        lifespan_s = source.handle.stream.lifespan_s
        if lifespan_s is not None and age_s > lifespan_s and self._first(role, name, "old"):
            _log.warning(
                "%s of feed role %s was %.3f s old, lifespan %.3f s: dropped; where its clock is not ours, a publisher "
                "leaves the stamp 0",
                name, role.name, age_s, lifespan_s,
            )  # fmt: skip
