"""Where streams that have ended go on counting, should they come again."""

from typing import Final

from sern_core.vocabulary.message import StreamId

MAX_ENDED: Final = 1024
"""Streams whose last number is remembered."""
ENDED_S: Final = 3600.0
"""How long it is: longer than anybody keeps what it has of a stream that was withdrawn."""


class Numbering:
    """The last numbers of streams that have ended, the latest `MAX_ENDED` of the last `ENDED_S`.

    A stream that is not among them begins above all that were forgotten: never below its own last number.
    """

    def __init__(self) -> None:
        self._last: dict[StreamId, tuple[int, float]] = {}  # number, and when it ended; the oldest first
        self._floor = 0

    def __len__(self) -> int:
        return len(self._last)

    def last(self, stream: StreamId) -> int:
        """The number before the next one."""
        known = self._last.get(stream)
        return self._floor if known is None else known[0]

    def ended(self, stream: StreamId, last: int, *, now: float) -> None:
        """The stream ended with this number."""
        self._last.pop(stream, None)
        self._last[stream] = (last, now)
        self.tidy(now=now)

    def tidy(self, *, now: float) -> None:
        """Forget what is too old, or too much."""
        while self._last:
            stream, (last, ended_s) = next(iter(self._last.items()))
            if len(self._last) <= MAX_ENDED and now - ended_s <= ENDED_S:
                break
            del self._last[stream]
            self._floor = max(self._floor, last)
