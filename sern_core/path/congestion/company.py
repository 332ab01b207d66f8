"""Whose a queue is: what the window knows of somebody else on the link, and of making way for him."""

from collections import deque
from math import inf

from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import Cubic, Swing


class Rival:
    """What is known of somebody else who keeps a queue. `cubic` is the window while we compete with him."""

    __slots__ = (
        "_gone",
        "_params",
        "_pinned",
        "_recent",
        "above_epochs",
        "adopted_until_s",
        "calm_window",
        "cubic",
        "until_s",
    )

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.cubic: Cubic | None = None
        self.restart()

    def restart(self) -> None:
        """What was seen says nothing about what will be."""
        self.above_epochs = 0
        """Epochs in a row whose queue was too long."""
        self._pinned = Swing()  # of the queue while the window is at its least
        self._recent: deque[float] = deque(maxlen=self._params.stuck_epochs)  # queues of the last epochs
        self.adopted_until_s = -inf
        """The end of a time for which the path was taken for a longer one: short again, it has shown a rival."""
        self._gone: deque[float] = deque(maxlen=self._params.gone_times)  # when its queue went as we made way
        self.until_s = -inf
        """The end of a time in which a queue that stays is taken for a rival's."""
        self.calm_window = 0.0
        """The last window with which the queue was as wanted."""

    def note(self, queue_s: float) -> None:
        """An epoch has ended."""
        self._recent.append(queue_s)

    def remember(self, now: float) -> None:
        """There is one, or was a moment ago."""
        self.until_s = now + self._params.rival_memory_s

    def went_again(self, now: float) -> bool:
        """Its queue went as we made way; whether it did so again and again of late."""
        gone = self._gone
        gone.append(now)
        return len(gone) == self._params.gone_times and now < gone[0] + self._params.rival_memory_s

    def forget(self) -> None:
        """There was none."""
        self.until_s = -inf
        self._gone.clear()

    def stuck(self, now: float, queue_s: float, window: float, fragment: float, peak: float) -> bool:
        """Whether a queue stays though we made way for it, or moves though we are not there."""
        return self.above_epochs >= self._params.stuck_epochs or self._is_pinned(now, queue_s, window, fragment, peak)

    def flat(self, queue_s: float) -> bool:
        """Whether the queue of the last epochs was the same, as no queue of a rival is."""
        return max(self._recent) - min(self._recent) < max(self._params.flat_s, 0.1 * queue_s)

    def _is_pinned(self, now: float, queue_s: float, window: float, fragment: float, peak: float) -> bool:
        """Whether the window has long been at its least while the queue swings more than ours can: it is not ours,
        though no empty queue was ever seen to measure it by."""
        if window > 2 * fragment:
            self._pinned.since_s = None
            return False
        swing_s = max(0.010, min(0.100, 2 * window / peak)) if peak else inf
        return self._pinned.wider(now, queue_s, swing_s)


class Drain:
    """When the window makes way, and what it was before."""

    __slots__ = ("_params", "drained_s", "emptied_s", "judging", "saved_window", "until_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.restart()

    def restart(self) -> None:
        """What was seen says nothing about what will be."""
        self.until_s = -inf
        """When it has made way for long enough."""
        self.saved_window = 0.0
        self.judging = False
        """Whether the next epoch tells whose the queue is."""
        self.drained_s = -inf
        """When it last had made way."""
        self.emptied_s = -inf
        """When the queue was last seen empty, or the path to have room."""

    def begin(self, now: float, window: float, smaller: float, wait_s: float, rate: float) -> None:
        """The window goes from `window` to `smaller` until that has reached the path, and for `wait_s`."""
        self.saved_window = window
        # What is too little for a rate must not become a pause without end.
        self.until_s = now + wait_s + min((window - smaller) / rate, self._params.max_drain_s)

    def end(self, now: float) -> None:
        self.drained_s = now
        self.judging = True

    def lately(self, now: float, rtt_s: float) -> bool:
        """Whether what arrives now may have been sent while draining, though that is over."""
        return now < self.drained_s + 2 * rtt_s + self._params.min_rate_span_s

    def due(self, now: float, interval_s: float, *, stuck: bool) -> bool:
        """Whether it is time to make way: for a queue that stays, or since none was seen to be empty for long."""
        if stuck and now >= self.drained_s + self._params.stuck_wait_s:
            return True
        return now >= max(self.drained_s, self.emptied_s) + interval_s

    def interval_s(self, rtt_s: float) -> float:
        """How long the queue may go without being seen empty."""
        return max(self._params.drain_interval_s, self._params.drain_rtts * rtt_s)
