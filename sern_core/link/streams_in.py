"""The streams that the peer has for this end: announced, delivered, confirmed, skipped, gone. Pure."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from sern_core.link.answers import Answers
from sern_core.link.control_stream import ControlStream
from sern_core.link.definitions import PeerDefinitions
from sern_core.link.end import End
from sern_core.link.events import Events
from sern_core.link.lane_set import LaneSet
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.vocabulary.errors import RefusedError, RemoteError, WireError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire.announce import Announcement

WHY_CHARS: Final = 400
"""The most of a reason that a refusal carries."""
MAX_REMEMBERED: Final = 1024
"""Reliable streams that have ended whose place is remembered."""


class StreamsIn:
    """`auto_confirm`: what had its turn here is delivered; a relay confirms by hand, when its subscribers have.

    `answered(count)` is told of what the peer made us say; `finish(now)` says whether all that came of what was read
    before is done.
    """

    def __init__(
        self,
        end: End,
        control: ControlStream,
        answers: Answers,
        texts: PeerDefinitions,
        reassembly: Reassembly,
        lanes: LaneSet,
        events: Events,
        *,
        auto_confirm: bool,
        answered: Callable[[int], None],
        finished: Callable[[float], bool],
    ) -> None:
        self._end = end
        self._control = control
        self._answers = answers
        self._texts = texts
        self._reassembly = reassembly
        self._lanes = lanes
        self._events = events
        self.auto_confirm = auto_confirm
        self._answered = answered
        self._finished = finished
        self.streams: dict[StreamId, InStream] = {}
        """All of them, across sessions."""
        self.incoming: dict[int, InStream] = {}
        """Streams of the session by the peer's channel number."""
        self.watermarks: dict[int, int] = {}
        """Up to where a channel is delivered, where the peer is still to be told."""
        self._gone: deque[InStream] = deque()  # streams that the peer no longer has, to be retracted
        self._had: dict[StreamId, tuple[int, int]] = {}  # of reliable ones that have ended: delivered, confirmed
        self._skipping: dict[InStream, None] = {}  # streams that leave messages out, and go on in a while
        self._missing: dict[StreamId, float] = {}  # not announced by a new peer, and since when
        self._fresh: deque[tuple[InStream, Message, int]] = deque()
        """Messages of class control that were young enough, with the number of steps that the clock estimate had seen:
        what arrives in the same turn may tell that our clock stood still while they lay here."""

    # --- sessions -------------------------------------------------------------------------------------------------

    def begin(self, *, resumed: bool, now: float) -> None:
        """A session has begun."""
        if resumed:
            return
        if self._end.towards_relay:  # a new relay has yet to learn of them
            for identity in self.streams:
                self._missing.setdefault(identity, now)
        for stream in self.streams.values():
            # Another process goes on with what is durable, and may encode otherwise what is half here.
            if stream.stream.spec.durable:
                stream.forget(DropReason.DISCONNECTED)

    def leave(self) -> None:
        """The session is over: channels have no streams."""
        for stream in self.incoming.values():
            stream.channel_id = None
            stream.known = True
            stream.pause_seq = 0
            stream.reports.unsay()
        self.incoming.clear()
        self.watermarks.clear()

    def forget_gone(self) -> None:
        """What the peer did not announce in a session that has ended is announced in the next, or gone then."""
        self._gone.clear()

    def close(self) -> None:
        """The link is given up: its incoming streams are gone for good."""
        for stream in self.streams.values():
            stream.close()
        self.streams.clear()
        self._skipping.clear()
        self.incoming.clear()
        self._missing.clear()

    # --- announced, refused, gone ---------------------------------------------------------------------------------

    def announced(self, announcement: Announcement, now: float) -> None:
        """The peer has a stream. Raises WireError where that cannot be."""
        identity = announcement.stream.id
        channel_id = announcement.channel_id
        stream = self.streams.get(identity)
        if self.incoming.get(channel_id, stream) is not stream or (
            stream and stream.channel_id not in (None, channel_id)
        ):
            raise WireError(f"channel {channel_id} or its stream {identity.topic!r} is announced twice")
        if stream is not None and not _same_type(stream.stream, announcement):
            self.retract(stream, now)  # the name came back with another type: that is another stream
            stream = None
        if stream is None or stream.stream.spec != announcement.stream.spec:
            replaced = stream
            stream = InStream(
                announcement.stream, self._reassembly, self._deliver, self._in_drop, first=announcement.first
            )
            if replaced is None:
                self._recall(stream)
            else:  # the origin was configured anew: what was delivered stays delivered
                stream.delivered, stream.confirmed = replaced.delivered, replaced.confirmed
                stream.unhandled = replaced.unhandled
                replaced.close()
            self.streams[identity] = stream
        self._missing.pop(identity, None)
        stream.channel_id = channel_id
        self.incoming[channel_id] = stream
        self._answers.expect(stream, channel_id)
        digest = stream.stream.definition_hash = announcement.definition_hash
        self._texts.use_incoming(identity, digest)
        if digest and self._texts.lacks(digest):
            self._control.send({"t": "need", "dh": digest}, now=now)
        try:
            wanted = self._offer(stream, announcement, now)
        except RefusedError as refusal:
            self.incoming.pop(channel_id, None)
            self.streams.pop(identity, None)
            self._answers.forget(stream)
            self._texts.use_incoming(identity, "")
            self.watermarks.pop(channel_id, None)
            stream.channel_id = None
            stream.close()
            self._say_refused(channel_id, refusal.code, str(refusal), now)
            return
        self.skip(stream, announcement.first, now)
        if stream.reliable and stream.confirmed >= announcement.first:
            self.watermarks[channel_id] = stream.confirmed  # it may not know: ours was lost with the session
        if wanted is not None:
            self._answers.answer(stream, wanted, now=now)

    def _recall(self, stream: InStream) -> None:
        """What was delivered of a stream stays so when it comes back: its origin may know less than we do."""
        delivered, confirmed = self._had.get(stream.stream.id, (0, 0))
        stream.delivered = max(stream.delivered, delivered)
        stream.confirmed = max(stream.confirmed, confirmed)

    def _offer(self, stream: InStream, announcement: Announcement, now: float) -> bool | None:
        """The owner's answer to an announcement. Raises RefusedError, also when it fails twice."""
        for last in (False, True):
            try:
                return self._events.announce(announcement, now=now)
            except RemoteError:
                raise
            except Exception as error:
                self._events.fault(error)
                if last:
                    self._events.retract(stream, now=now)
                    name, topic = self._end.name, announcement.stream.id.topic
                    text = f"{name} cannot take {topic}: an error of its own; see its log"
                    raise RefusedError("internal_error", text) from error
        return None

    def refuse(self, stream: InStream, code: str, text: str, *, now: float) -> None:
        """Take back what was allowed when the stream was announced (an access rule changed)."""
        if self._end.established and stream.channel_id is not None:
            self._answers.forget(stream)
            self._say_refused(stream.channel_id, code, text, now)

    def _say_refused(self, channel_id: int, code: str, text: str, now: float) -> None:
        self._control.send({"t": "refuse", "ch": channel_id, "code": code, "why": text[:WHY_CHARS]}, now=now)

    def synced(self, now: float) -> None:
        """The peer has announced all it has. What it left out is gone, unless it is a relay that is still learning:
        a stream it has not been told of yet keeps its delivered count here, so that "once" survives its restart."""
        for identity, stream in self.streams.items():
            if stream.channel_id is None and identity not in self._missing:
                self._gone.append(stream)
        self.go_on(now)

    def outlived(self, origin: ClientName, boot: int, *, now: float) -> None:
        """A process of `origin` is there, `boot`: what a new relay has not been told of the ones before is gone, unless
        the origin keeps it on disk."""
        for identity in [each for each in self._missing if each.origin == origin and each.boot != boot]:
            if not self.streams[identity].stream.spec.durable:
                self.retract(self.streams[identity], now)

    def retract(self, stream: InStream, now: float) -> None:
        """The peer no longer has the stream."""
        self.hand_on(now)
        self._remember(stream)
        self.streams.pop(stream.stream.id, None)
        self._missing.pop(stream.stream.id, None)
        self._texts.use_incoming(stream.stream.id, "")
        if stream.channel_id is not None:
            self.incoming.pop(stream.channel_id, None)
            self.watermarks.pop(stream.channel_id, None)
        self._answers.forget(stream)
        self._skipping.pop(stream, None)
        self._events.retract(stream, now=now)
        stream.close()
        stream.channel_id = None

    def _remember(self, stream: InStream) -> None:
        """Keep where a durable stream ends, for `_recall`, and at a client any reliable one: its origin may be about to
        go over to another relay, which begins where the origin knows it to be. The latest of them are kept. What a
        latched one has held is wanted again: whoever comes late asks the publisher that ends with it."""
        spec = stream.stream.spec
        if not (spec.durable or (self.auto_confirm and stream.reliable and not spec.latched)):
            return
        delivered = stream.unhandled - 1 if stream.unhandled else stream.delivered
        self._had.pop(stream.stream.id, None)
        self._had[stream.stream.id] = (delivered, min(stream.confirmed, delivered))
        if len(self._had) > MAX_REMEMBERED:
            del self._had[next(iter(self._had))]

    # --- messages -------------------------------------------------------------------------------------------------

    @property
    def fresh(self) -> bool:
        """Whether messages wait for `hand_on`."""
        return bool(self._fresh)

    def _deliver(self, stream: InStream, message: Message) -> None:
        end = self._end
        # At a relay the next hop sees that the relay's clock stood still.
        if self.auto_confirm and end.initiator and stream.perishable:
            self._fresh.append((stream, message, self._lanes.clock.steps))
            end.dirty = True
            return
        try:
            self._events.message(stream, message, now=end.now)
        except Exception as error:  # noqa: BLE001  (of one message: the stream goes on, whatever its bodies do)
            self._undelivered(stream, message, error)
        if stream.reliable:
            self._confirm_own(stream)

    def hand_on(self, now: float) -> None:
        """Deliver commands and poses: everything that had arrived with them has been looked at."""
        self._end.now = now
        newest: dict[InStream, Message] = {}
        if len(self._fresh) > 1:
            newest = {stream: message for stream, message, _ in self._fresh if stream.newest_alone}
        while self._fresh:
            stream, message, steps = self._fresh.popleft()
            if stream.newest_alone and newest.get(stream, message) is not message:
                self._in_drop(stream, DropReason.SUPERSEDED, len(message.body), (message.seq,), reported=False)
                continue
            lifespan_s = stream.lifespan_s
            aged = lifespan_s is not None and now - message.born_s + message.error_s > lifespan_s  # while it lay here
            if aged or steps != self._lanes.clock.steps:
                self._in_drop(stream, DropReason.LIFESPAN, len(message.body), (message.seq,), reported=False)
                continue
            try:
                self._events.message(stream, message, now=now)
            except Exception as error:  # noqa: BLE001  (as in `_deliver`)
                self._undelivered(stream, message, error)

    def _undelivered(self, stream: InStream, message: Message, error: Exception) -> None:
        """The owner failed at a message: it is given up, and its drop marker has the turn."""
        self._events.fault(error)
        if message.drop_marker:
            lost = message
        elif stream.reliable:
            self._in_drop(stream, DropReason.FAULT, len(message.body), (message.seq,), reported=True)
            lost = stream.drop_marker(message.seq, DropReason.FAULT, message.stamp_ns, message.born_s)
        else:
            self._in_drop(stream, DropReason.FAULT, len(message.body), (message.seq,), reported=False)
            return
        try:
            self._events.message(stream, lost, now=self._end.now)
        except Exception as again:  # noqa: BLE001
            self._events.fault(again)

    def _in_drop(self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int], reported: bool) -> None:
        if reported:
            for seq in seqs:
                self._answers.report(stream, seq, reason, self._end.name)  # its drop marker tells the owner
                self._answered(1)
        else:
            self._events.discarded(stream, reason, nbytes, seqs)

    # --- how far a stream is --------------------------------------------------------------------------------------

    def skip(self, stream: InStream, first: int, now: float) -> None:
        """Nothing of the stream below seq `first` will come any more."""
        stream.skip_to(first, now)
        if stream in self._reassembly.behind:
            self._skipping[stream] = None
        else:
            self._skipped(stream, now)

    def _skipped(self, stream: InStream, now: float) -> None:
        if stream.left_out:
            self._events.skipped(stream, stream.left_out, now=now)
            self._confirm_own(stream)
        if stream.wanted:
            stream.paused = False

    def confirm(self, stream: InStream, delivered: int) -> None:
        """Tell the peer that its reliable stream is delivered up to `delivered`; remembered while it is away."""
        if delivered > stream.confirmed:
            stream.confirmed = delivered
            if stream.channel_id is not None:
                self.watermarks[stream.channel_id] = delivered
                self._end.dirty = True

    def _confirm_own(self, stream: InStream) -> None:
        if self.auto_confirm and stream.reliable:
            self.confirm(stream, min(stream.delivered, stream.unhandled - 1) if stream.unhandled else stream.delivered)

    def processed_below(self, stream: InStream, oldest: int) -> None:
        """Confirm delivered messages below seq `oldest`; 0 confirms all."""
        stream.unhandled = oldest
        self._confirm_own(stream)

    def take_watermarks(self, limit: int, *, acked_seq: int) -> Iterator[tuple[int, int]]:
        """Up to `limit` of (channel, delivered) to be told, each taken when it is asked for. `acked_seq`: the number of
        the last control message that the peer has acknowledged."""
        for channel_id in list(self.watermarks)[:limit]:
            # Of drops first: else it would take them for delivered.
            if self.incoming[channel_id].reports.acknowledged(acked_seq):
                yield channel_id, self.watermarks.pop(channel_id)

    def tell_again(self, channel_id: int) -> None:
        """The watermark of a channel was lost on the way."""
        if channel_id in self.incoming:
            self.watermarks[channel_id] = self.incoming[channel_id].confirmed

    # --- in slices, and by time -----------------------------------------------------------------------------------

    def go_on(self, now: float) -> bool:
        """Do more of what has to be done before the next frame is read. True: all of it is done."""
        reassembly = self._reassembly
        if not self._finished(now):
            return False
        while reassembly.behind:
            stream = next(iter(reassembly.behind))
            stream.go_on(now)
            if stream in reassembly.behind:
                return False
            self._confirm_own(stream)
            if stream in self._skipping:
                del self._skipping[stream]
                self._skipped(stream, now)
        while self._gone:
            if reassembly.work_us > reassembly.slice_us:
                return False
            self.retract(self._gone.popleft(), now)
        return self._finished(now)

    def sweep_acked(self) -> None:
        """Let go of reports, and of what is half received of streams that are not wanted, once the peer knows."""
        acked_seq = self._control.acked_seq
        for stream in self.incoming.values():
            stream.reports.acknowledged(acked_seq)
            if 0 < stream.pause_seq <= acked_seq:
                stream.forget(DropReason.UNWANTED)  # the peer has given up what is half received or waits here
                self._skipping.pop(stream, None)  # it is where it was to go on, and nobody is to hear of it later

    def sweep(self, now: float) -> None:
        """Give up what has been half received for too long, and streams that a new relay never learnt of."""
        end = self._end
        if end.established:
            for stream in self.streams.values():
                stream.sweep(now, end.up_since_s)
        for identity, since_s in list(self._missing.items()):
            if now - since_s > end.params.retention_s:
                self.retract(self.streams[identity], now)

    @property
    def held_bytes(self) -> int:
        """Bytes of what has arrived in part or out of its turn."""
        return sum(stream.held_bytes for stream in self.streams.values())

    def validate(self, check: Callable[[bool, str], None]) -> None:
        """Internal consistency, for tests."""
        streams = self.streams.values()
        for stream in streams:
            stream.validate(check)
        unacked, reports = self._reassembly.unacked_reports, [stream.reports for stream in streams]
        check(unacked.reports == sum(map(len, reports)), "reports of drops do not add up")
        check(unacked.said == sum(each.said for each in reports), "reports of drops that were said do not add up")
        check(self.watermarks.keys() <= self.incoming.keys(), "watermarks of streams that are gone")


def _same_type(known: StreamInfo, announced: Announcement) -> bool:
    """Whether bodies of both are to be read in the same way."""
    one, other = known.info, announced.stream.info
    return (
        one.type_name == other.type_name
        and one.encoding is other.encoding
        and one.type_hash == other.type_hash
        and known.definition_hash == announced.definition_hash
    )
