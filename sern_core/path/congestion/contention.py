"""Whose the queue is: our own, somebody else's, or none but a longer way. The window makes way to find out."""

from enum import Enum, auto

from sern_core.path.congestion.company import Drain, Rival
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import Cubic
from sern_core.path.congestion.path_model import PathModel, Seen


class Verdict(Enum):
    """What a queue turned out to be."""

    RIVAL = auto()
    """Somebody else keeps it."""
    GONE = auto()
    """The rival's queue is no longer there."""
    FADED = auto()
    """It is no longer there and was no rival's: the link carried less for a while."""
    LONGER_PATH = auto()
    """It is none: packets take that long."""


class Contention:
    """Somebody else on the link: when the window makes way, what that tells, and the window while he keeps a queue.

    `rival` and `drain` are what is known of him and of making way. The mode is the owner's: it carries out a verdict.
    """

    __slots__ = ("_losses", "_params", "_path", "drain", "rival")

    def __init__(self, params: HybridParams, path: PathModel, losses: Losses) -> None:
        self._params = params
        self._path = path
        self._losses = losses
        self.rival = Rival(params)
        self.drain = Drain(params)

    def restart(self) -> None:
        """What was seen says nothing about what will be."""
        self.rival.restart()
        self.drain.restart()

    def memory_s(self, interval_s: float, *, varying: bool) -> float:
        """How long the least delay counts, where an empty queue is to be seen once in `interval_s`."""
        params = self._params
        if self.rival.cubic is not None:
            return params.compete_max_s + params.base_window_s
        memory_s = max(params.base_window_s, 2.2 * interval_s)
        if varying:  # the queue that is kept must not become the empty path
            memory_s = max(memory_s, 2 * params.variable_memory_s)
        return memory_s

    # --- making way -----------------------------------------------------------------------------------------------

    def stuck(self, now: float, window: float, inflight_bytes: int) -> bool:
        """Whether a queue stays that is not ours, and nobody is known to keep it."""
        path, rival = self._path, self.rival
        queue_s = path.view.queue_s
        return (
            rival.cubic is None
            and rival.stuck(now, queue_s, window, path.fragment, path.rate.peak)
            and not self._own(queue_s, window, inflight_bytes)
        )

    def _own(self, queue_s: float, window: float, inflight_bytes: int) -> bool:
        """Whether all that queues may be ours: class 0, which passes the window, what left before the window was cut,
        or the least that we have under way on a thin link."""
        room = 2 * self._path.fragment
        return inflight_bytes > window + room or (window <= room and queue_s * self._path.rate.peak < window + room)

    def make_way(self, now: float, window: float, least_window: float, *, competing: bool) -> float | None:
        """Begin to make way. Returns the window with which the path empties; None: what it carries is not known."""
        path = self._path
        rate, rtt_s = path.rate.value, path.rtt_s
        if rate is None or rtt_s is None:
            return None
        smaller = max(min(window, self._params.drain_gain * rate * rtt_s), least_window)
        wait_s = rtt_s + path.view.queue_s if competing or self.rival.above_epochs else rtt_s
        self.drain.begin(now, window, smaller, wait_s, rate)
        return smaller

    def judge(self, now: float, window: float, inflight_bytes: int) -> Verdict | None:
        """We made way for a round trip: whose is the queue? None: nothing new."""
        params, rival, view = self._params, self.rival, self._path.view
        cubic, queue_s = rival.cubic, view.queue_s
        if queue_s <= view.high_s:
            return None if cubic is None else self._gone(now, queue_s, window)
        if cubic is not None:
            return Verdict.LONGER_PATH if now > cubic.began_s + params.compete_max_s else None
        if rival.above_epochs < params.stuck_epochs or self._own(queue_s, window, inflight_bytes):
            return None
        quiet = now > max(rival.until_s, self._losses.at_s + params.loss_memory_s)
        return Verdict.LONGER_PATH if quiet and rival.flat(queue_s) else Verdict.RIVAL

    def _gone(self, now: float, queue_s: float, window: float) -> Verdict:
        """The rival's queue went as we made way."""
        params, rival = self._params, self.rival
        rival.cubic = None
        rival.calm_window = window
        # A rival that has just cut its window leaves a short queue; one of our own goes to the last packet.
        emptied = queue_s <= params.fast_s + self._path.view.serialise_s
        if params.variable_queue_s is not None and emptied and rival.went_again(now):
            rival.forget()  # none comes and goes as we make way: the link fades
            return Verdict.FADED
        rival.remember(now)
        return Verdict.GONE

    def longer_path(self, now: float, queue_s: float) -> None:
        """Take what looked like a queue for a longer way."""
        self._path.longer_path(now, queue_s)
        self.rival.above_epochs = 0
        self.rival.adopted_until_s = now + self._params.rival_memory_s

    # --- beside a rival -------------------------------------------------------------------------------------------

    def compete(self, now: float, window: float, seen: Seen) -> float:
        """Begin to compete. Returns the window."""
        path, rival = self._path, self.rival
        path.slowdown.forget()
        rtt_s = seen.rtt_s + seen.queue_s
        window = max(window, rival.calm_window, (path.rate.arrived.rate() or 0.0) * rtt_s)
        window = min(window, self._params.max_window_bytes)
        rival.cubic = Cubic(now, window, path.fragment)
        rival.above_epochs = 0
        return window

    def competing_window(self, cubic: Cubic, now: float, window: float, least_window: float, seen: Seen) -> float:
        """The window after an epoch beside a rival."""
        params = self._params
        wanted = min(cubic.window(now, seen.rtt_s + seen.queue_s, self._path.fragment), params.max_window_bytes)
        most = 1.5 * window if seen.queue_s < params.compete_queue_s else window
        return min(max(wanted, least_window), most)
