"""What viewers are told in words: what did not come of the topics here and why, and what they did wrong.

Statuses of the protocol have ids: one that is told again under its id takes the place of the one before. Each is told
when it changes, not more often than every few seconds, and taken back when it has not changed for a while. Who comes
later is told those that hold.
"""

import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from sern_client.endpoints.base import TopicNews
from sern_client.endpoints.foxglove.viewer import Viewer
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

LOOK_S: Final = 1.0
TELL_S: Final = 5.0
"""How often a status is told again at most."""
CALM_S: Final = 30.0
"""A status that has not changed for so long is taken back."""
MAX_STATUSES: Final = 500
INFO, WARNING, ERROR = 0, 1, 2
"""Levels of a status (Foxglove WebSocket protocol)."""
_DROPPED: Final = "sern/dropped"
_CAPPED: Final = "sern/capped"
_LEFT_OUT: Final = "sern/left_out"


class _Episode(NamedTuple):
    """Messages that did not come, from the first of them until none is missing for a while."""

    since: str
    before: int  # how many had not come until then
    total: int
    changed_s: float
    told_s: float | None
    told: int


class Episodes:
    """Rising counts, made into what is to be told. `update` as often as you like; `over` says which are to be taken
    back."""

    def __init__(self) -> None:
        self._known: dict[Hashable, int] = {}
        self._running: dict[Hashable, _Episode] = {}

    def update(self, key: Hashable, count: int, *, now: float, first: int | None = None) -> str | None:
        """Take a count; how many are new and since when, where that is to be told now. `first`: what it was before it
        was looked at; None: that is what it is now."""
        before = self._known.get(key, first)
        self._known[key] = count
        episode = self._running.get(key)
        if before is None:
            return None  # nobody looked: what was before is no news
        if count > before:
            if episode is None:
                episode = _Episode(time.strftime("%H:%M:%S"), before, before, now, None, before)
            episode = self._running[key] = episode._replace(total=count, changed_s=now)
        if episode is None or episode.total == episode.told:
            return None
        if episode.told_s is not None and now - episode.told_s < TELL_S:
            return None
        self._running[key] = episode._replace(told_s=now, told=episode.total)
        return f"{episode.total - episode.before} since {episode.since}"

    def over(self, *, now: float) -> list[Hashable]:
        """Those that have ended since it was asked last."""
        ended = [key for key, episode in self._running.items() if now - episode.changed_s >= CALM_S]
        for key in ended:
            del self._running[key]
        return ended

    def keep(self, keys: Iterable[Hashable]) -> list[Hashable]:
        """Forget all others; those of them that were told."""
        gone = self._known.keys() - set(keys)
        for key in gone:
            del self._known[key]
        return [key for key in gone if self._running.pop(key, None) is not None]


class News:
    """Statuses. `viewers`: all, also those who are not ready. `topics`: what is known of those that come. `name_of`:
    the topic of a channel."""

    def __init__(
        self,
        viewers: Callable[[], Sequence[Viewer]],
        topics: Callable[[], Sequence[TopicNews]],
        name_of: Callable[[int], TopicName | None],
    ) -> None:
        self._viewers = viewers
        self._topics = topics
        self._name_of = name_of
        self._active: dict[str, tuple[int, str]] = {}
        self._of_link = Episodes()
        self._of_viewers: dict[Viewer, Episodes] = {}
        self._timer = Timer(self._look)
        self._closed = False

    def viewers_changed(self) -> None:
        """Somebody has come or gone."""
        if not self._closed and self._timer.deadline_s is None:
            self._timer.arm(clock.now())

    def close(self) -> None:
        self._closed = True
        self._timer.cancel()

    def say(self, status: str, text: str, level: int = ERROR) -> None:
        """Tell all viewers, and those who come, until it is taken back."""
        full = len(self._active) >= MAX_STATUSES and status not in self._active
        if full or self._active.get(status) == (level, text):
            return
        self._active[status] = level, text
        for viewer in self._viewers():
            viewer.tell(_status(status, level, text))

    def take_back(self, statuses: Iterable[str]) -> None:
        told = [status for status in statuses if self._active.pop(status, None) is not None]
        if told:
            for viewer in self._viewers():
                viewer.tell({"op": "removeStatus", "statusIds": told})

    def _look(self) -> None:
        if not self._viewers():
            self._of_viewers.clear()
            self._of_link = Episodes()
            self.take_back([status for status in self._active if status.startswith((_DROPPED, _CAPPED))])
            return
        now = clock.now()
        self._timer.arm(now + LOOK_S)
        viewers = [viewer for viewer in self._viewers() if viewer.ready]
        self._look_at_link(now)
        for viewer in viewers:
            if viewer not in self._of_viewers:
                self._of_viewers[viewer] = Episodes()
                for status, (level, text) in self._active.items():
                    viewer.tell(_status(status, level, text))
            self._look_at(viewer, self._of_viewers[viewer], now)
        for viewer in self._of_viewers.keys() - set(viewers):
            del self._of_viewers[viewer]

    def _look_at_link(self, now: float) -> None:
        all_news = self._topics()
        capped = {f"{_CAPPED}{news.name}": news for news in all_news if news.capped_hz and news.age_s is not None}
        for status, news in capped.items():
            text = f"{news.name} comes {news.capped_hz:g} times a second at most: its site thins it (max_rate_hz there)"
            self.say(status, text, INFO)
        self.take_back([status for status in self._active if status.startswith(_CAPPED) and status not in capped])
        topics = {news.name: _lost(news.dropped) for news in all_news}
        for name, dropped in topics.items():
            told = self._of_link.update(name, sum(dropped.values()), now=now)
            if told is not None:
                self.say(f"{_DROPPED}{name}", f"{name}: {told} did not come ({_reasons(dropped)} in all)", WARNING)
        ended = [*self._of_link.over(now=now), *self._of_link.keep(topics)]
        self.take_back(f"{_DROPPED}{name}" for name in ended)

    def _look_at(self, viewer: Viewer, episodes: Episodes, now: float) -> None:
        """What one viewer did not take is of no interest to the others."""
        for channel, count in viewer.dropped.items():
            told = episodes.update(channel, count, now=now, first=0)
            name = self._name_of(channel)
            if told is not None and name is not None:
                text = f"{name}: {told} were left out here, because this viewer takes less than what comes"
                viewer.tell(_status(f"{_LEFT_OUT}{name}", WARNING, text))
        names = [self._name_of(channel) for channel in episodes.over(now=now) if isinstance(channel, int)]
        if ids := [f"{_LEFT_OUT}{name}" for name in names if name is not None]:
            viewer.tell({"op": "removeStatus", "statusIds": ids})


def _status(status: str, level: int, text: str) -> dict[str, object]:
    return {"op": "status", "level": level, "message": text, "id": status}


def _lost(dropped: Mapping[DropReason, int]) -> dict[DropReason, int]:
    """What is missing: a message that came twice is counted as dropped, and is there."""
    return {reason: count for reason, count in dropped.items() if reason != DropReason.DUPLICATE}


def _reasons(dropped: Mapping[DropReason, int]) -> str:
    return ", ".join(f"{reason} {count}" for reason, count in dropped.items() if count)
