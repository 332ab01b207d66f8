"""What the link takes, by what the receiver got, and what is known of a link that got slower."""

from math import inf
from typing import Final

from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import GreatestRate, LatelyArrived

BURST_BYTES: Final = 4 * 1200
"""What comes in a shorter burst tells too little."""
SPAN_PACKETS: Final = 4
"""A slower link is told by what comes while it sends so many packets, at least."""
BURST_TIMES: Final = 1.03
BURSTS: Final = 3
"""This many bursts in a row, each `BURST_TIMES` as fast as the link was known to be, show that it is faster."""


class LinkRate:
    """The greatest rate of late. `value` is in bytes/s: the capacity if it is `saturated`, that is if there ever was
    more to send; else how fast bursts came, or what was offered. `peak` is the greatest of the last minute or so."""

    __slots__ = (
        "_faster",
        "_mark",
        "_params",
        "_rates",
        "_span_idle",
        "_span_limited",
        "arrived",
        "burst",
        "bursts",
        "peak",
        "saturated",
        "shown",
        "value",
    )

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._rates = GreatestRate()
        self.value: float | None = None
        self.saturated = False
        self.shown = False
        """Whether `value` says what the link can do, and not what little was offered."""
        self.bursts = 0
        """How many bursts were measured since anything else showed it; 0: something else does."""
        self.peak = 0.0
        self.measure_anew()

    def measure_anew(self) -> None:
        """What arrived so far says nothing about what will."""
        self.skip_span()
        self._span_limited = self._span_idle = False
        self.arrived = LatelyArrived()
        self.burst: tuple[float, int] | None = None
        """When it began by the receiver's clock, and bytes by then; None: there is none."""
        self._faster: list[float] = []  # rates of the latest bursts, in a row, that the link was not known to carry

    def skip_span(self) -> None:
        """The span of now is not measured to its end."""
        self._mark: tuple[float, int] | None = None

    def stalled(self) -> None:
        """Nothing is known of the link; what begins anew shows little at first."""
        self._rates.clear()
        self.value = None
        self.saturated = self.shown = False
        self.bursts = 0
        self.measure_anew()

    def measure(
        self, receiver_s: float, cum_bytes: int, *, app_limited: bool, held: bool, rtt_s: float
    ) -> tuple[float, bool] | None:
        """The rate over a span that ends now, and whether that is less than the link takes; None: it goes on.
        `app_limited`: there was nothing more to send; `held`: something of ours held back what there was."""
        mark = self._mark
        if mark is None:
            self._mark = (receiver_s, cum_bytes)
            self._span_limited = app_limited or held
            self._span_idle = app_limited
            return None
        if app_limited or held:
            self._span_limited = True
        self._span_idle |= app_limited
        span_s = receiver_s - mark[0]
        if span_s < self._params.min_rate_span_s or span_s < rtt_s:
            return None
        rate = (cum_bytes - mark[1]) / span_s
        if rate <= 0.0:
            return None  # the receiver names newer packets and no more bytes: that says nothing of the path
        limited = self._span_limited
        if not self._span_idle:
            self.shown, self.bursts = True, 0
        self._mark = (receiver_s, cum_bytes)
        self._span_limited = app_limited or held  # nothing more was there when this packet left: the next begins idle
        self._span_idle = app_limited
        return rate, limited

    def note_burst(
        self, now: float, receiver_s: float, cum_bytes: int, *, app_limited: bool, spread_s: float, rtt_s: float
    ) -> None:
        """One acknowledgement. A robot that sends a cloud now and again leaves the link idle in between: it carried
        what came while one arrived, not what came in a span with the pauses. `spread_s`: by so much jitter may have
        made a burst shorter. `app_limited`: there was nothing more to send, so the burst is over."""
        began = self.burst
        if not app_limited:
            if began is None:
                self.burst = (receiver_s, cum_bytes)
            return
        self.burst = None
        if began is None or cum_bytes - began[1] < BURST_BYTES or receiver_s <= began[0]:
            return
        rate = (cum_bytes - began[1]) / (receiver_s - began[0] + spread_s)
        if not self.saturated or self.value is None:
            self.bursts += 1
            self.show(now, rate, rtt_s)
        elif rate > BURST_TIMES * self.value:
            self._faster.append(rate)
            if len(self._faster) == BURSTS:
                self.note(now, min(self._faster), rtt_s)
                self._faster.clear()
        else:
            self._faster.clear()

    @property
    def lately(self) -> float | None:
        """Bytes/s that the link has carried of late; where it is not known to be full, between the pauses."""
        arrived = self.arrived.rate()
        if self.saturated or arrived is None or self.value is None:
            return arrived
        return max(arrived, self.value)

    def saturate(self) -> None:
        """There is more to send than the link takes: what bursts showed is forgotten."""
        if not self.saturated:
            self.saturated = self.shown = True
            self.bursts = 0
            self._rates.clear()

    def note(self, now: float, rate: float, rtt_s: float) -> None:
        """The link has carried `rate`."""
        self.value = self._rates.note(now, rate, max(self._params.rate_window_s, 3 * rtt_s))

    def show(self, now: float, rate: float, rtt_s: float) -> None:
        """The link can do `rate` at least, though there was not more to send for long."""
        self.shown = True
        self.note(now, rate, rtt_s)

    def adopt(self, other: "LinkRate", now: float, rtt_s: float) -> None:
        """The link carries what another lane has seen there."""
        if other.value is not None:
            self.saturated, self.shown, self.bursts = other.saturated, other.shown, other.bursts
            self.replace(now, other.value, rtt_s)
            self.peak = other.peak

    def replace(self, now: float, rate: float, rtt_s: float) -> None:
        """The link carries `rate`, whatever was seen before."""
        self._rates.clear()
        self.note(now, rate, rtt_s)

    def decay(self, elapsed_s: float) -> None:
        """Forget a little of the peak."""
        self.peak = max(self.value or 0.0, self.peak * (1 - self._params.peak_decay * elapsed_s))


