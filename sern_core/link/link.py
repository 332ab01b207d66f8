"""One end of a hop: handshake (`Session`), data (`Hop`), announcements and interest; no I/O, clock or randomness.

A hop is a pair of links. Each end announces the streams it has, is told which of them are wanted, and sends those as
scheduler and window allow.

A link lives as long as its owner remembers the peer's name; sessions come and go inside it. What survives a session:
queues, retained reliable messages, delivered counts. What does not: channel numbers and control messages, so every
session announces everything again.

The owner calls `submit`, `receive`, `next_datagram`, `next_deadline` and `handle_timeout`, each with the time, and is
told what happens through its `LinkHandler`.
"""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final, ParamSpec, Protocol

from sern_core.link.answering import Answering
from sern_core.link.definitions import DefinitionStore, PeerDefinitions
from sern_core.stream.in_stream import SLICE_US, InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.errors import RefusedError, RemoteError, UsageError, WireError
from sern_core.vocabulary.fates import Fates
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace, TraceEvent
from sern_core.vocabulary.types import CLASS_LABELS, DROP_REASONS, ClientName, DropReason, PriorityClass
from sern_core.wire import framing
from sern_core.wire.announce import (
    Announcement,
    announcement_parts,
    decode_announcement,
    decode_want,
    definition_hash,
)

TIDY_S: Final = 60.0
MAX_TOLD_BYTES: Final = 4 * 2**20
MAX_TOLD_CHANNEL_BYTES: Final = 1024
"""Control messages that may wait for a peer, beside so much for each channel: more than any leaves that reads."""
ATTACHMENT_BURST_BYTES: Final = 6 * 2**20
ATTACHMENT_BYTES_PER_S: Final = 64 * 2**20
"""What a peer's attachments may unpack to at once and after that: zlib makes a kilobyte of a megabyte of blank lines,
and takes 2 ms to unpack it."""
CONTROL_US: Final = 30
CONTROL_BYTES_PER_US: Final = 16
ATTACHMENT_BYTES_PER_US: Final = 250
RETAINED_PER_US: Final = 16
"""What a control message is charged with: itself, its size, what its attachment unpacks to, what it looks through."""
ANNOUNCE_US: Final = 12
"""What a session that begins is charged with for each stream that is announced in it."""
MAX_TRACED: Final = 100
"""The most of one run of dropped messages that the trace of decisions has."""
MAX_UNHEARD: Final = 20_000
"""Control messages that a peer may have answered, beside four for each channel, before it reads an answer."""
SEVERAL: Final = "several clients"
"""Who will not get a message when the report of its drop names nobody; it is no client's name."""


P = ParamSpec("P")


