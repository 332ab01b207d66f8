"""The streams that one end of a hop has for the other: announced, wanted or not, refused, gone. Pure."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from sern_core.link.control_stream import ControlStream
from sern_core.link.definitions import PeerDefinitions
from sern_core.link.end import End
from sern_core.link.events import Events
from sern_core.link.name_lists import NameLists
from sern_core.link.sender import Sender
from sern_core.stream.in_stream import Reassembly
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.fates import Fates
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import DROP_REASONS, DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, Want, announcement_parts, definition_hash

MAX_NAMED: Final = 0x10000
"""Price of the answers of one datagram, beside that of one for each open channel: a few bytes name many channels."""
ANSWER_PRICE: Final = 16
"""What an answer about an open channel costs, next to one about a channel that is closed."""
NAMED_PER_US: Final = 16
ANSWER_US: Final = 6
NAMES_PER_US: Final = 16
"""What naming channels, answers about open ones, and lists of names are charged with (`Reassembly.work_us`)."""
RETAINED_PER_US: Final = 16
"""What a report of drops is charged with, for what it looks through."""
ANNOUNCE_US: Final = 12
"""What a session that begins is charged with for each stream that is announced in it."""
SEVERAL: Final = "several clients"
"""Who will not get a message when the report of its drop names nobody; it is no client's name."""


