"""How old topics are, for each scene that asks (`common/ages`)."""

from collections.abc import Callable, Sequence
from math import isnan

from sern_client.endpoints.base import TopicNews
from sern_client.endpoints.common import ages
from sern_client.endpoints.common.ages import age_body
from sern_core.vocabulary.types import Encoding, TopicName

Told = Callable[[bytes], None]
"""`told(body)`: a Float32 with the age in seconds."""


class AgeWatch:
    """One who is told how old a topic is, until `close`."""

    def __init__(self, owner: "AgeWatches", topic: TopicName, told: Told) -> None:
        self.topic = topic
        self.told = told
        self._owner = owner

    def close(self) -> None:
        self._owner.forget(self)


class AgeWatches:
    """`topics` says how old topics are now. Before the first message of a topic nothing is told: a scene has no use for
    an age that is not known. Only on the event loop."""

    def __init__(self, encoding: Encoding, topics: Callable[[], Sequence[TopicNews]]) -> None:
        self._encoding = encoding
        self._topics = topics
        self._watches: dict[TopicName, list[AgeWatch]] = {}
        self._ages: ages.Ages | None = None  # from the first watch on

    def watch(self, topic: TopicName, told: Told) -> AgeWatch:
        watch = AgeWatch(self, topic, told)
        self._watches.setdefault(topic, []).append(watch)
        if self._ages is None:
            self._ages = ages.Ages(self._topics, self._tell)
        self._ages.look(topic, looked=True)
        return watch

    def forget(self, watch: AgeWatch) -> None:
        """It is told nothing more; once more of it changes nothing."""
        watches = self._watches.get(watch.topic, [])
        if watch in watches:
            watches.remove(watch)
            if not watches:
                del self._watches[watch.topic]
                if self._ages is not None:
                    self._ages.look(watch.topic, looked=False)

    def close(self) -> None:
        self._watches.clear()
        if self._ages is not None:
            self._ages.close()

    def _tell(self, topic: TopicName, age_s: float) -> None:
        if not isnan(age_s):
            body = age_body(max(0.0, age_s), self._encoding)
            for watch in list(self._watches.get(topic, ())):
                watch.told(body)
