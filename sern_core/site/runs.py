"""Sets of message numbers as runs: what arrived of a stream, and what did not. Pure."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

Run = tuple[int, int]
"""First and last number."""


class Runs:
    """Disjoint runs of whole numbers, rising; neighbours are one run."""

    __slots__ = ("_firsts", "_lasts", "count")

    def __init__(self, runs: Iterator[Run] | tuple[Run, ...] | list[Run] = ()) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []
        self.count = 0
        """How many numbers are in it."""
        for first, last in runs:
            self.add(first, last)

    def __iter__(self) -> Iterator[Run]:
        return zip(self._firsts, self._lasts, strict=True)

    def __len__(self) -> int:
        """How many runs there are."""
        return len(self._firsts)

    def __contains__(self, number: int) -> bool:
        index = bisect_right(self._firsts, number) - 1
        return index >= 0 and number <= self._lasts[index]

    @property
    def last(self) -> int:
        """The highest number; 0: there is none."""
        return self._lasts[-1] if self._lasts else 0

    def add(self, first: int, last: int) -> int:
        """Add the numbers from `first` to `last`. Returns how many of them are new."""
        firsts, lasts = self._firsts, self._lasts
        if lasts and first == lasts[-1] + 1:  # what comes in order
            lasts[-1] = last
            self.count += last - first + 1
            return last - first + 1
        low = bisect_left(lasts, first - 1)
        high = bisect_right(firsts, last + 1)
        before = sum(lasts[i] - firsts[i] + 1 for i in range(low, high))
        if low < high:
            first, last = min(first, firsts[low]), max(last, lasts[high - 1])
        firsts[low:high] = [first]
        lasts[low:high] = [last]
        new = last - first + 1 - before
        self.count += new
        return new

    def remove(self, number: int) -> None:
        """Leave out a number."""
        firsts, lasts = self._firsts, self._lasts
        index = bisect_right(firsts, number) - 1
        if index < 0 or number > lasts[index]:
            return
        first, last = firsts[index], lasts[index]
        left = [run for run in ((first, number - 1), (number + 1, last)) if run[0] <= run[1]]
        firsts[index : index + 1] = [run[0] for run in left]
        lasts[index : index + 1] = [run[1] for run in left]
        self.count -= 1

    def remove_below(self, number: int) -> None:
        """Leave out every number below this one."""
        index = bisect_left(self._lasts, number)
        self.count -= sum(self._lasts[i] - self._firsts[i] + 1 for i in range(index))
        del self._firsts[:index], self._lasts[:index]
        if self._firsts and self._firsts[0] < number:
            self.count -= number - self._firsts[0]
            self._firsts[0] = number

    def within(self, first: int, last: int) -> int:
        """How many numbers from `first` to `last` are in it."""
        firsts, lasts = self._firsts, self._lasts
        low, high = bisect_left(lasts, first), bisect_right(firsts, last)
        if low >= high:
            return 0
        # What lies outside is little where this is asked for often.
        outside: int = sum(lasts[i] - firsts[i] + 1 for i in (*range(low), *range(high, len(firsts))))
        begun, ended = max(0, first - firsts[low]), max(0, lasts[high - 1] - last)
        return self.count - outside - begun - ended

    def gaps(self, first: int, last: int) -> Iterator[Run]:
        """The runs of numbers from `first` to `last` that are not in it. It must not change meanwhile."""
        index = bisect_left(self._lasts, first)
        while first <= last:
            if index == len(self._firsts) or self._firsts[index] > last:
                yield first, last
                return
            if first < self._firsts[index]:
                yield first, self._firsts[index] - 1
            first = self._lasts[index] + 1
            index += 1

    def shed(self, most: int) -> int:
        """Close the oldest gaps until no more than `most` runs are left. Returns how many numbers that adds."""
        over = len(self._firsts) - most
        return 0 if over <= 0 else self.add(self._firsts[0], self._lasts[over])
