"""The relay's table of streams and interests: who gets what, who owns which global name.

Theory of operation
- A client announces its streams and says what it wants as patterns and exact names. A *match* is a (client, stream)
  pair for which the client wants the stream's global name, may subscribe to it, and is not its origin.
- Every change of streams, interests or access rules comes back as a `RouteChange`: the caller opens and closes channels
  from it and tells origins whether anybody listens. Per message there is only `subscribers(stream)`, one look-up.
- Patterns are matched once per (client, global name), whatever the number of streams and messages under that name, and
  only against names that the client may subscribe to.
- A new stream is matched at once: it costs at most `MAX_CLIENT_PROGRAM` steps a character and client. A new interest,
  which has all names before it, is worked out in slices: while `unfinished`, call `go_on`. Until a
  name's turn has come it stays as it was; what a client may no longer have is taken away at once.

Names
- A global name has one owner, the first client that announces it, until the owner withdraws it or is dropped.
  Only when every owner declares it `many_writers` may several clients hold it (`/tf`).
- A client lives in one boot at a time. Announcing under another boot replaces all that it had; boots are drawn at
  random, so "newer" means "announced later", and a boot that was replaced comes back only with a session (`returned`):
  of two processes with one name each may. Streams that their origin keeps on disk go on from one process to the next:
  their number is the store's, and another one replaces the stream of that name alone.

Peers
- Another relay is a client of another kind, a *peer* (`sern_core/relay/peers.py`): it subscribes for the clients behind
  it, whose rights it checks, and announces their streams, which keep their origins (`via`). What came from a peer is
  offered to clients alone, so nothing goes round in circles. What the relay publishes itself goes to peers, too, unless
  one of them has the same name for it (`stays`).
- Where rules differ, both relays' must grant a stream to its subscriber (`sern_core/relay/peer_rights.py`).

Who announces is the caller's business: `StreamInfo.id.origin` must be the name bound to the peer's key.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import replace
from typing import Final

from sern_core.relay.access import AccessTable, Right
from sern_core.relay.interest import PEER_TIMES, Interest, RoutingLimits, Topic, refused
from sern_core.relay.peer_rights import PeerRights
from sern_core.relay.route_change import NO_CHANGE, Denied, RouteChange, RouteCollector
from sern_core.topics.patterns import PatternError, PatternSet
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.names import name_problem, plain_type
from sern_core.vocabulary.types import ClientName, TopicName

RETIRED_BOOTS: Final = 8
"""Replaced boots remembered per client, against announcements that were still under way."""
UNIT_S: Final = 4e-9
"""What one instruction of a pattern's program costs for one character at most, roughly: the unit of what follows."""
NAME_UNITS: Final = 500
"""A look at one name, access included."""
ROUTE_UNITS: Final = 20_000
"""What follows from a route that comes or goes: a channel, its announcement, an answer to the origin."""
COMPILE_UNITS: Final = 200
"""Compiling, for each instruction of the program and each character of a pattern."""


