"""Draws snapshots into a scene of viser: twins, what was heard of their robots, paths, bounds, and what stands around.

All of it is drawn relative to an origin near the first thing that is: a browser has numbers of 24 bits, and places of
a site may be thousands of kilometres from its zero.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.twin.view.frames import ERROR, OK, STALE, WARN, Box, Place, RobotFrame, Snapshot
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.mesh import Mesh
from sern_twin.world.terrain import Terrain

if TYPE_CHECKING:
    from viser import FrameHandle, SceneApi

Colour = tuple[int, int, int]
Point = tuple[float, float, float]

ROBOT_COLOURS: Final[tuple[Colour, ...]] = (
    (37, 99, 235), (192, 38, 211), (8, 145, 178), (124, 58, 237), (190, 24, 93), (3, 105, 161),
)  # fmt: skip
LEVEL_COLOURS: Final[dict[int, Colour]] = {
    OK: (22, 163, 74), WARN: (245, 158, 11), ERROR: (220, 38, 38), STALE: (148, 163, 184)
}  # fmt: skip
DISCREPANCY_COLOURS: Final[dict[DiscrepancyKind, Colour]] = {
    DiscrepancyKind.PHANTOM: (147, 51, 234), DiscrepancyKind.UNKNOWN_OBSTACLE: (220, 38, 38)
}  # fmt: skip
DISCREPANCY_M: Final = 1.2
"""How high they are drawn."""
MOST_LABELS: Final = 12
HEARD_COLOUR: Final[Colour] = (120, 128, 140)
YOUNG: Final[Colour] = (13, 148, 136)
OLD: Final[Colour] = (203, 193, 178)
UNDATED: Final[Colour] = (176, 180, 188)
"""Blocks that changed just now, `OLD_S` ago or more, and those of the map."""
OLD_S: Final = 600.0
BODY_M: Final = (0.9, 0.6, 0.4)
NOSE_M: Final = (0.22, 0.4, 0.1)
ORIGIN_STEP_M: Final = 100.0
CIRCLE_CORNERS: Final = 96
LEAST_BOUND_M: Final = 0.01
APART_M: Final = 1.0
"""A twin that is so far from where its robot was last heard has that labelled, too."""
_BOUND_Z_M: Final = 0.02
_PATH_Z_M: Final = 0.05
"""Above the ground, so that nothing flickers through another."""
_CUBE_VERTICES: Final = np.array([(x, y, z) for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], np.float32)
_CUBE_FACES: Final = np.array(
    [
        (0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4),
        (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5),
    ],
    np.uint32,
)  # fmt: skip


class Camera(NamedTuple):
    """The place from where to look, and what to look at, in the scene."""

    position: Point
    look_at: Point


class Drawing:
    """`ground` first, where there is one; all else in any order, by one thread at a time."""

    def __init__(self, scene: "SceneApi") -> None:
        self._scene = scene
        self._origin: NDArray[np.float64] | None = None
        self._robots: list[_RobotMarks] = []
        self._terrain: Terrain | None = None
        self._level_m = 0.0
        """The height of the ground where it is not known: the median."""
        self._discrepancies: tuple[SeenDiscrepancy, ...] = ()
        scene.configure_environment_map(None)
        scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(190, 190, 190), intensity=1.4)
        scene.add_grid(
            "/ground", infinite_grid=True, cell_size=1.0, section_size=10.0, cell_color=(224, 226, 230),
            section_color=(186, 190, 198), fade_distance=90.0, cell_thickness=0.7, shadow_opacity=0.1,
        )  # fmt: skip

    def draw(self, snapshot: Snapshot) -> None:
        """Show all robots as they are in a snapshot. Those before it had no others."""
        for number, robot in enumerate(snapshot.robots):
            if number == len(self._robots):
                self._robots.append(_RobotMarks(self._scene, number))
            if robot.shown is None:
                self._robots[number].hide()
            else:
                path_m = robot.path_m + np.array((robot.shown.x_m, robot.shown.y_m))
                up_m = self._up_m(path_m, robot.shown.z_m) - self._up_m(path_m[:1], robot.shown.z_m).sum()
                self._robots[number].show(
                    robot, self.local(robot.shown), None if robot.heard is None else self.local(robot.heard), up_m
                )

    def blocks(self, boxes: Sequence[Box]) -> None:
        """Show what stands around, in place of what did before, coloured by age."""
        if not boxes:
            self._scene.remove_by_name("/blocks")
            return
        x_m, y_m, size_m, height_m, ages_s = (np.array(column, np.float64) for column in zip(*boxes, strict=True))
        origin = self._need_origin(Place(float(x_m[0]), float(y_m[0]), 0.0, 0.0))
        up_m = self._up_m(np.column_stack([x_m, y_m]), origin[2])
        positions = np.column_stack([x_m, y_m, up_m]) - origin
        self._scene.add_batched_meshes_simple(
            "/blocks",
            _CUBE_VERTICES,
            _CUBE_FACES,
            batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(boxes), 1)),
            batched_positions=positions.astype(np.float32),
            batched_scales=np.column_stack([size_m, size_m, height_m]).astype(np.float32),
            batched_colors=age_colours(ages_s),
            flat_shading=True,
            lod="off",
            cast_shadow=False,
        )

    def ground(self, mesh: Mesh, terrain: Terrain | None) -> None:
        """Show the ground, and what stands on it. Where its heights are known, all else is drawn on it."""
        corners = mesh.vertices.astype(np.float64)
        self._terrain = terrain
        if terrain is not None:
            self._level_m = float(np.nanmedian(terrain.heights_m))
        east_m, north_m, up_m = (float(value) for value in corners[0])
        if terrain is not None:
            up_m = self._level_m
            self._scene.remove_by_name("/ground")
        origin = self._need_origin(Place(east_m, north_m, up_m, 0.0), known=terrain is not None)
        self._scene.add_mesh_simple(
            "/terrain", (corners - origin).astype(np.float32), mesh.faces.astype(np.uint32), color=(214, 208, 192),
            flat_shading=True, side="double", cast_shadow=False,
        )  # fmt: skip

    def discrepancies(self, found: tuple[SeenDiscrepancy, ...]) -> None:
        """Show where the twin is wrong, in place of what did before."""
        if found == self._discrepancies:
            return
        for number in range(min(len(self._discrepancies), MOST_LABELS)):
            self._scene.remove_by_name(f"/discrepancies/{number}")
        self._discrepancies = found
        if not found:
            self._scene.remove_by_name("/discrepancies/all")
            return
        places = np.array([(thing.east_m, thing.north_m) for thing in found])
        origin = self._need_origin(Place(float(places[0, 0]), float(places[0, 1]), 0.0, 0.0))
        positions = np.column_stack([places, self._up_m(places, origin[2])]) - origin
        radii_m = np.array([thing.radius_m for thing in found])
        self._scene.add_batched_meshes_simple(
            "/discrepancies/all",
            *_cylinder(),
            batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(found), 1)),
            batched_positions=positions.astype(np.float32),
            batched_scales=np.column_stack([radii_m, radii_m, np.full(len(found), DISCREPANCY_M)]).astype(np.float32),
            batched_colors=np.array([DISCREPANCY_COLOURS[thing.kind] for thing in found], np.uint8),
            opacity=0.4,
            side="double",
            lod="off",
            cast_shadow=False,
        )
        for number, thing in enumerate(found[:MOST_LABELS]):
            x_m, y_m, z_m = (float(value) for value in positions[number])
            self._scene.add_label(
                f"/discrepancies/{number}", thing.says, position=(x_m, y_m, z_m + DISCREPANCY_M + 0.2),
                anchor="bottom-center", font_screen_scale=0.9,
            )  # fmt: skip

    def local(self, place: Place) -> Place:
        """A place of the site as one of the scene: on its ground, where that is known."""
        origin = self._need_origin(place)
        z_m = float(self._up_m(np.array([(place.x_m, place.y_m)]), place.z_m)[0])
        return Place(place.x_m - origin[0], place.y_m - origin[1], z_m - origin[2], place.yaw_rad)

    def _up_m(self, places_m: NDArray[np.float64], otherwise_m: float) -> NDArray[np.float64]:
        """The height of the ground at places (n, 2); where nobody knows, this one."""
        if self._terrain is None:
            return np.full(len(places_m), otherwise_m)
        heights_m = self._terrain.height_m(places_m[:, 0], places_m[:, 1])
        return np.where(np.isnan(heights_m), self._level_m, heights_m)

    def camera(self, snapshot: Snapshot) -> Camera | None:
        """Where all robots and their paths are seen well. None: there are none yet."""
        found: list[tuple[float, float]] = []
        z_m = 0.0
        for robot in snapshot.robots:
            if robot.shown is not None:
                shown = self.local(robot.shown)
                z_m = shown.z_m
                found += [(shown.x_m + x_m, shown.y_m + y_m) for x_m, y_m in ((0.0, 0.0), *robot.path_m.tolist())]
                if robot.heard is not None:
                    heard = self.local(robot.heard)
                    found.append((heard.x_m, heard.y_m))
        if not found:
            return None
        points = np.array(found)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        reach_m = max(4.0, float(np.linalg.norm(points - middle, axis=1).max()))
        x_m, y_m = (float(value) for value in middle)
        x_m, y_m = x_m + 0.3 * reach_m, y_m - 0.15 * reach_m  # what stands beside the scene hides its right
        away_m = 1.4 * reach_m
        return Camera((x_m - 0.2 * away_m, y_m - 0.85 * away_m, z_m + 0.75 * away_m), (x_m, y_m, z_m))

    def _need_origin(self, near: Place, *, known: bool = False) -> NDArray[np.float64]:
        """`known`: its height is that of the ground."""
        if self._origin is None:
            self._origin = np.array(
                [round(near.x_m / ORIGIN_STEP_M) * ORIGIN_STEP_M, round(near.y_m / ORIGIN_STEP_M) * ORIGIN_STEP_M,
                 near.z_m if known or abs(near.z_m) > ORIGIN_STEP_M else 0.0]
            )  # fmt: skip
        return self._origin


class _RobotMarks:
    """What is drawn for one robot; all of it is there from the beginning, and moved."""

    def __init__(self, scene: "SceneApi", number: int) -> None:
        root = f"/robots/{number}"
        colour = ROBOT_COLOURS[number % len(ROBOT_COLOURS)]
        self._twin = scene.add_frame(f"{root}/twin", show_axes=False)
        self._heard = scene.add_frame(f"{root}/heard", show_axes=False)
        for parent, of, share, opacity in (
            (f"{root}/twin", colour, 1.0, None), (f"{root}/heard", HEARD_COLOUR, 0.97, 0.5)
        ):  # fmt: skip
            size_m = (BODY_M[0] * share, BODY_M[1] * share, BODY_M[2] * share)
            scene.add_box(
                f"{parent}/body", of, size_m, opacity=opacity, position=(0.0, 0.0, BODY_M[2] / 2 + 0.05),
                cast_shadow=opacity is None,
            )  # fmt: skip
            scene.add_box(
                f"{parent}/nose", (250, 250, 250) if opacity is None else of, NOSE_M, opacity=opacity,
                position=(BODY_M[0] / 2 - NOSE_M[0] / 2, 0.0, BODY_M[2] + 0.05 + NOSE_M[2] / 2), cast_shadow=False,
            )  # fmt: skip
        self._label = scene.add_label(
            f"{root}/twin/label", "", position=(0.0, 0.0, 1.5), anchor="bottom-center", font_screen_scale=1.2
        )
        self._heard_label = scene.add_label(
            f"{root}/heard/label", "", position=(0.0, 0.0, 0.9), anchor="bottom-center", font_screen_scale=1.0
        )
        circle = _circle()
        faces = np.array([(0, n + 1, (n + 1) % CIRCLE_CORNERS + 1) for n in range(CIRCLE_CORNERS)], np.uint32)
        self._bound = scene.add_mesh_simple(
            f"{root}/bound", np.vstack([np.zeros((1, 3), np.float32), circle]), faces, opacity=0.22, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._edge = scene.add_line_segments(
            f"{root}/edge", np.stack([circle, np.roll(circle, -1, axis=0)], axis=1), (0, 0, 0), thickness=2.0,
            thickness_units="screen",
        )  # fmt: skip
        self._path = scene.add_line_segments(
            f"{root}/path", np.zeros((1, 2, 3), np.float32), colour, thickness=4.0, thickness_units="screen"
        )
        self._path_colour = np.array(colour, np.uint8)
        self._gap = scene.add_line_segments(
            f"{root}/gap", np.zeros((1, 2, 3), np.float32), HEARD_COLOUR, thickness=2.0, thickness_units="screen"
        )
        self._all = (self._twin, self._heard, self._bound, self._edge, self._path, self._gap)
        self._level: int | None = None

    def hide(self) -> None:
        for handle in self._all:
            handle.visible = False

    def show(self, robot: RobotFrame, shown: Place, heard: Place | None, path_up_m: NDArray[np.float64]) -> None:
        """`shown`, `heard`: in the scene. `path_up_m`: how much higher each place of the path is than the first."""
        _move(self._twin, shown)
        self._label.text = robot.label
        self._heard.visible = heard is not None
        self._gap.visible = False
        if heard is not None:
            _move(self._heard, heard)
            apart = math.dist((heard.x_m, heard.y_m), (shown.x_m, shown.y_m)) > APART_M
            self._heard_label.text = f"heard {robot.age_s:.1f} s ago"
            self._heard_label.visible = self._gap.visible = apart
            self._gap.points = _line(heard, shown)
        radius_m = max(robot.error_m, LEAST_BOUND_M)
        if robot.level != self._level:
            self._level = robot.level
            colour = LEVEL_COLOURS[robot.level]
            self._bound.color = colour
            self._edge.colors = np.broadcast_to(np.array(colour, np.uint8), (CIRCLE_CORNERS, 2, 3)).copy()
        for handle in (self._bound, self._edge):
            handle.position = (shown.x_m, shown.y_m, shown.z_m + _BOUND_Z_M)
            handle.scale = radius_m
            handle.visible = True
        self._path.visible = len(robot.path_m) > 1
        if self._path.visible:
            self._path.points = _segments(np.column_stack([robot.path_m, path_up_m]).astype(np.float32))
            self._path.colors = np.broadcast_to(self._path_colour, (len(robot.path_m) - 1, 2, 3)).copy()
            self._path.position = (shown.x_m, shown.y_m, shown.z_m + _PATH_Z_M)


def age_colours(ages_s: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(n, 3) of ages (n,): from `YOUNG` to `OLD` by the logarithm, `UNDATED` for NaN."""
    share = np.clip(np.log1p(np.maximum(np.nan_to_num(ages_s), 0.0)) / math.log1p(OLD_S), 0.0, 1.0)[:, None]
    mixed = np.array(YOUNG) * (1 - share) + np.array(OLD) * share
    found: NDArray[np.uint8] = np.where(np.isnan(ages_s)[:, None], np.array(UNDATED), mixed).round().astype(np.uint8)
    return found


