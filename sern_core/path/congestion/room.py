"""Whether a path has room for more, where jitter hides whether it is empty.

The delay of a few packets says nothing when each of them may come some milliseconds sooner or later. But on a full path
every byte that the window gains goes into the queue, and on a path with room none does. So the window is followed: when
it has changed by so much that a full path's queue would have changed by more than jitter does, the queue tells which it
is. The window changes by itself while it is steered; when nothing has told for long it is made a little larger. A path
that keeps less than that has no queue to tell by and drops it: what is lost counts like what queues. Where the path was
full the window goes back to what it was.
"""

from collections import deque
from math import inf
from typing import Final

EPOCHS: Final = 3
"""What a window does to the queue is seen an epoch or two later: a change counts when so many epochs have had it."""
SHARE: Final = 0.5
"""Share of the queue that a full path would have. Half way between none and all is told most surely."""
SHRANK: Final = 2.0
"""Spreads. A window shrinks because the queue was long, and that may be by chance: it takes more to be believed."""
GROWTH: Final = 0.05
"""Share of the window; twice as much each time that the path had room again."""
MARGIN: Final = 1.1
WAIT_S: Final = 2.0
"""Time without an answer until the window is made larger to get one. It doubles each time that this found no room..."""
MOST_WAIT_S: Final = 8.0
PATIENT_S: Final = 32.0
"""... up to this, and from this on a path whose packets hide the jitter: it steers well, and a try is a queue."""
MOST_EPOCHS: Final = 10
"""A larger window that was not filled for so long tells nothing, and is given up like that of a full path."""
AGREE_S: Final = 2.0
"""What was seen longer ago says nothing."""


