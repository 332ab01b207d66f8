"""Objects over the link, the relay's half: what clients put is taken in, and those who subscribe are told. Pure.

Who may is said by `object_rights`; what other relays tell and are told is in `peer_objects`.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from sern_core.link.link import Link
from sern_core.objects.changes import (
    MAX_WANTS,
    OBJECTS_TOPIC,
    Begin,
    Change,
    Define,
    Delete,
    Put,
    Set,
    decode,
    encode,
    put_of,
    text_hash,
)
from sern_core.objects.feed import ObjectFeed
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessTable
from sern_core.relay.object_rights import check_right, name_of
from sern_core.relay.peer_objects import KINDS, PeerObjects
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern, PatternError, compile_pattern
from sern_core.vocabulary.errors import RefusedError, UsageError, WireError
from sern_core.vocabulary.message import Message, StreamId
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName, ObjectKind
from sern_core.wire import framing

MAX_TEXTS_BYTES: Final = 2**20
"""Texts of definitions that a client has sent and that its next objects may name."""
CHANGE_US: Final = 40
BYTES_PER_US: Final = 64
PATTERN_US: Final = 100
LOOK_US: Final = 2
SHOW_US: Final = 60
"""What a client is charged with: a change of an object, its size, a pattern, an object that one is held against; and a
peer for showing what it tells."""


class _Want(NamedTuple):
    """Objects of a kind (None: any) whose ids match, with their values or without."""

    kind: ObjectKind | None
    pattern: Pattern
    valued: bool

    def matches(self, object_id: str, kind: ObjectKind | None) -> bool:
        return (kind is None or self.kind in (None, kind)) and self.pattern.fullmatch(object_id)


class _Owner:
    """What a client puts. `fresh`: what it has put since it began to tell all; None: it has told all."""

    __slots__ = ("fresh", "texts", "texts_bytes", "told_seq")

    def __init__(self) -> None:
        self.fresh: set[str] | None = None
        self.texts: dict[str, str] = {}
        self.texts_bytes = 0
        self.told_seq = 0

    def begin(self, *, whole: bool) -> None:
        self.fresh = set() if whole else None
        self.texts.clear()
        self.texts_bytes = 0


class ObjectExchange:
    """`access` are the rules of now; `text_of` gives the text of an object's definition; `refused(client, code, text)`
    is told what is not taken; `attempt` does something about a client so that its failure is that client's. `home`
    names the peer that a client is at, `via` the one that a stream comes from."""

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
    ) -> None:
        self._attempt = attempt
        self._registry = registry
        self._links = links
        self._access = access
        self._text_of = text_of
        self._refused = refused
        self._owners: dict[ClientName, _Owner] = {}
        self._strayed: set[ClientName] = set()  # of those: have been at a peer since they told us what they have
        self._wants: dict[ClientName, tuple[_Want, ...]] = {}
        self._asked: dict[ClientName, object] = {}  # what each said last, as it said it
        self.feeds: dict[ClientName, ObjectFeed] = {}
        """What each client is told, by its name."""
        self._first = 1  # a client that was forgotten and comes back has read so many messages of the stream
        self.counts: Counter[str] = Counter()
        """Changes that clients and other relays sent: `taken`, or the code of the refusal."""
        self.peers = PeerObjects(
            registry,
            links,
            access=access,
            text_of=text_of,
            refused=refused,
            attempt=attempt,
            home=home,
            via=via,
            counts=self.counts,
        )
        """What other relays tell and are told."""

    # --- what clients put -----------------------------------------------------------------------------------------

    def message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        """A change of a client's objects has its turn, or of those at another relay."""
        client = link.peer
        link.taking.confirm(stream, message.seq)
        if message.drop_marker:
            return
        link.reassembly.work_us += CHANGE_US + len(message.body) // BYTES_PER_US
        object_id = ""
        try:
            change = decode(message.body)
            if isinstance(change, (Put, Set, Delete)):
                object_id = change.object_id
                if not isinstance(change, Delete):  # the value came packed
                    link.reassembly.work_us += len(change.value or b"") // BYTES_PER_US
            elif isinstance(change, Define):  # so did it
                link.reassembly.work_us += len(change.text) // BYTES_PER_US
            if is_peer(client):
                link.reassembly.work_us += SHOW_US
                if self.peers.far.take(client, change, now=now):
                    self.pump(now=now)
                return
            self._apply(self._owners.setdefault(client, _Owner()), client, change, now)
        except (RefusedError, WireError) as error:
            code = error.code if isinstance(error, RefusedError) else "bad_object"
            if is_peer(client):
                self.peers.far.refuse(client, client, code, str(error))
                return
            self.counts[code] += 1
            self._refused(client, code, str(error))
            self._say_refused(link, object_id, code, str(error), now)
        else:
            self.counts["taken"] += 1
        self.pump(now=now)

    def _apply(self, owner: _Owner, client: ClientName, change: Change, now: float) -> None:
        registry = self._registry
        if isinstance(change, Begin):
            owner.begin(whole=change.whole)
        elif isinstance(change, Define):
            if owner.texts_bytes + len(change.text) > MAX_TEXTS_BYTES:
                raise RefusedError("too_large", f"{client} has sent {MAX_TEXTS_BYTES} bytes of definitions: too many")
            owner.texts_bytes += len(change.text)
            owner.texts[change.text_hash] = change.text
        elif isinstance(change, (Put, Set)):
            if owner.fresh is not None:
                owner.fresh.add(change.object_id)  # also where it is refused: what there is of it stays
            try:
                self._put(owner, client, self._whole(client, change), now)
            finally:
                self._ended(owner, client, change.upto)
        elif isinstance(change, Delete):
            if owner.fresh is not None:
                owner.fresh.discard(change.object_id)
            about = registry.about(change.object_id)
            if about is not None and about[2] is None:
                registry.delete(change.object_id, owner=client)
            self._ended(owner, client, change.upto)
        else:
            self._ended(owner, client, change.upto)

    def _whole(self, client: ClientName, change: Put | Set) -> Put:
        """A put, of a change of a value alone with the rest as it was."""
        if isinstance(change, Put):
            return change
        item = self._registry.get(change.object_id)
        if item is None or item.owner != client:
            raise RefusedError("bad_object", f"{client} has no object {change.object_id[:80]} to give another value")
        put = put_of(item, item.definition)
        return put._replace(**{field: getattr(change, field) for field in Set._fields})

    def _put(self, owner: _Owner, client: ClientName, change: Put, now: float) -> None:
        check_right(self._access(), client, change.object_id)
        about = self._registry.about(change.object_id)
        if about is not None and about[2] is not None:
            raise RefusedError("not_owner", f"{client} may not put {change.object_id[:80]}: it stands for a topic")
        try:
            encode(change._replace(owner=client, value=b"", upto=2**62))  # as it is told to others
        except UsageError as error:
            raise RefusedError("too_large", f"{client} may not put {change.object_id[:80]}: {error}") from error
        self._registry.put(
            change.object_id,
            owner=client,
            kind=change.kind,
            type_name=change.type_name,
            definition=owner.texts.get(change.text_hash, "") or self._known_text(change),
            definition_hash=change.definition_hash,
            attributes=change.attributes,
            value=change.value,
            seq=change.seq,
            ros_stamp_ns=change.ros_stamp_ns,
            wall_ns=change.wall_ns,
            now=now,
        )

    def _known_text(self, change: Put) -> str:
        """The text of a definition that the object has already."""
        item = self._registry.get(change.object_id) if change.text_hash else None
        return item.definition if item is not None and text_hash(item.definition) == change.text_hash else ""

    def _ended(self, owner: _Owner, client: ClientName, upto: int | None) -> None:
        """A client has told all it has: what it had before is gone."""
        if upto is None or owner.fresh is None:
            return
        for object_id in self._registry.named(owner=client):
            about = self._registry.about(object_id)
            if object_id not in owner.fresh and about is not None and about[2] is None:
                self._registry.delete(object_id, owner=client)
        owner.fresh = None

    def _say_refused(self, link: Link, object_id: str, code: str, why: str, now: float) -> None:
        """One at a time: a client that puts a thousand wrong ones hears of some."""
        owner = self._owners.setdefault(link.peer, _Owner())
        if link.established and link.control.acked_seq >= owner.told_seq:
            said = {"t": "object_refused", "id": object_id, "code": code, "why": why[:400]}
            owner.told_seq = link.control.send(said, now=now)

    # --- who is told ----------------------------------------------------------------------------------------------

    def subscribe(self, link: Link, envelope: framing.Envelope, *, now: float) -> None:
        """A client says which objects it wants, and what it has. Raises WireError for what no honest client sends,
        RefusedError for a pattern that is none."""
        if is_peer(link.peer):
            self.peers.subscribe(link, envelope, now=now)
            return
        client = link.peer
        kinds = framing.take_strings(envelope, "kinds", max_length=16)
        patterns = framing.take_strings(envelope, "match")
        since, epoch = framing.take_int(envelope, "since", default=0), framing.take_int(envelope, "epoch", default=0)
        bare = framing.take_int(envelope, "bare", default=0)
        if len(kinds) != len(patterns) or len(kinds) > MAX_WANTS:
            raise WireError(f"a subscription of {len(kinds)} kinds and {len(patterns)} patterns of objects")
        if not set(kinds) <= KINDS:
            raise WireError("a subscription to objects of an unknown kind")
        feed = self.feeds.get(client)
        if bare > len(kinds):
            raise WireError(f"a subscription of {len(kinds)} kinds of objects, {bare} of them without values")
        asked = (bare, *zip(kinds, patterns, strict=True))
        if feed is not None and self._asked.get(client) == asked:
            return  # it goes on where the session before ended
        link.reassembly.work_us += PATTERN_US * len(patterns)
        try:
            wants = tuple(
                _Want(ObjectKind(kind) if kind else None, compile_pattern(text), index < len(kinds) - bare)
                for index, (kind, text) in enumerate(zip(kinds, patterns, strict=True))
            )
        except PatternError as error:
            raise RefusedError("bad_pattern", f"{client} may not subscribe to objects: {error}") from error
        self._asked[client] = asked
        self._wants[client] = wants
        self._tell_peers()
        every_kind = any(want.kind is None for want in wants)
        told = None if every_kind else frozenset(want.kind for want in wants if want.kind is not None)
        if feed is None:
            if not wants:
                del self._asked[client], self._wants[client]
                return
            feed = self.feeds[client] = ObjectFeed(
                self._registry,
                link,
                sees=lambda object_id, kind: self._sees(client, object_id, kind),
                text_of=self._text_of,
                kinds=told,
                first=self._first,
                now=now,
            )
            feed.restart(since, epoch)
        else:
            feed.kinds, feed.idle = told, False
            feed.restart()
        feed.wants_value = partial(self._wants_value, client) if any(want.valued for want in wants) else None
        feed.pump(now=now)

    def _sees(self, client: ClientName, object_id: str, kind: ObjectKind | None) -> bool:
        about = self._registry.about(object_id)
        if about is not None and about[1] == client:
            return False  # its own
        wants = self._wants[client]
        self._links[client].reassembly.work_us += LOOK_US * len(wants)
        if not any(want.matches(object_id, kind) for want in wants):
            return False
        return self._access().may_subscribe(client, name_of(object_id))

    def _wants_value(self, client: ClientName, object_id: str, kind: ObjectKind) -> bool:
        return any(want.valued and want.matches(object_id, kind) for want in self._wants[client])

    def _tell_peers(self) -> None:
        """Other relays are asked for the values that clients want."""
        self.peers.want(
            (str(want.kind or ""), want.pattern.pattern)
            for wants in self._wants.values()
            for want in wants
            if want.valued
        )

    def pump(self, *, now: float) -> None:
        """Tell those who subscribe what is due. Call ten times a second."""
        for client, feed in list(self.feeds.items()):
            if not feed.at_rest:
                self._attempt(client, now, partial(feed.pump, now=now))
        self.peers.pump(now=now)

    def revoke(self) -> None:
        """There are new access rules: everyone is told anew what it may have, and forgets what it may not."""
        for feed in self.feeds.values():
            feed.restart()
        self.peers.far.revoke()

    # --- news of the link -----------------------------------------------------------------------------------------

    def came(self, link: Link, *, resumed: bool, now: float) -> None:
        """A session has begun. Another process has nothing of what the one before was told, and says what it wants;
        and of one that was forgotten nothing is here."""
        if is_peer(link.peer):
            self.peers.up(link, resumed=resumed, now=now)
            return
        self.peers.moved(link.peer, now=now)
        if not resumed:
            self._asked.pop(link.peer, None)
            if link.peer in self.feeds:
                self.feeds[link.peer].idle = True
        if not resumed or link.peer in self._strayed:
            self._strayed.discard(link.peer)
            link.control.send({"t": "objects_lost"}, now=now)

    def went(self, client: ClientName, *, now: float) -> None:
        """A client is at a peer, whose word counts for its objects now."""
        if client in self._owners:
            self._strayed.add(client)
        self.peers.moved(client, now=now)

    def delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        self.peers.delivered(link, channel, now=now)
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.pump(now=now)

    def dropped(self, link: Link, channel: OutChannel) -> None:
        """Something of what was told will not arrive."""
        self.peers.dropped(link, channel)
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.dropped()

    def forget(self, client: ClientName) -> None:
        feed = self.feeds.pop(client, None)
        if feed is not None:
            self._first = max(self._first, feed.channel.next_seq)
        self._owners.pop(client, None)
        self._strayed.discard(client)
        self._asked.pop(client, None)
        if self._wants.pop(client, None) is not None:
            self._tell_peers()
        if is_peer(client):
            self.peers.forget(client)
        else:
            self.peers.far.forget(client)

    def every_feed(self) -> list[ObjectFeed]:
        """Those that tell clients and those that tell other relays."""
        return [*self.feeds.values(), *self.peers.feeds.values()]

    def channels(self) -> set[int]:
        """Identities of the channels of feeds, for tests."""
        return {id(feed.channel) for feed in self.every_feed()}

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self.feeds.keys() == self._wants.keys() >= self._asked.keys(), "who is told, and of what"
        assert self._strayed <= self._owners.keys(), "clients that told nothing have nothing to tell again"
        assert self._owners.keys() | self.feeds.keys() <= self._links.keys(), "objects of clients that are gone"
        for feed in self.feeds.values():
            feed.validate()
        self.peers.validate()


__all__ = ["OBJECTS_TOPIC", "ObjectExchange"]
