"""Which reliable messages have lapsed: their lifespan or their retention is over.

A sweep looks at few of many. What stays was looked at once: those that the peer has whole have their retention left,
which ends in their order, and are sent again only to another process there (`restart`).
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable
from itertools import islice
from typing import Final, NamedTuple, Protocol

from sern_core.stream.out_message import BY_SEQ, OutMessage
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import DropReason

SEEN_PER_LAPSED: Final = 8
"""Messages that a sweep looks at and keeps, for one that it gives up, in the price of the sweep."""


def lapsed(out: OutMessage, spec: TopicSpec, now: float) -> DropReason | None:
    """Why a reliable message that is no drop marker is to be given up now; None if it is not."""
    if now - out.retain_from_s > spec.retention_s:
        return DropReason.RETENTION
    # Lifespan stops a message from being sent; once the peer has it whole, the peer watches it.
    if out.expired(spec.lifespan_s, now) and (out.has_unsent or out.fragments_inflight > 0):
        return DropReason.LIFESPAN
    return None


class Kept(Protocol):
    """What a channel keeps: everything above seq `watermark`, the oldest first."""

    retained: deque[OutMessage]
    watermark: int

    def mark_dropped(self, outs: list[OutMessage], reason: DropReason) -> None:
        """Put drop markers in the places of messages."""


class LeftBehind(NamedTuple):
    """The oldest messages that have lapsed, up to `last_seq`; 0: none. In `runs` are those that were not counted."""

    spent: int
    last_seq: int
    runs: list[tuple[DropReason, list[OutMessage]]]


def left_behind(retained: Iterable[OutMessage], spec: TopicSpec, now: float, room: int) -> LeftBehind:
    """The oldest of what is kept that have lapsed, with the drop markers between them, as many as `room` takes."""
    runs: list[tuple[DropReason, list[OutMessage]]] = []
    known: DropReason | None = None
    count = seen = last_seq = 0
    for out in retained:
        if count + seen // SEEN_PER_LAPSED >= room:
            break
        if out.message.drop_marker:
            seen += 1
        else:
            reason = lapsed(out, spec, now)
            if reason is None:
                break
            count += 1
            if not out.counted:
                if reason is not known:
                    runs.append((reason, []))
                    known = reason
                runs[-1][1].append(out)
        last_seq = out.seq
    return LeftBehind(count + seen // SEEN_PER_LAPSED, last_seq, runs)


class Lapses:
    """How far the messages of one reliable channel were looked at."""

    __slots__ = ("_marked_to", "_replays_marked_to", "_replays_to", "_settled_to", "_spec")

    def __init__(self, spec: TopicSpec) -> None:
        self._spec = spec
        self._marked_to = 0  # every message that is kept up to this seq, and is no replay, is a drop marker
        self._replays_marked_to = 0  # the same of replays
        self._replays_to = 0  # the newest that was a replay
        self._settled_to = 0  # every message that is kept up to this seq is a drop marker, or the peer has it whole

    def primed(self, last_seq: int) -> None:
        """Replays up to `last_seq` were put ahead of all that is kept."""
        self._replays_to = max(self._replays_to, last_seq)
        self._replays_marked_to = self._settled_to = 0

    def restart(self) -> None:
        """The peer has none of them any more."""
        self._settled_to = 0

    def mark(self, kept: Kept, now: float, room: int) -> int:
        """Put drop markers in the places of messages that have lapsed. Returns what of `room` it took."""
        spent = 0
        if self._replays_to > kept.watermark:  # they are kept from later on than what is behind them
            spent, self._replays_marked_to = self._mark_behind(kept, self._replays_marked_to, now, room, None)
        if spent < room:
            behind = max(self._marked_to, self._replays_to)
            more, self._marked_to = self._mark_behind(kept, behind, now, room - spent, None)
            spent += more
        lifespan_s = self._spec.lifespan_s
        if spent < room and lifespan_s is not None:
            more, self._settled_to = self._mark_behind(kept, self._settled_to, now, room - spent, lifespan_s)
            spent += more
        return spent

    def _mark_behind(self, kept: Kept, seq: int, now: float, room: int, lifespan_s: float | None) -> tuple[int, int]:
        """The same behind `seq`, up to the first whose retention or lifespan is not over. Returns what of `room` it
        took, and the seq that it came to."""
        retained, retention_s = kept.retained, self._spec.retention_s
        start = 0 if seq <= kept.watermark else bisect_right(retained, seq, key=BY_SEQ)
        if start == len(retained) or self._young(retained[start], now, lifespan_s):
            return 0, seq  # most often, and it takes no walk to the start
        runs: list[tuple[DropReason | None, list[OutMessage]]] = []
        known: DropReason | None = None
        count = seen = 0
        for out in islice(retained, start, None):
            if count + seen // SEEN_PER_LAPSED >= room or self._young(out, now, lifespan_s):
                break
            if out.message.drop_marker:
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
            kept.mark_dropped(run, why)
        return count + seen // SEEN_PER_LAPSED, seq

    def _young(self, out: OutMessage, now: float, lifespan_s: float | None) -> bool:
        """Whether a reliable message is no drop marker, and its lifespan, or without one its retention, goes on. They
        are in the order of their birth, and but for replays in that of their retention."""
        message = out.message
        if message.drop_marker:
            return False
        if lifespan_s is None:
            return now - out.retain_from_s <= self._spec.retention_s
        return now - message.born_s + message.error_s <= lifespan_s
