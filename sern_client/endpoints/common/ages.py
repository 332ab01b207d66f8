"""How old a topic of another site is, as a topic of its own: TOPIC/sern/age, std_msgs/Float32, seconds.

It grows while nothing comes, and is published while somebody looks at it. To look at the age of a topic does not make
the topic itself come.
"""

import struct
from collections.abc import Callable
from math import nan
from typing import Final

from sern_client.endpoints.base import Viewed
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.loop import Timer

SUFFIX: Final = "/sern/age"
PERIOD_S: Final = 0.25
_CDR_HEAD: Final = b"\x00\x01\x00\x00"
_FLOAT: Final = struct.Struct("<f")


def age_topic(info: TopicInfo) -> TopicInfo | None:
    """The topic of a topic's age, in the encoding of that topic; None: it has none, because its name would be too long
    or it is an age itself."""
    if info.name.endswith(SUFFIX):
        return None
    try:
        name = topic_name(info.name + SUFFIX)
    except UsageError:
        return None
    encoding = Encoding.ROS1 if info.encoding is Encoding.ROS1 else Encoding.CDR
    return ros_types.topic_info(name, "std_msgs/msg/Float32", encoding)


def age_body(age_s: float, encoding: Encoding) -> bytes:
    """The message of an age, NaN where none is known."""
    return (b"" if encoding is Encoding.ROS1 else _CDR_HEAD) + _FLOAT.pack(age_s)


class Ages:
    """Has `publish(name, age_s)` called of each topic whose age somebody looks at; NaN: nothing of it has come."""

    def __init__(self, viewed: Viewed, publish: Callable[[TopicName, float], None]) -> None:
        self._viewed = viewed
        self._publish = publish
        self._looked_at: set[TopicName] = set()
        self._timer = Timer(self._tell)

    def look(self, name: TopicName, looked: bool) -> None:
        """Somebody looks at the age of a topic, by the topic's name, or nobody does any more."""
        (self._looked_at.add if looked else self._looked_at.discard)(name)
        if self._looked_at and self._timer.deadline_s is None:
            self._timer.arm(clock.now())

    def close(self) -> None:
        self._looked_at.clear()
        self._timer.cancel()

    def _tell(self) -> None:
        if not self._looked_at:
            return
        self._timer.arm(clock.now() + PERIOD_S)
        known = {news.name: news.age_s for news in self._viewed.topics()}
        for name in list(self._looked_at):
            age_s = known.get(name)
            self._publish(name, nan if age_s is None else age_s)