class StreamsOut:
    """`at_once(channel)` says whether data may follow an announcement without waiting for the answer."""

    def __init__(
        self,
        end: End,
        control: ControlStream,
        sender: Sender,
        texts: PeerDefinitions,
        name_lists: NameLists,
        reassembly: Reassembly,
        events: Events,
        *,
        at_once: Callable[[OutChannel], bool],
    ) -> None:
        self._end = end
        self._control = control
        self._sender = sender
        self._texts = texts
        self._name_lists = name_lists
        self._reassembly = reassembly
        self._events = events
        self._at_once = at_once
        self.by_stream: dict[StreamId, OutChannel] = {}
        self._next_channel_id = 1
        self._on_dropped = self._dropped  # one for all channels
        self._announcing: deque[tuple[int, OutChannel]] = deque()  # may send once that control message is on its way
        self._price = self._priced_us = 0  # of the answers that came at this time
        self.declined: OutChannel | None = None
        """The channel of which the peer says just now that nobody behind it wants it."""

    # --- our streams ----------------------------------------------------------------------------------------------

    def begin(self, now: float) -> None:
        """A session has begun: announce everything."""
        channels = self._sender.channels
        self._reassembly.work_us += ANNOUNCE_US * len(channels)
        for channel in list(channels.values()):
            self.announce(channel, now)

    def forget_announced(self) -> None:
        """What was announced in an earlier session is none of the one that begins."""
        self._announcing.clear()

    def open(
        self,
        stream: StreamInfo,
        *,
        first: int,
        now: float,
        required: tuple[str, ...] = (),
        wanted: bool | None = None,
        replays: Sequence[Message] = (),
    ) -> OutChannel:
        """Announce a stream to the peer; its messages start at seq `first`, after the latched `replays`, oldest first.

        Raises UsageError if it is open already, or cannot be announced at all.
        """
        peer, channels = self._end.peer, self._sender.channels
        if stream.id in self.by_stream:
            raise UsageError(f"stream {stream.id.topic} of {stream.id.origin} is already open towards {peer}")
        if len(stream.info.definition.encode()) > framing.MAX_ATTACHMENT_BYTES:
            raise UsageError(f"the definition of {stream.id.topic} exceeds {framing.MAX_ATTACHMENT_BYTES} bytes")
        if len(channels) >= 0xFFFF:
            raise UsageError(f"all 65535 channels towards {peer} are in use")
        channel_id = self._next_channel_id
        while channel_id in channels:
            channel_id = channel_id % 0xFFFF + 1
        self._next_channel_id = channel_id % 0xFFFF + 1
        counters = self._sender.ledger.topic(stream.id.topic, stream.spec.priority)
        codec = self._sender.new_codec(stream)
        channel = OutChannel(channel_id, stream, counters, self._on_dropped, first=first, codec=codec)
        channel.required = required
        channel.wanted = wanted
        if self._end.fates is not None:
            channel.drops.on_count = partial(self._counted, self._end.fates, stream)
        channels[channel_id] = channel
        self.prime(channel, replays, now=now)
        self.by_stream[stream.id] = channel
        self._texts.use_outgoing(channel_id, _digest(stream), stream.info.definition)
        if self._end.established:
            self.announce(channel, now)
        return channel

    def prime(self, channel: OutChannel, replays: Sequence[Message], *, now: float) -> None:
        """Put latched messages (oldest first, marked as replays) ahead of what waits in a channel."""
        primed = channel.prime(replays, now=now)
        if primed and self._end.trace.enabled:
            self._sender.told.replayed(channel, primed, now)

    def _counted(self, fates: Fates, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        fates.dropped(stream, seq, reason, self._end.peer)

    def _dropped(self, channel_id: int, outs: Sequence[OutMessage], reason: DropReason) -> None:
        channel = self._sender.channels.get(channel_id)
        if channel is not None:
            if self._end.trace.enabled:
                self._sender.told.dropped(channel, outs, reason, self._end.now)
            self._events.dropped(channel, outs, reason)

    def close(self, channel: OutChannel, reason: DropReason, *, now: float) -> None:
        """The stream is gone: tell the peer, drop what is left for `reason`."""
        self._end.now = now
        channel.clear(reason)
        channel.ready = False
        self._sender.refresh(channel, now)
        self._sender.channels.pop(channel.channel_id, None)
        self._sender.told.forget(channel)
        self._sender.cadences.forget(channel.channel_id)
        if self.by_stream.get(channel.stream.id) is channel:
            del self.by_stream[channel.stream.id]
        self._texts.use_outgoing(channel.channel_id, "")
        self._control.send({"t": "retract", "ch": channel.channel_id}, now=now)

    def announce(self, channel: OutChannel, now: float) -> None:
        """Tell the peer that the stream is there, on its channel."""
        stream = channel.stream
        digest = _digest(stream)
        self._texts.use_outgoing(channel.channel_id, digest)  # in another session its origin may say another
        required = channel.required if channel.reliable else ()
        announcement = Announcement(channel.channel_id, stream, digest, channel.first_seq, required)
        channel.ready = False
        seq = 0
        for envelope in announcement_parts(announcement):
            seq = self._control.send(envelope, now=now)
        if self._at_once(channel):
            self._announcing.append((seq, channel))
        self._sender.refresh(channel, now)

    def control_sent(self, seq: int) -> None:
        """Control message `seq` is on the wire."""
        while self._announcing and self._announcing[0][0] <= seq:
            channel = self._announcing.popleft()[1]
            if self._sender.channels.get(channel.channel_id) is channel:
                channel.ready = True
                self._sender.refresh(channel, self._end.now)

    def rest(self, channel: OutChannel, *, now: float) -> None:
        """Keep nothing of a stream for the peer until it says that it wants it: what it has not got is dropped."""
        self._end.now = now
        self._set_wanted(channel, False, DropReason.UNWANTED)
        self._sender.refresh(channel, now)

    # --- gaps -----------------------------------------------------------------------------------------------------

    def skip(self, channel: OutChannel, first: int, *, now: float, silent: bool = False) -> None:
        """The stream goes on at seq `first`: what lies between will not come, and the peer must not wait for it.

        `silent`: it was sent before anybody behind the peer wanted it, so there is nothing to report.
        """
        if silent and not channel.retained:
            channel.start_at(first)
            if self._end.established:
                self.announce(channel, now)
            return
        channel.skip_to(first)
        self._tell_gap(channel, now)

    def leave_out(self, channel: OutChannel, message: Message, reason: DropReason, *, now: float) -> None:
        """Drop a reliable message that cannot be kept at all; the peer is told where the stream goes on."""
        self._end.now = now
        channel.leave_out(message, reason)
        self._tell_gap(channel, now)

    def _tell_gap(self, channel: OutChannel, now: float) -> None:
        first = channel.next_gap()
        if first is not None:
            self._control.send({"t": "first", "ch": channel.channel_id, "seq": first}, now=now)

    def delivered(self, channel: OutChannel) -> None:
        """The peer's watermark of a channel has moved."""
        now = self._end.now
        if channel.gaps:
            self._tell_gap(channel, now)
        self._events.delivered(channel, now=now)

    # --- what the peer says of them -------------------------------------------------------------------------------

    def answered(self, want: Want, now: float) -> None:
        """The peer has said whether it wants streams of ours. Raises WireError for more answers than questions."""
        end, reassembly = self._end, self._reassembly
        if not end.towards_relay:
            # Who is required is for origins to remember: a client that takes a stream speaks for itself alone.
            want = replace(want, required=(), add=(), drop=())
            if want.more:
                return
        first = want.runs[0][0]
        if want.more:
            self._name_lists.add(("want", first), want.required or (), more=True, peer=end.peer)
            return
        required = None
        if want.required is not None:
            required = self._name_lists.add(("want", first), want.required, more=False, peer=end.peer)
        changed: dict[int, tuple[tuple[str, ...], tuple[str, ...]]] = {}  # by identity: who was required, who is now
        for first, last in want.runs:
            self._charge(last - first + 1, now)
            reassembly.work_us += (last - first + 1) // NAMED_PER_US
            for channel_id in range(first, last + 1):
                channel = self._sender.channels.get(channel_id)
                if channel is not None:  # else closed meanwhile
                    self._charge(ANSWER_PRICE, now)
                    reassembly.work_us += ANSWER_US
                    if required is None:
                        before = channel.required
                        if id(before) not in changed:  # channels with the same required clients share one list
                            changed[id(before)] = before, self._changed(before, want)
                        channel.required = changed[id(before)][1]
                    else:
                        channel.required = required
                    self._answer_came(channel, want, now)

    def _changed(self, before: tuple[str, ...], want: Want) -> tuple[str, ...]:
        """What an answer by difference makes of a list of names."""
        self._reassembly.work_us += len(before) // NAMES_PER_US
        names = dict.fromkeys(before) | dict.fromkeys(want.add)
        for name in want.drop:
            names.pop(name, None)
        most = self._end.params.limits.required
        if len(names) > most:
            raise WireError(f"{self._end.peer} owes a stream to more than {most} names")
        return tuple(names)

    def _charge(self, price: int, now: float) -> None:
        """Raises WireError if the peer answers more in one datagram than there is to be answered."""
        now_us = int(now * 1e6)
        if now_us != self._priced_us:
            self._price, self._priced_us = 0, now_us
        self._price += price
        channels = len(self._sender.channels)
        if self._price > MAX_NAMED + 2 * ANSWER_PRICE * channels:
            raise WireError(f"{self._end.peer} answers the announcements of {channels} channels again and again")

    def _answer_came(self, channel: OutChannel, want: Want, now: float) -> None:
        if want.on and channel.wanted is False and channel.reliable:
            self._control.send({"t": "first", "ch": channel.channel_id, "seq": channel.first_seq}, now=now)
        self.declined = None if want.on else channel
        self._set_wanted(channel, want.on, DropReason.UNWANTED)
        self.declined = None
        channel.ready = True
        self._sender.refresh(channel, now)
        self._events.wanted(channel, now=now)

    def _set_wanted(self, channel: OutChannel, wanted: bool, reason: DropReason) -> None:
        watermark = channel.watermark
        self._reassembly.work_us += channel.set_wanted(wanted, reason)
        if channel.watermark > watermark:
            self.delivered(channel)

    def reported(self, channel: OutChannel, envelope: framing.Envelope) -> None:
        """The peer reports drops of a stream of ours. Raises WireError."""
        reason = DROP_REASONS.get(framing.take_int(envelope, "code"), DropReason.LOST)
        where = framing.take_str(envelope, "to", max_length=64, default="") or SEVERAL
        self._reassembly.work_us += len(channel.retained) // RETAINED_PER_US
        count = framing.take_int(envelope, "n", low=1, high=framing.MAX_SEQ, default=1)
        self._reassembly.work_us += channel.reported(framing.take_int(envelope, "seq"), reason, where, count)

    def refused(self, channel: OutChannel, envelope: framing.Envelope, now: float) -> None:
        """The peer refuses a stream of ours. Raises WireError."""
        code, why = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
        self._set_wanted(channel, False, DropReason.FORBIDDEN if code == "forbidden" else DropReason.UNWANTED)
        self._sender.refresh(channel, now)
        self._events.refused(channel, code, why, now=now)


def _digest(stream: StreamInfo) -> str:
    """What the stream's definition is called; empty for none."""
    return stream.definition_hash or definition_hash(stream.info.definition)
