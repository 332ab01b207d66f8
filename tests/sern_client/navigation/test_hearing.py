"""What a node that navigates reads of messages, and what it makes of bad ones."""

import math

import numpy as np
import pytest

from sern_client.navigation import hearing
from sern_client.navigation.options import Mount
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_navigation.navigator import Goal
from sern_runtime import ros_types
from sern_twin.world.grid import Grid
from tests.sern_client.navigation import bodies

CDR = Encoding.CDR
GRID = Grid(-2.0, -1.0, 0.1, 40, 20)


def test_a_cloud_is_turned_and_moved_by_where_the_scanner_is() -> None:
    mount = Mount(x_m=0.2, z_m=0.5, yaw_rad=math.pi / 2)
    heard = hearing.read_points(bodies.cloud(7, [(1.0, 0.0, -0.5, 0.0)]), CDR, mount)
    assert (heard.stamp_ns, heard.frame_id) == (7, "velodyne")
    assert heard.points_m == pytest.approx(np.array([(0.2, 1.0, 0.0)]), abs=1e-6)


@pytest.mark.parametrize(
    ("mount", "wanted"),
    [
        (Mount(z_m=1.0, pitch_rad=math.pi / 2), (0.0, 0.0, 0.0)),  # nose down: what is ahead of it is on the ground
        (Mount(z_m=1.0, roll_rad=math.pi / 2), (1.0, 0.0, 1.0)),
    ],
)
def test_roll_and_pitch_of_a_mount_are_those_of_rep_103(mount: Mount, wanted: tuple[float, float, float]) -> None:
    heard = hearing.read_points(bodies.cloud(0, [(1.0, 0.0, 0.0, 0.0)]), CDR, mount)
    assert heard.points_m[0] == pytest.approx(wanted, abs=1e-6)


def test_odometry_has_place_tilt_and_speed() -> None:
    heard = hearing.read_odometry(bodies.odometry(5, 1.0, 2.0, 0.5, frame_id="odom", speed=0.3), CDR)
    assert heard.stamp_ns == 5 and heard.frame_id == "odom"
    assert heard.pose == pytest.approx((1.0, 2.0, 0.5)) and heard.speed == (0.3, 0.0)
    assert (heard.roll_rad, heard.pitch_rad) == pytest.approx((0.0, 0.0))


def test_odometry_without_an_orientation_has_no_yaw() -> None:
    body = bodies.body(hearing.ODOMETRY, header=ros_types.header(0, "map", CDR))
    assert math.isnan(hearing.read_odometry(body, CDR).pose[2])


def test_a_map_comes_with_its_grid() -> None:
    cells = np.arange(800).reshape(20, 40) % 101
    grid, read = hearing.read_grid(bodies.grid_map(GRID, cells), CDR)
    assert grid == Grid(-2.0, -1.0, 0.1, 40, 20) and (read == cells).all(), "its resolution is a float32 in the message"


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (bodies.grid_map(GRID, np.zeros(799)), "with 799 values"),
        (bodies.grid_map(GRID, np.zeros(800), origin=bodies.pose(0.0, 0.0, 0.2)), "turned"),
        (bodies.grid_map(GRID, np.zeros(800), origin=bodies.pose(0.0, 0.0, None)), "turned"),
        (bodies.grid_map(GRID, np.zeros(800), origin=bodies.pose(1e12, 0.0)), "corners"),
        (bodies.body(hearing.GRID), "0 x 0 cells"),
        (b"\0\1\0\0nothing", "decode"),
    ],
)
def test_a_map_that_is_none_is_a_line(body: bytes, says: str) -> None:
    with pytest.raises(BodyError, match=says):
        hearing.read_grid(body, CDR)


def test_an_update_says_where_it_is() -> None:
    heard = hearing.read_update(bodies.update(3, 4, [[0, 100], [-1, 0]]), CDR)
    assert (heard.column, heard.row) == (3, 4) and heard.cells.tolist() == [[0, 100], [-1, 0]]
    with pytest.raises(BodyError, match="0 x 0 cells"):
        hearing.read_update(bodies.body(hearing.UPDATE), CDR)


def test_a_goal_may_leave_its_yaw_open() -> None:
    assert hearing.read_goal(bodies.goal_body(1.0, 2.0), CDR) == Goal(1.0, 2.0, None, "map")
    assert hearing.goal_of(bodies.goal(1.0, 2.0, 0.5)).yaw_rad == pytest.approx(0.5)


@pytest.mark.parametrize("connected", [True, False])
@pytest.mark.parametrize("encoding", [Encoding.CDR, Encoding.ROS1])
def test_the_state_of_the_link_in_either_ros(connected: bool, encoding: Encoding) -> None:
    message = ros_types.new(hearing.STATUS, encoding, level=0 if connected else 2)
    assert hearing.read_connected(ros_types.serialise(message, hearing.STATUS, encoding), encoding) is connected
