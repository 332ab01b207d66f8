"""What is known of the path: how long it is, what it takes, and what queues on it (the network path model of BBR)."""

from math import inf
from typing import Final, NamedTuple

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.link_rate import LinkRate, Slowdown
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import Eased
from sern_core.path.congestion.path_delay import PathDelay
from sern_core.path.congestion.queue_view import QueueView

SHORTER: Final = 0.1
"""A path of which no packet of an epoch took more than this share of its round trip got shorter."""


class Seen(NamedTuple):
    """What the acknowledgements of an epoch show."""

    queue_s: float
    rtt_s: float
    """Round trip with our own queue on the way out empty."""
    limited: bool
    """There was more to send than the path took, in half of the epoch at least."""
    early: bool
    """Packets came sooner than over the empty path, by more than a queue may be long."""
    quicker: bool
    """Packets take clearly less time than before: it is another link."""


class PathModel:
    """Measures the path, epoch by epoch. `fragment_bytes` is the size of a datagram before any was sent.

    `note` takes each acknowledgement; whoever owns it closes an epoch that is over and begins the next one. What is
    measured is public; the window is the owner's.
    """

    __slots__ = (
        "_before_s",
        "_first_fragment_bytes",
        "_gaps",
        "_grew",
        "_known_fragment",
        "_last",
        "_limited",
        "_longest_rtt_s",
        "_params",
        "_samples",
        "delay",
        "eased",
        "epoch_s",
        "fragment",
        "longest",
        "rate",
        "rtt_s",
        "slowdown",
        "view",
    )

    def __init__(self, params: HybridParams, fragment_bytes: int) -> None:
        self._params = params
        self._first_fragment_bytes = fragment_bytes
        self.fragment = float(fragment_bytes)
        """Bytes of the largest packet that there is to send."""
        self._known_fragment = float(fragment_bytes)
        """The size of packets for which it is known how jitter holds them."""
        self._grew = False
        self._before_s: float | None = None
        """The queue before packets grew, in the epoch after that; None: they did not."""
        self.rate = LinkRate(params)
        self.delay = PathDelay(params)
        self.view = QueueView(params)
        self.eased = Eased()
        self.rtt_s: float | None = None
        """Round trip with our own queue on the way out empty; None: not known yet."""
        self.restart()

    def restart(self) -> None:
        """What was under way says nothing about what will be; length and rate of the path stand."""
        self.epoch_s: float | None = None
        """When the epoch began; None: with the next acknowledgement."""
        self._samples: list[tuple[float, float]] = []  # (queue, way back) of the epoch
        self._gaps: list[float] = []  # seconds a byte between acknowledgements of the epoch, at the receiver
        self._last: tuple[float, int] | None = None  # (time, bytes) at the receiver, of the latest of them
        self._longest_rtt_s = 0.0  # of the epoch
        self._limited = 0  # acknowledgements of packets after which there was more to send
        self.longest = 0
        """Bytes of the longest packet of the epoch."""
        self.delay.restart()
        self.rate.measure_anew()
        self.slowdown = Slowdown(self._params)

    # --- packets --------------------------------------------------------------------------------------------------

    def larger_packet(self, nbytes: int) -> None:
        """A packet left that is larger than any before: it takes longer."""
        rate = self.rate
        if rate.peak and rate.saturated:
            self.delay.longer_packets((nbytes - self.fragment) / rate.peak)
        self.fragment = float(nbytes)
        if nbytes >= 2 * self._known_fragment:
            self._grew = True

    def note(self, sample: AckSample) -> float:
        """Measure one acknowledgement. Returns how long its packet has queued."""
        rtt_s, receiver_s, sent_s, nbytes = sample.rtt_s, sample.receiver_s, sample.sent_s, sample.packet_bytes
        rate = self.rate
        if sent_s is None:
            sent_s = sample.now - rtt_s
            delay_s = rtt_s
        else:
            delay_s = receiver_s - sent_s
        queue_s = self.delay.queue_s(delay_s, nbytes, self.fragment, rate, overtook=sample.overtook)
        self._samples.append((queue_s, rtt_s - delay_s))
        if rtt_s > self._longest_rtt_s:
            self._longest_rtt_s = rtt_s
        carried = rate.value
        if carried is not None and rate.saturated:
            queued = not sample.app_limited or queue_s > self.fragment / carried
            self.eased.note(sample.now, receiver_s - sent_s, rtt_s, nbytes or self.fragment, carried, queued=queued)
        last, self._last = self._last, (receiver_s, sample.cum_bytes)
        if last is not None and (came_bytes := sample.cum_bytes - last[1]) > 0:
            self._gaps.append(max(0.0, receiver_s - last[0]) / came_bytes)
        if not sample.app_limited:
            self._limited += 1
        rate.arrived.note(receiver_s, sample.cum_bytes)
        return queue_s

    @property
    def segmented(self) -> bool:
        """Whether a packet is of many segments, as a fragment of a stream."""
        return self.fragment >= 2 * self._first_fragment_bytes

    # --- the rate -------------------------------------------------------------------------------------------------

    def slower_rate(self, sample: AckSample) -> float | None:
        """What arrives while a queue stays, in bytes/s, where it is clearly less than what is known: the link is never
        idle then, and this is all it can do, whatever was seen before."""
        rate = self.slowdown.arrives(sample.receiver_s, sample.cum_bytes, self.view.serialise_s)
        known = self.rate.value
        if rate is not None and known is not None and 0.0 < rate < self._params.slower * known:
            return rate
        return None

    def replace_rate(self, now: float, rate: float) -> bool:
        """The link carries `rate`, whatever was seen before. True: that is clearly less than it did."""
        slower = self.slowdown.began(self.rate, rate)
        self.rate.replace(now, rate, self.rtt_s or 0.0)
        return slower

    # --- epochs ---------------------------------------------------------------------------------------------------

    def epoch_over(self, now: float) -> bool:
        """Whether the epoch has lasted for a round trip, and shows something."""
        params, view, count = self._params, self.view, len(self._samples)
        if self.epoch_s is None or count < params.min_epoch_samples:
            return False
        rtt_s = self.rtt_s or 0.0
        if self._longest_rtt_s < SHORTER * rtt_s:
            rtt_s = self._longest_rtt_s  # the path got shorter
        lasted_s, least_s = now - self.epoch_s, max(params.min_epoch_s, rtt_s)
        if view.jittery and not view.calm and count < params.jittery_epoch_samples:
            least_s *= params.jittery_epochs
        return lasted_s >= least_s

    def close_epoch(self, now: float, memory_s: float, window: float, *, steered: bool) -> Seen:
        """See what the delays of the epoch say of path and queue. `memory_s`: how long the least delay of late counts;
        `window`: bytes that may be under way; `steered`: it was one that keeps the queue short."""
        delay, view, fragment = self.delay, self.view, self.fragment
        queues = sorted([queue_s for queue_s, _ in self._samples])
        backs = sorted([back_s for _, back_s in self._samples])
        count = len(queues)
        held_s = self._held_longer_s(queues[count // 5])
        if held_s:
            queues = [queue_s - held_s for queue_s in queues]
        early_s = -queues[count // 5]
        early = early_s > view.high_s
        delay.close_epoch(now, memory_s)
        if self.segmented and delay.no_large_since(now - memory_s):
            self._shorten_fragment()
            delay.smaller_packets(self.fragment / self.rate.peak if self.rate.peak else 0.0)
        quicker = delay.got_quicker(view.serialise_s)
        delay.came_early(early_s)
        rtt_s = self.rtt_s = max(1e-5, delay.empty_s(segmented=self.segmented) + backs[count // 2])
        self.rate.decay(now - (self.epoch_s or now))
        usual = fragment <= self._first_fragment_bytes
        limited = 2 * self._limited >= count
        gaps = sorted(self._gaps)
        packet_s = fragment * gaps[(len(gaps) - 1) // 2] if gaps else inf
        view.close_epoch(
            queues, rtt_s, self.rate, fragment, packet_s=packet_s, usual=usual, limited=limited, steered=steered
        )
        self._look_for_end_of_queue(now, window)
        return Seen(view.queue_s, rtt_s, limited, early, quicker)

    def _held_longer_s(self, queue_s: float) -> float:
        """Seconds for which jitter holds the packets of an epoch longer than those before, as they are larger: a
        fragment of a stream comes with the last of its segments, each of which jitter may hold. A window does not
        change so much in an epoch that this were its queue."""
        before_s, self._before_s = self._before_s, None
        if self._grew:
            self._grew = False
            self._known_fragment = self.fragment
            self._before_s = self.view.queue_s
        if before_s is None or not self.view.jitters:
            return 0.0
        held_s = min(queue_s - before_s, self._params.segmented_spreads * self.view.jitter_s)
        if held_s <= 0.0:
            return 0.0
        self.delay.held_s += held_s
        return held_s

    def begin_epoch(self, now: float) -> None:
        """What was seen of the last one has been dealt with."""
        self._samples.clear()
        self._gaps.clear()
        self._limited = self.longest = 0
        self._longest_rtt_s = 0.0
        self.epoch_s = now

    def _look_for_end_of_queue(self, now: float, window: float) -> None:
        """See whether the queue of a link that got slower has gone."""
        slowdown, view = self.slowdown, self.view
        if (slowdown.faster_rate is not None and not view.long) or slowdown.went(
            view.queue_s, window, 2 * self.fragment, self.rate, self.rtt_s
        ):
            self._emptied_slower(now)
        elif not view.long:
            slowdown.most_queue_s = None

    def _emptied_slower(self, now: float) -> None:
        """The queue went as we made way, so it was ours, and the link is slower: what a packet takes on it is none."""
        faster, rate = self.slowdown.faster_rate or self.rate.peak, self.rate.value
        self.slowdown.forget()
        if not faster or rate is None or rate >= faster:
            return
        self.rate.peak = rate
        self.delay.keep_least(now)
        before = self.fragment
        self._shorten_fragment()
        self.delay.longer_packets(self.fragment / rate - before / faster)

    def _shorten_fragment(self) -> None:
        """What there is to send got shorter: the fragments of a stream do with its rate."""
        self.fragment = min(self.fragment, max(self.longest, self._first_fragment_bytes))
        self._known_fragment = min(self._known_fragment, self.fragment)

    def longer_path(self, now: float, queue_s: float) -> None:
        """What looked like a queue is a longer way."""
        params, rate = self._params, self.rate
        self.delay.longer_path(now, queue_s)
        far = self.rtt_s is not None and queue_s > params.went_rtts * self.rtt_s
        if self.rtt_s is not None:
            self.rtt_s += queue_s
        if far and rate.value is not None and rate.value < params.went_slower * rate.peak:
            rate.peak = rate.value  # what packets take on a link so much slower is what made it longer
            self._shorten_fragment()
            self.slowdown.most_queue_s = None
        self.view.queue_s = 0.0
