"""Which of the messages on a topic we have published ourselves.

rclpy does not say whose a message is. But it says when it was published, and our own ones were published while we did
so: the same length, the same ends, and a source stamp between our two looks at the clock are ours. Where a middleware
gives no source stamps, so many of a kind are ours as we have published.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from sern_core.vocabulary.types import TopicName

MAX_KEPT: Final = 1000
"""Messages of a topic that are known as ours, unless a publisher of it keeps more for late joiners."""
KEPT_NS: Final = 10 * 10**9
"""How long one may be on its way back to us."""
SLACK_NS: Final = 1000
"""Middlewares carry stamps in fractions of a second, which are rounded."""
_END_BYTES: Final = 256


class _Published(NamedTuple):
    digest: int
    began_ns: int
    ended_ns: int


@dataclass(slots=True)
class _Topic:
    published: deque[_Published] = field(default_factory=deque)
    stepped: bool = False
    """The clock went back between two of them: the later ones are not those with later stamps."""


def digest(body: bytes) -> int:
    """A digest of length and ends: with the time of publication that is enough, at one price for every size."""
    return hash((len(body), body[:_END_BYTES], body[-_END_BYTES:]))


class Echoes:
    """What an endpoint has published in its domain, by topic. `clock_ns`: the clock that source stamps are of."""

    def __init__(self, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._clock_ns = clock_ns
        self._topics: dict[TopicName, _Topic] = {}

    def publish(self, name: TopicName, body: bytes, publish: Callable[[bytes], None], *, keep: int) -> None:
        """Have a message published. `keep`: how many of the topic may come back to us however old they are."""
        topic = self._topics.setdefault(name, _Topic())
        began_ns = self._clock_ns()
        try:
            publish(body)
        finally:  # one that failed may be on its way all the same
            ended_ns = self._clock_ns()
            kept = topic.published
            if kept and began_ns < kept[-1].ended_ns:
                topic.stepped = True
            kept.append(_Published(digest(body), began_ns, ended_ns))
            while len(kept) > max(keep, 1) and (len(kept) > MAX_KEPT or kept[0].ended_ns < ended_ns - KEPT_NS):
                kept.popleft()

    def ours(self, name: TopicName, body: bytes, stamp_ns: int) -> bool:
        """Whether a message that has come from the middleware is one of ours. `stamp_ns` 0: it does not say when it was
        published."""
        topic = self._topics.get(name)
        if topic is None:
            return False
        of = digest(body)
        for index in range(len(topic.published) - 1, -1, -1):
            each = topic.published[index]
            if stamp_ns > each.ended_ns + SLACK_NS and not topic.stepped:
                return False  # and those before it are older still
            if each.digest != of:
                continue
            if not stamp_ns:
                del topic.published[index]
                return True
            if each.began_ns - SLACK_NS <= stamp_ns <= each.ended_ns + SLACK_NS:
                return True
        return False

    def forget(self, name: TopicName) -> None:
        """Nothing of ours is published there any more, nor heard."""
        self._topics.pop(name, None)
