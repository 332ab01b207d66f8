"""Window, pacing and capacity from forward delay and from the rate timed at the receiver.

Theory of operation
    *Delay.* What queues on the way out shows in the forward delay d = receiver's stamp − our stamp (the clocks' offset
    is in every d alike, as in LEDBAT, RFC 6817): an acknowledgement that waits on a busy way back is no queue of ours.
    Small and large packets are told apart, for a large one takes longer to serialise. Once an *epoch* (a round trip,
    at least 40 ms) the 20th percentile is compared with its least value of the last ten seconds: the queue q.
    *Rate.* Bytes received between two stamps of the receiver, over a round trip and at least 120 ms; the capacity B is
    the greatest of the recent ones while there was more to send. While q stays above `hi` the link is never idle, so
    that what arrives in 120 ms is all it can do now: a link that got slower is known by then, a faster one by growth.
    *Window.* The queue is W − B·RTT, so an error of q is corrected as what it is in bytes: W += γ·B·(q* − q). While
    the path looks empty the step doubles every epoch, up to a quarter of W. A queue above `hi` cuts W to what the
    receiver saw; one far above for longer than a moment does it at once (the link got slower).
    *Jitter* hides whether the path is empty. There the queue's answer to the window tells (`room`): it follows
    where the path is full. Where it does not the window grows, by more each time, and what packets wait for each
    other's jitter is taken out of q. What is lost then beyond what is usual counts like a queue.
    *Pacing.* On a path without jitter a little below B while something queues: the window bounds, the pace keeps the
    queue short. Where packets take long it also tries the empty path, in small steps, with a window that leaves room.
    What is lost on the way is added. B does not follow what our own pacing made of it.
    *Start-up.* The first packets leave in a train: its dispersion shows the capacity one round trip later, and the
    window goes there in steps of at most `STARTUP_GAIN`.
    *Draining.* When no empty queue was seen for a while, one round trip at 0.6 of the product shows it. A queue that
    stays although we made way is either a longer path (constant: taken as the new empty path) or somebody else's:
    then the window follows CUBIC (RFC 9438) until a drain finds the queue gone.
    *Loss* alone changes nothing (radio): it counts only against a rival, and when a fifth is lost in start-up.
"""

from collections import deque
from math import inf
from typing import Final

from sern_core.path.capacity import AckSample, CapacityEstimator, Receiver
from sern_core.path.congestion.parts import BaseDelay, Cubic, Eased, GreatestRate, LatelyArrived, Swing, Train
from sern_core.path.congestion.room import Room

