"""What others may know of a link and set on it, without knowing its parts. Pure.

Whoever watches links (adaptation, metrics, HTTP, the daemons) reads the frozen views of `Link.observe` and
`Link.topics`, and sets with `Link.apply`: how lanes, flights and queues are built is the link's own business.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Final, NamedTuple

from sern_core.bodies.codecs import CodecProfile
from sern_core.link.end import End
from sern_core.link.lane_set import LaneSet
from sern_core.link.receiver import Receiver
from sern_core.link.sender import Sender
from sern_core.path.lanes import LANE_NAMES, LANE_UDP
from sern_core.stream.coding import preferred
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.message import StreamInfo, TopicSpec
from sern_core.vocabulary.types import CLASSES, ClientName, TopicName

UNLIMITED: Final = 2**31
"""A queue limit that limits nothing."""


class LinkView(NamedTuple):
    """A link as it was when it was looked at. Lane, window, round trip and loss are those of the lane that carries
    data; rates in bit/s."""

    peer: ClientName
    established: bool
    """There is a session."""
    stalled: bool
    """Nothing was acknowledged for too long."""
    version: int
    """The wire version of the session."""
    lane_id: int
    lossless: bool
    """The lane is a stream (TCP)."""
    fragment_bytes: int
    rate_bps: float | None
    """The estimated capacity; None: the link was never full."""
    bound_bps: float | None
    """What the link carries at least; None: nothing was carried yet."""
    eased_s: float
    """When the link was last seen to be faster than it is known to be; -inf: never."""
    window_bytes: float
    inflight_bytes: int
    rtprop_s: float | None
    """Round trip of the empty path; None: not known yet."""
    srtt_s: float
    """Smoothed round trip; 0: not known yet."""
    loss: float
    """Share of recent packets that were lost."""
    waiting_s: float | None
    """How long something has waited for an acknowledgement; None: nothing waits for one."""
    stream_usable: bool
    """The lane of the connection on which the session began is there and answers."""
    datagrams_pass: bool
    """The peer answers over the datagram lane."""
    priority_lane: bool
    """Class control goes over connections of its own."""
    wire_bytes: int
    """Bytes of numbered datagrams sent so far, second copies and headers included."""
    strays: int
    """Fragments of streams that were not announced, so far."""
    clock_offset_s: float
    """The peer's clock less ours."""
    clock_error_s: float
    """Bound of the error of the offset; inf: not known yet."""
    background_bytes: int = 0
    """Bytes of `wire_bytes` that were of streams in the background: the rest of the link, which they take, is free."""

    @property
    def up(self) -> bool:
        """There is a session, and the path answers."""
        return self.established and not self.stalled

    @property
    def lane(self) -> str:
        return LANE_NAMES[self.lane_id]

    def to_json(self) -> dict[str, object]:
        """The row of /api/link; None where a value is not known yet."""
        return {
            "peer": self.peer,
            "lane": self.lane,
            "up": self.up,
            "stalled": self.stalled,
            "version": self.version,
            "inflight_bytes": self.inflight_bytes,
            "srtt_s": self.srtt_s,
            "loss": self.loss,
            "fragment_bytes": self.fragment_bytes,
            "clock_offset_s": self.clock_offset_s,
            "clock_error_s": self.clock_error_s if isfinite(self.clock_error_s) else None,
        }


class CodecView(NamedTuple):
    """How the bodies of a stream are encoded, and what was found out about it."""

    setting: Compression | None
    """The mode to use; None: whichever is quickest (`auto`)."""
    mode: Compression
    """The mode in use."""
    modes: tuple[Compression, ...]
    """What there is to choose from, beside `none`."""
    raw_bytes: int
    encoded_bytes: int
    """Bytes of all messages chosen so far, before and after."""
    profiles: Mapping[Compression, CodecProfile]
    """What each mode makes of this topic, as measured."""


class TopicView(NamedTuple):
    """A stream of a topic on its way out. Several publishers of a topic are several streams."""

    topic: TopicName
    """The name under which it is counted, in `Link.counters`."""
    stream: StreamInfo
    wanted: bool | None
    """The peer wants it; None: it has not answered yet."""
    ready: bool
    """It is announced in the session."""
    thinnable: bool
    """Messages may be left out."""
    thinned: int
    """Messages that were left out for a share set with `Link.apply`."""
    codec: CodecView | None
    """None: bodies go as they come."""

    @property
    def spec(self) -> TopicSpec:
        return self.stream.spec


class Sending(NamedTuple):
    """A stream on its way out, looked at closely."""

    wanted: bool | None
    """The peer wants it; None: it has not answered yet."""
    counters: SendCounters
    """What was offered of its topic, and what became of it."""
    standing: Mapping[str, object]
    """How much waits of it, and why (`Holds.standing`)."""


class Held(NamedTuple):
    """Messages of a topic that have no fate yet."""

    queued: int
    in_flight: int