class RoutingTable:
    """See the module's text. Not thread-safe; every call either works or raises and changes nothing."""

    def __init__(self, access: AccessTable, *, limits: RoutingLimits | None = None) -> None:
        self._access = access
        self._limits = limits or RoutingLimits()
        self.peers: set[ClientName] = set()
        """The names of other relays; set by the owner."""
        self.stays: Container[ClientName] = ()
        """Origins whose streams no peer gets; set by the owner."""
        self.rights = PeerRights()
        """What other relays' rules grant, and what may go to them."""
        self._via: dict[StreamId, ClientName] = {}  # the peer that a stream came from
        self._infos: dict[StreamId, StreamInfo] = {}
        self._routes: dict[StreamId, tuple[ClientName, ...]] = {}
        self._topics: dict[TopicName, Topic] = {}
        self._by_client: dict[ClientName, dict[TopicName, StreamId]] = {}
        self._boots: dict[ClientName, int] = {}
        self._retired: dict[ClientName, deque[int]] = {}
        self._interests: dict[ClientName, Interest] = {}
        self._wanted: tuple[str, ...] | None = None  # see `interests`; None: to be worked out
        self.spent_units = 0
        """What the last `announce`, `subscribe`, `go_on` or `set_access` has cost."""
        self.route_units: Callable[[StreamId], int] = lambda _stream: 0
        """What a new route of a stream costs beside `ROUTE_UNITS`; set by the owner."""

    # Look-ups --------------------------------------------------------------------------------------------------------

    def subscribers(self, stream: StreamId) -> tuple[ClientName, ...]:
        """Clients to forward the stream's messages to, sorted; empty for an unknown stream."""
        return self._routes.get(stream, ())

    def wanted(self, stream: StreamId) -> bool:
        return bool(self._routes.get(stream))

    def known(self, stream: StreamId) -> bool:
        return stream in self._infos

    def info(self, stream: StreamId) -> StreamInfo | None:
        return self._infos.get(stream)

    def infos(self) -> tuple[StreamInfo, ...]:
        return tuple(self._infos.values())

    def streams_of(self, client: ClientName) -> tuple[StreamId, ...]:
        """The streams that the client announced, in that order."""
        return tuple(self._by_client.get(client, {}).values())

    def received_by(self, client: ClientName) -> tuple[StreamId, ...]:
        """The streams that the client receives, sorted."""
        interest = self._interests.get(client)
        topics = interest.topics if interest is not None else set()
        return tuple(
            sorted(
                stream
                for topic in topics
                for stream in self._topics[topic].streams.values()
                if self._gets(client, stream)
            )
        )

    def takes(self, client: ClientName, topic: TopicName) -> bool:
        """Whether the client wants the global name and may have it, whether or not there is such a stream."""
        interest = self._interests.get(client)
        return interest is not None and self._may_have(client, topic) and interest.wants(topic)

    def owners(self, topic: TopicName) -> tuple[ClientName, ...]:
        """The clients that hold the global name, first come first."""
        entry = self._topics.get(topic)
        return tuple(entry.streams) if entry is not None else ()

    def writers(self, topic: TopicName) -> list[tuple[StreamInfo, ClientName | None]]:
        """The streams of a global name, and the peer that announced each."""
        entry = self._topics.get(topic)
        held = () if entry is None else entry.streams.values()
        return [(self._infos[stream], self._via.get(stream)) for stream in held]

    def topics_via(self, peer: ClientName) -> set[TopicName]:
        """The names of the streams that the peer announced."""
        return {stream.topic for stream, via in self._via.items() if via == peer}

    def pairs(self) -> tuple[tuple[ClientName, TopicName], ...]:
        """Every (client, topic) that uses an access right now; for `AccessTable.replaced`."""
        used = {(stream.origin, stream.topic) for stream in self._infos}
        used.update((client, topic) for client, interest in self._interests.items() for topic in interest.topics)
        return tuple(sorted(used))

    def via(self, stream: StreamId) -> ClientName | None:
        """The peer that announced the stream; None: a client did, or the relay itself."""
        return self._via.get(stream)

    def interests(self) -> tuple[str, ...]:
        """The patterns and names that clients want, each once: what this relay asks its peers for. The same object as
        long as nothing has changed."""
        if self._wanted is not None:
            return self._wanted
        wanting = [interest for client, interest in self._interests.items() if client not in self.peers]
        patterns = {text for interest in wanting for text in interest.patterns.texts}
        names = {name for interest in wanting for name in interest.exact}
        self._wanted = (*sorted(patterns), *sorted(names - patterns))
        return self._wanted

    def unfinished(self, client: ClientName) -> bool:
        """Whether there are names that the client's interest was not matched with yet: call `go_on`."""
        interest = self._interests.get(client)
        return interest is not None and bool(interest.left)

    # Changes ---------------------------------------------------------------------------------------------------------

    def announce(self, stream: StreamInfo, *, via: ClientName | None = None) -> RouteChange:
        """A client offers a stream, or offers it again with other properties, or from another place: `via` a peer.

        Raises RefusedError with code `bad_name`, `forbidden`, `name_taken`, `type_mismatch`, `old_boot` or
        `too_many_streams`.
        """
        self.spent_units = 0
        origin, boot, _ = stream.id
        known = self._infos.get(stream.id)
        moved = known is not None and self._via.get(stream.id) != via
        if known is not None and _same(known, stream) and not moved:
            return NO_CHANGE
        durable = stream.spec.durable
        reboot = not durable and self._boots.get(origin, boot) != boot
        self._check(stream, reboot=reboot)
        change = RouteCollector()
        if known is not None:
            self._infos[stream.id] = stream
            if moved:
                self._move(stream.id, via, change)
            return replace(change.result(self._routes), updated=() if _same(known, stream) else (stream.id,))
        if reboot:
            for old in tuple(self._by_client.get(origin, {}).values()):
                if not self._infos[old].spec.durable:
                    self._remove(old, change)
            self._retired.setdefault(origin, deque(maxlen=RETIRED_BOOTS)).append(self._boots[origin])
        if not durable:
            self._boots[origin] = boot
        namesake = self._by_client.get(origin, {}).get(stream.id.topic)
        if namesake is not None:
            self._remove(namesake, change)
        if via is not None:
            self._via[stream.id] = via
        self._add(stream, change)
        return change.result(self._routes)

    def withdraw(self, stream: StreamId) -> RouteChange:
        """The origin no longer offers the stream; nothing happens when it is unknown."""
        if stream not in self._infos:
            return NO_CHANGE
        change = RouteCollector()
        self._remove(stream, change)
        return change.result(self._routes)

    def subscribe(
        self, client: ClientName, patterns: Iterable[str] = (), *, exact: Iterable[TopicName] = ()
    ) -> RouteChange:
        """Replace what the client wants: full-match patterns on global names, and exact names. See `unfinished`.

        Raises RefusedError with code `bad_pattern` or `too_many_patterns`; then the earlier interest stays.
        """
        self.spent_units = NAME_UNITS
        texts = tuple(dict.fromkeys(patterns))
        names = set(exact)
        many = PEER_TIMES if client in self.peers else 1
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
        self.spent_units += COMPILE_UNITS * sum(map(len, texts))
        try:
            wanted = PatternSet(texts, max_program=many * self._limits.max_program)
        except PatternError as error:
            raise refused(error, client) from None
        self.spent_units += COMPILE_UNITS * wanted.program
        change = RouteCollector()
        change.denied.update(denied)
        self._set_interest(client, Interest(wanted, names), change)
        return change.result(self._routes)

    def also(self, client: ClientName, topic: TopicName) -> RouteChange:
        """The client wants one more name beside what it wants: that costs one look, whatever it has.

        Raises RefusedError with code `too_many_patterns`.
        """
        self.spent_units = NAME_UNITS
        interest = self._interests.get(client)
        exact: set[TopicName] = set() if interest is None else interest.exact
        if topic not in exact and len(exact) >= self._limits.max_exact:
            raise RefusedError(
                "too_many_patterns", f"{client} has {len(exact)} names already, which is the limit; use a pattern"
            )
        if interest is None:
            interest = self._interests[client] = Interest(PatternSet(()), exact)
        exact.add(topic)
        self._wanted = None
        change = RouteCollector()
        if not self._may_have(client, topic):
            change.denied.update(self._denials(client, {topic}))
        elif topic in self._topics and topic not in interest.topics:
            interest.topics.add(topic)
            self._set_subscriber(client, topic, change, takes=True)
        return change.result(self._routes)

    def go_on(self, client: ClientName) -> RouteChange:
        """Match the client's interest with some more of the names that are left; nothing happens when none is."""
        self.spent_units = 0
        change = RouteCollector()
        interest = self._interests.get(client)
        if interest is not None:
            self._match_some(client, interest, change)
        return change.result(self._routes)

    def returned(self, client: ClientName, boot: int) -> None:
        """The process that was replaced is not gone: it has the client's session again, and may announce."""
        retired = self._retired.get(client)
        if retired is not None and boot in retired:
            retired.remove(boot)

    def drop_client(self, client: ClientName) -> RouteChange:
        """The client is gone for good: its streams, its names and its interest go. It may come back under any boot, and
        what it has at another relay stays. With a peer goes all that came from it."""
        change = RouteCollector()
        self._set_interest(client, None, change)
        if client in self.peers:
            streams = [stream for stream, via in self._via.items() if via == client]
        else:
            streams = [stream for stream in self._by_client.get(client, {}).values() if stream not in self._via]
        for stream in streams:
            self._remove(stream, change)
        for origin in {client, *(stream.origin for stream in streams)}:
            if not self._by_client.get(origin):
                self._by_client.pop(origin, None)
                self._boots.pop(origin, None)
                self._retired.pop(origin, None)
        return change.result(self._routes)

    def set_access(self, access: AccessTable) -> RouteChange:
        """New access rules are in force: `removed` streams and `unmatched` pairs have lost their right, others may
        have gained one (see `unfinished`). A name that a client asked for and just lost is listed in `denied`."""
        before, self._access = self._access, access
        self.spent_units = 0
        change = RouteCollector()
        for stream in tuple(self._infos):
            if not access.may_publish(stream.origin, stream.topic):
                self._remove(stream, change)
        for client, interest in list(self._interests.items()):
            change.denied.update(
                Denied(client, name)
                for name in interest.exact
                if client not in self.peers and before.may_subscribe(client, name) and not self._may_have(client, name)
            )
            for name in sorted(interest.topics):
                if not self._may_have(client, name):
                    interest.topics.discard(name)
                    self._set_subscriber(client, name, change, takes=False)
            interest.left = self._to_look_at(interest)
            self._match_some(client, interest, change)
        return change.result(self._routes)

    # Peers ----------------------------------------------------------------------------------------------------------

    def peer_has(self, peer: ClientName) -> None:
        """A client is at home at a peer that was not there before: see `unfinished`."""
        interest = self._interests.get(peer)
        if interest is not None:
            interest.left = self._to_look_at(interest)

    def rejudge(self, peer: ClientName) -> RouteChange:
        """The rules of a peer are others than before: what they forbid ends now, for the rest see `unfinished`."""
        self.spent_units = 0
        change = RouteCollector()
        names: set[TopicName] = set()
        for stream in [stream for stream, via in self._via.items() if via == peer]:
            names.add(stream.topic)
            route = self._routes[stream]
            change.before.setdefault(stream, route)
            self._routes[stream] = tuple(client for client in route if self._gets(client, stream))
            change.denied.update(self._denied_by_source(stream))
        for client, interest in self._interests.items():
            if client not in self.peers:
                interest.left.extend(sorted((names & interest.topics).difference(interest.left)))
        return change.result(self._routes)

    def may_replay(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules let a client have earlier messages of a stream."""
        if client in self.peers:
            return self.rights.may_replay(self._access, client, stream.topic)
        granted = self.rights.grants(self._via.get(stream), client, stream.topic, Right.REPLAY)
        return granted and self._access.may_replay(client, stream.topic)

    def _may_have(self, client: ClientName, name: TopicName) -> bool:
        """Whether our rules let a client have a topic, or somebody at a peer."""
        if client not in self.peers:
            return self._access.may_subscribe(client, name)
        may, looked = self.rights.may_have(self._access, client, name)
        self.spent_units += NAME_UNITS * looked
        return may

    def _gets(self, client: ClientName, stream: StreamId) -> bool:
        """Whether a subscriber of the stream's name gets the stream."""
        via = self._via.get(stream)
        if client in self.peers:
            return via is None and stream.origin not in self.stays
        return client != stream.origin and self.rights.grants(via, client, stream.topic, Right.SUBSCRIBE)

    def _denials(self, client: ClientName, names: set[TopicName]) -> list[Denied]:
        """Which of the names that a client asks for it may not have. A peer is not told: it knows our rules."""
        if client in self.peers:
            return []
        denied = [Denied(client, name) for name in names if not self._may_have(client, name)]
        return denied + [
            Denied(client, name, self._via[stream])
            for name in names & self._topics.keys()
            for stream in self._topics[name].streams.values()
            if self.rights.denies(self._via.get(stream), client, name)
        ]

    def _denied_by_source(self, stream: StreamId) -> list[Denied]:
        """Who has named a stream's topic and may not have it by the rules of the peer that it comes from."""
        topic, via = stream.topic, self._via.get(stream)
        if via is None:
            return []
        return [
            Denied(client, topic, via)
            for client in self._topics[topic].subscribers - self.peers
            if topic in self._interests[client].exact and self.rights.denies(via, client, topic)
        ]

    def relocate(self, stream: StreamId, via: ClientName) -> RouteChange:
        """The origin of a stream has gone to a peer, which may not have announced it yet."""
        change = RouteCollector()
        self._move(stream, via, change)
        return change.result(self._routes)

    def _move(self, stream: StreamId, via: ClientName | None, change: RouteCollector) -> None:
        """The stream is announced from another place than before."""
        change.before.setdefault(stream, self._routes[stream])
        self._via.pop(stream, None)
        if via is not None:
            self._via[stream] = via
        self._route(stream, change)

    def _route(self, stream: StreamId, change: RouteCollector) -> None:
        subscribers = self._topics[stream.topic].subscribers
        self._routes[stream] = tuple(sorted(client for client in subscribers if self._gets(client, stream)))
        change.denied.update(self._denied_by_source(stream))

    def judge(self, origin: ClientName) -> RouteChange:
        """`stays` says something else of an origin than before."""
        change = RouteCollector()
        for stream in self.streams_of(origin):
            change.before.setdefault(stream, self._routes[stream])
            self._route(stream, change)
        return change.result(self._routes)

    # Internals -------------------------------------------------------------------------------------------------------

    def _check(self, stream: StreamInfo, *, reboot: bool) -> None:
        origin, boot, topic = stream.id
        problem = name_problem(topic)
        if problem is not None:
            raise RefusedError("bad_name", f"{origin} may not publish {topic[:80]!r}: the name {problem}")
        if not stream.spec.durable and boot in self._retired.get(origin, ()):
            raise RefusedError(
                "old_boot", f"{origin} announced {topic} for a run that it has since replaced; ignore it"
            )
        if not self._access.may_publish(origin, topic):
            raise RefusedError(
                "forbidden", f"{origin} may not publish {topic}: no access rule grants it; add it under access.publish"
            )
        full = not reboot and len(self._by_client.get(origin, ())) >= self._limits.max_streams
        if full and stream.id not in self._infos:
            raise RefusedError(
                "too_many_streams",
                f"{origin} may not publish {topic}: it has {self._limits.max_streams} streams, which is the limit; "
                "deny some topics in its discovery",
            )
        if stream.id not in self._infos and len(self._infos) >= self._limits.max_all_streams:
            raise RefusedError(
                "too_many_streams",
                f"{origin} may not publish {topic}: the relay has {self._limits.max_all_streams} streams, which is the "
                "limit; deny some topics in the discovery of the clients",
            )
        entry = self._topics.get(topic)
        for other, held in entry.streams.items() if entry is not None else ():
            if other == origin:
                continue
            theirs = self._infos[held]
            if not (stream.spec.many_writers and theirs.spec.many_writers):
                raise RefusedError(
                    "name_taken",
                    f"{origin} may not publish {topic}: {other} owns that name; give {origin} a namespace, remap the "
                    "topic, or declare it many_writers at both clients",
                )
            problem = type_problem(stream.info, theirs.info)
            if problem is not None:
                raise RefusedError(
                    "type_mismatch",
                    f"{origin} may not publish {topic}: {problem} at {other}; use one definition at both clients",
                )

    def _add(self, stream: StreamInfo, change: RouteCollector) -> None:
        origin, _, name = stream.id
        self._infos[stream.id] = stream
        self._by_client.setdefault(origin, {})[name] = stream.id
        change.added.add(stream.id)
        topic = self._topics.get(name)
        if topic is None:
            topic = self._topics[name] = Topic()
            for client, interest in self._interests.items():
                if self._takes(client, interest, name):
                    interest.topics.add(name)
                    topic.subscribers.add(client)
        topic.streams[origin] = stream.id
        change.before.setdefault(stream.id, ())
        self._route(stream.id, change)

    def _remove(self, stream: StreamId, change: RouteCollector) -> None:
        change.removed.add(stream)
        change.before.setdefault(stream, self._routes.pop(stream))
        del self._infos[stream]
        self._via.pop(stream, None)
        del self._by_client[stream.origin][stream.topic]
        topic = self._topics[stream.topic]
        del topic.streams[stream.origin]
        if not topic.streams:
            for client in topic.subscribers:
                self._interests[client].topics.discard(stream.topic)
            del self._topics[stream.topic]

    def _set_interest(self, client: ClientName, interest: Interest | None, change: RouteCollector) -> None:
        old = self._interests.pop(client, None)
        self._wanted = None
        if interest is not None:
            interest.topics = old.topics if old is not None else set()
            self._interests[client] = interest
            interest.left = self._to_look_at(interest)
            self._match_some(client, interest, change)
        elif old is not None:
            for name in old.topics:
                self._set_subscriber(client, name, change, takes=False)

    def _to_look_at(self, interest: Interest) -> deque[TopicName]:
        """The names that may come to the interest or leave it, those that it names itself first."""
        if interest.patterns.texts:
            return deque(self._topics)
        named = interest.exact & self._topics.keys()
        return deque((*sorted(named - interest.topics), *sorted(interest.topics - named)))

    def _takes(self, client: ClientName, interest: Interest, name: TopicName) -> bool:
        """Whether the client wants the name and may have it. What may take long is asked last."""
        steps = interest.patterns.steps(name)
        if steps:
            if not self._may_have(client, name):
                return False
            self.spent_units += steps * len(name)
            return interest.wants(name)
        return interest.wants(name) and self._may_have(client, name)

    def _match_some(self, client: ClientName, interest: Interest, change: RouteCollector) -> None:
        """Match names that are left against the client's rights and interest, one slice of them at least by one."""
        left = interest.left
        while left:
            name = left.popleft()
            self.spent_units += NAME_UNITS
            if name not in self._topics:
                continue  # gone meanwhile
            takes, took = self._takes(client, interest, name), name in interest.topics
            (interest.topics.add if takes else interest.topics.discard)(name)
            if (takes or took) and self._set_subscriber(client, name, change, takes=takes):
                self.spent_units += ROUTE_UNITS
                if takes:
                    self.spent_units += sum(map(self.route_units, self._topics[name].streams.values()))
            if self.spent_units >= self._limits.slice_units:
                return
        if not interest.patterns.texts and not interest.exact:
            del self._interests[client]

    def _set_subscriber(self, client: ClientName, name: TopicName, change: RouteCollector, *, takes: bool) -> bool:
        """Whether that changed a route."""
        topic, changed = self._topics[name], False
        (topic.subscribers.add if takes else topic.subscribers.discard)(client)
        for stream in topic.streams.values():
            route = self._routes[stream]
            at = bisect_left(route, client)
            had, gets = at < len(route) and route[at] == client, takes and self._gets(client, stream)
            if had != gets:
                change.before.setdefault(stream, route)
                self._routes[stream] = (*route[:at], client, *route[at:]) if gets else route[:at] + route[at + 1 :]
                changed = True
        return changed

    def validate(self) -> None:
        """Check the tables against each other and against brute force; raises AssertionError."""
        for stream, info in self._infos.items():
            name = stream.topic
            route = self._routes[stream]
            expected = tuple(
                sorted(
                    client
                    for client, interest in self._interests.items()
                    if self._gets(client, stream)
                    and self._may_have(client, name)
                    and (client in route if name in interest.left else interest.wants(name))
                )
            )
            assert info.id == stream, f"{stream} is filed under another id"
            assert route == expected, f"{stream}: routes {route}, expected {expected}"
            assert info.spec.durable or self._boots[stream.origin] == stream.boot, f"{stream} is of a retired boot"
            assert self._topics[name].streams[stream.origin] == stream, f"{stream} does not hold its name"
            assert self._by_client[stream.origin][name] == stream, f"{stream} is not among its origin's streams"
            assert self._access.may_publish(stream.origin, name), f"{stream} may not be published"
        assert self._routes.keys() == self._infos.keys(), "routes of unknown streams"
        assert self._via.keys() <= self._infos.keys(), "places of unknown streams"
        assert sum(map(len, self._by_client.values())) == len(self._infos), "streams by client differ"
        assert sum(len(topic.streams) for topic in self._topics.values()) == len(self._infos), "names differ"
        for name, topic in self._topics.items():
            assert topic.streams, f"{name} has no stream"
            alone = len(topic.streams) == 1
            assert alone or all(self._infos[held].spec.many_writers for held in topic.streams.values()), name
            subscribers = {client for client, interest in self._interests.items() if name in interest.topics}
            assert topic.subscribers == subscribers, f"{name}: subscribers differ"
        for interest in self._interests.values():
            assert interest.topics <= self._topics.keys(), "interest in unknown names"


def type_problem(mine: TopicInfo, theirs: TopicInfo) -> str | None:
    """How two descriptions of one topic contradict each other, as a phrase that names both, or None.

    Hashes of different encodings (ROS 1 md5, ROS 2 RIHS01) cannot be compared, nor can empty ones.
    """
    if plain_type(mine.type_name) != plain_type(theirs.type_name):
        return f"its type is {mine.type_name}, and {theirs.type_name}"
    comparable = mine.encoding is theirs.encoding and mine.type_hash and theirs.type_hash
    if comparable and mine.type_hash != theirs.type_hash:
        return f"its {mine.type_name} has hash {mine.type_hash}, and {theirs.type_hash}"
    return None


def _same(one: StreamInfo, other: StreamInfo) -> bool:
    return (
        one.info == other.info
        and one.spec == other.spec
        and one.attributes == other.attributes
        and one.definition_hash == other.definition_hash
    )
