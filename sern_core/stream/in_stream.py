"""The receiving side of a stream on one hop: reassembly, duplicates, order, drop markers.

Best effort is delivered in increasing seq (a late older sample is dropped as superseded); reliable is delivered
once and in order, a drop marker taking its message's turn. A reliable message that cannot be kept here (too late, too
large, no room) becomes a drop marker as well, and the sender is told: nothing waits for it for ever.
State is kept per `StreamId`, across sessions and peers: that is what makes "once" hold when a relay comes back as a
new process and everything is sent again.
"""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Final

from sern_core.stream.drop_reports import DropReports, UnackedReports
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import LIMITS, PeerLimits
from sern_core.vocabulary.message import COMMAND_TYPES, Message, StreamInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import DROP_CODES, DROP_REASONS, DropReason, PriorityClass
from sern_core.wire.framing import FLAG_DROP_MARKER, FLAG_REPLAY, Datagram

PARTIAL_IDLE_S: Final = 10.0
"""A half-received best-effort message with a newer one behind it that gets no fragment for so long was given up. The
newest one is waited for: on a slow link its next fragment may have to wait for much else, and its sender, told that
the others have arrived, would take it for delivered."""
MAX_PARTIALS: Final = 256
"""Half-received best-effort messages of a stream; each whole one that arrives looks through them."""
MAX_PIECES: Final = 2048
"""Pieces of a half-received message: more gaps than a sender has packets in flight, twice."""
PIECE_BYTES: Final = 128
"""What a piece of a half-received message costs beside its bytes."""
PIECES_PAID: Final = 16
"""Pieces are charged for so many at a time."""
PIECES_INCLUDED: Final = 4
"""Pieces that a half-received message may have before more are charged for."""
HELD_OVERHEAD_BYTES: Final = 1024
"""What a half-received or waiting message counts for beside its body: without it, small ones could fill the memory. It
is more than they take, since a peer ends all of them at a word, in one turn of the loop."""
TURN_US: Final = 4
"""A message that waited and has its turn, without what its owner does with it."""
STALE_US: Final = 1
LOOKED_AT_PER_US: Final = 16
"""A half-received message that will not be completed, and how many are looked through for those."""
SEEN_BITS: Final = 64
SEEN_MASK: Final = (1 << SEEN_BITS) - 1


class Partial:
    """One message of which some fragments have arrived.

    The price of a fragment is its own bytes and a bisection, in whatever order fragments come: nothing is sorted, and
    nothing is allocated for a size that is only claimed. Pieces that touch are put together when the later one is at
    most twice as long, so that a byte is moved a logarithmic number of times, and a run without gaps has a
    logarithmic number of pieces.
    """

    __slots__ = (
        "_end",
        "_missing",
        "_pieces",
        "_starts",
        "born_s",
        "codec",
        "error_s",
        "held_bytes",
        "paid_pieces",
        "stamp_ns",
        "total",
        "touched_s",
    )

    def __init__(self, total: int) -> None:
        self.total = total
        self.held_bytes = total + HELD_OVERHEAD_BYTES  # as `Reassembly` counts it
        self.paid_pieces = PIECES_INCLUDED
        self.born_s: float | None = None  # known with the first fragment
        self.error_s = 0.0
        self.codec = 0
        self.stamp_ns = 0
        self.touched_s = 0.0
        self._missing = total
        self._starts = [0]  # where each piece begins, ascending; the first may be empty
        self._pieces = [bytearray()]
        self._end = 0  # where the last piece ends

    def add(self, offset: int, data: Datagram) -> bool:
        """Take a fragment in. True: it was not the next one in order. What has arrived already stays as it is."""
        if offset == self._end:
            self._pieces[-1] += data
            size = len(data)
            self._end += size
            self._missing -= size
            return False
        self._insert(offset, data)
        return True

    def _insert(self, at: int, data: Datagram) -> None:
        """Put the parts of `data` that are missing into the gaps where they belong."""
        starts, pieces = self._starts, self._pieces
        first, end = at, at + len(data)
        index = bisect_right(starts, at) - 1
        while at < end:
            reach = starts[index] + len(pieces[index])
            following = starts[index + 1] if index + 1 < len(starts) else self.total
            if at < reach:
                at = reach
            elif at == following:
                index += 1
            else:
                stop = min(end, following)
                part = data[at - first : stop - first]
                self._missing -= len(part)
                if at == reach:
                    pieces[index] += part
                else:
                    if len(starts) >= MAX_PIECES:
                        raise WireError(f"a message of {self.total} bytes in more than {MAX_PIECES} pieces")
                    index += 1
                    starts.insert(index, at)
                    pieces.insert(index, bytearray(part))
                at = stop
                if at == following:
                    self._join(index)
        self._end = starts[-1] + len(pieces[-1])

    def _join(self, index: int) -> None:
        """Append the pieces that follow one without a gap, as long as that is cheap."""
        starts, pieces = self._starts, self._pieces
        piece = pieces[index]
        while (
            index + 1 < len(starts)
            and starts[index] + len(piece) == starts[index + 1]
            and len(pieces[index + 1]) <= 2 * len(piece)
        ):
            piece += pieces.pop(index + 1)
            del starts[index + 1]

    @property
    def pieces(self) -> int:
        return len(self._pieces)

    @property
    def complete(self) -> bool:
        return not self._missing and self.born_s is not None

    def body(self) -> bytes:
        """The whole message, once it is complete."""
        pieces = self._pieces
        return bytes(pieces[0]) if len(pieces) == 1 else b"".join(pieces)


