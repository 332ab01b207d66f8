"""The rounds of start-up: the window doubles in a round, and goes where the trains of packets point."""

from math import inf
from typing import Final, NamedTuple

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.train import TRAIN_BYTES, Train

LOST: Final = 0.2
"""A path that loses more than this share in an epoch drops what it cannot keep."""
CLOCKED_RTTS: Final = 2.0
"""A window that its acknowledgements let go comes within so many round trips, unless a bottleneck holds it."""
RTT_WEIGHT: Final = 0.1
"""Share of a packet in what the round knows of the round trip; more of the first ones, so that they are a mean."""


class Ramp(NamedTuple):
    """What an acknowledgement of start-up shows: the window; whether start-up is over, and whether a round is."""

    window: float
    filled: bool
    round_over: bool


class StartUp:
    """The rounds of start-up. Packets sent after `since_s` belong to the present one."""

    __slots__ = (
        "_before",
        "_first_window",
        "_full_rounds",
        "_least_rtt_s",
        "_lossy_epochs",
        "_may_jitter",
        "_pace",
        "_packets",
        "_params",
        "_resumed",
        "_rtt_s",
        "_shown",
        "_spread_s",
        "_train",
        "_window",
        "jittery",
        "rounds",
        "since_s",
    )

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.begin(-inf, 0.0, None)

    def begin(
        self, now: float, window: float, pace: float | None, *, resumed: bool = False, may_jitter: bool = True
    ) -> None:
        """The first round. `resumed`: after a silence, of what we have left to send and not of a full window.
        `may_jitter`: the path is not known to be without jitter."""
        self.jittery = False
        """Whether packets that left one after the other have come unevenly: jitter did that."""
        self._may_jitter = may_jitter
        self._before = self._shown = 0.0
        self._first_window = window
        self._train = Train()
        self._full_rounds = self._lossy_epochs = 0
        self.rounds = -1
        """How many are over."""
        self._least_rtt_s = inf  # the least mean of a round: with hardly a queue of ours
        self.begin_round(now, window, pace)
        self._resumed = resumed

    def begin_round(self, now: float, window: float, pace: float | None) -> None:
        """The next one."""
        # Jitter may bring few packets all at once.
        if self.jittery and self._train.whole_bytes >= 2 * TRAIN_BYTES and self._train.whole_rate < inf:
            self._shown = max(self._shown, self._train.whole_rate)
        self._before = self.rate
        self.rounds += 1
        self._resumed = False
        self.since_s = now
        self._window = window
        self._pace = pace
        self._packets = 0
        self._rtt_s = self._spread_s = 0.0  # of them
        self.measure_anew()

    def measure_anew(self) -> None:
        """What arrived so far cannot be compared with what will."""
        self._train = Train()

    def nothing_more(self, left_s: float) -> None:
        """There was nothing more to send behind a packet that left then."""
        self._train.nothing_more(left_s)

    def loses(self, share: float) -> bool:
        """An epoch is over in which `share` was lost. Whether the path drops what it cannot keep. Where packets
        overtake each other many seem to be lost until it is known that they do."""
        self._lossy_epochs = self._lossy_epochs + 1 if share > LOST else 0
        return self._lossy_epochs > self.jittery

    @property
    def rate(self) -> float:
        """Bytes/s that came in the round, or in the one before if that was more; 0: nothing tells it."""
        train = self._train
        rates = (train.even_rate, train.whole_rate) if self._may_jitter else (train.rate,)
        return max(next((rate for rate in rates if 0.0 < rate < inf), 0.0), self._before)

    def ramp(self, sample: AckSample, left_s: float, *, window: float, rtt_s: float, fragment: float) -> Ramp | None:
        """One acknowledgement of a packet of the round, which left at `left_s`; None: it shows nothing new."""
        train = self._train
        self._note_rtt(sample.rtt_s)
        if not train.note(sample, left_s, rtt_s, jittery=self.jittery):
            return None
        # As they had left, within two round trips: it was the window that spaced them.
        clocked = train.even and not train.spread and train.took_s < CLOCKED_RTTS * rtt_s
        told = train.tells and not clocked
        if self._may_jitter and not told and train.nbytes < self._window:
            return None
        if self._may_jitter and not (told and train.even):
            self.jittery = True
            return self._jittery_ramp(window, fragment)
        # By chance a few of many packets that jitter spreads come evenly: no link is slower than all of a round.
        rate = max(train.even_rate, train.whole_rate, self._shown) if self._may_jitter else train.rate
        if self._resumed and not train.spread:
            rate = inf  # as it had left: by our own sending
        seen, held = rate * rtt_s, self._held(rate)
        if held and window > seen + 2 * fragment:
            return Ramp(seen + fragment, filled=True, round_over=False)
        if train.nbytes < self._window / 4:
            return None
        window = self._grown(window, seen, even=True)
        return Ramp(window, filled=held and window >= 0.85 * seen, round_over=True)

    def _jittery_ramp(self, window: float, fragment: float) -> Ramp | None:
        """The same where packets do not come evenly. Jitter spreads a train as a slow link does, so the link may be
        faster: it is full once packets take longer, in the mean, for two rounds of one window."""
        train, params = self._train, self._params
        whole = train.nbytes >= params.startup_share * self._window
        if not whole and train.span_s < self._rtt_s:
            return None
        rate = train.whole_rate if train.whole_spread else inf  # as it had left: by our own sending
        seen, held = rate * min(self._rtt_s, self._least_rtt_s), self._held(rate)
        if held and self._rtt_s > params.startup_far * self._least_rtt_s:
            return Ramp(min(window, seen + fragment), filled=True, round_over=False)
        if not whole:
            return None
        self._least_rtt_s = min(self._rtt_s, self._least_rtt_s)
        longer_s = self._rtt_s - self._least_rtt_s
        if not held or longer_s < max(params.startup_longer * self._least_rtt_s, 2 * self._spread_s):
            self._full_rounds = 0
            return Ramp(self._grown(window, inf, even=False), filled=False, round_over=True)
        self._full_rounds += 1
        if self._full_rounds >= params.startup_rounds:
            # What was there before is kept: there may have been little to send, and jitter made less of it.
            return Ramp(min(window, max(seen, self._first_window)), filled=True, round_over=True)
        return Ramp(window, filled=False, round_over=True)

    def _note_rtt(self, rtt_s: float) -> None:
        """Mean of the round, of the latest packets, and their mean deviation from it."""
        self._packets += 1
        weight = max(1.0 / self._packets, RTT_WEIGHT)
        off_s = rtt_s - self._rtt_s
        self._rtt_s += weight * off_s
        self._spread_s += weight * (abs(off_s) * (self._packets > 1) - self._spread_s)

    def _held(self, rate: float) -> bool:
        """Whether packets that came at `rate` were held by the bottleneck, not by our own pacing."""
        return rate < inf and (self._pace is None or rate < 0.75 * self._pace)

    def _grown(self, window: float, seen: float, *, even: bool) -> float:
        """The window of the next round; `seen`: bytes that the path took."""
        params = self._params
        gain = params.startup_gain if even else params.startup_jittery_gain
        window = max(window, min(gain * self._window, params.startup_aim * seen))
        return min(window, params.max_window_bytes)
