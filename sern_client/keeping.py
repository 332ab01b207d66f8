"""Reliable messages that were published here and are not kept yet: they are confirmed when they are.

An endpoint that keeps messages (a recording) counts what it takes and says up to which number it is flushed
(`KeepingEndpoint`). Which message had which number is remembered here, so that conversion, frame ids and several
endpoints between the bridge and the file make no difference.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sern_client.endpoints.base import KeepingEndpoint
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import DropReason

Hold = Callable[[StreamId, int], None]
"""`hold(stream, seq)`: do not confirm it yet."""
Release = Callable[[StreamId, int, DropReason | None], None]
"""`release(stream, seq, lost)`: it is kept, or was lost for a reason."""

Told = Callable[[StreamId, int, DropReason | None], None]
"""`told(stream, seq, lost)`, once for each keeper of a message: that one keeps it, or lost it for a reason."""

Numbers = tuple[int, ...]

SOON_S: Final = 0.005
"""Least wait of a reliable message before it is flushed, so that many are flushed together."""


class KeeperNumbers:
    """Which message has which number at which of `keepers`. `mark` before a message is published, `published` after."""

    def __init__(self, keepers: Sequence[KeepingEndpoint], told: Told) -> None:
        self.keepers = list(keepers)
        self._told = told
        self._waiting: list[deque[tuple[int, StreamId, int]]] = [deque() for _ in self.keepers]  # in order of number
        for index, keeper in enumerate(self.keepers):
            keeper.watch_kept(lambda upto, lost, index=index: self._kept(index, upto, lost))  # type: ignore[misc]

    def mark(self) -> Numbers:
        return tuple(keeper.taken for keeper in self.keepers)

    def published(self, stream: StreamId, seq: int, mark: Numbers) -> int:
        """The keepers that have taken something since `mark` have taken this message; returns how many."""
        took = [i for i, keeper in enumerate(self.keepers) if keeper.taken > mark[i]]
        for index in took:
            self._waiting[index].append((self.keepers[index].taken, stream, seq))
        return len(took)

    def _kept(self, index: int, upto: int, lost: Mapping[int, DropReason]) -> None:
        waiting = self._waiting[index]
        last = max(upto, max(lost, default=0))
        again: list[tuple[int, StreamId, int]] = []
        while waiting and waiting[0][0] <= last:
            number, stream, seq = waiting.popleft()
            if number > upto and number not in lost:
                again.append((number, stream, seq))
                continue
            self._told(stream, seq, lost.get(number))
        waiting.extendleft(reversed(again))


class Keeping:
    """Holds what waits for `keepers`. `mark` before a message is published, `published` after it. `soon` is called with
    the delay after which `keep_soon` should be."""

    def __init__(
        self, keepers: Sequence[KeepingEndpoint], hold: Hold, release: Release, soon: Callable[[float], None]
    ) -> None:
        self._numbers = KeeperNumbers(keepers, self._one)
        self._hold = hold
        self._release = release
        self._soon = soon
        self._asked = False
        self._left: dict[tuple[StreamId, int], int] = {}  # message -> keepers that have not kept it

    def __bool__(self) -> bool:
        return bool(self._numbers.keepers)

    @property
    def pending(self) -> int:
        """Messages that are not confirmed because they are not kept yet."""
        return len(self._left)

    def mark(self) -> Numbers:
        return self._numbers.mark()

    def published(self, stream: StreamId, seq: int, mark: Numbers) -> bool:
        """The keepers that have taken something since `mark` have taken this message. False: there are none, and it is
        not held."""
        took = self._numbers.published(stream, seq, mark)
        if not took:
            return False
        self._left[stream, seq] = took
        self._hold(stream, seq)
        if not self._asked:
            self._asked = True
            self._soon(SOON_S)
        return True

    def keep_soon(self) -> None:
        """Have what waits kept, if that is cheap."""
        self._asked = False
        if self._left:
            for keeper in self._numbers.keepers:
                keeper.keep_soon()

    def flush(self) -> None:
        """Have everything kept now."""
        for keeper in self._numbers.keepers:
            keeper.flush()

    def _one(self, stream: StreamId, seq: int, lost: DropReason | None) -> None:
        left = self._left.get((stream, seq))
        if left is None:
            return  # another has lost it
        if left > 1 and lost is None:
            self._left[stream, seq] = left - 1
            return
        del self._left[stream, seq]
        self._release(stream, seq, lost)
