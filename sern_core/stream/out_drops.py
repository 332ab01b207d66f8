"""What one channel drops: each message is counted once, and many are told of together."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

from sern_core.stream.coding import Coding
from sern_core.stream.out_message import BY_SEQ, OutMessage, in_sequence
from sern_core.vocabulary.ledger import LOSSES, SendCounters
from sern_core.vocabulary.types import DropReason

OnDrop = Callable[[int, Sequence[OutMessage], DropReason], None]
"""`on_drop(channel_id, outs, reason)`: these messages of the channel, in order, are counted as dropped now. Of a
reliable stream what lies between two of them was dropped before, or never comes: the whole span may be told onwards."""


class OutDrops:
    """Counts what a channel drops, and tells `on_drop` of it."""

    __slots__ = ("_channel_id", "_on_drop", "_reliable", "counters", "live_from", "on_count")

    def __init__(self, channel_id: int, counters: SendCounters, on_drop: OnDrop, *, reliable: bool) -> None:
        self._channel_id = channel_id
        self._on_drop = on_drop
        self._reliable = reliable
        self.counters = counters
        self.live_from = 0
        """Reliable: what is kept below this seq are replays, and between them lies what the peer is not to get."""
        self.on_count: Callable[[int, DropReason], None] | None = None
        """Told of every drop that is counted, by seq; for audits."""

    def count(self, seq: int, reason: DropReason, nbytes: int) -> None:
        self.counters.drop(reason, nbytes)
        if self.on_count is not None:
            self.on_count(seq, reason)

    def tell(self, out: OutMessage, reason: DropReason) -> None:
        """Tell of one message that is counted already."""
        self._on_drop(self._channel_id, (out,), reason)

    def drop(self, out: OutMessage, reason: DropReason) -> None:
        """Count one message, and tell of it."""
        if out.exposed:
            reason = self.reason_of(out, reason)
        out.coding = Coding.DONE  # whatever another thread makes of it
        self.count(out.seq, reason, out.offered_bytes)
        self._on_drop(self._channel_id, (out,), reason)

    def drop_run(self, run: Sequence[OutMessage], reason: DropReason) -> None:
        """Count messages that are dropped together, and tell of them at once: there may be a hundred thousand."""
        self.counters.drop(reason, sum([out.offered_bytes for out in run]), len(run))
        if self.on_count is not None:
            for out in run:
                self.on_count(out.seq, reason)
        self._on_drop(self._channel_id, run, reason)

    def drop_all(self, lost: list[OutMessage], reason: DropReason) -> int:
        """Count what is given up and tell of it; returns in how many runs."""
        count = 0
        for run in self.runs(lost):
            self.drop_run(run, self.reason_of(run[0], reason, len(run)))
            count += 1
        return count

    def reason_of(self, out: OutMessage, reason: DropReason, count: int = 1) -> DropReason:
        """Whatever the reason to give up so many like this: what may have arrived must not be counted as if it had not.
        Called once for each message."""
        if not out.exposed:
            return reason
        if self._reliable and reason in LOSSES:
            self.counters.reliable_unconfirmed += count
        return DropReason.UNCONFIRMED

    def spans(self, lost: list[OutMessage]) -> Iterator[Sequence[OutMessage]]:
        """Messages of a reliable stream, in their order, in runs whose spans may be told onwards."""
        replays = bisect_left(lost, self.live_from, key=BY_SEQ) if self.live_from else 0
        if replays:
            yield from in_sequence(lost[:replays])
            lost = lost[replays:]
        if lost:
            yield lost

    def runs(self, lost: list[OutMessage]) -> Iterator[Sequence[OutMessage]]:
        """What is left, in runs that are alike in whether they may have arrived."""
        for span in self.spans(lost):
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
