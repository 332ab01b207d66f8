"""The topics of updates that a site asks for beside its own patterns: those of the patches that are open now.

Peers decide how many grids there are and how often they come and go. So at most MAX_TOPICS are asked for, those that
have been open longest, and the relay is told of changes together and not more often than once in PAUSE_S.
"""

import logging
from collections.abc import Callable
from itertools import islice
from typing import Final

from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

MAX_TOPICS: Final = 256
PAUSE_S: Final = 1.0
"""How long after a change of the subscription the next one waits."""

_log = logging.getLogger(__name__)


class UpdateTopics:
    """`opened` and `closed` for each stream of whole grids; `close` it at the end.

    `of_site(topic)` tells whether the site subscribes to a topic by itself; `add(names)` asks for these, in place of
    those before.
    """

    def __init__(self, of_site: Callable[[TopicName], bool], add: Callable[[list[TopicName]], None]) -> None:
        self.of_site = of_site
        self._add = add
        self._open: dict[StreamId, TopicName] = {}
        self._told: list[TopicName] = []
        self._complained = False
        self._next_s = 0.0
        self._timer = Timer(self._tell)

    def close(self) -> None:
        """Ask for nothing more."""
        self._timer.cancel()
        self._open.clear()

    def opened(self, stream: StreamId, topic: TopicName) -> None:
        """The updates of a stream are on a topic: have it, unless the site has it by itself."""
        if not self.of_site(topic):
            self._open[stream] = topic
            self._arm()

    def closed(self, stream: StreamId) -> None:
        """A stream, of whole grids or not, has ended."""
        if self._open.pop(stream, None) is not None:
            self._arm()

    def _arm(self) -> None:
        if self._timer.deadline_s is None:
            self._timer.arm(max(clock.now(), self._next_s))

    def _tell(self) -> None:
        topics = dict.fromkeys(self._open.values())
        if len(topics) > MAX_TOPICS and not self._complained:
            self._complained = True
            _log.warning(
                "%d grids of patches are open; updates are asked for of %d: subscribe to the others by name",
                len(topics), MAX_TOPICS,
            )  # fmt: skip
        wanted = sorted(islice(topics, MAX_TOPICS))
        if wanted != self._told:
            self._told = wanted
            self._next_s = clock.now() + PAUSE_S
            self._add(wanted)
