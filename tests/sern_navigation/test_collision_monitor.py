"""Stop, slowdown, approach, and no data."""

import math
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.collision_monitor import Action, CollisionMonitor, MonitorOptions, Polygon, Speed, inside
from sern_twin.world.grid import Floats
from tests.exploring import seeds

NOTHING = np.empty((0, 2))
BARE = MonitorOptions(polygons=())
"""The circle that approaches alone."""


def thing(x_m: float, y_m: float) -> Floats:
    """Three points close to each other."""
    return np.array([[x_m, y_m], [x_m, y_m + 0.02], [x_m, y_m - 0.02]])


def verdict(command: Speed, points: Floats, options: MonitorOptions | None = None) -> tuple[Speed, Action, str]:
    found = CollisionMonitor(options).process(command, points, 10.0, 10.1)
    return found.command, found.action, found.polygon


def test_on_free_ground_a_command_is_as_it_was() -> None:
    assert verdict((0.5, 0.3), NOTHING) == ((0.5, 0.3), Action.DO_NOT_PROCESS, "")
    assert verdict((0.5, 0.0), thing(3.0, 0.0)) == ((0.5, 0.0), Action.DO_NOT_PROCESS, "")
    assert verdict((0.5, 0.0), thing(0.0, 0.6))[1] is Action.DO_NOT_PROCESS, "beside it"


def test_close_ahead_it_stops_and_may_turn_or_back_away() -> None:
    points = thing(0.38, 0.0)
    assert verdict((0.3, 0.2), points) == ((0.0, 0.0), Action.STOP, "PolygonStop")
    assert verdict((-0.2, 0.0), points) == ((-0.2, 0.0), Action.DO_NOT_PROCESS, "")
    assert verdict((0.0, 0.8), points) == ((0.0, 0.8), Action.DO_NOT_PROCESS, "")
    assert verdict((-0.2, 0.0), thing(-0.38, 0.0)) == ((0.0, 0.0), Action.STOP, "PolygonStopBehind")


def test_before_something_it_slows_down() -> None:
    command, action, polygon = verdict((0.2, 0.1), thing(0.85, 0.0))
    assert (action, polygon) == (Action.SLOWDOWN, "PolygonSlow")
    assert command == pytest.approx((0.1, 0.05))


@pytest.mark.parametrize("speed_mps", [0.3, 0.5, 1.0, 2.0])
def test_it_approaches_so_that_nothing_is_met_within_the_time(speed_mps: float) -> None:
    """Nav2's rule: the speed in proportion to the time to the collision."""
    command, action, _polygon = verdict((speed_mps, 0.0), thing(0.63, 0.0), BARE)
    meets_s = 0.3 / speed_mps
    if meets_s > 1.2:
        assert action is Action.DO_NOT_PROCESS
        return
    assert action is Action.APPROACH
    assert command[0] <= speed_mps * meets_s / 1.2 + 1e-9, "not faster"
    assert command[0] >= speed_mps * (meets_s - 0.11) / 1.2, "nor a step slower"


def test_an_arc_meets_what_is_beside_and_not_what_is_ahead() -> None:
    assert verdict((0.6, 1.5), thing(0.9, -0.1), BARE)[1] is Action.DO_NOT_PROCESS
    assert verdict((0.6, 0.0), thing(0.9, -0.1), BARE)[1] is Action.APPROACH
    assert verdict((0.6, 1.5), thing(0.4, 0.65), BARE)[1] is Action.APPROACH


def test_a_robot_that_touches_something_gets_away_and_not_nearer() -> None:
    touching = thing(0.30, 0.0)
    assert verdict((-0.2, 0.0), touching, BARE) == ((-0.2, 0.0), Action.DO_NOT_PROCESS, "")
    assert verdict((0.2, 0.0), touching, BARE)[0] == (0.0, 0.0)


