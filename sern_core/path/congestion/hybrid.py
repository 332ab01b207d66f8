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
    *Swings.* A link whose rate goes up and down all the time (cellular) is followed acknowledgement by acknowledgement,
    with a queue that shows what it can do now (`variable`), until it keeps a rate again.
    *Draining.* When no empty queue was seen for a while, one round trip at 0.6 of the product shows it. A queue that
    stays although we made way is either a longer path (constant: taken as the new empty path) or somebody else's:
    then the window follows CUBIC (RFC 9438) until a drain finds the queue gone.
    *Silence* (`on_stall`) ends with the first acknowledgement: what was sent into it says nothing of the path, so
    start-up begins there once more.
    *Loss* alone changes nothing (radio): it counts only against a rival, and when a fifth is lost in start-up.
"""

from math import inf
from typing import Final

from sern_core.path.capacity import AckSample, CapacityEstimator, Receiver
from sern_core.path.congestion.company import Drain, Rival
from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.link_rate import LinkRate, Slowdown
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.mode import STARTUP, STEADY, TRANSITIONS, Event
from sern_core.path.congestion.pace import Pace
from sern_core.path.congestion.params import DEFAULT_HYBRID, HybridParams
from sern_core.path.congestion.parts import Cubic, Eased
from sern_core.path.congestion.path_delay import PathDelay
from sern_core.path.congestion.queue_view import QueueView
from sern_core.path.congestion.sooner import Sooner
from sern_core.path.congestion.start_up import StartUp
from sern_core.path.congestion.variable import Variability, VariableWindow

SOONER_ROOM: Final = 4
"""Packets."""


class HybridWindow(CapacityEstimator):
    """See the module. `fragment_bytes` is the size of a datagram of the lane before any was sent."""

    def __init__(
        self,
        *,
        fragment_bytes: int = 1260,
        initial_bytes: int = DEFAULT_HYBRID.initial_window_bytes,
        params: HybridParams = DEFAULT_HYBRID,
    ) -> None:
        self._params = params
        self._follows = params.variable_queue_s is not None  # swings of the link's rate
        self._first_fragment_bytes = fragment_bytes
        self._initial_bytes = initial_bytes
        self._receiver = Receiver()
        self._begin()

    def _begin(self) -> None:
        params = self._params
        self._mode = STARTUP
        self._window = float(self._initial_bytes)
        self._fragment = float(self._first_fragment_bytes)
        self._rate = LinkRate(params)
        self._delay = PathDelay(params)
        self._view = QueueView(params)
        self._pace = Pace(params)
        self._losses = Losses(params)
        self._growth = Growth(params, self._view, self._delay, self._losses)
        self._start = StartUp(params)
        self._rival = Rival(params)
        self._drain = Drain(params)
        self._eased = Eased()
        self._sooner = Sooner(params)
        self._variability = Variability(params)
        self._variable = VariableWindow(params)
        self._rtt_s: float | None = None  # with our own queue on the way out empty
        self._resumed_s = -inf  # when the first acknowledgement after a silence came
        self._restart()
        self._start.begin_round(-inf, self._window, None)

    def _restart(self) -> None:
        """What was under way says nothing about what will be."""
        self._silent = False
        self._epoch_s: float | None = None
        self._samples: list[tuple[float, float]] = []  # (queue, way back) of the epoch
        self._limited = 0
        self._longest = 0  # bytes of a packet
        self._inflight = 0
        self._losses.next_epoch()
        self._delay.restart()
        self._rate.measure_anew()
        self._rival.restart()
        self._drain.restart()
        self._slowdown = Slowdown(self._params)
        self._sooner.restart()
        self._growth.restart(-inf)
        self._variability.measure_anew()
        self._variable.restart()
        self._busy_s: float | None = None
        self._high_since_s: float | None = None
        self._hold_until_s = -inf

    def _happens(self, event: Event) -> None:
        self._mode = TRANSITIONS[event][self._mode]

    # --- what it says ---------------------------------------------------------------------------------------------

    @property
    def window_bytes(self) -> float:
        return self._window + self._fragment if self._pace.capped and self._view.gentle else self._window

    @property
    def rate_bps(self) -> float | None:
        """None until there was more to send than the link took: what little was offered is no capacity."""
        return 8 * self._rate.value if self._rate.value is not None and self._rate.saturated else None

    @property
    def bound_bps(self) -> float | None:
        return 8 * self._rate.value if self._rate.value is not None else None

    @property
    def pacing_bps(self) -> float | None:
        return 8 * self._pace.value if self._pace.value is not None else None

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
            "queue_s": self._view.queue_s,
            "startup": float(self._mode.starting),
            "competing": float(self._mode.competing),
            "varying": float(self._mode.varying),
        }

    # --- what it sees ---------------------------------------------------------------------------------------------

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        self._longest = max(self._longest, nbytes)
        if nbytes > self._fragment:
            if self._rate.peak and self._rate.saturated:
                self._delay.longer_packets((nbytes - self._fragment) / self._rate.peak)
            self._fragment = float(nbytes)
        if 2 * inflight_bytes >= self._window or self._busy_s is None:
            self._busy_s = now
        elif now > self._busy_s + self._params.idle_s:
            self._busy_s = now
            if self._window > self._initial_bytes:
                self._window = max(self._window / 2, self._initial_bytes)
                self._start_again(now)

    def on_ack(self, sample: AckSample) -> None:
        now, receiver_s, cum_bytes = sample.now, sample.receiver_s, sample.cum_bytes
        rtt_s, nbytes = sample.rtt_s, sample.packet_bytes
        rate = self._rate
        if self._silent:
            self._answers_again(now)
        if self._receiver.went_back(receiver_s, cum_bytes):
            rate.measure_anew()
            self._variability.measure_anew()
            self._variable.restart()
            self._slowdown.not_full()
            self._high_since_s = None
            self._start.measure_anew()
        sent_s = sample.sent_s
        if sent_s is None:
            sent_s = now - rtt_s
            delay_s = rtt_s
        else:
            delay_s = receiver_s - sent_s
        queue_s = self._delay.queue_s(delay_s, nbytes, self._fragment, rate)
        self._samples.append((queue_s, rtt_s - delay_s))
        if rate.saturated and rate.value is not None:
            size = nbytes or self._fragment
            queued = not sample.app_limited or queue_s > self._fragment / rate.value
            self._eased.note(now, receiver_s - sent_s, size, rate.value, queued=queued)
        if not sample.app_limited:
            self._limited += 1
            self._busy_s = now  # the pacer may hold back what the window would let go
        self._losses.acked_bytes += sample.acked_bytes
        self._inflight = sample.inflight_bytes
        rate.arrived.note(receiver_s, cum_bytes)
        mode, high_s = self._mode, self._view.high_s
        if mode.starting:
            if self._rtt_s is None or rtt_s < self._rtt_s:
                self._rtt_s = rtt_s
            if not sample.app_limited and sent_s >= self._start.since_s:
                self._ramp(now, receiver_s, cum_bytes, sample.acked_bytes, sample.sent_s)
        elif mode.varying:
            self._follow(sample, queue_s)
        elif queue_s > 3 * high_s and not (mode.competing or mode.draining):
            if self._high_since_s is None:
                self._high_since_s = receiver_s
            elif receiver_s >= self._high_since_s + self._params.emergency_s and now >= self._hold_until_s:
                self._emergency(now, queue_s)
        else:
            self._high_since_s = None
        if mode is not STEADY:
            self._sooner.hold(now, self._rtt_s or 0.0)
        elif 2 * nbytes >= self._fragment:
            self._look_for_faster_link(now, queue_s)
        if self._follows:
            self._look_for_swings(sample, queue_s)
        if queue_s <= high_s or sample.app_limited or mode.competing:
            self._slowdown.not_full()
        else:
            self._look_for_slower_link(sample)
        # Half a window and no queue: it was not the path that held us back, but our own pacing or a busy processor.
        limited = sample.app_limited or (queue_s <= high_s and 2 * sample.inflight_bytes < self._window)
        measured = rate.measure(receiver_s, cum_bytes, app_limited=limited, rtt_s=self._rtt_s or 0.0)
        if measured is not None:
            self._note_rate(now, *measured)
        if self._epoch_s is None:
            self._epoch_s = now
        elif (
            now >= self._epoch_s + max(self._params.min_epoch_s, self._rtt_s or 0.0)
            and len(self._samples) >= self._params.min_epoch_samples
        ):
            self._close_epoch(now)

    def _look_for_swings(self, sample: AckSample, queue_s: float) -> None:
        """A link is full while every packet meets another one, and waits longer than jitter makes it."""
        mode = self._mode
        jitter_s = 0.0 if mode.varying else self._view.jitter_s
        tells = not (sample.app_limited or mode.starting or mode.draining or mode.competing)
        if tells and queue_s >= jitter_s + self._params.fast_s:
            rate = self._rate.arrived.rate()
            met = rate is not None and queue_s >= jitter_s + self._fragment / rate
            if met and not self._drain.lately(sample.now, self._rtt_s or 0.0):
                self._variability.queued(sample.now, sample.receiver_s, sample.cum_bytes, jitter_s)
                return
        self._variability.passed()

    def _follow(self, sample: AckSample, queue_s: float) -> None:
        """One acknowledgement of a link whose rate swings."""
        window = self._variable.steer(self._window, queue_s, sample, rtt_s=self._rtt_s or 0.0, fragment=self._fragment)
        self._window = min(max(window, self._least_window), self._params.max_window_bytes)
        self._set_pace()

    def _vary(self, now: float, queue_s: float, rtt_s: float) -> None:
        """An epoch of a link whose rate swings is over."""
        if self._variable.close_epoch(now, queue_s, high_s=self._view.high_s, rtt_s=rtt_s):
            self._variability.forget()  # it was a rival who took more or less of the link
        if not self._variability.swings(now):
            self._happens(Event.SETTLED)

    def on_loss(self, *, now: float, nbytes: int) -> None:
        self._losses.lost(now, nbytes)
        cubic = self._rival.cubic
        if cubic is None or self._mode.draining:
            return
        if now >= cubic.cut_s + (self._rtt_s or 0.0) + self._view.queue_s:
            self._window = max(cubic.cut(now, self._window, self._fragment), self._least_window)

    def on_reset(self, *, now: float) -> None:
        self._begin()

    def on_stall(self, *, now: float) -> None:
        self._rate.stalled()
        self._restart()
        self._growth.restart(now)
        self._window = max(min(self._window, self._initial_bytes), self._least_window)
        self._start_again(now)
        self._silent = True

    def _answers_again(self, now: float) -> None:
        """A silence is over. What left in it was lost, or comes in a trickle that is no train."""
        self._restart()
        self._resumed_s = now
        self._start.begin_round(now, self._window, self._pace.value, resumed=True)

    # --- the rate -------------------------------------------------------------------------------------------------

    def _note_rate(self, now: float, rate: float, span_limited: bool) -> None:
        rtt_s = self._rtt_s or 0.0
        # What was sent while draining or with nothing more to send only shows a lower bound.
        bound = span_limited or self._mode.draining or self._drain.lately(now, rtt_s)
        self._rate.saturated = self._rate.saturated or not bound
        if self._follows:
            self._variability.at_least(now, rate)
        paced = self._pace.capped and self._view.queue_s <= self._view.target_s
        if rate > (self._rate.value or 0.0) or not (bound or paced):
            self._rate.note(now, rate, rtt_s)

    def _look_for_faster_link(self, now: float, queue_s: float) -> None:
        """Go at once to what the packets say that the link carries; start-up finds how much more it is."""
        if self._window <= SOONER_ROOM * self._fragment:
            return  # a round trip holds so few packets that a window of so many more would be a queue
        times = self._sooner.times(now, -queue_s, self._view)
        if times > 1.0:
            self._growth.got_quicker(now)
            self._window *= times
            self._start_again(now)

    def _look_for_slower_link(self, sample: AckSample) -> None:
        """While a queue stays the link is never idle: what arrives is all it can do, whatever was seen before."""
        rate = self._slowdown.arrives(sample.receiver_s, sample.cum_bytes)
        known = self._rate.value
        if rate is not None and known is not None and 0.0 < rate < self._params.slower * known:
            # The link got slower, or somebody else has his share of it.
            self._forget_rate(sample.now, rate)
            self._rate.skip_span()
            product = rate * (self._rtt_s or 0.0)
            self._drain.saved_window = min(self._drain.saved_window, product + self._fragment)

    def _forget_rate(self, now: float, rate: float) -> None:
        if self._slowdown.began(self._rate, rate):
            self._growth.got_slower(now)
        self._rate.replace(now, rate, self._rtt_s or 0.0)

    def _emptied_slower(self, now: float) -> None:
        """The queue went as we made way, so it was ours, and the link is slower: what a packet takes on it is none."""
        faster, rate = self._slowdown.faster_rate or self._rate.peak, self._rate.value
        self._slowdown.forget()
        if not faster or rate is None or rate >= faster:
            return
        self._rate.peak = rate
        self._delay.keep_least(now)
        # The fragments of a stream get shorter with its rate.
        fragment = min(self._fragment, max(self._longest, self._first_fragment_bytes))
        self._delay.longer_packets(fragment / rate - self._fragment / faster)
        self._fragment = fragment

    def _emergency(self, now: float, queue_s: float) -> None:
        """The queue is far too long: the link got slower."""
        rtt_s = self._rtt_s
        rate = self._rate.arrived.rate()
        if rtt_s is None or rate is None:
            return
        self._forget_rate(now, rate)
        self._rate.skip_span()
        self._window = min(self._window, max(self._params.emergency_cut * rate * rtt_s, self._least_window))
        self._hold_until_s = now + max(0.1, rtt_s + queue_s)
        self._high_since_s = None
        self._growth.empty_epochs = 0
        self._set_pace()

    # --- start-up -------------------------------------------------------------------------------------------------

    def _start_again(self, now: float) -> None:
        self._happens(Event.RESTART)
        self._rival.cubic = None
        self._set_pace()
        self._start.begin_round(now, self._window, self._pace.value)

    def _ramp(self, now: float, receiver_s: float, cum_bytes: int, acked_bytes: int, sent_s: float | None) -> None:
        """One acknowledgement of start-up."""
        rtt_s = self._rtt_s or self._params.min_epoch_s
        ramp = self._start.ramp(
            receiver_s, cum_bytes, acked_bytes, sent_s, window=self._window, rtt_s=rtt_s, fragment=self._fragment
        )
        if ramp is None:
            return
        if ramp.round_over:
            self._window = ramp.window
            self._rate.peak = max(self._rate.peak, min(self._start.rate, self._window / rtt_s))
            self._set_pace()
        if ramp.filled:
            self._end_startup(ramp.window)
        else:
            self._start.begin_round(now, self._window, self._pace.value)

    def _end_startup(self, window: float) -> None:
        self._happens(Event.FILLED)
        self._window = max(window, self._least_window)
        self._hold_until_s = -inf
        self._growth.empty_epochs = 0
        self._set_pace()

    # --- once an epoch --------------------------------------------------------------------------------------------

    def _close_epoch(self, now: float) -> None:
        params, drain, rival, losses, view = self._params, self._drain, self._rival, self._losses, self._view
        interval_s = drain.interval_s(self._rtt_s or 0.0)
        rtt_s = self._see_epoch(now, interval_s)
        queue_s = view.queue_s
        rival.note(queue_s)
        if (self._slowdown.faster_rate is not None and not view.long) or self._slowdown.went(
            queue_s, self._window, 2 * self._fragment, self._rate, self._rtt_s
        ):
            self._emptied_slower(now)
        elif not view.long:
            self._slowdown.most_queue_s = None
        if drain.judging and not self._mode.draining:
            drain.judging = False
            self._judge(now, queue_s, rtt_s)
        if queue_s < 0.25 * view.target_s or self._growth.room.steps:
            drain.emptied_s = now
        limited = 2 * self._limited >= len(self._samples)
        lost = losses.share
        if not self._growth.room.trying:  # what a larger window loses is not usual
            losses.learn(lost)
        if self._mode.draining:
            if now >= drain.until_s:
                self._window = drain.saved_window
                drain.end(now)
                self._happens(Event.MADE_WAY)
        elif self._mode.starting:
            # What left before a silence was over is known to be lost within two round trips.
            told = (self._epoch_s or now) >= self._resumed_s + 2 * rtt_s
            if limited and (queue_s > view.high_s / 2 or (told and lost > 0.2)):
                rate = self._rate.arrived.rate()
                self._end_startup(min(self._window, rate * rtt_s) if rate else self._window / 2)
        elif self._mode.varying:
            self._vary(now, queue_s, rtt_s)
        elif limited:
            if rival.cubic is not None:
                self._growth.room.clear()
                window = min(rival.cubic.window(now, rtt_s + queue_s, self._fragment), params.max_window_bytes)
                most = 1.5 * self._window if queue_s < params.compete_queue_s else self._window
                self._window = min(max(window, self._least_window), most)
            else:
                self._steer(now, queue_s, rtt_s, lost)
            stuck = (
                rival.cubic is None
                and rival.stuck(now, queue_s, self._window, self._fragment, self._rate.peak)
                and not self._own(queue_s)
            )
            if stuck and now < rival.until_s:
                self._compete(now, rtt_s + queue_s)
            elif self._mode is STEADY and now >= rival.until_s and self._variability.swings(now):
                self._happens(Event.SWINGS)
                self._variable.restart()
            elif drain.due(now, interval_s, stuck=stuck):
                self._make_way(now, rtt_s)
        self._set_pace()
        self._samples.clear()
        self._limited = self._longest = 0
        losses.next_epoch()
        self._epoch_s = now

    def _see_epoch(self, now: float, interval_s: float) -> float:
        """What the delays of the epoch say of path and queue. Returns the round trip of the empty path."""
        params, delay, view = self._params, self._delay, self._view
        queues = sorted([queue_s for queue_s, _ in self._samples])
        backs = sorted([back_s for _, back_s in self._samples])
        count = len(queues)
        early_s = -queues[count // 5]
        if self._rival.cubic is None:
            window_s = max(params.base_window_s, 2.2 * interval_s)
            if self._mode.varying:  # the queue that is kept must not become the empty path
                window_s = max(window_s, 2 * params.variable_memory_s)
        else:
            window_s = params.compete_max_s + params.base_window_s
        delay.close_epoch(now, window_s)
        if early_s > view.high_s and now < self._rival.adopted_until_s:
            self._rival.remember(now)  # the short way is back: it was a queue
        if delay.got_quicker(view.serialise_s):
            self._growth.got_quicker(now)
        delay.came_early(early_s)
        rtt_s = self._rtt_s = max(1e-5, delay.empty_s + backs[count // 2])
        self._rate.decay(now - (self._epoch_s or now))
        view.close_epoch(queues, rtt_s, self._rate, self._fragment, usual=self._fragment <= self._first_fragment_bytes)
        return rtt_s

    @property
    def _least_window(self) -> float:
        return self._params.min_window_fragments * self._fragment

    def _steer(self, now: float, queue_s: float, rtt_s: float, lost: float) -> None:
        params, view, rival = self._params, self._view, self._rival
        rate = self._rate.value
        if rate is None:
            return
        window = self._window
        if queue_s > view.high_s:
            self._growth.stop()
            rival.above_epochs += 1
            if now >= self._hold_until_s:
                recent = self._rate.arrived.rate() or rate
                if rival.above_epochs >= 2 and self._slowdown.faster_rate is None:
                    self._forget_rate(now, recent)
                window = min(window, params.cut * min(recent, rate) * rtt_s + self._fragment)
                self._hold_until_s = now + rtt_s
        else:
            rival.above_epochs = 0
            alone, capped = now >= rival.until_s, self._pace.capped
            if alone:
                rival.calm_window = window
            window = self._growth.steer(
                now, window, rtt_s, rate, lost=lost, fragment=self._fragment, capped=capped, alone=alone
            )
        self._window = min(max(window, self._least_window), params.max_window_bytes)

    def _set_pace(self) -> None:
        if self._mode.starting:
            self._pace.start(self._window, self._initial_bytes, self._rtt_s)
        elif self._mode.competing:
            self._pace.compete(self._window, self._rtt_s)
        elif self._mode.varying:
            self._pace.vary(self._window, self._rtt_s)
        else:
            probing = None if self._growth.room.trying else self._growth.probing
            self._pace.steer(self._window, self._rtt_s, self._rate, self._view, self._losses.usual, probing)

    # --- somebody else --------------------------------------------------------------------------------------------

    def _make_way(self, now: float, rtt_s: float) -> None:
        rate = self._rate.value
        if rate is None:
            return
        self._growth.room.clear()
        window = self._window
        self._window = max(min(window, self._params.drain_gain * rate * rtt_s), self._least_window)
        behind = self._mode.competing or self._rival.above_epochs
        wait_s = rtt_s + self._view.queue_s if behind else rtt_s
        self._drain.begin(now, window, self._window, wait_s, rate)
        self._happens(Event.MAKE_WAY)

    def _judge(self, now: float, queue_s: float, rtt_s: float) -> None:
        """We made way for a round trip: whose is the queue?"""
        params, rival = self._params, self._rival
        cubic = rival.cubic
        if queue_s <= self._view.high_s:
            if cubic is not None:
                self._happens(Event.RIVAL_GONE)
                rival.cubic = None
                rival.calm_window = self._window
                # A rival that has just cut its window leaves a short queue; one of our own goes to the last packet.
                emptied = queue_s <= params.fast_s + self._view.serialise_s
                if self._follows and emptied and rival.went_again(now):
                    rival.forget()  # none comes and goes as we make way: the link fades
                    self._variability.faded(now)
                else:
                    rival.remember(now)
                self._window = min(self._window, (self._rate.value or 0.0) * rtt_s + self._fragment)
        elif cubic is not None:
            if now > cubic.began_s + params.compete_max_s:
                self._new_path(now, queue_s)
        elif rival.above_epochs >= params.stuck_epochs and not self._own(queue_s):
            quiet = now > max(rival.until_s, self._losses.at_s + params.loss_memory_s)
            if quiet and rival.flat(queue_s):
                self._new_path(now, queue_s)
            else:
                self._compete(now, rtt_s + queue_s)

    def _own(self, queue_s: float) -> bool:
        """Whether all that queues may be ours: class 0, which passes the window, what left before the window was cut,
        or the least that we have under way on a thin link."""
        room = 2 * self._fragment
        return self._inflight > self._window + room or (
            self._window <= room and queue_s * self._rate.peak < self._window + room
        )

    def _compete(self, now: float, rtt_s: float) -> None:
        self._happens(Event.RIVAL)
        self._slowdown.forget()
        window = max(self._window, self._rival.calm_window, (self._rate.arrived.rate() or 0.0) * rtt_s)
        window = min(window, self._params.max_window_bytes)
        self._rival.cubic = Cubic(now, window, self._fragment)
        self._window = window
        self._rival.above_epochs = 0

    def _new_path(self, now: float, queue_s: float) -> None:
        """What looked like a queue is a longer way."""
        params, rate = self._params, self._rate
        self._delay.longer_path(now, queue_s)
        far = self._rtt_s is not None and queue_s > params.went_rtts * self._rtt_s
        if self._rtt_s is not None:
            self._rtt_s += queue_s
        if far and rate.value is not None and rate.value < params.went_slower * rate.peak:
            rate.peak = rate.value  # what packets take on a link so much slower is what made it longer
            self._fragment = min(self._fragment, max(self._longest, self._first_fragment_bytes))
            self._slowdown.most_queue_s = None
        self._view.queue_s = 0.0
        self._rival.above_epochs = 0
        self._rival.adopted_until_s = now + params.rival_memory_s
        self._start_again(now)
