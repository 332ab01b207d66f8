"""The rounds of start-up: the window doubles in a round, and goes where the trains of packets point."""

from math import inf
from typing import NamedTuple

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import Train


class Ramp(NamedTuple):
    """What an acknowledgement of start-up shows: the window; whether start-up is over, and whether a round is."""

    window: float
    filled: bool
    round_over: bool


class StartUp:
    """One round of start-up. Packets sent after `since_s` belong to it."""

    __slots__ = ("_pace", "_params", "_resumed", "_train", "_window", "since_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.begin_round(-inf, 0.0, None)

    def begin_round(self, now: float, window: float, pace: float | None, *, resumed: bool = False) -> None:
        """`resumed`: the first round after a silence, of what we have left to send and not of a full window."""
        self.since_s = now
        self._resumed = resumed
        self._window = window
        self._pace = pace
        self.measure_anew()

    def measure_anew(self) -> None:
        """What arrived so far cannot be compared with what will."""
        self._train = Train()

    @property
    def rate(self) -> float:
        """Bytes/s, the greatest that a train of the round showed."""
        return self._train.rate

    def ramp(self, sample: AckSample, *, window: float, rtt_s: float, fragment: float) -> Ramp | None:
        """One acknowledgement of a packet of the round; None: it shows nothing new."""
        train, params = self._train, self._params
        if not train.note(sample.receiver_s, sample.cum_bytes, sample.acked_bytes, sample.sent_s):
            return None
        seen = train.rate * rtt_s
        held = self._pace is None or train.rate < 0.75 * self._pace  # by the bottleneck, not by our own pacing
        if self._resumed and not train.spread:
            held, seen = False, inf
        if held and window > seen + 2 * fragment:
            return Ramp(seen + fragment, filled=True, round_over=False)
        if train.nbytes < self._window / 4:
            return None
        window = max(window, min(params.startup_gain * self._window, params.startup_aim * seen))
        window = min(window, params.max_window_bytes)
        return Ramp(window, filled=held and window >= 0.85 * seen, round_over=True)
