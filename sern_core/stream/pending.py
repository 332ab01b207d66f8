"""The pending messages of one class, and which of them has the highest score P (the paper's eq. (priority_score)).

    P(t) = g · (1 + η · min(t − since, a_max)),   g = κ / (s + ε)

Up to `FEW` pending messages a plain loop over the formula is the fastest thing Python can do. Above that, the score is
linear in time until its age is clipped: P(t) = α + β·t with α = g·(1 − η·since) and β = g·η; afterwards α is
g·(1 + η·a_max) and β is 0. Compact numpy arrays of α and β then need one multiplication, one addition and one argmax
for a choice. A heap of clip times, lazily invalidated, says which lines must be replaced by their clipped value first.

Alternatives that were measured for the whole decision (choose, then offer the winner's next message), µs at 10 / 100 /
1000 pending messages, one decision every millisecond, on one machine in one run:

    rescoring everything in a loop            0.9 / 7.2  / 67
    numpy argmax over α + β·t (kept)          1.2 / 1.2  / 1.6      the plain loop takes 0.8 at 10
    argmax, winner kept until it is crossed   1.9 / 1.9  / 1.9      a served topic's next message ends the certificate
    short list of 32 with a horizon bound     0.6 / 1.6  / 2.1      2.7 at 10 ms a decision: the horizon runs out
    kinetic tournament                        1.0 / 1.7  / 3.2      7.3 at 10 ms a decision: certificates fail
"""

from heapq import heapify, heappop, heappush
from typing import Final

import numpy as np
from numpy.typing import NDArray

FEW: Final = 16
"""Above this many pending messages the numpy lines pay; they are given up again below half of it."""
_TIE_ETA: Final = 1e-9
"""η = 0 (Smith's rule) leaves equal scores to ageing this slow, so that the older of two equals is served first."""
_INF: Final = float("inf")

_multiply = np.multiply
_add = np.add


class _Lines:
    """α + β·t of every pending message, as numpy arrays, index for index beside the lists of `PendingClass`."""

    __slots__ = ("_alpha", "_beta", "_clip_at", "_clips", "_eta", "_origin_s", "_score", "_views", "a_max_s", "count")

    def __init__(self, *, eta: float, a_max_s: float, origin_s: float) -> None:
        self._eta = eta
        self.a_max_s = a_max_s
        self._origin_s = origin_s  # times are kept relative to it: α must not swamp the differences between scores
        self.count = 0
        self._resize(64)
        self._clip_at: list[float] = []  # per message, when its age is clipped; −inf once that was done
        self._clips: list[tuple[float, int]] = []  # heap of (clip time, index); an entry holds if `_clip_at` agrees

    def _resize(self, capacity: int) -> None:
        alpha, beta = np.zeros(capacity), np.zeros(capacity)
        if self.count:
            alpha[: self.count] = self._alpha[: self.count]
            beta[: self.count] = self._beta[: self.count]
        self._alpha: NDArray[np.float64] = alpha
        self._beta: NDArray[np.float64] = beta
        self._score: NDArray[np.float64] = np.empty(capacity)
        self._cut()

    def _cut(self) -> None:
        n = self.count
        self._views = (self._alpha[:n], self._beta[:n], self._score[:n])

    def append(self, gain: float, since_s: float) -> None:
        index = self.count
        if index == len(self._alpha):
            self._resize(2 * index)
        self.count = index + 1
        self._cut()
        self._clip_at.append(_INF)
        self.put(index, gain, since_s)

    def put(self, index: int, gain: float, since_s: float, *, same_age: bool = False) -> None:
        """Replace the line at `index`; `same_age`: since_s is what it was, so a clip stays done or stays planned."""
        if same_age:
            if self._clip_at[index] == -_INF:
                self._alpha[index] = gain * (1.0 + self._eta * self.a_max_s)
                return
        else:
            clip_at = since_s + self.a_max_s
            self._clip_at[index] = clip_at
            self._plan_clip(clip_at, index)
        slope = gain * self._eta
        self._alpha[index] = gain - slope * (since_s - self._origin_s)
        self._beta[index] = slope

    def swap_remove(self, index: int) -> None:
        """The last message takes the place of the one at `index`."""
        last = self.count - 1
        clip_at = self._clip_at.pop()
        if index != last:
            self._alpha[index] = self._alpha[last]
            self._beta[index] = self._beta[last]
            self._clip_at[index] = clip_at
        self.count = last
        self._cut()
        if index != last and clip_at != -_INF:
            self._plan_clip(clip_at, index)

    def _plan_clip(self, clip_at: float, index: int) -> None:
        clips = self._clips
        heappush(clips, (clip_at, index))
        if len(clips) > 64 + 4 * self.count:
            self._clips = [(at, i) for i, at in enumerate(self._clip_at) if at != -_INF]
            heapify(self._clips)

    def best(self, now: float, gains: list[float]) -> int:
        """Index of the highest score; the first of equals."""
        clips = self._clips
        if clips and clips[0][0] <= now:
            self._clip(now, gains)
        alpha, beta, score = self._views
        _multiply(beta, now - self._origin_s, score)
        _add(score, alpha, score)
        return int(score.argmax())

    def _clip(self, now: float, gains: list[float]) -> None:
        clips, clip_at = self._clips, self._clip_at
        full = 1.0 + self._eta * self.a_max_s
        while clips and clips[0][0] <= now:
            at, index = heappop(clips)
            if index < self.count and clip_at[index] == at:
                clip_at[index] = -_INF
                self._alpha[index] = gains[index] * full
                self._beta[index] = 0.0

    def validate(self, gains: list[float], sinces: list[float]) -> None:
        assert self.count == len(gains) == len(self._clip_at)
        planned = set(self._clips)
        for index, (gain, since_s, at) in enumerate(zip(gains, sinces, self._clip_at, strict=True)):
            slope = 0.0 if at == -_INF else gain * self._eta
            assert self._beta[index] == slope
            if at == -_INF:
                assert self._alpha[index] == gain * (1.0 + self._eta * self.a_max_s)
            else:
                assert at == since_s + self.a_max_s
                assert (at, index) in planned, "a message would never be clipped"
                assert self._alpha[index] == gain - slope * (since_s - self._origin_s)


