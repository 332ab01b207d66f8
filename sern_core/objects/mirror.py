"""What the other end of a hop tells of its registry (`ObjectFeed`), as it was told last. Pure.

What is here stays while the link is gone. Then either what is new since `version` is told, or everything: what is not
named then is gone. All of it is bounded, texts of definitions included, each of which is kept once.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from sern_core.objects.changes import Begin, Change, Define, Delete, End, Put, Set
from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.types import ClientName

OBJECT_BYTES = 512
"""What an object costs beside its texts and its value."""


@dataclass(frozen=True, slots=True)
class MirrorLimits:
    """What is kept: objects, their bytes (`OBJECT_BYTES` each, without texts of definitions), and bytes of those texts.
    What is more is counted, and not kept."""

    max_objects: int = 65_536
    max_bytes: int = 64 * 2**20
    max_texts_bytes: int = 16 * 2**20


class _Text:
    """The text of a definition, and how many objects have it."""

    __slots__ = ("text", "users")

    def __init__(self, text: str) -> None:
        self.text = text
        self.users = 0


class Mirror:
    """`changed(item, before)` is told of each object that is put or has another value, `before` None: it is new;
    `deleted(item)` of each that is gone. Both are called when the mirror has the change."""

    def __init__(
        self,
        limits: MirrorLimits,
        *,
        changed: Callable[[XrObject, XrObject | None], None],
        deleted: Callable[[XrObject], None],
    ) -> None:
        self.limits = limits
        self.objects: dict[str, XrObject] = {}
        self.counts: Counter[str] = Counter()
        """Changes that came: `put`, `deleted`, and `full`, which were not kept."""
        self.epoch = 0
        self.version = 0
        """Everything up to this version of that epoch has been told."""
        self.telling = 0
        """The epoch of the registry that tells now."""
        self._begun = False
        self._changed = changed
        self._deleted = deleted
        self._bytes = 0
        self._texts: dict[str, _Text] = {}  # by the hash that puts name
        self._texts_bytes = 0
        self._text_of: dict[str, str] = {}  # the hash of an object's text
        self._fresh: set[str] | None = None

    def apply(self, change: Change, *, now: float) -> None:
        """A change has its turn."""
        if isinstance(change, Begin):
            self._begun = True
            self.telling = change.epoch
            self._fresh = set() if change.whole else None
            for named in [named for named, text in self._texts.items() if not text.users]:
                self._texts_bytes -= len(self._texts.pop(named).text)
        elif isinstance(change, Define):
            self._define(change)
        elif isinstance(change, Put):
            self._put(change, now)
        elif isinstance(change, Set):
            self._set(change, now)
        elif isinstance(change, Delete):
            if self._fresh is not None:
                self._fresh.discard(change.object_id)
            self._delete(change.object_id)
        if isinstance(change, (Put, Set, Delete, End)) and change.upto is not None:
            self._ended(change.upto)

    def text_hash(self, object_id: str) -> str:
        """What the text of an object's definition is called on the wire; empty: it has none here."""
        return self._text_of.get(object_id, "")

    def _define(self, change: Define) -> None:
        if change.text_hash in self._texts:
            return
        if self._texts_bytes + len(change.text) <= self.limits.max_texts_bytes:
            self._texts_bytes += len(change.text)
            self._texts[change.text_hash] = _Text(change.text)
        else:
            self.counts["full"] += 1

    def _put(self, change: Put, now: float) -> None:
        old = self.objects.get(change.object_id)
        text = self._texts.get(change.text_hash)
        if self._fresh is not None:
            self._fresh.add(change.object_id)
        item = XrObject(
            id=change.object_id,
            owner=ClientName(change.owner),
            kind=change.kind,
            type_name=change.type_name,
            definition="" if text is None else text.text,
            definition_hash=change.definition_hash,
            attributes=change.attributes,
            value=change.value,
            value_bytes=change.value_bytes,
            value_sha256=change.value_sha256 or None,
            seq=change.seq,
            ros_stamp_ns=change.ros_stamp_ns,
            wall_ns=change.wall_ns,
            created_s=now if old is None else old.created_s,
            updated_s=now,
            version=self.version,
        )
        if not self._has_room(item, old):
            return
        self._use_text(item.id, "" if text is None else change.text_hash)
        self._keep(item, old)

    def _set(self, change: Set, now: float) -> None:
        old = self.objects.get(change.object_id)
        if old is None:
            # Where nothing has begun it was put before we were there, and all is told anew behind it.
            self.counts["full"] += self._begun  # there was no room for it when it was put
            return
        if self._fresh is not None:
            self._fresh.add(change.object_id)
        item = replace(
            old,
            value=change.value,
            value_bytes=change.value_bytes,
            value_sha256=change.value_sha256 or None,
            seq=change.seq,
            ros_stamp_ns=change.ros_stamp_ns,
            wall_ns=change.wall_ns,
            updated_s=now,
            version=self.version,
        )
        if self._has_room(item, old):
            self._keep(item, old)

    def _has_room(self, item: XrObject, old: XrObject | None) -> bool:
        """False: it is not kept, nor what there was of it."""
        more_bytes = _cost_bytes(item) - (0 if old is None else _cost_bytes(old))
        full = old is None and len(self.objects) >= self.limits.max_objects
        if not full and self._bytes + more_bytes <= self.limits.max_bytes:
            return True
        self.counts["full"] += 1
        if old is not None:
            self._delete(old.id)
        return False

    def _keep(self, item: XrObject, old: XrObject | None) -> None:
        self.counts["put"] += 1
        self._bytes += _cost_bytes(item) - (0 if old is None else _cost_bytes(old))
        self.objects[item.id] = item
        self._changed(item, old)

    def _delete(self, object_id: str) -> None:
        old = self.objects.pop(object_id, None)
        if old is None:
            return
        self.counts["deleted"] += 1
        self._bytes -= _cost_bytes(old)
        self._use_text(object_id, "")
        self._deleted(old)

    def _use_text(self, object_id: str, named: str) -> None:
        """The object's definition is that text, empty: none. One that nobody has any more stays for those to come."""
        before = self._text_of.pop(object_id, "")
        if before:
            self._texts[before].users -= 1
        if named:
            self._texts[named].users += 1
            self._text_of[object_id] = named

    def _ended(self, upto: int) -> None:
        """Everything up to this version has been told."""
        self.epoch, self.version = self.telling, upto
        if self._fresh is not None:
            for object_id in [object_id for object_id in self.objects if object_id not in self._fresh]:
                self._delete(object_id)
            self._fresh = None

    def validate(self) -> None:
        """Internal consistency, for tests."""
        limits = self.limits
        assert self._bytes == sum(map(_cost_bytes, self.objects.values())) <= limits.max_bytes, "bytes of objects"
        assert len(self.objects) <= limits.max_objects, "objects"
        texts_bytes = sum(len(text.text) for text in self._texts.values())
        assert self._texts_bytes == texts_bytes <= limits.max_texts_bytes, "texts"
        users = Counter(self._text_of.values())
        assert users == {named: text.users for named, text in self._texts.items() if text.users}, "users of texts"
        assert self._text_of.keys() <= self.objects.keys(), "texts of objects that are gone"


def _cost_bytes(item: XrObject) -> int:
    texts = (item.id, item.type_name, item.definition_hash, *item.attributes, *item.attributes.values())
    return OBJECT_BYTES + sum(map(len, texts)) + len(item.value or b"")
