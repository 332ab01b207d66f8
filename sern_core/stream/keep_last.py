"""What a best-effort channel keeps: the last `depth` messages. A newer one takes the oldest one's place unless that has
begun. What a cap or a share holds back is kept while it is the newest, and goes when its time comes (`release`)."""

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import ClassVar

from sern_core.stream.gate import Gate
from sern_core.stream.out_drops import OutDrops
from sern_core.stream.out_message import BY_SEQ, OutMessage
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.stream.transit import Transit
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import DropReason


class KeepLast:
    """The messages of one best-effort channel. `gate` is None where nothing is held back."""

    __slots__ = ("_acked_seq", "_drops", "_spec", "_transit", "coalesced", "depth", "gate", "next_seq", "watermark")

    retained: ClassVar[Sequence[OutMessage]] = ()
    retained_bytes: ClassVar[int] = 0
    gaps: ClassVar[Sequence[tuple[int, int]]] = ()

    def __init__(self, spec: TopicSpec, transit: Transit, drops: OutDrops, *, first: int) -> None:
        self._spec = spec
        self._transit = transit
        self._drops = drops
        self._acked_seq = 0  # the newest message that the peer has whole
        self.next_seq = first
        self.watermark = first - 1
        self.coalesced = spec.depth == 1
        """Only the newest message counts."""
        self.depth = spec.depth
        """Messages that may wait, at most the topic's own depth (`adapt`)."""
        self.gate = None if spec.max_rate_hz is None else Gate(spec.max_rate_hz)

    # --- entry ----------------------------------------------------------------------------------------------------

    def submit(self, message: Message, now: float, *, forced: bool, unwanted: bool) -> bool:
        """Take one message, in whatever way."""
        drops = self._drops
        size = len(message.body)
        drops.counters.offer(size)
        self.next_seq = message.seq + 1
        gate = self.gate
        if gate is not None:
            gate.left_out = 0
        if unwanted:
            drops.count(message.seq, DropReason.UNWANTED, size)
            return True
        if gate is not None:
            older = gate.leave_out()
            if older is not None:
                drops.count(older.seq, DropReason.RATE_CAP, older.offered_bytes)
            if gate.holds_back(message, now, forced=forced):
                return True
        transit = self._transit
        while len(transit.queue) >= self.depth:
            drops.drop(transit.pop(), DropReason.SUPERSEDED)
        transit.append(OutMessage(message))
        return True

    def reject(self, message: Message, reason: DropReason) -> None:
        """Drop a message that cannot travel at all."""
        self._drops.counters.offer(len(message.body))
        self.next_seq = message.seq + 1
        self._drops.drop(OutMessage(message), reason)

    def prime(self, replays: Sequence[Message], now: float) -> Sequence[OutMessage]:
        """Put latched messages ahead of everything, as many as `depth` leaves room for; returns those."""
        transit, gate = self._transit, self.gate
        newest = None if gate is None else gate.newest
        limit = transit.queue[0].seq if transit.queue else newest.seq if newest is not None else self.next_seq
        fresh = [OutMessage(message) for message in replays if message.seq < limit]
        fresh = [out for out in fresh if not out.expired(self._spec.lifespan_s, now)]
        fresh = fresh[max(0, len(fresh) + len(transit.queue) - self._spec.depth) :]
        if not fresh:
            return fresh
        for out in fresh:
            out.retain_from_s = now
            self._drops.counters.offer(out.offered_bytes)
        transit.put_first(fresh)
        return fresh

    def adapt(self, share: float, depth_max: int) -> None:
        """Let in a share of the messages from the next one on, and fewer of them wait."""
        if self.gate is None and share < 1.0:
            self.gate = Gate(None)
        if self.gate is not None:
            self.gate.share = share
        self.depth = min(self._spec.depth, depth_max)

    def release(self, now: float) -> bool:
        """Let the message that was held back into the queue if its time has come. True: it did."""
        gate, drops, transit = self.gate, self._drops, self._transit
        out = None if gate is None else gate.release(now)
        if gate is None or out is None:
            return False
        if out.expired(self._spec.lifespan_s, now):
            drops.drop(out, DropReason.LIFESPAN)
            return False
        gate.passed(now)
        while len(transit.queue) >= self.depth:
            drops.drop(transit.pop(), DropReason.SUPERSEDED)
        transit.append(out)
        return True

    def start_at(self, first: int) -> None:
        self.next_seq = first
        self.watermark = first - 1

    def skip_to(self, first: int) -> None:
        self.next_seq = max(self.next_seq, first)

    # --- service --------------------------------------------------------------------------------------------------

    def head(self, now: float) -> OutMessage | None:
        """The message to serve next; what has expired, or is older than what arrived, is dropped on the way."""
        transit, lifespan_s = self._transit, self._spec.lifespan_s
        while transit.active:
            out = transit.active[0]
            message = out.message
            if (
                lifespan_s is not None
                and now - message.born_s + message.error_s > lifespan_s
                and not message.drop_marker
            ):
                self.give_up_begun(out, DropReason.LIFESPAN)
            elif out.seq < self._acked_seq:
                self.give_up_begun(out, DropReason.SUPERSEDED)
            else:
                return out
        if not transit.queue:
            return None
        out = transit.queue[0]
        message = out.message
        if lifespan_s is None or now - message.born_s + message.error_s <= lifespan_s or message.drop_marker:
            return out
        self._drop_expired(now)
        return transit.queue[0] if transit.queue else None

    def _drop_expired(self, now: float) -> None:
        """Drop the oldest that have waited too long, together."""
        transit, lifespan_s = self._transit, self._spec.lifespan_s
        gone: list[OutMessage] = []
        while transit.queue and transit.queue[0].expired(lifespan_s, now):
            gone.append(transit.pop())
        transit.uncode(gone)
        self._drops.drop_all(gone, DropReason.LIFESPAN)

    def give_up(self, out: OutMessage, reason: DropReason) -> None:
        """Give up the message that would go next."""
        if out.started:
            self.give_up_begun(out, reason)
        else:
            self._drops.drop(self._transit.pop(), reason)

    def give_up_begun(self, out: OutMessage, reason: DropReason) -> None:
        """Give up a message of which something was sent already."""
        transit = self._transit
        del transit.flying[out.seq]
        transit.deactivate(out)
        self._drops.drop(out, reason)

    def shed(self, room_bytes: int, reason: DropReason) -> int:
        """Give up what has not been begun, the oldest first."""
        transit = self._transit
        given_up: deque[OutMessage] = deque()
        freed_bytes = 0
        while freed_bytes < room_bytes and transit.queue:
            out = transit.pop()
            given_up.append(out)
            freed_bytes += out.size + CLIENT_OVERHEAD_BYTES
        transit.uncode(given_up)
        self._drops.drop_all(list(given_up), reason)
        if freed_bytes < room_bytes:
            newest = self._drop_newest(reason)
            if newest is not None:
                freed_bytes += newest.size + CLIENT_OVERHEAD_BYTES
        return freed_bytes

    def _drop_newest(self, reason: DropReason) -> OutMessage | None:
        """Drop what is held back; returns what was."""
        out = None if self.gate is None else self.gate.take_newest()
        if out is not None:
            self._drops.drop(out, reason)
        return out

    # --- outcomes -------------------------------------------------------------------------------------------------

    def arrived(self, out: OutMessage) -> None:
        """The peer has the whole message."""
        self._drops.counters.deliver(out.offered_bytes)
        if out.seq > self._acked_seq:
            self._acked_seq = out.seq

    def unwanted_again(self, out: OutMessage, now: float) -> DropReason | None:
        """Why a message that lost a fragment is not sent again; None if it is."""
        if out.expired(self._spec.lifespan_s, now):
            return DropReason.LIFESPAN
        transit = self._transit
        fresher = bool(transit.queue) or transit.begun_seq > out.seq
        # Behind a newer one it would be dropped on arrival; of a coalesced topic only the newest counts, unless most
        # of a large one may have arrived.
        if out.seq < self._acked_seq or (self.coalesced and fresher and not out.ranges and not out.some_acked):
            return DropReason.SUPERSEDED
        return None

    def recoded(self, grown_bytes: int) -> None:
        """A body is longer by so much: nothing but the queue counts them."""

    def delivered_to(self, watermark: int) -> int:
        """Nothing waits for the peer's watermark here."""
        self.watermark = max(self.watermark, watermark)
        return 0

    def sweep(self, now: float, *, up: bool, room: int) -> int:
        """Drop what has expired. Nothing of it counts against `room`, nor does it matter whether the link is `up`."""
        gate, transit, lifespan_s = self.gate, self._transit, self._spec.lifespan_s
        if gate is not None and gate.newest is not None and gate.newest.expired(lifespan_s, now):
            self._drop_newest(DropReason.LIFESPAN)
        if lifespan_s is not None:
            self._drop_expired(now)
            while transit.active and transit.active[0].expired(lifespan_s, now):
                self.give_up_begun(transit.active[0], DropReason.LIFESPAN)
        return 0

    def restart(self, *, alone: bool) -> None:
        """The peer is a new process: what was under way waits again, as much as `depth` allows. It matters to none
        whether it is `alone`."""
        transit, depth = self._transit, self._spec.depth
        again = sorted(transit.flying.values(), key=BY_SEQ)
        again += transit.queue
        for out in again[: max(0, len(again) - depth)]:
            self._drops.drop(out, DropReason.SUPERSEDED)
        transit.restart(again[-depth:])
        self._acked_seq = 0

    def clear(self, reason: DropReason) -> int:
        """Drop all that is left; returns in how many runs."""
        transit = self._transit
        left = [*transit.flying.values(), *transit.queue]
        transit.uncode(left)
        runs = self._drops.drop_all([out for out in left if not out.counted], reason)
        self._drop_newest(reason)
        transit.let_go()
        return runs

    # --- accounting -----------------------------------------------------------------------------------------------

    @property
    def kept(self) -> int:
        return self.unbegun + len(self._transit.flying)

    @property
    def unbegun(self) -> int:
        """How many messages wait of which nothing was sent, that which is held back included."""
        return len(self._transit.queue) + (self.gate is not None and self.gate.newest is not None)

    @property
    def unbegun_bytes(self) -> int:
        newest = None if self.gate is None else self.gate.newest
        return self._transit.queued_bytes + (0 if newest is None else newest.size)

    @property
    def held_bytes(self) -> int:
        return self.unbegun_bytes + sum([out.size for out in self._transit.flying.values()])

    @property
    def first_seq(self) -> int:
        return min([out.seq for out in self.undelivered()], default=self.next_seq)

    def undelivered(self) -> list[OutMessage]:
        return [*self._transit.flying.values(), *self._queued()]

    def split(self) -> tuple[list[OutMessage], list[OutMessage]]:
        """What waits, and what is in flight."""
        return self._queued(), list(self._transit.flying.values())

    def _queued(self) -> list[OutMessage]:
        newest = None if self.gate is None else self.gate.newest
        return [*self._transit.queue] if newest is None else [*self._transit.queue, newest]

    def validate(self, check: Callable[[bool, str], None], name: str) -> None:
        transit, gate = self._transit, self.gate
        check(len(transit.queue) <= self._spec.depth, f"{name}: queue deeper than its depth")
        if gate is not None:
            newest = gate.newest
            check((newest is None) == (gate.newest_due_s == inf), f"{name}: a message held back has no due time")
            check(
                newest is None or all(out.seq < newest.seq for out in transit.queue),
                f"{name}: a message is held back behind a newer one",
            )
        transit.validate(check, name, sorted(transit.flying.values(), key=BY_SEQ))
        check(
            all(out.has_unsent or out.fragments_inflight > 0 for out in transit.flying.values()),
            f"{name}: a message waits for nothing",
        )
