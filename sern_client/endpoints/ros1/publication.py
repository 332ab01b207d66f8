"""What this node publishes: a topic of the far side, for any number of local subscribers.

Every subscriber has a bounded queue of its own: one that does not keep up loses its oldest messages, which is counted,
and holds up nobody. What several streams of the link have in common by name (/tf_static of two robots) is one topic
here: `Publication` joins them, and a late subscriber gets the last message of each, static transforms as one. Its first
messages wait for the subscribers that there are (`first_messages`), also when the far side has ended the topic
meanwhile.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from math import inf
from typing import Final

from sern_client.endpoints.common.queue import BoundedQueue
from sern_client.endpoints.ros1.first_messages import FirstMessages
from sern_client.endpoints.ros1.frames import LENGTH, Frames
from sern_client.endpoints.ros1.header import BRIDGE_FIELD, shown
from sern_client.tf_latch import TfLatch, is_static_tf
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime import ros_types

JOIN_BYTES: Final = 32 * 1024
"""Up to this size a message and its length are joined: one copy is cheaper than two writes."""
WRITE_BUFFER_BYTES: Final = 128 * 1024
"""What may wait in the transport, where it cannot be overtaken; the rest waits in the queue."""
LAST_READ_S: Final = 1.0
"""How long the master does not hear of the end of a topic while subscribers read its last messages. roscpp throws away
what it has not read when it hears of the end."""

_log = logging.getLogger(__name__)


class Feed:
    """The sending half of one subscriber's connection."""

    def __init__(self, link: Frames, publication: "Publication", caller: str, number: int) -> None:
        assert link.transport is not None
        self.caller = caller
        self.number = number
        self.publication = publication
        self.sent_bytes = 0
        self.sent_messages = 0
        self.dropped = 0
        self._transport: asyncio.Transport | None = link.transport
        limits = publication.limits
        self._queue: BoundedQueue[bytes] = BoundedQueue(max_bytes=limits.bytes, max_items=limits.messages)
        self._paused = False
        self._over = False  # nothing follows what was sent
        link.transport.set_write_buffer_limits(high=WRITE_BUFFER_BYTES)

    def send(self, body: bytes, frame: bytes | None) -> None:
        """`frame` is the body with its length in front, where that was worth making."""
        if self._transport is None or self._over or self._transport.is_closing():
            return
        if self._paused:
            self._keep(body)
            return
        self._write(body, frame)

    def _write(self, body: bytes, frame: bytes | None) -> None:
        assert self._transport is not None
        self.sent_messages += 1
        self.sent_bytes += len(body) + 4
        if frame is not None:
            self._transport.write(frame)
        else:
            self._transport.writelines((LENGTH.pack(len(body)), body))

    def _keep(self, body: bytes) -> None:
        for _ in self._queue.put(body, len(body)):
            if not self.dropped:
                _log.warning("%s: %s is slower than its messages; the oldest are dropped",
                             self.publication.topic, self.caller)  # fmt: skip
            self.dropped += 1
            self.publication.limits.drop(DropReason.QUEUE_FULL)

    def pause(self) -> None:
        self._paused = True

    def resume(self) -> None:
        self._paused = False
        while self._queue and not self._paused:
            self._write(self._queue.pop(), None)

    def ended(self) -> None:
        """The connection is gone, and what waited for it is lost."""
        self._transport = None
        for _ in self._queue:
            self.publication.limits.drop(DropReason.DISCONNECTED)
        self._queue.clear()
        self.publication.left(self)

    def finish(self) -> None:
        """Send what was published before, the last of it may be a stop command, and then say that this was all. The
        subscriber ends the connection when it has read it."""
        if self._transport is not None and not self._over:
            self._over = True
            while self._queue:
                self._write(self._queue.pop(), None)
            self._transport.write_eof()

    def close(self) -> None:
        """End the connection. What was sent still leaves."""
        if self._transport is not None:
            self._transport.close()


class Limits:
    """How much may wait for one subscriber, and what was dropped, by reason, over the life of the endpoint."""

    def __init__(self, messages: int, size_bytes: int) -> None:
        self.messages = messages
        self.bytes = size_bytes
        self.dropped: Counter[DropReason] = Counter()

    def drop(self, why: DropReason, count: int = 1) -> None:
        self.dropped[why] += count