MIN_EPOCH_S: Final = 0.040
MIN_EPOCH_SAMPLES: Final = 4
BASE_WINDOW_S: Final = 10.0
MAX_DRAIN_S: Final = 1.0
DRAIN_INTERVAL_S: Final = 5.0
DRAIN_RTTS: Final = 20.0
"""On long paths draining is rarer: a round trip at 0.6 of the product costs 2 % of twenty."""
DRAIN_GAIN: Final = 0.6
RATE_WINDOW_S: Final = 1.2
MIN_RATE_SPAN_S: Final = 0.120
TARGET_S: Final = 0.0002
TARGET_PACKETS: Final = 0.32
FAST_PACKETS: Final = 2.5
FAST_S: Final = 0.002
"""Where a packet takes less than this, up to so many more: they cost little, and flows share more fairly."""
TURNS_S: Final = 0.002
TURNS_RATE: Final = 50e6
"""Bytes/s: what queues for a moment on a faster path waits for a processor, as processes take turns."""
GAIN: Final = 0.35
PATIENT_EPOCHS: Final = 2
"""The effect of a step is seen two epochs later; only then may the next one be larger."""
CLEAR_PACKETS: Final = 1.0
"""The path counts as empty when four packets of five met at most about one other."""
FIRST_GROWTH: Final = 0.02
MAX_GROWTH: Final = 0.25
ROOM_GAIN: Final = 1.25
QUICKER_EPOCHS: Final = 8
HELD_SPREADS: Final = 1.5
"""At most so many spreads of the delay are taken for what jitter holds back: it may be a queue after all."""
LOST_BY_CHANCE: Final = 3.0
"""Standard deviations of what is lost in an epoch, where packets are lost one by one."""
CUT: Final = 0.95
EMERGENCY_CUT: Final = 0.9
WENT: Final = 0.25
"""A queue that came down to this share of the longest one since the link got slower, as we made way, was ours..."""
WENT_RTTS: Final = 10
WENT_SLOWER: Final = 0.1
"""... if it was `WENT_RTTS` round trips long and the rate fell to this share: a rival leaves more, and its queue is
short for a moment whenever it looks at the empty path."""
SLOWER: Final = 0.8
"""The link got slower when less than this share of the known rate passes a queue that stays."""
EMERGENCY_S: Final = 0.050
STARTUP_GAIN: Final = 4.0
STARTUP_PACING: Final = 4.0
STARTUP_AIM: Final = 0.9
PACING_GAIN: Final = 1.03
CALM_PACING: Final = 0.985
CALM_PACKETS: Final = 0.3
"""These two replace `PACING_GAIN` and `TARGET_PACKETS` where there is no jitter and a packet takes little: with jitter
the rate would drift down unseen, and an epoch has too few long packets."""
GENTLE_PACKET_S: Final = 0.0015
GENTLE_PACKETS: Final = 0.4
GENTLE_PACING: Final = (1.01, 1.01, 1.01, 1.02, 1.03, 1.05, 1.09, 1.17, 1.3, 1.5)
"""The pace steers, not the window, where a packet takes longer than `GENTLE_PACKET_S`: one more in flight is a step of
the queue there. These are the pace over the capacity, epoch by epoch, while the path looks empty."""
CALM_SHARE: Final = 0.05
"""How much faster the pace is of a sender that has none of the link, so that shares meet."""
CALM_NOISE_S: Final = 0.0005
CALM_PACKET_S: Final = 0.003
DRAIN_PACING: Final = 0.98
INITIAL_WINDOW_BYTES: Final = 12_600
MIN_WINDOW_FRAGMENTS: Final = 1.5
"""The least window; the hop commits one fragment beyond it."""
MAX_WINDOW_BYTES: Final = 64 * 2**20
IDLE_S: Final = 2.0
"""What was not used for so long is halved, for the link may have changed; start-up brings it back."""
STUCK_EPOCHS: Final = 4
STUCK_WAIT_S: Final = 1.0
FLAT_S: Final = 0.003
LOSS_MEMORY_S: Final = 3.0
RIVAL_MEMORY_S: Final = 30.0
COMPETE_MAX_S: Final = 30.0
COMPETE_QUEUE_S: Final = 1.0
"""A stream never loses a packet: its queue would grow without end."""
NOISE: Final = 1.0
"""The least of many epochs lies so many times their spread below the usual one, though no queue ever was."""
PEAK_DECAY: Final = 0.02
"""Share of the peak rate that is forgotten each second."""


