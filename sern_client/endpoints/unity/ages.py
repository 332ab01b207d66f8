"""How old topics are, for whoever asks: std_msgs/Float32, a few times a second, growing while nothing comes."""

import asyncio
import struct
from collections.abc import Callable, Sequence
from typing import Final

from sern_client.endpoints.base import TopicNews
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock

AGE_TYPE: Final = "std_msgs/msg/Float32"
AGE_PERIOD_S: Final = 0.25
_FLOAT: Final = struct.Struct("<f")
_CDR_HEADER: Final = b"\x00\x01\x00\x00"

Told = Callable[[bytes], None]
"""`told(body)`: a Float32 with the age in seconds."""


class AgeWatch:
    """One who is told how old a topic is, until `close`."""

    def __init__(self, owner: "Ages", topic: TopicName, told: Told) -> None:
        self.topic = topic
        self.told = told
        self._owner = owner

    def close(self) -> None:
        self._owner.forget(self)


class Ages:
    """`news` says how old topics are now. Of one that has gone the last message goes on growing older; before the
    first message of a topic nothing is said. Only on the event loop."""

    def __init__(self, encoding: Encoding, news: Callable[[], Sequence[TopicNews]]) -> None:
        self._header = _CDR_HEADER if encoding is Encoding.CDR else b""
        self._news = news
        self._watches: dict[TopicName, list[AgeWatch]] = {}
        self._born_s: dict[TopicName, float] = {}  # of the newest message, of topics that somebody watches
        self._timer: asyncio.TimerHandle | None = None

    def watch(self, topic: TopicName, told: Told) -> AgeWatch:
        watch = AgeWatch(self, topic, told)
        self._watches.setdefault(topic, []).append(watch)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(0, self._tell)
        return watch

    def forget(self, watch: AgeWatch) -> None:
        """It is told nothing more; once more of it changes nothing."""
        watches = self._watches.get(watch.topic, [])
        if watch in watches:
            watches.remove(watch)
            if not watches:
                del self._watches[watch.topic]
                self._born_s.pop(watch.topic, None)
        if not self._watches:
            self.close()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tell(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(AGE_PERIOD_S, self._tell)
        now = clock.now()
        for news in self._news():
            if news.name in self._watches and news.age_s is not None:
                self._born_s[news.name] = now - news.age_s
        for topic, born_s in list(self._born_s.items()):
            body = self._header + _FLOAT.pack(max(0.0, now - born_s))
            for watch in list(self._watches.get(topic, ())):
                watch.told(body)
