"""What a client asks the relay for: the patterns of its file, and the topics that parts of it add by name."""

from collections.abc import Callable, Iterable, Sequence

from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.types import TopicName


class Subscribed:
    """`tell(patterns)` replaces what the relay was told."""

    def __init__(self, tell: Callable[[tuple[str, ...]], None]) -> None:
        self._own = PatternSet(())
        self._tell = tell
        self._added: dict[str, tuple[TopicName, ...]] = {}

    def begin(self, patterns: Sequence[str]) -> None:
        """The patterns of the client's file."""
        self._own = PatternSet(patterns)
        self._tell(self._all())

    def covers(self, name: TopicName) -> bool:
        """Whether the client asks for a topic by itself."""
        return self._own.fullmatch(name)

    def add(self, part: str, names: Iterable[TopicName]) -> None:
        """A part of the client wants these, in place of what it wanted before."""
        self._added[part] = tuple(names)
        self._tell(self._all())

    def _all(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self._own.texts, *(name for names in self._added.values() for name in names))))
