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
from dataclasses import replace
from typing import Final, Protocol

from sern_core import wire
from sern_core.announce import MAX_STRINGS, Announcement, announcement_parts, decode_announcement, definition_hash
from sern_core.errors import RefusedError, UsageError, WireError
from sern_core.fragments import DropReport, InStream
from sern_core.message import Message, StreamId, StreamInfo
from sern_core.out_message import OutMessage
from sern_core.params import LinkParams, SchedulerParams
from sern_core.queues import OutChannel
from sern_core.session import Session
from sern_core.trace import DecisionTrace, TraceEvent
from sern_core.types import CLASS_LABELS, DROP_CODES, DROP_REASONS, ClientName, DropReason, PriorityClass

MAX_DEFINITIONS: Final = 16_384
"""Texts that a process keeps, of all its peers."""
MAX_PEER_DEFINITIONS: Final = 2048
MAX_PEER_DEFINITION_BYTES: Final = 16 * 2**20
"""Texts that one peer may add; all types of a ROS distribution together have less than 2 MB."""
MAX_OWED: Final = 8192
"""Names in lists that have begun and not ended."""
ATTACHMENT_BURST_BYTES: Final = 6 * 2**20
ATTACHMENT_BYTES_PER_S: Final = 64 * 2**20
"""What a peer's attachments may unpack to at once and after that: zlib makes a kilobyte of a megabyte of blank lines,
and takes 2 ms to unpack it."""
MAX_UNHEARD: Final = 20_000
"""Control messages that a peer may have answered, beside four for each channel, before it reads an answer."""


class LinkHandler(Protocol):
    """What the owner of a link is told. Calls happen inside `receive`, `submit` and `handle_timeout`."""

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

    def on_in_drop(self, link: "Link", stream: InStream, reason: DropReason, nbytes: int) -> None: ...

    def on_out_drop(self, link: "Link", channel: OutChannel, out: OutMessage, reason: DropReason) -> None: ...

    def on_delivered(self, link: "Link", channel: OutChannel, *, now: float) -> None:
        """The peer's watermark of a reliable channel moved to `channel.watermark`."""

    def on_wanted(self, link: "Link", channel: OutChannel, *, now: float) -> None:
        """The peer has said whether it wants the stream: `channel.wanted`. Said again after every change."""

    def on_refused(self, link: "Link", channel: OutChannel, code: str, text: str, *, now: float) -> None: ...

    def on_skipped(self, link: "Link", stream: InStream, count: int, *, now: float) -> None:
        """`count` messages of the stream will not come; they were reported where they were dropped."""

    def on_definition(self, link: "Link", digest: str, *, now: float) -> None:
        """`Link.definitions` has a new text."""

    def on_control(self, link: "Link", envelope: wire.Envelope, attachment: bytes, *, now: float) -> None:
        """A control message that is not the link's own business. Raises WireError if it is nobody's."""


