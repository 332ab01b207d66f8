"""The Jackal in MuJoCo: skid, slopes, what holds it, what its scanner sees, and that a seed decides everything."""

import math
import sys
from random import Random

import numpy as np
import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_sim.follower import ON_HILLS
from sern_sim.mujoco_jackal import MujocoJackal, load_mujoco
from sern_sim.pilot import FigureOfEight, Pilot
from sern_sim.plant import Plant
from sern_sim.robot import GRAVITY_MPS2, LIDAR_HEIGHT_M, LIDAR_RANGE_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_sim.terrain import DITCH_X_M, HALF_SIZE_M, Block, Label, Terrain
from tests.exploring import also

CELLS = 41


@pytest.fixture(autouse=True)
def _needs_mujoco(request: pytest.FixtureRequest) -> None:
    if "without_mujoco" not in request.fixturenames:
        pytest.importorskip("mujoco", reason="the extra sim is not installed")


@pytest.fixture
def without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)


def level(*blocks: Block) -> Terrain:
    return Terrain(np.zeros((CELLS, CELLS)), blocks)


def slope(degrees: float) -> Terrain:
    """It rises to the east."""
    axis = np.linspace(-HALF_SIZE_M, HALF_SIZE_M, CELLS)
    return Terrain(np.tile(math.tan(math.radians(degrees)) * axis, (CELLS, 1)))


def run(robot: Plant, seconds: float) -> RobotState:
    for _ in range(round(seconds / STEP_S)):
        robot.step()
    return robot.state


def test_both_are_plants() -> None:
    plants: list[Plant] = [SimulatedJackal(Random(1)), MujocoJackal(Random(1))]
    for plant in plants:
        told = [plant.commanded]
        assert plant.command == (0.0, 0.0) and 0.3 < plant.yaw_scale_known < 0.5
        plant.drive(0.5, 0.0)
        told.append(plant.commanded)
        assert told == [False, True] and run(plant, 2.0).pose.x_m > 0.5
        assert len(plant.imu()) == 6 and plant.scan(90).shape == (90,)
        assert plant.world.occupancy(10).shape == (10, 10)
        assert plant.image(9, 7).shape == (7, 9, 3) and len(plant.cloud(100)) == 100


def test_it_drives_straight_on_level_ground() -> None:
    robot = MujocoJackal(Random(1), world=level())
    start = robot.state
    assert abs(start.z_m) < 0.005 and start.travelled_m == 0.0
    assert run(robot, 1.0).travelled_m < 0.005
    robot.drive(0.8, 0.0)
    state = run(robot, 5.0)
    assert state.speed_mps == pytest.approx(0.8, rel=0.03)
    assert state.pose.x_m == pytest.approx(4.0, abs=0.3) and abs(state.pose.y_m) < 0.05
    assert state.travelled_m == pytest.approx(state.pose.x_m - start.pose.x_m, abs=0.02)
    assert state.odometry.x_m == pytest.approx(state.pose.x_m, rel=0.03)
    assert state.wheel_left_rad * 0.098 == pytest.approx(state.pose.x_m, rel=0.03)
    assert 0.99 < state.charge < 1.0 and not state.blocked


@pytest.mark.parametrize(("speed_mps", "turn_radps"), [(0.0, 1.0), (0.5, -1.0), (0.7, 0.5), (0.7, 1.5), (1.0, 2.0)])
def test_it_skids(speed_mps: float, turn_radps: float) -> None:
    """The effective track ratio: what the wheels say of a turn, for what the base makes of it."""
    robot = MujocoJackal(Random(1), world=level())
    robot.drive(speed_mps, turn_radps)
    before = run(robot, 3.0)
    after = run(robot, 2.0)
    turned = [math.remainder(after.pose.yaw_rad - before.pose.yaw_rad, math.tau)]
    wheels = [(state.wheel_right_rad - state.wheel_left_rad) * 0.098 / 0.3765 for state in (before, after)]
    ratio = (wheels[1] - wheels[0]) / turned[0]
    assert 2.3 < ratio < 3.8


