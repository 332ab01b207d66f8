"""Who claimed the name of a topic first, over all relays of a fabric. Pure.

At one relay a name belongs to the client that announced it first (`sern_core/relay/routing.py`). Relays that are parted
may each have given it to another. They tell each other of every name that a client of theirs has, wanted elsewhere or
not, with the stamp of its claim, and all decide alike: the earlier stamp holds, of equal ones the client whose name
comes first. The others' streams are refused with `name_taken` by their own relays.

A stamp is that of a hybrid logical clock (Kulkarni et al., "Logical Physical Clocks", 2014): the relay's wall clock in
microseconds, but always more than every stamp that it has given or heard of. So a claim that was made when another was
known is the later one, however wrong a clock is.

A relay takes of a peer what it can, in whatever order claims and streams come. What it did not take because another
had the name it asks for again (`offer`) when the name has become free.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.message import StreamId, StreamInfo
from sern_core.vocabulary.names import is_client_name, is_peer, name_problem
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing

MAX_CLAIMS: Final = 40
"""Claims in one message at most,"""
MAX_CLAIM_BYTES: Final = framing.MAX_ENVELOPE_BYTES // 2
"""and what their texts may have together."""
CLAIM_BYTES: Final = 20
MAX_STAMP_US: Final = 2**61


class Claim(NamedTuple):
    """The less of two is the earlier."""

    stamp_us: int
    client: ClientName
    many_writers: bool

    def excludes(self, other: "Claim") -> bool:
        """Whether the name cannot be both claims'."""
        return self.client != other.client and not (self.many_writers and other.many_writers)