class Room:
    """`note` every epoch in which there was more to send than the link took, and grow by `step`."""

    __slots__ = (
        "_from_bytes",
        "_hurried",
        "_least_s",
        "_lost",
        "_most_s",
        "_noted_s",
        "_queues",
        "_spread_bytes",
        "_told_s",
        "_tried_epochs",
        "_wait_s",
        "_wanted_bytes",
        "_windows",
        "back_bytes",
        "steps",
    )

    def __init__(self) -> None:
        self.steps = 0
        """Times in a row that the path had room."""
        self.back_bytes: float | None = None
        """The window before it was made larger, if that found no room just now; for the owner to take."""
        self._wanted_bytes = 0.0  # the window that will tell; 0: none is wanted
        self._tried_epochs = 0  # since then
        self._hurried = False
        self._told_s: float | None = None
        self._wait_s: float | None = None
        self._noted_s = -inf
        self._spread_bytes = 0.0
        self._windows: deque[float] = deque(maxlen=EPOCHS)
        self._queues: deque[float] = deque(maxlen=2)
        self._lost: deque[float] = deque(maxlen=2)  # seconds of the path
        self._from_bytes: float | None = None  # the window that is compared with
        self._least_s = self._most_s = 0.0  # of the queue since

    def clear(self) -> None:
        """What was seen so far cannot be compared with what will be."""
        self.steps = 0
        self._wanted_bytes = 0.0
        self._tried_epochs = 0
        self._windows.clear()
        self._queues.clear()
        self._lost.clear()
        self._from_bytes = None

    def hurry(self) -> None:
        """There is reason to think that the link got faster: do not wait."""
        self._hurried = True
        self._wait_s = WAIT_S

    @property
    def trying(self) -> bool:
        """Whether the window alone is to say how much is under way: what a pace holds back tells nothing."""
        return self.steps > 0 or self._wanted_bytes > 0.0

    @property
    def queue_s(self) -> float:
        """Mean queue of the last two epochs."""
        return sum(self._queues) / len(self._queues)

    @property
    def _answer_s(self) -> float:
        """The same, with what was lost in both of them: a burst is in one."""
        return self.queue_s + min(self._lost)

    def step(self, window: float) -> float:
        """Bytes by which `window` is to grow now, while `trying`. The first time that the path had room may
        have been by chance, so the second one is waited for."""
        if self.steps > 1:
            return GROWTH * window * 2.0 ** min(self.steps - 1, 8)
        return min(self._wanted_bytes - window, GROWTH * window if self.steps else self._spread_bytes)

    def note(
        self,
        now: float,
        window: float,
        queue_s: float,
        *,
        rate: float,
        spread_s: float,
        lost: float,
        binds: bool,
        tries: bool,
        patient: bool,
    ) -> bool:
        """An epoch is over in which `window` bytes might be under way on a path of `rate` bytes/s; True: it has room.

        `spread_s`: how far the queue goes up and down whatever the window is. `lost`: share of the bytes of the epoch;
        what a path drops because it keeps no more is as good as queued. `binds`: the window limited, not the pace.
        `tries`: the window may be made larger for it, and if `patient` seldom.
        """
        self.back_bytes = None
        if now > self._noted_s + AGREE_S:
            self.clear()
        self._noted_s = now
        self._spread_bytes = spread_s * rate
        if self._told_s is None or self._wait_s is None:
            self._told_s = now
            self._wait_s = PATIENT_S if patient else WAIT_S
        if not binds:
            self._windows.clear()
            self._queues.clear()
            self._lost.clear()
            self._from_bytes = None
        self._windows.append(window)
        self._queues.append(queue_s)
        self._lost.append(lost * window / rate)
        queue_s = self._answer_s
        if len(self._windows) == EPOCHS:
            least, most = min(self._windows), max(self._windows)
            before = self._from_bytes
            if before is None:
                before = self._windows[0]
                self._compare(before, queue_s)
            self._least_s = min(self._least_s, queue_s)
            self._most_s = max(self._most_s, queue_s)
            grew_s = (least - before) / rate
            shrank_s = (before - most) / rate
            rose_s = queue_s - self._least_s
            if grew_s >= spread_s or (self.trying and min(self._lost) >= spread_s):
                return self._tell(now, least, room=rose_s < SHARE * grew_s, patient=patient)
            if shrank_s >= SHRANK * spread_s:
                fell_s = self._most_s - queue_s
                return self._tell(now, most, room=fell_s < SHARE * shrank_s, patient=patient)
        elif binds:
            return False
        self._try(now, window, allowed=tries, patient=patient)
        return False

    def _tell(self, now: float, window: float, *, room: bool, patient: bool) -> bool:
        assert self._wait_s is not None
        if room:
            self._wait_s = WAIT_S
        elif self._wanted_bytes:
            self._wait_s = min(2 * self._wait_s, PATIENT_S if patient else MOST_WAIT_S)
        self.back_bytes = self._from_bytes if self.trying and not room else None
        self._told_s = now
        self._tried_epochs = 0
        self.steps = self.steps + 1 if room else 0
        self._wanted_bytes = window + MARGIN * self._spread_bytes if self.steps == 1 else 0.0
        self._compare(window, self._answer_s)
        return room

    def _try(self, now: float, window: float, *, allowed: bool, patient: bool) -> None:
        assert self._told_s is not None and self._wait_s is not None
        if self._wanted_bytes:
            self._tried_epochs += 1
            if self._tried_epochs > MOST_EPOCHS:
                self._tell(now, window, room=False, patient=patient)
        elif self._hurried or (allowed and now >= self._told_s + self._wait_s):
            self._hurried = False
            self._compare(window, self._answer_s)
            self._wanted_bytes = window + MARGIN * self._spread_bytes

    def _compare(self, window: float, queue_s: float) -> None:
        self._from_bytes = window
        self._least_s = self._most_s = queue_s

    def shift(self, delay_s: float) -> None:
        """Take `delay_s` off what was noted as queue: it is none."""
        self._queues = deque([queue_s - delay_s for queue_s in self._queues], maxlen=2)
        self._least_s -= delay_s
        self._most_s -= delay_s
