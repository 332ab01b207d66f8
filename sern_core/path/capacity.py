"""What a lane can carry and how much of it may be in flight: the interface that every estimator fills.

One estimator a lane. The link feeds it sends, acknowledgements and losses; it answers with a window in bytes, a
capacity in bits per second (None while unknown) and whether the path has stalled. Algorithms live in
`sern_core.path.congestion`, one a file, with their parts beside them.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import inf
from typing import Final

from mypy_extensions import mypyc_attr

PACING_BURST_S: Final = 0.001
"""A timer may be this late; what could have left meanwhile leaves at once..."""
PACING_LATE_S: Final = 0.02
"""... and this late where something waited for it all the time: on a busy machine it is. What does not leave then is
not seen to arrive, and a window that is steered by what arrives would follow the timers."""
PACING_DEBT_S: Final = 0.1


@dataclass(slots=True)
class AckSample:
    """One acknowledgement that moved things forward. `rtt_s` excludes the receiver's acknowledgement delay."""

    now: float
    rtt_s: float
    acked_bytes: int
    inflight_bytes: int  # after this acknowledgement
    receiver_s: float  # the receiver's clock when the newest acknowledged packet arrived
    cum_bytes: int  # bytes the receiver has got in all by then
    app_limited: bool  # the sender had nothing to send when that packet left
    sent_s: float | None = None  # our clock when it left; with it the queue is told from forward delay alone
    packet_bytes: int = 0  # its size, 0 when unknown: what it took to serialise is no queue
    overtook: bool = False  # the one before it had not arrived by then: it was lost, or is on a longer way


class Receiver:
    """What the receiver says of its clock and of the bytes it has got. Both only grow, unless it errs or lies."""

    __slots__ = ("_cum_bytes", "_receiver_s")

    def __init__(self) -> None:
        self._receiver_s = -inf
        self._cum_bytes = 0

    def went_back(self, receiver_s: float, cum_bytes: int) -> bool:
        """Note one statement. True: nothing said before can be compared with it; measure from here."""
        back = receiver_s < self._receiver_s or cum_bytes < self._cum_bytes
        self._receiver_s = receiver_s
        self._cum_bytes = cum_bytes
        return back


@mypyc_attr(allow_interpreted_subclasses=True)  # those that this one is compared with
class CapacityEstimator(ABC):
    """Window and capacity of one lane. Every method takes the time from its caller.

    Samples hold what the peer says: counters that stand still or go back, times that do not move or lie years away.
    Whatever they hold nothing is raised, the window is positive, and rates are positive and finite, or None.
    """

    @property
    @abstractmethod
    def window_bytes(self) -> float:
        """Bytes that may be in flight, headers included."""

    @property
    @abstractmethod
    def rate_bps(self) -> float | None:
        """Estimated capacity in bits per second; None while unknown."""

    @property
    def bound_bps(self) -> float | None:
        """What the path has carried at least, bits per second: known before there was enough to send to fill it."""
        return self.rate_bps

    @property
    def queues(self) -> bool:
        """Whether what is sent waits on the path for longer than it is to: more than must be sent now is too much."""
        return False

    @property
    @abstractmethod
    def rtprop_s(self) -> float | None:
        """Round-trip time of the empty path; None while unknown."""

    @property
    def unqueued_bytes(self) -> float:
        """Bytes in flight that fill the path and wait nowhere on it; what is in the background keeps below."""
        return self.window_bytes

    @property
    def eased_s(self) -> float:
        """When packets were last seen to take clearly less time than the link as it is known can have given them: it
        may have got faster, though there was too little to send to tell by how much. -inf: never."""
        return -inf

    @property
    def pacing_bps(self) -> float | None:
        """How fast to send while the window is open; None: at once."""
        return None

    @abstractmethod
    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        """`nbytes` left; `inflight_bytes` includes them."""

    @abstractmethod
    def on_ack(self, sample: AckSample) -> None: ...

    @abstractmethod
    def on_loss(self, *, now: float, nbytes: int) -> None: ...

    @abstractmethod
    def on_reset(self, *, now: float) -> None:
        """The transport was replaced: what is in flight is gone, the path may be another."""

    def goes_on_from(self, other: "CapacityEstimator", *, now: float) -> None:  # noqa: B027
        """The lane of `other` has carried the data over the same path until now, and this one does from now on: what
        the one has found need not be found again."""

    @abstractmethod
    def on_stall(self, *, now: float) -> None:
        """No acknowledgement for too long; capacity is zero until the next one."""

    def snapshot(self) -> dict[str, float | None]:
        """State for /api/link and the metrics."""
        return {"window_bytes": self.window_bytes, "rate_bps": self.rate_bps, "rtprop_s": self.rtprop_s}


class Pacer:
    """Spreads what the window allows over time. Class 0 does not wait for it, but counts."""

    __slots__ = ("_bps", "_next_s", "_waits", "due_s")

    def __init__(self) -> None:
        self._bps = 0.0  # the pace of the latest datagram
        self._next_s = 0.0
        self._waits = False  # something waited for the pacer alone since the latest datagram
        self.due_s = 0.0
        """When the next datagram may leave. May be put off: of what is not used then `PACING_BURST_S` is made good."""

    def ready(self, now: float) -> bool:
        return now >= self.due_s

    def sent(self, *, now: float, nbytes: int, pacing_bps: float | None, waits: bool = False) -> None:
        """`nbytes` left; `waits`: more waits, for the pacer alone. Of the time that was not used no more is saved up
        than a timer may be late; and what does not ask, class control, keeps the others waiting for its own time or
        `PACING_DEBT_S` at most. Without that bound a moment of a very low pace would hold them back for as long as
        class control had exceeded it."""
        if pacing_bps is not None:
            unused_s = PACING_BURST_S
            if self._waits and now > self.due_s + unused_s:
                unused_s = min(now - self.due_s, PACING_LATE_S)
            self._waits = waits
            earliest_s = now - unused_s
            own_s = 8 * nbytes / pacing_bps
            begin_s = self._next_s if self._next_s > earliest_s else earliest_s
            self.due_s = self._next_s = max(begin_s, min(begin_s + own_s, now + max(own_s, PACING_DEBT_S)))
            self._bps = pacing_bps

    def paced(self, *, now: float, pacing_bps: float | None) -> None:
        """What the pace is from now on. A long wait that a slower one had asked for gets shorter: before much was sent
        a pace may say seconds for a datagram, and be known better a moment later."""
        left_s = self._next_s - now
        if left_s > PACING_DEBT_S and pacing_bps is not None and pacing_bps > self._bps:
            self.due_s = self._next_s = now + left_s * self._bps / pacing_bps
            self._bps = pacing_bps