def test_a_command_out_of_bounds_is_limited_and_one_that_is_no_number_refused() -> None:
    robot = MujocoJackal(Random(1), world=level())
    robot.drive(50.0, 0.0)
    first = robot.step()
    assert first.speed_mps < 0.1
    assert run(robot, 3.0).speed_mps < 2.1
    for command in ((math.nan, 0.0), (0.0, math.inf), (-math.inf, 0.0)):
        with pytest.raises(ValueError, match="finite"):
            robot.drive(*command)
    assert robot.command == (50.0, 0.0)


@pytest.mark.parametrize("degrees", [5.0, 15.0])
def test_it_stands_on_a_slope_and_feels_it(degrees: float) -> None:
    robot = MujocoJackal(Random(1), world=slope(degrees))
    start = robot.state
    state = run(robot, 5.0)
    assert math.dist((state.pose.x_m, state.pose.y_m), (start.pose.x_m, start.pose.y_m)) < 0.04
    assert math.degrees(state.pitch_rad) == pytest.approx(-degrees, abs=0.5) and abs(state.roll_rad) < 0.01
    felt = robot.imu()
    tilt = math.radians(degrees)
    assert felt.forward_mps2 == pytest.approx(GRAVITY_MPS2 * math.sin(tilt), abs=0.3)
    assert felt.up_mps2 == pytest.approx(GRAVITY_MPS2 * math.cos(tilt), abs=0.3)
    robot.drive(0.5, 0.0)
    higher = run(robot, 4.0)
    assert higher.z_m == pytest.approx(math.tan(tilt) * higher.pose.x_m, abs=0.03) and higher.z_m > state.z_m + 0.1


def test_its_gyroscope_turns_as_it_does() -> None:
    robot = MujocoJackal(Random(3), world=level())
    robot.drive(0.0, 2.0)
    before = run(robot, 2.0).pose.yaw_rad
    rates = []
    for _ in range(50):
        robot.step()
        rates.append(robot.imu().yaw_radps)
    turned = math.remainder(robot.state.pose.yaw_rad - before, math.tau)
    assert sum(rates) / 50 == pytest.approx(turned, abs=0.02)


def test_a_car_holds_it_and_its_odometry_does_not_know() -> None:
    car = Block(Label.CAR, 4.0, 0.0, 0.55, (2.0, 0.8, 0.4))
    robot = MujocoJackal(Random(1), world=level(car))
    robot.drive(1.0, 0.0)
    state = run(robot, 6.0)
    assert state.blocked and state.pose.x_m == pytest.approx(2.0 - 0.25, abs=0.05)
    assert abs(state.pitch_rad) < 0.2 and abs(state.roll_rad) < 0.2
    assert state.odometry.x_m > 4.0
    robot.drive(-0.5, 0.0)
    assert run(robot, 2.0).pose.x_m < 1.3 and not robot.state.blocked


def test_the_bridge_carries_it_and_the_ditch_does_not() -> None:
    lowest_m = {}
    for y_m in (0.0, 3.0):
        robot = MujocoJackal(Random(1), start=Pose2(-6.5, y_m, math.pi))
        robot.drive(0.6, 0.0)
        lowest_m[y_m] = min(robot.step().z_m for _ in range(400))
        crossed = robot.state.pose.x_m < DITCH_X_M - 1.5
        assert crossed == (y_m == 0.0)
    assert lowest_m[0.0] > -0.15 and lowest_m[3.0] < -0.4


