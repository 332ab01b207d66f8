"""What the view has drawn and when, without a browser: the page only remembers."""

from typing import Any, cast

import numpy as np

from benchmarks.twin_picture import World, yard
from sern_client.endpoints.twin.options import ViewOptions
from sern_client.endpoints.twin.view.frames import Box
from sern_client.endpoints.twin.view.server import AGES_S, BLOCKS_S, DRAW_S, SHARE, TwinView, pause_s
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.mesh import Mesh
from sern_twin.world.patches import Cells
from sern_twin.world.terrain import Terrain, flat


class FakePage:
    """A `Page` with its slider at `ago_s`."""

    def __init__(self) -> None:
        self.ago_s = 0.0
        self.drawn: list[Any] = []
        self.boxes: list[list[Box]] = []
        self.grounds: list[int] = []

    def ground(self, mesh: Mesh, terrain: Terrain | None) -> None:
        assert mesh.faces.max() < len(mesh.vertices) and terrain is not None
        self.grounds.append(len(mesh.faces))

    def draw(self, picture: object) -> None:
        self.drawn.append(picture)

    def blocks(self, boxes: list[Box]) -> None:
        self.boxes.append(boxes)


class FakeScene:
    """A `SceneShown` of the yard of the picture."""

    def __init__(self) -> None:
        self.grid, self._cells, self._ages_s = yard()
        self.changes = 0
        self.asked = 0
        self.terrain: Terrain | None = flat(self.grid)
        self.ground: Mesh | None = flat(self.grid).mesh(step=10)
        self.found: tuple[SeenDiscrepancy, ...] = ()

    def set_one_box(self) -> None:
        self._cells = np.where(np.arange(self._cells.size).reshape(self._cells.shape) == 77, 100, -1).astype(np.int8)
        self.changes += 1

    def cells(self) -> Cells:
        self.asked += 1
        return self._cells.astype(np.int8)

    def ages_s(self) -> Any:
        return self._ages_s

    def discrepancies(self) -> tuple[SeenDiscrepancy, ...]:
        return self.found


def made(world: World) -> tuple[TwinView, FakePage, Any]:
    view = TwinView(ViewOptions("127.0.0.1", 0), (), world.endpoint.snapshot, now=lambda: world.now)
    page = FakePage()
    return view, page, cast("Any", page)


async def test_the_slider_says_which_moment_is_drawn() -> None:
    world = World()
    view, page, as_page = made(world)
    for step in range(40):
        world.now = step * 0.25
        view.history.add(world.endpoint.snapshot())
    world.now = 10.0
    await view.draw(as_page)
    page.ago_s = 4.0
    await view.draw(as_page)
    page.ago_s = 600.0
    await view.draw(as_page)
    now, then, oldest = page.drawn
    assert (now.snapshot.time_s, now.ago_s) == (10.0, 0.0)
    assert (then.snapshot.time_s, then.ago_s) == (6.0, 4.0)
    assert (oldest.snapshot.time_s, oldest.ago_s, oldest.reaches_s) == (0.0, 10.0, 10.0)


async def test_what_stands_around_is_drawn_when_it_changes_and_as_it_gets_older() -> None:
    world = World()
    view, page, as_page = made(world)
    await view.draw(as_page)
    assert page.boxes == [], "there is no scene"
    scene = FakeScene()
    view.scene = scene
    world.now = 100.0
    await view.draw(as_page)
    assert len(page.boxes) == 1 and len(page.boxes[0]) > 100
    world.now += BLOCKS_S
    await view.draw(as_page)
    assert scene.asked == 1, "nothing has changed"
    scene.changes += 1
    await view.draw(as_page)
    assert scene.asked == 2
    scene.changes += 1
    world.now += BLOCKS_S / 2
    await view.draw(as_page)
    assert scene.asked == 2, "not so soon"
    world.now += BLOCKS_S / 2
    await view.draw(as_page)
    assert scene.asked == len(page.boxes) == 3
    world.now += AGES_S
    await view.draw(as_page)
    assert scene.asked == 4, "older by now"


async def test_the_slider_moves_what_stands_around_too() -> None:
    world = World()
    view, page, as_page = made(world)
    scene = FakeScene()
    view.scene = scene
    phantom = SeenDiscrepancy("a", "robot", DiscrepancyKind.PHANTOM, 1.0, 2.0, 0.5, 9)
    for step in range(60):
        world.now = float(step)
        if step == 30:
            scene.set_one_box()
            scene.found = (phantom,)
        await view.record()
    assert len(view.scene_history) == 2, "it changed once"
    await view.draw(as_page)
    page.ago_s = 40.0
    await view.draw(as_page)
    await view.draw(as_page)
    page.ago_s = 10.0
    await view.draw(as_page)
    page.ago_s = 0.0
    await view.draw(as_page)
    assert [len(boxes) for boxes in page.boxes] == [1, 320, 1, 1], "now, then once, at its end, and now again"
    assert [picture.discrepancies for picture in page.drawn] == [(phantom,), (), (), (phantom,), (phantom,)]


def test_the_view_of_many_robots_takes_a_share_of_the_time() -> None:
    assert pause_s(DRAW_S, 0.0) == pause_s(DRAW_S, 0.01) == DRAW_S
    assert 0.5 / (0.5 + pause_s(DRAW_S, 0.5)) == SHARE


async def test_the_ground_is_drawn_once() -> None:
    world = World()
    view, page, as_page = made(world)
    view.scene = FakeScene()
    for step in range(5):
        world.now = 20.0 * step
        await view.draw(as_page)
    assert page.grounds == [len(FakeScene().ground.faces)]  # type: ignore[union-attr]
    view, page, as_page = made(world)
    scene = FakeScene()
    scene.ground = None
    view.scene = scene
    await view.draw(as_page)
    assert page.grounds == [] and len(page.boxes) == 1