def _move(handle: "FrameHandle", place: Place) -> None:
    handle.position = (place.x_m, place.y_m, place.z_m)
    handle.wxyz = (math.cos(place.yaw_rad / 2), 0.0, 0.0, math.sin(place.yaw_rad / 2))
    handle.visible = True


def _circle() -> NDArray[np.float32]:
    turns = np.linspace(0.0, 2 * math.pi, CIRCLE_CORNERS, endpoint=False)
    return np.column_stack([np.cos(turns), np.sin(turns), np.zeros(CIRCLE_CORNERS)]).astype(np.float32)


def _line(start: Place, end: Place) -> NDArray[np.float32]:
    return np.array([[(place.x_m, place.y_m, place.z_m + _PATH_Z_M) for place in (start, end)]], np.float32)


def _segments(path_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n - 1, 2, 3) of points (n, 3)."""
    found: NDArray[np.float32] = np.stack([path_m[:-1], path_m[1:]], axis=1)
    return found


def _cylinder() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """The side of one, of radius and height 1."""
    low = _circle()
    high = low + np.array((0.0, 0.0, 1.0), np.float32)
    corner = np.arange(CIRCLE_CORNERS, dtype=np.uint32)
    after = np.roll(corner, -1)
    faces = np.concatenate(
        [
            np.column_stack([corner, after, after + CIRCLE_CORNERS]),
            np.column_stack([corner, after + CIRCLE_CORNERS, corner + CIRCLE_CORNERS]),
        ]
    )
    return np.concatenate([low, high]), faces.astype(np.uint32)
