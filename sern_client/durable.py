"""Durable topics of this site: what is published on them is on disk before it is sent, until it is delivered.

Their streams have the store's number in place of the process's, and their messages are numbered in the order in which
they were stored. The next process goes on with them, so that a message reaches its subscribers once, however often this
one is ended. What earlier processes have left is offered at once, whether its publisher is back or not.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from sern_core.site.client import ClientCore, KeptMessage, KeptPlace
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.errors import ConfigError, UsageError, WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import TopicName
from sern_core.wire.announce import Announcement, decode_announcement, definition_hash, encode_announcement
from sern_runtime.durable.disk import Disk
from sern_runtime.durable.keeper import Keeps
from sern_runtime.durable.store import Described, KeptStream, Put, Row

Send = Callable[[bytes, int, float | None], bool]
StoredCount = Callable[[int], None]
"""`stored(count)`: so many messages of a topic are on disk, of all that this store has ever had."""

_log = logging.getLogger(__name__)


class _Waiting(NamedTuple):
    """A message on its way to the disk. `born_s`: on this process's clock."""

    seq: int
    body: bytes
    stamp_ns: int
    born_s: float


class _Topic:
    """One durable topic. `send` puts a stored message into the channel. `leaving`: nobody publishes it now."""

    __slots__ = (
        "channel",
        "leaving",
        "next_seq",
        "required",
        "send",
        "stored",
        "trimmed",
        "waiting",
        "waiting_bytes",
    )

    def __init__(self, channel: OutChannel, next_seq: int) -> None:
        self.channel = channel
        self.next_seq = next_seq
        self.required = channel.required
        self.leaving = True
        self.send: Send | None = None
        self.stored: StoredCount | None = None
        self.trimmed = channel.watermark
        self.waiting: deque[_Waiting] = deque()
        self.waiting_bytes = 0


