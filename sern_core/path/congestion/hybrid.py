"""Window, pacing and capacity from forward delay and from the rate timed at the receiver.

Theory of operation
    *Delay.* What queues on the way out shows in the forward delay d = receiver's stamp − our stamp (the clocks' offset
    is in every d alike, as in LEDBAT, RFC 6817): an acknowledgement that waits on a busy way back is no queue of ours.
    Small and large packets are told apart, for a large one takes longer to serialise. Once an *epoch* (a round trip,
    at least 40 ms) the 20th percentile is compared with its least value of the last ten seconds: the queue q.
    *Rate.* Bytes received between two stamps of the receiver, over a round trip and at least 120 ms; the capacity B is
    the greatest of the recent ones while there was more to send. While q stays above `hi` the link is never idle, so
    that what arrives in 120 ms is all it can do now: a link that got slower is known by then, a faster one by growth.
    Where a burst now and again leaves the link idle in between, B is what came while one arrived, and the pace is a
    quarter above it: bursts would show our own pace else. What little was offered without a burst is no B.
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
    window goes there in steps of at most `startup_gain`. Packets that jitter spreads come in clumps and not evenly:
    where they do, the window doubles instead, and is full when packets take longer for two rounds. Bursts too short for
    a train end it where they show the rate.
    *Swings.* A link whose rate goes up and down all the time (cellular) is followed acknowledgement by acknowledgement,
    with a queue that shows what it can do now (`variable`), until it keeps a rate again.
    *Draining.* When no empty queue was seen for a while, one round trip at 0.6 of the product shows it. A queue that
    stays although we made way is either a longer path (constant: taken as the new empty path) or somebody else's:
    then the window follows CUBIC (RFC 9438) until a drain finds the queue gone.
    *Silence* (`on_stall`) ends with the first acknowledgement: what was sent into it says nothing of the path, so
    start-up begins there once more.
    *Order.* A packet that overtook others, sooner than any could come, had a way of its own: it says nothing of q.
    *Loss* alone changes nothing (radio): it counts only against a rival, and when a fifth is lost in start-up.
"""

from math import inf
from typing import Final

from sern_core.path.capacity import AckSample, CapacityEstimator, Receiver
from sern_core.path.congestion.backoff import Backoff
from sern_core.path.congestion.contention import Contention, Verdict
from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.link_rate import BURSTS
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.mode import STARTUP, STEADY, TRANSITIONS, Event
from sern_core.path.congestion.pace import Pace
from sern_core.path.congestion.params import DEFAULT_HYBRID, HybridParams
from sern_core.path.congestion.path_model import PathModel, Seen
from sern_core.path.congestion.sooner import Sooner
from sern_core.path.congestion.start_up import StartUp
from sern_core.path.congestion.swings import Swings
from sern_core.path.congestion.unqueued import Unqueued