class PendingClass:
    """Pending messages, at most one a channel. `channel_ids` may be read: its truth says whether anything is pending.

    Equal scores: the older message first when η = 0, else the first in table order; the same operations always make
    the same choice.
    """

    __slots__ = ("_a_max_s", "_eta", "_gains", "_index", "_lines", "_origin_s", "_sinces", "channel_ids")

    def __init__(self, *, eta: float, a_max_s: float, origin_s: float) -> None:
        self._eta = max(eta, _TIE_ETA)  # 1/s
        self._a_max_s = a_max_s
        self._origin_s = origin_s
        self.channel_ids: list[int] = []
        self._gains: list[float] = []  # g = κ/(s + ε), 1/bytes
        self._sinces: list[float] = []
        self._index: dict[int, int] = {}
        self._lines: _Lines | None = None

    def __len__(self) -> int:
        return len(self.channel_ids)

    def put(self, channel_id: int, gain: float, since_s: float) -> None:
        """Add a channel's message, or replace it. `gain` is κ/(s + ε) > 0; age counts from `since_s`; both finite."""
        index = self._index.get(channel_id)
        lines = self._lines
        if index is not None:
            self._gains[index] = gain
            if lines is not None:
                lines.put(index, gain, since_s, same_age=self._sinces[index] == since_s)
            self._sinces[index] = since_s
            return
        channel_ids = self.channel_ids
        self._index[channel_id] = len(channel_ids)
        channel_ids.append(channel_id)
        self._gains.append(gain)
        self._sinces.append(since_s)
        if lines is not None:
            lines.append(gain, since_s)
        elif len(channel_ids) > FEW:
            self._lines = lines = _Lines(eta=self._eta, a_max_s=self._a_max_s, origin_s=self._origin_s)
            for gain, since_s in zip(self._gains, self._sinces, strict=True):
                lines.append(gain, since_s)

    def remove(self, channel_id: int) -> None:
        """Take out the message of a channel, which must be pending."""
        index = self._index.pop(channel_id)
        channel_ids, gains, sinces = self.channel_ids, self._gains, self._sinces
        moved, gain, since_s = channel_ids.pop(), gains.pop(), sinces.pop()
        if moved != channel_id:
            channel_ids[index], gains[index], sinces[index] = moved, gain, since_s
            self._index[moved] = index
        if self._lines is not None:
            if len(channel_ids) < FEW // 2:
                self._lines = None
            else:
                self._lines.swap_remove(index)

    def best(self, now: float) -> int:
        """The channel with the highest score; something must be pending."""
        channel_ids = self.channel_ids
        if len(channel_ids) == 1:
            return channel_ids[0]
        if self._lines is not None:
            return channel_ids[self._lines.best(now, self._gains)]
        eta, a_max_s = self._eta, self._a_max_s
        best, highest = -1, -_INF
        for channel_id, gain, since_s in zip(channel_ids, self._gains, self._sinces, strict=True):
            age_s = now - since_s
            score = gain * (1.0 + eta * (age_s if age_s < a_max_s else a_max_s))
            if score > highest:
                best, highest = channel_id, score
        return best

    def validate(self) -> None:
        """Raise AssertionError unless the lists, the index and the lines agree."""
        assert len(self.channel_ids) == len(self._gains) == len(self._sinces) == len(self._index)
        assert all(self.channel_ids[index] == channel_id for channel_id, index in self._index.items())
        if self._lines is None:
            assert len(self.channel_ids) <= FEW
        else:
            assert len(self.channel_ids) >= FEW // 2
            self._lines.validate(self._gains, self._sinces)
