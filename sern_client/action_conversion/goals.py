"""The goals that nodes here have given to one action, by both of their names: bounded, whoever gives and ends them."""

from collections.abc import Iterator
from typing import Final, Generic, Protocol, TypeVar

from sern_client.actions import GoalId
from sern_core.site.services import MAX_CALLS

MAX_LIVE: Final = MAX_CALLS
"""Goals under way: as many calls for a result may wait at one service."""
MAX_GOALS: Final = 256
"""Goals that are known, ended ones among them."""
MAX_RESULT_BYTES: Final = 16 * 2**20
"""Results that are kept for whoever asks."""


class Named(Protocol):
    """What a goal is called in ROS 1 and in ROS 2 (16 bytes)."""

    @property
    def ident(self) -> GoalId: ...

    @property
    def uuid(self) -> bytes: ...


G = TypeVar("G", bound=Named)


class GoalTable(Generic[G]):
    """Goals that ended stay for `keep_s`, the oldest of them go first when there are too many, or too large ones.

    `now`: seconds on any clock that is never stepped.
    """

    def __init__(
        self,
        keep_s: float,
        *,
        max_live: int = MAX_LIVE,
        max_goals: int = MAX_GOALS,
        max_result_bytes: int = MAX_RESULT_BYTES,
    ) -> None:
        self.keep_s = keep_s
        self._max_live = max_live
        self._max_goals = max_goals
        self._max_result_bytes = max_result_bytes
        self._by_uuid: dict[bytes, G] = {}
        self._by_text: dict[str, G] = {}
        self._ended: dict[bytes, tuple[float, int]] = {}  # when, and the size of the result; the oldest first
        self._result_bytes = 0

    def __len__(self) -> int:
        return len(self._by_uuid)

    def __iter__(self) -> Iterator[G]:
        return iter(self._by_uuid.values())

    @property
    def live(self) -> list[G]:
        """Those that have not ended, the oldest first."""
        return [goal for uuid, goal in self._by_uuid.items() if uuid not in self._ended]

    @property
    def busy(self) -> bool:
        """Whether any has not ended."""
        return len(self._by_uuid) > len(self._ended)

    @property
    def due_s(self) -> float | None:
        """When the next one is to be forgotten."""
        return next((ended_s + self.keep_s for ended_s, _ in self._ended.values()), None)

    def of_uuid(self, uuid: bytes) -> G | None:
        return self._by_uuid.get(uuid)

    def of_text(self, text: str) -> G | None:
        return self._by_text.get(text)

    def has_ended(self, goal: G) -> bool:
        """Also of one that is forgotten."""
        return self._by_uuid.get(goal.uuid) is not goal or goal.uuid in self._ended

    def add(self, goal: G) -> str:
        """Take a goal. Why it is not taken, in a few words, or nothing. One that ended makes room for its like."""
        earlier = [self._by_uuid.get(goal.uuid), self._by_text.get(goal.ident.text)]
        if any(each is not None and not self.has_ended(each) for each in earlier):
            return "a goal of that id is under way"
        if len(self._by_uuid) - len(self._ended) >= self._max_live:
            return f"{self._max_live} goals are under way already"
        for each in earlier:
            if each is not None:
                self._forget(each.uuid)
        while len(self._by_uuid) >= self._max_goals:
            self._forget(next(iter(self._ended)))
        self._by_uuid[goal.uuid] = goal
        self._by_text[goal.ident.text] = goal
        return ""

    def end(self, goal: G, result_bytes: int = 0, *, now: float) -> None:
        """A goal has ended, with a result of that size. The newest result is kept, however large."""
        if self.has_ended(goal):
            return
        self._ended[goal.uuid] = now, result_bytes
        self._result_bytes += result_bytes
        while self._result_bytes > self._max_result_bytes and len(self._ended) > 1:
            self._forget(next(iter(self._ended)))

    def expire(self, *, now: float) -> bool:
        """Forget what has been kept long enough. Whether there was any."""
        before = len(self._ended)
        while self._ended and (due_s := self.due_s) is not None and due_s <= now:
            self._forget(next(iter(self._ended)))
        return len(self._ended) < before

    def _forget(self, uuid: bytes) -> None:
        goal = self._by_uuid.pop(uuid, None)
        _, result_bytes = self._ended.pop(uuid, (0.0, 0))
        self._result_bytes -= result_bytes
        if goal is not None and self._by_text.get(goal.ident.text) is goal:
            del self._by_text[goal.ident.text]
