"""The sending side of one stream on one hop: its bounded queue, what is in flight, and what must be kept.

Best effort: keep-last `depth`, a newer message takes the oldest one's place unless that has begun transmission. What a
rate cap holds back is kept while it is the newest, and goes when its time comes (`release`).
Reliable: every message is kept until the peer's delivered watermark passes it, or until its lifespan or retention
ends, when a one-byte tombstone takes its place so that order survives and nothing is lost silently. Overflow of a
reliable queue is refused to the caller.

A message is in exactly one of four places: queued (nothing sent yet), in flight (begun), delivered, dropped for a
reason. `OutChannel.validate` checks that the counters agree.
"""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice, pairwise
from math import inf
from operator import attrgetter
from typing import Any, Final

from sern_core.stream.coding import ChannelCodec, Coding
from sern_core.stream.out_message import OutMessage, in_sequence
from sern_core.stream.rate_cap import RateCap
from sern_core.vocabulary.ledger import LOSSES, SendCounters
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DROP_REASONS, DropReason

MESSAGE_OVERHEAD_BYTES: Final = 768
"""What a retained message counts for beside its body: what its objects take, up to the next multiple of 256. Else the
bound of a stream of many small ones would bound neither memory nor what their end costs. CPython 3.11 takes 420 bytes
for one of two bytes that waits, and 600 while it is in flight, of which 170 and 350 are for each receiver."""

CLIENT_OVERHEAD_BYTES: Final = 2048
"""What it counts for, beside its body, in the bound of all that waits for one client. That is more than it takes: a
client ends all that waits for it at a word, in one turn of the loop, and 64,000 messages are what ends in 20 ms."""

GIVEN_UP_US: Final = 3
"""What giving up one message, and telling its origin, is charged with to whoever sets it off
(`Reassembly.work_us`)."""

CLEARED_PER_US: Final = 2
"""Messages of a run that are given up at once and told of together: what they are charged with beside `GIVEN_UP_US` for
the run."""

FEW: Final = 16
"""Up to so many messages that are confirmed are let go of one by one: that is what happens all the time."""

SHARE_HOLD_S: Final = 1.0
"""The longest that the newest message is held back by a `share`."""

LAPSED_A_SWEEP: Final = 1_000
"""Messages of a link that are given up in one sweep: some milliseconds."""

SEEN_PER_LAPSED: Final = 8
"""Messages that a sweep looks at and keeps, for one that it gives up, in the price of the sweep."""

OnDrop = Callable[["OutChannel", Sequence[OutMessage], DropReason], None]
"""`on_drop(channel, outs, reason)`: these messages, in their order, are counted as dropped now. Of a reliable stream
what lies between two of them was dropped before, or never comes: the whole span may be told onwards."""

_NOTHING: Final[Any] = ()
"""Where nothing waits: an empty deque takes 760 bytes, and most channels of most subscribers are quiet."""
_NO_CAP: Final = RateCap(None)
_NEVER: Final = -inf
_SEQ: Final = attrgetter("seq")


