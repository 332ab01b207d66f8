"""Tells the other end of a hop what changes in a registry: each object's latest state, and no more than is read. Pure.

Nothing is queued while there is no session, and little while there is one: what changes meanwhile is told once, as it
is then. So a link that was gone for an hour brings only what is new, and a thin link tells of what changes all the time
as often as it can.
"""

from collections.abc import Callable, Collection, Iterable
from typing import Final, NamedTuple

from sern_core.link.link import Link
from sern_core.objects.changes import (
    Begin,
    Define,
    Delete,
    End,
    encode,
    object_stream,
    put_of,
    set_of,
)
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import ObjectKind

PERIOD_S: Final = 0.1
"""How often a feed is to be looked at."""
REST_S: Final = 0.05
"""How long after a look at what has changed comes the next one at least. Two feeds in a row, client's and relay's, are
to carry what changes ten times a second (the paper's patches) each time."""
BURST_S: Final = 0.01
"""What changes so soon after a look is of the same event, and goes with it."""
LEAST_AHEAD_BYTES: Final = 2048
MOST_AHEAD_BYTES: Final = 64 * 2**10
"""What may wait for the link. It is doubled when all of it has gone by the time that more is due, and halved when
something of it waits for `OLD_S`: what waits there grows old, what waits in the registry is told as it is then."""
OLD_S: Final = 0.15
MOST_UNREAD_BYTES: Final = 256 * 2**10
"""What the reader may not have confirmed."""
LOOKS: Final = 256
"""Objects that are told in one turn."""
OVERHEAD_BYTES: Final = 40
"""What a message costs beside its body."""

Sees = Callable[[str, ObjectKind | None], bool]
"""Whether the reader wants an object, and may have it. None: the kind of one that is gone is not known."""
WantsValue = Callable[[str, ObjectKind], bool]
"""Whether the reader wants an object's value, too. None in its place: it wants no value at all, and what has another
value alone is not even looked at."""


def _always(_object_id: str, _kind: ObjectKind) -> bool:
    return True


class _Told(NamedTuple):
    """An object that the reader has: its version, the hash of its texts, and, where it is told without a value, the
    version in which it was described last, else 0."""

    version: int
    texts: int
    bare: int


