"""The streams from elsewhere that a client takes: opened for its shell, handed on message by message, closed. Pure."""

from collections.abc import Collection
from dataclasses import replace

from sern_core.bodies.codecs import Coder
from sern_core.link.link import Link
from sern_core.site.client_events import ClientShell
from sern_core.site.peers import Peers
from sern_core.stream.decoding import Decoder
from sern_core.stream.in_stream import InStream
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.ledger import MAX_TOPICS, ReceiveLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.trace import TraceEvent
from sern_core.vocabulary.types import DropReason, TopicName
from sern_core.wire.announce import Announcement


def _announced(stream: StreamInfo) -> StreamInfo:
    """What its origin says of a stream, without what is filled in here."""
    return replace(stream, info=replace(stream.info, definition=""), definition_hash="")


class RemoteStreams:
    """Opens what the peer announces, hands its messages on in their turn, decoded, and confirms what is dealt with.

    Its owner calls `decoder` and writes to `held` directly: a method here would be one more call for each message.
    """

    def __init__(self, link: Link, shell: ClientShell, peers: Peers, received: ReceiveLedger, coder: Coder) -> None:
        self._link = link
        self._shell = shell
        self._events = shell.events
        self._peers = peers
        self._received = received
        self._trace = link.end.trace
        self.opened: dict[StreamId, StreamInfo] = {}
        """The streams that are open here, as they were announced."""
        self.refused: set[StreamId] = set()
        """Those that were announced, and that this site could not publish."""
        self.held: dict[StreamId, dict[int, None]] = {}
        """Messages that were handed on and are not to be confirmed yet."""
        self._undecodable: set[TopicName] = set()  # topics of which that was told
        self.decoder = Decoder[InStream](
            coder, lambda stream: stream.stream, self._handle, self._failed, self._settled, fault=shell.fault
        )

    # --- opened and closed ----------------------------------------------------------------------------------------

    def announced(self, stream: InStream, announcement: Announcement, now: float) -> bool | None:
        """The peer has a stream. Whether it is open now; None: its definition is still to come."""
        digest = announcement.definition_hash
        opened = self.opened.get(stream.stream.id)
        if opened is not None and opened != _announced(announcement.stream):
            # Its origin ended it and began it anew while we were away, as something else.
            self._close(stream, now)
            stream.stream = replace(announcement.stream, attributes={**announcement.stream.attributes})
            stream.stream.definition_hash = digest
        if digest and digest not in self._link.definitions:
            return None  # asked for; answered when it is here
        return self._open(stream)

    def definition_known(self, digest: str, now: float) -> None:
        """A definition is here: open the streams that wait for it."""
        for stream in list(self._link.taking.incoming.values()):
            if stream.stream.definition_hash == digest:
                self._link.answers.answer(stream, self._open(stream), now=now)

    def retracted(self, stream: InStream, now: float) -> None:
        """The peer has a stream no longer."""
        self.refused.discard(stream.stream.id)
        if stream.stream.id in self.opened:
            self._close(stream, now)

    def reconsider(self, now: float) -> None:
        """Open what could not be opened when it was announced, if it can be now."""
        for stream in list(self._link.taking.incoming.values()):
            if stream.stream.id in self.refused and self._open(stream):
                self._link.answers.answer(stream, True, now=now)

    def reopen(self, identities: Collection[StreamId], now: float) -> None:
        """Close these streams for the shell, and open them anew."""
        for stream in list(self._link.taking.incoming.values()):
            if stream.stream.id in identities and stream.stream.id in self.opened:
                self._close(stream, now)
                self._link.answers.answer(stream, self._open(stream), now=now)

    def _open(self, stream: InStream) -> bool:
        identity = stream.stream.id
        if identity.origin == self._link.end.name:
            return False  # our own, come back through somebody else
        if identity not in self.opened:
            info = stream.stream.info
            digest = stream.stream.definition_hash
            complete = TopicInfo(
                info.name,
                info.type_name,
                info.encoding,
                info.type_hash,
                self._link.definitions.get(digest),
                info.latched,
                info.reliable,
            )
            announced = _announced(stream.stream)
            stream.stream = replace(stream.stream, info=complete)
            if not self._publishable(stream.stream):
                self.refused.add(identity)
                return False
            self.refused.discard(identity)
            self.opened[identity] = announced
            self._shell.tell(self._peers.opened, identity.origin, now=self._link.now)
        return True

    def _publishable(self, stream: StreamInfo) -> bool:
        """Whether the shell can publish this stream."""
        for _ in range(2):
            try:
                self._events.stream_opened(stream)
            except ConfigError:
                return False  # the shell has logged it; nothing else stops
            except Exception as error:  # noqa: BLE001  (of one stream, whatever its definition holds; it may pass)
                self._shell.fault(error)
                self._shell.tell(self._events.stream_closed, stream)  # as far as it had come
            else:
                return True
        return False

    def _close(self, stream: InStream, now: float) -> None:
        self.decoder.forget(stream.stream.id, now=now)
        self.held.pop(stream.stream.id, None)
        del self.opened[stream.stream.id]
        self._shell.tell(self._peers.closed, stream.stream.id.origin, stream.stream.id.topic, now=now)
        self._shell.tell(self._events.stream_closed, stream.stream)

    # --- messages -------------------------------------------------------------------------------------------------

    def _handle(self, stream: InStream, message: Message, now: float) -> None:
        """A message has had its turn and is decoded."""
        lifespan_s = stream.lifespan_s
        if stream.unhandled and not stream.reliable and lifespan_s is not None and message.age_s(now) > lifespan_s:
            self._failed(stream, message, DropReason.LIFESPAN, "", now)  # while it was decoded
            return
        if message.drop_marker:
            reason = message.drop_reason
            self._received.of(stream.stream).drop_arrived(reason)
            self._shell.tell(self._events.expired, stream.stream, message.seq, reason)
            return
        try:
            refused = self._events.message(stream.stream, message, now=now)
        except Exception as error:  # noqa: BLE001  (of one message: the stream goes on, whatever its bodies do)
            self._shell.fault(error)
            self._failed(stream, message, DropReason.FAULT, "", now)
        else:
            if refused is not None:
                self._failed(stream, message, refused, "", now)
                return
            self._received.of(stream.stream).arrived(len(message.body), now - message.born_s, now)
            if self._trace.steps:
                self._trace.record(
                    now,
                    message.stream.topic,
                    TraceEvent.DELIVERED,
                    message.seq,
                    origin=message.stream.origin,
                    age_s=now - message.born_s,
                )
            if not message.replay:  # which is the relay's
                self._peers.arrived(message.stream.origin, now=now)

    def _failed(self, stream: InStream, message: Message, reason: DropReason, problem: str, now: float) -> None:
        """A message has had its turn and cannot be handed on."""
        topic = stream.stream.id.topic
        self._received.of(stream.stream).drop_arrived(reason)
        self.note_drop(stream.stream.id, message.seq, reason, now)
        if self._link.end.fates is not None and (not stream.reliable or reason is DropReason.DISCONNECTED):
            self._link.end.fates.discarded(stream.stream, message.seq, reason, self._link.peer)
        told = self._undecodable
        if reason is DropReason.UNDECODABLE and topic not in told and len(told) < MAX_TOPICS:
            told.add(topic)
            self._shell.tell(self._events.undecodable, stream.stream, problem)
        if stream.reliable and reason is not DropReason.DISCONNECTED:
            self._link.answers.report(stream, message.seq, reason, self._link.end.name)
            self._shell.tell(self._events.expired, stream.stream, message.seq, reason)

    def _settled(self, stream: InStream) -> None:
        """A body is decoded, or dropped: the peer may be told how far the stream has come."""
        identity = stream.stream.id
        current = self._link.taking.streams.get(identity)
        if current is not None:
            self._link.taking.processed_below(current, self.oldest(identity))

    def oldest(self, identity: StreamId) -> int:
        """The seq of the oldest message of a stream that has had its turn and is not dealt with, 0: none."""
        decoding = self.decoder.oldest(identity)
        if not self.held:
            return decoding
        held = next(iter(self.held.get(identity, ())), 0)
        return min(decoding, held) if decoding and held else decoding or held

    def release(self, identity: StreamId, seq: int, lost: DropReason | None, now: float) -> None:
        """A message that was held has been dealt with, or was `lost` after all: tell its origin."""
        held = self.held.get(identity)
        if held is None or seq not in held:
            return  # the stream has ended
        del held[seq]
        if not held:
            del self.held[identity]
        taking = self._link.taking
        if lost is not None and (stream := taking.streams.get(identity)) is not None:
            self.note_drop(identity, seq, lost, now)
            self._link.answers.report(stream, seq, lost, self._link.end.name)
            self._events.expired(stream.stream, seq, lost)
        if (stream := taking.streams.get(identity)) is not None:  # as `_settled` does, without its call
            taking.processed_below(stream, self.oldest(identity))

    def note_drop(self, identity: StreamId, seq: int, reason: DropReason, now: float) -> None:
        """Record that a message was dropped on its arrival; seq 0: one or more whose numbers are not told."""
        self._trace.record(now, identity.topic, TraceEvent.DROPPED, seq, reason=reason, origin=identity.origin)
