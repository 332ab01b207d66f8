"""A cap on the rate of a topic that jitter does not halve. Whoever asks it keeps the newest sample that it holds back,
and offers it again at `next_s`: the last of a series always passes."""

from math import inf
from typing import Final

RATE_CAP_SLACK: Final = 0.25
"""A sample this fraction of a period early still passes a rate cap, so that jitter does not halve the rate."""


class RateCap:
    """Lets at most `max_rate_hz` samples a second pass; None: all."""

    __slots__ = ("_next_allowed_s", "max_rate_hz")

    def __init__(self, max_rate_hz: float | None) -> None:
        self.max_rate_hz = max_rate_hz
        self._next_allowed_s: float | None = None

    @property
    def next_s(self) -> float:
        """When the next sample may pass at the latest; -inf: now."""
        return -inf if self._next_allowed_s is None else self._next_allowed_s

    def allows(self, now: float) -> bool:
        """Whether a sample may pass now; it is taken to pass."""
        if self.max_rate_hz is None:
            return True
        period_s = 1.0 / self.max_rate_hz
        allowed_s = self._next_allowed_s
        if allowed_s is not None and now < allowed_s - RATE_CAP_SLACK * period_s:
            return False
        self._next_allowed_s = period_s + (now if allowed_s is None or now > allowed_s + period_s else allowed_s)
        return True
