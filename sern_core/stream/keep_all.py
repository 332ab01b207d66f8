"""What a reliable channel keeps: every message until the peer's delivered watermark passes it, or until its lifespan or
retention ends. Then a one-byte drop marker takes its place, so that order survives and nothing is lost silently. A full
queue refuses messages to its caller."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from itertools import islice
from typing import ClassVar, Final

from sern_core.stream.lapses import Lapses, left_behind
from sern_core.stream.out_drops import OutDrops
from sern_core.stream.out_message import BY_SEQ, OutMessage
from sern_core.stream.prices import CLEARED_PER_US, CLIENT_OVERHEAD_BYTES, GIVEN_UP_US, MESSAGE_OVERHEAD_BYTES
from sern_core.stream.transit import NOTHING, Transit
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import DROP_REASONS, DropReason

FEW: Final = 16
"""Up to so many messages that are confirmed are let go of one by one: that is what happens all the time."""


class KeepAll:
    """The messages of one reliable channel, from the first above `watermark` on."""

    __slots__ = (
        "_drops",
        "_lapses",
        "_spec",
        "_transit",
        "depth",
        "gaps",
        "next_seq",
        "retained",
        "retained_bytes",
        "watermark",
    )

    coalesced: ClassVar[bool] = False
    gate: ClassVar[None] = None

    def __init__(self, spec: TopicSpec, transit: Transit, drops: OutDrops, *, first: int) -> None:
        self._spec = spec
        self._transit = transit
        self._drops = drops
        self._lapses = Lapses(spec)
        self.depth = spec.depth
        self.retained: deque[OutMessage] = NOTHING
        """Everything above the watermark, drop markers included, in its order."""
        self.retained_bytes = 0
        self.watermark = first - 1
        self.next_seq = first
        self.gaps: deque[tuple[int, int]] = NOTHING
        """After this seq, the next that will come."""

    # --- entry ----------------------------------------------------------------------------------------------------

    def submit(self, message: Message, now: float, *, forced: bool, unwanted: bool) -> bool:
        """Take one message. False: there is no room for it."""
        drops = self._drops
        counters = drops.counters
        size = len(message.body)
        if not forced and not self.has_room(size):
            counters.refuse(size)
            return False
        counters.offer(size)
        self.next_seq = message.seq + 1
        if message.seq <= self.watermark:
            counters.deliver(size)  # the peer has it already, from an earlier run of this relay
            return True
        if unwanted and not self.retained:
            reason = DROP_REASONS[message.drop_marker] if message.drop_marker else DropReason.UNWANTED
            drops.count(message.seq, reason, size)
            self.watermark = message.seq
            return True
        out = OutMessage(message)
        if message.drop_marker:
            out.counted = True
            drops.count(message.seq, DROP_REASONS[message.drop_marker], size)
        self._keep(out)
        return True

    def has_room(self, size_bytes: int) -> bool:
        """Whether one more message keeps within the stream's bound."""
        overhead_bytes = MESSAGE_OVERHEAD_BYTES * (len(self.retained) + 1)
        return self.retained_bytes + size_bytes + overhead_bytes <= self._spec.max_queue_bytes

    def reject(self, message: Message, reason: DropReason) -> None:
        """Drop a message that cannot travel at all; the stream goes on over its drop marker."""
        drops = self._drops
        size = len(message.body)
        drops.counters.offer(size)
        self.next_seq = message.seq + 1
        out = OutMessage(message)
        if message.seq <= self.watermark:
            drops.drop(out, reason)
            return
        drops.count(message.seq, reason, size)
        out.mark_dropped(reason)
        self._keep(out)
        drops.tell(out, reason)

    def leave_out(self, message: Message, reason: DropReason) -> None:
        """There is no room for this message, nor for a drop marker: the stream goes on behind it."""
        drops = self._drops
        size = len(message.body)
        drops.counters.offer(size)
        if message.seq <= self.watermark:
            drops.counters.deliver(size)
        elif message.drop_marker:
            drops.count(message.seq, message.drop_reason, size)  # reported where it was dropped
        else:
            drops.count(message.seq, reason, size)
            drops.tell(OutMessage(message), reason)
        self.skip_to(message.seq + 1)

    def prime(self, replays: Sequence[Message], now: float) -> Sequence[OutMessage]:
        """Put latched messages ahead of everything; returns those that are to be sent."""
        limit = self.retained[0].seq if self.retained else self.next_seq
        fresh = [OutMessage(message) for message in replays if message.seq < limit]
        fresh = [out for out in fresh if not out.expired(self._spec.lifespan_s, now)]
        if not fresh:
            return fresh
        for out in fresh:
            out.retain_from_s = now
            self._drops.counters.offer(out.offered_bytes)
        self._transit.put_first(fresh)
        self.retained = deque((*fresh, *self.retained))
        self.retained_bytes += sum(out.size for out in fresh)
        self.watermark = fresh[0].seq - 1
        # Also replays of an earlier time may have others between them.
        self._drops.live_from = max(self._drops.live_from, limit)
        self._lapses.primed(fresh[-1].seq)
        after = [*(out.seq for out in fresh[1:]), limit]
        gaps = [(out.seq, seq) for out, seq in zip(fresh, after, strict=True) if seq > out.seq + 1]
        if gaps:
            self.gaps = deque((*gaps, *self.gaps))
        return fresh

    def _keep(self, out: OutMessage) -> None:
        if self.retained is NOTHING:
            self.retained = deque()
        self.retained.append(out)
        self.retained_bytes += out.size
        self._transit.append(out)

    # --- gaps -----------------------------------------------------------------------------------------------------

    def start_at(self, first: int) -> None:
        """Nothing has been submitted yet: begin at seq `first` instead."""
        self.gaps = NOTHING
        self.next_seq = first
        self.watermark = first - 1

    def skip_to(self, first: int) -> None:
        """Nothing from `next_seq` up to `first` will come; the peer is told in its turn (`next_gap`)."""
        if first > self.next_seq:
            if self.gaps and self.gaps[-1][1] == self.next_seq:  # nothing was kept since that gap
                self.gaps[-1] = (self.gaps[-1][0], first)
            else:
                self._add_gap(self.next_seq - 1, first)
            self.next_seq = first

    def next_gap(self) -> int | None:
        """The seq to go on at, once everything before the gap is delivered; each gap is given out once."""
        first = None
        while self.gaps and self.watermark >= self.gaps[0][0]:
            first = self.gaps.popleft()[1]
            self.watermark = max(self.watermark, first - 1)
        return first

    def _add_gap(self, last_seq: int, first: int) -> None:
        if self.gaps is NOTHING:
            self.gaps = deque()
        self.gaps.append((last_seq, first))

    # --- service --------------------------------------------------------------------------------------------------

    def head(self, now: float) -> OutMessage | None:
        """The message to serve next: a drop marker if its time is over."""
        transit = self._transit
        if transit.active:
            out = transit.active[0]
        elif transit.queue:
            out = transit.queue[0]
        else:
            return None
        message, spec = out.message, self._spec
        if not message.drop_marker:
            if now - out.retain_from_s > spec.retention_s:
                self.give_up(out, DropReason.RETENTION)
            elif spec.lifespan_s is not None and now - message.born_s + message.error_s > spec.lifespan_s:
                self.give_up(out, DropReason.LIFESPAN)
        return out

    def give_up(self, out: OutMessage, reason: DropReason) -> None:
        """A drop marker takes the place of a message; it is reported unless that was done before. The marker has the
        reason itself: it is read by those alone who did not get the message."""
        drops, transit = self._drops, self._transit
        size = out.size
        if not out.started:
            transit.queued_bytes -= size - 1
        self.retained_bytes -= size - 1
        reported, told = out.counted, reason
        if not reported:
            told = drops.reason_of(out, reason)
            drops.count(out.seq, told, out.offered_bytes)
        out.mark_dropped(reason)
        if not reported:
            drops.tell(out, told)
        if out.started:
            # What is in flight of the old body is harmless: the receiver takes the drop marker in its place.
            transit.activate(out)

    def mark_dropped(self, outs: list[OutMessage], reason: DropReason) -> None:
        """Drop markers take the places of messages. Those that were not counted are told of together."""
        drops, transit = self._drops, self._transit
        lost = [out for out in outs if not out.counted]
        told = [(run, drops.reason_of(run[0], reason, len(run))) for run in drops.runs(lost)]
        for out in outs:
            freed_bytes = out.size - 1
            self.retained_bytes -= freed_bytes
            if not out.started:
                transit.queued_bytes -= freed_bytes
            out.mark_dropped(reason)
        transit.activate_all([out for out in outs if out.started])
        for run, why in told:
            drops.drop_run(run, why)

    def abandon(self, seq: int, reason: DropReason) -> bool:
        """Give up message `seq`; a drop marker stays. False: it has been begun, or is not here."""
        for out in reversed(self._transit.queue):
            if out.seq == seq and not out.message.drop_marker:
                self.give_up(out, reason)
                return True
        return False

    def shed(self, room_bytes: int, reason: DropReason) -> int:
        """Give up what has not been begun, the newest first; the stream goes on behind it (`next_gap`)."""
        transit = self._transit
        given_up: deque[OutMessage] = deque()
        freed_bytes = 0
        while freed_bytes < room_bytes and transit.queue:
            out = transit.pop_newest()
            self.retained.pop()  # what has not been begun is behind all that has been
            self.retained_bytes -= out.size
            given_up.appendleft(out)
            freed_bytes += out.size + CLIENT_OVERHEAD_BYTES
        if given_up:
            last_seq = self.retained[-1].seq if self.retained else self.watermark
            while self.gaps and self.gaps[-1][1] > last_seq:
                self.gaps.pop()
            self._add_gap(last_seq, self.next_seq)
        transit.uncode(given_up)
        self._drops.drop_all([out for out in given_up if not out.counted], reason)
        return freed_bytes

    # --- outcomes -------------------------------------------------------------------------------------------------

    def arrived(self, out: OutMessage) -> None:
        """The peer has the whole message: it is kept until the watermark passes it."""

    def unwanted_again(self, out: OutMessage, now: float) -> DropReason | None:
        """Every fragment that is lost is sent again."""
        return None

    def recoded(self, grown_bytes: int) -> None:
        """A body is longer by so much."""
        self.retained_bytes += grown_bytes

    def delivered_to(self, watermark: int) -> int:
        """The peer's delivered watermark moved: messages up to it are done. Returns how many were kept."""
        if watermark <= self.watermark:
            return 0
        self.watermark = watermark
        retained, counters = self.retained, self._drops.counters
        before = len(retained)
        if before > FEW and retained[FEW].seq <= watermark:
            done = self._take_out()
            sizes = [out.offered_bytes for out in done if not out.counted]
            counters.deliver(sum(sizes), len(sizes))
            return len(done)
        while retained and retained[0].seq <= watermark:
            out = retained.popleft()
            self.retained_bytes -= out.size
            if not out.counted:
                counters.deliver(out.offered_bytes)
            self._transit.forget(out)
        return before - len(retained)

    def _take_out(self) -> Sequence[OutMessage]:
        """Take the messages up to the watermark out of wherever they are, at once: a peer may confirm a hundred
        thousand with one number."""
        watermark, retained, transit = self.watermark, self.retained, self._transit
        if retained[-1].seq <= watermark:
            transit.uncode(retained)
            self._let_go()
            return retained
        done = [retained.popleft() for _ in range(bisect_right(retained, watermark, key=BY_SEQ))]
        transit.uncode(done)
        self.retained_bytes -= sum([out.size for out in done])
        transit.take_out(done, watermark)
        return done

    def _let_go(self) -> None:
        self.retained = NOTHING
        self.retained_bytes = 0
        self._transit.let_go()

    def settle(self) -> None:
        """Let go of messages that the peer has whole, in order: for a stream without a watermark."""
        flying = self._transit.flying
        while self.retained and self.retained[0].started and self.retained[0].seq not in flying:
            self.delivered_to(self.retained[0].seq)

    def reported(self, seq: int, reason: DropReason, where: str, count: int) -> int:
        """A later hop dropped `count` messages from `seq` on, for the client `where`. Returns what that costs, in
        microseconds."""
        retained, drops = self.retained, self._drops
        start, end = bisect_left(retained, seq, key=BY_SEQ), bisect_left(retained, seq + count, key=BY_SEQ)
        news = [out for out in islice(retained, start, end) if not out.counted]
        for out in news:
            out.counted = True
            out.lost_to = where
        work_us = len(news) // CLEARED_PER_US
        for run in drops.spans(news):
            drops.drop_run(run, reason)
            work_us += GIVEN_UP_US
        return work_us

    def sweep(self, now: float, *, up: bool, room: int) -> int:
        """Give up what has lapsed; returns what of `room` that took."""
        spent = 0
        if not up and self.retained:
            spent = self._leave_behind(now, room)
        if self.retained and spent < room:
            spent += self._lapses.mark(self, now, room - spent)
        return spent

    def _leave_behind(self, now: float, room: int) -> int:
        """Drop the oldest that have lapsed without a session, and leave nothing behind: there is nobody to tell, and
        the announcement of the next session starts behind them. Returns what of `room` it took."""
        spent, last_seq, runs = left_behind(self.retained, self._spec, now, room)
        if last_seq:
            self.watermark = last_seq
            self._take_out()
        for why, lost in runs:
            self._drops.drop_all(lost, why)
        return spent

    def restart(self, *, alone: bool) -> None:
        """The peer is a new process: everything waits to be sent again. `alone`: one at most is to get it."""
        if alone:
            for out in self.retained:  # reported as dropped to the only one: then it shall not get it now
                if out.counted and not out.message.drop_marker:
                    self.retained_bytes -= out.size - 1
                    out.mark_dropped(DropReason.LOST)
        self._transit.restart(self.retained)
        self._lapses.restart()

    def clear(self, reason: DropReason) -> int:
        """Drop all that is left; returns in how many runs."""
        self._transit.uncode(self.retained)
        runs = self._drops.drop_all([out for out in self.retained if not out.counted], reason)
        self.gaps = NOTHING
        self.watermark = max(self.watermark, self.next_seq - 1)
        self._let_go()
        return runs

    # --- accounting -----------------------------------------------------------------------------------------------

    @property
    def kept(self) -> int:
        return len(self.retained)

    @property
    def unbegun(self) -> int:
        """How many messages wait of which nothing was sent."""
        return len(self._transit.queue)

    @property
    def unbegun_bytes(self) -> int:
        return self._transit.queued_bytes

    @property
    def held_bytes(self) -> int:
        return self.retained_bytes

    @property
    def first_seq(self) -> int:
        return self.retained[0].seq if self.retained else self.next_seq

    def undelivered(self) -> list[OutMessage]:
        return [out for out in self.retained if not out.counted]

    def split(self) -> tuple[list[OutMessage], list[OutMessage]]:
        """What waits, and what is in flight or arrived, but for what is counted already."""
        left = self.undelivered()
        return [out for out in left if not out.started], [out for out in left if out.started]

    def validate(self, check: Callable[[bool, str], None], name: str) -> None:
        check(self.retained_bytes == sum(out.size for out in self.retained), f"{name}: retained bytes do not add up")
        seqs = [out.seq for out in self.retained]
        check(seqs == sorted(set(seqs)), f"{name}: retained messages are out of order")
        check(not seqs or seqs[0] > self.watermark, f"{name}: a delivered message is retained")
        check(not seqs or seqs[-1] < self.next_seq, f"{name}: retained beyond what was submitted")
        check(
            [out for out in self.retained if not out.started] == list(self._transit.queue),
            f"{name}: queued and retained messages differ",
        )
        self._transit.validate(check, name, [out for out in self.retained if out.started])
