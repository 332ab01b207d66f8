"""Worlds that the tests of navigation drive through and look at."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_navigation.costmap.twin import TwinView
from sern_navigation.navigator import Command, Navigator, State
from sern_navigation.scan import VLP16_RAD, Cloud
from sern_sim.robot import BODY_RADIUS_M, LIDAR_HEIGHT_M, STEP_S, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Floats, Grid

Wall = tuple[float, float, float, float, float]
PERIOD_S: Final = 0.1
Heights = Callable[[Floats, Floats], Floats]


def box(west_m: float, south_m: float, east_m: float, north_m: float, height_m: float = 2.0) -> list[Wall]:
    """The walls of a thing that stands between these."""
    return [
        (west_m, south_m, east_m, south_m, height_m),
        (east_m, south_m, east_m, north_m, height_m),
        (east_m, north_m, west_m, north_m, height_m),
        (west_m, north_m, west_m, south_m, height_m),
    ]


def world_of(walls: Iterable[Wall], half_size_m: float = 12.0) -> World:
    """These walls in a square yard with walls of its own."""
    yard = box(-half_size_m, -half_size_m, half_size_m, half_size_m, 3.0)
    return World(np.array([*yard, *walls]), np.zeros((0, 4)), half_size_m)


def jackal(world: World, seed: int = 1) -> SimulatedJackal:
    return SimulatedJackal(Random(seed), world=world)


def seen(robot: SimulatedJackal, points: int = 14_400) -> Cloud:
    """What its scanner sees, in its own frame."""
    found = robot.cloud(points)[:, :3].astype(np.float64)
    found[:, 2] += LIDAR_HEIGHT_M
    return Cloud(found, robot.state.time_s)


def looking_at(ground: Heights, azimuths: int = 360, range_m: float = 30.0) -> NDArray[np.float64]:
    """What 16 rings above x, y = 0 see of ground with these heights, (n, 3): where each ray first goes below it.

    Rays that meet nothing are NaN, as in drivers.
    """
    bearings = np.linspace(-math.pi, math.pi, azimuths, endpoint=False) + math.pi / azimuths
    reach = np.concatenate((np.arange(0.2, 8.0, 0.01), np.arange(8.0, range_m, 0.1)))
    found = np.full((len(VLP16_RAD), azimuths, 3), np.nan)
    x, y = reach * np.cos(bearings)[:, None], reach * np.sin(bearings)[:, None]
    heights = ground(x, y)
    for ring, elevation in enumerate(VLP16_RAD):
        z = LIDAR_HEIGHT_M + math.tan(elevation) * reach
        below = z[None, :] <= heights
        first = below.argmax(axis=1)
        met = below.any(axis=1)
        rows = np.arange(azimuths)[met]
        found[ring, met] = np.stack((x[rows, first[met]], y[rows, first[met]], z[first[met]]), axis=1)
    return found.reshape(-1, 3)


def level(x_m: Floats, y_m: Floats) -> Floats:
    return np.zeros(np.broadcast(x_m, y_m).shape)


def empty_map(grid: Grid) -> NDArray[np.int8]:
    return np.zeros(grid.shape, np.int8)


def filled(grid: Grid, *areas: tuple[float, float, float, float]) -> NDArray[np.int8]:
    """A map with these rectangles occupied: west, south, east, north [m]."""
    cells = empty_map(grid)
    places = grid.all_centres()
    for west_m, south_m, east_m, north_m in areas:
        inside = (places[..., 0] > west_m) & (places[..., 0] < east_m)
        inside &= (places[..., 1] > south_m) & (places[..., 1] < north_m)
        cells[inside] = 100
    return cells


def drive(
    navigator: Navigator,
    robot: SimulatedJackal,
    twin: TwinView | None = None,
    *,
    seconds: float = 60.0,
    points: int = 5_760,
) -> list[Command]:
    """Until the goal is reached or given up: commands at 10 Hz, divided by what the base is thought to make of a turn.

    AssertionError: the robot's body meets something.
    """
    found: list[Command] = []
    for _ in range(round(seconds / PERIOD_S)):
        state = robot.state
        view = None if twin is None else replace(twin, stamp_s=state.time_s)
        pose = (state.pose.x_m, state.pose.y_m, state.pose.yaw_rad)
        command = navigator.step(state.time_s, pose, seen(robot, points), view)
        found.append(command)
        if command.status.state not in (State.FOLLOWING, State.RECOVERING):
            break
        robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
        for _ in range(round(PERIOD_S / STEP_S)):
            here = robot.step().pose
            assert robot.world.clearance_m(here.x_m, here.y_m) > BODY_RADIUS_M, (here, command)
    return found
