"""Two bare `Link`s of one hop, without relay or client around them, and what the one got of the other."""

from collections.abc import Callable, Sequence

from sern_core.link.definitions import DefinitionStore
from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_ZMQ
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement

HELLO_KIND = bytes([framing.Kind.HELLO])


class BareEnd:
    """One end of a hop between relays, and its owner: takes whatever is announced."""

    def __init__(
        self, name: ClientName, peer: ClientName, *, initiator: bool, now: float, lossless: bool, any_size: bool
    ) -> None:
        self.got: list[bytes] = []
        self.take: Callable[[bytes], object] = self.got.append
        """What is done with what arrives."""
        self.faults: list[Exception] = []
        self.downs: list[str] = []
        """Why sessions have ended."""
        self.link = Link(
            name=name,
            boot=1,
            peer=peer,
            initiator=initiator,
            handler=self,
            definitions=DefinitionStore(),
            link=LinkParams(),
            scheduler=SchedulerParams(),
            trace=DecisionTrace(),
            now=now,
            lossless=lossless,
            any_size=any_size,
            leased=True,
        )
        self.port = HelloPort(self.link)

    def open(self, topic: str, spec: TopicSpec, *, now: float) -> OutChannel:
        name = TopicName(topic)
        info = TopicInfo(name, "std_msgs/String", Encoding.CDR)
        return self.link.outgoing.open(StreamInfo(StreamId(self.link.end.name, 1, name), info, spec), first=1, now=now)

    def submit(self, channel: OutChannel, body: bytes, *, now: float) -> bool:
        return self.link.sender.submit(channel, Message(channel.stream.id, channel.next_seq, body, 0, now), now=now)

    def on_announce(self, link: Link, announcement: Announcement, *, now: float) -> bool:
        del link, announcement, now
        return True

    def on_message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        del link, stream, now
        self.take(bytes(message.body))

    def on_fault(self, link: Link, error: Exception, *, now: float) -> None:
        del link, now
        self.faults.append(error)

    def on_down(self, link: Link, reason: str, *, now: float) -> None:
        del link, now
        self.downs.append(reason)

    def on_up(self, link: Link, *, resumed: bool, now: float) -> None: ...
    def on_lane_closed(self, link: Link) -> None: ...
    def on_rejected(self, link: Link, code: str, text: str, *, now: float) -> None: ...
    def on_retract(self, link: Link, stream: InStream, *, now: float) -> None: ...
    def on_in_drop(self, link: Link, stream: InStream, reason: DropReason, nbytes: int, count: int) -> None: ...
    def on_out_drop(self, link: Link, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None: ...
    def on_delivered(self, link: Link, channel: OutChannel, *, now: float) -> None: ...
    def on_wanted(self, link: Link, channel: OutChannel, *, now: float) -> None: ...
    def on_refused(self, link: Link, channel: OutChannel, code: str, text: str, *, now: float) -> None: ...
    def on_skipped(self, link: Link, stream: InStream, count: int, *, now: float) -> None: ...
    def on_definition(self, link: Link, digest: str, *, now: float) -> None: ...
    def on_control(self, link: Link, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None: ...


class HelloPort:
    """The only lane of a link as a port. The end that is spoken to also takes the HELLO, which its owner does
    elsewhere."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._lane = LanePort(link, LANE_ZMQ)

    def receive(self, data: bytes, *, now: float) -> None:
        if data[2:3] == HELLO_KIND:
            header = framing.decode_header(data)
            self._link.accept(framing.decode_handshake(data), header.tag, header.stamp_us, now=now)
        else:
            self._lane.receive(data, now=now)

    def next_datagram(self, *, now: float) -> bytes | None:
        return self._lane.next_datagram(now=now)

    @property
    def priority(self) -> PriorityClass:
        return self._lane.priority

    def next_deadline(self) -> float | None:
        return self._lane.next_deadline()

    def handle_timeout(self, *, now: float) -> None:
        self._lane.handle_timeout(now=now)

    def connected(self, *, now: float) -> None:
        self._lane.connected(now=now)

    def disconnected(self, *, now: float) -> None:
        self._lane.disconnected(now=now)


def pair(*, now: float, lossless: bool, any_size: bool) -> tuple[BareEnd, BareEnd]:
    """The first of them says hello."""
    names = ClientName("relay_a"), ClientName("relay_b")
    return (
        BareEnd(names[0], names[1], initiator=True, now=now, lossless=lossless, any_size=any_size),
        BareEnd(names[1], names[0], initiator=False, now=now, lossless=lossless, any_size=any_size),
    )
