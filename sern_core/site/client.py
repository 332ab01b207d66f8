"""The client daemon's core: one link to the relay, what this site publishes, what it receives. Pure.

The shell (sern_client) feeds it endpoint messages and lane bytes, and is told through `ClientEvents` which streams
appear and which messages have their turn. Everything about bandwidth, order, replay and loss is in the link below.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from sern_core.bodies.codecs import CodecProfile, Coder
from sern_core.link.definitions import DefinitionStore
from sern_core.link.link import Link
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.site.client_events import ClientEvents, ClientShell
from sern_core.site.object_mirror import ObjectMirror, Selection
from sern_core.site.own_objects import OwnObjects
from sern_core.site.peers import Peers, PeerView
from sern_core.site.remote_streams import RemoteStreams
from sern_core.site.subscription import Subscription
from sern_core.stream.in_stream import InStream
from sern_core.stream.latched import LatchedCache
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage, in_sequence
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.key_news import ClientKeys, RelayKeys
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import LINK, DecisionTrace, TraceEvent
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, check_stream
from sern_core.wire.numbering import Numbering

RELAY_NAME = ClientName("relay")
"""What the relay is called until its WELCOME says its own name."""


@dataclass(frozen=True, slots=True)
class KeptPlace:
    """Where the stream of a durable topic goes on: the number of the store it is kept in, and its first message that is
    not known to be delivered."""

    boot: int
    first: int


@dataclass(frozen=True, slots=True)
class KeptMessage:
    """A message that an earlier process has kept; it is `age_s` old by now."""

    seq: int
    body: bytes
    stamp_ns: int
    age_s: float


class ClientCore:
    """One client. `boot` is a random 63-bit number of this process, `now` any monotonic time in seconds.

    With a `coder` what is published is compressed as each topic's spec says; without one it is sent as it comes.
    """

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        events: ClientEvents,
        link: LinkParams,
        scheduler: SchedulerParams,
        now: float,
        trace: DecisionTrace | None = None,
        lossless: bool = True,
        coder: Coder | None = None,
    ) -> None:
        self.name = name
        self.boot = boot
        self.events = events
        self.shell = ClientShell(events)
        """Tells the shell, and counts errors of ours."""
        self.trace = trace or DecisionTrace(enabled=False)
        self._runs_told = link.limits.runs_told
        self.definitions = DefinitionStore()
        self.received = ReceiveLedger()
        """Counters of what arrives, by topic: delivered, and dropped on arrival for a reason."""
        self.peers = Peers()
        """The clients whose streams this one takes, and whether they are there."""
        self.attributes: dict[str, str] = {}
        """Metadata of this node, for the object registry."""
        self._numbering = Numbering()  # of topics that were offered before
        self._latched: dict[StreamId, LatchedCache] = {}  # for a relay that comes back with nothing
        self.coder = coder or Coder(max_bytes=link.max_message_bytes)
        self.link = Link(
            name=name,
            boot=boot,
            peer=RELAY_NAME,
            initiator=True,
            handler=self,
            definitions=self.definitions,
            link=link,
            scheduler=scheduler,
            trace=self.trace,
            now=now,
            lossless=lossless,
        )
        self._remote = RemoteStreams(self.link, self.shell, self.peers, self.received, self.coder)
        self.subscription = Subscription(self.link.control)
        self.objects = OwnObjects(self.link, boot=boot)
        self.mirror = ObjectMirror(self.link.control, self.shell.tell)
        """Objects of others that this site subscribes to."""
        self.link.housekeeping.on_tidy = self._tidy
        self.link.receiver.on_stray = self.received.stray
        if coder is not None:
            self.link.encode_with(coder)

    def _tidy(self, now: float) -> None:
        """Fold the counters of topics that ended long ago, and forget their numbers."""
        self.received.tidy({stream.topic for stream in self.link.taking.streams}, now=now)
        self._numbering.tidy(now=now)

    # --- publishing -----------------------------------------------------------------------------------------------

    def publish(
        self,
        info: TopicInfo,
        spec: TopicSpec,
        *,
        now: float,
        attributes: dict[str, str] | None = None,
        required: tuple[str, ...] = (),
        kept: KeptPlace | None = None,
    ) -> OutChannel:
        """Offer a topic under its global name. Offering it again after `unpublish` goes on counting where it ended.
        `attributes` travel with its announcement. `required`: of a reliable topic, clients that it is for: a relay
        that does not know them yet keeps it for them. `kept`: of a durable topic, where its stream goes on.

        Raises UsageError if it is offered already, or no relay would accept it.
        """
        identity = StreamId(self.name, self.boot if kept is None else kept.boot, info.name)
        first = self._numbering.last(identity) + 1 if kept is None else kept.first
        stream = StreamInfo(identity, info, spec, dict(attributes or {}))
        check_stream(stream)
        channel = self.link.outgoing.open(stream, first=first, required=required, now=now)
        if spec.latched:
            self._latched[identity] = LatchedCache(spec.depth, spec.max_queue_bytes)
        return channel

    def unpublish(self, channel: OutChannel, *, now: float) -> None:
        self._numbering.ended(channel.stream.id, channel.next_seq - 1, now=now)
        self._latched.pop(channel.stream.id, None)
        self.link.outgoing.close(channel, DropReason.SHUTDOWN, now=now)

    def latched(self, channel: OutChannel) -> list[Message]:
        """What late joiners of a latched topic would get, the oldest first."""
        cache = self._latched.get(channel.stream.id)
        return [] if cache is None else list(cache.replay())

    def send(
        self,
        channel: OutChannel,
        body: bytes,
        stamp_ns: int,
        *,
        now: float,
        born_s: float | None = None,
        forced: bool = False,
    ) -> bool:
        """Offer one message. False: refused, the reliable queue is full; offer it again later or count it lost.
        `born_s`: when it was taken, if that was before `now`. `forced`: whether there is room was asked before."""
        message = Message(channel.stream.id, channel.next_seq, body, stamp_ns, now if born_s is None else born_s)
        accepted = self.link.sender.submit(channel, message, now=now, forced=forced)
        if accepted and channel.spec.latched:
            self._latched[channel.stream.id].add(message)
        return accepted

    def go_on(self, channel: OutChannel, messages: Iterable[KeptMessage], *, next_seq: int, now: float) -> None:
        """Send what an earlier process has kept of a durable topic, the oldest first. What is new begins at
        `next_seq`."""
        for kept in messages:
            if kept.seq > channel.next_seq:  # what lies between is gone
                self.link.outgoing.skip(channel, kept.seq, now=now)
            self.send(channel, kept.body, kept.stamp_ns, now=now, born_s=now - kept.age_s, forced=True)
        if next_seq > channel.next_seq:
            self.link.outgoing.skip(channel, next_seq, now=now)

    def set_compression(self, channel: OutChannel, setting: Compression | None, *, now: float) -> None:
        """Compress what leaves this channel from the next message on with another mode; None: `auto`."""
        self.link.sender.set_compression(channel, setting, now=now)

    def codec_profiles(self, channel: OutChannel) -> dict[Compression, CodecProfile]:
        """What each mode makes of this channel's messages, as measured so far."""
        return {} if channel.codec is None else dict(channel.codec.profiles)

    def drop(self, channel: OutChannel, size_bytes: int, reason: DropReason, *, now: float) -> None:
        """Count a message of this channel that was given up before it was offered to the link."""
        channel.counters.offer(size_bytes)
        channel.counters.drop(reason, size_bytes)
        self.trace.record(now, channel.stream.id.topic, TraceEvent.DROPPED, reason=reason)

    def level_changed(self, channel: OutChannel, level: SummaryLevel, *, now: float) -> None:
        """Record what the link has this topic sent as from now on: its messages as they come, or their summary."""
        event = TraceEvent.SUMMARISED if level is SummaryLevel.SUMMARY else TraceEvent.WHOLE
        name, lifespan_s = channel.stream.id.topic, channel.spec.lifespan_s or 0.0
        self.trace.record(now, LINK, event, name=name, lifespan_s=lifespan_s)  # a topic forgets in seconds

    # --- receiving ------------------------------------------------------------------------------------------------

    def subscribe(self, patterns: tuple[str, ...], *, now: float) -> None:
        """Full-match patterns of the global names this site wants; replaces the earlier ones."""
        self.subscription.patterns = patterns
        self.shell.tell(self.peers.subscribed, patterns, now=now)
        if self.link.established:
            self.subscription.send(now)

    def subscribe_objects(self, selections: Sequence[Selection], *, now: float) -> None:
        """The cross-reality objects that this site wants; replaces the earlier ones. UsageError: a pattern is none."""
        self.mirror.select(selections)
        if self.link.established:
            self.mirror.send(now=now)

    def look_at_peers(self, *, now: float) -> list[PeerView]:
        """Who is there of those whose streams we take, by name. Call about once a second: that the own link has fallen
        silent is found here."""
        self.peers.reached(self.link.observe(now=now).up, now=now)
        return self.peers.look(now=now)

    def reconsider(self, *, now: float) -> None:
        """Open what this site could not publish when it was announced, if it can now: another stream may have been in
        its way, which has ended."""
        self._remote.reconsider(now)

    def reopen(self, identities: Collection[StreamId], *, now: float) -> None:
        """Close these streams from elsewhere for the shell, and open them anew: what holds for them here has changed.
        The stream itself goes on."""
        self._remote.reopen(identities, now)

    @property
    def refused(self) -> Collection[StreamId]:
        """The streams from elsewhere that there are, and that this site could not publish."""
        return self._remote.refused

    @property
    def opened(self) -> Collection[StreamId]:
        """The streams from elsewhere that are open here."""
        return self._remote.opened.keys()

    def hold(self, identity: StreamId, seq: int) -> None:
        """Called for the reliable message that is just being handed on: it is not confirmed before `release`."""
        self._remote.held.setdefault(identity, {})[seq] = None

    def release(self, identity: StreamId, seq: int, *, now: float, lost: DropReason | None = None) -> None:
        """A message that was held has been dealt with, or was `lost` after all; then its origin is told."""
        self._remote.release(identity, seq, lost, now)

    def lease_expired(self, identity: StreamId, after_s: float, *, now: float) -> None:
        """Called by whoever keeps the lease of a command topic: no fresh command came, and it is stopped."""
        self.trace.record(now, identity.topic, TraceEvent.LEASE_EXPIRED, origin=identity.origin, after_s=after_s)

    # --- LinkHandler ----------------------------------------------------------------------------------------------

    def on_fault(self, link: Link, error: Exception, *, now: float) -> None:
        self.shell.fault(error)

    def on_up(self, link: Link, *, resumed: bool, now: float) -> None:
        if not resumed:
            for identity, cache in self._latched.items():
                link.outgoing.prime(link.outgoing.by_stream[identity], cache.replay(), now=now)
        self.peers.session_began(now=now)
        self.subscription.send(now, self.peers.asked())
        self.mirror.send(now=now)
        if not resumed:
            self.objects.lost()
        self.objects.pump(now=now)
        self.shell.tell(self.events.link_up, resumed=resumed)

    def on_down(self, link: Link, reason: str, *, now: float) -> None:
        self.shell.tell(self.events.link_down, reason)
        self.shell.tell(self.peers.session_ended, now=now)

    def on_lane_closed(self, link: Link) -> None:
        self.shell.tell(self.events.lane_closed)

    def on_rejected(self, link: Link, code: str, text: str, *, now: float) -> None:
        self.shell.tell(self.events.rejected, code, text)

    def on_announce(self, link: Link, announcement: Announcement, *, now: float) -> bool | None:
        stream = link.taking.streams[announcement.stream.id]
        identity = stream.stream.id
        if not stream.stream.spec.durable:
            link.taking.outlived(identity.origin, identity.boot, now=now)
        if identity.topic == OBJECTS_TOPIC:
            return identity.origin == link.peer
        return self._remote.announced(stream, announcement, now)

    def on_definition(self, link: Link, digest: str, *, now: float) -> None:
        self._remote.definition_known(digest, now)

    def on_retract(self, link: Link, stream: InStream, *, now: float) -> None:
        self._remote.retracted(stream, now)

    def on_message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        if stream.stream.id.topic == OBJECTS_TOPIC:
            if not message.drop_marker:
                self.mirror.message(message.body, now=now)
            return
        remote = self._remote
        remote.decoder.message(stream, message, now=now)
        stream.unhandled = remote.oldest(message.stream) if remote.decoder.running or remote.held else 0

    def on_in_drop(self, link: Link, stream: InStream, reason: DropReason, nbytes: int, count: int) -> None:
        self.received.of(stream.stream).drop_arrived(reason, count)
        self._remote.note_drop(stream.stream.id, 0, reason, link.now)

    def on_out_drop(self, link: Link, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        if self.objects.dropped(channel):
            return
        runs = list(in_sequence(outs))
        if channel.reliable and len(runs) > self._runs_told:
            runs = [outs]  # what lies between was told before
        for run in runs:
            first, count = run[0], run[-1].seq - run[0].seq + 1
            self.shell.tell(self.events.send_dropped, channel.stream, first.seq, count, reason, first.lost_to)

    def on_delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        """The ledger has counted it."""
        self.objects.delivered(channel, now=now)

    def on_wanted(self, link: Link, channel: OutChannel, *, now: float) -> None:
        if channel.stream.id.topic == OBJECTS_TOPIC:
            self.objects.pump(now=now)
        else:
            self.shell.tell(self.events.wanted, channel.stream, bool(channel.wanted))

    def on_refused(self, link: Link, channel: OutChannel, code: str, text: str, *, now: float) -> None:
        self.shell.tell(self.events.publication_refused, channel.stream, code, text)

    def on_skipped(self, link: Link, stream: InStream, count: int, *, now: float) -> None:
        if stream.known and stream.stream.id in self._remote.opened:
            self.shell.tell(self.events.skipped, stream.stream, count)

    def on_control(self, link: Link, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        kind = envelope["t"]
        if kind == "lane":
            self.events.lane_offered(envelope)
        elif kind == "denied":
            code, why = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
            self.shell.tell(self.events.subscription_refused, code, why)
        elif kind == "peers":
            self.peers.told(envelope, now=now)
        elif kind == "keys":
            told = RelayKeys(
                relay=tuple(framing.take_strings(envelope, "relay", max_length=64)),
                takes=framing.take_bool(envelope, "takes"),
                key=framing.take_str(envelope, "key", max_length=64, default=""),
                code=framing.take_str(envelope, "code", max_length=64, default=""),
                why=framing.take_str(envelope, "why", default=""),
            )
            self.shell.tell(self.events.keys_told, told)
        elif kind == "objects_lost":
            if link.end.resumed:  # else all is told anyway
                self.objects.lost()
        elif kind == "object_refused":
            code, why = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
            self.shell.tell(self.events.object_refused, framing.take_str(envelope, "id", default=""), code, why)
        else:
            raise WireError(f"unknown control message {kind!r}")

    def tell_keys(self, keys: ClientKeys, *, now: float) -> None:
        """Tell the relay which of its keys this side accepts, and which other one of its own it has. Only to a relay
        that has told of its own since we connected."""
        said: framing.Envelope = {"t": "key", "relay": list(keys.relay), "kept": keys.kept, "key": keys.key}
        self.link.control.send(said, now=now)

    def ask_lane(self, ciphers: Sequence[str], *, now: float) -> None:
        """Ask the relay for a datagram session; `ClientEvents.lane_offered` has the answer, if it has one."""
        self.link.control.send({"t": "lane_ask", "ciphers": list(ciphers)}, now=now)
