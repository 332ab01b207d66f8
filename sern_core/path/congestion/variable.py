"""A link whose rate goes up and down all the time, as a cellular one does: how that is known, and the window there.

What such a link carries is another thing every few round trips, so the least delay of many seconds and the greatest
rate of late say little. Only a queue shows what the link can do now, and while it is short nobody waits for it long. So
a queue of `variable_queue_s` is kept, and every acknowledgement steers. While the queue is longer, the window goes to
what arrived of late times the round trip with that queue. While it is shorter the link may carry more, and the window
grows with what is acknowledged. A sender sees the link a round trip late, and that bounds what anyone can do: what is
under way when the link fades waits until it has passed.
"""

from collections import deque
from math import inf

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.params import HybridParams


class Variability:
    """Whether the rate swings: how often of late it turned from rising to falling or back, by `variable_times`."""

    __slots__ = ("_greatest", "_least", "_mark", "_params", "_turns")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._turns: deque[float] = deque(maxlen=params.variable_turns)
        self.measure_anew()

    def measure_anew(self) -> None:
        """What the link carries from now on is not to be compared with what it did. Turns that were seen stand."""
        self._mark: tuple[float, int, int] | None = None  # (time, bytes, acknowledgements) of the receiver
        self._least: float | None = inf  # bytes/s since it fell; None while it rises
        self._greatest: float | None = 0.0  # since it rose; None while it falls

    def forget(self) -> None:
        """Whatever turned, it was not the link."""
        self._turns.clear()
        self.measure_anew()

    def faded(self, now: float) -> None:
        """A queue of ours came and went: the link carried less for a while."""
        self._turns.extend((now, now))

    def queued(self, now: float, receiver_s: float, cum_bytes: int, jitter_s: float) -> None:
        """A packet came that had to queue. While all of them do, what arrives is what the link carries."""
        mark, params = self._mark, self._params
        if mark is None:
            self._mark = (receiver_s, cum_bytes, 0)
            return
        since_s, before, count = mark
        if receiver_s < since_s + params.variable_span_s + 10 * jitter_s or count < params.min_epoch_samples:
            self._mark = (since_s, before, count + 1)
            return
        self._mark = (receiver_s, cum_bytes, 0)
        rate = (cum_bytes - before) / (receiver_s - since_s)
        self._carries(now, rate, rate)

    def passed(self) -> None:
        """A packet came that did not queue: the link could have carried more."""
        self._mark = None

    def at_least(self, now: float, rate: float) -> None:
        """The link carried `rate`, in bytes/s, and may be able to carry more."""
        self._carries(now, rate, inf)

    def _carries(self, now: float, least: float, most: float) -> None:
        """It carries something between `least` and `most`."""
        times, lowest, highest = self._params.variable_times, self._least, self._greatest
        if lowest is not None:
            lowest = self._least = min(lowest, most)
        if highest is not None:
            highest = self._greatest = max(highest, least)
        if lowest is not None and least > times * lowest:
            self._turn(now, first=highest is not None)
            self._least, self._greatest = None, least
        elif highest is not None and times * most < highest:
            self._turn(now, first=lowest is not None)
            self._least, self._greatest = most, None

    def _turn(self, now: float, *, first: bool) -> None:
        if not first:  # before, it was not known whether it rose or fell
            self._turns.append(now)

    def swings(self, now: float) -> bool:
        """Whether it has turned often of late, or faded and come back at once."""
        turns, params = self._turns, self._params
        if len(turns) < 2 or turns[-1] <= now - params.variable_memory_s:
            return False
        faded = turns[-1] - turns[-2] <= params.variable_fade_s
        return faded or (len(turns) == params.variable_turns and turns[0] > now - params.variable_memory_s)


class VariableWindow:
    """The window of such a link, acknowledgement by acknowledgement, and whether its queue is somebody else's."""

    __slots__ = ("_arrived", "_epoch_s", "_long", "_params", "_wanted_s", "_yields_until_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._wanted_s = params.variable_queue_s or 0.0
        self.restart()

    def restart(self) -> None:
        """What was seen says nothing of what will be."""
        self._arrived: deque[tuple[float, int]] = deque()  # (time, bytes) of the receiver
        self._epoch_s: float | None = None
        self._long = 0.0  # share of the last epochs whose queue was too long
        self._yields_until_s: float | None = None

    def steer(
        self,
        window: float,
        queue_s: float,
        sample: AckSample,
        *,
        rtt_s: float,
        fragment: float,
    ) -> float:
        """The window after an acknowledgement whose packet queued for `queue_s`. `rtt_s`: of the empty path."""
        params = self._params
        rate = self._rate(sample.receiver_s, sample.cum_bytes)
        if rate is None:
            return window
        if self._yields_until_s is not None:
            return 0.0
        wanted_s = self._wanted_s
        carried = rate * (rtt_s + wanted_s)
        short = (wanted_s - queue_s) / wanted_s
        if short <= 0.0:
            return window + min(1.0, -short) * min(0.0, carried + fragment - window)
        if sample.app_limited:
            return window
        most = max(window, params.variable_ahead * carried + params.variable_ahead_packets * fragment)
        return min(window + params.variable_growth * min(1.0, short) * sample.acked_bytes, most)

    def _rate(self, receiver_s: float, cum_bytes: int) -> float | None:
        """Bytes/s that arrived in the last `variable_rate_s`; None while that is not known."""
        arrived, params = self._arrived, self._params
        arrived.append((receiver_s, cum_bytes))
        while len(arrived) > params.min_epoch_samples and arrived[1][0] <= receiver_s - params.variable_rate_s:
            arrived.popleft()
        since_s, before = arrived[0]
        return (cum_bytes - before) / (receiver_s - since_s) if receiver_s > since_s else None

    def close_epoch(self, now: float, queue_s: float, *, high_s: float, rtt_s: float) -> bool:
        """An epoch is over. True: its queue stayed though we made way, so it is somebody else's. `high_s`: what is too
        long in any case. A fade ends, and then what queued is ours and goes; a rival's queue is short for moments."""
        params = self._params
        elapsed_s, self._epoch_s = now - (self._epoch_s or now), now
        long = queue_s > max(high_s, params.variable_long * self._wanted_s)
        self._long += min(1.0, elapsed_s / params.variable_patience_s) * ((1.0 if long else 0.0) - self._long)
        until_s = self._yields_until_s
        if until_s is None:
            if self._long > params.variable_stays:
                self._yields_until_s = now + rtt_s + queue_s + 2 * params.variable_patience_s
            return False
        if now <= until_s:
            return False
        self._yields_until_s = None
        stays, self._long = self._long > params.variable_stays / 2, 0.0
        return stays
