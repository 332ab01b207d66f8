"""The sending side of one stream on one hop: its bounded queue, what is in flight, and what must be kept.

Best effort: the last few messages are kept (`keep_last`). Reliable: every message is kept until the peer has confirmed
it or its time is over (`keep_all`).

A message is in exactly one of four places: queued (nothing sent yet), in flight (begun), delivered, dropped for a
reason. `OutChannel.validate` checks that the counters agree. What waits and what is in flight is in `transit`, for both
kinds alike; `out_drops` counts what is dropped and tells of it.
"""

from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import inf

from sern_core.stream.coding import ChannelCodec
from sern_core.stream.gate import Gate
from sern_core.stream.keep_all import KeepAll
from sern_core.stream.keep_last import KeepLast
from sern_core.stream.out_drops import OnDrop, OutDrops
from sern_core.stream.out_message import OutMessage
from sern_core.stream.prices import CLEARED_PER_US, CLIENT_OVERHEAD_BYTES, GIVEN_UP_US
from sern_core.stream.transit import Transit
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason


class OutChannel:
    """One stream towards one peer. The link serves it through `head` and `take`; `channel_id` is its number in the
    session, by which the scheduler names it as well."""

    __slots__ = (
        "_all",
        "_kept",
        "_transit",
        "channel_id",
        "codec",
        "counters",
        "drops",
        "offered",
        "probe_from_seq",
        "ready",
        "reliable",
        "required",
        "spec",
        "stream",
        "waits_since_s",
        "wanted",
    )

    def __init__(
        self,
        channel_id: int,
        stream: StreamInfo,
        counters: SendCounters,
        on_drop: OnDrop,
        *,
        first: int,
        codec: ChannelCodec | None = None,
    ) -> None:
        spec = stream.spec
        self.channel_id = channel_id
        self.stream = stream
        self.spec = spec
        self.counters = counters
        self.codec = codec
        """None: bodies go as they come."""
        self.reliable = spec.reliable
        self.drops = OutDrops(channel_id, counters, on_drop, reliable=spec.reliable)
        self._transit = Transit(coded=codec is not None)
        self._all = KeepAll(spec, self._transit, self.drops, first=first) if spec.reliable else None
        self._kept = self._all or KeepLast(spec, self._transit, self.drops, first=first)
        self.waits_since_s: float | None = None
        """When a message began last; before the first one, when the first that waited was born."""
        self.wanted: bool | None = None
        """Whether anybody behind the peer wants the stream; None until it has answered."""
        self.ready = False
        """Whether it was announced in the session."""
        self.offered = False
        """Whether the scheduler knows of a pending message."""
        self.probe_from_seq: int | None = None
        """The first message from this one on that the link is not known to carry in time is begun all the same, to
        see; None: none is."""
        self.required: tuple[str, ...] = ()
        """Reliable subscribers behind the peer, as it told us."""

    # --- what is where --------------------------------------------------------------------------------------------

    @property
    def queue(self) -> deque[OutMessage]:
        """What has not begun, the oldest first."""
        return self._transit.queue

    @property
    def queued_bytes(self) -> int:
        return self._transit.queued_bytes

    @property
    def active(self) -> list[OutMessage]:
        """What has begun and has bytes still to send, the oldest first."""
        return self._transit.active

    @property
    def flying(self) -> dict[int, OutMessage]:
        """What has begun, by seq, until it is acknowledged or given up."""
        return self._transit.flying

    @property
    def retained(self) -> Sequence[OutMessage]:
        """Reliable: everything above the watermark, the oldest first."""
        return self._kept.retained

    @property
    def retained_bytes(self) -> int:
        return self._kept.retained_bytes

    @property
    def watermark(self) -> int:
        """Reliable: the peer has confirmed everything up to this seq."""
        return self._kept.watermark

    @property
    def gaps(self) -> Sequence[tuple[int, int]]:
        """Reliable: after this seq, the next that will come."""
        return self._kept.gaps

    @property
    def next_seq(self) -> int:
        """The next seq expected from `submit`."""
        return self._kept.next_seq

    @property
    def first_seq(self) -> int:
        """The lowest seq that may still come: what an announcement promises."""
        return self._kept.first_seq

    # --- entry ----------------------------------------------------------------------------------------------------

    def submit(self, message: Message, *, now: float, forced: bool = False) -> bool:
        """Take one message. False: refused (a reliable queue is full). Drops are counted and reported.

        `forced` skips the rate cap and the reliable bound: the relay's forwarding, where the origin enforces both.
        """
        return self._kept.submit(message, now, forced=forced, unwanted=self.wanted is False)

    def reject(self, message: Message, reason: DropReason) -> None:
        """Drop a message that cannot travel at all; a reliable stream goes on over its drop marker."""
        self._kept.reject(message, reason)

    def leave_out(self, message: Message, reason: DropReason) -> None:
        """There is no room for this reliable message, nor for a drop marker: the stream goes on behind it."""
        if self._all is not None:
            self._all.leave_out(message, reason)

    def prime(self, replays: Sequence[Message], *, now: float) -> Sequence[OutMessage]:
        """Put latched messages (oldest first, marked as replays) ahead of everything; nothing has been sent yet.
        Returns those that are to be sent."""
        return self._kept.prime(replays, now)

    def start_at(self, first: int) -> None:
        """Nothing has been submitted yet: begin at seq `first` instead."""
        self._kept.start_at(first)

    def skip_to(self, first: int) -> None:
        """Nothing from `next_seq` up to `first` will come; the peer is told in its turn (`next_gap`)."""
        self._kept.skip_to(first)

    def next_gap(self) -> int | None:
        """The seq to go on at, once everything before the gap is delivered; each gap is given out once."""
        return None if self._all is None else self._all.next_gap()

    def has_room(self, size_bytes: int) -> bool:
        """Whether one more reliable message keeps within the stream's bound."""
        return self._all is None or self._all.has_room(size_bytes)

    # --- what is held back ----------------------------------------------------------------------------------------

    @property
    def gate(self) -> Gate | None:
        """Where the newest message of a best-effort stream is held back; None: nothing of it is."""
        return self._kept.gate

    @property
    def newest(self) -> OutMessage | None:
        """The newest message, held back by `max_rate_hz` or `share` until `newest_due_s`."""
        return None if self._kept.gate is None else self._kept.gate.newest

    @property
    def newest_due_s(self) -> float:
        return inf if self._kept.gate is None else self._kept.gate.newest_due_s

    @property
    def share(self) -> float:
        """Share of the messages that are let in (`adapt`)."""
        return 1.0 if self._kept.gate is None else self._kept.gate.share

    @property
    def thinned(self) -> int:
        """Messages that `share` left out."""
        return 0 if self._kept.gate is None else self._kept.gate.thinned

    @property
    def depth(self) -> int:
        """Messages that may wait; of a best-effort stream at most the topic's own depth (`adapt`)."""
        return self._kept.depth

    @property
    def coalesced(self) -> bool:
        """Whether only the newest message counts."""
        return self._kept.coalesced

    @property
    def thinnable(self) -> bool:
        """Whether messages may be left out: only the newest one counts, and none is kept for late joiners."""
        return not self.reliable and not self.spec.latched

    def adapt(self, *, share: float, depth_max: int) -> None:
        """What the adaptation allows from the next message on: a share of the messages in (0, 1], and a queue limit
        below the topic's own. Nothing that waits is dropped for it, and what may not be thinned is not."""
        if self.thinnable and isinstance(self._kept, KeepLast):
            self._kept.adapt(share, depth_max)

    def release(self, now: float) -> bool:
        """Let the message that was held back into the queue if its time has come. True: it did."""
        return isinstance(self._kept, KeepLast) and self._kept.release(now)

    # --- service --------------------------------------------------------------------------------------------------

    def head(self, now: float) -> OutMessage | None:
        """The message to serve next: begun ones first, then the queue; what has expired is dropped on the way."""
        transit = self._transit
        return self._kept.head(now) if transit.queue or transit.active else None

    def begin(self, out: OutMessage, now: float) -> None:
        """`out` was the head of the queue and its first bytes leave now, or once its body is encoded."""
        self._transit.begin(out)
        self.waits_since_s = now

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
            self._transit.begin(out)
            self.waits_since_s = now
        elif not out.ranges:
            self._transit.deactivate(out)
        out.fragments_inflight += 1
        if end == out.size:  # fragments leave in their order, so those before it have left as well
            out.exposed = True
        return start, end

    def recoded(self, out: OutMessage, message: Message) -> None:
        """The body of `out`, of which nothing was sent yet, is another one now: encoded."""
        size = len(message.body)
        if not out.started:
            self._transit.queued_bytes += size - out.size
        self._kept.recoded(size - out.size)
        out.message = message
        out.size = size

    def drop_head(self, reason: DropReason, now: float) -> None:
        """Give up the message that would go next (best effort); a reliable one becomes a drop marker."""
        out = self.head(now)
        if out is not None and not out.message.drop_marker:
            self._kept.give_up(out, reason)

    def shed(self, room_bytes: int, reason: DropReason) -> int:
        """Give up messages that have not been begun, together, until `kept_bytes` is less by `room_bytes` or none is
        left. Returns by how much it is less.

        They are the oldest, of a reliable stream the newest, and the peer is told in its turn that the stream goes on
        behind them (`next_gap`).
        """
        return self._kept.shed(room_bytes, reason)

    def abandon(self, seq: int, reason: DropReason) -> bool:
        """Give up reliable message `seq`; a drop marker stays. False: it has been begun, or is not here."""
        return self._all is not None and self._all.abandon(seq, reason)

    def sweep(self, now: float, *, up: bool, room: int = LIMITS.lapsed_a_sweep) -> int:
        """Expire what nobody will send: lifespan and retention, also while the link is down.

        Of a reliable stream at most `room` messages are given up; `SEEN_PER_LAPSED` that are looked at and stay count
        like one. Returns how many that makes. As many as there was room for: sweep again soon, there may be more.
        Nothing of that is sent meanwhile (`head`).
        """
        return self._kept.sweep(now, up=up, room=room)

    # --- outcomes -------------------------------------------------------------------------------------------------

    def fragment_acked(self, out: OutMessage, generation: int) -> bool:
        """The peer has a fragment. True: with it, it has the whole message."""
        if out.generation != generation:
            return False
        out.fragments_inflight -= 1
        out.some_acked = True
        if out.fragments_inflight <= 0 and out.ranges is not None and not out.ranges:
            flying = self._transit.flying
            if flying.get(out.seq) is out:
                del flying[out.seq]
                self._kept.arrived(out)
                return True
        return False

    def fragment_lost(self, out: OutMessage, generation: int, start: int, end: int, *, now: float) -> bool:
        """A fragment did not arrive. True: it will be sent again; False: the message is no longer wanted."""
        return bool(self.fragments_lost([(out, generation, start, end)], now=now))

    def fragments_lost(self, fragments: Iterable[tuple[OutMessage, int, int, int]], *, now: float) -> list[OutMessage]:
        """Fragments (message, its generation, start, end) did not arrive: a connection may end with twenty thousand of
        them. Returns the message of each that will be sent again."""
        kept, transit = self._kept, self._transit
        again: list[OutMessage] = []
        waiting: dict[int, OutMessage] = {}  # have bytes to send again, and are not in `active` yet
        for out, generation, start, end in fragments:
            if out.generation != generation:
                continue
            out.fragments_inflight -= 1
            if transit.flying.get(out.seq) is not out:
                continue  # finished or dropped meanwhile
            reason = kept.unwanted_again(out, now)
            if reason is not None:
                waiting.pop(out.seq, None)
                kept.give_up(out, reason)
                continue
            if out.ranges is None:
                out.ranges = []
            insort(out.ranges, (start, end))
            waiting[out.seq] = out
            again.append(out)
        transit.activate_all(waiting.values())
        return again

    def delivered_to(self, watermark: int) -> int:
        """The peer's delivered watermark moved: reliable messages up to it are done. Returns how many were kept."""
        return self._kept.delivered_to(watermark)

    def settle(self) -> None:
        """Let go of reliable messages that the peer has whole, in order: for a stream without a watermark."""
        if self._all is not None:
            self._all.settle()

    def reported(self, seq: int, reason: DropReason, where: str = "", count: int = 1) -> int:
        """A later hop dropped `count` messages from `seq` on, for the client `where`, and said so before its watermark
        passed them. Returns what that costs, in microseconds."""
        return 0 if self._all is None else self._all.reported(seq, reason, where, count)

    def set_wanted(self, wanted: bool, reason: DropReason = DropReason.UNWANTED) -> int:
        """The peer's answer: does anybody behind it want this stream? What is left is dropped for `reason` if not.
        Returns what that costs, in microseconds."""
        self.wanted = wanted
        return 0 if wanted else self.clear(reason)

    def peer_restarted(self) -> None:
        """A new process at the other end has nothing of what we sent: everything waits to be sent again."""
        self._kept.restart(alone=len(self.required) < 2)

    def clear(self, reason: DropReason) -> int:
        """The stream ends: whatever is left is dropped for `reason`. Returns what that costs, in microseconds."""
        work_us = self.kept // CLEARED_PER_US
        return work_us + GIVEN_UP_US * self._kept.clear(reason)

    # --- accounting -----------------------------------------------------------------------------------------------

    @property
    def kept(self) -> int:
        """How many messages wait here or are under way, drop markers included."""
        return self._kept.kept

    @property
    def kept_bytes(self) -> int:
        """What it counts for in the bound of its client: `held_bytes`, and each message's overhead."""
        return self._kept.held_bytes + CLIENT_OVERHEAD_BYTES * self._kept.kept

    @property
    def held_bytes(self) -> int:
        """Bytes that wait here or are under way, and would have to be sent again to a peer that has lost them."""
        return self._kept.held_bytes

    @property
    def unbegun(self) -> int:
        """How many messages wait of which nothing was sent, that which is held back included."""
        return self._kept.unbegun

    @property
    def unbegun_bytes(self) -> int:
        """Bytes of these messages."""
        return self._kept.unbegun_bytes

    def undelivered(self) -> list[OutMessage]:
        """What is queued or in flight; counted drop markers are neither."""
        return self._kept.undelivered()

    def held(self) -> tuple[int, int, int, int]:
        """(messages queued, bytes queued, messages in flight, bytes in flight), bytes as they were offered; counted
        drop markers are neither."""
        queued, flying = self._kept.split()
        queued_bytes, flying_bytes = sum(o.offered_bytes for o in queued), sum(o.offered_bytes for o in flying)
        return len(queued), queued_bytes, len(flying), flying_bytes

    def validate(self, check: Callable[[bool, str], None]) -> None:
        """Internal consistency; that the counters add up is checked by the link, as streams of one topic share them."""
        self._kept.validate(check, self.stream.id.topic)
