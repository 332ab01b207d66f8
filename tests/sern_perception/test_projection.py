"""Clouds as range images."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import BodyError, UsageError
from sern_perception.projection import HDL64, VLP16, ImageShape, of_points, project


def at(bearing_rad: float, elevation_rad: float, range_m: float, intensity: float = 0.5) -> tuple[float, ...]:
    flat_m = range_m * math.cos(elevation_rad)
    return (
        flat_m * math.cos(bearing_rad),
        flat_m * math.sin(bearing_rad),
        range_m * math.sin(elevation_rad),
        intensity,
    )


@pytest.mark.parametrize("shape", [VLP16, HDL64], ids=["16x900", "64x512"])
def test_rows_fall_and_columns_go_from_behind_over_left_and_ahead_to_right(shape: ImageShape) -> None:
    ring_rad = (shape.high_rad - shape.low_rad) / (shape.rows - 1)
    cloud = [
        at(0.0, shape.high_rad, 5.0),
        at(math.pi / 2, shape.low_rad, 6.0),
        at(-math.pi / 2, shape.high_rad - 3 * ring_rad, 7.0, intensity=0.25),
    ]
    image = project(cloud, shape)
    ahead, left = shape.columns // 2, shape.columns // 4
    assert image.points[0, ahead] == 0
    assert image.points[-1, left] == 1 and image.points[-1].tolist().count(-1) == shape.columns - 1
    rows, columns = np.nonzero(image.points == 2)
    assert rows.tolist() == [3] and columns[0] == 3 * shape.columns // 4
    assert image.channels[:, 3, columns[0]] == pytest.approx([*cloud[2][:3], 0.25, 7.0], abs=1e-5)
    assert image.seen.sum() == 3 and not image.channels[:, ~image.seen].any()


@pytest.mark.parametrize("off", [-0.4, 0.0, 0.4])
def test_each_ray_of_a_scanner_that_is_as_fine_as_the_columns_has_a_pixel(off: float) -> None:
    """The first ray of the stand-in's looks straight back; that of another one may be off by less than half a step."""
    bearings = -math.pi + (np.arange(VLP16.columns) + off) / VLP16.columns * math.tau
    cloud = np.array([at(float(bearing), VLP16.low_rad, 3.7) for bearing in bearings], np.float32)
    image = project(cloud)
    assert image.seen[-1].all() and not any(image.unused.values())


def test_the_nearest_point_of_a_pixel_is_kept_whatever_their_order() -> None:
    cloud = np.array([at(0.001, 0.0, 9.0), at(0.001, 0.0, 4.0), at(0.001, 0.0, 7.0)])
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        image = project(cloud[order])
        assert image.channels[4].max() == pytest.approx(4.0) and image.unused["hidden"] == 2
        assert image.points.max() == order.index(1)


def test_what_is_in_no_pixel_is_counted_and_warns_nobody() -> None:
    cloud = np.array(
        [
            at(0.0, 0.0, 5.0),
            (math.nan, 0.0, 0.0, 0.0),
            (0.0, math.inf, 0.0, 0.0),
            (0.01, 0.0, 0.0, 0.0),
            (1e30, 1e30, 1e30, 0.0),
            at(0.0, 1.0, 5.0),
            at(0.0, -1.0, 5.0),
        ]
    )
    image = project(cloud)
    assert image.unused == {"nan": 2, "range": 2, "elevation": 2, "hidden": 0} and image.seen.sum() == 1


def test_an_intensity_that_is_none_is_zero_and_one_may_be_missing() -> None:
    image = project([at(0.0, 0.0, 5.0, math.nan), at(1.0, 0.0, 5.0, math.inf)])
    assert not image.channels[3].any() and np.isfinite(image.channels).all()
    assert project([at(0.0, 0.0, 5.0)[:3]]).channels[3].max() == 0.0
    assert project(np.zeros((0, 4))).seen.sum() == 0


@pytest.mark.parametrize("cloud", [np.zeros(3), np.zeros((4, 2)), np.zeros((2, 2, 3)), np.zeros((1_000_001, 3))])
def test_what_is_no_cloud(cloud: np.ndarray) -> None:
    with pytest.raises(BodyError, match="a cloud of"):
        project(cloud)


@pytest.mark.parametrize("wrong", [(1, 900, -0.2, 0.2), (16, 4, -0.2, 0.2), (16, 900, 0.2, -0.2), (16, 900, -2.0, 0.2)])
def test_what_is_no_shape(wrong: tuple[int, int, float, float]) -> None:
    with pytest.raises(UsageError):
        ImageShape(*wrong)


def test_classes_of_pixels_are_those_of_their_points() -> None:
    cloud = [at(0.0, 0.0, 9.0), at(0.0, 0.0, 4.0), at(1.0, 0.0, 5.0), (math.nan, 0.0, 0.0, 0.0)]
    image = project(cloud)
    pixels = np.where(image.points == 1, 4, 5).astype(np.uint8)
    assert of_points(image, pixels, len(cloud)).tolist() == [0, 4, 5, 0]
