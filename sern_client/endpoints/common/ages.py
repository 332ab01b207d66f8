"""How old a topic of another site is, as a topic of its own: TOPIC/sern/age, std_msgs/Float32, seconds.

It grows while nothing comes, and is published while somebody looks at it. To look at the age of a topic does not make
the topic itself come.
"""

import struct
from collections.abc import Callable, Sequence
from math import nan
from typing import Final

from sern_client.endpoints.base import TopicNews
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.loop import Timer

SUFFIX: Final = "/sern/age"
TYPE: Final = "std_msgs/msg/Float32"
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
    return ros_types.topic_info(name, TYPE, encoding)


def age_body(age_s: float, encoding: Encoding) -> bytes:
    """The message of an age, NaN where none is known."""
    return (b"" if encoding is Encoding.ROS1 else _CDR_HEAD) + _FLOAT.pack(age_s)


class Ages:
    """Has `publish(name, age_s)` called of each topic whose age somebody looks at; NaN: nothing of it has come.
    `topics` says how old they are. Of one that has gone the last message goes on growing older."""

    def __init__(self, topics: Callable[[], Sequence[TopicNews]], publish: Callable[[TopicName, float], None]) -> None:
        self._topics = topics
        self._publish = publish
        self._looked_at: set[TopicName] = set()
        self._born_s: dict[TopicName, float] = {}  # of their newest messages
        self._timer = Timer(self._tell)

    def look(self, name: TopicName, looked: bool) -> None:
        """Somebody looks at the age of a topic, by the topic's name, or nobody does any more."""
        if looked:
            self._looked_at.add(name)
        else:
            self._looked_at.discard(name)
            self._born_s.pop(name, None)
        if self._looked_at and self._timer.deadline_s is None:
            self._timer.arm(clock.now())

    def close(self) -> None:
        self._looked_at.clear()
        self._born_s.clear()
        self._timer.cancel()

    def _tell(self) -> None:
        if not self._looked_at:
            return
        now = clock.now()
        self._timer.arm(now + PERIOD_S)
        for news in self._topics():
            if news.name in self._looked_at and news.age_s is not None:
                self._born_s[news.name] = now - news.age_s
        for name in list(self._looked_at):
            self._publish(name, now - self._born_s[name] if name in self._born_s else nan)
