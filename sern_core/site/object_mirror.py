"""Objects of others that this client subscribes to, as the relay tells of them. Pure.

What is here stays while the link is gone; then the relay tells what is new since `version`, or, where it does not know
any more, everything: what it does not name then is gone.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, Protocol

from sern_core.link.control_stream import ControlStream
from sern_core.objects.changes import MAX_WANTS, Begin, Define, Delete, End, Put, Set, decode, put_of
from sern_core.objects.xr_object import XrObject
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.types import ClientName, ObjectKind

MAX_OBJECTS: Final = 65_536
MAX_BYTES: Final = 64 * 2**20
MAX_TEXTS_BYTES: Final = 16 * 2**20
"""What is kept of a relay: its objects, their bytes, and the texts of their definitions. What is more is counted."""
MAX_PATTERNS_CHARS: Final = 3000
"""All patterns together: they go in one envelope."""
OBJECT_BYTES: Final = 512
"""What an object costs beside its texts and its value."""


class Selection(NamedTuple):
    """Objects of a kind (None: any) whose ids match a pattern (full match). Not `valued`: without their values."""

    kind: ObjectKind | None = None
    pattern: str = ".*"
    valued: bool = True


class ObjectListener(Protocol):
    """Who is told. What it raises is a fault of its own; the mirror has the change by then."""

    def changed(self, item: XrObject) -> None: ...

    def deleted(self, object_id: str) -> None: ...


class ObjectMirror:
    """`tell` calls a listener so that its failure stops nothing."""

    def __init__(self, control: ControlStream, tell: Callable[[Callable[[], None]], None]) -> None:
        self._control = control
        self._tell = tell
        self.selections: tuple[Selection, ...] = ()
        self.listeners: list[ObjectListener] = []
        self.objects: dict[str, XrObject] = {}
        self.counts: Counter[str] = Counter()
        """Changes that came: `put`, `deleted`, `malformed`, and `full`, which were not kept."""
        self._bytes = 0
        self._texts: dict[str, str] = {}
        self._texts_bytes = 0
        self._epoch = 0
        self._version = 0
        self._telling = 0  # epoch of the relay that tells now
        self._fresh: set[str] | None = None

    def select(self, selections: Sequence[Selection]) -> None:
        """What to subscribe to, from the next `send` on. UsageError: a pattern is none, or there are too many."""
        if len(selections) > MAX_WANTS or sum(len(each.pattern) for each in selections) > MAX_PATTERNS_CHARS:
            raise UsageError(
                f"{len(selections)} selections of objects; at most {MAX_WANTS} with {MAX_PATTERNS_CHARS} characters"
            )
        for selection in selections:
            compile_pattern(selection.pattern)
        self.selections = tuple(sorted(selections, key=lambda each: not each.valued))

    def send(self, *, now: float) -> None:
        """Tell the relay what is wanted, and what is here. Call in every session that begins, and after `select`."""
        if self.selections or self._version:
            self._control.send(
                {
                    "t": "objects",
                    "kinds": ["" if each.kind is None else str(each.kind) for each in self.selections],
                    "match": [each.pattern for each in self.selections],
                    "bare": sum(not each.valued for each in self.selections),
                    "since": self._version,
                    "epoch": self._epoch,
                },
                now=now,
            )

    def message(self, body: bytes, *, now: float) -> None:
        """A change has its turn."""
        try:
            change = decode(body)
        except WireError:
            self.counts["malformed"] += 1  # of the relay's own: it is told again with the next change of it
            return
        if isinstance(change, Begin):
            self._telling = change.epoch
            self._fresh = set() if change.whole else None
            self._texts.clear()
            self._texts_bytes = 0
        elif isinstance(change, Define):
            if change.text_hash in self._texts:
                return
            if self._texts_bytes + len(change.text) <= MAX_TEXTS_BYTES:
                self._texts_bytes += len(change.text)
                self._texts[change.text_hash] = change.text
            else:
                self.counts["full"] += 1
        elif isinstance(change, Put):
            self._put(change, self._texts.get(change.text_hash, ""), now)
        elif isinstance(change, Set):
            self._set(change, now)
        elif isinstance(change, Delete):
            self._delete(change.object_id)
        if isinstance(change, (Put, Set, Delete, End)) and change.upto is not None:
            self._ended(change.upto)

    def _set(self, change: Set, now: float) -> None:
        old = self.objects.get(change.object_id)
        if old is None:
            self.counts["full"] += 1  # there was no room for it when it was put
            return
        put = put_of(old, old.definition)
        self._put(put._replace(**{field: getattr(change, field) for field in Set._fields}), old.definition, now)

    def _put(self, change: Put, definition: str, now: float) -> None:
        old = self.objects.get(change.object_id)
        if self._fresh is not None:
            self._fresh.add(change.object_id)
        item = XrObject(
            id=change.object_id,
            owner=ClientName(change.owner),
            kind=change.kind,
            type_name=change.type_name,
            definition=definition,
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
            version=self._version,
        )
        more_bytes = _cost_bytes(item) - (0 if old is None else _cost_bytes(old))
        if (old is None and len(self.objects) >= MAX_OBJECTS) or self._bytes + more_bytes > MAX_BYTES:
            self.counts["full"] += 1
            if old is not None:
                self._delete(old.id)
            return
        self.counts["put"] += 1
        self._bytes += more_bytes
        self.objects[item.id] = item
        for listener in self.listeners:
            self._tell(partial(listener.changed, item))

    def _delete(self, object_id: str) -> None:
        old = self.objects.pop(object_id, None)
        if self._fresh is not None:
            self._fresh.discard(object_id)
        if old is None:
            return
        self.counts["deleted"] += 1
        self._bytes -= _cost_bytes(old)
        for listener in self.listeners:
            self._tell(partial(listener.deleted, object_id))

    def _ended(self, upto: int) -> None:
        """Everything up to this version has been told."""
        self._epoch, self._version = self._telling, upto
        if self._fresh is not None:
            for object_id in [object_id for object_id in self.objects if object_id not in self._fresh]:
                self._delete(object_id)
            self._fresh = None

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._bytes == sum(map(_cost_bytes, self.objects.values())) <= MAX_BYTES, "bytes of objects"
        assert len(self.objects) <= MAX_OBJECTS, "objects"
        assert self._texts_bytes == sum(map(len, self._texts.values())) <= MAX_TEXTS_BYTES, "texts"


def _cost_bytes(item: XrObject) -> int:
    texts = (item.id, item.type_name, item.definition_hash, *item.attributes, *item.attributes.values())
    return OBJECT_BYTES + sum(map(len, texts)) + len(item.value or b"")


__all__ = ["MAX_WANTS", "ObjectListener", "ObjectMirror", "Selection"]