class OutChannel:
    """One stream towards one peer. The link serves it through `head` and `sent`; `slot` is its scheduler slot."""

    __slots__ = (
        "_arrived_s",
        "_buried_to",
        "_cap",
        "_owed_share",
        "_replays_buried_to",
        "_replays_to",
        "_settled_to",
        "acked_seq",
        "active",
        "begun_seq",
        "coalesced",
        "codec",
        "counters",
        "depth",
        "flying",
        "gaps",
        "last_sent_s",
        "left_out",
        "live_from",
        "newest",
        "newest_due_s",
        "newest_thinned",
        "next_seq",
        "offered",
        "on_count",
        "on_drop",
        "owed",
        "queue",
        "queued_bytes",
        "ready",
        "reliable",
        "retained",
        "retained_bytes",
        "share",
        "slot",
        "spec",
        "stream",
        "thinned",
        "wanted",
        "watermark",
    )

    def __init__(self, slot: int, stream: StreamInfo, counters: SendCounters, on_drop: OnDrop, *, first: int) -> None:
        self.slot = slot
        self.stream = stream
        self.spec = stream.spec
        self.counters = counters
        self.on_drop = on_drop
        self.reliable = stream.spec.reliable
        self.coalesced = not self.reliable and stream.spec.depth == 1
        self.queue: deque[OutMessage] = _NOTHING  # not begun
        self.active: list[OutMessage] = []  # begun, with bytes still to send; oldest first
        self.flying: dict[int, OutMessage] = {}  # begun, by seq, until acknowledged or given up
        self.retained: deque[OutMessage] = _NOTHING  # reliable: everything above the watermark
        self.retained_bytes = 0
        self.queued_bytes = 0
        self.watermark = first - 1
        self.acked_seq = 0  # best effort: the newest message that the peer has whole
        self.begun_seq = 0
        self.next_seq = first  # the next seq expected from `submit`
        self.live_from = 0  # what is kept below it are replays, and between them lies what the peer is not owed
        self._buried_to = 0  # every message that is kept up to this seq, and is no replay, is a tombstone
        self._replays_buried_to = 0  # the same of replays
        self._replays_to = 0  # the newest that was a replay
        self._settled_to = 0  # every message that is kept up to this seq is a tombstone, or the peer has it whole
        self.last_sent_s: float | None = None
        self.share = 1.0
        """Share of the messages that are let in (`adapt`)."""
        self.depth = stream.spec.depth
        """Messages that may wait, at most the topic's own depth (`adapt`)."""
        self.thinned = 0
        """Messages that `share` left out."""
        self.newest: OutMessage | None = None
        """Best effort: the newest message, held back by `max_rate_hz` or `share` until `newest_due_s`."""
        self.newest_due_s = inf
        self.left_out = 0
        """Seq of the message that the last call left out for a newer one; 0: none."""
        self.newest_thinned = False
        self._arrived_s = _NEVER
        self._owed_share = 0.0
        self._cap = _NO_CAP if stream.spec.max_rate_hz is None else RateCap(stream.spec.max_rate_hz)
        self.wanted: bool | None = None  # None until the peer has answered
        self.ready = False  # announced in the session
        self.gaps: deque[tuple[int, int]] = _NOTHING  # reliable: after this seq, the next that will come
        self.offered = False  # the scheduler knows of a pending message
        self.owed: tuple[str, ...] = ()  # reliable subscribers behind the peer, as it told us
        self.codec: ChannelCodec | None = None  # None: bodies go as they come
        self.on_count: Callable[[int, DropReason], None] | None = None
        """Told of every drop that is counted, by seq; for audits."""

    # --- entry ------------------------------------------------------------------------------------------------

    def submit(self, message: Message, *, now: float, forced: bool = False) -> bool:
        """Take one message. False: refused (a reliable queue is full). Drops are counted and reported.

        `forced` skips the rate cap and the reliable bound: the relay's forwarding, where the origin enforces both.
        """
        counters = self.counters
        size = len(message.body)
        if self.reliable:
            if not forced and not self.has_room(size):
                counters.refuse(size)
                return False
            counters.offer(size)
            self.next_seq = message.seq + 1
            if message.seq <= self.watermark:
                counters.deliver(size)  # the peer has it already, from an earlier run of this relay
                return True
            if self.wanted is False and not self.retained:
                reason = DROP_REASONS[message.tombstone] if message.tombstone else DropReason.UNWANTED
                self._count(message.seq, reason, size)
                self.watermark = message.seq
                return True
            out = OutMessage(message)
            if message.tombstone:
                out.counted = True
                self._count(message.seq, DROP_REASONS[message.tombstone], size)
        else:
            counters.offer(size)
            self.next_seq = message.seq + 1
            if self.wanted is False:
                self._count(message.seq, DropReason.UNWANTED, size)
                return True
            if self.newest is not None:
                self._leave_out()
            if not forced and not self._cap.allows(now):
                self._hold_back(message, self._cap.next_s, thinned=False)
                return True
            if self.share < 1.0:
                gap_s, self._arrived_s = now - self._arrived_s, now
                if not self._share_allows():
                    due_s = now + min(SHARE_HOLD_S, max(2.0, 1.0 / max(self.share, 1e-3)) * gap_s)
                    self._hold_back(message, due_s, thinned=True)
                    return True
            while len(self.queue) >= self.depth:
                self._drop(self._pop_queue(), DropReason.SUPERSEDED)
            out = OutMessage(message)
        self._keep(out)
        return True

    def reject(self, message: Message, reason: DropReason) -> None:
        """Drop a message that cannot travel at all; a reliable stream goes on over its tombstone."""
        size = len(message.body)
        self.counters.offer(size)
        self.next_seq = message.seq + 1
        out = OutMessage(message)
        if not self.reliable or message.seq <= self.watermark:
            self._drop(out, reason)
            return
        self._count(message.seq, reason, size)
        out.entomb(reason)
        self._keep(out)
        self.on_drop(self, (out,), reason)

    def prime(self, replays: Sequence[Message], *, now: float) -> Sequence[OutMessage]:
        """Put latched messages (oldest first, marked as replays) ahead of everything; nothing has been sent yet.
        Returns those that are to be sent."""
        limit = self.retained[0].seq if self.retained else self.next_seq
        if not self.reliable:
            limit = self.queue[0].seq if self.queue else self.newest.seq if self.newest is not None else self.next_seq
        fresh = [OutMessage(message) for message in replays if message.seq < limit]
        fresh = [out for out in fresh if not self._expired(out, now)]
        if not self.reliable:
            fresh = fresh[max(0, len(fresh) + len(self.queue) - self.spec.depth) :]
        if not fresh:
            return fresh
        for out in fresh:
            out.retain_from_s = now
            self.counters.offer(out.offered_bytes)
            self.queued_bytes += out.size
        self.queue = deque((*fresh, *self.queue))
        if self.reliable:
            self.retained = deque((*fresh, *self.retained))
            self.retained_bytes += sum(out.size for out in fresh)
            self.watermark = fresh[0].seq - 1
            self.live_from = max(self.live_from, limit)  # also replays of an earlier time may have others between them
            self._replays_to = max(self._replays_to, fresh[-1].seq)
            self._replays_buried_to = self._settled_to = 0
            after = [*(out.seq for out in fresh[1:]), limit]
            gaps = [(out.seq, seq) for out, seq in zip(fresh, after, strict=True) if seq > out.seq + 1]
            if gaps:
                self.gaps = deque((*gaps, *self.gaps))
        return fresh

    def _hold_back(self, message: Message, due_s: float, *, thinned: bool) -> None:
        self.newest = OutMessage(message)
        self.newest_due_s = due_s
        self.newest_thinned = thinned

    def _leave_out(self) -> None:
        """A newer message came before the one that was held back could go."""
        out = self.newest
        assert out is not None
        self.newest, self.newest_due_s = None, inf
        self.thinned += self.newest_thinned
        self.left_out = out.seq
        self._count(out.seq, DropReason.RATE_CAP, out.offered_bytes)

    def release(self, now: float) -> bool:
        """Let the message that was held back into the queue if its time has come. True: it did."""
        out = self.newest
        if out is None or now < self.newest_due_s:
            return False
        self.newest, self.newest_due_s = None, inf
        if self._expired(out, now):
            self._drop(out, DropReason.LIFESPAN)
            return False
        if not self.newest_thinned:
            self._cap.allows(now)
        while len(self.queue) >= self.depth:
            self._drop(self._pop_queue(), DropReason.SUPERSEDED)
        self._keep(out)
        return True

    def _drop_newest(self, reason: DropReason) -> int:
        out = self.newest
        if out is None:
            return 0
        self.newest, self.newest_due_s = None, inf
        self._drop(out, reason)
        return out.size

    def _keep(self, out: OutMessage) -> None:
        if self.reliable:
            if self.retained is _NOTHING:
                self.retained = deque()
            self.retained.append(out)
            self.retained_bytes += out.size
        if self.queue is _NOTHING:
            self.queue = deque()
        self.queue.append(out)
        self.queued_bytes += out.size

    def _share_allows(self) -> bool:
        """Let `share` of the messages through, evenly spread."""
        self._owed_share += self.share
        if self._owed_share < 1.0:
            return False
        self._owed_share -= 1.0
        return True

    @property
    def thinnable(self) -> bool:
        """Whether messages may be left out: only the newest one counts, and none is kept for late joiners."""
        return not self.reliable and not self.spec.latched

    def adapt(self, *, share: float, depth_max: int) -> None:
        """What the adaptation allows from the next message on: a share of the messages in (0, 1], and a queue limit
        below the topic's own. Nothing that waits is dropped for it, and what may not be thinned is not."""
        if self.thinnable:
            self.share = share
            self.depth = min(self.spec.depth, depth_max)

    def _pop_queue(self) -> OutMessage:
        out = self.queue.popleft()
        self.queued_bytes -= out.size
        return out

    def _count(self, seq: int, reason: DropReason, nbytes: int) -> None:
        self.counters.drop(reason, nbytes)
        if self.on_count is not None:
            self.on_count(seq, reason)

    def _dropped(self, run: Sequence[OutMessage], reason: DropReason) -> None:
        """Count messages that are dropped together, and tell of them at once: there may be a hundred thousand."""
        self.counters.drop(reason, sum([out.offered_bytes for out in run]), len(run))
        if self.on_count is not None:
            for out in run:
                self.on_count(out.seq, reason)
        self.on_drop(self, run, reason)

    def _spans(self, lost: list[OutMessage]) -> Iterator[Sequence[OutMessage]]:
        """Messages of a reliable stream, in their order, in runs whose spans may be told onwards."""
        replays = bisect_left(lost, self.live_from, key=_SEQ) if self.live_from else 0
        if replays:
            yield from in_sequence(lost[:replays])
            lost = lost[replays:]
        if lost:
            yield lost

    def _runs(self, lost: list[OutMessage]) -> Iterator[Sequence[OutMessage]]:
        """What is left, in runs that are alike in whether they may have arrived."""
        for span in self._spans(lost):
            exposed = [out.exposed for out in span]
            if exposed.count(exposed[0]) == len(span):
                yield span
                continue
            start = 0
            for index, (one, other) in enumerate(pairwise(exposed), 1):
                if one is not other:
                    yield span[start:index]
                    start = index
            yield span[start:]

    def _uncode(self, outs: Iterable[OutMessage]) -> None:
        """Whatever another thread makes of these bodies, nobody needs it any more."""
        if self.codec is not None:
            for out in outs:
                out.coding = Coding.DONE

    def _told(self, out: OutMessage, reason: DropReason, count: int = 1) -> DropReason:
        """Whatever the reason to give up so many like this: what may have arrived must not be counted as if it had not.
        Called once for each message."""
        if not out.exposed:
            return reason
        if self.reliable and reason in LOSSES:
            self.counters.reliable_unconfirmed += count
        return DropReason.UNCONFIRMED

    def _give_up(self, lost: list[OutMessage], reason: DropReason) -> int:
        """Count what is given up and tell of it; returns in how many runs."""
        count = 0
        for run in self._runs(lost):
            self._dropped(run, self._told(run[0], reason, len(run)))
            count += 1
        return count

    def _drop(self, out: OutMessage, reason: DropReason) -> None:
        reason = self._told(out, reason)
        out.coding = Coding.DONE  # whatever another thread makes of it
        self._count(out.seq, reason, out.offered_bytes)
        self.on_drop(self, (out,), reason)

    # --- service ------------------------------------------------------------------------------------------------

    def head(self, now: float) -> OutMessage | None:
        """The message to serve next: begun ones first, then the queue; what has expired is dropped on the way."""
        while self.active:
            out = self.active[0]
            reason = self._overdue(out, now)
            if reason is not None:
                self._give_up_begun(out, reason)
            elif out.seq < self.acked_seq:
                self._give_up_begun(out, DropReason.SUPERSEDED)
            else:
                return out
        if not self.queue:
            return None
        out = self.queue[0]
        reason = self._overdue(out, now)
        if reason is None:
            return out
        if self.reliable:
            self._entomb(out, reason)
            return out
        self._drop_overdue(now)
        return self.queue[0] if self.queue else None

    def _drop_overdue(self, now: float) -> None:
        """Best effort: the oldest that have waited too long, together."""
        gone: list[OutMessage] = []
        while self.queue and self._expired(self.queue[0], now):
            gone.append(self._pop_queue())
        self._uncode(gone)
        self._give_up(gone, DropReason.LIFESPAN)

    def _overdue(self, out: OutMessage, now: float) -> DropReason | None:
        """Why a message is not to be sent any more, by time; None if it is."""
        message, spec = out.message, self.spec
        if message.tombstone:
            return None
        if self.reliable and now - out.retain_from_s > spec.retention_s:
            return DropReason.RETENTION
        late = spec.lifespan_s is not None and now - message.born_s + message.error_s > spec.lifespan_s
        return DropReason.LIFESPAN if late else None

    def _expired(self, out: OutMessage, now: float) -> bool:
        lifespan_s = self.spec.lifespan_s
        message = out.message
        return lifespan_s is not None and not message.tombstone and now - message.born_s + message.error_s > lifespan_s

    def _give_up_begun(self, out: OutMessage, reason: DropReason) -> None:
        """Give up a message of which something was sent already."""
        if self.reliable:
            # What is in flight of the old body is harmless: the receiver takes the tombstone in its place.
            self._entomb(out, reason)
            self._activate(out)
            return
        del self.flying[out.seq]
        self._deactivate(out)
        self._drop(out, reason)

    def _entomb(self, out: OutMessage, reason: DropReason) -> None:
        """A tombstone takes the place of a reliable message; it is reported unless that was done before. The tombstone
        has the reason itself: it is read by those alone who did not get the message."""
        size = out.size
        if not out.started:
            self.queued_bytes -= size - 1
        self.retained_bytes -= size - 1
        reported, told = out.counted, reason
        if not reported:
            told = self._told(out, reason)
            self._count(out.seq, told, out.offered_bytes)
        out.entomb(reason)
        if not reported:
            self.on_drop(self, (out,), told)

    def drop_head(self, reason: DropReason, now: float) -> None:
        """Give up the message that would go next (best effort); a reliable one becomes a tombstone."""
        out = self.head(now)
        if out is None or out.message.tombstone:
            return
        if out.started:
            self._give_up_begun(out, reason)
        elif self.reliable:
            self._entomb(out, reason)
        else:
            self._drop(self._pop_queue(), reason)

    def shed(self, room_bytes: int, reason: DropReason) -> int:
        """Give up messages that have not been begun, together, until `kept_bytes` is less by `room_bytes` or none is
        left. Returns by how much it is less.

        They are the oldest, of a reliable stream the newest, and the peer is told in its turn that the stream goes on
        behind them (`next_gap`).
        """
        given_up: deque[OutMessage] = deque()
        freed_bytes = 0
        while freed_bytes < room_bytes and self.queue:
            if self.reliable:
                out = self.queue.pop()
                self.retained.pop()  # what has not been begun is behind all that has been
                self.retained_bytes -= out.size
                given_up.appendleft(out)
            else:
                out = self.queue.popleft()
                given_up.append(out)
            self.queued_bytes -= out.size
            freed_bytes += out.size + CLIENT_OVERHEAD_BYTES
        if self.reliable and given_up:
            last_seq = self.retained[-1].seq if self.retained else self.watermark
            while self.gaps and self.gaps[-1][1] > last_seq:
                self.gaps.pop()
            self._add_gap(last_seq, self.next_seq)
        self._uncode(given_up)
        self._give_up([out for out in given_up if not out.counted], reason)
        if freed_bytes < room_bytes and self.newest is not None:
            freed_bytes += self._drop_newest(reason) + CLIENT_OVERHEAD_BYTES
        return freed_bytes

    def abandon(self, seq: int, reason: DropReason) -> bool:
        """Give up reliable message `seq`; a tombstone stays. False: it has been begun, or is not here."""
        for out in reversed(self.queue):
            if out.seq == seq and not out.message.tombstone:
                self._entomb(out, reason)
                return True
        return False

    def has_room(self, size_bytes: int) -> bool:
        """Whether one more reliable message keeps within the stream's bound."""
        overhead_bytes = MESSAGE_OVERHEAD_BYTES * (len(self.retained) + 1)
        return self.retained_bytes + size_bytes + overhead_bytes <= self.spec.max_queue_bytes

    @property
    def kept_bytes(self) -> int:
        """What it counts for in the bound of its client: `held_bytes`, and each message's overhead."""
        return self.held_bytes + CLIENT_OVERHEAD_BYTES * self.kept

    @property
    def kept(self) -> int:
        """How many messages wait here or are under way, tombstones included."""
        if self.reliable:
            return len(self.retained)
        return self.unbegun + len(self.flying)

    @property
    def unbegun(self) -> int:
        """How many messages wait of which nothing was sent, that which is held back included."""
        return len(self.queue) + (self.newest is not None)

    @property
    def unbegun_bytes(self) -> int:
        """Bytes of these messages."""
        return self.queued_bytes + (0 if self.newest is None else self.newest.size)

    @property
    def held_bytes(self) -> int:
        """Bytes that wait here or are under way, and would have to be sent again to a peer that has lost them."""
        if self.reliable:
            return self.retained_bytes
        return self.unbegun_bytes + sum(o.size for o in self.flying.values())

    def begin(self, out: OutMessage, now: float) -> None:
        """`out` was the head of the queue and its first bytes leave now, or once its body is encoded."""
        out.started = True
        popped = self._pop_queue()
        assert popped is out
        self.flying[out.seq] = out
        if out.has_unsent:
            self._activate(out)
        self.begun_seq = out.seq
        self.last_sent_s = now

    def take(self, out: OutMessage, room: int, now: float) -> tuple[int, int]:
        """Cut the next fragment of at most `room` body bytes: (start, end). The caller puts it on the wire."""
        if out.ranges is None:
            start, end = 0, out.size
            if end > room:
                end = room
                out.ranges = [(end, out.size)]
            else:
                out.ranges = []
        else:
            start, end = out.ranges[0]
            if end - start > room:
                out.ranges[0] = (start + room, end)
                end = start + room
            else:
                del out.ranges[0]
        if not out.started:
            self.begin(out, now)
        elif not out.ranges:
            self._deactivate(out)
        out.fragments_inflight += 1
        if end == out.size:  # fragments leave in their order, so those before it have left as well
            out.exposed = True
        return start, end

    def recoded(self, out: OutMessage, message: Message) -> None:
        """The body of `out`, of which nothing was sent yet, is another one now: encoded."""
        size = len(message.body)
        if not out.started:
            self.queued_bytes += size - out.size
        if self.reliable:
            self.retained_bytes += size - out.size
        out.message = message
        out.size = size

    # --- outcomes -----------------------------------------------------------------------------------------------

    def fragment_acked(self, out: OutMessage, generation: int) -> bool:
        """The peer has a fragment. True: with it, it has the whole message."""
        if out.generation != generation:
            return False
        out.fragments_inflight -= 1
        out.some_acked = True
        if out.fragments_inflight <= 0 and not out.has_unsent and self.flying.get(out.seq) is out:
            del self.flying[out.seq]
            if not self.reliable:
                self.counters.deliver(out.offered_bytes)
                if out.seq > self.acked_seq:
                    self.acked_seq = out.seq
            return True
        return False

    def fragment_lost(self, out: OutMessage, generation: int, start: int, end: int, *, now: float) -> bool:
        """A fragment did not arrive. True: it will be sent again; False: the message is no longer wanted."""
        return bool(self.fragments_lost([(out, generation, start, end)], now=now))

    def fragments_lost(self, fragments: Iterable[tuple[OutMessage, int, int, int]], *, now: float) -> list[OutMessage]:
        """Fragments (message, its generation, start, end) did not arrive: a connection may end with twenty thousand of
        them. Returns the message of each that will be sent again."""
        again: list[OutMessage] = []
        waiting: dict[int, OutMessage] = {}  # have bytes to send again, and are not in `active` yet
        for out, generation, start, end in fragments:
            if out.generation != generation:
                continue
            out.fragments_inflight -= 1
            if self.flying.get(out.seq) is not out:
                continue  # finished or dropped meanwhile
            reason = None if self.reliable else self._unwanted_again(out, now)
            if reason is not None:
                waiting.pop(out.seq, None)
                self._give_up_begun(out, reason)
                continue
            if out.ranges is None:
                out.ranges = []
            insort(out.ranges, (start, end))
            waiting[out.seq] = out
            again.append(out)
        self._activate_all(waiting.values())
        return again

    def _unwanted_again(self, out: OutMessage, now: float) -> DropReason | None:
        """Why a best-effort message that lost a fragment is not sent again; None if it is."""
        if self._expired(out, now):
            return DropReason.LIFESPAN
        fresher = bool(self.queue) or self.begun_seq > out.seq
        # Behind a newer one it would be dropped on arrival; of a coalesced topic only the newest counts, unless most
        # of a large one may have arrived.
        if out.seq < self.acked_seq or (self.coalesced and fresher and not out.ranges and not out.some_acked):
            return DropReason.SUPERSEDED
        return None

    def _activate(self, out: OutMessage) -> None:
        """A begun message has bytes to send (again): put it back in its place."""
        self.flying[out.seq] = out
        if not out.active:
            out.active = True
            insort(self.active, out, key=_SEQ)

    def _activate_all(self, outs: Iterable[OutMessage]) -> None:
        """The same of many, each once."""
        fresh = []
        for out in outs:
            self.flying[out.seq] = out
            if not out.active:
                out.active = True
                fresh.append(out)
        if len(fresh) == 1:
            insort(self.active, fresh[0], key=_SEQ)
        elif fresh:
            fresh.sort(key=_SEQ)
            behind = not self.active or self.active[-1].seq < fresh[0].seq
            self.active += fresh
            if not behind:
                self.active.sort(key=_SEQ)  # two runs in order, which are merged in one go

    def _deactivate(self, out: OutMessage) -> None:
        """It has no more bytes to send, or is given up."""
        if out.active:
            out.active = False
            del self.active[bisect_left(self.active, out.seq, key=_SEQ)]

    def _deactivate_all(self) -> None:
        for out in self.active:
            out.active = False
        self.active.clear()

    def delivered_to(self, watermark: int) -> int:
        """The peer's delivered watermark moved: reliable messages up to it are done. Returns how many were kept."""
        if watermark <= self.watermark:
            return 0
        self.watermark = watermark
        retained = self.retained
        before = len(retained)
        if before > FEW and retained[FEW].seq <= watermark:
            done = self._take_out()
            sizes = [out.offered_bytes for out in done if not out.counted]
            self.counters.deliver(sum(sizes), len(sizes))
            return len(done)
        while retained and retained[0].seq <= watermark:
            out = retained.popleft()
            self.retained_bytes -= out.size
            if not out.counted:
                self.counters.deliver(out.offered_bytes)
            self._forget(out)
        return before - len(retained)

    def _take_out(self) -> Sequence[OutMessage]:
        """Take the reliable messages up to the watermark out of wherever they are, at once: a peer may confirm a
        hundred thousand with one number."""
        watermark, retained = self.watermark, self.retained
        if retained[-1].seq <= watermark:
            self._uncode(retained)
            self._let_go()
            return retained
        done = [retained.popleft() for _ in range(bisect_right(retained, watermark, key=_SEQ))]
        self._uncode(done)
        self.retained_bytes -= sum([out.size for out in done])
        for out in done:
            self.flying.pop(out.seq, None)  # not by a look at all: a peer may confirm them by twenty
        begun = bisect_right(self.active, watermark, key=_SEQ)
        for out in self.active[:begun]:
            out.active = False
        del self.active[:begun]
        queue = self.queue
        if queue and queue[0].seq <= watermark:
            waited = [queue.popleft() for _ in range(bisect_right(queue, watermark, key=_SEQ))]
            self.queued_bytes -= sum([out.size for out in waited])
        return done

    def _let_go(self) -> None:
        """Nothing is left."""
        if self.reliable:
            self.retained = _NOTHING
            self.retained_bytes = 0
        self.flying.clear()
        self._deactivate_all()
        self.queue = _NOTHING
        self.queued_bytes = 0

    def settle(self) -> None:
        """Let go of reliable messages that the peer has whole, in order: for a stream without a watermark."""
        while self.retained and self.retained[0].started and self.retained[0].seq not in self.flying:
            self.delivered_to(self.retained[0].seq)

    def skip_to(self, first: int) -> None:
        """Nothing from `next_seq` up to `first` will come; the peer is told in its turn (`next_gap`)."""
        if first > self.next_seq:
            if self.gaps and self.gaps[-1][1] == self.next_seq:  # nothing was kept since that gap
                self.gaps[-1] = (self.gaps[-1][0], first)
            else:
                self._add_gap(self.next_seq - 1, first)
            self.next_seq = first

    def _add_gap(self, last_seq: int, first: int) -> None:
        if self.gaps is _NOTHING:
            self.gaps = deque()
        self.gaps.append((last_seq, first))

    def leave_out(self, message: Message, reason: DropReason) -> None:
        """There is no room for this reliable message, nor for a tombstone: the stream goes on behind it."""
        size = len(message.body)
        self.counters.offer(size)
        if message.seq <= self.watermark:
            self.counters.deliver(size)
        elif message.tombstone:
            self._count(message.seq, message.drop_reason, size)  # reported where it was dropped
        else:
            self._count(message.seq, reason, size)
            self.on_drop(self, (OutMessage(message),), reason)
        self.skip_to(message.seq + 1)

    def start_at(self, first: int) -> None:
        """Nothing has been submitted yet: begin at seq `first` instead."""
        self.gaps = _NOTHING
        self.next_seq = first
        self.watermark = first - 1

    def next_gap(self) -> int | None:
        """The seq to go on at, once everything before the gap is delivered; each gap is given out once."""
        first = None
        while self.gaps and self.watermark >= self.gaps[0][0]:
            first = self.gaps.popleft()[1]
            self.watermark = max(self.watermark, first - 1)
        return first

    def _forget(self, out: OutMessage) -> None:
        """Take a reliable message out of wherever it still is."""
        out.coding = Coding.DONE
        if not out.started:
            self.queue.remove(out)
            self.queued_bytes -= out.size
        else:
            if self.flying.get(out.seq) is out:
                del self.flying[out.seq]
            self._deactivate(out)

    def reported(self, seq: int, reason: DropReason, where: str = "", count: int = 1) -> int:
        """A later hop dropped `count` messages from `seq` on, for the client `where`, and said so before its watermark
        passed them. Returns what that costs, in microseconds."""
        retained = self.retained
        start, end = bisect_left(retained, seq, key=_SEQ), bisect_left(retained, seq + count, key=_SEQ)
        news = [out for out in islice(retained, start, end) if not out.counted]
        for out in news:
            out.counted = True
            out.lost_to = where
        work_us = len(news) // CLEARED_PER_US
        for run in self._spans(news):
            self._dropped(run, reason)
            work_us += GIVEN_UP_US
        return work_us

    def sweep(self, now: float, *, up: bool, room: int = LAPSED_A_SWEEP) -> int:
        """Expire what nobody will send: lifespan and retention, also while the link is down.

        Of a reliable stream at most `room` messages are given up; `SEEN_PER_LAPSED` that are looked at and stay count
        like one. Returns how many that makes. As many as there was room for: sweep again soon, there may be more.
        Nothing of that is sent meanwhile (`head`).
        """
        if not self.reliable:
            if self.newest is not None and self._expired(self.newest, now):
                self._drop_newest(DropReason.LIFESPAN)
            if self.spec.lifespan_s is not None:
                self._drop_overdue(now)
                while self.active and self._expired(self.active[0], now):
                    self._give_up_begun(self.active[0], DropReason.LIFESPAN)
            return 0
        spent = 0
        if not up and self.retained:
            spent = self._leave_behind(now, room)
        if self.retained and spent < room:
            spent += self._bury(now, room - spent)
        return spent

    def _lapsed(self, out: OutMessage, now: float) -> DropReason | None:
        """Why a reliable message that is no tombstone is to be given up now; None if it is not."""
        if now - out.retain_from_s > self.spec.retention_s:
            return DropReason.RETENTION
        # Lifespan stops a message from being sent; once the peer has it whole, the peer watches it.
        if self._expired(out, now) and (out.has_unsent or out.fragments_inflight > 0):
            return DropReason.LIFESPAN
        return None

    def _bury(self, now: float, room: int) -> int:
        """Put tombstones in the places of reliable messages that have lapsed. What stays was looked at once: those that
        the peer has whole have their retention left, which ends in their order, and are sent again only to another
        process there (`peer_restarted`)."""
        spent = 0
        if self._replays_to > self.watermark:  # they are kept from later on than what is behind them
            spent, self._replays_buried_to = self._bury_behind(self._replays_buried_to, now, room, None)
        if spent < room:
            behind = max(self._buried_to, self._replays_to)
            more, self._buried_to = self._bury_behind(behind, now, room - spent, None)
            spent += more
        if spent < room and self.spec.lifespan_s is not None:
            more, self._settled_to = self._bury_behind(self._settled_to, now, room - spent, self.spec.lifespan_s)
            spent += more
        return spent

    def _bury_behind(self, seq: int, now: float, room: int, lifespan_s: float | None) -> tuple[int, int]:
        """The same behind `seq`, up to the first whose retention or lifespan is not over. Returns what of `room` it
        took, and the seq that it came to."""
        retained, retention_s = self.retained, self.spec.retention_s
        start = 0 if seq <= self.watermark else bisect_right(retained, seq, key=_SEQ)
        if start == len(retained) or self._young(retained[start], now, lifespan_s):
            return 0, seq  # most often, and it takes no walk to the start
        runs: list[tuple[DropReason | None, list[OutMessage]]] = []
        known: DropReason | None = None
        count = seen = 0
        for out in islice(retained, start, None):
            if count + seen // SEEN_PER_LAPSED >= room or self._young(out, now, lifespan_s):
                break
            if out.message.tombstone:
                seen += 1
            else:
                reason: DropReason | None = None
                if now - out.retain_from_s > retention_s:
                    reason = DropReason.RETENTION
                elif out.ranges or out.ranges is None or out.fragments_inflight > 0:
                    reason = DropReason.LIFESPAN
                if reason is None:
                    seen += 1
                else:
                    if reason is not known:
                        runs.append((reason, []))
                    runs[-1][1].append(out)
                    count += 1
                known = reason  # a span has none in it that goes on
            seq = out.seq
        for why, run in runs:
            assert why is not None
            self._entomb_all(run, why)
        return count + seen // SEEN_PER_LAPSED, seq

    def _young(self, out: OutMessage, now: float, lifespan_s: float | None) -> bool:
        """Whether a reliable message is no tombstone, and its lifespan, or without one its retention, goes on. They are
        in the order of their birth, and but for replays in that of their retention."""
        message = out.message
        if message.tombstone:
            return False
        if lifespan_s is None:
            return now - out.retain_from_s <= self.spec.retention_s
        return now - message.born_s + message.error_s <= lifespan_s

    def _entomb_all(self, outs: list[OutMessage], reason: DropReason) -> None:
        """Tombstones take the places of reliable messages. Those that were not counted are told of together."""
        lost = [out for out in outs if not out.counted]
        told = [(run, self._told(run[0], reason, len(run))) for run in self._runs(lost)]
        for out in outs:
            freed_bytes = out.size - 1
            self.retained_bytes -= freed_bytes
            if not out.started:
                self.queued_bytes -= freed_bytes
            out.entomb(reason)
        self._activate_all([out for out in outs if out.started])
        for run, why in told:
            self._dropped(run, why)

    def _leave_behind(self, now: float, room: int) -> int:
        """Without a session the oldest that have lapsed leave nothing behind: there is nobody to tell, and the
        announcement of the next session starts behind them. Returns what of `room` it took."""
        runs: list[tuple[DropReason, list[OutMessage]]] = []
        known: DropReason | None = None
        count = seen = last_seq = 0
        for out in self.retained:
            if count + seen // SEEN_PER_LAPSED >= room:
                break
            if out.message.tombstone:
                seen += 1
            else:
                reason = self._lapsed(out, now)
                if reason is None:
                    break
                count += 1
                if not out.counted:
                    if reason is not known:
                        runs.append((reason, []))
                        known = reason
                    runs[-1][1].append(out)
            last_seq = out.seq
        if last_seq:
            self.watermark = last_seq
            self._take_out()
        for why, lost in runs:
            self._give_up(lost, why)
        return count + seen // SEEN_PER_LAPSED

    @property
    def first_seq(self) -> int:
        """The lowest seq that may still come: what an announcement promises."""
        if self.reliable:
            return self.retained[0].seq if self.retained else self.next_seq
        candidates = [out.seq for out in (*self.flying.values(), *self.queue, *filter(None, (self.newest,)))]
        return min(candidates) if candidates else self.next_seq

    def set_wanted(self, wanted: bool, reason: DropReason = DropReason.UNWANTED) -> int:
        """The peer's answer: does anybody behind it want this stream? What is left is dropped for `reason` if not.
        Returns what that costs, in microseconds."""
        self.wanted = wanted
        return 0 if wanted else self.clear(reason)

    def peer_restarted(self) -> None:
        """A new process at the other end has nothing of what we sent: everything waits to be sent again."""
        again = list(self.retained) if self.reliable else sorted(self.flying.values(), key=lambda out: out.seq)
        if self.reliable and len(self.owed) < 2:
            for out in again:  # reported as dropped to the only one who was to get it: then it shall not get it now
                if out.counted and not out.message.tombstone:
                    self.retained_bytes -= out.size - 1
                    out.entomb(DropReason.LOST)
        if not self.reliable:
            again += self.queue
            for out in again[: max(0, len(again) - self.spec.depth)]:
                self._drop(out, DropReason.SUPERSEDED)
            again = again[-self.spec.depth :]
        for out in again:
            out.restart()
            out.started = False
        self.queue = deque(again) if again else _NOTHING
        self.queued_bytes = sum(out.size for out in again)
        self.flying.clear()
        self._deactivate_all()
        self.acked_seq = self.begun_seq = self._settled_to = 0

    def clear(self, reason: DropReason) -> int:
        """The stream ends: whatever is left is dropped for `reason`. Returns what that costs, in microseconds."""
        work_us = self.kept // CLEARED_PER_US
        left = self.retained if self.reliable else [*self.flying.values(), *self.queue]
        self._uncode(left)
        work_us += GIVEN_UP_US * self._give_up([out for out in left if not out.counted], reason)
        if self.reliable:
            self.gaps = _NOTHING
            self.watermark = max(self.watermark, self.next_seq - 1)
        else:
            self._drop_newest(reason)
        self._let_go()
        return work_us

    # --- accounting -----------------------------------------------------------------------------------------------

    def undelivered(self) -> list[OutMessage]:
        """What is queued or in flight; counted tombstones are neither."""
        if self.reliable:
            return [out for out in self.retained if not out.counted]
        return [*self.flying.values(), *self.queue, *filter(None, (self.newest,))]

    def held(self) -> tuple[int, int, int, int]:
        """(messages queued, bytes queued, messages in flight, bytes in flight), bytes as they were offered; counted
        tombstones are neither."""
        if self.reliable:
            queued = [out for out in self.retained if not out.started and not out.counted]
            flying = [out for out in self.retained if out.started and not out.counted]
        else:
            queued, flying = [*self.queue, *filter(None, (self.newest,))], list(self.flying.values())
        queued_bytes, flying_bytes = sum(o.offered_bytes for o in queued), sum(o.offered_bytes for o in flying)
        return len(queued), queued_bytes, len(flying), flying_bytes

    def validate(self, check: Callable[[bool, str], None]) -> None:
        """Internal consistency; that the counters add up is checked by the link, as streams of one topic share them."""
        name = self.stream.id.topic
        check(self.queued_bytes == sum(out.size for out in self.queue), f"{name}: queued bytes do not add up")
        check(all(not out.started for out in self.queue), f"{name}: a begun message is in the queue")
        check(
            all(
                out.started and out.active and out.has_unsent and self.flying.get(out.seq) is out for out in self.active
            ),
            f"{name}: an active message was not begun, has nothing to send, or is not in flight",
        )
        if not self.reliable:
            check(len(self.queue) <= self.spec.depth, f"{name}: queue deeper than its depth")
            check((self.newest is None) == (self.newest_due_s == inf), f"{name}: a message held back has no due time")
            check(
                self.newest is None or all(out.seq < self.newest.seq for out in self.queue),
                f"{name}: a message is held back behind a newer one",
            )
            unsent = sorted((out for out in self.flying.values() if out.has_unsent), key=_SEQ)
            check(unsent == self.active, f"{name}: bytes to send are forgotten")
            check(
                all(out.has_unsent or out.fragments_inflight > 0 for out in self.flying.values()),
                f"{name}: a message waits for nothing",
            )
            return
        check(self.retained_bytes == sum(out.size for out in self.retained), f"{name}: retained bytes do not add up")
        seqs = [out.seq for out in self.retained]
        check(seqs == sorted(set(seqs)), f"{name}: retained messages are out of order")
        check(not seqs or seqs[0] > self.watermark, f"{name}: a delivered message is retained")
        check(not seqs or seqs[-1] < self.next_seq, f"{name}: retained beyond what was submitted")
        check(
            [out for out in self.retained if not out.started] == list(self.queue),
            f"{name}: queued and retained messages differ",
        )
        unsent = [out for out in self.retained if out.started and out.has_unsent]
        check(unsent == self.active, f"{name}: bytes to send are forgotten")
