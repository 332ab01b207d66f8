"""Objects of others that this client subscribes to, as the relay tells of them. Pure."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, Protocol

from sern_core.link.control_stream import ControlStream
from sern_core.objects.changes import MAX_WANTS, decode
from sern_core.objects.mirror import Mirror, MirrorLimits
from sern_core.objects.xr_object import XrObject
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.types import ObjectKind

MAX_PATTERNS_CHARS: Final = 3000
"""All patterns together: they go in one envelope."""


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
        self._mirror = Mirror(MirrorLimits(), changed=self._changed, deleted=self._deleted)

    @property
    def objects(self) -> dict[str, XrObject]:
        """The objects that are there, by their ids."""
        return self._mirror.objects

    @property
    def counts(self) -> Counter[str]:
        """Changes that came: `put`, `deleted`, `malformed`, and `full`, which were not kept."""
        return self._mirror.counts

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
        if self.selections or self._mirror.version:
            self._control.send(
                {
                    "t": "objects",
                    "kinds": ["" if each.kind is None else str(each.kind) for each in self.selections],
                    "match": [each.pattern for each in self.selections],
                    "bare": sum(not each.valued for each in self.selections),
                    "since": self._mirror.version,
                    "epoch": self._mirror.epoch,
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
        self._mirror.apply(change, now=now)

    def _changed(self, item: XrObject, _before: XrObject | None) -> None:
        for listener in self.listeners:
            self._tell(partial(listener.changed, item))

    def _deleted(self, item: XrObject) -> None:
        for listener in self.listeners:
            self._tell(partial(listener.deleted, item.id))

    def validate(self) -> None:
        """Internal consistency, for tests."""
        self._mirror.validate()


__all__ = ["MAX_WANTS", "ObjectListener", "ObjectMirror", "Selection"]