class HybridWindow(CapacityEstimator):
    """See the module. `fragment_bytes` is the size of a datagram of the lane before any was sent."""

    def __init__(self, *, fragment_bytes: int = 1260, initial_bytes: int = INITIAL_WINDOW_BYTES) -> None:
        self._first_fragment_bytes = fragment_bytes
        self._initial_bytes = initial_bytes
        self._receiver = Receiver()
        self._begin()

    def _begin(self) -> None:
        self._window = float(self._initial_bytes)
        self._fragment = float(self._first_fragment_bytes)
        self._rate: float | None = None  # bytes/s, the capacity, or what was offered if there was never more to send
        self._saturated = False  # there was: it is the capacity
        self._peak = 0.0  # bytes/s, the greatest rate of the last minute or so
        self._rates = GreatestRate()
        self._pacing: float | None = None  # bytes/s
        self._capped = False  # it keeps below the capacity
        self._calm = False
        self._jittery = False  # more than packets in each other's way make of it
        self._loss = 0.0  # smoothed share
        self._gentle = False  # calm, and a packet takes long enough to be steered for
        self._small, self._large = BaseDelay(), BaseDelay()
        self._queue_s = 0.0  # 20th percentile of the epoch
        self._queue_most_s = 0.0  # 80th
        self._serialise_s = 0.0
        self._jitter_s = 0.0
        self._spreads: deque[float] = deque(maxlen=16)
        self._least_spread_s = 0.0  # of these, but for chance: what jitter makes of them, whoever else sends
        self._target_s = 0.0
        self._high_s = inf
        self._rtt_s: float | None = None  # with our own queue on the way out empty
        self._startup = True
        self._cubic: Cubic | None = None  # while somebody else keeps the queue
        self._eased = Eased()
        self._lost_s = -inf
        self._restart()

    def _restart(self) -> None:
        """What was under way says nothing about what will be."""
        self._epoch_s: float | None = None
        self._samples: list[tuple[float, float]] = []  # (queue, way back) of the epoch
        self._limited = 0
        self._longest = 0  # bytes of a packet
        self._lost_bytes = self._acked_bytes = 0
        self._inflight = 0
        self._small.epoch.clear()
        self._large.epoch.clear()
        self._mark: tuple[float, int] | None = None
        self._span_limited = False
        self._faster_rate: float | None = None  # before the link seemed to get slower
        self._most_queue_s: float | None = None  # since then, whatever share of it we had
        self._full: tuple[float, int] | None = None  # (time, bytes) at the receiver since which a queue never went
        self._arrived = LatelyArrived()
        self._busy_s: float | None = None
        self._high_since_s: float | None = None
        self._hold_until_s = -inf
        self._empty_epochs = 0
        self._room = Room()
        self._held_s = 0.0  # what packets are held by the jitter of those before them, beyond the least delay
        self._leasts: deque[float] = deque(maxlen=QUICKER_EPOCHS)  # of the delay of large packets
        self._changed_s = -inf  # when the link was seen to have got slower or faster
        self._early_s = 0.0  # by how much the packets of the last epoch came sooner than that
        self._above_epochs = 0
        self._pinned = Swing()  # of the queue while the window is at its least
        self._recent: deque[float] = deque(maxlen=STUCK_EPOCHS)  # queues of the last epochs
        self._emptied_s = -inf
        self._drain_until_s: float | None = None
        self._judging = False
        self._drained_s = -inf
        self._saved_window = 0.0
        self._adopted_until_s = -inf
        self._rival_until_s = -inf
        self._calm_window = 0.0  # the last one with which the queue was as wanted
        self._begin_round(-inf)

    def _begin_round(self, now: float) -> None:
        self._round_s = now  # packets sent later belong to this round of start-up
        self._round_window = self._window
        self._train = Train()
        self._round_sent_pacing = self._pacing

    # --- what it says ---------------------------------------------------------------------------------------------

    @property
    def window_bytes(self) -> float:
        return self._window + self._fragment if self._capped and self._gentle else self._window

    @property
    def rate_bps(self) -> float | None:
        """None until there was more to send than the link took: what little was offered is no capacity."""
        return 8 * self._rate if self._rate is not None and self._saturated else None

    @property
    def bound_bps(self) -> float | None:
        return 8 * self._rate if self._rate is not None else None

    @property
    def pacing_bps(self) -> float | None:
        return 8 * self._pacing if self._pacing is not None else None

    @property
    def eased_s(self) -> float:
        return self._eased.at_s

    @property
    def rtprop_s(self) -> float | None:
        return self._rtt_s

    def snapshot(self) -> dict[str, float | None]:
        return {
            **super().snapshot(),
            "pacing_bps": self.pacing_bps,
            "queue_s": self._queue_s,
            "startup": float(self._startup),
            "competing": float(self._cubic is not None),
        }

    # --- what it sees ---------------------------------------------------------------------------------------------

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        self._longest = max(self._longest, nbytes)
        if nbytes > self._fragment:
            if self._peak and self._saturated:
                self._large.shift((nbytes - self._fragment) / self._peak)
            self._fragment = float(nbytes)
        if 2 * inflight_bytes >= self._window or self._busy_s is None:
            self._busy_s = now
        elif now > self._busy_s + IDLE_S:
            self._busy_s = now
            if self._window > self._initial_bytes:
                self._window = max(self._window / 2, self._initial_bytes)
                self._start_again(now)

    def on_ack(self, sample: AckSample) -> None:
        now, receiver_s, cum_bytes = sample.now, sample.receiver_s, sample.cum_bytes
        rtt_s, nbytes = sample.rtt_s, sample.packet_bytes
        if self._receiver.went_back(receiver_s, cum_bytes):
            self._mark = self._full = self._high_since_s = None
            self._arrived = LatelyArrived()
            self._train = Train()
        sent_s = sample.sent_s
        if sent_s is None:
            sent_s = now - rtt_s
            delay_s = rtt_s
        else:
            delay_s = receiver_s - sent_s
        back_s = rtt_s - delay_s
        base = self._large if nbytes == 0 or 2 * nbytes >= self._fragment else self._small
        if base is self._large and 0 < nbytes < self._fragment:
            # As if it had been a full one: else the least delay would be that of shorter ones. While there was never
            # more to send than the link took, what it takes is not known: what little was sent would make it seconds.
            if self._peak and self._saturated:
                delay_s += (self._fragment - nbytes) / self._peak
            elif 10 * nbytes < 9 * self._fragment:
                base = self._small
        base.epoch.append(delay_s)
        least = base.least
        queue_s = delay_s - least[0][1] - self._held_s if least else 0.0
        self._samples.append((queue_s, back_s))
        if self._saturated and self._rate is not None:
            size = nbytes or self._fragment
            queued = not sample.app_limited or queue_s > self._fragment / self._rate
            self._eased.note(now, receiver_s - sent_s, size, self._rate, queued=queued)
        if not sample.app_limited:
            self._limited += 1
            self._busy_s = now  # the pacer may hold back what the window would let go
        self._acked_bytes += sample.acked_bytes
        self._inflight = sample.inflight_bytes
        self._arrived.note(receiver_s, cum_bytes)
        if self._startup:
            if self._rtt_s is None or rtt_s < self._rtt_s:
                self._rtt_s = rtt_s
            if not sample.app_limited and sent_s >= self._round_s:
                self._ramp(now, receiver_s, cum_bytes, sample.acked_bytes)
        elif queue_s > 3 * self._high_s and self._cubic is None and self._drain_until_s is None:
            if self._high_since_s is None:
                self._high_since_s = receiver_s
            elif receiver_s >= self._high_since_s + EMERGENCY_S and now >= self._hold_until_s:
                self._emergency(now, queue_s)
        else:
            self._high_since_s = None
        self._measure_full(sample, queue_s)
        # Half a window and no queue: it was not the path that held us back, but our own pacing or a busy processor.
        idle = queue_s <= self._high_s and 2 * sample.inflight_bytes < self._window
        self._measure_rate(now, receiver_s, cum_bytes, sample.app_limited or idle)
        if self._epoch_s is None:
            self._epoch_s = now
        elif now >= self._epoch_s + max(MIN_EPOCH_S, self._rtt_s or 0.0) and len(self._samples) >= MIN_EPOCH_SAMPLES:
            self._close_epoch(now)

    def _measure_rate(self, now: float, receiver_s: float, cum_bytes: int, app_limited: bool) -> None:
        mark = self._mark
        if mark is None:
            self._mark = (receiver_s, cum_bytes)
            self._span_limited = app_limited
            return
        if app_limited:
            self._span_limited = True
        span_s = receiver_s - mark[0]
        if span_s < MIN_RATE_SPAN_S or span_s < (self._rtt_s or 0.0):
            return
        rate = (cum_bytes - mark[1]) / span_s
        if rate <= 0.0:
            return  # the receiver names newer packets and no more bytes: that says nothing of the path
        # What was sent while draining or with nothing more to send only shows a lower bound.
        bound = self._span_limited or self._draining(now)
        self._saturated = self._saturated or not bound
        if rate > (self._rate or 0.0) or not (bound or (self._capped and self._queue_s <= self._target_s)):
            self._note_rate(now, rate)
        self._mark = (receiver_s, cum_bytes)
        self._span_limited = app_limited  # nothing more was there when this packet left: the next span begins idle

    def _measure_full(self, sample: AckSample, queue_s: float) -> None:
        """While a queue stays the link is never idle: what arrives is all it can do, whatever was seen before."""
        if queue_s <= self._high_s or sample.app_limited or self._cubic is not None:
            self._full = None
            return
        full = self._full
        if full is None:
            self._full = (sample.receiver_s, sample.cum_bytes)
            return
        span_s = sample.receiver_s - full[0]
        if span_s < MIN_RATE_SPAN_S:
            return
        rate = (sample.cum_bytes - full[1]) / span_s
        self._full = (sample.receiver_s, sample.cum_bytes)
        if self._rate is not None and 0.0 < rate < SLOWER * self._rate:
            self._slower(sample.now, rate)

    def _slower(self, now: float, rate: float) -> None:
        """The link got slower, or somebody else has his share of it."""
        self._forget_rate(now, rate)
        self._mark = None
        self._saved_window = min(self._saved_window, rate * (self._rtt_s or 0.0) + self._fragment)

    def _forget_rate(self, now: float, rate: float) -> None:
        if self._faster_rate is None and self._rate is not None and self._rate >= self._peak / 2:
            self._faster_rate = self._rate  # we had most of the link
        if self._rate is not None and rate < SLOWER * self._rate:
            self._room = Room()
            self._changed_s = now
            if self._most_queue_s is None:
                self._most_queue_s = 0.0
        self._rates.clear()
        self._note_rate(now, rate)

    def _went(self, queue_s: float) -> bool:
        """Whether the queue of a link that got slower came down to the least that we have under way. On a link that is
        a hundred times slower that is long against what a packet took before, and no queue seems ever to go."""
        most_s = self._most_queue_s
        if most_s is None or self._rate is None:
            return False
        self._most_queue_s = max(most_s, queue_s)
        room = 2 * self._fragment
        least = self._window <= room and queue_s * self._rate < self._window + room
        far = most_s > WENT_RTTS * (self._rtt_s or inf) and self._rate < WENT_SLOWER * self._peak
        return least and far and queue_s < WENT * most_s

    def _emptied_slower(self, now: float) -> None:
        """The queue went as we made way, so it was ours, and the link is slower: what a packet takes on it is none."""
        faster, rate = self._faster_rate or self._peak, self._rate
        self._faster_rate = self._most_queue_s = None
        if not faster or rate is None or rate >= faster:
            return
        self._peak = rate
        self._small.keep_least(now)
        self._large.keep_least(now)
        # The fragments of a stream get shorter with its rate.
        fragment = min(self._fragment, max(self._longest, self._first_fragment_bytes))
        self._large.shift(fragment / rate - self._fragment / faster)
        self._fragment = fragment

    def _draining(self, now: float) -> bool:
        """Whether what arrives now may have been sent while draining."""
        return self._drain_until_s is not None or now < self._drained_s + 2 * (self._rtt_s or 0.0) + MIN_RATE_SPAN_S

    def _note_rate(self, now: float, rate: float) -> None:
        self._rate = self._rates.note(now, rate, max(RATE_WINDOW_S, 3 * (self._rtt_s or 0.0)))

    # --- start-up -------------------------------------------------------------------------------------------------

    def _start_again(self, now: float) -> None:
        self._startup = True
        self._cubic = None
        self._drain_until_s = None
        self._pace()
        self._begin_round(now)

    def _ramp(self, now: float, receiver_s: float, cum_bytes: int, acked_bytes: int) -> None:
        """One acknowledgement of start-up: the window doubles in a round, and goes where the trains point."""
        train = self._train
        if not train.note(receiver_s, cum_bytes, acked_bytes):
            return
        rtt_s = self._rtt_s or MIN_EPOCH_S
        seen = train.rate * rtt_s
        pacing = self._round_sent_pacing
        held = pacing is None or train.rate < 0.75 * pacing  # by the bottleneck, not by our own pacing
        if held and self._window > seen + 2 * self._fragment:
            self._end_startup(seen + self._fragment)
            return
        if train.nbytes >= self._round_window / 4:
            self._window = max(self._window, min(STARTUP_GAIN * self._round_window, STARTUP_AIM * seen))
            self._window = min(self._window, MAX_WINDOW_BYTES)
            self._peak = max(self._peak, min(train.rate, self._window / rtt_s))
            self._pace()
            if held and self._window >= 0.85 * seen:
                self._end_startup(self._window)
            else:
                self._begin_round(now)

    def _end_startup(self, window: float) -> None:
        self._startup = False
        self._window = max(window, MIN_WINDOW_FRAGMENTS * self._fragment)
        self._hold_until_s = -inf
        self._empty_epochs = 0
        self._pace()

    # --- once an epoch --------------------------------------------------------------------------------------------

    def _close_epoch(self, now: float) -> None:
        samples = self._samples
        count = len(samples)
        queues = sorted([queue_s for queue_s, _ in samples])
        backs = sorted([back_s for _, back_s in samples])
        fifth = count // 5
        queue_s = self._queue_s = max(0.0, queues[fifth])
        interval_s = max(DRAIN_INTERVAL_S, DRAIN_RTTS * (self._rtt_s or 0.0))
        window_s = max(BASE_WINDOW_S, 2.2 * interval_s) if self._cubic is None else COMPETE_MAX_S + BASE_WINDOW_S
        for base in (self._small, self._large):
            if base.epoch:
                base.epoch.sort()
                base.note(now, base.epoch[len(base.epoch) // 5], window_s)
                base.epoch.clear()
        if queues[fifth] < -self._high_s and now < self._adopted_until_s:
            self._rival_until_s = now + RIVAL_MEMORY_S  # the short way is back: it was a queue
        leasts = self._leasts
        leasts.append(self._large.value_s or 0.0)
        if max(leasts) - leasts[-1] > 0.5 * self._serialise_s > CALM_PACKET_S:
            leasts.clear()
            self._changed_s = now  # no packet can take less than the link needs for it
            self._room.hurry()
        early_s, self._early_s = self._early_s, max(0.0, -queues[fifth])
        self._held_s = max(0.0, self._held_s - min(early_s, self._early_s))
        known = self._large.least or self._small.least
        rtt_s = self._rtt_s = max(1e-5, known[0][1] + self._held_s + backs[count // 2])
        spread_s = queues[count * 4 // 5] - queues[fifth]
        self._jitter_s += 0.1 * (min(spread_s, 0.020 + 0.2 * rtt_s) - self._jitter_s)
        # Of the link, not of our share of it: by the greatest rate seen lately.
        self._peak = max(self._rate or 0.0, self._peak * (1 - PEAK_DECAY * (now - (self._epoch_s or now))))
        serialise_s = self._serialise_s = self._fragment / self._peak if self._peak else 0.0
        self._queue_most_s = queues[count * 4 // 5]
        self._spreads.append(self._queue_most_s - queues[fifth])
        own_s = self._fragment / self._rate if self._rate else 0.0
        noise_s = NOISE * max(0.0, self._jitter_s - serialise_s)
        # A slower flow wants a longer queue than a faster one, so that their shares meet.
        self._calm = noise_s <= CALM_NOISE_S and serialise_s <= CALM_PACKET_S
        least_spread_s = self._least_spread_s = sorted(self._spreads)[len(self._spreads) // 8]
        self._jittery = least_spread_s > (CALM_NOISE_S if serialise_s <= CALM_PACKET_S else serialise_s)
        # Fragments of a stream grow with its rate, and TCP cuts them anew: what they take is not known so well.
        self._gentle = self._calm and serialise_s >= GENTLE_PACKET_S and self._fragment <= self._first_fragment_bytes
        packets = GENTLE_PACKETS if self._gentle else CALM_PACKETS if self._calm else TARGET_PACKETS
        packets += FAST_PACKETS * max(0.0, 1 - serialise_s / FAST_S)
        turns_s = TURNS_S * max(0.0, 1 - TURNS_RATE / self._peak) if self._peak else 0.0
        self._target_s = TARGET_S + packets * min(own_s, 4 * serialise_s) + noise_s + turns_s
        self._high_s = max(0.010, 0.1 * rtt_s) + serialise_s + 1.5 * noise_s
        self._recent.append(queue_s)
        if (self._faster_rate is not None and queue_s <= self._high_s) or self._went(queue_s):
            self._emptied_slower(now)
        elif queue_s <= self._high_s:
            self._most_queue_s = None
        if self._judging and self._drain_until_s is None:
            self._judging = False
            self._judge(now, queue_s, rtt_s)
        if queue_s < 0.25 * self._target_s or self._room.steps:
            self._emptied_s = now
        limited = 2 * self._limited >= count
        lost = self._lost_bytes / max(1, self._lost_bytes + self._acked_bytes)
        if not self._room.trying:  # what a larger window loses is not usual
            self._loss += 0.05 * (min(lost, 0.2) - self._loss)
        if self._drain_until_s is not None:
            if now >= self._drain_until_s:
                self._window = self._saved_window
                self._drain_until_s = None
                self._drained_s = now
                self._judging = True
        elif self._startup:
            if limited and (queue_s > self._high_s / 2 or lost > 0.2):
                rate = self._arrived.rate()
                self._end_startup(min(self._window, rate * rtt_s) if rate else self._window / 2)
        elif limited:
            if self._cubic is not None:
                self._room.clear()
                window = min(self._cubic.window(now, rtt_s + queue_s, self._fragment), MAX_WINDOW_BYTES)
                most = 1.5 * self._window if queue_s < COMPETE_QUEUE_S else self._window
                self._window = min(max(window, MIN_WINDOW_FRAGMENTS * self._fragment), most)
            else:
                self._steer(now, queue_s, rtt_s, lost)
            stuck = self._cubic is None and (self._above_epochs >= STUCK_EPOCHS or self._is_pinned(now, queue_s))
            stuck = stuck and not self._own(queue_s)
            if stuck and now < self._rival_until_s:
                self._compete(now, rtt_s + queue_s)
            elif (stuck and now >= self._drained_s + STUCK_WAIT_S) or (
                now >= max(self._drained_s, self._emptied_s) + interval_s
            ):
                self._drain(now, rtt_s)
        self._pace()
        samples.clear()
        self._limited = self._longest = 0
        self._lost_bytes = self._acked_bytes = 0
        self._epoch_s = now

    def _steer(self, now: float, queue_s: float, rtt_s: float, lost: float) -> None:
        rate = self._rate
        if rate is None:
            return
        window = self._window
        if queue_s > self._high_s:
            self._room.clear()
            self._empty_epochs = 0
            self._above_epochs += 1
            if now >= self._hold_until_s:
                recent = self._arrived.rate() or rate
                if self._above_epochs >= 2 and self._faster_rate is None:
                    self._forget_rate(now, recent)
                window = min(window, CUT * min(recent, rate) * rtt_s + self._fragment)
                self._hold_until_s = now + rtt_s
        else:
            self._above_epochs = 0
            if now >= self._rival_until_s:
                self._calm_window = window
            target_s = self._target_s
            queue_s = self._look_for_room(now, window, queue_s, rate, lost)
            back_bytes, self._room.back_bytes = self._room.back_bytes, None
            if back_bytes is not None and back_bytes < window:
                queue_s = max(0.0, queue_s - (window - back_bytes) / rate)
                window = back_bytes
            step = GAIN * rate * max(target_s - queue_s, -queue_s)
            if queue_s >= 0.25 * target_s:
                self._empty_epochs = 0
            elif self._queue_most_s <= min(self._spreads) + CLEAR_PACKETS * self._serialise_s:
                # Clearly empty: hardly a packet met another one. Otherwise a little more will do.
                self._empty_epochs += 1
                if self._empty_epochs > PATIENT_EPOCHS:
                    step = max(step, FIRST_GROWTH * window) * 2 ** min(self._empty_epochs - PATIENT_EPOCHS - 1, 8)
            if self._room.trying:
                step = max(step, self._room.step(window))
            if step > 0:
                gain = ROOM_GAIN if self._room.steps and not self._empty_epochs else 1.4
                most = gain * rate * (rtt_s + target_s) + 3 * self._fragment
                if self._capped and self._gentle and not self._room.trying:
                    # It does not bind, so it would run away.
                    most = self._probing * rate / (1 - self._loss) * (rtt_s + target_s) + self._fragment
                window = max(window, min(window + min(step, MAX_GROWTH * window), most))
            else:
                window = min(window, 1.1 * rate * (rtt_s + queue_s) + 4 * self._fragment) + step
        self._window = min(max(window, MIN_WINDOW_FRAGMENTS * self._fragment), MAX_WINDOW_BYTES)

    def _look_for_room(self, now: float, window: float, queue_s: float, rate: float, lost: float) -> float:
        """The queue without what jitter holds packets back. In order they wait for those before them, the longer the
        closer they follow each other: that is in no delay of slower times, and is no queue."""
        room = self._room
        tries = (self._jittery and not self._calm) or now < self._changed_s + BASE_WINDOW_S
        if not (tries or room.trying) or now < self._rival_until_s:
            room.clear()
            return queue_s
        unusual = self._unusual(lost)
        has_room = room.note(
            now,
            window,
            queue_s,
            rate=rate,
            spread_s=max(self._jitter_s, self._serialise_s),
            lost=unusual,
            binds=not self._capped,
            tries=tries,
            patient=self._calm,
        )
        if room.back_bytes is not None and unusual > 0.0:
            queue_s += self._held_s  # the path drops what it cannot keep, so what was taken for jitter is all it keeps
            self._held_s = 0.0
            room.clear()
        if not has_room or self._calm or not self._jittery:
            return queue_s
        held_s = min(room.queue_s - self._target_s / 2, HELD_SPREADS * self._least_spread_s - self._held_s)
        if held_s <= 0.0:
            return queue_s
        self._held_s += held_s
        room.shift(held_s)
        return max(0.0, queue_s - held_s)

    def _unusual(self, lost: float) -> float:
        """What was lost in the epoch beyond what may be by chance where as much is lost as usual."""
        count = (self._lost_bytes + self._acked_bytes) / self._fragment
        usual = self._loss
        return lost - usual if count * (lost - usual) > LOST_BY_CHANCE * (usual * count) ** 0.5 + 2.0 else 0.0

    def _pace(self) -> None:
        rtt_s = self._rtt_s
        self._capped = False
        if rtt_s is None:
            return
        if self._startup:
            # The first train leaves at once: its dispersion is the bottleneck's, not our own.
            first = self._window <= self._initial_bytes
            self._pacing = None if first else STARTUP_PACING * self._window / rtt_s
            return
        if self._cubic is not None:
            self._pacing = 1.2 * self._window / rtt_s
            return
        self._pacing = PACING_GAIN * self._window / rtt_s
        rate = self._rate
        if rate is None or not self._peak:
            return  # nothing has been delivered in an epoch yet
        if self._room.trying:
            return
        if self._queue_s < 0.25 * self._target_s:
            if self._gentle and self._saturated:
                pacing = self._probing * rate / (1 - self._loss)
                self._capped = pacing < self._pacing
                self._pacing = min(self._pacing, pacing)
        else:
            gain = DRAIN_PACING
            if self._queue_s < 2 * self._target_s + self._serialise_s:
                gain = CALM_PACING + CALM_SHARE * max(0.0, 1 - rate / self._peak) if self._calm else PACING_GAIN
            if self._calm:
                rate /= 1 - self._loss  # what arrives is less than what was sent
            self._capped = self._calm and gain * rate < self._pacing
            self._pacing = max(min(self._pacing, gain * rate), 1.0)

    @property
    def _probing(self) -> float:
        """Times the capacity that an empty path is tried with."""
        return GENTLE_PACING[min(self._empty_epochs, len(GENTLE_PACING) - 1)]

    def _drain(self, now: float, rtt_s: float) -> None:
        if self._rate is None:
            return
        self._room.clear()
        self._saved_window = self._window
        self._window = max(min(self._window, DRAIN_GAIN * self._rate * rtt_s), MIN_WINDOW_FRAGMENTS * self._fragment)
        wait_s = rtt_s + self._queue_s if self._cubic is not None or self._above_epochs else rtt_s
        # What is too little for a rate must not become a pause without end.
        self._drain_until_s = now + wait_s + min((self._saved_window - self._window) / self._rate, MAX_DRAIN_S)

    def _judge(self, now: float, queue_s: float, rtt_s: float) -> None:
        """We made way for a round trip: whose is the queue?"""
        cubic = self._cubic
        if queue_s <= self._high_s:
            if cubic is not None:
                self._cubic = None
                self._calm_window = self._window
                self._rival_until_s = now + RIVAL_MEMORY_S
                self._window = min(self._window, (self._rate or 0.0) * rtt_s + self._fragment)
        elif cubic is not None:
            if now > cubic.began_s + COMPETE_MAX_S:
                self._new_path(now, queue_s)
        elif self._above_epochs >= STUCK_EPOCHS and not self._own(queue_s):
            flat = max(self._recent) - min(self._recent) < max(FLAT_S, 0.1 * queue_s)
            if flat and now > max(self._rival_until_s, self._lost_s + LOSS_MEMORY_S):
                self._new_path(now, queue_s)
            else:
                self._compete(now, rtt_s + queue_s)

    def _is_pinned(self, now: float, queue_s: float) -> bool:
        """Whether the window has long been at its least while the queue swings more than ours can: it is not ours,
        though no empty queue was ever seen to measure it by."""
        if self._window > 2 * self._fragment:
            self._pinned.since_s = None
            return False
        swing_s = max(0.010, min(0.100, 2 * self._window / self._peak)) if self._peak else inf
        return self._pinned.wider(now, queue_s, swing_s)

    def _own(self, queue_s: float) -> bool:
        """Whether all that queues may be ours: class 0, which passes the window, what left before the window was cut,
        or the least that we have under way on a thin link."""
        room = 2 * self._fragment
        return self._inflight > self._window + room or (
            self._window <= room and queue_s * self._peak < self._window + room
        )

    def _compete(self, now: float, rtt_s: float) -> None:
        self._faster_rate = self._most_queue_s = None
        window = max(self._window, self._calm_window, (self._arrived.rate() or 0.0) * rtt_s)
        window = min(window, MAX_WINDOW_BYTES)
        self._cubic = Cubic(now, window, self._fragment)
        self._window = window
        self._above_epochs = 0

    def _new_path(self, now: float, queue_s: float) -> None:
        """What looked like a queue is a longer way."""
        for base in (self._small, self._large):
            if base.least:
                delay_s = base.least[0][1] + self._held_s + queue_s
                base.least.clear()
                base.least.append((now, delay_s))
        far = self._rtt_s is not None and queue_s > WENT_RTTS * self._rtt_s
        if self._rtt_s is not None:
            self._rtt_s += queue_s
        if far and self._rate is not None and self._rate < WENT_SLOWER * self._peak:
            self._peak = self._rate  # what packets take on a link so much slower is what made it longer
            self._fragment = min(self._fragment, max(self._longest, self._first_fragment_bytes))
            self._most_queue_s = None
        self._queue_s = self._held_s = 0.0
        self._above_epochs = 0
        self._adopted_until_s = now + RIVAL_MEMORY_S
        self._start_again(now)

    def _emergency(self, now: float, queue_s: float) -> None:
        """The queue is far too long: the link got slower."""
        rtt_s = self._rtt_s
        rate = self._arrived.rate()
        if rtt_s is None or rate is None:
            return
        self._forget_rate(now, rate)
        self._mark = None
        self._drain_until_s = None
        self._window = min(self._window, max(EMERGENCY_CUT * rate * rtt_s, MIN_WINDOW_FRAGMENTS * self._fragment))
        self._hold_until_s = now + max(0.1, rtt_s + queue_s)
        self._high_since_s = None
        self._empty_epochs = 0
        self._pace()

    def on_loss(self, *, now: float, nbytes: int) -> None:
        self._lost_bytes += nbytes
        self._lost_s = now
        cubic = self._cubic
        if cubic is None or self._drain_until_s is not None:
            return
        if now >= cubic.cut_s + (self._rtt_s or 0.0) + self._queue_s:
            self._window = max(cubic.cut(now, self._window, self._fragment), MIN_WINDOW_FRAGMENTS * self._fragment)

    def on_reset(self, *, now: float) -> None:
        self._begin()

    def on_stall(self, *, now: float) -> None:
        self._rates.clear()
        self._rate = None
        self._saturated = False  # what begins anew shows little at first
        self._restart()
        self._changed_s = now
        self._window = max(min(self._window, self._initial_bytes), MIN_WINDOW_FRAGMENTS * self._fragment)
        self._start_again(now)
