"""Which topic may send its next fragment: the paper's eq. (priority_score) and Alg. prioritize, made to hold a link.

The scheduler holds no messages. The link names each topic by a small integer, the *id* of its channel, says what is
pending there (`offer`, `withdraw`), asks whose turn it is each time the link can take one more fragment (`pick`), and
says what went out (`charge`). A choice is late and cheap: P is evaluated at every fragment, so a newcomer preempts
within one.

Ordering `class` (the reading of "priority first" that delivers it; P alone divides by size and starves a large
urgent message) serves by (class, −P). A class is served ahead of a backlogged more urgent one only
- from its floor: each charged byte earns every backlogged lower class `floor` bytes of credit (deficit round robin);
  a class whose credit reaches a quantum goes next, and pays with the bytes it sends;
- when the token bucket of class 0 is spent: class 0 may take `class0_share` of the link while others wait;
- while the more urgent message is being encoded.

Streams in the background (`TopicSpec.background`) count as class 2 and stand below it: they are served only while
nothing else waits, and have no floor.

Ordering `paper` is Alg. prioritize as printed: once per interval all pending messages are sorted by P, classes mixed;
those that fit the interval's budget B·Δt are sent whole, the others wait, and a stale one of the lowest class is
reported for dropping. A message larger than the budget is therefore never sent. A message that was marked and not
finished within its interval stays marked, for the algorithm has handed it to the transport.

In both orderings only class 0 within its bucket passes a closed window, and every class-0 byte counts in the bucket.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import floor
from typing import Final, NamedTuple

from sern_core.stream.pending import PendingClass
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASSES, Ordering, PriorityClass

DEFAULT_QUANTUM_BYTES: Final = 1200
"""Credit that lets a lower class go next: one fragment of the UDP lane."""
CREDIT_QUANTA: Final = 4
"""Most credit a class can save up, in quanta: what it may send in a row when the window opens again."""
BURST_BYTES: Final = 4096
"""Least size of the class-0 bucket: a handful of poses and commands at once, on any link."""
BURST_S: Final = 0.05
"""Size of the class-0 bucket on faster links: what its rate delivers in this time."""
_MIN_RATE: Final = 1.0  # bytes/s; keeps the bucket's arithmetic finite while the link is stalled at 0
_INF: Final = float("inf")


class WaitReason(StrEnum):
    """Why a pending message is not the next one."""

    OUTRANKED = "outranked"  # another message of its class has a higher score
    CLASS = "class"  # a more urgent class goes first
    FLOOR = "floor"  # a less urgent class is served from its floor
    BUCKET = "bucket"  # the token bucket of class 0 is spent
    WINDOW = "window"  # the window is closed to its class
    INTERVAL = "interval"  # ordering `paper`: did not fit this interval's budget
    ENCODING = "encoding"  # withdrawn while it is encoded


@dataclass(frozen=True, slots=True)
class Standing:
    """What the scheduler thinks of one channel at one time, for people and for the decision log.

    `score` is P in 1/bytes with the clipped age; `age_s` is not clipped. `rank` counts the pending messages that go
    before it: by (class, −P), or by −P in ordering `paper`. `waits_for` is None when this channel is the next one.
    """

    channel_id: int
    priority: PriorityClass
    weight: float
    age_s: float
    size_bytes: float
    score: float
    rank: int
    waits_for: WaitReason | None


class _Entry(NamedTuple):
    priority: PriorityClass
    weight: float
    size_bytes: float
    since_s: float
    stale_after_s: float | None
    background: bool


_new_entry = tuple.__new__  # builds an _Entry in half the time of its constructor; one is built per offer


class _Bucket:
    """Token bucket of class 0, kept as the time at which it is no longer spent: asking is one comparison.

    Tokens at `now` are (now − ready_s) / s_per_byte, at most the burst and at least minus the burst.
    """

    __slots__ = ("_burst_s", "_s_per_byte", "_share", "ready_s")

    def __init__(self, share: float, now: float) -> None:
        self._share = share
        self._s_per_byte = 0.0  # 0: no known rate, never spent
        self._burst_s = 0.0  # time that refills an empty bucket
        self.ready_s = now

    def set_rate(self, rate_bps: float | None, now: float) -> None:
        if rate_bps is None:
            self._s_per_byte = self._burst_s = 0.0
            self.ready_s = now
            return
        rate = max(self._share * rate_bps / 8.0, _MIN_RATE)  # bytes/s
        burst_bytes = max(float(BURST_BYTES), BURST_S * rate)
        tokens = min(max(self.tokens_bytes(now), -burst_bytes), burst_bytes)
        self._s_per_byte = 1.0 / rate
        self._burst_s = burst_bytes / rate
        self.ready_s = now - tokens / rate

    def take(self, nbytes: float, now: float) -> None:
        burst_s = self._burst_s
        ready_s = self.ready_s
        if ready_s < now - burst_s:
            ready_s = now - burst_s
        ready_s += nbytes * self._s_per_byte
        self.ready_s = ready_s if ready_s < now + burst_s else now + burst_s

    def tokens_bytes(self, now: float) -> float:
        """Bytes class 0 may still send ahead of others; infinite without a known rate, negative in debt."""
        if not self._s_per_byte:
            return _INF
        return min(now - self.ready_s, self._burst_s) / self._s_per_byte


class _Interval:
    """Alg. prioritize: the messages marked for sending, and the stale ones, as of the last interval boundary."""

    __slots__ = ("_next_s", "_params", "_start_s", "budget_bytes", "marked", "stale")

    def __init__(self, params: SchedulerParams, now: float) -> None:
        self._params = params
        self._start_s = now
        self._next_s = now
        self.budget_bytes = _INF  # B·Δt
        self.marked: dict[int, None] = {}  # in the order of sending
        self.stale: dict[int, None] = {}

    @property
    def next_s(self) -> float:
        return self._next_s

    def advance(self, entries: dict[int, _Entry], now: float) -> None:
        """Run the algorithm if an interval boundary has passed. Marked messages have left the list M already."""
        if now < self._next_s:
            return
        interval_s = self._params.interval_s
        self._next_s = self._start_s + (floor((now - self._start_s) / interval_s) + 1) * interval_s
        if self._next_s <= now:  # the quotient was rounded down across a boundary
            self._next_s = now + interval_s
        waiting = [
            (-score(entry, now, self._params), channel_id, entry)
            for channel_id, entry in entries.items()
            if channel_id not in self.marked and not entry.background
        ]
        waiting.sort()
        used_bytes = 0.0
        for _, channel_id, entry in waiting:
            if used_bytes + entry.size_bytes <= self.budget_bytes:
                self.marked[channel_id] = None
                self.stale.pop(channel_id, None)
                used_bytes += entry.size_bytes
            elif (
                entry.priority == PriorityClass.BULK
                and entry.stale_after_s is not None
                and now - entry.since_s > entry.stale_after_s
            ):
                self.stale[channel_id] = None

    def offered(self, channel_id: int, old: _Entry | None, new: _Entry, *, encoded: bool) -> None:
        self.stale.pop(channel_id, None)
        if channel_id in self.marked and not encoded:
            same_message = old is not None and old.since_s == new.since_s and new.size_bytes <= old.size_bytes
            if not same_message:
                del self.marked[channel_id]

    def withdrawn(self, channel_id: int, *, encoding: bool) -> None:
        self.stale.pop(channel_id, None)
        if not encoding:
            self.marked.pop(channel_id, None)


def score(entry: _Entry, now: float, params: SchedulerParams) -> float:
    """P(m) of the paper's eq. (priority_score), age clipped at a_max; 1/bytes."""
    age_s = min(now - entry.since_s, params.a_max_s)
    return entry.weight / (entry.size_bytes + params.epsilon_bytes) * (1.0 + params.eta * age_s)