class DurableTopics:
    """The durable topics of one client. `now` is the clock of the core, `wall_ns` the one that goes on while the
    machine is off."""

    def __init__(
        self, disk: Disk, *, core: ClientCore, now: Callable[[], float], wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self.disk = disk
        self._core = core
        self._now = now
        self._wall_ns = wall_ns
        self._topics: dict[StreamId, _Topic] = {}
        self._found: dict[StreamId, KeptStream] = {}
        self._boot = 0
        self._closed = False

    @property
    def _keeper(self) -> Keeps:
        """What writes. There are durable topics only where there is one."""
        assert self.disk.keeper is not None
        return self.disk.keeper

    def start(self, rule: Callable[[TopicInfo], TopicSpec]) -> None:
        """Begin to write, and offer what earlier processes have left. `rule` says how a global topic is treated now.
        Raises ConfigError as `Disk.open` does."""
        contents = self.disk.open(self._stored)
        if contents is None:
            return
        self._boot, self._found = contents.boot, contents.streams
        for found in [found for found in self._found.values() if found.rows]:
            try:
                info, spec = _described(found)
                self.publish(info, self._rule(found, info, spec, rule))
            except (UsageError, WireError) as error:
                _log.error("%d messages of %s are lost: %s", len(found.rows), found.id.topic, error)
                self._found.pop(found.id, None)
                self._keeper.forget(found.id)

    def _rule(
        self, found: KeptStream, info: TopicInfo, then: TopicSpec, rule: Callable[[TopicInfo], TopicSpec]
    ) -> TopicSpec:
        """How to treat what was found: as now, where that says the same on the wire, else as `then`."""
        try:
            now = rule(info)
        except ConfigError:
            return then
        return now if _said(found.id, info, now) == found.announcement else then

    # --- topics come and go -----------------------------------------------------------------------------------------

    def publish(self, info: TopicInfo, spec: TopicSpec) -> OutChannel:
        """Offer a durable topic under its global name, or go on with it. Raises UsageError."""
        if self.disk.keeper is None:
            return self._core.publish(info, spec, now=self._now())
        identity = StreamId(self._core.name, self._boot, info.name)
        said = _said(identity, info, spec)
        known = self._topics.get(identity)
        if known is not None:
            if not known.leaving:
                raise UsageError(f"{info.name} is offered already")
            if _said(identity, known.channel.stream.info, known.channel.spec) == said:
                self._core.set_compression(known.channel, spec.compression, now=self._now())
                return known.channel
            self._end(known)
        found = self._found.pop(identity, None)
        last, rows, required = (0, [], ()) if found is None else (found.last, found.rows, found.required)
        if found is not None and found.announcement != said:
            if rows:
                _log.error("%d messages of %s are dropped: it is another topic now", len(rows), info.name)
                self._keeper.trim(identity, last)
            rows, required = [], ()
        first = rows[0].seq if rows else last + 1
        channel = self._core.publish(info, spec, now=self._now(), required=required, kept=KeptPlace(self._boot, first))
        topic = self._topics[identity] = _Topic(channel, last + 1)
        self._describe(topic, last)
        wall_ns = self._wall_ns()
        messages = [KeptMessage(row.seq, row.body, row.stamp_ns, max(0, wall_ns - row.born_ns) * 1e-9) for row in rows]
        self._core.go_on(channel, messages, next_seq=last + 1, now=self._now())
        if messages:
            _log.warning("%s: %d messages of an earlier run are sent now", info.name, len(messages))
        return channel

    def sender(self, channel: OutChannel, send: Send, stored: StoredCount | None) -> Send:
        """What takes messages of this topic: they are kept, and given to `send` when they are on disk. `stored` is told
        then. False: there is no room."""
        topic = self._topics.get(channel.stream.id)
        if topic is None:
            return send
        topic.send, topic.stored, topic.leaving = send, stored, False
        keeper = self._keeper

        def keep(body: bytes, stamp_ns: int, born_s: float | None) -> bool:
            size = len(body)
            overhead_bytes = MESSAGE_OVERHEAD_BYTES * len(topic.waiting)
            if not keeper.has_room(self._core.name, size) or not channel.has_room(
                size + topic.waiting_bytes + overhead_bytes
            ):
                channel.counters.refuse(size)
                return False
            now = self._now()
            born_s = now if born_s is None else born_s
            seq, topic.next_seq = topic.next_seq, topic.next_seq + 1
            topic.waiting.append(_Waiting(seq, body, stamp_ns, born_s))
            topic.waiting_bytes += size
            keeper.put(Put(channel.stream.id, Row(seq, self._wall_ns() - int((now - born_s) * 1e9), stamp_ns, body)))
            return True

        return keep

    def leave(self, channel: OutChannel) -> bool:
        """Nobody publishes this topic any more. True: its stream stays until all of it is delivered."""
        topic = self._topics.get(channel.stream.id)
        if topic is None or topic.channel is not channel:
            return False
        topic.stored, topic.leaving = None, True
        return True

    def give_way(self, name: TopicName) -> None:
        """This global topic is not durable any more: what is left of it ends."""
        topic = self._topics.get(StreamId(self._core.name, self._boot, name))
        if topic is not None:
            self._end(topic)

    def look(self) -> None:
        """Let go of what is delivered. Call about twice a second."""
        if self.disk.keeper is None or self._closed:
            return
        keeper = self._keeper
        for topic in list(self._topics.values()):
            channel = topic.channel
            if channel.watermark > topic.trimmed:
                topic.trimmed = channel.watermark
                keeper.trim(channel.stream.id, channel.watermark)
            if channel.required != topic.required:
                topic.required = channel.required
                self._describe(topic, topic.next_seq - 1 - len(topic.waiting))
            if topic.leaving and not channel.retained and not topic.waiting:
                self._end(topic)

    def _end(self, topic: _Topic) -> None:
        """The topic is offered no more; its numbers are remembered, since it may come again."""
        channel = topic.channel
        if channel.retained or topic.waiting:
            left = len(channel.retained) + len(topic.waiting)
            _log.error("%d messages of %s are dropped: it is another topic now", left, channel.stream.id.topic)
        stream = channel.stream.id
        del self._topics[stream]
        last = topic.next_seq - 1
        self._found[stream] = KeptStream(stream, _said(stream, channel.stream.info, channel.spec), "", (), last)
        self._keeper.trim(stream, last)
        self._core.unpublish(channel, now=self._now())

    def _describe(self, topic: _Topic, last: int) -> None:
        stream = topic.channel.stream
        said = _said(stream.id, stream.info, stream.spec)
        self._keeper.change(Described(stream.id, said, stream.info.definition, tuple(topic.required), last))

    # --- from the keeper --------------------------------------------------------------------------------------------

    def _stored(self, puts: Sequence[Put]) -> None:
        """These are on disk: they may go."""
        told: dict[StreamId, _Topic] = {}
        for put in puts:
            topic = self._topics.get(put.stream)
            if topic is None or self._closed or not topic.waiting or topic.waiting[0].seq != put.row.seq:
                continue  # its stream has ended meanwhile, or the next process sends it
            _seq, body, stamp_ns, born_s = topic.waiting.popleft()
            topic.waiting_bytes -= len(body)
            assert topic.send is not None
            topic.send(body, stamp_ns, born_s)
            told[put.stream] = topic
        for topic in told.values():
            if topic.stored is not None:
                topic.stored(topic.next_seq - 1 - len(topic.waiting))

    @property
    def pending(self) -> int:
        """Messages that are not on disk yet."""
        return sum(len(topic.waiting) for topic in self._topics.values())

    def close(self) -> None:
        """Have everything on disk that was taken. Idempotent."""
        if not self._closed:
            self.look()
        self._closed = True
        self.disk.close()


def _said(stream: StreamId, info: TopicInfo, spec: TopicSpec) -> dict[str, Any]:
    """What an announcement says of a stream, whoever is required."""
    return encode_announcement(Announcement(1, StreamInfo(stream, info, spec), definition_hash(info.definition), 1))


def _described(found: KeptStream) -> tuple[TopicInfo, TopicSpec]:
    """Topic and rule of a stream as they were. Raises WireError."""
    stream = decode_announcement(found.announcement).stream
    info = stream.info
    topic = TopicInfo(info.name, info.type_name, info.encoding, info.type_hash, found.definition, info.latched)
    return topic, stream.spec
