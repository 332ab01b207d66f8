"""The arithmetic of the shaping proxy, free of sockets: when does a packet leave, and when does it arrive?

One `Shaper` is one direction of one link, shared by every connection on it: a bottleneck with a rate that changes
over time, a queue counted in packets in front of it, and a delay with jitter behind it. Everything is worked out
when a packet is admitted, so no timer error accumulates. Times are seconds on the caller's monotonic clock.

A blackout is a rate of zero. It freezes what is on the way as well: a byte that had 10 ms to go when the link went
away arrives 10 ms after the link is back.
"""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from random import Random
from typing import Final, Self

from sern_sim.models import SEGMENT_BYTES, Jitter, LinkModel

SLOT_BYTES: Final = SEGMENT_BYTES
"""A queue slot holds at most this much of the byte stream: the payload of a full Ethernet frame."""
UNLIMITED_BPS: Final = 10e9
"""What a model without a rate is shaped to; above what the proxy can carry."""
HORIZON_S: Final = 3600.0
"""How much of a flapping link's endless script is unrolled."""


@dataclass(frozen=True)
class RateSchedule:
    """The rate of the link as a step function: `steps` of (start in seconds, rate in bit/s), the first at 0.

    Before 0 the first rate holds; after the last step the last rate holds. Rate 0 is a blackout.
    """

    steps: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        starts = [start for start, _ in self.steps]
        if not starts or starts[0] != 0.0:
            raise ValueError("the first step of a rate schedule starts at 0")
        if any(later <= earlier for earlier, later in pairwise(starts)):
            raise ValueError("the steps of a rate schedule are in rising order of time")
        if any(rate < 0 or not math.isfinite(rate) for _, rate in self.steps):
            raise ValueError("a rate is a finite number of bit/s, not below 0")

    @classmethod
    def of(cls, model: LinkModel, *, until_s: float = HORIZON_S) -> Self:
        """The script of a link model, up to `until_s`."""
        steps: list[tuple[float, float]] = []
        t: float | None = 0.0
        while t is not None and t < until_s:
            rate = 0.0 if model.blackout_at(t) else (model.rate_bps_at(t) or UNLIMITED_BPS)
            if not steps or steps[-1][1] != rate:
                steps.append((t, rate))
            t = model.next_change_s(t)
        return cls(tuple(steps))

    def _index(self, t: float) -> int:
        return max(0, bisect_right(self.steps, t, key=lambda step: step[0]) - 1)

    def _end_of(self, index: int) -> float:
        return self.steps[index + 1][0] if index + 1 < len(self.steps) else math.inf

    def rate_bps(self, t: float) -> float:
        return self.steps[self._index(t)][1]

    def finish(self, t: float, size_bytes: float) -> float:
        """When a packet of `size_bytes` that starts at `t` has left; infinite when the link never comes back."""
        bits = size_bytes * 8.0
        index = self._index(t)
        while True:
            rate, end = self.steps[index][1], self._end_of(index)
            if rate > 0 and t + bits / rate <= end:
                return t + bits / rate
            if math.isinf(end):
                return math.inf
            bits -= rate * (end - t)
            t = end
            index += 1

    def advance(self, t: float, span_s: float) -> float:
        """`t` plus `span_s` of time in which the link is there."""
        index = self._index(t)
        while True:
            rate, end = self.steps[index][1], self._end_of(index)
            if rate > 0:
                if t + span_s <= end:
                    return t + span_s
                span_s -= end - t
            elif math.isinf(end):
                return math.inf
            t = end
            index += 1

    def carried_bytes(self, start: float, end: float) -> float:
        """The most the link can carry between two times."""
        total_bits = 0.0
        index = self._index(start)
        while start < end:
            until = min(end, self._end_of(index))
            total_bits += self.steps[index][1] * (until - start)
            start = until
            index += 1
        return total_bits / 8.0

    def blackouts(self, until_s: float) -> list[tuple[float, float]]:
        """Intervals without a link that begin before `until_s`, clipped to it."""
        found: list[tuple[float, float]] = []
        for index, (start, rate) in enumerate(self.steps):
            if rate == 0 and start < until_s:
                end = min(self._end_of(index), until_s)
                if found and found[-1][1] == start:
                    found[-1] = (found[-1][0], end)
                else:
                    found.append((start, end))
        return found


class Shaper:
    """One direction of the link. `origin_s` is where 0 of the model's script lies on the caller's clock.

    Of the model, reordering and duplication do not apply, and loss is the caller's, for datagrams.
    """

    def __init__(self, model: LinkModel, *, rng: Random, origin_s: float) -> None:
        self.model = model
        self.schedule = RateSchedule.of(model)
        self.origin_s = origin_s
        self.slots = model.queue_packets
        self._rng = rng
        self._leaves: deque[float] = deque()  # departure times of the packets in the queue, rising
        self._busy_until = -math.inf
        self._last_arrival = -math.inf

    def free_slots(self, now: float) -> int:
        leaves = self._leaves
        while leaves and leaves[0] <= now:
            leaves.popleft()
        return self.slots - len(leaves)

    def when_free(self, slots: int, now: float) -> float:
        """The time at which at least `slots` slots are free."""
        missing = slots - self.free_slots(now)
        return now if missing <= 0 else self._leaves[missing - 1]

    def admit(self, size_bytes: int, now: float) -> float:
        """Queue one packet (the caller has checked for a free slot) and return its time of arrival.

        Arrivals never overtake each other: jitter delays, as on a TCP connection, and does not reorder.
        """
        origin = self.origin_s
        start = max(now, self._busy_until) - origin
        leave = self.schedule.finish(start, size_bytes + self.model.overhead_bytes)
        self._busy_until = leave + origin
        self._leaves.append(leave + origin)
        arrival = self.schedule.advance(leave, self._delay_s()) if math.isfinite(leave) else math.inf
        self._last_arrival = max(self._last_arrival, arrival + origin)
        return self._last_arrival

    def _delay_s(self) -> float:
        delay, jitter = self.model.delay_s, self.model.jitter_s
        if not jitter:
            return delay
        if self.model.jitter is Jitter.UNIFORM:
            return max(0.0, delay + self._rng.uniform(-jitter, jitter))
        return max(0.0, delay + max(-3 * jitter, min(3 * jitter, self._rng.gauss(0.0, jitter))))

    def after(self, span_s: float, now: float) -> float:
        """`now` plus `span_s` of link time: how far connection set-up has come, blackouts not counted."""
        return self.schedule.advance(now - self.origin_s, span_s) + self.origin_s