class LinkHandler(Protocol):
    """What the owner of a link is told. Calls happen inside `receive`, `submit` and `handle_timeout`.

    What they raise unexpectedly goes to `on_fault` and stops nothing that is under way here. News is told once more, as
    it does not come again; a message is given up (`fault`), counted and, of a reliable stream, reported; a stream that
    cannot be announced is refused. Only `on_up` and `on_control` end the session, for the next one tells it all anew.
    """

    def on_fault(self, link: "Link", error: Exception, *, now: float) -> None:
        """Something raised what nobody expects, here or in the owner: to be logged with its traceback, and counted."""

    def on_up(self, link: "Link", *, resumed: bool, now: float) -> None:
        """A session exists. `resumed`: the peer is the same process as before."""

    def on_down(self, link: "Link", reason: str, *, now: float) -> None: ...

    def on_lane_closed(self, link: "Link") -> None:
        """The datagram lane ended with the session: close its transport; its keys are of no more use."""

    def on_rejected(self, link: "Link", code: str, text: str, *, now: float) -> None:
        """The peer refused the session itself."""

    def on_announce(self, link: "Link", announcement: Announcement, *, now: float) -> bool | None:
        """The peer has a stream: is it wanted? None: `Link.answer` says so later. Raises RefusedError to refuse."""

    def on_retract(self, link: "Link", stream: InStream, *, now: float) -> None: ...

    def on_message(self, link: "Link", stream: InStream, message: Message, *, now: float) -> None:
        """A message (or tombstone) has its turn."""

    def on_in_drop(self, link: "Link", stream: InStream, reason: DropReason, nbytes: int, count: int) -> None: ...

    def on_out_drop(self, link: "Link", channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        """These messages are dropped, in the order of their seqs. Of a reliable stream what lies between two of them
        was dropped before, or never comes."""

    def on_delivered(self, link: "Link", channel: OutChannel, *, now: float) -> None:
        """The peer's watermark of a reliable channel moved to `channel.watermark`."""

    def on_wanted(self, link: "Link", channel: OutChannel, *, now: float) -> None:
        """The peer has said whether it wants the stream: `channel.wanted`. Said again after every change."""

    def on_refused(self, link: "Link", channel: OutChannel, code: str, text: str, *, now: float) -> None: ...

    def on_skipped(self, link: "Link", stream: InStream, count: int, *, now: float) -> None:
        """`count` messages of the stream will not come; they were reported where they were dropped."""

    def on_definition(self, link: "Link", digest: str, *, now: float) -> None:
        """`Link.definitions` has a new text."""

    def on_control(self, link: "Link", envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        """A control message that is not the link's own business. Raises WireError if it is nobody's."""


class Link(Answering):
    """One end of one hop towards `peer`.

    `definitions` is shared by all links of a process. `auto_confirm`: what had its turn here
    is delivered; a relay confirms by hand, when its subscribers have.
    """

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        peer: ClientName,
        initiator: bool,
        handler: LinkHandler,
        definitions: DefinitionStore,
        link: LinkParams,
        scheduler: SchedulerParams,
        trace: DecisionTrace,
        now: float,
        lossless: bool = True,
        auto_confirm: bool = True,
    ) -> None:
        self.handler = handler
        self.definitions = definitions
        self.texts = PeerDefinitions(definitions, peer)
        self.auto_confirm = auto_confirm
        self.by_stream: dict[StreamId, OutChannel] = {}
        self.streams: dict[StreamId, InStream] = {}
        """Incoming streams across sessions."""
        self.on_tidy: Callable[[float], None] | None = None
        """Called now and then, with the time, for the owner to let go of what nobody needs any more."""
        self._tidy_due_s = now + TIDY_S
        self._next_channel = 1
        self._unheard = 0  # answers since the peer acknowledged the one of number `_unheard_seq`
        self._unheard_seq = 0
        self._attachments_left = float(ATTACHMENT_BURST_BYTES)
        self._attachments_s = 0.0
        self._announcing: deque[tuple[int, OutChannel]] = deque()  # may send once that control message is on its way
        self._gone: deque[InStream] = deque()  # streams that the peer no longer has, to be retracted
        self._skipping: dict[InStream, None] = {}  # streams that leave messages out, and go on in a while
        self._missing: dict[StreamId, float] = {}  # not announced by a new peer, and since when
        self.finish: Callable[[Link, float], bool] | None = None
        """Called before more is read: whether all that came of what was read before is done by now."""
        self._on_dropped = self._dropped  # one for all channels
        self.faults = 0
        """Errors of ours on this link so far."""
        self.fates: Fates | None = None
        """Told what becomes of each message here; set before the first channel is opened."""
        super().__init__(
            name=name,
            boot=boot,
            peer=peer,
            initiator=initiator,
            link=link,
            scheduler=scheduler,
            trace=trace,
            now=now,
            lossless=lossless,
        )

    def _session_began(self, resumed: bool, now: float) -> None:
        self.texts.peer = self.peer
        self.texts.begin()
        self._unheard = self._unheard_seq = 0
        self._begin_answers()
        self._announcing.clear()
        if self.initiator and not resumed:  # a new relay has yet to learn of them
            for identity in self.streams:
                self._missing.setdefault(identity, now)
        self.handler.on_up(self, resumed=resumed, now=now)
        self.reassembly.work_us += ANNOUNCE_US * len(self.channels)
        for channel in list(self.channels.values()):
            self._announce(channel, now)
        self.send_control({"t": "synced", "batch": True}, now=now)

    def _heard_of(self, channel: OutChannel, now: float) -> None:
        self._tell(self.handler.on_wanted, self, channel, now=now)

    def _session_ended(self, reason: str, now: float) -> None:
        self._gone.clear()
        self._tell(self.handler.on_down, self, reason, now=now)

    def _lane_closed(self) -> None:
        self._tell(self.handler.on_lane_closed, self)

    def _session_refused(self, code: str, text: str, now: float) -> None:
        self._tell(self.handler.on_rejected, self, code, text, now=now)

    # --- errors of ours -------------------------------------------------------------------------------------------

    def fault(self, error: Exception) -> None:
        self.faults += 1
        with suppress(Exception):  # counted above; there is nobody left to tell
            self.handler.on_fault(self, error, now=self._now)

    def _tell(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> None:
        """Tell the owner what it is not told again: once more if that raises."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001  (the owner's, and no reason to leave our own work half done)
            self.fault(error)
            try:
                call(*args, **kwargs)
            except Exception as again:  # noqa: BLE001
                self.fault(again)

    # --- streams out ----------------------------------------------------------------------------------------------

    def open_channel(
        self,
        stream: StreamInfo,
        *,
        first: int,
        now: float,
        owed: tuple[str, ...] = (),
        wanted: bool | None = None,
        replays: Sequence[Message] = (),
    ) -> OutChannel:
        """Announce a stream to the peer; its messages start at seq `first`, after the latched `replays`, oldest first.

        Raises UsageError if it is open already, or cannot be announced at all.
        """
        if stream.id in self.by_stream:
            raise UsageError(f"stream {stream.id.topic} of {stream.id.origin} is already open towards {self.peer}")
        if len(stream.info.definition.encode()) > framing.MAX_ATTACHMENT_BYTES:
            raise UsageError(f"the definition of {stream.id.topic} exceeds {framing.MAX_ATTACHMENT_BYTES} bytes")
        if len(self.channels) >= 0xFFFF:
            raise UsageError(f"all 65535 channels towards {self.peer} are in use")
        slot = self._next_channel
        while slot in self.channels:
            slot = slot % 0xFFFF + 1
        self._next_channel = slot % 0xFFFF + 1
        counters = self.ledger.topic(stream.id.topic, stream.spec.priority)
        channel = OutChannel(slot, stream, counters, self._on_dropped, first=first)
        channel.owed = owed
        channel.wanted = wanted
        channel.codec = self._new_codec(stream)
        if self.fates is not None:
            channel.on_count = partial(self._counted, self.fates, stream)
        channel.prime(replays, now=now)
        self.channels[slot] = channel
        self.by_stream[stream.id] = channel
        self.texts.use_outgoing(slot, _digest(stream), stream.info.definition)
        if self.established:
            self._announce(channel, now)
        return channel

    def _counted(self, fates: Fates, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        fates.dropped(stream, seq, reason, self.peer)

    def _dropped(self, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        if self.channels.get(channel.slot) is channel:
            topic = channel.stream.id.topic
            for out in outs[:MAX_TRACED]:
                self.trace.record(self._now, topic, TraceEvent.DROPPED, seq=out.seq, reason=reason, peer=self.peer)
            self._tell(self.handler.on_out_drop, self, channel, outs, reason)

    def close_channel(self, channel: OutChannel, reason: DropReason, *, now: float) -> None:
        """The stream is gone: tell the peer, drop what is left for `reason`."""
        self._now = now
        channel.clear(reason)
        channel.ready = False
        self._refresh(channel, now)
        self.channels.pop(channel.slot, None)
        self.cadences.forget(channel.slot)
        if self.by_stream.get(channel.stream.id) is channel:
            del self.by_stream[channel.stream.id]
        self.texts.use_outgoing(channel.slot, "")
        if self.established:
            self.send_control({"t": "retract", "ch": channel.slot}, now=now)

    def _announce(self, channel: OutChannel, now: float) -> None:
        stream = channel.stream
        digest = _digest(stream)
        self.texts.use_outgoing(channel.slot, digest)  # in another session its origin may say another
        owed = channel.owed if channel.reliable else ()
        announcement = Announcement(channel.slot, stream, digest, channel.first_seq, owed)
        channel.ready = False
        seq = 0
        for envelope in announcement_parts(announcement):
            seq = self.send_control(envelope, now=now)
        beside = channel.spec.priority is PriorityClass.CONTROL and self.express is not None
        if self.lane.lossless and self._resumed and channel.wanted and not beside:
            # On a stream lane data may follow its announcement at once, if the same peer wanted it before.
            self._announcing.append((seq, channel))
        self._refresh(channel, now)

    def _control_sent(self, seq: int) -> None:
        while self._announcing and self._announcing[0][0] <= seq:
            channel = self._announcing.popleft()[1]
            if self.channels.get(channel.slot) is channel:
                channel.ready = True
                self._refresh(channel, self._now)

    def send_control(self, envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int:
        """Queue a control message: reliable and in order within the session. Returns its number, 0 without a session:
        then it is not sent; every session tells everything anew."""
        if not self.established:
            return 0
        control = self._control
        body = framing.encode_control(envelope, attachment)
        seq = control.next_seq
        control.submit(Message(control.stream.id, seq, body, 0, now), now=now, forced=True)
        self.dirty = True
        return seq

    # --- streams in -----------------------------------------------------------------------------------------------

    def refuse(self, stream: InStream, code: str, text: str, *, now: float) -> None:
        """Take back what `on_announce` allowed (an access rule changed)."""
        if self.established and stream.channel_id is not None:
            self._forget_answers(stream)
            self.send_control({"t": "refuse", "ch": stream.channel_id, "code": code, "why": text[:400]}, now=now)

    def _announced(self, announcement: Announcement, now: float) -> None:
        identity = announcement.stream.id
        slot = announcement.channel
        stream = self.streams.get(identity)
        if self.incoming.get(slot, stream) is not stream or (stream and stream.channel_id not in (None, slot)):
            raise WireError(f"channel {slot} or its stream {identity.topic!r} is announced twice")
        if stream is not None and not _same_type(stream.stream, announcement):
            self._retract(stream, now)  # the name came back with another type: that is another stream
            stream = None
        if stream is None or stream.stream.spec != announcement.stream.spec:
            replaced = stream
            stream = InStream(
                announcement.stream, self.reassembly, self._deliver, self._in_drop, first=announcement.first
            )
            if replaced is not None:  # the origin was configured anew: what was delivered stays delivered
                stream.delivered, stream.confirmed = replaced.delivered, replaced.confirmed
                stream.unhandled = replaced.unhandled
                replaced.close()
            self.streams[identity] = stream
        self._missing.pop(identity, None)
        stream.channel_id = slot
        self.incoming[slot] = stream
        self._expect_answer(stream, slot)
        digest = stream.stream.definition_hash = announcement.definition_hash
        self.texts.use_incoming(identity, digest)
        if digest and self.texts.lacks(digest):
            self.send_control({"t": "need", "dh": digest}, now=now)
        try:
            wanted = self._offer_stream(stream, announcement, now)
        except RefusedError as refusal:
            self.incoming.pop(slot, None)
            self.streams.pop(identity, None)
            self._forget_answers(stream)
            self.texts.use_incoming(identity, "")
            self._watermarks.pop(slot, None)
            stream.channel_id = None
            stream.close()
            self.send_control({"t": "refuse", "ch": slot, "code": refusal.code, "why": str(refusal)[:400]}, now=now)
            return
        self._skip(stream, announcement.first, now)
        if stream.reliable and stream.confirmed >= announcement.first:
            self._watermarks[slot] = stream.confirmed  # it may not know: ours was lost with the session
        if wanted is not None:
            self.answer(stream, wanted, now=now)

    def _offer_stream(self, stream: InStream, announcement: Announcement, now: float) -> bool | None:
        """The owner's answer to an announcement. Raises RefusedError, also when it fails twice."""
        for last in (False, True):
            try:
                return self.handler.on_announce(self, announcement, now=now)
            except RemoteError:
                raise
            except Exception as error:
                self.fault(error)
                if last:
                    self._tell(self.handler.on_retract, self, stream, now=now)
                    text = f"{self.name} cannot take {announcement.stream.id.topic}: an error of its own; see its log"
                    raise RefusedError("internal_error", text) from error
        return None

    def _skip(self, stream: InStream, first: int, now: float) -> None:
        stream.skip_to(first, now)
        if stream in self.reassembly.behind:
            self._skipping[stream] = None
        else:
            self._skipped(stream, now)

    def _forget_paused(self, stream: InStream) -> None:
        super()._forget_paused(stream)
        self._skipping.pop(stream, None)  # it is where it was to go on, and nobody is to hear of it later

    def _skipped(self, stream: InStream, now: float) -> None:
        if stream.left_out:
            self._tell(self.handler.on_skipped, self, stream, stream.left_out, now=now)
            self._confirm_own(stream)
        if stream.wanted:
            stream.paused = False

    def _confirm_own(self, stream: InStream) -> None:
        if self.auto_confirm and stream.reliable:
            self.confirm(stream, min(stream.delivered, stream.unhandled - 1) if stream.unhandled else stream.delivered)

    def handled(self, stream: InStream, oldest: int) -> None:
        """Everything that had its turn below seq `oldest` has been dealt with by now; 0: everything."""
        stream.unhandled = oldest
        self._confirm_own(stream)

    def _deliver(self, stream: InStream, message: Message) -> None:
        if self.initiator and stream.perishable:  # at the relay the next hop sees that the relay's clock stood still
            self._fresh.append((stream, message, self.clock.steps))
            self.dirty = True
            return
        try:
            self.handler.on_message(self, stream, message, now=self._now)
        except Exception as error:  # noqa: BLE001  (of one message: the stream goes on, whatever its bodies do)
            self._undelivered(stream, message, error)
        if stream.reliable:
            self._confirm_own(stream)

    def _hand_on(self, now: float) -> None:
        self._now = now
        while self._fresh:
            stream, message, steps = self._fresh.popleft()
            lifespan_s = stream.lifespan_s
            aged = lifespan_s is not None and now - message.born_s + message.error_s > lifespan_s  # while it lay here
            if aged or steps != self.clock.steps:
                self._in_drop(stream, DropReason.LIFESPAN, len(message.body), (message.seq,), reported=False)
                continue
            try:
                self.handler.on_message(self, stream, message, now=now)
            except Exception as error:  # noqa: BLE001  (as in `_deliver`)
                self._undelivered(stream, message, error)

    def _undelivered(self, stream: InStream, message: Message, error: Exception) -> None:
        """The owner failed at a message: it is given up, and its tombstone has the turn."""
        self.fault(error)
        if message.tombstone:
            lost = message
        elif stream.reliable:
            self._in_drop(stream, DropReason.FAULT, len(message.body), (message.seq,), reported=True)
            lost = stream.tombstone(message.seq, DropReason.FAULT, message.stamp_ns, message.born_s)
        else:
            self._in_drop(stream, DropReason.FAULT, len(message.body), (message.seq,), reported=False)
            return
        try:
            self.handler.on_message(self, stream, lost, now=self._now)
        except Exception as again:  # noqa: BLE001
            self.fault(again)

    def _in_drop(self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int], reported: bool) -> None:
        if stream is self._control_in:
            return
        if reported:
            for seq in seqs:
                self.report_drop(stream, seq, reason, self.name, now=self._now)  # its tombstone tells the handler
                self._answered(1)
        else:
            self._tell(self.handler.on_in_drop, self, stream, reason, nbytes, len(seqs))
            if self.fates is not None and reason is not DropReason.DUPLICATE:
                for seq in seqs:
                    self.fates.discarded(stream.stream, seq, reason, self.peer)

    def skip(self, channel: OutChannel, first: int, *, now: float, silent: bool = False) -> None:
        """The stream goes on at seq `first`: what lies between will not come, and the peer must not wait for it.

        `silent`: it was sent before anybody behind the peer wanted it, so there is nothing to report.
        """
        if silent and not channel.retained:
            channel.start_at(first)
            if self.established:
                self._announce(channel, now)
            return
        channel.skip_to(first)
        self._tell_gap(channel, now)

    def leave_out(self, channel: OutChannel, message: Message, reason: DropReason, *, now: float) -> None:
        """Drop a reliable message that cannot be kept at all; the peer is told where the stream goes on."""
        self._now = now
        channel.leave_out(message, reason)
        self._tell_gap(channel, now)

    def _tell_gap(self, channel: OutChannel, now: float) -> None:
        first = channel.next_gap()
        if first is not None and self.established:
            self.send_control({"t": "first", "ch": channel.slot, "seq": first}, now=now)

    def _watermark_moved(self, channel: OutChannel) -> None:
        if channel.gaps:
            self._tell_gap(channel, self._now)
        self._tell(self.handler.on_delivered, self, channel, now=self._now)

    def _synced(self, now: float) -> None:
        """The peer has announced all it has. What it left out is gone, unless it is a relay that is still learning:
        a stream it has not been told of yet keeps its delivered count here, so that "once" survives its restart."""
        for identity, stream in self.streams.items():
            if stream.channel_id is None and identity not in self._missing:
                self._gone.append(stream)
        self._go_on(now)

    def _go_on(self, now: float) -> bool:
        reassembly = self.reassembly
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
            if reassembly.work_us > SLICE_US:
                return False
            self._retract(self._gone.popleft(), now)
        return self._finished(now)

    def _finished(self, now: float) -> bool:
        return self.finish is None or self.finish(self, now)

    def outlived(self, origin: ClientName, boot: int, *, now: float) -> None:
        """A process of `origin` is there, `boot`: what a new relay has not been told of the ones before is gone."""
        for identity in [each for each in self._missing if each.origin == origin and each.boot != boot]:
            self._retract(self.streams[identity], now)

    def _retract(self, stream: InStream, now: float) -> None:
        self._hand_on(now)
        self.streams.pop(stream.stream.id, None)
        self._missing.pop(stream.stream.id, None)
        self.texts.use_incoming(stream.stream.id, "")
        if stream.channel_id is not None:
            self.incoming.pop(stream.channel_id, None)
            self._watermarks.pop(stream.channel_id, None)
        self._forget_answers(stream)
        self._skipping.pop(stream, None)
        self._tell(self.handler.on_retract, self, stream, now=now)
        stream.close()
        stream.channel_id = None

    def _sweep(self, now: float) -> None:
        super()._sweep(now)
        if now >= self._tidy_due_s:
            self._tidy_due_s = now + TIDY_S
            self.ledger.tidy({channel.counters.topic for channel in self.channels.values()}, now=now)
            if self.on_tidy is not None:
                self.on_tidy(now)
        if self.established:
            for stream in self.streams.values():
                stream.sweep(now, self._up_since_s)
        for identity, since_s in list(self._missing.items()):
            if now - since_s > self.params.retention_s:
                self._retract(self.streams[identity], now)

    # --- control messages -------------------------------------------------------------------------------------------

    def _control_message(self, stream: InStream, message: Message) -> None:
        now = self._now
        self.reassembly.work_us += CONTROL_US + len(message.body) // CONTROL_BYTES_PER_US
        room = self._attachments_left + (now - self._attachments_s) * ATTACHMENT_BYTES_PER_S
        self._attachments_left, self._attachments_s = min(room, float(ATTACHMENT_BURST_BYTES)), now
        most = min(int(self._attachments_left), framing.MAX_ATTACHMENT_BYTES)
        envelope, attachment = framing.decode_control(message.body, max_bytes=most)
        self._attachments_left -= len(attachment)
        self.reassembly.work_us += len(attachment) // ATTACHMENT_BYTES_PER_US
        kind = framing.take_str(envelope, "t", max_length=16)
        before = self._control.next_seq
        self._handle_control(kind, envelope, attachment, now)
        said = self._control.next_seq - before
        # Reports of drops are repeated at an announcement: ours to say, not an answer, which comes later.
        self._answered(1 if kind == "announce" else said)

    def _answered(self, count: int) -> None:
        """The peer made us say `count` things. Raises WireError if it never reads what it makes us say."""
        control = self._control
        if control.watermark >= self._unheard_seq:
            self._unheard, self._unheard_seq = 0, control.next_seq - 1
        self._unheard += count
        if self._unheard > MAX_UNHEARD + 4 * (len(self.channels) + len(self.incoming)):
            raise WireError(f"{self.peer} does not read {self._unheard} answers and goes on asking")

    def _handle_control(self, kind: str, envelope: framing.Envelope, attachment: bytes, now: float) -> None:
        if kind == "announce":
            announcement = decode_announcement(envelope)
            owed = self._owed_so_far(("announce", announcement.channel), announcement.owed, more=announcement.more)
            if owed is not None:
                self._announced(replace(announcement, owed=owed), now)
        elif kind == "want":
            self._answers(decode_want(envelope), now)
        elif kind in ("refuse", "dropped"):
            channel = self.channels.get(framing.take_int(envelope, "ch", high=0xFFFF))
            if channel is not None:  # else closed meanwhile
                self._about_channel(kind, channel, envelope, now)
        elif kind in ("first", "retract"):
            slot = framing.take_int(envelope, "ch", high=0xFFFF)
            incoming = self.incoming.get(slot)
            if incoming is None:
                return
            if kind == "first":
                incoming.known = True  # had it been nobody's before, it would have been announced again
                self._skip(incoming, framing.take_int(envelope, "seq", low=1, high=framing.MAX_SEQ), now)
            else:
                self._retract(incoming, now)
        elif kind == "synced":
            self._interest.batches = framing.take_bool(envelope, "batch")
            self._synced(now)
        elif kind == "need":
            digest = framing.take_str(envelope, "dh", max_length=64)
            self._define(digest, self.texts.asked(digest), now)
        elif kind == "define":
            digest = framing.take_str(envelope, "dh", max_length=64)
            if self.texts.came(digest, attachment):
                self._tell(self.handler.on_definition, self, digest, now=now)
        else:
            self.handler.on_control(self, envelope, attachment, now=now)

    def _about_channel(self, kind: str, channel: OutChannel, envelope: framing.Envelope, now: float) -> None:
        if kind == "dropped":
            reason = DROP_REASONS.get(framing.take_int(envelope, "code"), DropReason.LOST)
            where = framing.take_str(envelope, "to", max_length=64, default="") or SEVERAL
            self.reassembly.work_us += len(channel.retained) // RETAINED_PER_US
            count = framing.take_int(envelope, "n", low=1, high=framing.MAX_SEQ, default=1)
            self.reassembly.work_us += channel.reported(framing.take_int(envelope, "seq"), reason, where, count)
        else:
            code, why = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
            self._set_wanted(
                channel, False, now, reason=DropReason.FORBIDDEN if code == "forbidden" else DropReason.UNWANTED
            )
            self._refresh(channel, now)
            self._tell(self.handler.on_refused, self, channel, code, why, now=now)

    def _define(self, digest: str, text: str | None, now: float) -> None:
        if text is not None and self.established:
            self.send_control({"t": "define", "dh": digest}, text.encode(), now=now)

    def definition_known(self, digest: str, *, now: float) -> None:
        """A text arrived from elsewhere: pass it on if this peer is waiting for it."""
        self._define(digest, self.texts.known(digest), now)

    def close_streams(self) -> None:
        """The link is given up: its incoming streams are gone for good."""
        for stream in self.streams.values():
            stream.close()
        self.streams.clear()
        self._skipping.clear()
        self.incoming.clear()
        self._missing.clear()
        self.texts.close()

    @property
    def now(self) -> float:
        """The time of the call under way, for handlers that are told without it."""
        return self._now

    @property
    def deaf(self) -> bool:
        """Whether more waits to be told than any peer leaves behind that reads what it is told."""
        return self._control.retained_bytes > MAX_TOLD_BYTES + MAX_TOLD_CHANNEL_BYTES * len(self.channels)

    # --- views ------------------------------------------------------------------------------------------------------

    def queued(self) -> dict[str, tuple[int, int]]:
        """Messages and bytes that wait for the lane, by class label."""
        cells = {label: [0, 0] for label in CLASS_LABELS}
        for channel in self.channels.values():
            cell = cells[CLASS_LABELS[channel.spec.priority]]
            cell[0] += len(channel.queue) + len(channel.active)
            cell[1] += channel.queued_bytes + sum(out.unsent_bytes for out in channel.active)
        return {label: (messages, nbytes) for label, (messages, nbytes) in cells.items()}

    def snapshot(self) -> dict[str, object]:
        """State for /api/link; None where a value is not known yet."""
        flight = self.lane.flight
        return {
            "peer": self.peer,
            "lane": self.lane.name,
            "up": self.established and not self.lane.stalled,
            "stalled": self.lane.stalled,
            "version": self.version,
            "inflight_bytes": flight.inflight_bytes,
            "srtt_s": flight.rtt.srtt_s,
            "fragment_bytes": self.lane.fragment_bytes,
            "clock_offset_s": self.clock.offset_s,
            "clock_error_s": self.clock.error_s if self.clock.ready else None,
            **self.lane.estimator.snapshot(),
            "queue": {label: {"messages": cell[0], "bytes": cell[1]} for label, cell in self.queued().items()},
        }

    def validate(self) -> None:
        """Internal consistency, for tests. Raises AssertionError with what does not add up."""

        def check(ok: bool, text: str) -> None:
            assert ok, f"{self.name}->{self.peer}: {text}"

        for channel in self.channels.values():
            channel.validate(check)
            waits = bool(channel.ready and channel.wanted and (channel.active or channel.queue))
            check(waits == channel.offered, f"{channel.stream.id.topic}: the scheduler does not know what waits")
        self.ledger.validate([(channel.counters, *channel.held()) for channel in self.channels.values()], check)
        held_bytes = sum(stream.held_bytes for stream in self.streams.values()) + self._control_in.held_bytes
        check(self.reassembly.held_bytes == held_bytes, "reassembly bytes do not add up")
        for stream in self.streams.values():
            stream.validate(check)
        unheard, reports = self.reassembly.unheard, [stream.reports for stream in self.streams.values()]
        check(unheard.reports == sum(map(len, reports)), "reports of drops do not add up")
        check(unheard.said == sum(each.said for each in reports), "reports of drops that were said do not add up")
        for lane in self.lanes.values():
            lane.flight.validate(check)
        self.scheduler.validate()
        check(len(self.by_stream) == len(self.channels), "channel tables differ")
        self.texts.validate()
        check(self._watermarks.keys() <= self.incoming.keys(), "watermarks of streams that are gone")


def _same_type(known: StreamInfo, announced: Announcement) -> bool:
    """Whether bodies of both are to be read in the same way."""
    one, other = known.info, announced.stream.info
    return (
        one.type_name == other.type_name
        and one.encoding is other.encoding
        and one.type_hash == other.type_hash
        and known.definition_hash == announced.definition_hash
    )


def _digest(stream: StreamInfo) -> str:
    """What the stream's definition is called; empty for none."""
    return stream.definition_hash or definition_hash(stream.info.definition)
