"""What is drawn of snapshots, without a browser: the scene only remembers."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.twin_picture import World, bend
from sern_client.endpoints.twin.view.frames import Box, Snapshot
from sern_client.endpoints.twin.view.scene import (
    DISCREPANCY_COLOURS,
    LEVEL_COLOURS,
    OLD,
    OLD_S,
    UNDATED,
    YOUNG,
    Drawing,
    age_colours,
)
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.grid import Grid
from sern_twin.world.mesh import Mesh
from sern_twin.world.terrain import Terrain


class FakeScene:
    """A `viser.SceneApi` that keeps what was added, by name."""

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        def add(path: str | None, *_: object, **properties: Any) -> SimpleNamespace:
            handle = SimpleNamespace(**{"visible": True, **properties})
            if path is not None:
                self.found[path] = handle
            return handle

        return add

    def remove_by_name(self, name: str) -> None:
        self.found.pop(name, None)


def drawing() -> tuple[Drawing, dict[str, Any]]:
    scene = FakeScene()
    return Drawing(cast("Any", scene)), scene.found


def silent() -> Snapshot:
    world = World()
    world.play(12.0, 8.0)
    return world.endpoint.snapshot()


def test_a_robot_is_drawn_as_heard_as_shown_and_as_it_will_be() -> None:
    draws, found = drawing()
    snapshot = silent()
    draws.draw(snapshot)
    robot = snapshot.robots[0]
    twin, heard, path = (found[f"/robots/0/{part}"] for part in ("twin", "heard", "path"))
    assert twin.position == pytest.approx((bend(20).x_m, bend(20).y_m, 0.0), abs=0.05)
    assert heard.position == pytest.approx((bend(12).x_m, bend(12).y_m, 0.0))
    yaw_rad = 2 * math.atan2(twin.wxyz[3], twin.wxyz[0])
    assert yaw_rad == pytest.approx(bend(20).yaw_rad, abs=0.02)
    assert path.points.shape == (20, 2, 3) and path.visible and path.position[:2] == twin.position[:2]
    assert found["/robots/0/bound"].scale == found["/robots/0/edge"].scale == robot.error_m
    assert found["/robots/0/bound"].color == LEVEL_COLOURS[robot.level]
    assert found["/robots/0/twin/label"].text == robot.label
    assert found["/robots/0/heard/label"].text == "heard 8.0 s ago" and found["/robots/0/heard/label"].visible
    assert not found["/robots/1/heard/label"].visible and not found["/robots/1/gap"].visible, "it is heard"
    assert found["/robots/0/twin/body"] is not None and found["/robots/0/heard/body"].opacity == 0.5


def test_a_robot_that_was_not_heard_then_is_not_drawn() -> None:
    """The slider goes back to before it was."""
    draws, found = drawing()
    draws.draw(silent())
    draws.draw(World().endpoint.snapshot())
    assert not any(found[f"/robots/0/{part}"].visible for part in ("twin", "heard", "bound", "edge", "path", "gap"))
    draws.draw(silent())
    assert all(found[f"/robots/0/{part}"].visible for part in ("twin", "heard", "bound", "edge", "path", "gap"))


def test_a_site_far_from_its_zero_is_drawn_near_that_of_the_scene() -> None:
    draws, found = drawing()
    first, second = silent().robots
    assert first.shown is not None and second.shown is not None
    far = replace(first, shown=replace(first.shown, x_m=4e6 + 0.25))
    draws.draw(Snapshot(0.0, (far, second), ""))
    assert found["/robots/0/twin"].position[0] == 0.25
    draws.blocks([Box(4e6 + 1.5, 2.0, 0.5, 0.5, 1.0)])
    assert found["/blocks"].batched_positions.tolist() == [[1.5, 2.0, 0.0]]
    corners = np.array([(4e6, 0.0, 0.0), (4e6 + 10, 0.0, 1.0), (4e6, 10.0, 2.0)], np.float32)
    draws.ground(Mesh(corners, np.array([(0, 1, 2)], np.int32)), None)
    assert "/terrain" in found and "/ground" in found


def test_robots_paths_and_what_stands_around_are_on_the_ground() -> None:
    """A hill of one in ten that is 300 m high at its foot; odometry says that the robot is at height 0."""
    grid = Grid(-50.0, -50.0, 0.5, 200, 200)
    hill = Terrain(grid, 300.0 + 0.1 * grid.all_centres()[..., 0].reshape(grid.shape))
    draws, found = drawing()
    draws.ground(hill.mesh(10), hill)
    assert "/ground" not in found, "the plane would cut it"
    snapshot = silent()
    draws.draw(snapshot)
    robot = snapshot.robots[0]
    assert robot.shown is not None
    twin, path = found["/robots/0/twin"], found["/robots/0/path"]
    assert twin.position[2] == pytest.approx(0.1 * robot.shown.x_m, abs=0.01), "the scene is as high as its middle"
    rises_m = path.points[:, 1, 2] - path.points[0, 0, 2]
    assert rises_m == pytest.approx(0.1 * robot.path_m[1:, 0], abs=0.01)
    draws.blocks([Box(20.0, 2.0, 0.5, 0.5, 1.0)])
    assert found["/blocks"].batched_positions[0].tolist() == pytest.approx([20.0, 2.0, 2.0], abs=0.01)
    camera = draws.camera(snapshot)
    assert camera is not None and abs(camera.look_at[2]) < 5.0
    draws.blocks([Box(2000.0, 2.0, 0.5, 0.5, 1.0)])
    assert found["/blocks"].batched_positions[0, 2] == pytest.approx(0.0, abs=0.1), "beyond what is known"


def test_where_the_twin_is_wrong_is_drawn_and_goes() -> None:
    draws, found = drawing()
    phantom = SeenDiscrepancy("a", "jackal1", DiscrepancyKind.PHANTOM, 1.0, 2.0, 0.5, 9)
    obstacle = SeenDiscrepancy("b", "jackal1", DiscrepancyKind.UNKNOWN_OBSTACLE, 4.0, 2.0, 1.5, 99)
    draws.discrepancies((phantom, obstacle))
    drawn = found["/discrepancies/all"]
    assert drawn.batched_positions[:, :2].tolist() == [[1.0, 2.0], [4.0, 2.0]]
    assert drawn.batched_scales[:, 0].tolist() == [0.5, 1.5]
    assert drawn.batched_colors.tolist() == [list(DISCREPANCY_COLOURS[each.kind]) for each in (phantom, obstacle)]
    assert {"/discrepancies/0", "/discrepancies/1"} <= found.keys()
    draws.discrepancies((obstacle,))
    assert found["/discrepancies/all"].batched_scales[:, 0].tolist() == [1.5] and "/discrepancies/1" not in found
    draws.discrepancies(())
    assert not [name for name in found if name.startswith("/discrepancies")]


def test_blocks_have_the_colours_of_their_ages_and_go() -> None:
    draws, found = drawing()
    draws.blocks([Box(1.0, 2.0, 0.5, 0.7, 0.0), Box(2.0, 2.0, 0.5, 0.7, math.nan)])
    assert found["/blocks"].batched_colors.tolist() == [list(YOUNG), list(UNDATED)]
    assert found["/blocks"].batched_scales[0].tolist() == pytest.approx([0.5, 0.5, 0.7])
    draws.blocks([])
    assert "/blocks" not in found


def test_colours_of_ages_go_from_young_to_old() -> None:
    ages_s = np.array([-1.0, 0.0, 10.0, 100.0, OLD_S, 1e9, math.inf, math.nan])
    colours = age_colours(ages_s).tolist()
    assert colours[0] == colours[1] == list(YOUNG)
    assert colours[4] == colours[5] == colours[6] == list(OLD)
    assert colours[7] == list(UNDATED)
    reds = [colour[0] for colour in colours[1:5]]
    assert reds == sorted(set(reds))


def test_the_camera_sees_all_robots() -> None:
    draws, _ = drawing()
    assert draws.camera(World().endpoint.snapshot()) is None
    near = draws.camera(silent())
    assert near is not None and near.position[2] > 5.0
    assert math.dist(near.look_at[:2], (2.0, 8.0)) < 8.0
