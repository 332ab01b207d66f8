"""The world as a whole: a robot's scans become patches, and an obstacle of the operator is where it was put."""

import math
from random import Random

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")

from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Occupancy
from sern_twin.world.offset import object_offset
from sern_twin.world.scene import Outcome, Scene

GRID = Grid(-20.0, -20.0, 0.1, 400, 400)
ANGLES_RAD = np.linspace(-math.pi, math.pi, 720, endpoint=False)
WALLS_M = 15.0
BOX_M = (3.0, 1.0, 0.5)
"""East and north of the middle, half of the side."""


def ranges_m(x_m: float, y_m: float, yaw_rad: float, noise: Random) -> list[float]:
    """The ranges of a scanner in a square room with a box in it."""
    found = []
    for angle in (ANGLES_RAD + yaw_rad).tolist():
        along = math.cos(angle), math.sin(angle)
        range_m = min(
            (math.copysign(WALLS_M, way) - start) / way for start, way in zip((x_m, y_m), along, strict=True) if way
        )
        enters, leaves = 0.0, math.inf
        for start, way, middle in zip((x_m, y_m), along, BOX_M[:2], strict=True):
            if not way:
                way = 1e-12
            ends = sorted(((middle - BOX_M[2] - start) / way, (middle + BOX_M[2] - start) / way))
            enters, leaves = max(enters, ends[0]), min(leaves, ends[1])
        if enters < leaves:
            range_m = min(range_m, enters)
        found.append(range_m + noise.gauss(0, 0.01))
    return found


def test_scans_become_patches_of_what_changed() -> None:
    """A robot drives through a room at 1 m/s and publishes at 10 Hz: what it has seen already it does not say again."""
    noise = Random(3)
    robot, twin, world = Scene(GRID, "robot1"), Scene(GRID, "twin"), Occupancy(GRID)
    sizes = []
    for step in range(30):
        pose = (-3.0 + 0.1 * step, -4.0, 0.02 * step)
        world.fuse(pose, ANGLES_RAD, ranges_m(*pose, noise), 30.0)
        robot.set_cells("live", world.classes())
        patches = [robot.encode_block(key) for key in robot.publish()]
        assert {*map(twin.apply, patches)} <= {Outcome.TAKEN}
        sizes.append(sum(map(len, patches)))
    assert (twin.merged("live") == world.classes()).all()
    assert max(sizes[-10:]) < 8_000
    whole = sum(len(robot.encode_block(key)) for key in robot.versions())
    assert sum(sizes[-10:]) / 10 < whole / 4


def test_an_obstacle_is_seen_where_it_was_put() -> None:
    noise = Random(4)
    operator, robot, world = Scene(GRID, "operator"), Scene(GRID, "robot1"), Occupancy(GRID)
    east_m, north_m, half_m = BOX_M
    corners = [(east_m + a * half_m, north_m + b * half_m) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    operator.paint("twin_only", corners, 100)
    for key in operator.publish():
        assert robot.apply(operator.encode_block(key)) is Outcome.TAKEN
    put = robot.merged("twin_only")
    same = object_offset((GRID, operator.merged("twin_only")), (GRID, put), (3.0, 1.0), 1.0)
    assert same is not None and same.distance_m == 0

    for step in range(60):  # around it
        turn_rad = step / 60 * 2 * math.pi
        pose = (east_m + 3 * math.cos(turn_rad), north_m + 3 * math.sin(turn_rad), turn_rad)
        world.fuse(pose, ANGLES_RAD, ranges_m(*pose, noise), 30.0)
    seen = object_offset((GRID, put), (GRID, world.cells()), (3.0, 1.0), 1.0)
    assert seen is not None
    assert seen.distance_m < 0.05, "half a cell"
