"""How the window follows the queue where nobody else keeps one: the step of an epoch, and the search for room."""

from math import inf

from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.path_delay import PathDelay
from sern_core.path.congestion.queue_view import QueueView
from sern_core.path.congestion.room import Room


class Growth:
    """What is known of room for more. `capped`, of its methods: the pace keeps below the capacity."""

    __slots__ = ("_changed_s", "_delay", "_losses", "_params", "_view", "empty_epochs", "room")

    def __init__(self, params: HybridParams, view: QueueView, delay: PathDelay, losses: Losses) -> None:
        self._params = params
        self._view = view
        self._delay = delay
        self._losses = losses
        self.restart(-inf)

    def restart(self, now: float) -> None:
        """What was seen says nothing about what will be; the link may be another since `now`."""
        self.room = Room()
        self.empty_epochs = 0
        """Epochs in a row in which the path was clearly empty."""
        self._changed_s = now

    def got_slower(self, now: float) -> None:
        self.room = Room()
        self._changed_s = now

    def got_quicker(self, now: float) -> None:
        self._changed_s = now
        self.room.hurry()

    def stop(self) -> None:
        """There is none."""
        self.room.clear()
        self.empty_epochs = 0

    @property
    def probing(self) -> float:
        """Times the capacity that an empty path is tried with."""
        pacing = self._params.gentle_pacing
        return pacing[min(self.empty_epochs, len(pacing) - 1)]

    def steer(
        self,
        now: float,
        window: float,
        rtt_s: float,
        rate: float,
        *,
        lost: float,
        fragment: float,
        capped: bool,
        alone: bool,
        segmented: bool = False,
    ) -> float:
        """The window after an epoch whose queue was not too long. `lost`: share that was lost in it; `alone`: no rival
        was seen lately; `segmented`: packets are of many segments each, and come with the last of them."""
        queue_s = self._view.queue_s
        if alone:
            queue_s = self._without_jitter(
                now, window, queue_s, rate, self._losses.unusual(lost, fragment), capped=capped, segmented=segmented
            )
        else:
            self.room.clear()
        back_bytes, self.room.back_bytes = self.room.back_bytes, None
        if back_bytes is not None and back_bytes < window:
            queue_s = max(0.0, queue_s - (window - back_bytes) / rate)
            window = back_bytes
        return self._step(window, queue_s, rtt_s, rate, fragment, capped=capped)

    def _step(
        self, window: float, queue_s: float, rtt_s: float, rate: float, fragment: float, *, capped: bool
    ) -> float:
        """The window that makes the queue what it is to be."""
        params, view, room = self._params, self._view, self.room
        target_s = view.target_s
        step = params.gain * rate * max(target_s - queue_s, -queue_s)
        if queue_s >= 0.25 * target_s:
            self.empty_epochs = 0
        elif view.most_s <= view.clear_s:
            # Clearly empty: hardly a packet met another one. Otherwise a little more will do.
            self.empty_epochs += 1
            patient = params.patient_epochs
            if self.empty_epochs > patient:
                step = max(step, params.first_growth * window) * 2 ** min(self.empty_epochs - patient - 1, 8)
        if room.trying:
            step = max(step, room.step(window))
        if step <= 0:
            return min(window, 1.1 * rate * (rtt_s + queue_s) + 4 * fragment) + step
        gain = params.room_gain if room.steps and not self.empty_epochs else 1.4
        most = gain * rate * (rtt_s + target_s) + 3 * fragment
        if capped and view.gentle and not room.trying:
            # It does not bind, so it would run away.
            most = self.probing * rate / (1 - self._losses.usual) * (rtt_s + target_s) + fragment
        return max(window, min(window + min(step, params.max_growth * window), most))

    def _without_jitter(
        self, now: float, window: float, queue_s: float, rate: float, unusual: float, *, capped: bool, segmented: bool
    ) -> float:
        """The queue without what jitter holds packets back. In order they wait for those before them, the longer the
        closer they follow each other: that is in no delay of slower times, and is no queue. `unusual`: share that was
        lost and is not usually."""
        room, view, delay, params = self.room, self._view, self._delay, self._params
        jitters = segmented or (view.jittery and not view.calm)
        tries = jitters or now < self._changed_s + params.base_window_s
        if not (tries or room.trying):
            room.clear()
            return queue_s
        has_room = room.note(
            now,
            window,
            queue_s,
            rate=rate,
            spread_s=max(view.jitter_s, view.serialise_s),
            lost=unusual,
            binds=not capped,
            tries=tries,
            patient=view.calm,
        )
        if room.back_bytes is not None and unusual > 0.0:
            # The path drops what it cannot keep, so what was taken for jitter is all it keeps.
            queue_s += delay.held_s
            delay.held_s = 0.0
            room.clear()
        if not has_room or not jitters:
            return queue_s
        most_s = params.segmented_spreads * view.jitter_s if segmented else params.held_spreads * view.least_spread_s
        held_s = min(room.queue_s - view.target_s / 2, most_s - delay.held_s)
        if held_s <= 0.0:
            return queue_s
        delay.held_s += held_s
        room.shift(held_s)
        return max(0.0, queue_s - held_s)
