"""Scans and masks of a room whose every distance is known, by brute force on random points, and of real scans."""

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from sern_client.endpoints.clouds import read_ply
from sern_core.summaries.clouds import read_cloud
from sern_core.summaries.mask import MaskMaker, MaskParams
from sern_core.summaries.obstacles import Band, ObstacleFinder, fit_ground
from sern_core.summaries.scan import ScanMaker, ScanParams, nearest_ranges
from sern_core.vocabulary.errors import BodyError, UsageError
from sern_core.vocabulary.types import Encoding
from tests.daemons import recording
from tests.sern_core.summaries import scenes

SENSOR_M = 0.8
WALL_X_M, WALL_Y_M = 6.0, 4.0
BOX = ((2.0, -1.0, 0.0), (3.0, 1.0, 0.6))  # opposite corners, heights above the ground: in the way
KERB = ((-2.0, -4.0, 0.0), (-1.0, 4.0, 0.06))  # driven over
BEAM = ((-6.0, 1.5, 1.5), (6.0, 1.7, 2.0))  # driven under
PIT = ((-4.5, -3.0), (-3.0, 0.0))  # 0.5 m deep
PIT_M = 0.5


def room() -> NDArray[np.float64]:
    """(n, 3) what a LiDAR of 64 rings and 900 bearings sees from SENSOR_M above the floor of the room, by ray casting.

    The beams begin at the origin; what they hit first is kept. A beam that enters the pit ends at its bottom.
    """
    elevation, bearing = np.meshgrid(np.radians(np.linspace(-40, 30, 64)), np.linspace(-np.pi, np.pi, 900, False))
    rays = np.stack(
        (np.cos(elevation) * np.cos(bearing), np.cos(elevation) * np.sin(bearing), np.sin(elevation)), axis=-1
    ).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = np.minimum(WALL_X_M / np.abs(rays[:, 0]), WALL_Y_M / np.abs(rays[:, 1]))
        floor = np.where(rays[:, 2] < 0, -SENSOR_M / rays[:, 2], np.inf)
        at = rays * floor[:, None]
        into_pit = ((at[:, :2] > PIT[0]) & (at[:, :2] < PIT[1])).all(axis=1)
        floor[into_pit] *= (SENSOR_M + PIT_M) / SENSOR_M
        hit = np.minimum(hit, floor)
        for low, high in (BOX, KERB, BEAM):
            near = (np.array(low) - (0, 0, SENSOR_M)) / rays
            far = (np.array(high) - (0, 0, SENSOR_M)) / rays
            enter = np.minimum(near, far).max(axis=1)
            leave = np.maximum(near, far).min(axis=1)
            hit = np.where((enter > 0) & (enter <= leave), np.minimum(hit, enter), hit)
    points: NDArray[np.float64] = rays * hit[:, None]
    return points


def body_of(xyz: NDArray[Any], encoding: Encoding = Encoding.CDR) -> bytes:
    return scenes.cloud_body(scenes.structured(xyz), encoding)


def tilted(xyz: NDArray[np.float64], roll: float, pitch: float) -> NDArray[np.float64]:
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    turn = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    turned: NDArray[np.float64] = xyz @ turn.T
    return turned


def scan_of(xyz: NDArray[Any], params: ScanParams, encoding: Encoding = Encoding.CDR) -> Any:
    return scenes.read(ScanMaker(params).scan(body_of(xyz, encoding), encoding), scenes.SCAN, encoding)


def range_at(scan: Any, degrees: float) -> float:
    index = round((math.radians(degrees) - scan.angle_min) / scan.angle_increment) % len(scan.ranges)
    return float(scan.ranges[index])


# --- the room --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize("sensor_height_m", [None, SENSOR_M])
def test_the_scan_of_a_room(encoding: Encoding, sensor_height_m: float | None) -> None:
    scan = scan_of(room(), ScanParams(Band(sensor_height_m=sensor_height_m), beams=360), encoding)
    assert scan.header == ros_header(encoding)
    assert (len(scan.ranges), len(scan.intensities)) == (360, 0)
    assert math.isclose(scan.angle_min, -math.pi, rel_tol=1e-6)
    assert math.isclose(scan.angle_min + 359 * scan.angle_increment, scan.angle_max, rel_tol=1e-6)
    assert math.isclose(range_at(scan, 0), 2.0, abs_tol=0.01)  # the box
    assert math.isclose(range_at(scan, 20), 2.0 / math.cos(math.radians(20)), abs_tol=0.02)
    assert math.isclose(range_at(scan, 90), WALL_Y_M, abs_tol=0.01)  # through below the beam
    assert math.isclose(range_at(scan, -60), WALL_Y_M / math.sin(math.radians(60)), abs_tol=0.05)
    assert math.isclose(range_at(scan, 170), WALL_X_M / math.cos(math.radians(10)), abs_tol=0.05)  # across the kerb
    # The pit begins 3 m off at 180 degrees and further to its side; the first ring that enters it says so.
    assert 3.0 <= range_at(scan, -170) <= 3.6


