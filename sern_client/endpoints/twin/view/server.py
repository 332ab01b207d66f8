"""Runs the view beside the twins: takes snapshots, keeps the last minutes, and has them drawn in another thread.

A browser that is slow or gone costs the twins nothing: what is drawn is the newest there is when the drawing before is
done, ten times a second at most, and nothing while nobody looks.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.base import SceneShown
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.twin.options import ViewOptions
from sern_client.endpoints.twin.view.frames import Snapshot
from sern_client.endpoints.twin.view.history import STEP_S, History, SceneHistory, SceneMoment
from sern_runtime.entry import end_tasks

if TYPE_CHECKING:
    from sern_client.endpoints.twin.view.page import Page

DRAW_S: Final = 0.1
BLOCKS_S: Final = 1.0
"""How often what stands around is drawn at most, while it changes."""
AGES_S: Final = 10.0
"""The same while it does not, and only gets older."""
SHARE: Final = 0.25
"""Snapshots and drawing take this share of the time at most: of hundreds of robots there are fewer pictures."""
PAUSE_S: Final = 1.0
"""After a failure."""

_log = logging.getLogger(__name__)


class TwinView:
    """`look` makes the snapshot of now. `failures` counts drawings that failed."""

    def __init__(
        self,
        options: ViewOptions,
        robots: tuple[str, ...],
        look: Callable[[], Snapshot],
        *,
        now: Callable[[], float],
    ) -> None:
        self._options = options
        self._names = robots
        self._look = look
        self._now = now
        self.history = History()
        self.scene_history = SceneHistory()
        self.failures = 0
        self.page: Page | None = None
        self.scene: SceneShown | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._said = SayOnce(_log)
        self._grounded = False
        self._blocks_due_s = 0.0
        self._ages_due_s = 0.0
        self._changes = -1
        self._past: SceneMoment | None = None
        """What is drawn of the scene, if not that of now."""

    async def start(self) -> None:
        """ConfigError: the address cannot be listened on."""
        self.page = await asyncio.to_thread(self._open)
        _log.info("the twins are to be seen at %s", self.page.url)
        self._tasks = [
            asyncio.create_task(self._keep(self._record), name="twin view: history"),
            asyncio.create_task(self._keep(self._show), name="twin view: drawing"),
        ]

    def _open(self) -> "Page":
        from sern_client.endpoints.twin.view.page import Page

        return Page(self._options, self._names)

    async def stop(self) -> None:
        await end_tasks(self._tasks)
        if self.page is not None:
            await asyncio.to_thread(self.page.close)

    async def _keep(self, run: Callable[[], Awaitable[None]]) -> None:
        """Go on after whatever goes wrong: the twins do not depend on who looks at them."""
        while True:
            try:
                await run()
            except Exception as error:  # noqa: BLE001  (counted and said)
                self.failures += 1
                self._said(f"the view of the twins failed, and goes on: {error}", type(error).__name__, error=error)
                await asyncio.sleep(PAUSE_S)

    async def _record(self) -> None:
        begin_s = self._now()
        await self.record()
        await asyncio.sleep(pause_s(STEP_S, self._now() - begin_s))

    async def record(self) -> None:
        """Keep what is to be seen now, where it is time for that."""
        begin_s = self._now()
        if self.history.due(begin_s):
            self.history.add(self._look())
        scene = self.scene
        if scene is not None and self.scene_history.due(begin_s, scene.changes):
            changes = scene.changes
            parts = begin_s, scene.cells(), scene.ages_s(), scene.discrepancies()
            self.scene_history.add(await asyncio.to_thread(SceneMoment.of, *parts), changes)

    async def _show(self) -> None:
        begin_s, page = self._now(), self.page
        if page is None or not page.watched:
            self._changes, self._past = -1, None  # for who comes next all of it is drawn at once
        else:
            await self.draw(page)
        await asyncio.sleep(pause_s(DRAW_S, self._now() - begin_s))

    async def draw(self, page: "Page") -> None:
        """Draw what the slider asks for, and what stands around where that is due."""
        from sern_client.endpoints.twin.view.page import Picture

        now, ago_s = self._now(), page.ago_s
        latest = self._look()
        self.history.add(latest)
        snapshot = latest if ago_s <= 0 else self.history.at(now - ago_s) or latest
        past = None if ago_s <= 0 else self.scene_history.at(now - ago_s)
        scene = self.scene
        if scene is not None and scene.ground is not None and not self._grounded:
            self._grounded = True
            await asyncio.to_thread(page.ground, scene.ground, scene.terrain)
        discrepancies = () if scene is None else scene.discrepancies() if past is None else past.discrepancies
        picture = Picture(
            snapshot, now - snapshot.time_s if ago_s > 0 else 0.0, self.history.reaches_s(now), discrepancies
        )
        await asyncio.to_thread(page.draw, picture)
        if scene is not None:
            await self._draw_blocks(page, scene, past, now)

    async def _draw_blocks(self, page: "Page", scene: SceneShown, past: SceneMoment | None, now: float) -> None:
        """Draw blocks as they are, or as they were in the past; seldom, since there may be many."""
        other = past is not self._past
        changed = past is None and (scene.changes != self._changes or now >= self._ages_due_s)
        if not other and not (changed and now >= self._blocks_due_s):
            return
        from sern_client.endpoints.twin.view.blocks import boxes  # needs what a scene does

        self._past = past
        self._changes, self._blocks_due_s, self._ages_due_s = scene.changes, now + BLOCKS_S, now + AGES_S
        grid = scene.grid
        if past is None:
            cells, ages_s = scene.cells(), scene.ages_s()
            await asyncio.to_thread(lambda: page.blocks(boxes(grid, cells, ages_s)))
        else:
            await asyncio.to_thread(lambda: page.blocks(boxes(grid, past.cells, past.ages_s)))


def pause_s(least_s: float, took_s: float) -> float:
    """How long to wait after what took so long, so that it takes `SHARE` of the time at most."""
    return max(least_s, took_s * (1 / SHARE - 1))
