"""The receiving side of a stream on one hop: reassembly, duplicates, order, tombstones.

Best effort is delivered in increasing seq (a late older sample is dropped as superseded); reliable is delivered
once and in order, a tombstone taking its message's turn. State is kept per `StreamId`, across sessions and peers:
that is what makes "once" hold when a relay comes back as a new process and everything is sent again.
"""

from collections.abc import Callable
from typing import Final

from sern_core.message import Message, StreamInfo
from sern_core.types import DROP_CODES, DROP_REASONS, DropReason
from sern_core.wire import FLAG_REPLAY, FLAG_TOMBSTONE

PARTIAL_IDLE_S: Final = 10.0
"""A half-received best-effort message that gets no fragment for so long will not be completed."""
SEEN_BITS: Final = 64


class Partial:
    """One message of which some fragments have arrived."""

    __slots__ = ("body", "born_s", "spans", "stamp_ns", "touched_s")

    def __init__(self, total: int) -> None:
        self.body = bytearray(total)
        self.spans: list[tuple[int, int]] = []  # merged [start, end) that have arrived
        self.born_s: float | None = None  # known with the first fragment
        self.stamp_ns = 0
        self.touched_s = 0.0

    def add(self, offset: int, data: bytes) -> None:
        end = offset + len(data)
        self.body[offset:end] = data
        spans = self.spans
        if spans and spans[-1][1] == offset:
            spans[-1] = (spans[-1][0], end)
            return
        spans.append((offset, end))
        if len(spans) > 1:
            spans.sort()
            merged = [spans[0]]
            for start, stop in spans[1:]:
                if start <= merged[-1][1]:
                    merged[-1] = (merged[-1][0], max(merged[-1][1], stop))
                else:
                    merged.append((start, stop))
            self.spans = merged

    @property
    def complete(self) -> bool:
        return self.born_s is not None and len(self.spans) == 1 and self.spans[0] == (0, len(self.body))


class Reassembly:
    """Memory that half-received messages of one link may hold in all."""

    __slots__ = ("held_bytes", "limit_bytes")

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.held_bytes = 0


Deliver = Callable[["InStream", Message], None]
OnInDrop = Callable[["InStream", DropReason, int], None]


