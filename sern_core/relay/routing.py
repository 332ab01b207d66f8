"""The relay's table of streams and interests: who gets what, who owns which global name.

Theory of operation
- A client announces its streams and says what it wants as patterns and exact names. A *match* is a (client, stream)
  pair for which the client wants the stream's global name, may subscribe to it, and is not its origin.
- Every change of streams, interests or access rules comes back as a `RouteChange`: the caller opens and closes channels
  from it and tells origins whether anybody listens. Per message there is only `subscribers(stream)`, one look-up.
- A new stream is matched at once, a new interest in slices (`sern_core/relay/interest_table.py`): while `unfinished`,
  call `go_on`.

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
  one of them has the same name for it (`PeerRights.stays`).
- Where rules differ, both relays' must grant a stream to its subscriber (`sern_core/relay/stream_rights.py`).

Who announces is the caller's business: `StreamInfo.id.origin` must be the name bound to the peer's key.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from sern_core.relay.access import AccessTable
from sern_core.relay.interest import RoutingLimits, WorkMeter
from sern_core.relay.interest_table import InterestTable
from sern_core.relay.route_change import NO_CHANGE, RouteChange, RouteCollector
from sern_core.relay.stream_rights import StreamRights
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.names import name_problem, plain_type
from sern_core.vocabulary.types import ClientName, TopicName

RETIRED_BOOTS: Final = 8
"""Replaced boots remembered per client, against announcements that were still under way."""


class RoutingTable:
    """See the module's text. Not thread-safe; every call either works or raises and changes nothing."""

    def __init__(self, access: AccessTable, *, limits: RoutingLimits | None = None) -> None:
        self._limits = limits or RoutingLimits()
        self.spent = WorkMeter()
        """What the last `announce`, `subscribe`, `also`, `go_on`, `set_access` or `rejudge` has cost."""
        self._stream_rights = StreamRights(access, self.spent)
        self.peers = self._stream_rights.peers
        """The names of other relays; set by the owner."""
        self.rights = self._stream_rights.peer_rights
        """What other relays' rules grant, and what may go to them."""
        self.interest = InterestTable(self._stream_rights, self._limits, self.spent)
        """What clients want, and what they get for it."""
        # Tables of those parts, held here as well: what is asked for each message is one look-up, and no further call.
        self._via = self._stream_rights.via
        self._routes = self.interest.routes
        self._topics = self.interest.topics
        self._infos: dict[StreamId, StreamInfo] = {}
        self._by_client: dict[ClientName, dict[TopicName, StreamId]] = {}
        self._boots: dict[ClientName, int] = {}
        self._retired: dict[ClientName, deque[int]] = {}

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
        return self.interest.received_by(client)

    def takes(self, client: ClientName, topic: TopicName) -> bool:
        """Whether the client wants the global name and may have it, whether or not there is such a stream."""
        return self.interest.takes(client, topic)

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
        return tuple(sorted(used | self.interest.pairs()))

    def via(self, stream: StreamId) -> ClientName | None:
        """The peer that announced the stream; None: a client did, or the relay itself."""
        return self._via.get(stream)

    def interests(self) -> tuple[str, ...]:
        """The patterns and names that clients want, each once: what this relay asks its peers for. The same object as
        long as nothing has changed."""
        return self.interest.texts()

    def unfinished(self, client: ClientName) -> bool:
        """Whether there are names that the client's interest was not matched with yet: call `go_on`."""
        return self.interest.unfinished(client)

    # Changes ---------------------------------------------------------------------------------------------------------

    def announce(self, stream: StreamInfo, *, via: ClientName | None = None) -> RouteChange:
        """A client offers a stream, or offers it again with other properties, or from another place: `via` a peer.

        Raises RefusedError with code `bad_name`, `forbidden`, `name_taken`, `type_mismatch`, `old_boot` or
        `too_many_streams`.
        """
        self.spent.units = 0
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
        return self.interest.subscribe(client, patterns, exact)

    def also(self, client: ClientName, topic: TopicName) -> RouteChange:
        """The client wants one more name beside what it wants: that costs one look, whatever it has.

        Raises RefusedError with code `too_many_patterns`.
        """
        return self.interest.also(client, topic)

    def go_on(self, client: ClientName) -> RouteChange:
        """Match the client's interest with some more of the names that are left; nothing happens when none is."""
        return self.interest.go_on(client)

    def returned(self, client: ClientName, boot: int) -> None:
        """The process that was replaced is not gone: it has the client's session again, and may announce."""
        retired = self._retired.get(client)
        if retired is not None and boot in retired:
            retired.remove(boot)

    def drop_client(self, client: ClientName) -> RouteChange:
        """The client is gone for good: its streams, its names and its interest go. It may come back under any boot, and
        what it has at another relay stays. With a peer goes all that came from it."""
        change = RouteCollector()
        self.interest.drop(client, change)
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
        before, self._stream_rights.access = self._stream_rights.access, access
        self.spent.units = 0
        change = RouteCollector()
        for stream in tuple(self._infos):
            if not access.may_publish(stream.origin, stream.topic):
                self._remove(stream, change)
        self.interest.review_names(before, change)
        return change.result(self._routes)

    # Peers ----------------------------------------------------------------------------------------------------------

    def peer_has(self, peer: ClientName) -> None:
        """A client is at home at a peer that was not there before: see `unfinished`."""
        self.interest.look_again(peer)

    def rejudge(self, peer: ClientName) -> RouteChange:
        """The rules of a peer are others than before: what they forbid ends now, for the rest see `unfinished`."""
        self.spent.units = 0
        change = RouteCollector()
        self.interest.review_streams([stream for stream, via in self._via.items() if via == peer], change)
        return change.result(self._routes)

    def may_replay(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules let a client have earlier messages of a stream."""
        return self._stream_rights.may_replay(client, stream)

    def relocate(self, stream: StreamId, via: ClientName) -> RouteChange:
        """The origin of a stream has gone to a peer, which may not have announced it yet."""
        change = RouteCollector()
        self._move(stream, via, change)
        return change.result(self._routes)

    def _move(self, stream: StreamId, via: ClientName | None, change: RouteCollector) -> None:
        """The stream is announced from another place than before."""
        self._via.pop(stream, None)
        if via is not None:
            self._via[stream] = via
        self.interest.route(stream, change)

    def judge(self, origin: ClientName) -> RouteChange:
        """`PeerRights.stays` says something else of an origin than before."""
        change = RouteCollector()
        for stream in self.streams_of(origin):
            self.interest.route(stream, change)
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
        if not self._stream_rights.access.may_publish(origin, topic):
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
        self.interest.add(stream.id, change)

    def _remove(self, stream: StreamId, change: RouteCollector) -> None:
        change.removed.add(stream)
        del self._infos[stream]
        self._via.pop(stream, None)
        del self._by_client[stream.origin][stream.topic]
        self.interest.remove(stream, change)

    def validate(self) -> None:
        """Check the tables against each other and against brute force; raises AssertionError."""
        for stream, info in self._infos.items():
            name = stream.topic
            assert info.id == stream, f"{stream} is filed under another id"
            assert info.spec.durable or self._boots[stream.origin] == stream.boot, f"{stream} is of a retired boot"
            assert self._by_client[stream.origin][name] == stream, f"{stream} is not among its origin's streams"
            assert self._stream_rights.access.may_publish(stream.origin, name), f"{stream} may not be published"
        assert self._routes.keys() == self._infos.keys(), "routes of unknown streams"
        assert self._via.keys() <= self._infos.keys(), "places of unknown streams"
        assert sum(map(len, self._by_client.values())) == len(self._infos), "streams by client differ"
        for name, topic in self._topics.items():
            alone = len(topic.streams) == 1
            assert alone or all(self._infos[held].spec.many_writers for held in topic.streams.values()), name
        self.interest.validate()


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
