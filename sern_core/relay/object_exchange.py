"""Objects over the link, the relay's half: what clients put is taken in, and those who subscribe are told. Pure.

`node:NAME` is the object of the client of that name, which needs no right for it. Any other id stands for a global
name: itself, without the `@client` at its end, under the leading `/` of names. Who may publish that name may put it,
who may subscribe to it is told of it; `node:NAME` is told to who may subscribe to `/NAME/node`.
"""

import re
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
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern, PatternError, compile_pattern
from sern_core.vocabulary.errors import RefusedError, UsageError, WireError
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import ClientName, ObjectKind, TopicName
from sern_core.wire import framing

NODE: Final = "node:"
"""How the id of a client's own object begins."""
_OWNED: Final = re.compile(r"(.*)@[a-z][a-z0-9_]{0,62}", re.DOTALL)
MAX_TEXTS_BYTES: Final = 2**20
"""Texts of definitions that a client has sent and that its next objects may name."""
CHANGE_US: Final = 40
BYTES_PER_US: Final = 64
PATTERN_US: Final = 100
LOOK_US: Final = 2
"""What a client is charged with: a change of an object, its size, a pattern, and an object that one is held against."""


def name_of(object_id: str) -> TopicName:
    """The global name that an object's id stands for."""
    if object_id.startswith(NODE):
        return TopicName(f"/{object_id.removeprefix(NODE)}/node")
    owned = _OWNED.fullmatch(object_id)
    return TopicName("/" + (object_id if owned is None else owned[1]).lstrip("/"))


def check_right(access: AccessTable, client: ClientName, object_id: str) -> None:
    """Raises RefusedError when the client may not have an object of this id."""
    if object_id.startswith(NODE):
        if object_id != NODE + client:
            raise RefusedError("not_owner", f"{client} may not put {object_id[:80]}: it belongs to the client it names")
        return
    name = TopicName("/" + object_id.removesuffix(f"@{client}").lstrip("/"))
    if not access.may_publish(client, name):
        raise RefusedError(
            "forbidden",
            f"{client} may not put {object_id[:80]}: no access rule lets it publish {name[:80]}; "
            "add it under access.publish",
        )


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
    is told what is not taken; `attempt` does something about a client so that its failure is that client's."""

    def __init__(
        self,
        registry: ObjectRegistry,
        links: Mapping[ClientName, Link],
        *,
        access: Callable[[], AccessTable],
        text_of: Callable[[XrObject], str],
        refused: Callable[[ClientName, str, str], None],
        attempt: Callable[[ClientName, float, Callable[[], object]], None],
    ) -> None:
        self._attempt = attempt
        self._registry = registry
        self._links = links
        self._access = access
        self._text_of = text_of
        self._refused = refused
        self._owners: dict[ClientName, _Owner] = {}
        self._wants: dict[ClientName, tuple[_Want, ...]] = {}
        self._asked: dict[ClientName, object] = {}  # what each said last, as it said it
        self.feeds: dict[ClientName, ObjectFeed] = {}
        """By the client that is told."""
        self._first = 1  # a client that was forgotten and comes back has read so many messages of the stream
        self.counts: Counter[str] = Counter()
        """Changes that clients sent: `taken`, or the code of the refusal."""

    # --- what clients put -----------------------------------------------------------------------------------------

    def message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        """A change of a client's objects has its turn."""
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
            elif isinstance(change, Define):  # it came packed
                link.reassembly.work_us += len(change.text) // BYTES_PER_US
            self._apply(self._owners.setdefault(client, _Owner()), client, change, now)
        except (RefusedError, WireError) as error:
            code = error.code if isinstance(error, RefusedError) else "bad_object"
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
        client = link.peer
        kinds = framing.take_strings(envelope, "kinds", max_length=16)
        patterns = framing.take_strings(envelope, "match")
        since, epoch = framing.take_int(envelope, "since", default=0), framing.take_int(envelope, "epoch", default=0)
        bare = framing.take_int(envelope, "bare", default=0)
        if len(kinds) != len(patterns) or len(kinds) > MAX_WANTS:
            raise WireError(f"a subscription of {len(kinds)} kinds and {len(patterns)} patterns of objects")
        if not set(kinds) <= _KINDS:
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

    def pump(self, *, now: float) -> None:
        """Tell those who subscribe what is due. Call ten times a second."""
        for client, feed in list(self.feeds.items()):
            self._attempt(client, now, partial(feed.pump, now=now))

    def revoke(self) -> None:
        """There are new access rules: everyone is told anew what it may have, and forgets what it may not."""
        for feed in self.feeds.values():
            feed.restart()

    # --- news of the link -----------------------------------------------------------------------------------------

    def came(self, link: Link, *, resumed: bool, now: float) -> None:
        """A session has begun. Another process has nothing of what the one before was told, and says what it wants;
        and of one that was forgotten nothing is here."""
        if not resumed:
            self._asked.pop(link.peer, None)
            if link.peer in self.feeds:
                self.feeds[link.peer].idle = True
            link.control.send({"t": "objects_lost"}, now=now)

    def delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.pump(now=now)

    def dropped(self, link: Link, channel: OutChannel) -> None:
        """Something of what was told will not arrive."""
        feed = self.feeds.get(link.peer)
        if feed is not None and feed.channel is channel:
            feed.dropped()

    def forget(self, client: ClientName) -> None:
        feed = self.feeds.pop(client, None)
        if feed is not None:
            self._first = max(self._first, feed.channel.next_seq)
        self._owners.pop(client, None)
        self._wants.pop(client, None)
        self._asked.pop(client, None)

    def channels(self) -> set[int]:
        """Identities of the channels of feeds, for tests."""
        return {id(feed.channel) for feed in self.feeds.values()}

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self.feeds.keys() == self._wants.keys() >= self._asked.keys(), "who is told, and of what"
        assert self._owners.keys() | self.feeds.keys() <= self._links.keys(), "objects of clients that are gone"
        for feed in self.feeds.values():
            feed.validate()


_KINDS: Final = frozenset(ObjectKind) | {""}
__all__ = ["NODE", "OBJECTS_TOPIC", "ObjectExchange", "check_right", "name_of"]