def ros_header(encoding: Encoding) -> Any:
    return scenes.cloud_message(scenes.structured(np.zeros((0, 3))), encoding).header


def test_without_a_limit_for_drop_offs_the_pit_is_driven_into() -> None:
    """The drop-offs are what stops it: the same scan without them sees the wall behind."""
    blind = scan_of(room(), ScanParams(Band(drop_off_m=10.0), beams=360))
    assert range_at(blind, -170) > 5.9


@pytest.mark.parametrize(("roll", "pitch"), [(4.0, 0.0), (-3.0, 5.0)])
def test_a_tilted_sensor_finds_the_ground(roll: float, pitch: float) -> None:
    xyz = tilted(room(), math.radians(roll), math.radians(pitch))
    plane = fit_ground(xyz)
    assert plane is not None
    up = np.array([-plane.slope_x, -plane.slope_y, 1.0])
    expected = tilted(np.array([[0.0, 0.0, 1.0]]), math.radians(roll), math.radians(pitch))[0]
    off = math.degrees(math.acos(min(float(up @ expected / np.linalg.norm(up)), 1.0)))
    assert off < 0.3
    scan = scan_of(xyz, ScanParams(beams=360))
    # In the sensor's own plane: its walls lean by as much as it is tilted.
    assert math.isclose(range_at(scan, 0), 2.0, abs_tol=0.1)
    assert math.isclose(range_at(scan, 90), WALL_Y_M, abs_tol=0.1)


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_the_mask_of_a_room(encoding: Encoding) -> None:
    maker = MaskMaker(MaskParams(size_m=10.0, resolution_m=0.1))
    grid = scenes.read(maker.mask(body_of(room(), encoding), encoding), scenes.GRID, encoding)
    assert grid.header == ros_header(encoding) and grid.info.map_load_time == grid.header.stamp
    assert (grid.info.width, grid.info.height) == (100, 100) and math.isclose(grid.info.resolution, 0.1, rel_tol=1e-6)
    origin = grid.info.origin.position
    assert (origin.x, origin.y) == (-5.0, -5.0) and math.isclose(origin.z, -SENSOR_M, abs_tol=0.02)
    cells = np.asarray(grid.data).reshape(100, 100)

    def at(x_m: float, y_m: float) -> int:
        return int(cells[int((y_m + 5) * 10), int((x_m + 5) * 10)])

    assert at(2.05, 0.05) == 100  # the box's face
    assert at(4.5, 0.05) == -1  # behind it
    assert 100 in cells[89:91, 45:55] and 100 not in cells[60:85, 40:50]  # the wall at y = 4; nothing under the beam
    pit = cells[20:50, 5:20]
    assert 100 in pit and 0 not in pit[5:25, 3:12]
    outside = np.ones((100, 100), bool)
    outside[89:91, :] = outside[9:11, :] = False  # the walls at y = 4 and y = -4
    outside[19:51, 4:21] = outside[38:62, 69:81] = False  # pit and box
    assert not (cells[outside] == 100).any()
    assert (cells[outside] == 0).sum() > 800


def test_points_on_the_robot_and_far_off_are_no_obstacles() -> None:
    xyz = np.array([[0.2, 0.0, 0.0], [0.0, 40.0, 0.0], [-3.0, 0.0, 0.0]])
    scan = scan_of(xyz, ScanParams(Band(sensor_height_m=0.5), beams=8))
    assert np.isfinite(scan.ranges).sum() == 1 and range_at(scan, 180) == 3.0


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_a_cloud_of_nothing_is_a_scan_of_nothing(encoding: Encoding) -> None:
    for xyz in (np.empty((0, 3)), np.full((4, 3), np.nan)):
        assert np.isposinf(scan_of(xyz, ScanParams(), encoding).ranges).all()
        grid = scenes.read(MaskMaker(MaskParams()).mask(body_of(xyz, encoding), encoding), scenes.GRID, encoding)
        assert (np.asarray(grid.data) == -1).all()


