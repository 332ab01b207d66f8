"""What a robot tries that is stuck: the order of Nav2, and when each is done or fails."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.recovery import Behaviour, Progress, Recovery, RecoveryOptions
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose
from tests.sern_navigation.worlds import filled

GRID = Grid(-3.0, -3.0, 0.1, 60, 60)
STEP_S = 0.1


def costmap_of(*areas: tuple[float, float, float, float]) -> Costmap:
    layered = LayeredCostmap(GRID)
    layered.static.take(GRID, filled(GRID, *areas))
    return layered.everywhere(0.0)


def begun(behaviour: Behaviour, pose: Pose = (0.0, 0.0, 0.0)) -> Recovery:
    recovery = Recovery()
    while recovery.begin(0.0, pose) is not behaviour:
        pass
    return recovery


def run(recovery: Recovery, pose: Pose, costmap: Costmap | None, *, held: bool = False) -> tuple[Progress, Pose, float]:
    """Until it does not run any more: a robot that does at once what it is told, or one that is held."""
    now_s = 0.0
    while True:
        progress, (speed, turn) = recovery.step(now_s, pose, costmap)
        if progress is not Progress.RUNNING:
            assert (speed, turn) == (0.0, 0.0)
            return progress, pose, now_s
        now_s += STEP_S
        if not held:
            yaw_rad = pose[2] + turn * STEP_S
            pose = (
                pose[0] + speed * STEP_S * math.cos(yaw_rad),
                pose[1] + speed * STEP_S * math.sin(yaw_rad),
                math.remainder(yaw_rad, math.tau),
            )
        assert now_s < 60


def test_the_order_is_that_of_nav2_round_and_round() -> None:
    recovery = Recovery()
    tried = []
    while not recovery.exhausted:
        tried.append(recovery.begin(0.0, (0.0, 0.0, 0.0)).value)
    assert tried == ["clear_costmap", "spin", "wait", "back_up", "clear_costmap", "spin"]
    recovery.reset()
    assert recovery.begun == 0 and recovery.begin(0.0, (0.0, 0.0, 0.0)) is Behaviour.CLEAR_COSTMAP


@pytest.mark.parametrize("yaw_rad", [0.0, 2.5, -3.1])
def test_it_spins_by_a_quarter_of_a_turn(yaw_rad: float) -> None:
    progress, pose, _now_s = run(begun(Behaviour.SPIN, (0.0, 0.0, yaw_rad)), (0.0, 0.0, yaw_rad), costmap_of())
    assert progress is Progress.SUCCEEDED
    assert math.remainder(pose[2] - yaw_rad, math.tau) == pytest.approx(1.57, abs=0.1)


def test_it_waits() -> None:
    progress, pose, now_s = run(begun(Behaviour.WAIT), (0.0, 0.0, 0.0), None)
    assert (progress, pose) == (Progress.SUCCEEDED, (0.0, 0.0, 0.0)) and now_s == pytest.approx(5.0, abs=0.15)


def test_it_backs_up() -> None:
    progress, pose, now_s = run(begun(Behaviour.BACK_UP), (0.0, 0.0, 0.0), costmap_of())
    assert progress is Progress.SUCCEEDED and pose[0] == pytest.approx(-0.3, abs=0.02) and now_s < 3.0


def test_it_does_not_back_into_something() -> None:
    progress, pose, _now_s = run(begun(Behaviour.BACK_UP), (0.0, 0.0, 0.0), costmap_of((-0.8, -0.5, -0.5, 0.5)))
    assert progress is Progress.FAILED and pose[0] > -0.25
    assert run(begun(Behaviour.BACK_UP), (0.0, 0.0, 0.0), None)[0] is Progress.FAILED, "not on the map"


def test_a_robot_that_touches_something_backs_away_from_it() -> None:
    progress, pose, _now_s = run(begun(Behaviour.BACK_UP), (0.0, 0.0, 0.0), costmap_of((0.2, -0.5, 0.6, 0.5)))
    assert progress is Progress.SUCCEEDED and pose[0] < -0.25


@pytest.mark.parametrize("behaviour", [Behaviour.SPIN, Behaviour.BACK_UP])
def test_a_robot_that_is_held_gives_up(behaviour: Behaviour) -> None:
    progress, _pose, now_s = run(begun(behaviour), (0.0, 0.0, 0.0), costmap_of(), held=True)
    assert progress is Progress.FAILED and now_s == pytest.approx(10.0, abs=0.3)


@pytest.mark.parametrize("wrong", [{"spin_dist": -1.0}, {"wait_duration": math.nan}, {"max_rotational_vel": 0.1}])
def test_options_that_are_none_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        RecoveryOptions(**wrong)  # type: ignore[arg-type]


def test_places_off_the_map_are_in_the_way() -> None:
    costmap = Costmap(GRID, np.zeros(GRID.shape, np.uint8), np.zeros(GRID.shape, np.uint8))
    progress, _pose, _now_s = run(begun(Behaviour.BACK_UP, (-2.9, 0.0, 0.0)), (-2.9, 0.0, 0.0), costmap)
    assert progress is Progress.FAILED