class Claims:
    """`home` names the peer that a client is at, `wall_us` is the wall clock; `give_way(stream, why, now)` refuses a
    stream that was taken."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        *,
        home: Callable[[ClientName], ClientName | None],
        wall_us: Callable[[float], int],
        give_way: Callable[[StreamId, str, float], None],
    ) -> None:
        self._clients = clients
        self._routing = routing
        self._home = home
        self._wall_us = wall_us
        self._give_way = give_way
        self._own: dict[TopicName, dict[ClientName, Claim]] = {}
        self._theirs: dict[TopicName, dict[ClientName, Claim]] = {}  # by the peer that told of it
        self._told: Counter[ClientName] = Counter()  # how many claims of each peer are kept
        self._untold: dict[TopicName, None] = {}
        self._refused: dict[TopicName, set[ClientName]] = {}  # peers whose streams were not taken for their name
        self._stamp_us = 0

    # --- streams that are relayed here ----------------------------------------------------------------------------

    def check(self, stream: StreamInfo) -> None:
        """Call this before a stream of a client or of a peer is taken. Raises RefusedError."""
        topic = stream.id.topic
        if topic not in self._theirs:
            return
        self._refuse_later(topic, self._claim(stream))

    def _refuse_later(self, topic: TopicName, mine: Claim) -> None:
        for claim, peer in self._of(topic):
            if claim.excludes(mine) and claim < mine:
                at = "" if peer is None else f", a client of the relay {peer[1:]},"
                raise RefusedError(
                    "name_taken",
                    f"{mine.client} may not publish {topic}: {claim.client}{at} owns that name; give {mine.client} a "
                    "namespace, remap the topic, or declare it many_writers at both clients",
                )

    def changed(self, topic: TopicName, now: float) -> None:
        """A stream of that name has begun, ended, or comes from elsewhere."""
        known, own = self._own.get(topic, {}), dict[ClientName, Claim]()
        writers = self._routing.writers(topic)
        for stream, via in writers:
            if via is None:
                origin = stream.id.origin
                stamp_us = known[origin].stamp_us if origin in known else self._stamp(topic, origin, now)
                own[origin] = Claim(stamp_us, origin, stream.spec.many_writers)
        if own != known:
            self._untold[topic] = None
            self._own[topic] = own
            if not own:
                del self._own[topic]
        if not writers:
            self._ask_again(topic, now)

    def _ask_again(self, topic: TopicName, now: float) -> None:
        for peer in sorted(self._refused.pop(topic, ())):
            self._clients.tell(peer, {"t": "offer", "topic": topic}, now)

    def _stamp(self, topic: TopicName, client: ClientName, now: float) -> int:
        """The stamp of a new claim. A client that has come from another relay keeps the one it had there."""
        earlier = [claim.stamp_us for claim in self._theirs.get(topic, {}).values() if claim.client == client]
        self._stamp_us = min(max(self._wall_us(now), self._stamp_us + 1), MAX_STAMP_US)
        return min((*earlier, self._stamp_us))

    def refused(self, stream: StreamId, peer: ClientName) -> None:
        """A stream of a peer was not taken, for another has its name."""
        self._refused.setdefault(stream.topic, set()).add(peer)

    # --- what peers are told --------------------------------------------------------------------------------------

    def up(self, link: Link, *, now: float) -> None:
        """The session with a peer has begun: it is told of every name, and says anew which ones it has."""
        self.lost(link.peer)
        self._say([link.peer], self._own, now)
        self._clients.tell(link.peer, {"t": "claims", "topics": [], "whole": True}, now)

    def lost(self, peer: ClientName) -> None:
        """What a peer has told holds no more."""
        for topic in [topic for topic, claims in self._theirs.items() if peer in claims]:
            self._drop(topic, peer)
        for topic in [topic for topic, peers in self._refused.items() if peer in peers]:
            self._refused[topic].discard(peer)
            if not self._refused[topic]:
                del self._refused[topic]

    def tell(self, *, now: float) -> None:
        """Tell the peers of what has changed. Call ten times a second."""
        untold, self._untold = self._untold, {}
        if untold:
            peers = [peer for peer in sorted(self._routing.peers) if self._reached(peer)]
            self._say(peers, untold, now)

    def _reached(self, peer: ClientName) -> bool:
        link = self._clients.links.get(peer)
        return link is not None and link.established

    def _say(self, peers: list[ClientName], topics: Iterable[TopicName], now: float) -> None:
        batch: list[list[object]] = []
        batch_bytes = 0
        for topic in topics:
            own = self._own.get(topic)
            claim = min(own.values()) if own else None
            told: list[object] = [topic] if claim is None else [topic, claim.client, claim.stamp_us, claim.many_writers]
            nbytes = len(topic.encode()) + CLAIM_BYTES + (0 if claim is None else len(claim.client))
            if len(batch) == MAX_CLAIMS or batch_bytes + nbytes > MAX_CLAIM_BYTES:
                self._send(peers, batch, now)
                batch, batch_bytes = [], 0
            batch.append(told)
            batch_bytes += nbytes
        if batch:
            self._send(peers, batch, now)

    def _send(self, peers: list[ClientName], batch: list[list[object]], now: float) -> None:
        for peer in peers:
            self._clients.tell(peer, {"t": "claims", "topics": batch}, now)

    # --- what they tell -------------------------------------------------------------------------------------------

    def told(self, peer: ClientName, envelope: framing.Envelope, *, max_claims: int, now: float) -> None:
        """A peer tells of names that its clients have, or have no more; at most `max_claims` of one peer are kept.
        Raises WireError."""
        for topic, claim in _claims(envelope):
            self._drop(topic, peer)
            if claim is not None:
                if self._told[peer] >= max_claims:
                    raise WireError(f"more than {max_claims} claims of names")
                self._told[peer] += 1
                self._theirs.setdefault(topic, {})[peer] = claim
                self._stamp_us = max(self._stamp_us, claim.stamp_us)
                self._judge(topic, now)
            if topic in self._refused and not self._routing.writers(topic):
                self._ask_again(topic, now)
        if framing.take_bool(envelope, "whole"):  # what an earlier process of it had, and it did not take, is gone
            for topic in sorted(self._theirs.keys() & self._routing.topics_via(peer)):
                self._judge(topic, now)

    def _drop(self, topic: TopicName, peer: ClientName) -> None:
        claims = self._theirs.get(topic)
        if claims is not None and claims.pop(peer, None) is not None:
            self._told[peer] -= 1
            if not claims:
                del self._theirs[topic]

    def _judge(self, topic: TopicName, now: float) -> None:
        """Give up the streams whose claims are the later ones."""
        for stream, _via in self._routing.writers(topic):
            try:
                self._refuse_later(topic, self._claim(stream))
            except RefusedError as refusal:
                self._give_way(stream.id, str(refusal), now)

    def offer(self, topic: TopicName) -> list[StreamId]:
        """A peer asks again for what it could not take: the streams of that name that begin here."""
        return [stream.id for stream, via in self._routing.writers(topic) if via is None]

    # --- both -----------------------------------------------------------------------------------------------------

    def _of(self, topic: TopicName) -> Iterator[tuple[Claim, ClientName | None]]:
        """The claims that count, with the peer of each, None: it was made here."""
        for claim in self._own.get(topic, {}).values():
            yield claim, None
        for peer, claim in self._theirs.get(topic, {}).items():
            if self._home(claim.client) == peer and self._clients.access.may_publish(claim.client, topic):
                yield claim, peer

    def _claim(self, stream: StreamInfo) -> Claim:
        """The claim of a stream. One that is not known yet, or not any more, is later than all."""
        origin, many = stream.id.origin, stream.spec.many_writers
        stamps_us = [claim.stamp_us for claim, _peer in self._of(stream.id.topic) if claim.client == origin]
        return Claim(min(stamps_us, default=MAX_STAMP_US), origin, many)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        for topic, own in self._own.items():
            held = {stream.id.origin for stream, via in self._routing.writers(topic) if via is None}
            assert own.keys() == held, f"{topic}: claimed for {set(own)}, held by {held}"
        kept = Counter(peer for claims in self._theirs.values() for peer in claims)
        assert kept == +self._told, "claims of peers are counted wrong"
        assert all(map(is_peer, kept)), "claims of somebody who is no peer"
        assert all(self._theirs.values()) and all(self._refused.values()), "an empty table is kept"


def _claims(envelope: framing.Envelope) -> Iterator[tuple[TopicName, Claim | None]]:
    """Raises WireError."""
    told = envelope.get("topics")
    if not isinstance(told, list):
        raise WireError("claims without topics")
    for each in told:
        if not (isinstance(each, list) and each and isinstance(each[0], str)) or name_problem(each[0]) is not None:
            raise WireError("claims of something that is no topic")
        topic = TopicName(each[0])
        if len(each) == 1:
            yield topic, None
            continue
        if len(each) != 4 or not isinstance(each[1], str) or type(each[2]) is not int or type(each[3]) is not bool:
            raise WireError(f"a claim of {topic} that is none")
        if not is_client_name(each[1]) or not 0 < each[2] <= MAX_STAMP_US:
            raise WireError(f"a claim of {topic} by {each[1][:64]!r}, stamp {each[2]}")
        yield topic, Claim(each[2], ClientName(each[1]), each[3])
