"""What is to be seen of twins at one moment, in time that the test makes."""

import math

import pytest

from benchmarks.twin_picture import LINK, World, bend, straight
from sern_client.endpoints.twin.options import FrameOrigin
from sern_client.endpoints.twin.view.frames import MOST_FRAME_CHARS, OK, STALE, WARN, places


def test_before_a_robot_is_heard_there_is_its_name_alone() -> None:
    world = World()
    first, second = world.endpoint.snapshot().robots
    assert (first.name, first.shown, first.heard, first.level, len(first.path_m)) == ("jackal1", None, None, STALE, 0)
    assert second.says == "not heard yet: /jackal2/odom"
    assert places(world.endpoint.snapshot()) == {}


def test_a_robot_that_is_silent_is_where_it_was_and_its_twin_goes_on() -> None:
    world = World()
    world.play(12.0, 8.0)
    snapshot = world.endpoint.snapshot()
    assert (snapshot.time_s, snapshot.link) == (20.0, LINK)
    silent, heard = snapshot.robots
    assert silent.heard is not None and silent.shown is not None and heard.shown is not None
    assert (silent.heard.x_m, silent.heard.y_m, silent.heard.yaw_rad) == pytest.approx(
        (bend(12.0).x_m, bend(12.0).y_m, bend(12.0).yaw_rad)
    )
    assert (silent.shown.x_m, silent.shown.y_m) == pytest.approx((bend(20.0).x_m, bend(20.0).y_m), abs=0.05)
    assert (silent.level, heard.level) == (WARN, OK)
    assert silent.age_s == pytest.approx(8.0) and heard.age_s == 0.0
    assert silent.label == f"jackal1: 8.00 s old, error ≤ {silent.error_m:.2f} m" and silent.error_m > 1.0
    end_x_m, end_y_m = (float(value) for value in silent.path_m[-1])
    ahead = bend(25.0)
    assert (silent.shown.x_m + end_x_m, silent.shown.y_m + end_y_m) == pytest.approx((ahead.x_m, ahead.y_m), abs=0.1)
    assert silent.path_m[0].tolist() == [0.0, 0.0] and silent.path_m.shape == (21, 2)
    assert places(snapshot)["jackal2"].x_m == pytest.approx(straight(20.0).x_m, abs=0.02)


def test_a_path_far_from_the_zero_of_its_frame_is_as_fine_as_elsewhere() -> None:
    """In metres of UTM a number of 24 bits has steps of half a metre."""
    world = World()
    for step in range(21):
        world.now = step * 0.05
        there = straight(world.now)
        there = type(there)(500_000.0 + there.x_m, 4_500_000.0, 0.0, there.twist)
        world.pose("jackal2", there)
    robot = world.endpoint.snapshot().robots[1]
    steps_m = robot.path_m[1:, 0] - robot.path_m[:-1, 0]
    assert steps_m.tolist() == pytest.approx([0.125] * 20, abs=0.002)


def test_a_robot_is_in_the_frame_of_the_site_where_its_own_begins_elsewhere() -> None:
    """It was switched on 10 m to the east, looking north: its odometry knows nothing of that."""
    world = World(origin=FrameOrigin(10.0, 0.0, math.pi / 2))
    world.play(4.0, 1.0)
    robot = world.endpoint.snapshot().robots[1]
    assert robot.shown is not None and robot.heard is not None
    there = straight(5.0)
    assert (robot.shown.x_m, robot.shown.y_m) == pytest.approx((10.0 - there.y_m, there.x_m), abs=0.02)
    assert (robot.heard.x_m, robot.heard.y_m) == pytest.approx((10.0 - there.y_m, there.x_m), abs=0.02)
    assert math.remainder(robot.shown.yaw_rad - there.yaw_rad - math.pi / 2, math.tau) == pytest.approx(0, abs=0.01)
    ahead = straight(10.0)
    end_x_m, end_y_m = (float(value) for value in robot.path_m[-1])
    assert (end_x_m, end_y_m) == pytest.approx((there.y_m - ahead.y_m, ahead.x_m - there.x_m), abs=0.1)


@pytest.mark.parametrize("z_m", [math.nan, math.inf, -math.inf, 1e300])
def test_a_height_that_is_none_and_an_endless_name_draw_nothing_strange(z_m: float) -> None:
    world = World()
    world.pose("jackal2", straight(0.0), z_m=z_m, frame_id="<b>" * 100_000)
    robot = world.endpoint.snapshot().robots[1]
    assert robot.shown is not None and robot.heard is not None
    assert (robot.shown.z_m, robot.heard.z_m) == (0.0, 0.0)
    assert len(robot.frame_id) == MOST_FRAME_CHARS
    assert world.endpoint.snapshot().size_bytes < 3_000