class Reassembly:
    """Memory that half-received and waiting messages of one link may hold in all, and how much is to be reported."""

    __slots__ = (
        "behind",
        "held_bytes",
        "holders",
        "latest",
        "limit_bytes",
        "limits",
        "slice_us",
        "unacked_reports",
        "work_us",
    )

    def __init__(self, limit_bytes: int, limits: PeerLimits = LIMITS) -> None:
        self.limits = limits
        self.slice_us = limits.slice_us
        self.unacked_reports = UnackedReports(limits)
        self.limit_bytes = limit_bytes
        self.held_bytes = 0
        self.holders: OrderedDict[InStream, None] = OrderedDict()
        """Best-effort streams with half-received messages, untouched for longest first."""
        self.latest: InStream | None = None  # the last of them
        self.work_us = 0  # what the reading under way has cost so far; more than `slice_us` is enough
        self.behind: OrderedDict[InStream, None] = OrderedDict()
        """Streams with messages whose turn has come; nothing else is read before they have had it."""

    def make_room(self, nbytes: int) -> bool:
        """Take `nbytes` into account; best-effort streams untouched for longest make way. False: it is too much."""
        while self.held_bytes + nbytes > self.limit_bytes:
            if not self.holders:
                return False
            next(iter(self.holders)).evict()
        self.held_bytes += nbytes
        return True

    def touch(self, stream: "InStream") -> None:
        """A best-effort stream got a fragment of a message that it has not whole: it is the last to make way."""
        self.holders[stream] = None
        self.holders.move_to_end(stream)
        self.latest = stream

    def gone(self, stream: "InStream") -> None:
        """A stream has no half-received messages any more."""
        self.holders.pop(stream, None)
        if self.latest is stream:
            self.latest = None


Deliver = Callable[["InStream", Message], None]
OnInDrop = Callable[["InStream", DropReason, int, Sequence[int], bool], None]
"""`on_drop(stream, reason, nbytes, seqs, reported)`, `nbytes` of all of them together. `reported`: drop markers follow,
for these are reliable messages that were given up here."""


