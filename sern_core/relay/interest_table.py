"""What clients want, matched with the global names that there are, and who gets which stream for it. Pure.

- Patterns are matched once per (client, global name), whatever the number of streams and messages under that name, and
  only against names that the client may subscribe to.
- A new name is matched at once: it costs at most `MAX_CLIENT_PROGRAM` steps a character and client. A new interest,
  which has all names before it, is worked out in slices: while `unfinished`, call `go_on`. Until a name's turn has come
  it stays as it was; what a client may no longer have is taken away at once.
- A subscriber of a name gets the streams under it that `StreamRights.gets` lets it have.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable

from sern_core.relay.access import AccessTable
from sern_core.relay.interest import (
    COMPILE_UNITS,
    NAME_UNITS,
    PEER_TIMES,
    ROUTE_UNITS,
    Interest,
    RoutingLimits,
    Topic,
    WorkMeter,
    refused,
)
from sern_core.relay.route_change import Denied, RouteChange, RouteCollector
from sern_core.relay.stream_rights import StreamRights
from sern_core.topics.patterns import PatternError, PatternSet
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName


class InterestTable:
    """The half of the routing table that knows who wants what. `spent` counts what a call costs: `subscribe`, `also`
    and `go_on` begin it anew, the others add to it."""

    def __init__(self, rights: StreamRights, limits: RoutingLimits, spent: WorkMeter) -> None:
        self._rights = rights
        self._limits = limits
        self._spent = spent
        self.topics: dict[TopicName, Topic] = {}
        """The global names that have a stream; others only read it."""
        self.routes: dict[StreamId, tuple[ClientName, ...]] = {}
        """Who gets each stream, sorted; others only read it."""
        self._interests: dict[ClientName, Interest] = {}
        self._texts: tuple[str, ...] | None = None  # see `texts`; None: to be worked out
        self.route_units: Callable[[StreamId], int] = lambda _stream: 0
        """What a new route of a stream costs beside `ROUTE_UNITS`; set by the owner."""

    # Look-ups --------------------------------------------------------------------------------------------------------

    def received_by(self, client: ClientName) -> tuple[StreamId, ...]:
        """The streams that the client receives, sorted."""
        interest = self._interests.get(client)
        topics = interest.topics if interest is not None else set()
        return tuple(
            sorted(
                stream
                for topic in topics
                for stream in self.topics[topic].streams.values()
                if self._rights.gets(client, stream)
            )
        )

    def takes(self, client: ClientName, topic: TopicName) -> bool:
        """Whether the client wants the global name and may have it, whether or not there is such a stream."""
        interest = self._interests.get(client)
        return interest is not None and self._rights.may_have(client, topic) and interest.wants(topic)

    def pairs(self) -> set[tuple[ClientName, TopicName]]:
        """Every (client, topic) of which the client wants the topic and may have it."""
        return {(client, topic) for client, interest in self._interests.items() for topic in interest.topics}

    def texts(self) -> tuple[str, ...]:
        """The patterns and names that clients want, peers excepted, each once. The same object as long as nothing has
        changed."""
        if self._texts is not None:
            return self._texts
        wanting = [interest for client, interest in self._interests.items() if client not in self._rights.peers]
        patterns = {text for interest in wanting for text in interest.patterns.texts}
        names = {name for interest in wanting for name in interest.exact}
        self._texts = (*sorted(patterns), *sorted(names - patterns))
        return self._texts

    def unfinished(self, client: ClientName) -> bool:
        """Whether there are names that the client's interest was not matched with yet: call `go_on`."""
        interest = self._interests.get(client)
        return interest is not None and bool(interest.left)

    # What clients want -----------------------------------------------------------------------------------------------

    def subscribe(self, client: ClientName, patterns: Iterable[str], exact: Iterable[TopicName]) -> RouteChange:
        """Replace what the client wants. Raises RefusedError; then the earlier interest stays."""
        self._spent.units = NAME_UNITS
        texts = tuple(dict.fromkeys(patterns))
        names = set(exact)
        many = PEER_TIMES if client in self._rights.peers else 1
        if len(texts) > many * self._limits.max_patterns or len(names) > many * self._limits.max_exact:
            raise RefusedError(
                "too_many_patterns",
                f"{client} asks for {len(texts)} patterns and {len(names)} names; at most {self._limits.max_patterns} "
                f"and {self._limits.max_exact} are taken; join patterns with '|'",
            )
        old = self._interests.get(client)
        denied = self._denials(client, names)
        if old is not None and old.patterns.texts == texts and old.exact == names:
            return RouteChange(denied=tuple(sorted(denied)))  # said again: it may be another process that asks
        self._spent.units += COMPILE_UNITS * sum(map(len, texts))
        try:
            wanted = PatternSet(texts, max_program=many * self._limits.max_program)
        except PatternError as error:
            raise refused(error, client) from None
        self._spent.units += COMPILE_UNITS * wanted.program
        change = RouteCollector()
        change.denied.update(denied)
        interest = Interest(wanted, names)
        if old is not None:
            interest.topics = old.topics
            del self._interests[client]
        self._interests[client] = interest
        self._texts = None
        interest.left = self._to_look_at(interest)
        self._match_some(client, interest, change)
        return change.result(self.routes)

    def also(self, client: ClientName, topic: TopicName) -> RouteChange:
        """Add one name to what the client wants. Raises RefusedError."""
        self._spent.units = NAME_UNITS
        interest = self._interests.get(client)
        exact: set[TopicName] = set() if interest is None else interest.exact
        if topic not in exact and len(exact) >= self._limits.max_exact:
            raise RefusedError(
                "too_many_patterns", f"{client} has {len(exact)} names already, which is the limit; use a pattern"
            )
        if interest is None:
            interest = self._interests[client] = Interest(PatternSet(()), exact)
        exact.add(topic)
        self._texts = None
        change = RouteCollector()
        if not self._rights.may_have(client, topic):
            change.denied.update(self._denials(client, {topic}))
        elif topic in self.topics and topic not in interest.topics:
            interest.topics.add(topic)
            self._set_subscriber(client, topic, change, takes=True)
        return change.result(self.routes)

    def go_on(self, client: ClientName) -> RouteChange:
        """Match the client's interest with some more of the names that are left; nothing happens when none is."""
        self._spent.units = 0
        change = RouteCollector()
        interest = self._interests.get(client)
        if interest is not None:
            self._match_some(client, interest, change)
        return change.result(self.routes)

    def drop(self, client: ClientName, change: RouteCollector) -> None:
        """Forget what the client wants."""
        interest = self._interests.pop(client, None)
        self._texts = None
        if interest is not None:
            for name in interest.topics:
                self._set_subscriber(client, name, change, takes=False)

    # Streams come and go ---------------------------------------------------------------------------------------------

    def add(self, stream: StreamId, change: RouteCollector) -> None:
        """A stream begins, after it was said where it comes from (`StreamRights.via`)."""
        topic = self.topics.get(stream.topic)
        if topic is None:
            topic = self.topics[stream.topic] = Topic()
            for client, interest in self._interests.items():
                if self._takes(client, interest, stream.topic):
                    interest.topics.add(stream.topic)
                    topic.subscribers.add(client)
        topic.streams[stream.origin] = stream
        self.routes[stream] = ()
        self.route(stream, change)

    def remove(self, stream: StreamId, change: RouteCollector) -> None:
        """A stream ends."""
        change.before.setdefault(stream, self.routes.pop(stream))
        topic = self.topics[stream.topic]
        del topic.streams[stream.origin]
        if not topic.streams:
            for client in topic.subscribers:
                self._interests[client].topics.discard(stream.topic)
            del self.topics[stream.topic]

    def route(self, stream: StreamId, change: RouteCollector) -> None:
        """Judge anew which subscribers of its name get a stream: it is new, or it comes from elsewhere than before."""
        change.before.setdefault(stream, self.routes[stream])
        subscribers = self.topics[stream.topic].subscribers
        self.routes[stream] = tuple(sorted(client for client in subscribers if self._rights.gets(client, stream)))
        change.denied.update(self._denied_by_source(stream))

    # Rules change ----------------------------------------------------------------------------------------------------

    def look_again(self, peer: ClientName) -> None:
        """A peer may have more names than before: see `unfinished`."""
        interest = self._interests.get(peer)
        if interest is not None:
            interest.left = self._to_look_at(interest)

    def review_names(self, before: AccessTable, change: RouteCollector) -> None:
        """Our own rules were `before` and are others now: what they forbid ends now, for the rest see `unfinished`."""
        rights = self._rights
        for client, interest in list(self._interests.items()):
            change.denied.update(
                Denied(client, name)
                for name in interest.exact
                if client not in rights.peers
                and before.may_subscribe(client, name)
                and not rights.may_have(client, name)
            )
            for name in sorted(interest.topics):
                if not rights.may_have(client, name):
                    interest.topics.discard(name)
                    self._set_subscriber(client, name, change, takes=False)
            interest.left = self._to_look_at(interest)
            self._match_some(client, interest, change)

    def review_streams(self, streams: Iterable[StreamId], change: RouteCollector) -> None:
        """The rules of the peer that these streams come from are others: what they forbid ends now, for the rest see
        `unfinished`."""
        names: set[TopicName] = set()
        for stream in streams:
            names.add(stream.topic)
            route = self.routes[stream]
            change.before.setdefault(stream, route)
            self.routes[stream] = tuple(client for client in route if self._rights.gets(client, stream))
            change.denied.update(self._denied_by_source(stream))
        for client, interest in self._interests.items():
            if client not in self._rights.peers:
                interest.left.extend(sorted((names & interest.topics).difference(interest.left)))

    # Internals -------------------------------------------------------------------------------------------------------

    def _denials(self, client: ClientName, names: set[TopicName]) -> list[Denied]:
        """Which of the names that a client asks for it may not have. A peer is not told: it knows our rules."""
        if client in self._rights.peers:
            return []
        denied = [Denied(client, name) for name in names if not self._rights.may_have(client, name)]
        return denied + [
            Denied(client, name, self._rights.via[stream])
            for name in names & self.topics.keys()
            for stream in self.topics[name].streams.values()
            if self._rights.denies(client, stream)
        ]

    def _denied_by_source(self, stream: StreamId) -> list[Denied]:
        """Who has named a stream's topic and may not have it by the rules of the peer that it comes from."""
        topic, via = stream.topic, self._rights.via.get(stream)
        if via is None:
            return []
        return [
            Denied(client, topic, via)
            for client in self.topics[topic].subscribers - self._rights.peers
            if topic in self._interests[client].exact and self._rights.denies(client, stream)
        ]

    def _to_look_at(self, interest: Interest) -> deque[TopicName]:
        """The names that may come to the interest or leave it, those that it names itself first."""
        if interest.patterns.texts:
            return deque(self.topics)
        named = interest.exact & self.topics.keys()
        return deque((*sorted(named - interest.topics), *sorted(interest.topics - named)))

    def _takes(self, client: ClientName, interest: Interest, name: TopicName) -> bool:
        """Whether the client wants the name and may have it. What may take long is asked last."""
        steps = interest.patterns.steps(name)
        if steps:
            if not self._rights.may_have(client, name):
                return False
            self._spent.units += steps * len(name)
            return interest.wants(name)
        return interest.wants(name) and self._rights.may_have(client, name)

    def _match_some(self, client: ClientName, interest: Interest, change: RouteCollector) -> None:
        """Match names that are left against the client's rights and interest, one slice of them at least by one."""
        left, spent = interest.left, self._spent
        while left:
            name = left.popleft()
            spent.units += NAME_UNITS
            if name not in self.topics:
                continue  # gone meanwhile
            takes, took = self._takes(client, interest, name), name in interest.topics
            (interest.topics.add if takes else interest.topics.discard)(name)
            if (takes or took) and self._set_subscriber(client, name, change, takes=takes):
                spent.units += ROUTE_UNITS
                if takes:
                    spent.units += sum(map(self.route_units, self.topics[name].streams.values()))
            if spent.units >= self._limits.slice_units:
                return
        if not interest.patterns.texts and not interest.exact:
            del self._interests[client]

    def _set_subscriber(self, client: ClientName, name: TopicName, change: RouteCollector, *, takes: bool) -> bool:
        """Whether that changed a route."""
        topic, changed = self.topics[name], False
        (topic.subscribers.add if takes else topic.subscribers.discard)(client)
        for stream in topic.streams.values():
            route = self.routes[stream]
            at = bisect_left(route, client)
            had, gets = at < len(route) and route[at] == client, takes and self._rights.gets(client, stream)
            if had != gets:
                change.before.setdefault(stream, route)
                self.routes[stream] = (*route[:at], client, *route[at:]) if gets else route[:at] + route[at + 1 :]
                changed = True
        return changed

    def validate(self) -> None:
        """Check the tables against each other and against brute force; raises AssertionError."""
        for stream, route in self.routes.items():
            name = stream.topic
            expected = tuple(
                sorted(
                    client
                    for client, interest in self._interests.items()
                    if self._rights.gets(client, stream)
                    and self._rights.may_have(client, name)
                    and (client in route if name in interest.left else interest.wants(name))
                )
            )
            assert route == expected, f"{stream}: routes {route}, expected {expected}"
            assert self.topics[name].streams[stream.origin] == stream, f"{stream} does not hold its name"
        assert sum(len(topic.streams) for topic in self.topics.values()) == len(self.routes), "names differ"
        for name, topic in self.topics.items():
            assert topic.streams, f"{name} has no stream"
            subscribers = {client for client, interest in self._interests.items() if name in interest.topics}
            assert topic.subscribers == subscribers, f"{name}: subscribers differ"
        for interest in self._interests.values():
            assert interest.topics <= self.topics.keys(), "interest in unknown names"