class ObjectFeed:
    """`sees`, `kinds` and `wants_value` say what it is about; to change them, set them and call `restart`. `text_of`
    gives the text of an object's definition, empty where there is none. `untold` counts objects whose texts fit into no
    message. `passes`: how many are looked at in one turn, also where there is nothing to tell of them."""

    def __init__(
        self,
        registry: ObjectRegistry,
        link: Link,
        *,
        sees: Sees,
        text_of: Callable[[XrObject], str],
        now: float,
        kinds: Collection[ObjectKind] | None = None,
        wants_value: WantsValue | None = _always,
        first: int = 1,
        passes: int = LOOKS,
    ) -> None:
        self._registry = registry
        self._link = link
        self.sees = sees
        self.kinds = kinds
        self.wants_value = wants_value
        self._text_of = text_of
        self._passes = passes
        self.channel = link.outgoing.open(object_stream(link.end.name, link.end.boot), first=first, now=now)
        self.untold = 0
        self.idle = False
        """Nobody is to be told anything."""
        self._pending: dict[str, None] = {}
        self._again: set[str] = set()  # of those: also where nothing has changed that the reader is told of
        self._told: dict[str, _Told] = {}
        self._texts: set[str] = set()  # hashes of the texts that it has
        self._version = 0  # up to which `_pending` is what has changed
        self._began = False
        self._open = False  # a batch that was begun and is not ended
        self._unsure = False  # the reader has objects from an earlier feed
        self._looked_s = now - REST_S
        self._ahead_bytes = LEAST_AHEAD_BYTES
        self._full = False  # what may wait did, since it was looked at last
        self.restart()

    def restart(self, version: int = 0, epoch: int | None = None) -> None:
        """The reader has everything up to this version of that epoch, and nothing else of us."""
        changes = self._registry.changed(version, epoch=epoch, kinds=self.kinds)
        whole = changes.resync or version == 0
        self._began = False
        self._unsure = not whole
        self._told.clear()
        self._again.clear()
        self._texts.clear()
        self._open = True
        self._pending = dict.fromkeys(changes.in_order)
        self._version = changes.version

    def dropped(self) -> None:
        """Something of what was told will not arrive: tell all anew."""
        self.restart()

    def look_again(self, object_ids: Iterable[str]) -> None:
        """Whether the reader may have these objects, or wants their values, may be another matter now. What it has of
        all others stays."""
        again = dict.fromkeys(object_ids)
        self._again.update(again)
        self._pending |= again
        self._open = self._open or bool(again)

    def revalue(self) -> None:
        """The reader wants the values of other objects than before: `wants_value`."""
        self.look_again(self._registry.named())

    def pump(self, *, now: float) -> None:
        """Tell what is due. Call when something has changed, when the reader has confirmed something, and every
        `PERIOD_S`."""
        if self.idle or not self._link.established or self.channel.wanted is False:
            return
        channel = self.channel
        if not channel.queue:
            if self._full:
                self._ahead_bytes = min(2 * self._ahead_bytes, MOST_AHEAD_BYTES)
            self._full = False
        elif now - channel.queue[0].message.born_s > OLD_S:
            if self._full:
                self._ahead_bytes = max(self._ahead_bytes // 2, LEAST_AHEAD_BYTES)
            self._full = False
            return
        self._poll(now)
        looks = passes = 0
        while looks < LOOKS and passes < self._passes and self._room():
            if not self._began:
                self._began = True
                self._say(encode(Begin(self._registry.epoch, not self._unsure)), now)
            elif self._pending:
                object_id = next(iter(self._pending))
                del self._pending[object_id]
                seq = channel.next_seq
                self._tell(object_id, now)
                looks += channel.next_seq > seq
                passes += 1
            elif self._open:
                self._open = False
                self._say(encode(End(self._version)), now)
            else:
                return
        if not self._room():
            self._full = True

    @property
    def settled(self) -> bool:
        """Whether the reader has confirmed everything that there was to tell."""
        return not (self._pending or self._open or self.channel.retained) and self._version == self._registry.version

    @property
    def at_rest(self) -> bool:
        """Whether `pump` has nothing to do."""
        if self.idle:
            return True
        return self._began and not (self.channel.queue or self._pending or self._open or self._full or self._new)

    @property
    def _new(self) -> bool:
        """Whether something has changed that the reader may have to be told."""
        registry = self._registry
        newest = registry.described_version if self.wants_value is None else registry.version
        return self._version < newest

    def _poll(self, now: float) -> None:
        registry = self._registry
        if self._pending or self._open or not self._new:
            return
        if now >= self._looked_s + REST_S:
            self._looked_s = now
        elif now > self._looked_s + BURST_S:
            return
        changes = registry.changed(self._version, kinds=self.kinds)
        if changes.resync:
            self.restart()
            return
        self._pending = dict.fromkeys(changes.in_order)
        self._version = changes.version

    def _tell(self, object_id: str, now: float) -> None:
        upto = None if self._pending else self._version
        known = self._told.get(object_id)
        again = object_id in self._again
        self._again.discard(object_id)
        if known is not None and known.bare and known.bare == self._registry.described(object_id) and not again:
            return  # it has another value, of which the reader wants none
        about = self._registry.about(object_id)
        if about is None or not self.sees(object_id, about[0]):
            unsure = about is None and self._unsure and self.sees(object_id, None)
            if self._told.pop(object_id, None) is not None or unsure:
                self._say(encode(Delete(object_id, upto)), now)
                self._open = bool(self._pending)
            return
        valued = self.wants_value is not None and self.wants_value(object_id, about[0])
        item = self._registry.get(object_id, valued=valued)
        if item is None:
            return
        if known is not None and valued is not bool(known.bare):  # with its value or without, as it was told
            told = known.version == item.version if valued else known.bare == self._registry.described(object_id)
            if told:
                return
        text = self._text_of(item)
        put = put_of(item, text, upto=upto)
        texts = hash((put[:6], tuple(put.attributes.items())))
        try:
            body = encode(set_of(put) if known is not None and known.texts == texts else put)
        except UsageError:
            self.untold += 1  # of this object alone: the others go on
            return
        named = put.text_hash
        if text and named not in self._texts:
            self._texts.add(named)
            self._say(encode(Define(named, text)), now)
        self._told[object_id] = _Told(item.version, texts, 0 if valued else self._registry.described(object_id))
        self._say(body, now)
        self._open = bool(self._pending)

    def _say(self, body: bytes, now: float) -> None:
        channel = self.channel
        message = Message(channel.stream.id, channel.next_seq, body, 0, now)
        self._link.sender.submit(channel, message, now=now, forced=True)

    def _room(self) -> bool:
        channel = self.channel
        ahead_bytes = channel.queued_bytes + OVERHEAD_BYTES * len(channel.queue)
        unread_bytes = channel.retained_bytes + OVERHEAD_BYTES * len(channel.retained)
        return ahead_bytes < self._ahead_bytes and unread_bytes < MOST_UNREAD_BYTES

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._version <= self._registry.version, "a feed that is ahead of its registry"
        assert self._link.outgoing.by_stream.get(self.channel.stream.id) is self.channel, "a feed without its channel"
        assert len(self._pending) <= len(self._registry) + self._registry.limits.deletions, "more to tell than there is"
