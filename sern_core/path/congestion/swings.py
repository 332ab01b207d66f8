"""A link whose rate swings: told from others by its queues, and followed while it does (`variable`)."""

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.company import Drain
from sern_core.path.congestion.mode import Mode
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.path_model import PathModel, Seen
from sern_core.path.congestion.variable import Variability, VariableWindow


class Swings:
    """Tells by each acknowledgement whether the link is full, and steers the window of one that swings.

    `begin` when it is to be followed, then `steer` by each acknowledgement and `close_epoch` until that says that the
    link keeps a rate again.
    """

    __slots__ = ("_drain", "_params", "_path", "_variability", "_window")

    def __init__(self, params: HybridParams, path: PathModel, drain: Drain) -> None:
        self._params = params
        self._path = path
        self._drain = drain
        self._variability = Variability(params)
        self._window = VariableWindow(params)

    def measure_anew(self) -> None:
        """What arrives cannot be compared with what did. That the link swings stands."""
        self._variability.measure_anew()
        self._window.restart()

    def note(self, sample: AckSample, queue_s: float, mode: Mode) -> None:
        """See whether the link is full: every packet meets another one, and waits longer than jitter makes it."""
        path = self._path
        jitter_s = 0.0 if mode.varying else path.view.jitter_s
        tells = not (sample.app_limited or mode.starting or mode.draining or mode.competing)
        if tells and queue_s >= jitter_s + self._params.fast_s:
            rate = path.rate.arrived.rate()
            met = rate is not None and queue_s >= jitter_s + path.fragment / rate
            if met and not self._drain.lately(sample.now, path.rtt_s or 0.0):
                self._variability.queued(sample.now, sample.receiver_s, sample.cum_bytes, jitter_s)
                return
        self._variability.passed()

    def at_least(self, now: float, rate: float) -> None:
        """The link carried `rate`, in bytes/s, and may be able to carry more."""
        self._variability.at_least(now, rate)

    def faded(self, now: float) -> None:
        """A queue of ours came and went: the link carried less for a while."""
        self._variability.faded(now)

    def seen(self, now: float) -> bool:
        """Whether the link has swung of late."""
        return self._variability.swings(now)

    def begin(self) -> None:
        """Follow the link from now on."""
        self._window.restart()

    def steer(self, window: float, queue_s: float, sample: AckSample) -> float:
        """The window after an acknowledgement whose packet queued for `queue_s`."""
        path = self._path
        return self._window.steer(window, queue_s, sample, rtt_s=path.rtt_s or 0.0, fragment=path.fragment)

    def close_epoch(self, now: float, seen: Seen) -> bool:
        """An epoch is over. Whether the link still swings."""
        if self._window.close_epoch(now, seen.queue_s, high_s=self._path.view.high_s, rtt_s=seen.rtt_s):
            self._variability.forget()  # it was a rival who took more or less of the link
        return self._variability.swings(now)