def test_ground_that_is_out_of_sight_is_remembered_for_a_while() -> None:
    finder = ObstacleFinder(Band())
    crowd = room()
    crowd = crowd[crowd[:, 2] > 0]
    with pytest.raises(BodyError, match="sensor_height_m"):
        finder.find(read_cloud(body_of(crowd[:5]), Encoding.CDR))
    seen = finder.find(read_cloud(body_of(room()), Encoding.CDR)).plane
    hidden = read_cloud(body_of(crowd[:5]), Encoding.CDR)
    for _ in range(20):
        assert finder.find(hidden).plane == seen
    with pytest.raises(BodyError, match="no ground"):
        finder.find(hidden)


def test_a_wall_is_no_ground() -> None:
    across, up = np.meshgrid(np.linspace(-8, 8, 60), np.linspace(-1, 8, 60))
    wall = np.column_stack((up.ravel(), across.ravel(), 2.0 * up.ravel()))
    assert fit_ground(wall) is None


@pytest.mark.parametrize("beams", [0, 3, 10**6])
def test_a_scan_of_so_many_beams_is_refused(beams: int) -> None:
    with pytest.raises(UsageError, match="beams"):
        ScanMaker(ScanParams(beams=beams))


@pytest.mark.parametrize(("size_m", "resolution_m"), [(0.0, 0.1), (10.0, 0.0), (1e4, 0.1)])
def test_a_mask_of_such_a_size_is_refused(size_m: float, resolution_m: float) -> None:
    with pytest.raises(UsageError, match="mask"):
        MaskMaker(MaskParams(size_m=size_m, resolution_m=resolution_m))


# --- by property -----------------------------------------------------------------------------------------------------


@given(
    arrays.arrays(np.float64, st.tuples(st.integers(0, 40), st.just(2)), elements=st.floats(-30, 30)),
    st.sampled_from([4, 7, 360]),
)
def test_no_range_is_longer_than_to_the_nearest_point_of_its_bearing(points: np.ndarray, beams: int) -> None:
    ranges = nearest_ranges(points, beams)
    expected = np.full(beams, np.inf)
    for (x, y), bearing in zip(points.tolist(), np.arctan2(points[:, 1], points[:, 0]).tolist(), strict=True):
        beam = math.floor((bearing + math.pi) * (beams / (2 * math.pi)) + 0.5) % beams
        expected[beam] = min(expected[beam], math.hypot(x, y))
    assert np.allclose(ranges, expected, rtol=1e-6, atol=1e-30)


@given(st.data(), st.sampled_from(scenes.ENCODINGS))
def test_a_changed_body_is_scanned_or_refused(data: st.DataObject, encoding: Encoding) -> None:
    body = bytearray(body_of(np.array([[3.0, 0, 0], [0, 3, 0.5], [1, 1, -2]]), encoding))
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    for make in (
        ScanMaker(ScanParams(Band(sensor_height_m=0.5))).scan,
        ScanMaker(ScanParams()).scan,
        MaskMaker(MaskParams(Band(sensor_height_m=0.5), size_m=4)).mask,
    ):
        with suppress(BodyError):
            assert make(bytes(body), encoding)


# --- real scans ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lidar_scan_a.ply", "lidar_scan_b.ply"])
def test_the_scan_of_a_real_cloud_agrees_with_brute_force(name: str) -> None:
    xyz = read_ply(Path(recording(name)))[:, :3].astype(np.float64)
    plane = fit_ground(xyz)
    assert plane is not None and math.isclose(plane.offset_m, -1.98, abs_tol=0.05)
    scan = scan_of(xyz, ScanParams())
    heights = xyz[:, 2] - (plane.slope_x * xyz[:, 0] + plane.slope_y * xyz[:, 1] + plane.offset_m)
    reach = np.hypot(xyz[:, 0], xyz[:, 1])
    in_way = xyz[(heights >= 0.1) & (heights <= 1.2) & (reach >= 0.4) & (reach <= 30.0)]
    beams = np.floor((np.arctan2(in_way[:, 1], in_way[:, 0]) + np.pi) / (2 * np.pi / 720) + 0.5).astype(int) % 720
    for beam in range(720):
        mine = in_way[beams == beam]
        expected = np.hypot(mine[:, 0], mine[:, 1]).min() if len(mine) else math.inf
        assert math.isclose(scan.ranges[beam], expected, rel_tol=1e-5), beam
    assert np.isfinite(scan.ranges).sum() > 500
