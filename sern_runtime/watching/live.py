"""Watches a daemon for whoever watches it: looks once a second while somebody does, and keeps the links' history.

Everybody gets the same frames. Who is slow gets the newest when there is room for it, and none in between: nothing is
queued for anybody.
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import contextmanager
from typing import Final, TypeVar

from sern_core.vocabulary.errors import UsageError
from sern_runtime import clock
from sern_runtime.events import EventLog
from sern_runtime.metrics import Metrics
from sern_runtime.watching.alerts import alerts
from sern_runtime.watching.frames import links_frame, state_frame
from sern_runtime.watching.history import LinkHistory
from sern_runtime.watching.state import EVENTS, FlowTable, Sample, sample
from sern_runtime.watching.told import Json, Told
from sern_runtime.watching.why import Comparison

INTERVAL_S: Final = 1.0
FIRST_S: Final = 0.4
"""Time between the first two looks: before the second there are no rates, and nothing is shown."""
WINDOW_S: Final = 3.2
"""The time over which rates are taken."""
MAX_WATCHERS: Final = 8
SLICE: Final = 50
"""Rows that are read or judged in one turn of the loop: some 5 ms."""
SLOW: Final = "slow"
FULL: Final = "full"
PART: Final = "watching"

T = TypeVar("T")


class FullError(UsageError):
    """There are as many watchers as there may be."""


async def sliced(items: Iterable[T]) -> AsyncIterator[T]:
    """The items, with the loop's other work in between."""
    for count, item in enumerate(items, 1):
        yield item
        if not count % SLICE:
            await asyncio.sleep(0)


class Live:
    """`run` until cancelled; `close` when the HTTP server ends."""

    def __init__(
        self, told: Told, events: EventLog, *, interval_s: float = INTERVAL_S, max_watchers: int = MAX_WATCHERS
    ) -> None:
        self.history = LinkHistory()
        self.frame = ""
        """What is so now, as JSON; empty: nobody has looked."""
        self.number = 0
        """How many frames there have been."""
        self.closed = False
        self.turned_away = {SLOW: 0, FULL: 0}
        """Watchers that were cut or not let in, so far, by why."""
        self._told = told
        self._events = events
        self._interval_s = interval_s
        self._max_watchers = max_watchers
        self._watchers: set[Watcher] = set()
        self._samples: deque[Sample] = deque()
        self._wanted = asyncio.Event()

    @property
    def watchers(self) -> int:
        return len(self._watchers)

    @contextmanager
    def watcher(self) -> Iterator["Watcher"]:
        """Who watches while the block runs. Raises FullError."""
        if len(self._watchers) >= self._max_watchers:
            self.turned_away[FULL] += 1
            raise FullError(f"{self._max_watchers} pages watch this daemon already; close one of them")
        watcher = Watcher(self)
        self._watchers.add(watcher)
        if not self.frame:
            self._wanted.set()
        try:
            yield watcher
        finally:
            self._watchers.discard(watcher)

    def close(self) -> None:
        """End everybody's watching."""
        self.closed = True
        self._wake()

    def reset(self) -> None:
        """Begin anew, after a failure."""
        self._samples.clear()
        self.frame = ""

    async def run(self) -> None:
        """Look again and again, until cancelled."""
        while True:
            await self._pause(FIRST_S if len(self._samples) == 1 else self._interval_s)
            await self._note_links()
            if self._watchers:
                await self._look()
            else:
                self.reset()

    async def _pause(self, pause_s: float) -> None:
        self._wanted.clear()
        if self._watchers and not self._samples:
            return
        try:
            async with asyncio.timeout(pause_s):
                await self._wanted.wait()
        except TimeoutError:
            return

    async def _note_links(self) -> None:
        now = clock.now()
        async for look in sliced(self._told.looks(now)):
            self.history.note(look, now=now)
        self.history.advance(now=now)

    async def _look(self) -> None:
        """Read everything, a few rows in a turn, and make a frame of it if there is something to compare it with."""
        told = self._told
        head = told.head()
        flows = FlowTable(relay=head["role"] == "relay")
        async for part in sliced(told.topics()):
            flows.add(part)
        clients = [row async for row in sliced(told.clients())]
        links = [row async for row in sliced(told.links())]
        objects = Counter([kind async for kind in sliced(told.objects())])
        adapting = told.adapting()
        adaptation: Json | None = None
        if adapting is not None:
            adaptation = {**adapting.head, "links": [row async for row in sliced(adapting.links)]}
        events = self._events.after(self._events.last - EVENTS)
        now = sample(clock.now(), head, clients, links, flows, adaptation, events)
        samples = self._samples
        while len(samples) > 1 and now.at_s - samples[0].at_s > WINDOW_S:
            samples.popleft()
        if samples:
            comparison = Comparison(samples[0], now)
            view = comparison.view([line async for line in sliced(comparison.topics())])
            pieces = state_frame(view, alerts(view), adaptation=adaptation, objects=objects)
            self.frame = "".join([piece async for piece in sliced(pieces)])
            self.number += 1
            self._wake()
        samples.append(now)

    def _wake(self) -> None:
        for watcher in self._watchers:
            watcher.wake()

    def register(self, metrics: Metrics) -> None:
        """What is counted here."""
        metrics.gauge(
            "sern_http_watchers", "Pages that watch this daemon.", read=lambda: [((), float(len(self._watchers)))]
        )
        metrics.counter(
            "sern_http_watchers_turned_away_total",
            "Pages that were cut as they were too slow, or not let in as there were too many.",
            ("reason",),
            lambda: [((reason,), float(count)) for reason, count in self.turned_away.items()],
        )


class Watcher:
    """One page that watches."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._woken = asyncio.Event()
        self._seen = 0
        self._step = -1

    def wake(self) -> None:
        self._woken.set()

    async def next(self) -> list[tuple[str, str]] | None:
        """What is new, as names and JSON texts of events; None: there will be nothing more."""
        live = self._live
        while live.number == self._seen or not live.frame:
            if live.closed:
                return None
            self._woken.clear()
            await self._woken.wait()
        if live.closed:
            return None
        self._seen = live.number
        events = [("state", live.frame)]
        history = live.history
        if history.number > self._step:
            number, since = history.number, self._step
            pieces = links_frame(history.step_s, number, history.left_out, history.since(since))
            events.insert(0, ("links", "".join([piece async for piece in sliced(pieces)])))
            self._step = number
        return events