class Publication:
    """One topic that this node publishes. `topic` is its name at the master. `over` is called when it has ended.
    `as_node`: other SERN endpoints are not told that it is one's."""

    def __init__(
        self, topic: str, info: TopicInfo, caller: str, limits: Limits, over: "Ended", *, as_node: bool = False
    ) -> None:
        self.topic = topic
        self.info = info
        self.type_name = ros_types.ros1_name(info.type_name)
        self.limits = limits
        self.feeds: set[Feed] = set()
        self.handles: list[Handle] = []
        self.closed = False
        """Nobody can be served any more."""
        self.on_read: Callable[[], None] | None = None
        """Called when, after `close`, the last subscriber has gone."""
        self.latched = info.latched or is_static_tf(topic, info.type_name)
        self._static = TfLatch(Encoding.ROS1) if is_static_tf(topic, info.type_name) else None
        self._last: dict[Handle, bytes] = {}
        self._unreadable = False
        self._over = over
        newest_only = info.reliable is False and not self.latched
        self.first_messages = FirstMessages(
            topic,
            max_messages=min(info.depth or 1, limits.messages) if newest_only else limits.messages,
            max_bytes=limits.bytes,
            overflow=DropReason.SUPERSEDED if newest_only else DropReason.QUEUE_FULL,
            dropped=limits.drop,
            done=self._judge,
        )
        if self._static is not None:
            self.first_messages.close()  # one message says it all, to everybody who comes
        self.answer = {
            "callerid": caller,
            "topic": topic,
            "type": self.type_name,
            "md5sum": info.type_hash,
            "message_definition": info.definition,
            "latching": "1" if self.latched else "0",
        } | ({} if as_node else {BRIDGE_FIELD: caller})

    def fits(self, info: TopicInfo) -> bool:
        """Whether another stream is of the same type."""
        return (self.info.type_name, self.info.type_hash) == (info.type_name, info.type_hash)

    def goes_on_as(self, info: TopicInfo) -> bool:
        """Whether a new stream can take the place of those that have ended."""
        return self.fits(info) and self.latched == (info.latched or self._static is not None)

    def refusal(self, fields: dict[str, str]) -> str | None:
        """Why a subscriber with this header cannot be served; None when it can."""
        if fields.get("md5sum", "") not in ("*", self.info.type_hash):
            return (
                f"{self.topic}: {shown(fields, 'callerid', 'a subscriber')} expects {shown(fields, 'type', '*')} "
                f"with md5sum {shown(fields, 'md5sum')}, "
                f"what arrives here is {self.type_name} with {self.info.type_hash}"
            )
        return None

    def registered(self, subscribers: Iterable[str]) -> None:
        """The master lists us as its publisher, and these nodes as its subscribers."""
        self.first_messages.registered(subscribers)

    def join(self, feed: Feed) -> None:
        """A new subscriber: it gets what is latched, and the first messages that it has missed."""
        self.feeds.add(feed)
        missed = self.first_messages.joined(feed.caller)
        for body in [*(body for body in self.kept() if not any(body is other for other in missed)), *missed]:
            feed.send(body, None)

    def kept(self) -> list[bytes]:
        """What a late subscriber gets."""
        if self._static is not None and len(self._static):
            merged = self._static.merged()
            return [] if merged is None else [merged]
        return list(self._last.values())

    def publish(self, handle: "Handle", body: bytes, left_s: float = inf) -> None:
        if self.closed:
            self.limits.drop(DropReason.DISCONNECTED)
            return
        if self.latched:
            self._latch(handle, body)
        self.first_messages.keep(body, left_s)
        frame = LENGTH.pack(len(body)) + body if len(body) <= JOIN_BYTES else None
        for feed in self.feeds:
            feed.send(body, frame)

    def _latch(self, handle: "Handle", body: bytes) -> None:
        if self._static is not None:
            try:
                self._static.keep(handle, body)
                return
            except ConfigError as error:
                if not self._unreadable:
                    self._unreadable = True
                    _log.warning("%s: cannot be merged for late subscribers: %s", self.topic, error)
        self._last.pop(handle, None)
        self._last[handle] = body

    def leave(self, handle: "Handle") -> None:
        """One of the streams has ended."""
        self.handles.remove(handle)
        self._last.pop(handle, None)
        if self._static is not None:
            self._static.drop(handle)
        self._judge()

    def _judge(self) -> None:
        """End without a stream, once the subscribers that it has messages for have come or are given up."""
        if self.handles:
            return
        if self.first_messages.over or not len(self.first_messages):
            self._over(self)
        else:
            self.first_messages.hurry()

    def left(self, feed: Feed) -> None:
        """A subscriber has gone."""
        self.feeds.discard(feed)
        if self.closed and not self.feeds and self.on_read is not None:
            self.on_read()

    def close(self) -> None:
        """Send what was published, and nothing more."""
        self.closed = True
        self.first_messages.close()
        for feed in list(self.feeds):
            feed.finish()

    def cut(self) -> None:
        """Wait for no subscriber any more."""
        self.on_read = None
        for feed in list(self.feeds):
            feed.close()


class Handle:
    """The `AgingPublisher` of one stream."""

    def __init__(self, publication: Publication) -> None:
        self._publication: Publication | None = publication
        self._limits = publication.limits
        publication.handles.append(self)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        del stamp_ns  # TCPROS carries no time beside the message
        if self._publication is None:
            self._limits.drop(DropReason.DISCONNECTED)
        else:
            self._publication.publish(self, body, left_s)

    def close(self) -> None:
        publication, self._publication = self._publication, None
        if publication is not None:
            publication.leave(self)


class Ended:
    """Takes a publication that has ended out of the table it is in, and keeps it until its subscribers have read its
    last messages, for `LAST_READ_S` at most. `changed` is called when it is gone."""

    def __init__(self, publications: dict[str, Publication], changed: Callable[[], None]) -> None:
        self._publications = publications
        self._changed = changed
        self._leaving: dict[Publication, asyncio.TimerHandle] = {}
        self._none_leaves = asyncio.Event()
        self._none_leaves.set()

    @property
    def leaving(self) -> Iterable[Publication]:
        """Publications whose last messages are being read."""
        return self._leaving.keys()

    def __call__(self, publication: Publication) -> None:
        if self._publications.get(publication.topic) is publication:
            del self._publications[publication.topic]
        publication.close()
        if publication.feeds and publication not in self._leaving:
            publication.on_read = partial(self._gone, publication)
            timer = asyncio.get_running_loop().call_later(LAST_READ_S, self._gone, publication)
            self._leaving[publication] = timer
            self._none_leaves.clear()
        self._changed()

    def _gone(self, publication: Publication) -> None:
        self._leaving.pop(publication).cancel()
        if not self._leaving:
            self._none_leaves.set()
        publication.cut()
        self._changed()

    async def all_gone(self) -> None:
        """Return when all subscribers have read the last messages, or have had their time."""
        await self._none_leaves.wait()