class Slowdown:
    """Whether the link got slower, and whether the queue that this made has gone."""

    __slots__ = ("_full", "_params", "faster_rate", "most_queue_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.faster_rate: float | None = None
        """The rate of which we had most, before the link seemed to get slower."""
        self.most_queue_s: float | None = None
        """The longest queue since then, whatever share of the link we had."""
        self._full: tuple[float, int] | None = None  # (time, bytes) at the receiver since which a queue never went

    def not_full(self) -> None:
        """The queue went, or who keeps it is somebody else."""
        self._full = None

    def arrives(self, receiver_s: float, cum_bytes: int, packet_s: float = 0.0) -> float | None:
        """The bytes/s that arrived over a span with a queue throughout: the link was never idle. None: it goes on.
        `packet_s`: what a packet takes; one or two of them, and they may be small, show no rate."""
        full = self._full
        if full is None:
            self._full = (receiver_s, cum_bytes)
            return None
        span_s = receiver_s - full[0]
        if span_s < max(self._params.min_rate_span_s, SPAN_PACKETS * packet_s):
            return None
        self._full = (receiver_s, cum_bytes)
        return (cum_bytes - full[1]) / span_s

    def forget(self) -> None:
        """Whatever it was, it is not that the link got slower."""
        self.faster_rate = self.most_queue_s = None

    def began(self, rate: LinkRate, slower: float) -> bool:
        """The link carries `slower` now. True: that is clearly less than it did."""
        value = rate.value
        if self.faster_rate is None and value is not None and value >= rate.peak / 2:
            self.faster_rate = value  # we had most of the link
        if value is None or slower >= self._params.slower * value:
            return False
        if self.most_queue_s is None:
            self.most_queue_s = 0.0
        return True

    def went(self, queue_s: float, window: float, room: float, rate: LinkRate, rtt_s: float | None) -> bool:
        """Whether the queue of a link that got slower came down to the least that we have under way. On a link that is
        a hundred times slower that is long against what a packet took before, and no queue seems ever to go."""
        most_s, value, params = self.most_queue_s, rate.value, self._params
        if most_s is None or value is None:
            return False
        self.most_queue_s = max(most_s, queue_s)
        least = window <= room and queue_s * value < window + room
        far = most_s > params.went_rtts * (rtt_s or inf) and value < params.went_slower * rate.peak
        return least and far and queue_s < params.went * most_s