class InStream:
    """One stream as it arrives. `delivered` is the highest seq up to which everything has had its turn."""

    # Seldom set: there are thousands of streams.
    _stale: list[int] | None = None  # half-received and below `_first`
    _first = 0  # nothing below it will come; 0: that is done
    left_out = 0
    """How many messages the last `skip_to` leaves out, once nothing of the stream is behind any more."""

    def __init__(
        self, stream: StreamInfo, reassembly: Reassembly, deliver: Deliver, on_drop: OnInDrop, *, first: int
    ) -> None:
        self.stream = stream
        self.reliable = stream.spec.reliable
        self.lifespan_s = stream.spec.lifespan_s
        control = stream.spec.priority is PriorityClass.CONTROL
        command = plain_type(stream.info.type_name) in COMMAND_TYPES
        self.perishable = control and not self.reliable and self.lifespan_s is not None
        """A command or a pose: nobody shall have it too late."""
        self.newest_alone = self.perishable and stream.spec.depth == 1 and command
        """The robot gets the newest of commands that come together: after an outage there is no burst of them."""
        self.delivered = first - 1
        self.confirmed = first - 1  # what the peer was told (`StreamsIn.confirm`)
        self.unhandled = 0  # the first seq that had its turn and is still being decoded; 0: none
        self.channel_id: int | None = None  # in the session
        self.wanted = True  # what the peer was told
        self.paused = False  # it was not wanted, and the peer has not said yet where it goes on
        self.pause_seq = 0  # the control message of the session that said so
        self.known = False  # something has had its turn, or an earlier session announced it: a gap is then a gap
        self.reports = DropReports(reassembly.unacked_reports)  # drops that the peer may not know of yet
        self._seen = 0  # best effort: bit i set when seq delivered-1-i arrived
        self._partials: dict[int, Partial] = {}  # best effort: untouched for longest first
        self._lowest = 0  # no half-received message has a seq below it
        self._waiting: dict[int, Message] = {}
        self._order: list[int] = []  # a heap of their seqs
        self._reassembly = reassembly
        self._deliver = deliver
        self._on_drop = on_drop
        self._now = 0.0

    def skip_to(self, first: int, now: float) -> None:
        """The sender says that nothing below `first` will come. `left_out` counts the messages that this leaves out;
        what waited may have its turn later (`Reassembly.behind`)."""
        self.left_out = 0
        if first - 1 <= self.delivered or not self.reliable:
            return
        self._now = now
        self.left_out = first - 1 - self.delivered
        self._first = first
        if self._partials and self._lowest < first:
            self._reassembly.work_us += len(self._partials) // LOOKED_AT_PER_US
            self._stale = [seq for seq in self._partials if seq < first]
            self._lowest = first
        self._advance()

    def fragment(
        self,
        flags: int,
        seq: int,
        offset: int,
        total: int,
        body: Datagram,
        stamp_ns: int,
        born_s: float,
        error_s: float,
        now: float,
        codec: int = 0,
    ) -> None:
        """One fragment arrived; `seq` is widened already; `born_s`, `error_s` and `codec` hold for offset 0 only."""
        self._now = now
        if seq <= self.delivered:
            self._late(seq, len(body))
            return
        if self._partials and (flags & FLAG_DROP_MARKER or len(body) == total):
            self._discard_partial(seq)
        if self._waiting and seq in self._waiting:
            self._on_drop(self, DropReason.DUPLICATE, len(body), (seq,), False)
            return
        if flags & FLAG_DROP_MARKER:
            code = body[0] if body[0] in DROP_REASONS else DROP_CODES[DropReason.LOST]
            self._arrived(Message(self.stream.id, seq, bytes(body), stamp_ns, born_s, code))
            return
        replay = bool(flags & FLAG_REPLAY)
        if len(body) == total:
            self._arrived(Message(self.stream.id, seq, bytes(body), stamp_ns, born_s, 0, replay, error_s, codec))
            return
        partial = self._partials.get(seq)
        if partial is None or partial.total != total:
            self._discard_partial(seq)
            if not self.reliable and len(self._partials) >= MAX_PARTIALS:
                self.evict()
            if not self._reassembly.make_room(total + HELD_OVERHEAD_BYTES):
                self.give_up(seq, DropReason.REASSEMBLY, len(body), now)
                return
            if not self._partials or seq < self._lowest:
                self._lowest = seq
            partial = self._partials[seq] = Partial(total)
        elif not self.reliable and len(self._partials) > 1:
            self._partials[seq] = self._partials.pop(seq)  # the last to be evicted
        if not self.reliable and self._reassembly.latest is not self:
            self._reassembly.touch(self)
        partial.touched_s = now
        try:
            separate = partial.add(offset, body)
        except MemoryError:  # the machine has less than our own bound
            self._discard_partial(seq)
            self.give_up(seq, DropReason.REASSEMBLY, total, now)
            return
        if separate and partial.pieces > partial.paid_pieces and not self._pay(seq, partial):
            return
        if offset == 0:
            partial.born_s, partial.error_s, partial.stamp_ns = born_s, error_s, stamp_ns
            partial.codec = codec
        if partial.complete:
            assert partial.born_s is not None
            self._discard_partial(seq)
            self._arrived(
                Message(
                    self.stream.id,
                    seq,
                    partial.body(),
                    partial.stamp_ns,
                    partial.born_s,
                    0,
                    replay,
                    partial.error_s,
                    partial.codec,
                )
            )

    def _check_reports_read(self) -> None:
        if self.channel_id is not None:  # not of the control stream
            self._reassembly.unacked_reports.check(self._now)

    def _pay(self, seq: int, partial: Partial) -> bool:
        """Take the pieces of a message into account. False: there was no room for them, and it is lost."""
        nbytes = PIECES_PAID * PIECE_BYTES
        if self._reassembly.make_room(nbytes):
            if self._partials.get(seq) is partial:
                partial.held_bytes += nbytes
                partial.paid_pieces += PIECES_PAID
                return True
            self._reassembly.held_bytes -= nbytes  # it made way itself
            return False
        self._discard_partial(seq)
        self.give_up(seq, DropReason.REASSEMBLY, partial.total, self._now)
        return False

    def give_up(self, seq: int, reason: DropReason, nbytes: int, now: float) -> None:
        """Message `seq` cannot be taken: best effort loses it, of a reliable stream a drop marker takes its turn."""
        self._now = now
        if seq <= self.delivered or seq in self._waiting:
            return
        if not self.reliable:
            self._on_drop(self, reason, nbytes, (seq,), False)
            return
        if self._reassembly.unacked_reports.crowded:
            self._check_reports_read()
        self._on_drop(self, reason, nbytes, (seq,), True)
        self._arrived(self.drop_marker(seq, reason, 0, now))

    def fail(self, seq: int, nbytes: int, now: float) -> None:
        """Message `seq` met an error of ours: it is given up, and what waited behind it goes on."""
        self._discard_partial(seq)
        self.give_up(seq, DropReason.FAULT, nbytes, now)
        self._advance()

    def drop_marker(self, seq: int, reason: DropReason, stamp_ns: int, born_s: float) -> Message:
        """What takes the turn of a reliable message that was dropped."""
        code = DROP_CODES[reason]
        return Message(self.stream.id, seq, bytes([code]), stamp_ns, born_s, code)

    def evict(self) -> None:
        """Lose the half-received best-effort message that was untouched for longest."""
        self._lose(next(iter(self._partials)), DropReason.REASSEMBLY)

    def _lose(self, seq: int, reason: DropReason) -> None:
        self._on_drop(self, reason, self._partials[seq].total, (seq,), False)
        self._discard_partial(seq)

    def _discard_partial(self, seq: int) -> None:
        partial = self._partials.pop(seq, None) if self._partials else None
        if partial is not None:
            self._reassembly.held_bytes -= partial.held_bytes
            if not self._partials:
                self._reassembly.gone(self)

    def _late(self, seq: int, size: int) -> None:
        if self.reliable:
            self._on_drop(self, DropReason.DUPLICATE, size, (seq,), False)
            return
        bit = self.delivered - 1 - seq
        if seq == self.delivered or (0 <= bit < SEEN_BITS and self._seen >> bit & 1):
            self._on_drop(self, DropReason.DUPLICATE, size, (seq,), False)
        else:
            if 0 <= bit < SEEN_BITS:
                self._seen |= 1 << bit
            self._on_drop(self, DropReason.SUPERSEDED, size, (seq,), False)

    def _arrived(self, message: Message) -> None:
        seq = message.seq
        if not self.reliable:
            ahead = seq - self.delivered
            if ahead == 1:
                self._seen = (self._seen << 1 | 1) & SEEN_MASK
            else:
                self._seen = (self._seen << ahead | 1 << (ahead - 1)) & SEEN_MASK if ahead <= SEEN_BITS else 0
            self.delivered = seq
            if self._partials and self._lowest <= seq:
                for stale in [s for s in self._partials if s <= seq]:
                    self._lose(stale, DropReason.LOST)
                    if 0 <= seq - 1 - stale < SEEN_BITS:
                        self._seen |= 1 << (seq - 1 - stale)  # the rest of it is no news
                self._lowest = min(self._partials, default=0)
            self._turn(message)
            return
        if self._reassembly.unacked_reports.crowded:
            self._check_reports_read()
        if seq == self.delivered + 1:
            self.delivered = seq
            self._turn(message)
            if self._waiting:
                self._advance()
            return
        size = len(message.body)
        if not self._reassembly.make_room(size + HELD_OVERHEAD_BYTES):
            # Without the message before it this one cannot be kept; its drop marker can.
            if not message.drop_marker:
                self._on_drop(self, DropReason.REASSEMBLY, size, (seq,), True)
                message = self.drop_marker(seq, DropReason.REASSEMBLY, message.stamp_ns, message.born_s)
            if not self._reassembly.make_room(len(message.body) + HELD_OVERHEAD_BYTES):
                raise WireError(f"more messages out of order than {self._reassembly.limit_bytes} bytes hold")
        self._waiting[seq] = message
        heappush(self._order, seq)

    def go_on(self, now: float) -> None:
        """Go on with the messages whose turn has come."""
        self._now = now
        self._advance()

    def _advance(self) -> None:
        """Hand out what waited and waits for nothing more, at most so much that others do not wait for it."""
        reassembly, order = self._reassembly, self._order
        while True:
            stale = self._stale
            below = bool(order) and order[0] < self._first
            if not stale and not below:
                if self._first:
                    self.delivered, self._first = max(self.delivered, self._first - 1), 0
                if not order or order[0] != self.delivered + 1:
                    reassembly.behind.pop(self, None)
                    return
            if reassembly.work_us > reassembly.slice_us:
                reassembly.behind[self] = None
                return
            if stale:
                self._discard_partial(stale.pop())
                reassembly.work_us += STALE_US
            else:
                self._stale = None
                self.left_out -= below
                self._take_turn()

    def _take_turn(self) -> None:
        """The lowest of the messages that waited for those before them."""
        seq = heappop(self._order)
        message = self._waiting.pop(seq)
        self._reassembly.held_bytes -= len(message.body) + HELD_OVERHEAD_BYTES
        self._reassembly.work_us += TURN_US
        self.delivered = seq
        self._turn(message)

    def _turn(self, message: Message) -> None:
        lifespan_s = self.lifespan_s
        if (
            lifespan_s is not None
            and not message.drop_marker
            and self._now - message.born_s + message.error_s > lifespan_s
        ):
            # Late as far as can be known: where the clocks' offset is uncertain, the worst of it counts.
            size = len(message.body)
            if not self.reliable:
                self._on_drop(self, DropReason.LIFESPAN, size, (message.seq,), False)
                return
            self._on_drop(self, DropReason.LIFESPAN, size, (message.seq,), True)
            message = self.drop_marker(message.seq, DropReason.LIFESPAN, message.stamp_ns, message.born_s)
        self.known = True
        self._deliver(self, message)

    def sweep(self, now: float, up_since_s: float) -> None:
        """Give up half-received best-effort messages that will not be completed, or not in time."""
        if not self._partials or self.reliable:
            return
        newest = max(self._partials)
        lifespan_s = self.lifespan_s
        for seq, partial in list(self._partials.items()):
            since_s = partial.born_s if partial.born_s is not None else partial.touched_s
            too_old = lifespan_s is not None and now - since_s > lifespan_s
            if too_old or (seq != newest and now - max(partial.touched_s, up_since_s) > PARTIAL_IDLE_S):
                self._lose(seq, DropReason.LOST)

    def close(self) -> None:
        """The stream ends."""
        self.forget(DropReason.DISCONNECTED)
        self.reports.clear()

    def forget(self, reason: DropReason) -> None:
        """Let go of half-received and waiting messages: the sender has given them up."""
        self._reassembly.held_bytes -= self.held_bytes
        if self._partials:
            # At once: a peer may leave a hundred thousand half sent.
            lost, self._partials = self._partials, {}
            self._reassembly.gone(self)
            self._on_drop(self, reason, sum(partial.total for partial in lost.values()), tuple(lost), False)
        self._waiting.clear()
        self._order.clear()
        self._stale = None
        self._advance()

    def _waiting_bytes(self) -> int:
        return sum(len(message.body) + HELD_OVERHEAD_BYTES for message in self._waiting.values())

    @property
    def held_bytes(self) -> int:
        """Memory of half-received and waiting messages."""
        partial_bytes = sum(partial.held_bytes for partial in self._partials.values())
        return partial_bytes + self._waiting_bytes()

    def validate(self, check: Callable[[bool, str], None]) -> None:
        name = self.stream.id.topic
        check(all(seq > self.delivered for seq in self._waiting), f"{name}: a delivered message still waits")
        check(sorted(self._order) == sorted(self._waiting), f"{name}: the order of what waits is another")
        behind = self in self._reassembly.behind
        check(all(seq > self.delivered for seq in self._partials), f"{name}: a stale partial message is kept")
        check(
            not self._partials or self._lowest <= min(self._partials.keys() - {*(self._stale or ())}, default=2**63),
            f"{name}: a half-received message lies below the lowest",
        )
        check(behind or self.delivered + 1 not in self._waiting, f"{name}: a message waits for nothing")
        check(behind or not (self._stale or self._first), f"{name}: it was to go on at {self._first}")
        check(not self._partials.keys() & self._waiting.keys(), f"{name}: a whole message is half-received as well")
        self.reports.validate(check, name)
        check(self.confirmed <= self.delivered, f"{name}: more was confirmed than had its turn")
