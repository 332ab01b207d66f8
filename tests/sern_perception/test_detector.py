"""What stands in the way, whatever it is."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sern_perception.detector import ABOVE_M, clusters, ground_of, standing
from sern_perception.projection import VLP16, RangeImage, project

HEIGHT_M = 0.5
Meets = Callable[[np.ndarray], np.ndarray]
"""Where rays (n, 3) from the scanner end: ranges [m], infinite for nothing."""


def ground(rays: np.ndarray, slope: float = 0.0) -> np.ndarray:
    """A plane that rises ahead by `slope`, `HEIGHT_M` below the scanner."""
    falls = rays[:, 2] - slope * rays[:, 0]
    with np.errstate(divide="ignore"):
        return np.where(falls < 0, -HEIGHT_M / np.where(falls < 0, falls, -1.0), np.inf)


def box(x_m: float, y_m: float, wide_m: float, tall_m: float, deep_m: float = 0.4) -> Meets:
    low = np.array([x_m - deep_m / 2, y_m - wide_m / 2, -HEIGHT_M])
    high = np.array([x_m + deep_m / 2, y_m + wide_m / 2, tall_m - HEIGHT_M])

    def meets(rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = low / rays, high / rays
        near, far = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
        return np.where((near <= far) & (near > 0), near, np.inf)

    return meets


def seen(
    *things: Meets, noise_m: float = 0.0, slope: float = 0.0, far_m: float = 30.0, off: float = 0.0, lost: float = 0.0
) -> RangeImage:
    """`off`: how far the rays are from the middles of the columns, in steps. `lost`: the share of missing points."""
    elevations = np.linspace(VLP16.high_rad, VLP16.low_rad, VLP16.rows)[:, None]
    bearings = math.pi - (np.arange(VLP16.columns) + off) / VLP16.columns * math.tau
    rays = np.stack(
        np.broadcast_arrays(
            np.cos(elevations) * np.cos(bearings), np.cos(elevations) * np.sin(bearings), np.sin(elevations)
        ),
        axis=-1,
    ).reshape(-1, 3)
    ranges_m = np.minimum.reduce([ground(rays, slope), *(thing(rays) for thing in things)])
    ranges_m = np.where(ranges_m <= far_m, ranges_m, np.nan)
    draw = np.random.default_rng(1)
    ranges_m = ranges_m + draw.normal(0.0, noise_m, len(ranges_m))
    ranges_m = np.where(draw.random(len(ranges_m)) < lost, np.nan, ranges_m)
    return project((rays * ranges_m[:, None]).astype(np.float32))


@pytest.mark.parametrize("slope", [-0.15, 0.0, 0.15])
@pytest.mark.parametrize("noise_m", [0.0, 0.01])
def test_ground_alone_has_nothing_on_it(slope: float, noise_m: float) -> None:
    image = seen(slope=slope, noise_m=noise_m)
    assert image.seen.sum() > 2000
    assert clusters(image, VLP16) == []
    is_ground, _above = ground_of(image)
    assert is_ground[image.seen].mean() > 0.99


@pytest.mark.parametrize(
    ("x_m", "wide_m", "tall_m"), [(2.0, 0.3, 0.3), (3.0, 1.2, 0.25), (4.0, 0.5, 0.6), (2.5, 0.15, 1.5)]
)
def test_what_stands_on_the_ground_is_found_where_it_is(x_m: float, wide_m: float, tall_m: float) -> None:
    image = seen(box(x_m, 0.5, wide_m, tall_m), noise_m=0.01)
    found = clusters(image, VLP16)
    assert len(found) == 1
    (thing,) = found
    assert thing.middle_m[0] == pytest.approx(x_m - 0.2, abs=0.2)
    assert thing.middle_m[1] == pytest.approx(0.5, abs=0.1)
    assert thing.size_m[1] == pytest.approx(wide_m, abs=0.15)
    assert ABOVE_M < thing.above_m <= tall_m + 0.05
    assert standing(image, VLP16).sum() == len(thing.pixels)


@pytest.mark.parametrize(("off", "lost"), [(0.5, 0.0), (0.0, 0.1)])
def test_a_scanner_that_is_out_of_step_or_loses_points_sees_one_thing_as_one(off: float, lost: float) -> None:
    """Half a step off, rounding puts two rays into one pixel and none into the next."""
    image = seen(box(2.0, 0.5, 0.8, 0.6), noise_m=0.01, off=off, lost=lost)
    assert not image.seen[-1].all()
    (thing,) = clusters(image, VLP16)
    assert thing.size_m[1] == pytest.approx(0.8, abs=0.15)


def test_two_things_beside_each_other_are_two_and_one_behind_another_is_its_own() -> None:
    image = seen(box(2.0, 0.8, 0.4, 0.5), box(2.0, -0.8, 0.4, 0.5), box(5.0, 0.0, 2.5, 0.6), noise_m=0.01)
    assert sorted(round(thing.middle_m[0]) for thing in clusters(image, VLP16)) == [2, 2, 5]


def test_what_is_lower_than_a_stone_or_higher_than_the_robot_is_not_in_the_way() -> None:
    assert clusters(seen(box(2.0, 0.0, 0.5, 0.04)), VLP16) == []
    high = seen(lambda rays: np.where(np.abs(rays[:, 2] / rays[:, 0] - 0.2) < 0.05, 3.0 / rays[:, 0], np.inf))
    assert all(thing.middle_m[0] < 0 for thing in clusters(high, VLP16)) or clusters(high, VLP16) == []


def test_a_thing_across_the_seam_behind_the_robot_is_one() -> None:
    found = clusters(seen(box(-2.0, 0.0, 0.8, 0.5), noise_m=0.01), VLP16)
    assert len(found) == 1 and found[0].size_m[1] == pytest.approx(0.8, abs=0.15)


def test_clouds_of_nothing_and_of_one_point_have_nothing_in_them() -> None:
    assert clusters(project(np.zeros((0, 3))), VLP16) == []
    assert clusters(project([(1.0, 0.0, 0.0)]), VLP16) == []