class InStream:
    """One stream as it arrives. `delivered` is the highest seq up to which everything has had its turn."""

    def __init__(
        self, stream: StreamInfo, reassembly: Reassembly, deliver: Deliver, on_drop: OnInDrop, *, first: int
    ) -> None:
        self.stream = stream
        self.reliable = stream.spec.reliable
        self.lifespan_s = stream.spec.lifespan_s
        self.delivered = first - 1
        self.confirmed = first - 1  # what the peer was told (`Hop.confirm`)
        self.channel_id: int | None = None  # in this session
        self.error_s = 0.0  # uncertainty of the one-way delay, set by the hop
        self.skipped = 0  # messages that an announcement said will not come
        self._seen = 0  # best effort: bit i set when seq delivered-1-i arrived
        self._partials: dict[int, Partial] = {}
        self._waiting: dict[int, Message] = {}
        self._reassembly = reassembly
        self._deliver = deliver
        self._on_drop = on_drop
        self.last_message: Message | None = None
        self._now = 0.0

    def skip_to(self, first: int) -> int:
        """The sender says that nothing below `first` will come. Returns how many messages that leaves out."""
        left_out = first - 1 - self.delivered
        if left_out <= 0:
            return 0
        if self.reliable:
            while self.delivered < first - 1:
                self.delivered += 1
                message = self._waiting.pop(self.delivered, None)
                self._discard_partial(self.delivered)
                if message is not None:
                    left_out -= 1
                    self._turn(message)
            self._advance()
        self.skipped += left_out
        return left_out

    def fragment(
        self,
        flags: int,
        seq: int,
        offset: int,
        total: int,
        body: bytes,
        stamp_ns: int,
        born_s: float,
        now: float,
    ) -> None:
        """One fragment arrived; `seq` is widened already and `born_s` holds for offset 0 only."""
        self._now = now
        if seq <= self.delivered:
            self._late(seq, len(body))
            return
        if flags & FLAG_TOMBSTONE:
            self._discard_partial(seq)
            if seq not in self._waiting:
                code = body[0] if body[0] in DROP_REASONS else 1
                self._arrived(Message(self.stream.id, seq, body, stamp_ns, born_s, tombstone=code))
            return
        replay = bool(flags & FLAG_REPLAY)
        if len(body) == total:
            self._discard_partial(seq)
            if seq in self._waiting:
                self._on_drop(self, DropReason.DUPLICATE, total)
                return
            self._arrived(Message(self.stream.id, seq, body, stamp_ns, born_s, 0, replay))
            return
        if seq in self._waiting:
            self._on_drop(self, DropReason.DUPLICATE, len(body))
            return
        partial = self._partials.get(seq)
        if partial is None or len(partial.body) != total:
            self._discard_partial(seq)
            if not self._make_room(total):
                self._on_drop(self, DropReason.REASSEMBLY, len(body))
                return
            partial = self._partials[seq] = Partial(total)
        partial.touched_s = now
        partial.add(offset, body)
        if offset == 0:
            partial.born_s, partial.stamp_ns = born_s, stamp_ns
        if partial.complete:
            assert partial.born_s is not None
            del self._partials[seq]
            self._reassembly.held_bytes -= total
            self._arrived(
                Message(self.stream.id, seq, bytes(partial.body), partial.stamp_ns, partial.born_s, 0, replay)
            )

    def _make_room(self, total: int) -> bool:
        reassembly = self._reassembly
        while self._partials and not self.reliable and reassembly.held_bytes + total > reassembly.limit_bytes:
            oldest = min(self._partials)
            self._on_drop(self, DropReason.REASSEMBLY, len(self._partials[oldest].body))
            self._discard_partial(oldest)
        if reassembly.held_bytes + total > reassembly.limit_bytes:
            return False
        reassembly.held_bytes += total
        return True

    def _discard_partial(self, seq: int) -> None:
        partial = self._partials.pop(seq, None) if self._partials else None
        if partial is not None:
            self._reassembly.held_bytes -= len(partial.body)

    def _late(self, seq: int, size: int) -> None:
        if self.reliable:
            self._on_drop(self, DropReason.DUPLICATE, size)
            return
        bit = self.delivered - 1 - seq
        if seq == self.delivered or (0 <= bit < SEEN_BITS and self._seen >> bit & 1):
            self._on_drop(self, DropReason.DUPLICATE, size)
        else:
            if 0 <= bit < SEEN_BITS:
                self._seen |= 1 << bit
            self._on_drop(self, DropReason.SUPERSEDED, size)

    def _arrived(self, message: Message) -> None:
        seq = message.seq
        if not self.reliable:
            ahead = seq - self.delivered
            self._seen = ((self._seen << ahead) | 1 << (ahead - 1)) & (1 << SEEN_BITS) - 1
            self.delivered = seq
            for stale in [s for s in self._partials if s <= seq] if self._partials else ():
                self._on_drop(self, DropReason.SUPERSEDED, len(self._partials[stale].body))
                self._discard_partial(stale)
            self._turn(message)
            return
        if seq == self.delivered + 1:
            self.delivered = seq
            self._turn(message)
            if self._waiting:
                self._advance()
        else:
            self._waiting[seq] = message

    def _advance(self) -> None:
        while (message := self._waiting.pop(self.delivered + 1, None)) is not None:
            self.delivered = message.seq
            self._turn(message)

    def _turn(self, message: Message) -> None:
        lifespan_s = self.lifespan_s
        if lifespan_s is not None and not message.tombstone and self._now - message.born_s + self.error_s > lifespan_s:
            self._on_drop(self, DropReason.LIFESPAN, len(message.body))
            if not self.reliable:
                return
            code = DROP_CODES[DropReason.LIFESPAN]
            message = Message(message.stream, message.seq, bytes([code]), message.stamp_ns, message.born_s, code)
        self.last_message = message
        self._deliver(self, message)

    def sweep(self, now: float) -> None:
        """Give up half-received best-effort messages that nobody completes."""
        if self.reliable or not self._partials:
            return
        for seq in [seq for seq, partial in self._partials.items() if now - partial.touched_s > PARTIAL_IDLE_S]:
            self._on_drop(self, DropReason.LOST, len(self._partials[seq].body))
            self._discard_partial(seq)

    def close(self) -> None:
        """The stream ends; half-received messages are let go."""
        for seq in list(self._partials):
            self._on_drop(self, DropReason.DISCONNECTED, len(self._partials[seq].body))
            self._discard_partial(seq)
        self._waiting.clear()

    def validate(self, check: Callable[[bool, str], None]) -> None:
        name = self.stream.id.topic
        check(all(seq > self.delivered for seq in self._waiting), f"{name}: a delivered message still waits")
        check(all(seq > self.delivered for seq in self._partials), f"{name}: a stale partial message is kept")