def test_its_rays_meet_the_car_where_it_is() -> None:
    car = Block(Label.CAR, 5.0, 0.0, 0.55, (2.0, 0.8, 0.4))
    log = Block(Label.LOG, -2.0, 0.0, 0.12, (1.0, 0.0, 0.0), math.pi / 2, 0.15)
    robot = MujocoJackal(Random(1), world=level(car, log))
    cloud = robot.cloud(16 * 900)
    assert cloud.shape == (14400, 5) and cloud.dtype == np.float32
    seen = cloud[~np.isnan(cloud[:, 0])]
    assert set(seen[:, 4]) == {Label.GROUND, Label.CAR, Label.LOG}
    ahead = seen[(seen[:, 4] == Label.CAR) & (np.abs(seen[:, 1]) < 0.5) & (seen[:, 2] < 0.4)]
    assert len(ahead) > 20
    assert np.median(ahead[:, 0]) == pytest.approx(3.0, abs=0.01) and 0.003 < np.std(ahead[:, 0]) < 0.03
    ground = seen[seen[:, 4] == Label.GROUND]
    near = ground[np.hypot(ground[:, 0], ground[:, 1]) < 3.0]
    assert np.abs(near[:, 2] + LIDAR_HEIGHT_M).max() < 0.05
    behind = seen[seen[:, 4] == Label.LOG]
    assert behind[:, 0].max() < -1.8 and behind[:, 0].min() > -2.2 and np.abs(behind[:, 1]).max() < 1.05
    nothing = cloud[np.isnan(cloud[:, 0])]
    assert len(nothing) > 0 and not nothing[:, 3:].any()
    scan = robot.scan(721)
    assert scan.dtype == np.float32 and scan[360] == pytest.approx(3.0, abs=0.05)
    assert np.isinf(scan[180])  # to the right nothing stands
    assert np.nanmax(scan[np.isfinite(scan)]) <= LIDAR_RANGE_M


def test_its_camera_sees_the_car_red() -> None:
    car = Block(Label.CAR, 4.0, 0.0, 0.55, (2.0, 0.8, 0.4))
    small, large = (MujocoJackal(Random(1), world=level(car)).image(width, 3 * width // 4) for width in (64, 256))
    assert large.shape == (192, 256, 3)
    for frame in (small, large):
        middle = frame[len(frame) // 2, frame.shape[1] // 2].astype(int)
        assert middle[0] > middle[1] + 60 and frame[0, 0, 2] > frame[0, 0, 0]


def test_a_cloud_may_be_of_any_size() -> None:
    robot = MujocoJackal(Random(1), world=level())
    for points in (1, 15, 17, 16 * 900 + 1, 40_000):
        assert robot.cloud(points).shape == (points, 5)


def test_a_seed_decides_everything() -> None:
    def story(seed: int) -> list[object]:
        robot = MujocoJackal(Random(seed))
        robot.drive(0.5, 0.8)
        out: list[object] = []
        for number in range(150):
            out.append(robot.step())
            if number % 50 == 0:
                out += [robot.imu(), robot.scan().tobytes(), robot.cloud(1600).tobytes(), robot.image(16, 8).tobytes()]
        return out

    assert story(7) == story(7)
    assert story(7) != story(8)


def test_what_is_looked_at_does_not_change_where_it_goes() -> None:
    states = []
    for looks in (False, True):
        robot = MujocoJackal(Random(3))
        robot.drive(0.5, 0.8)
        for _ in range(50):
            robot.step()
            if looks:
                robot.imu(), robot.scan(), robot.cloud(160)
        states.append(robot.state)
    assert states[0] == states[1]


@pytest.mark.parametrize("seed", [0, *also(2)])
def test_it_stays_within_centimetres_of_its_plan_on_hills(seed: int) -> None:
    robot = MujocoJackal(Random(seed))
    way = FigureOfEight(Random(seed + 1), robot.state.pose, 0.0)
    pilot = Pilot(Random(seed + 2), robot, way.at, follower=ON_HILLS)
    off_m = []
    for _ in range(round(60 / STEP_S)):
        pilot.step()
        true, planned = robot.state.pose, way.at(robot.state.time_s).pose
        off_m.append(math.dist((true.x_m, true.y_m), (planned.x_m, planned.y_m)))
        assert not robot.state.blocked
    assert sorted(off_m)[round(0.95 * len(off_m))] < 0.1
    assert robot.state.travelled_m > 30


@pytest.mark.usefixtures("without_mujoco")
def test_without_mujoco_the_error_says_what_to_do() -> None:
    for make in (load_mujoco, lambda: MujocoJackal(Random(1))):
        with pytest.raises(ConfigError) as caught:
            make()
        said = str(caught.value)
        assert "install sern[sim]" in said and "plant unicycle" in said and "\n" not in said
