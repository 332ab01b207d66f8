"""Objects between relays: what each tells the others of those of its own clients, and which values it asks for. Pure.

A relay tells every peer of all objects of its clients, without values; and with its value of an object that somebody
behind the peer wants so: the peer says which (`objects`), whenever that has changed. What came from a peer is told to
no other.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Final

from sern_core.link.link import Link
from sern_core.objects.changes import MAX_WANTS
from sern_core.objects.feed import ObjectFeed
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessTable
from sern_core.relay.far_objects import FarObjects
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern, PatternError, compile_pattern
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import ClientName, ObjectKind
from sern_core.wire import framing

MAX_PEER_WANTS: Final = 64
"""Kinds and patterns that a peer may ask for. A relay whose clients want more asks for everything."""
EVERYTHING: Final = (("", ".*"),)
LOOK_S: Final = 10.0
"""For so long after somebody has looked at objects here their values are asked for."""
MAX_LOOKS: Final = 32
"""Looks that are remembered, the latest."""
PASSES: Final = 1024
"""Objects that are looked at for a peer in one turn: some milliseconds."""
PATTERN_US: Final = 100
LOOK_US: Final = 2
"""What a peer is charged with, in microseconds: a pattern, and an object that one is held against."""
KINDS: Final = frozenset(ObjectKind) | {""}
"""Kinds in a subscription; empty: any."""

Wanted = tuple[str, str]
"""A kind and a pattern."""


class PeerObjects:
    """Parameters as those of `ObjectExchange`; `via` names the peer that a stream came from."""

    def __init__(
        self,
        registry: ObjectRegistry,
        links: Mapping[ClientName, Link],
        *,
        access: Callable[[], AccessTable],
        text_of: Callable[[XrObject], str],
        refused: Callable[[ClientName, str, str], None],
        attempt: Callable[[ClientName, float, Callable[[], object]], None],
        home: Callable[[ClientName], ClientName | None],
        via: Callable[[StreamId], ClientName | None],
        counts: Counter[str],
    ) -> None:
        self._registry = registry
        self._links = links
        self._text_of = text_of
        self._attempt = attempt
        self._home = home
        self._via = via
        self.far = FarObjects(registry, links, access=access, home=home, refused=refused, counts=counts)
        """What peers tell."""
        self.feeds: dict[ClientName, ObjectFeed] = {}
        """What is told to each peer."""
        self._wants: dict[ClientName, dict[str, list[Pattern]]] = {}  # values that a peer wants: patterns by kind
        self._parts: dict[ClientName, list[Wanted]] = {}  # that have arrived
        self._first = 1  # as in `ObjectExchange`
        self._peers: dict[ClientName, Link] = {}  # that have had a session
        self._wanted: Collection[Wanted] = frozenset()  # by clients
        self._looks: dict[Wanted, float] = {}  # until when
        self._asked: dict[ClientName, Collection[Wanted]] = {}  # what a peer was asked for in its session

    # --- sessions -------------------------------------------------------------------------------------------------

    def up(self, link: Link, *, resumed: bool, now: float) -> None:
        """The session with a peer has begun: it is told which values are wanted here. Another process says itself what
        it wants, and has nothing."""
        feed = self.feeds.get(link.peer)
        if feed is not None and not resumed:
            feed.idle = True
        self._parts.pop(link.peer, None)
        self._asked.pop(link.peer, None)
        self._peers[link.peer] = link
        self._ask(now)

    def forget(self, peer: ClientName) -> None:
        """The peer is gone for good."""
        feed = self.feeds.pop(peer, None)
        if feed is not None:
            self._first = max(self._first, feed.channel.next_seq)
        self._peers.pop(peer, None)
        for table in (self._wants, self._parts, self._asked):
            table.pop(peer, None)
        self.far.lost(peer)

    def moved(self, client: ClientName, *, now: float) -> None:
        """A client has come here, or to a peer: who tells of its objects may be another one now."""
        object_ids = self._registry.named(owner=client)
        for feed in self.feeds.values():
            feed.look_again(object_ids)
        self.far.moved(client, now=now)

    # --- what is asked for ----------------------------------------------------------------------------------------

    def want(self, wanted: Iterable[Wanted]) -> None:
        """These are the objects whose values clients want here."""
        self._wanted = frozenset(wanted)

    def look(self, kind: str, topic: str, *, now: float) -> None:
        """Somebody looks at the values of a kind of objects (empty: any), or at those of a topic (empty: any)."""
        if topic and name_problem(topic) is not None:
            return  # there is none of that name
        if kind or topic:
            wanted = kind, f"{topic}@.*" if topic else ".*"
            self._looks.pop(wanted, None)
            self._looks[wanted] = now + LOOK_S
            while len(self._looks) > MAX_LOOKS:
                del self._looks[next(iter(self._looks))]

    def _ask(self, now: float) -> None:
        for wanted in [wanted for wanted, due_s in self._looks.items() if now >= due_s]:
            del self._looks[wanted]
        every: Collection[Wanted] = {*self._wanted, *self._looks} if self._looks else self._wanted
        if len(every) > MAX_PEER_WANTS:
            every = EVERYTHING
        for peer, link in self._peers.items():
            if link.established and self._asked.get(peer) != every:
                self._asked[peer] = every
                self._attempt(peer, now, partial(self._say, link, sorted(every), now))

    def _say(self, link: Link, wanted: list[Wanted], now: float) -> None:
        """Ask a peer for values, in parts that fit into an envelope each."""
        epoch, version = self.far.version(link.peer)
        part: list[Wanted] = []
        nbytes = 0
        for kind, pattern in wanted:
            if len(part) == MAX_WANTS or nbytes + len(pattern) > framing.MAX_ENVELOPE_BYTES // 2:
                self._say_part(link, part, epoch, version, now, more=True)
                part, nbytes = [], 0
            part.append((kind, pattern))
            nbytes += len(kind) + len(pattern) + 8
        self._say_part(link, part, epoch, version, now, more=False)

    def _say_part(self, link: Link, part: list[Wanted], epoch: int, version: int, now: float, *, more: bool) -> None:
        said: framing.Envelope = {
            "t": "objects",
            "kinds": [kind for kind, _pattern in part],
            "match": [pattern for _kind, pattern in part],
            "since": version,
            "epoch": epoch,
            "more": more,
        }
        link.control.send(said, now=now)

    # --- who is told ----------------------------------------------------------------------------------------------

    def subscribe(self, link: Link, envelope: framing.Envelope, *, now: float) -> None:
        """A peer says which values it wants, and what it has. Raises WireError for what no relay sends, RefusedError
        for a pattern that is none."""
        peer = link.peer
        kinds = framing.take_strings(envelope, "kinds", max_length=16)
        patterns = framing.take_strings(envelope, "match")
        framing.take_int(envelope, "since", default=0)
        epoch = framing.take_int(envelope, "epoch", default=0)
        parts = self._parts.setdefault(peer, [])
        if len(kinds) != len(patterns) or len(kinds) > MAX_WANTS or len(parts) + len(kinds) > MAX_PEER_WANTS:
            raise WireError(f"a subscription of {len(kinds)} kinds and {len(patterns)} patterns of objects")
        if not set(kinds) <= KINDS:
            raise WireError("a subscription to objects of an unknown kind")
        parts += zip(kinds, patterns, strict=True)
        link.reassembly.work_us += PATTERN_US * len(patterns)
        if framing.take_bool(envelope, "more"):
            return
        wants: dict[str, list[Pattern]] = {}
        try:
            for kind, text in self._parts.pop(peer):
                wants.setdefault(kind, []).append(compile_pattern(text))
        except PatternError as error:
            raise RefusedError("bad_pattern", f"{peer[1:]} may not subscribe to objects: {error}") from error
        self._tell(link, wants, has=epoch == self._registry.epoch, now=now)

    def _tell(self, link: Link, wants: dict[str, list[Pattern]], *, has: bool, now: float) -> None:
        """`has`: the peer has what it was told before, and goes on there."""
        peer = link.peer
        before = self._wants.get(peer)
        self._wants[peer] = wants
        feed = self.feeds.get(peer)
        if feed is None:
            feed = self.feeds[peer] = ObjectFeed(
                self._registry,
                link,
                sees=partial(self._ours, peer),
                text_of=self._text_of,
                first=self._first,
                passes=PASSES,
                now=now,
            )
        elif feed.idle or not has:
            feed.restart()
        elif wants != before:
            feed.revalue()
        feed.idle = False
        feed.wants_value = partial(self._wants_value, peer) if wants else None
        feed.pump(now=now)

    def _ours(self, peer: ClientName, object_id: str, _of_kind: ObjectKind | None) -> bool:
        """Whether it is an object of a client of this relay, or was one if it is gone."""
        self._links[peer].reassembly.work_us += LOOK_US
        about = self._registry.about(object_id)
        if about is None:
            return True
        _kind, owner, stream = about
        if self._home(owner) is not None:
            return False
        return self._registry.teller(object_id) is None if stream is None else self._via(stream) is None

    def _wants_value(self, peer: ClientName, object_id: str, kind: ObjectKind) -> bool:
        wants = self._wants[peer]
        return any(pattern.fullmatch(object_id) for key in (kind, "") for pattern in wants.get(key, ()))

    def pump(self, *, now: float) -> None:
        """Tell the peers what is due."""
        for peer, feed in list(self.feeds.items()):
            if not feed.at_rest:
                self._attempt(peer, now, partial(feed.pump, now=now))

    def work(self, *, now: float) -> None:
        """Ask for what is wanted by now, and show what is to be shown. Call ten times a second."""
        self._ask(now)
        self.far.work(now=now)

    def dropped(self, link: Link, channel: OutChannel) -> None:
        """Something of what was told will not arrive."""
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.dropped()

    def delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.pump(now=now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        self.far.validate()
        assert self.feeds.keys() == self._wants.keys() <= self._links.keys(), "peers that are told, and of what"
        for feed in self.feeds.values():
            feed.validate()
