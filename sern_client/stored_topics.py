"""How much of a durable topic is on disk, as a topic beside it: TOPIC/sern/stored, std_msgs/UInt64, latched.

It counts all messages of the topic that the store has ever taken: a publisher that has sent one knows that it is kept
when the number has grown by one.
"""

import logging
import struct
import time
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Final

from sern_client.endpoints.base import Publisher
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

SUFFIX: Final = "/sern/stored"
TYPE: Final = "std_msgs/msg/UInt64"
_CDR_HEAD: Final = b"\x00\x01\x00\x00"
_COUNT: Final = struct.Struct("<Q")

_log = logging.getLogger(__name__)


class StoredTopics:
    """`advertise` publishes at this site's endpoint."""

    def __init__(self, advertise: Callable[[TopicInfo], Publisher]) -> None:
        self._advertise = advertise
        self._publishers: dict[TopicName, tuple[TopicInfo, Publisher]] = {}

    @property
    def held(self) -> Counter[TopicName]:
        """Our publishers, by local name."""
        return Counter(info.name for info, _publisher in self._publishers.values())

    def of(self, info: TopicInfo) -> Callable[[int], None] | None:
        """What is called with the count of a local topic; None: it cannot be published, which is said."""
        encoding = Encoding.ROS1 if info.encoding is Encoding.ROS1 else Encoding.CDR
        try:
            stored = ros_types.topic_info(topic_name(info.name + SUFFIX), TYPE, encoding, latched=True, reliable=True)
            self._publishers[info.name] = stored, self._advertise(stored)
        except (ConfigError, UsageError) as error:
            _log.info("%s: how much of it is on disk is not published: %s", info.name, error)
            return None
        head = b"" if encoding is Encoding.ROS1 else _CDR_HEAD

        def publish(count: int) -> None:
            held = self._publishers.get(info.name)
            if held is not None:
                held[1].publish(head + _COUNT.pack(count), time.time_ns())

        return publish

    def close(self, name: TopicName) -> None:
        """The local topic has ended."""
        held = self._publishers.pop(name, None)
        if held is not None:
            held[1].close()

    def repair(self, names: Collection[TopicName]) -> None:
        """These are not open at the endpoint as they should be: open them anew."""
        for name, (info, publisher) in list(self._publishers.items()):
            if info.name not in names:
                continue
            with suppress(Exception):  # it is not what it should be
                publisher.close()
            del self._publishers[name]
            try:
                self._publishers[name] = info, self._advertise(info)
            except ConfigError as error:
                _log.error("%s cannot be published again: %s", info.name, error)

    def close_all(self) -> None:
        for name in list(self._publishers):
            self.close(name)