SOONER_ROOM: Final = 4
"""Packets."""
SLOW_START_RTTS: Final = 1.5
"""A stream that begins has half of the first window wait in TCP until the other half has arrived."""
TAKE_UP_S: Final = 0.25
"""TCP that was idle begins with few segments, and takes some round trips to carry what the link does (slow start,
RFC 5681): what waits in it meanwhile is no queue of the path."""


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
        path = self._path = PathModel(params, self._first_fragment_bytes)
        self._rate, self._view = path.rate, path.view
        self._losses = Losses(params)
        self._growth = Growth(params, path.view, path.delay, self._losses)
        self._backoff = Backoff(params, path, self._growth)
        self._pace = Pace(params, path, self._growth, self._losses, self._initial_bytes)
        self._start = StartUp(params)
        contention = self._contention = Contention(params, path, self._losses)
        self._rival, self._drain = contention.rival, contention.drain
        self._sooner = Sooner(params)
        self._unqueued = Unqueued()
        self._swings = Swings(params, path, contention.drain)
        self._resumed_s = -inf  # when the first acknowledgement after a silence came
        self._restart()
        self._start.begin(-inf, self._window, None)

    def _restart(self) -> None:
        """What was under way says nothing about what will be."""
        self._silent = False
        self._inflight = 0
        self._path.restart()
        self._losses.next_epoch()
        self._contention.restart()
        self._sooner.restart()
        self._growth.restart(-inf)
        self._backoff.restart()
        self._swings.measure_anew()
        self._busy_s: float | None = None

    def _happens(self, event: Event) -> None:
        self._mode = TRANSITIONS[event][self._mode]

    # --- what it says ---------------------------------------------------------------------------------------------

    @property
    def window_bytes(self) -> float:
        return self._window + self._path.fragment if self._pace.capped and self._view.gentle else self._window

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
    def queues(self) -> bool:
        return self._view.queue_s > self._view.high_s

    @property
    def unqueued_bytes(self) -> float:
        """The window itself while that finds out what the link carries, or shares the link with somebody else."""
        rtt_s, rate = self._path.rtt_s, self._rate.value
        if self._mode is not STEADY or rate is None or rtt_s is None or not self._rate.saturated:
            return self.window_bytes
        return min(self.window_bytes, rate * rtt_s + self._unqueued.fragments * self._path.fragment)

    @property
    def eased_s(self) -> float:
        return self._path.eased.at_s

    @property
    def rtprop_s(self) -> float | None:
        return self._path.rtt_s

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
        path = self._path
        if nbytes > path.longest:
            path.longest = nbytes
            if nbytes > path.fragment:
                path.larger_packet(nbytes)
        if 2 * inflight_bytes >= self._window or self._busy_s is None:
            self._busy_s = now
        elif now > self._busy_s + self._params.idle_s:
            self._busy_s = now
            if self._window > self._initial_bytes:
                self._window = max(self._window / 2, self._initial_bytes)
                self._start_again(now)

    def on_ack(self, sample: AckSample) -> None:
        now, receiver_s, cum_bytes = sample.now, sample.receiver_s, sample.cum_bytes
        path = self._path
        if self._silent:
            self._answers_again(now)
        if self._receiver.went_back(receiver_s, cum_bytes):
            self._measure_anew()
        queue_s = path.note(sample)
        app_limited = sample.app_limited
        if not app_limited:
            self._busy_s = now  # the pacer may hold back what the window would let go
        self._losses.acked_bytes += sample.acked_bytes
        self._inflight = sample.inflight_bytes
        mode, high_s = self._mode, self._view.high_s
        if mode.starting:
            self._ramp(sample)
        elif mode.varying:
            self._follow(sample, queue_s)
        elif queue_s > 3 * high_s and not (mode.competing or mode.draining):
            if self._backoff.urgent(now, receiver_s):
                self._cut_at_once(now, queue_s)
        else:
            self._backoff.far_since_s = None
        if mode.draining and not mode.competing:
            self._sooner.makes_way(now, path.rtt_s or 0.0)
        elif mode is not STEADY:
            self._sooner.hold(now, path.rtt_s or 0.0)
        elif 2 * sample.packet_bytes >= path.fragment:
            self._look_for_faster_link(now, queue_s)
        if self._follows:
            self._swings.note(sample, queue_s, self._mode)
        if queue_s <= high_s or app_limited or mode.competing:
            path.slowdown.not_full()
        else:
            self._look_for_slower_link(sample)
        # Half a window and no queue: it was not the path that held us back, but our own pacing or a busy processor.
        held = queue_s <= high_s and 2 * sample.inflight_bytes < self._window
        rtt_s = path.rtt_s or 0.0
        if (mode is STEADY or mode.starting) and (app_limited or self._rate.burst is None):  # it begins or ends
            spread_s = self._view.jitter_s
            self._rate.note_burst(now, receiver_s, cum_bytes, app_limited=app_limited, spread_s=spread_s, rtt_s=rtt_s)
            if self._mode.starting and self._rate.bursts >= BURSTS and not self._start.rate:
                self._end_startup(self._window)  # they are too short for a train
        measured = self._rate.measure(receiver_s, cum_bytes, app_limited=app_limited, held=held, rtt_s=rtt_s)
        if measured is not None:
            self._note_rate(now, *measured)
        if path.epoch_s is None:
            path.epoch_s = now
        elif path.epoch_over(now):
            self._close_epoch(now)

    def _measure_anew(self) -> None:
        """What the receiver says cannot be compared with what it has said."""
        self._rate.measure_anew()
        self._swings.measure_anew()
        self._path.slowdown.not_full()
        self._backoff.far_since_s = None
        self._start.measure_anew()

    def _follow(self, sample: AckSample, queue_s: float) -> None:
        """One acknowledgement of a link whose rate swings."""
        window = self._swings.steer(self._window, queue_s, sample)
        self._window = min(max(window, self._least_window), self._params.max_window_bytes)
        self._pace.set(self._mode, self._window)

    def on_loss(self, *, now: float, nbytes: int) -> None:
        self._losses.lost(now, nbytes)
        cubic = self._rival.cubic
        if cubic is None or self._mode.draining:
            return
        if now >= cubic.cut_s + (self._path.rtt_s or 0.0) + self._view.queue_s:
            self._window = max(cubic.cut(now, self._window, self._path.fragment), self._least_window)

    def on_reset(self, *, now: float) -> None:
        self._begin()

    def goes_on_from(self, other: CapacityEstimator, *, now: float) -> None:
        """Only where that was steady, and this has not found somebody else or a swinging link by itself."""
        if not isinstance(other, HybridWindow) or other._mode is not STEADY or not other._rate.shown:
            return
        if self._mode is STARTUP:
            self._happens(Event.FILLED)
        elif self._mode is not STEADY:
            return
        self._window = max(self._window, other._window)
        self._rate.adopt(other._rate, now, self._path.rtt_s or 0.0)
        self._growth.restart(now)
        self._backoff.hold_until_s = now + TAKE_UP_S
        self._busy_s = now
        self._pace.set(self._mode, self._window)

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
        self._start.begin(now, self._window, self._pace.value, resumed=True, may_jitter=self._view.may_jitter)

    # --- the rate -------------------------------------------------------------------------------------------------

    def _note_rate(self, now: float, rate: float, span_limited: bool) -> None:
        rtt_s = self._path.rtt_s or 0.0
        # What was sent while draining or with nothing more to send only shows a lower bound.
        bound = span_limited or self._mode.draining or self._drain.lately(now, rtt_s)
        if not bound:
            self._rate.saturate()
        if self._follows:
            self._swings.at_least(now, rate)
        paced = self._pace.capped and self._view.queue_s <= self._view.target_s
        if rate > (self._rate.value or 0.0) or not (bound or paced):
            self._rate.note(now, rate, rtt_s)

    def _look_for_faster_link(self, now: float, queue_s: float) -> None:
        """Go at once to what the packets say that the link carries; start-up finds how much more it is."""
        if self._window <= SOONER_ROOM * self._path.fragment:
            return  # a round trip holds so few packets that a window of so many more would be a queue
        times = self._sooner.times(now, -queue_s, self._view)
        if times > 1.0:
            self._growth.got_quicker(now)
            self._window *= times
            self._start_again(now)

    def _look_for_slower_link(self, sample: AckSample) -> None:
        rate = self._backoff.look_for_slower_link(sample)
        if rate is not None:
            product = rate * (self._path.rtt_s or 0.0)
            self._drain.saved_window = min(self._drain.saved_window, product + self._path.fragment)

    def _cut_at_once(self, now: float, queue_s: float) -> None:
        window = self._backoff.cut_at_once(now, self._window, self._least_window, queue_s)
        if window is not None:
            self._window = window
            self._pace.set(self._mode, self._window)

    # --- start-up -------------------------------------------------------------------------------------------------

    def _start_again(self, now: float) -> None:
        self._happens(Event.RESTART)
        self._rival.cubic = None
        self._pace.set(self._mode, self._window)
        self._start.begin(now, self._window, self._pace.value, may_jitter=self._view.may_jitter)

    def _ramp(self, sample: AckSample) -> None:
        """One acknowledgement of start-up."""
        path, start, now = self._path, self._start, sample.now
        if path.rtt_s is None or (sample.rtt_s < path.rtt_s and not sample.overtook):
            path.rtt_s = sample.rtt_s
        left_s = now - sample.rtt_s if sample.sent_s is None else sample.sent_s
        if sample.app_limited:
            start.nothing_more(left_s)
            return
        if left_s < start.since_s:
            return
        rtt_s = path.rtt_s or self._params.min_epoch_s
        ramp = start.ramp(sample, left_s, window=self._window, rtt_s=rtt_s, fragment=path.fragment)
        if ramp is None:
            return
        if ramp.round_over:
            self._window = ramp.window
            self._rate.peak = max(self._rate.peak, min(start.rate, self._window / rtt_s))
            self._pace.set(self._mode, self._window)
        if ramp.filled:
            if start.jittery:
                self._growth.room.hurry()  # the window may well be short of what there is
                self._view.learn()
            self._end_startup(ramp.window)
        else:
            start.begin_round(now, self._window, self._pace.value)

    def _end_startup(self, window: float) -> None:
        self._happens(Event.FILLED)
        self._window = max(window, self._least_window)
        self._backoff.hold_until_s = -inf
        self._growth.empty_epochs = 0
        self._pace.set(self._mode, self._window)

    # --- once an epoch --------------------------------------------------------------------------------------------

    def _close_epoch(self, now: float) -> None:
        drain, rival, losses = self._drain, self._rival, self._losses
        interval_s = drain.interval_s(self._path.rtt_s or 0.0)
        memory_s = self._contention.memory_s(interval_s, varying=self._mode.varying)
        seen = self._path.close_epoch(now, memory_s, self._window, steered=not self._mode.starting)
        if seen.early and now < rival.adopted_until_s:
            rival.remember(now)  # the short way is back: it was a queue
        if seen.quicker:
            self._growth.got_quicker(now)
        rival.note(seen.queue_s)
        if drain.judging and not self._mode.draining:
            drain.judging = False
            self._judge(now, seen)
        if seen.queue_s < 0.25 * self._view.target_s or self._growth.room.steps:
            drain.emptied_s = now
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
            told = (self._path.epoch_s or now) >= self._resumed_s + 2 * seen.rtt_s
            # Packets that jitter holds up have not queued.
            long_s = self._view.high_s * (3.0 if self._start.jittery else 0.5)
            if not self._start.rounds:
                long_s = max(long_s, SLOW_START_RTTS * seen.rtt_s)
            queued = seen.queue_s > long_s and self._start.rate > 0.0
            if seen.limited and (queued or (told and self._start.loses(losses.unusual(lost, self._path.fragment)))):
                # What came lately may have been little, since there was little to send.
                rate = max(self._rate.arrived.rate() or 0.0, self._start.rate)
                self._end_startup(min(self._window, rate * seen.rtt_s) if rate else self._window / 2)
        elif self._mode.varying:
            if not self._swings.close_epoch(now, seen):
                self._happens(Event.SETTLED)
        elif seen.limited:
            self._steer(now, seen, lost, interval_s)
        self._unqueued.close_epoch(self._view)
        self._pace.set(self._mode, self._window)
        self._path.begin_epoch(now)
        losses.next_epoch()

    def _steer(self, now: float, seen: Seen, lost: float, interval_s: float) -> None:
        """The window of an epoch in which it bound, and whose the queue is."""
        cubic = self._rival.cubic
        if cubic is not None:
            self._growth.room.clear()
            self._window = self._contention.competing_window(cubic, now, self._window, self._least_window, seen)
        else:
            self._follow_queue(now, seen, lost)
        stuck = self._contention.stuck(now, self._window, self._inflight)
        if stuck and now < self._rival.until_s:
            self._compete(now, seen)
        elif self._mode is STEADY and now >= self._rival.until_s and self._swings.seen(now):
            self._happens(Event.SWINGS)
            self._swings.begin()
        elif self._drain.due(now, interval_s, stuck=stuck):
            self._make_way(now)

    @property
    def _least_window(self) -> float:
        return self._params.min_window_fragments * self._path.fragment

    def _follow_queue(self, now: float, seen: Seen, lost: float) -> None:
        params, path, rival = self._params, self._path, self._rival
        rate = self._rate.value
        if rate is None or not self._rate.shown:
            return
        window = self._window
        if seen.queue_s > self._view.high_s:
            rival.above_epochs += 1
            window = self._backoff.cut(now, window, rate, seen.rtt_s, epochs=rival.above_epochs)
        else:
            rival.above_epochs = 0
            alone, capped = now >= rival.until_s, self._pace.capped
            if alone:
                rival.calm_window = window
            window = self._growth.steer(
                now, window, seen.rtt_s, rate,
                lost=lost, fragment=path.fragment, capped=capped, alone=alone, segmented=path.segmented,
            )  # fmt: skip
        self._window = min(max(window, self._least_window), params.max_window_bytes)

    # --- somebody else --------------------------------------------------------------------------------------------

    def _make_way(self, now: float) -> None:
        competing = self._mode.competing
        window = self._contention.make_way(now, self._window, self._least_window, competing=competing)
        if window is not None:
            self._growth.room.clear()
            self._window = window
            self._happens(Event.MAKE_WAY)

    def _judge(self, now: float, seen: Seen) -> None:
        """We made way for a round trip: whose is the queue?"""
        verdict = self._contention.judge(now, self._window, self._inflight)
        if verdict is Verdict.RIVAL:
            self._compete(now, seen)
        elif verdict is Verdict.LONGER_PATH:
            self._contention.longer_path(now, seen.queue_s)
            self._start_again(now)
        elif verdict is not None:
            self._happens(Event.RIVAL_GONE)
            if verdict is Verdict.FADED:
                self._swings.faded(now)
            self._window = min(self._window, (self._rate.value or 0.0) * seen.rtt_s + self._path.fragment)

    def _compete(self, now: float, seen: Seen) -> None:
        self._happens(Event.RIVAL)
        self._window = self._contention.compete(now, self._window, seen)