class Scheduler:
    """Decides which channel sends next. Times are seconds on one monotonic clock; `now` must not go back.

    `quantum_bytes` is the credit that lets a lower class go next; a lane with larger fragments may raise it.
    """

    def __init__(self, params: SchedulerParams, *, now: float, quantum_bytes: float = DEFAULT_QUANTUM_BYTES) -> None:
        if not 0.0 < quantum_bytes < _INF:
            raise UsageError(f"Scheduler: quantum_bytes = {quantum_bytes!r} must be above 0")
        self.params = params
        self._epsilon_bytes = params.epsilon_bytes
        self._floor = params.floor
        self._quantum_bytes = quantum_bytes
        self._credit_max = CREDIT_QUANTA * quantum_bytes
        self._tables = tuple(PendingClass(eta=params.eta, a_max_s=params.a_max_s, origin_s=now) for _ in CLASSES)
        self._control, self._state, self._bulk = self._tables
        self._background = PendingClass(eta=params.eta, a_max_s=params.a_max_s, origin_s=now)
        self._entries: dict[int, _Entry] = {}
        self._encoding: dict[int, _Entry] = {}  # withdrawn while encoded: not served, but still backlog of its class
        self._held = [0] * len(CLASSES)  # how many of `_encoding` there are, per class
        self._state_credit = 0.0  # bytes that class 1 may send ahead of class 0; negative after a large fragment
        self._bulk_credit = 0.0
        self._bucket = _Bucket(params.class0_share, now)
        self._interval = _Interval(params, now) if params.ordering is Ordering.PAPER else None

    # What is pending

    def offer(
        self,
        channel_id: int,
        *,
        priority: PriorityClass,
        weight: float,
        size_bytes: float,
        since_s: float,
        stale_after_s: float | None = None,
        background: bool = False,
    ) -> None:
        """The channel has a pending message: a new head, or less of the same one left to send.

        `weight` is κ(t), `size_bytes` the remaining size s(m) (an estimate will do). Age counts from `since_s`: the
        message's birth, or for a coalesced topic the time since which it waits (`OutChannel.waits_since_s`); not later
        than the next `pick`.
        `stale_after_s` (ordering `paper`) is the age above which a message of class bulk may be reported as stale.
        `background`, the same for a channel's whole life: it is served only while nothing else waits.
        In ordering `paper` an offer with the same `since_s` and no larger size continues the same message.

        Raises UsageError if `weight` is not above 0, `size_bytes` is negative, or a value is not finite.
        """
        gain = weight / (size_bytes + self._epsilon_bytes) if size_bytes >= 0.0 else 0.0
        if not (0.0 < gain < _INF and -_INF < since_s < _INF):
            raise UsageError(
                f"Scheduler.offer: channel {channel_id}: weight = {weight!r} must be above 0, size_bytes = "
                f"{size_bytes!r} not negative, since_s = {since_s!r} finite"
            )
        entries = self._entries
        old = entries.get(channel_id)
        entries[channel_id] = entry = _new_entry(
            _Entry, (priority, weight, size_bytes, since_s, stale_after_s, background)
        )
        if background:
            self._background.put(channel_id, gain, since_s)
            if self._encoding:
                self._release(channel_id)
            return
        if old is not None and old[0] is not priority:
            self._remove(channel_id, old[0])
        self._tables[priority].put(channel_id, gain, since_s)
        if self._encoding or self._interval is not None:
            encoded = self._release(channel_id)
            if encoded is not None and encoded.priority is not priority:
                self._settle_credit(encoded.priority)
            if self._interval is not None:
                self._interval.offered(channel_id, old, entry, encoded=encoded is not None)

    def withdraw(self, channel_id: int, *, encoding: bool = False) -> None:
        """Nothing of the channel can be sent now. Idempotent.

        With `encoding` the message will be back: meanwhile others are served, its class keeps the credit of its floor,
        and (ordering `paper`) it keeps its place in the interval. Without it, a class that has nothing else pending
        loses its credit.
        """
        entry = self._entries.pop(channel_id, None)
        if encoding and entry is not None:
            self._encoding[channel_id] = entry
            self._held[entry.priority] += not entry.background
        elif self._encoding and not encoding:
            held = self._release(channel_id)
            if held is not None:
                self._settle_credit(held.priority)
        if entry is not None and entry.background:
            self._background.remove(channel_id)
        elif entry is not None:
            self._remove(channel_id, entry[0])
        if self._interval is not None:
            self._interval.withdrawn(channel_id, encoding=encoding)

    def _remove(self, channel_id: int, priority: PriorityClass) -> None:
        table = self._tables[priority]
        table.remove(channel_id)
        if not table.channel_ids:
            self._settle_credit(priority)

    def _release(self, channel_id: int) -> _Entry | None:
        """The message is no longer being encoded."""
        entry = self._encoding.pop(channel_id, None)
        if entry is not None:
            self._held[entry.priority] -= not entry.background
        return entry

    def _settle_credit(self, priority: PriorityClass) -> None:
        """Credit is for backlog only: a class without any starts from nothing (debts stay)."""
        if not self._tables[priority].channel_ids and not self._held[priority]:
            if priority == 1:
                self._state_credit = min(self._state_credit, 0.0)
            elif priority == 2:
                self._bulk_credit = min(self._bulk_credit, 0.0)

    def pending(self, priority: PriorityClass) -> int:
        """Channels of the class that could be served; those being encoded, or in the background, are not counted."""
        return len(self._tables[priority].channel_ids)

    @property
    def pends(self) -> bool:
        """Whether a channel of any class could be served."""
        return bool(
            self._bulk.channel_ids
            or self._state.channel_ids
            or self._control.channel_ids
            or self._background.channel_ids
        )

    @property
    def background_only(self) -> bool:
        """Whether nothing waits but what is in the background."""
        return bool(self._background.channel_ids) and len(self._background) == len(self._entries)

    # Whose turn it is

    def pick(self, *, now: float, window_open: bool = True) -> int | None:
        """The channel to serve next, or None. Asking changes nothing: it may be asked again, or not be followed."""
        if self._interval is not None:
            marked = self._pick_marked(self._interval, now, window_open=window_open)
            return self._pick_background(now) if marked is None and window_open else marked
        control = self._control
        if control.channel_ids and now >= self._bucket.ready_s:
            if not window_open:
                return control.best(now)
            if self._state_credit >= self._quantum_bytes and self._state.channel_ids:
                return self._state.best(now)
            if self._bulk_credit >= self._quantum_bytes and self._bulk.channel_ids:
                return self._bulk.best(now)
            return control.best(now)
        if not window_open:
            return None
        bulk = self._bulk
        if self._state.channel_ids:
            if self._bulk_credit >= self._quantum_bytes and bulk.channel_ids:
                return bulk.best(now)
            return self._state.best(now)
        if bulk.channel_ids:
            return bulk.best(now)
        if control.channel_ids:
            return control.best(now)  # spent, but nobody else wants the link
        return self._pick_background(now)

    def _pick_background(self, now: float) -> int | None:
        """What may go because nothing else waits."""
        return self._background.best(now) if self.background_only else None

    def pick_control(self, *, now: float, window_open: bool) -> int | None:
        """The channel of class control to serve next on a connection of its own: beyond its share of the link it goes
        by the window, and only where nobody else wants the link.

        Ordering `class` only, like `pick_rest`.
        """
        control = self._control
        if control.channel_ids and (
            now >= self._bucket.ready_s or (window_open and not (self._state.channel_ids or self._bulk.channel_ids))
        ):
            return control.best(now)
        return None

    def control_deadline(self) -> float | None:
        """When `pick_control`, None by now with the window closed, can name a channel by time alone."""
        return self._bucket.ready_s if self._control.channel_ids else None

    def within_share(self, now: float) -> bool:
        """Whether class 0 has something left of its share of the link."""
        return now >= self._bucket.ready_s

    def pick_rest(self, *, now: float) -> int | None:
        """The channel to serve next when class control has a connection of its own."""
        state, bulk = self._state, self._bulk
        if bulk.channel_ids and (not state.channel_ids or self._bulk_credit >= self._quantum_bytes):
            return bulk.best(now)
        if state.channel_ids:
            return state.best(now)
        return self._pick_background(now)

    def _pick_marked(self, interval: _Interval, now: float, *, window_open: bool) -> int | None:
        interval.advance(self._entries, now)
        return self._first_marked(interval, now, window_open=window_open)

    def _first_marked(self, interval: _Interval, now: float, *, window_open: bool) -> int | None:
        for channel_id in interval.marked:
            entry = self._entries.get(channel_id)
            if entry is None:
                continue  # being encoded
            if window_open or (entry.priority == 0 and now >= self._bucket.ready_s):
                return channel_id
        return None

    def best(self, priority: PriorityClass, *, now: float) -> int | None:
        """The channel of the class with the highest score, or None; neither window nor bucket nor floors are asked.

        For a link that probes a stalled path with single fresh messages.
        """
        table = self._tables[priority]
        return table.best(now) if table.channel_ids else None

    def charge(self, priority: PriorityClass, nbytes: int, *, now: float, background: bool = False) -> None:
        """`nbytes` of that class were put on the wire, overhead included, whether or not `pick` had named it. What is
        in the background pays nothing and earns nobody anything: nobody waited for it."""
        if background:
            return
        bucket = self._bucket
        if priority == 0:
            urgent_waits = True
            bucket.take(nbytes, now)
        else:
            urgent_waits = bool(self._control.channel_ids) and now >= bucket.ready_s
        earned = self._floor * nbytes
        # Served in its own right, a class pays nothing and saves nothing; served from its floor, it pays. What a
        # fragment larger than the credit left as a debt is paid off by later traffic, backlog or not: else a class
        # of single large messages would get more than its floor.
        held = self._held
        credit = self._state_credit + earned
        limit = self._credit_max if self._state.channel_ids or held[1] else 0.0
        if priority == 1:
            if urgent_waits:
                credit -= nbytes
            else:
                limit = 0.0
        self._state_credit = credit if credit < limit else limit
        credit = self._bulk_credit + earned
        limit = self._credit_max if self._bulk.channel_ids or held[2] else 0.0
        if priority == 2:
            if urgent_waits or self._state.channel_ids:
                credit -= nbytes
            else:
                limit = 0.0
        self._bulk_credit = credit if credit < limit else limit

    def set_rate(self, rate_bps: float | None, *, now: float, full: bool = True) -> None:
        """The link's capacity B; None when unknown, which leaves class 0 and the interval's budget unlimited.

        `full` False: it carries that much, and there was never enough to send to see more. Class 0's share is of what
        is known; the interval's budget is no limit then, or little traffic would keep it little.

        Raises UsageError if it is negative or not finite.
        """
        if rate_bps is not None and not 0.0 <= rate_bps < _INF:
            raise UsageError(f"Scheduler.set_rate: rate_bps = {rate_bps!r} must be 0 or above, or None")
        self._bucket.set_rate(rate_bps, now)
        if self._interval is not None:
            self._interval.budget_bytes = (
                _INF if rate_bps is None or not full else rate_bps * self.params.interval_s / 8.0
            )

    def class0_tokens_bytes(self, *, now: float) -> float:
        """Bytes class 0 may send ahead of others; infinite while the capacity is unknown, negative in debt."""
        return self._bucket.tokens_bytes(now)

    def next_deadline(self, *, now: float, window_open: bool) -> float | None:
        """When `pick`, None by now, can name a channel by time alone; None if only another call can change that."""
        if self.pick(now=now, window_open=window_open) is not None:
            return None
        interval = self._interval
        if interval is None:
            return self._bucket.ready_s if self._control.channel_ids else None
        deadline = None
        if any(channel_id not in interval.marked for channel_id, e in self._entries.items() if not e.background):
            deadline = interval.next_s
        if any(
            self._entries[channel_id].priority == 0 for channel_id in interval.marked if channel_id in self._entries
        ):
            deadline = self._bucket.ready_s if deadline is None else min(deadline, self._bucket.ready_s)
        return deadline

    def take_stale(self, now: float) -> list[int]:
        """Ordering `paper`: the channels whose message the last interval found stale, of class bulk, and not fitting.

        Each is named once per interval; the caller drops the message (reason `stale`) and withdraws or offers anew.
        """
        if self._interval is None:
            return []
        self._interval.advance(self._entries, now)
        stale = list(self._interval.stale)
        self._interval.stale.clear()
        return stale

    # For people

    @property
    def busy(self) -> bool:
        """Whether anything waits, here or for its encoding."""
        return bool(self._entries or self._encoding)

    def waiting(self) -> list[int]:
        """The channels of which something waits, those whose message is being encoded included."""
        return [*self._entries, *self._encoding]

    def waits_for(
        self, channel_id: int, now: float, *, window_open: bool = True, beside: bool = False
    ) -> tuple[WaitReason | None, int | None]:
        """What a channel of `waiting` waits for, None: it is the next; and which channel is the next, None: nobody
        is. `beside`: class control has a connection of its own (`pick_control`, `pick_rest`). It changes nothing."""
        if channel_id not in self._entries:
            return WaitReason.ENCODING, None
        entry = self._entries[channel_id]
        if beside and self._interval is None:
            if entry.priority == 0:
                chosen = self.pick_control(now=now, window_open=window_open)
            else:
                chosen = self.pick_rest(now=now) if window_open else None
        elif self._interval is not None:
            chosen = self._first_marked(self._interval, now, window_open=window_open)
        else:
            chosen = self.pick(now=now, window_open=window_open)
        return self._reason(channel_id, entry, chosen, now, window_open=window_open), chosen

    def explain(self, channel_id: int, now: float, *, window_open: bool = True) -> Standing | None:
        """How the channel stands at `now`, and what it waits for; None when nothing of it is pending. O(n)."""
        entry = self._entries.get(channel_id) or self._encoding.get(channel_id)
        if entry is None:
            return None
        return Standing(
            channel_id=channel_id,
            priority=entry.priority,
            weight=entry.weight,
            age_s=now - entry.since_s,
            size_bytes=entry.size_bytes,
            score=score(entry, now, self.params),
            rank=self._rank(channel_id, entry, now),
            waits_for=self.waits_for(channel_id, now, window_open=window_open)[0],
        )

    def _rank(self, channel_id: int, entry: _Entry, now: float) -> int:
        by_class = self._interval is None
        own = score(entry, now, self.params)
        return sum(
            (by_class and other.priority < entry.priority)
            or ((not by_class or other.priority == entry.priority) and score(other, now, self.params) > own)
            for other_id, other in self._entries.items()
            if other_id != channel_id
        )

    def _reason(
        self, channel_id: int, entry: _Entry, chosen: int | None, now: float, *, window_open: bool
    ) -> WaitReason | None:
        if chosen == channel_id:
            return None
        if entry.background:
            return WaitReason.WINDOW if chosen is None else self._behind(chosen)
        if self._interval is not None and channel_id not in self._interval.marked:
            return WaitReason.INTERVAL
        spent = entry.priority == 0 and now < self._bucket.ready_s
        if chosen is None:
            return WaitReason.BUCKET if spent else WaitReason.WINDOW
        if self._interval is not None:
            return WaitReason.OUTRANKED if window_open or entry.priority == 0 else WaitReason.WINDOW
        served = self._entries[chosen].priority
        if served == entry.priority:
            return WaitReason.OUTRANKED
        if not window_open and entry.priority != 0:
            return WaitReason.WINDOW
        if served < entry.priority:
            return WaitReason.CLASS
        return WaitReason.BUCKET if spent else WaitReason.FLOOR

    def _behind(self, chosen: int) -> WaitReason:
        return WaitReason.OUTRANKED if self._entries[chosen].background else WaitReason.CLASS

    def validate(self) -> None:
        """Raise AssertionError unless the parts agree; for test teardown."""
        for table in (*self._tables, self._background):
            table.validate()
        assert not self._entries.keys() & self._encoding.keys()
        held = [entry for entry in self._encoding.values() if not entry.background]
        assert self._held == [sum(entry.priority == c for entry in held) for c in CLASSES]
        assert sum(len(table.channel_ids) for table in (*self._tables, self._background)) == len(self._entries)
        for channel_id, entry in self._entries.items():
            table = self._background if entry.background else self._tables[entry.priority]
            assert channel_id in table.channel_ids, f"channel {channel_id} is not in the table of its class"
        for priority, credit in ((PriorityClass.STATE, self._state_credit), (PriorityClass.BULK, self._bulk_credit)):
            assert credit <= self._credit_max
            backlog = self._tables[priority].channel_ids or self._held[priority]
            assert credit <= 0.0 or backlog, f"class {priority} has credit without backlog"
        if self._interval is not None:
            known = self._entries.keys() | self._encoding.keys()
            assert self._interval.marked.keys() <= known
            assert self._interval.stale.keys() <= self._entries.keys()
            assert not self._interval.stale.keys() & self._interval.marked.keys()