class Link(Session):
    """One end of one hop towards `peer`.

    `definitions` maps digest to text and is shared by all links of a process. `auto_confirm`: what had its turn here
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
        definitions: dict[str, str],
        link: LinkParams,
        scheduler: SchedulerParams,
        trace: DecisionTrace,
        now: float,
        lossless: bool = True,
        auto_confirm: bool = True,
    ) -> None:
        self.handler = handler
        self.definitions = definitions
        self.auto_confirm = auto_confirm
        self.by_stream: dict[StreamId, OutChannel] = {}
        self.streams: dict[StreamId, InStream] = {}
        """Incoming streams across sessions."""
        self._next_channel = 1
        self._asked: set[str] = set()  # definitions the peer asked for before we had them
        self._told: set[str] = set()  # definitions the peer has had in the session
        self._needed: set[str] = set()  # definitions we asked the peer for, not here yet
        self._peer_definitions = self._peer_definition_bytes = 0
        self._unheard = 0  # answers since the peer acknowledged the one of number `_unheard_seq`
        self._unheard_seq = 0
        self._attachments_left = float(ATTACHMENT_BURST_BYTES)
        self._attachments_s = 0.0
        self._owed_parts: dict[tuple[str, int], tuple[str, ...]] = {}  # by message and channel: more will come
        self._announcing: deque[tuple[int, OutChannel]] = deque()  # may send once that control message is on its way
        self._missing: dict[StreamId, float] = {}  # not announced by a new peer, and since when
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
        self._asked.clear()
        self._told.clear()
        self._needed.clear()
        self._unheard = self._unheard_seq = 0
        self._announcing.clear()
        self._owed_parts.clear()
        self.handler.on_up(self, resumed=resumed, now=now)
        for channel in list(self.channels.values()):
            self._announce(channel, now)
        self.send_control({"t": "synced"}, now=now)

    def _session_ended(self, reason: str, now: float) -> None:
        self.handler.on_down(self, reason, now=now)

    def _lane_closed(self) -> None:
        self.handler.on_lane_closed(self)

    def _session_refused(self, code: str, text: str, now: float) -> None:
        self.handler.on_rejected(self, code, text, now=now)

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
        if len(stream.info.definition.encode()) > wire.MAX_ATTACHMENT_BYTES:
            raise UsageError(f"the definition of {stream.id.topic} exceeds {wire.MAX_ATTACHMENT_BYTES} bytes")
        if len(self.channels) >= 0xFFFF:
            raise UsageError(f"all 65535 channels towards {self.peer} are in use")
        slot = self._next_channel
        while slot in self.channels:
            slot = slot % 0xFFFF + 1
        self._next_channel = slot % 0xFFFF + 1
        counters = self.ledger.topic(stream.id.topic, stream.spec.priority)
        channel = OutChannel(slot, stream, counters, self._reporter(slot), first=first)
        channel.owed = owed
        channel.wanted = wanted
        channel.codec = self._new_codec(stream)
        channel.prime(replays, now=now)
        self.channels[slot] = channel
        self.by_stream[stream.id] = channel
        self._define(stream.info.definition)
        if self.established:
            self._announce(channel, now)
        return channel

    def _reporter(self, slot: int) -> Callable[[OutMessage, DropReason], None]:
        def dropped(out: OutMessage, reason: DropReason) -> None:
            channel = self.channels.get(slot)
            if channel is not None:
                topic = channel.stream.id.topic
                self.trace.record(self._now, topic, TraceEvent.DROPPED, seq=out.seq, reason=reason, peer=self.peer)
                self.handler.on_out_drop(self, channel, out, reason)

        return dropped

    def close_channel(self, channel: OutChannel, reason: DropReason, *, now: float) -> None:
        """The stream is gone: tell the peer, drop what is left for `reason`."""
        self._now = now
        channel.clear(reason)
        channel.ready = False
        self._refresh(channel, now)
        self.channels.pop(channel.slot, None)
        self.cadences.forget(channel.slot)
        self.by_stream.pop(channel.stream.id, None)
        if self.established:
            self.send_control({"t": "retract", "ch": channel.slot}, now=now)

    def _announce(self, channel: OutChannel, now: float) -> None:
        stream = channel.stream
        digest = stream.attributes.get("definition") or definition_hash(stream.info.definition)
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

    def send_control(self, envelope: wire.Envelope, attachment: bytes = b"", *, now: float) -> int:
        """Queue a control message: reliable and in order within the session. Returns its number, 0 without a session:
        then it is not sent; every session tells everything anew."""
        if not self.established:
            return 0
        control = self._control
        body = wire.encode_control(envelope, attachment)
        seq = control.next_seq
        control.submit(Message(control.stream.id, seq, body, 0, now), now=now, forced=True)
        self.dirty = True
        return seq

    def report_drop(self, stream: InStream, seq: int, reason: DropReason, where: str, *, now: float) -> None:
        """Tell the origin's side that a reliable message was dropped here or further on: before the watermark passes
        it, and again in the next session until it is known there."""
        report = DropReport(seq, reason, where)
        stream.reports.append(report)
        self._send_report(stream, report, now)

    def _send_report(self, stream: InStream, report: DropReport, now: float) -> None:
        if stream.channel_id is not None:
            code = DROP_CODES[report.reason]
            envelope = {"t": "dropped", "ch": stream.channel_id, "seq": report.seq, "code": code, "to": report.where}
            report.control_seq = self.send_control(envelope, now=now)

    # --- streams in -----------------------------------------------------------------------------------------------

    def answer(self, stream: InStream, wanted: bool, *, now: float, owed: tuple[str, ...] = ()) -> None:
        """Tell the peer whether its stream is wanted; `owed` names the clients that must get a reliable one."""
        stream.wanted = wanted
        stream.paused = stream.paused or not wanted
        stream.pause_seq = 0
        if self.established and stream.channel_id is not None:
            seq = 0
            for start in range(0, max(1, len(owed)), MAX_STRINGS):
                part, more = list(owed[start : start + MAX_STRINGS]), start + MAX_STRINGS < len(owed)
                envelope = {"t": "want", "ch": stream.channel_id, "on": wanted, "owed": part, "more": more}
                seq = self.send_control(envelope, now=now)
            if not wanted:
                stream.pause_seq = seq

    def refuse(self, stream: InStream, code: str, text: str, *, now: float) -> None:
        """Take back what `on_announce` allowed (an access rule changed)."""
        if self.established and stream.channel_id is not None:
            self.send_control({"t": "refuse", "ch": stream.channel_id, "code": code, "why": text[:400]}, now=now)

    def _announced(self, announcement: Announcement, now: float) -> None:
        identity = announcement.stream.id
        slot = announcement.channel
        stream = self.streams.get(identity)
        if self.incoming.get(slot, stream) is not stream or (stream and stream.channel_id not in (None, slot)):
            raise WireError(f"channel {slot} or its stream {identity.topic!r} is announced twice")
        if stream is None or stream.stream.spec != announcement.stream.spec:
            replaced = stream
            stream = InStream(
                announcement.stream, self.reassembly, self._deliver, self._in_drop, first=announcement.first
            )
            if replaced is not None:  # the origin was configured anew: what was delivered stays delivered
                stream.delivered = stream.confirmed = replaced.delivered
                replaced.close()
            self.streams[identity] = stream
        self._missing.pop(identity, None)
        stream.channel_id = slot
        self.incoming[slot] = stream
        for report in stream.reports:
            self._send_report(stream, report, now)
        definition = self.definitions.get(announcement.definition_hash, "")
        if announcement.definition_hash:
            stream.stream.attributes["definition"] = announcement.definition_hash
            if not definition and announcement.definition_hash not in self._needed:
                self._needed.add(announcement.definition_hash)
                self.send_control({"t": "need", "dh": announcement.definition_hash}, now=now)
        try:
            wanted = self.handler.on_announce(self, announcement, now=now)
        except RefusedError as refusal:
            del self.incoming[slot]
            del self.streams[identity]
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

    def _skip(self, stream: InStream, first: int, now: float) -> None:
        left_out = stream.skip_to(first, now)
        if left_out:
            self.handler.on_skipped(self, stream, left_out, now=now)
            self._confirm_own(stream)
        if stream.wanted:
            stream.paused = False

    def _confirm_own(self, stream: InStream) -> None:
        if self.auto_confirm and stream.reliable:
            self.confirm(stream, min(stream.delivered, stream.unhandled - 1) if stream.unhandled else stream.delivered)

    def handled(self, stream: InStream, oldest: int) -> None:
        """Of what had its turn, everything below seq `oldest` has been dealt with by now; 0: everything."""
        stream.unhandled = oldest
        self._confirm_own(stream)

    def _deliver(self, stream: InStream, message: Message) -> None:
        self.handler.on_message(self, stream, message, now=self._now)
        if stream.reliable:
            self._confirm_own(stream)

    def _in_drop(self, stream: InStream, reason: DropReason, nbytes: int, seq: int) -> None:
        if stream is self._control_in:
            return
        if seq:
            self.report_drop(stream, seq, reason, self.name, now=self._now)  # its tombstone tells the handler
            self._answered(1)
        else:
            self.handler.on_in_drop(self, stream, reason, nbytes)

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

    def _tell_gap(self, channel: OutChannel, now: float) -> None:
        first = channel.next_gap()
        if first is not None and self.established:
            self.send_control({"t": "first", "ch": channel.slot, "seq": first}, now=now)

    def _watermark_moved(self, channel: OutChannel) -> None:
        if channel.gaps:
            self._tell_gap(channel, self._now)
        self.handler.on_delivered(self, channel, now=self._now)

    def _synced(self, now: float) -> None:
        """The peer has announced all it has. What it left out is gone, unless it is a relay that is still learning:
        a stream it has not been told of yet keeps its delivered count here, so that "once" survives its restart."""
        for identity, stream in list(self.streams.items()):
            if stream.channel_id is None:
                if self.initiator and (identity in self._missing or not self._resumed):
                    self._missing.setdefault(identity, now)
                else:
                    self._retract(stream, now)

    def _retract(self, stream: InStream, now: float) -> None:
        self.streams.pop(stream.stream.id, None)
        self._missing.pop(stream.stream.id, None)
        if stream.channel_id is not None:
            self.incoming.pop(stream.channel_id, None)
            self._watermarks.pop(stream.channel_id, None)
        self.handler.on_retract(self, stream, now=now)
        stream.close()
        stream.channel_id = None

    def _sweep(self, now: float) -> None:
        super()._sweep(now)
        if self.established:
            for stream in self.streams.values():
                stream.sweep(now, self._up_since_s)
        for identity, since_s in list(self._missing.items()):
            if now - since_s > self.params.retention_s:
                self._retract(self.streams[identity], now)

    # --- control messages -------------------------------------------------------------------------------------------

    def _control_message(self, stream: InStream, message: Message) -> None:
        now = self._now
        room = self._attachments_left + (now - self._attachments_s) * ATTACHMENT_BYTES_PER_S
        self._attachments_left, self._attachments_s = min(room, float(ATTACHMENT_BURST_BYTES)), now
        most = min(int(self._attachments_left), wire.MAX_ATTACHMENT_BYTES)
        envelope, attachment = wire.decode_control(message.body, max_bytes=most)
        self._attachments_left -= len(attachment)
        kind = wire.take_str(envelope, "t", max_length=16)
        before = self._control.next_seq
        self._handle_control(kind, envelope, attachment, now)
        said = self._control.next_seq - before
        # Reports of drops are repeated at an announcement: those are ours to say, not an answer.
        self._answered(min(1, said) if kind == "announce" else said)

    def _answered(self, count: int) -> None:
        """The peer made us say `count` things. Raises WireError if it never reads what it makes us say."""
        control = self._control
        if control.watermark >= self._unheard_seq:
            self._unheard, self._unheard_seq = 0, control.next_seq - 1
        self._unheard += count
        if self._unheard > MAX_UNHEARD + 4 * (len(self.channels) + len(self.incoming)):
            raise WireError(f"{self.peer} does not read {self._unheard} answers and goes on asking")

    def _handle_control(self, kind: str, envelope: wire.Envelope, attachment: bytes, now: float) -> None:
        if kind == "announce":
            announcement = decode_announcement(envelope)
            owed = self._owed_so_far(("announce", announcement.channel), announcement.owed, more=announcement.more)
            if owed is not None:
                self._announced(replace(announcement, owed=owed), now)
        elif kind in ("want", "refuse", "dropped"):
            channel = self.channels.get(wire.take_int(envelope, "ch", high=0xFFFF))
            if channel is not None:  # else closed meanwhile
                self._about_channel(kind, channel, envelope, now)
        elif kind in ("first", "retract"):
            slot = wire.take_int(envelope, "ch", high=0xFFFF)
            incoming = self.incoming.get(slot)
            if incoming is None:
                return
            if kind == "first":
                incoming.known = True  # had it been nobody's before, it would have been announced again
                self._skip(incoming, wire.take_int(envelope, "seq", low=1, high=wire.MAX_SEQ), now)
            else:
                self._retract(incoming, now)
        elif kind == "synced":
            self._synced(now)
        elif kind == "need":
            self._send_definition(wire.take_str(envelope, "dh", max_length=64), now)
        elif kind == "define":
            self._defined(envelope, attachment, now)
        else:
            self.handler.on_control(self, envelope, attachment, now=now)

    def _owed_so_far(self, key: tuple[str, int], names: tuple[str, ...], *, more: bool) -> tuple[str, ...] | None:
        """The names of a list that travels in parts, once it is complete."""
        if more:
            if sum(map(len, self._owed_parts.values())) + len(names) > MAX_OWED:
                raise WireError(f"{self.peer} leaves lists of more than {MAX_OWED} names unfinished")
            self._owed_parts[key] = self._owed_parts.get(key, ()) + names
            return None
        return self._owed_parts.pop(key, ()) + names

    def _about_channel(self, kind: str, channel: OutChannel, envelope: wire.Envelope, now: float) -> None:
        if kind == "want":
            wanted = wire.take_bool(envelope, "on")
            names = tuple(wire.take_strings(envelope, "owed", max_length=64))
            owed = self._owed_so_far(("want", channel.slot), names, more=wire.take_bool(envelope, "more"))
            if owed is None:
                return
            channel.owed = owed
            if wanted and channel.wanted is False and channel.reliable:
                self.send_control({"t": "first", "ch": channel.slot, "seq": channel.first_seq}, now=now)
            self._set_wanted(channel, wanted, now)
            channel.ready = True
            self._refresh(channel, now)
            self.handler.on_wanted(self, channel, now=now)
        elif kind == "dropped":
            reason = DROP_REASONS.get(wire.take_int(envelope, "code"), DropReason.LOST)
            channel.reported(wire.take_int(envelope, "seq"), reason)
        else:
            code, why = wire.take_str(envelope, "code", max_length=64), wire.take_str(envelope, "why")
            self._set_wanted(
                channel, False, now, reason=DropReason.FORBIDDEN if code == "forbidden" else DropReason.UNWANTED
            )
            self._refresh(channel, now)
            self.handler.on_refused(self, channel, code, why, now=now)

    def _set_wanted(
        self, channel: OutChannel, wanted: bool, now: float, *, reason: DropReason = DropReason.UNWANTED
    ) -> None:
        watermark = channel.watermark
        channel.set_wanted(wanted, reason)
        if channel.watermark > watermark:
            self._watermark_moved(channel)

    def _define(self, definition: str) -> None:
        digest = definition_hash(definition)
        if digest and len(self.definitions) < MAX_DEFINITIONS:
            self.definitions.setdefault(digest, definition)

    def _send_definition(self, digest: str, now: float) -> None:
        definition = self.definitions.get(digest)
        if definition is None:
            if len(self._asked) >= MAX_PEER_DEFINITIONS:
                raise WireError(f"{self.peer} asks for more than {MAX_PEER_DEFINITIONS} definitions that nobody has")
            self._asked.add(digest)
        elif digest not in self._told:
            self._told.add(digest)
            self.send_control({"t": "define", "dh": digest}, definition.encode(), now=now)

    def _defined(self, envelope: wire.Envelope, attachment: bytes, now: float) -> None:
        digest = wire.take_str(envelope, "dh", max_length=64)
        try:
            text = attachment.decode()
        except UnicodeDecodeError as error:
            raise WireError("a message definition is not UTF-8") from error
        if definition_hash(text) != digest:
            raise WireError("a message definition does not match its hash")
        if digest not in self._needed:
            raise WireError(f"{self.peer} defines {digest}, which it was not asked for")
        self._needed.discard(digest)
        if digest not in self.definitions:
            self._peer_definitions += 1
            self._peer_definition_bytes += len(attachment)
            if self._peer_definitions > MAX_PEER_DEFINITIONS or self._peer_definition_bytes > MAX_PEER_DEFINITION_BYTES:
                raise WireError(f"{self.peer} sends more definitions than {MAX_PEER_DEFINITION_BYTES} bytes")
            self._define(text)
            self.handler.on_definition(self, digest, now=now)

    def definition_known(self, digest: str, *, now: float) -> None:
        """A text arrived from elsewhere: pass it on if this peer is waiting for it."""
        if digest in self._asked and self.established:
            self._asked.discard(digest)
            self._send_definition(digest, now)

    @property
    def now(self) -> float:
        """The time of the call under way, for handlers that are told without it."""
        return self._now

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
        for lane in self.lanes.values():
            lane.flight.validate(check)
        self.scheduler.validate()
        check(len(self.by_stream) == len(self.channels), "channel tables differ")
        check(self._watermarks.keys() <= self.incoming.keys(), "watermarks of streams that are gone")