class Counted(NamedTuple):
    """A topic on its way out."""

    counters: SendCounters
    streams: tuple[TopicView, ...]
    """Those of it that are open."""
    held: Held


class Undelivered(NamedTuple):
    """A message that the peer is not known to have."""

    stream: StreamInfo
    seq: int
    exposed: bool
    """It was sent whole, and may have arrived."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """What may be set on a link while it runs; as it stands here, what the rules of the topics say.

    Nothing that waits or is under way is touched: `shares` and `depths` act on the next message of topics that may be
    thinned, `codecs` on the next body, `copies` on the next datagram.
    """

    shares: tuple[float, ...] = (1.0,) * len(CLASSES)
    """The share of the messages that is let in, in (0, 1], by class."""
    depths: tuple[int, ...] = (UNLIMITED,) * len(CLASSES)
    """How many messages of a topic may wait, by class, where its own depth is not less."""
    codecs: tuple[Compression, ...] | None = None
    """Compression modes in order of preference, of which each topic takes the first that it allows, unless its rule
    names one. None: all stay as they are."""
    copies: bool | None = None
    """Class control is sent twice, where the configuration leaves it open. None: the loss decides."""


def observe(end: End, lanes: LaneSet, receiver: Receiver, now: float) -> LinkView:
    """Look at the link. Costs the same however many streams there are."""
    lane, clock = lanes.lane, lanes.clock
    flight, estimator = lane.flight, lane.estimator
    waiting_since_s = flight.waiting_since_s
    datagrams = lanes.by_id.get(LANE_UDP)
    return LinkView(
        peer=end.peer,
        established=end.established,
        stalled=lane.stalled,
        version=end.version,
        lane_id=lane.id,
        lossless=lane.lossless,
        fragment_bytes=lane.fragment_bytes,
        rate_bps=estimator.rate_bps,
        bound_bps=estimator.bound_bps,
        eased_s=estimator.eased_s,
        window_bytes=estimator.window_bytes,
        inflight_bytes=flight.inflight_bytes,
        rtprop_s=estimator.rtprop_s,
        srtt_s=flight.rtt.srtt_s,
        loss=lane.loss,
        waiting_s=None if waiting_since_s is None else now - waiting_since_s,
        stream_usable=lanes.stream.usable,
        datagrams_pass=datagrams is not None and datagrams.usable and datagrams.answered,
        priority_lane=lanes.priority_lane is not None,
        wire_bytes=lanes.wire_bytes,
        strays=receiver.strays,
        clock_offset_s=clock.offset_s,
        clock_error_s=clock.error_s,
        background_bytes=lanes.background_bytes,
    )


def rtt_s(lanes: LaneSet) -> float:
    """The round trip of the empty path where it is known, else the smoothed one; 0: neither is."""
    lane = lanes.lane
    rtprop_s = lane.estimator.rtprop_s
    return rtprop_s if rtprop_s is not None and isfinite(rtprop_s) else lane.flight.rtt.srtt_s


def topics(channels: Iterable[OutChannel]) -> tuple[TopicView, ...]:
    """Look at every stream that is open."""
    return tuple(
        TopicView(
            channel.counters.topic,
            channel.stream,
            channel.wanted,
            channel.ready,
            channel.thinnable,
            channel.thinned,
            _codec(channel),
        )
        for channel in channels
    )


def held(channels: Iterable[OutChannel]) -> dict[TopicName, Held]:
    """Add up what each stream holds, by topic."""
    found: dict[TopicName, Held] = {}
    for channel in channels:
        topic = channel.stream.id.topic
        before = found.get(topic, Held(0, 0))
        queued, _queued_bytes, flying, _flying_bytes = channel.held()
        found[topic] = Held(before.queued + queued, before.in_flight + flying)
    return found


def undelivered(channels: Iterable[OutChannel]) -> Iterator[Undelivered]:
    """Go through what each stream keeps."""
    for channel in channels:
        for out in channel.undelivered():
            yield Undelivered(channel.stream, out.seq, out.exposed)


def _codec(channel: OutChannel) -> CodecView | None:
    codec = channel.codec
    if codec is None:
        return None
    return CodecView(codec.setting, codec.mode, codec.modes, codec.raw_bytes, codec.encoded_bytes, dict(codec.profiles))


def apply(settings: LinkSettings, sender: Sender, lanes: LaneSet, now: float) -> None:
    """Bring every channel and lane in line. Idempotent."""
    codecs = settings.codecs
    for channel in sender.channels.values():
        priority = channel.spec.priority
        channel.adapt(share=settings.shares[priority], depth_max=settings.depths[priority])
        if codecs is not None and channel.codec is not None and channel.spec.compression is None:
            mode = preferred(codecs, channel.codec.modes)
            if channel.codec.setting is not mode:
                sender.set_compression(channel, mode, now=now)
    for lane in lanes.by_id.values():
        lane.copies_wanted = settings.copies