@pytest.mark.parametrize("seed", seeds(40))
def test_what_is_let_through_meets_nothing_in_time(seed: int) -> None:
    """Along small steps of the command that is let through: no point comes into the circle that was outside."""
    random = np.random.default_rng(seed)
    points = random.uniform(-2, 2, (int(random.integers(1, 40)), 2))
    points = points[np.hypot(*points.T) > 0.34]
    command = float(random.uniform(-1, 2)), float(random.uniform(-3, 3))
    speed, turn = CollisionMonitor(BARE).process(command, points, 0.0, 0.0).command
    assert abs(speed) <= abs(command[0]) and abs(turn) <= abs(command[1])
    x_m = y_m = yaw_rad = 0.0
    for _ in range(120):
        yaw_rad += turn * 0.005
        x_m += speed * math.cos(yaw_rad) * 0.01
        y_m += speed * math.sin(yaw_rad) * 0.01
        yaw_rad += turn * 0.005
        if len(points):
            assert np.hypot(points[:, 0] - x_m, points[:, 1] - y_m).min() > 0.33 - 0.02


@pytest.mark.parametrize("stamp_s", [None, 8.9, 11.2, math.nan, -math.inf])
def test_without_fresh_data_it_stands(stamp_s: float | None) -> None:
    monitor = CollisionMonitor()
    found = monitor.process((0.5, 0.1), NOTHING, stamp_s, 10.0)
    assert found.command == (0.0, 0.0) and found.action is Action.NO_DATA
    assert monitor.counts[Action.NO_DATA] == 1


def test_a_command_that_is_not_finite_is_none() -> None:
    for command in ((math.nan, 0.0), (0.0, math.inf)):
        assert verdict(command, NOTHING) == ((0.0, 0.0), Action.INVALID, "")


def test_points_that_are_not_finite_are_none_and_one_point_is_noise_for_a_zone() -> None:
    assert verdict((0.5, 0.0), np.full((9, 2), np.nan))[1] is Action.DO_NOT_PROCESS
    assert verdict((0.1, 0.0), np.array([[0.4, 0.0], [np.inf, 0.0]]))[1] is Action.APPROACH


def test_the_most_cautious_zone_decides() -> None:
    half = Polygon("half", ((0, -1), (2, -1), (2, 1), (0, 1)), "slowdown", 0.5)
    tenth = Polygon("tenth", ((0, -1), (2, -1), (2, 1), (0, 1)), "slowdown", 0.1)
    found = verdict((0.1, 0.0), thing(1.5, 0.0), MonitorOptions(polygons=(half, tenth)))
    assert found[1:] == (Action.SLOWDOWN, "tenth") and found[0][0] == pytest.approx(0.01)


def test_points_in_a_polygon() -> None:
    star = (
        (0.0, 2.0),
        (-0.5, 0.5),
        (-2.0, 0.5),
        (-0.8, -0.4),
        (-1.2, -2.0),
        (0.0, -1.0),
        (1.2, -2.0),
        (0.8, -0.4),
        (2.0, 0.5),
        (0.5, 0.5),
    )
    points = np.array([[0.0, 0.0], [0.0, 1.5], [1.0, 1.0], [-1.5, 0.4], [0.0, -1.5], [3.0, 0.0]])
    assert inside(star, points).tolist() == [True, True, False, True, False, False]
    assert inside(star[::-1], points).tolist() == [True, True, False, True, False, False]


@pytest.mark.parametrize(
    "change",
    [
        {"points": ((0.0, 0.0), (1.0, 0.0))}, {"slowdown_ratio": 1.5}, {"min_points": 0},
        {"points": ((0.0, math.nan),) * 3},
    ],
)  # fmt: skip
def test_a_zone_that_is_none_is_refused(change: dict[str, Any]) -> None:
    values: dict[str, Any] = {"name": "zone", "points": ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)), "action_type": "stop"}
    with pytest.raises(UsageError, match="polygon zone"):
        Polygon(**{**values, **change})


@pytest.mark.parametrize(
    "change",
    [{"time_before_collision": 0.0}, {"simulation_time_step": 2.0}, {"radius": 0.0}, {"source_timeout": math.inf}],
)
def test_options_that_are_none_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="a monitor"):
        MonitorOptions(**change)  # type: ignore[arg-type]
