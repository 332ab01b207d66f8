"""The control messages of a session: a reliable stream in each direction, begun anew with it. Pure."""

from collections.abc import Callable
from typing import Final

from sern_core.link.end import End
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, PriorityClass, Reliability, TopicName
from sern_core.wire import framing

CONTROL_CHANNEL_ID: Final = 0
CONTROL_TOPIC: Final = TopicName("/_sern/control")
MAX_CONTROL_BYTES: Final = 2 + framing.MAX_ENVELOPE_BYTES + framing.MAX_ATTACHMENT_BYTES + 1024
"""A control message: envelope and packed attachment (what cannot be packed grows a little)."""
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
"""What a control message is charged with (`Reassembly.work_us`): itself, its size, what its attachment unpacks to."""


class ControlStream:
    """Both directions. `on_message` gets each control message in its turn."""

    def __init__(self, end: End, reassembly: Reassembly, on_message: Callable[[Message], None]) -> None:
        self._end = end
        self._reassembly = reassembly
        self._on_message = on_message
        self._unacked = 0  # answers since the peer acknowledged the one of number `_unacked_seq`
        self._unacked_seq = 0
        self._attachments_left = float(ATTACHMENT_BURST_BYTES)
        self._attachments_s = 0.0
        self.out, self.incoming = self._streams()

    def _streams(self) -> tuple[OutChannel, InStream]:
        spec = TopicSpec(
            priority=PriorityClass.CONTROL,
            reliability=Reliability.RELIABLE,
            lifespan_s=None,
            retention_s=float("inf"),
            max_queue_bytes=2**62,
        )
        info = TopicInfo(CONTROL_TOPIC, "", Encoding.RAW)
        stream = StreamInfo(StreamId(self._end.name, self._end.boot, CONTROL_TOPIC), info, spec)
        counters = SendCounters(CONTROL_TOPIC, PriorityClass.CONTROL)
        out = OutChannel(CONTROL_CHANNEL_ID, stream, counters, lambda _channel_id, _outs, _reason: None, first=1)
        out.wanted = out.ready = True
        incoming = InStream(
            stream,
            self._reassembly,
            lambda _stream, message: self._on_message(message),
            lambda _stream, _reason, _nbytes, _seqs, _reported: None,
            first=1,
        )
        return out, incoming

    def begin(self) -> None:
        """A session has begun."""
        self.incoming.close()
        self.out, self.incoming = self._streams()
        self._unacked = self._unacked_seq = 0

    def send(self, envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int:
        """Queue a control message: reliable and in order within the session. Returns its number, 0 without a session:
        then it is not sent; every session tells everything anew."""
        if not self._end.established:
            return 0
        out = self.out
        body = framing.encode_control(envelope, attachment)
        seq = out.next_seq
        out.submit(Message(out.stream.id, seq, body, 0, now), now=now, forced=True)
        self._end.dirty = True
        return seq

    @property
    def acked_seq(self) -> int:
        """The number of the last control message up to which the peer has acknowledged all."""
        return self.out.watermark

    @property
    def settled(self) -> bool:
        """Whether the peer has everything that it was told."""
        return not self.out.retained

    @property
    def waits(self) -> bool:
        """Whether something of it is to be sent."""
        return bool(self.out.queue or self.out.active)

    def deaf(self, channels: int) -> bool:
        """Whether more waits than any peer with so many channels leaves behind that reads what it is told."""
        return self.out.retained_bytes > MAX_TOLD_BYTES + MAX_TOLD_CHANNEL_BYTES * channels

    def decode(self, message: Message, now: float) -> tuple[framing.Envelope, bytes]:
        """Envelope and attachment of a control message of the peer. Raises WireError, also where attachments unpack to
        too much."""
        work = CONTROL_US + len(message.body) // CONTROL_BYTES_PER_US
        self._reassembly.work_us += work
        room = self._attachments_left + (now - self._attachments_s) * ATTACHMENT_BYTES_PER_S
        self._attachments_left, self._attachments_s = min(room, float(ATTACHMENT_BURST_BYTES)), now
        most = min(int(self._attachments_left), framing.MAX_ATTACHMENT_BYTES)
        envelope, attachment = framing.decode_control(message.body, max_bytes=most)
        self._attachments_left -= len(attachment)
        self._reassembly.work_us += len(attachment) // ATTACHMENT_BYTES_PER_US
        return envelope, attachment

    def answered(self, count: int, *, streams: int) -> None:
        """The peer made us say `count` things. Raises WireError if it never reads what it makes us say; `streams` are
        those in both directions."""
        if self.out.watermark >= self._unacked_seq:
            self._unacked, self._unacked_seq = 0, self.out.next_seq - 1
        self._unacked += count
        if self._unacked > self._end.params.limits.unacked + 4 * streams:
            raise WireError(f"{self._end.peer} does not read {self._unacked} answers and goes on asking")
