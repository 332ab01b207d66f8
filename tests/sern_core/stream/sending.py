"""One channel, with a record of what it drops."""

from collections.abc import Sequence

from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.ledger import SendLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from tests.world import spec


class Sender:
    """A channel with a record of its drops; it is announced and wanted from the start."""

    def __init__(self, topic_spec: TopicSpec, *, first: int = 1) -> None:
        info = TopicInfo(TopicName("/t"), "", Encoding.RAW)
        self.stream = StreamInfo(StreamId(ClientName("a"), 1, info.name), info, topic_spec)
        self.ledger = SendLedger()
        self.drops: list[tuple[int, DropReason]] = []
        self.told: list[tuple[int, int, DropReason]] = []  # the spans: first, last, why
        counters = self.ledger.topic(info.name, topic_spec.priority)
        self.channel = OutChannel(1, self.stream, counters, self._drop, first=first)
        self.channel.wanted = self.channel.ready = True

    def _drop(self, _channel_id: int, outs: Sequence[OutMessage], reason: DropReason) -> None:
        self.drops += [(out.seq, reason) for out in outs]
        self.told.append((outs[0].seq, outs[-1].seq, reason))

    def message(self, seq: int, size: int = 100, *, now: float = 0.0, replay: bool = False) -> Message:
        return Message(self.stream.id, seq, bytes(size), 0, now, 0, replay)

    def drop_marker(self, seq: int) -> Message:
        return Message(self.stream.id, seq, b"\x01", 0, 0.0, 1)

    def submit(self, count: int = 1, size: int = 100, *, now: float = 0.0) -> list[bool]:
        channel = self.channel
        return [channel.submit(self.message(channel.next_seq, size, now=now), now=now) for _ in range(count)]

    def take(self, room: int = 1000, *, now: float = 0.0) -> tuple[OutMessage, int, int, int] | None:
        out = self.channel.head(now)
        if out is None:
            return None
        return (out, out.generation, *self.channel.take(out, room, now))

    def send_all(self, *, now: float = 0.0) -> None:
        """The peer has each whole and confirms none."""
        while (sent := self.take(now=now)) is not None:
            out, generation, _start, _end = sent
            self.channel.fragment_acked(out, generation)

    def check(self) -> None:
        def check(ok: bool, text: str) -> None:
            assert ok, text

        self.channel.validate(check)
        self.ledger.validate([(self.channel.counters, *self.channel.held())], check)

    @property
    def waiting(self) -> list[int]:
        return [out.seq for out in self.channel.queue]


def whole_at_the_peer(count: int) -> Sender:
    sender = Sender(spec(reliable=True, lifespan_s=10.0, retention_s=3600.0))
    sender.submit(count, 2, now=0.0)
    sender.send_all()
    return sender
