"""What reads messages at the relay itself, beside the links of the clients: the feed, and the registry's transforms."""

import logging
from typing import Final

from sern_core.bodies.codecs import Coder
from sern_core.stream.decoding import Decoder
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason, TopicName
from sern_relay.feed import RelayFeed
from sern_relay.transforms import TransformObjects
from sern_runtime import clock
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.link_metrics import AgeHistograms
from sern_runtime.optional import OptionalParts

_log: Final = logging.getLogger(__name__)


class Readers:
    """Hands each message of the hub to them, decoded and in its turn. What fails in one of them costs neither the other
    one nor a client anything. The owner sets `feed` and `transforms`; None: there is none."""

    def __init__(self, coder: Coder, parts: OptionalParts, errors: InternalErrors) -> None:
        self.ages = AgeHistograms()
        """How old messages are when they come, by class."""
        self.feed: RelayFeed | None = None
        self.transforms: TransformObjects | None = None
        self._parts = parts
        self._decoder = Decoder[StreamInfo](
            coder, lambda stream: stream, self._deliver, self._undecodable, fault=errors.core
        )
        self._told: set[TopicName] = set()

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """A message has come to the hub."""
        try:
            self.ages.observe(stream.spec.priority, now - message.born_s)
            if not message.codec or self._reads(stream):  # else it goes on as it is
                self._decoder.message(stream, message, now=now)
        except Exception as error:  # noqa: BLE001  (none of it is needed for the message's own way)
            self._parts.failed("metrics", error)

    def stream_removed(self, stream: StreamInfo) -> None:
        self._decoder.forget(stream.id, now=clock.now())
        if self.transforms is not None:
            with self._parts.survive("objects"):
                self.transforms.stream_removed(stream)
        self.owners_changed()

    def close(self) -> None:
        """Close what there is, the last made first, also when one fails."""
        try:
            if self.transforms is not None:
                self.transforms.close()
        finally:
            if self.feed is not None:
                self.feed.close()

    def owners_changed(self) -> None:
        """A stream has come or gone, and so may have who owns a topic."""
        if self.feed is not None:
            with self._parts.survive("feed"):
                self.feed.owners_changed()

    def _reads(self, stream: StreamInfo) -> bool:
        """Whether one of them wants the stream's messages."""
        if self.transforms is not None and self.transforms.reads(stream):
            return True
        return self.feed is not None and self.feed.feed.wants(stream.id.topic)

    def _undecodable(self, stream: StreamInfo, message: Message, reason: DropReason, problem: str, now: float) -> None:
        topic = stream.id.topic
        if reason is DropReason.UNDECODABLE and topic not in self._told and len(self._told) < MAX_TOPICS:
            self._told.add(topic)
            _log.error("%s of %s cannot be decoded for the feed or the registry: %s", topic, stream.id.origin, problem)

    def _deliver(self, stream: StreamInfo, message: Message, now: float) -> None:
        """A message in its turn, decoded."""
        try:
            if self.transforms is not None:
                self.transforms.message(stream, message, now=now)
        except Exception as error:  # noqa: BLE001  (of the registry alone)
            self._parts.failed("objects", error)
        try:
            if self.feed is not None:
                self.feed.publish(stream, message, now=now)
        except Exception as error:  # noqa: BLE001  (of the feed alone)
            self._parts.failed("feed", error)
