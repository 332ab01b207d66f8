"""Things of shapes that no training scan has."""

import math
from random import Random

import numpy as np
import pytest

from sern_perception.training.shapes import KINDS, Shape, drawn

HERE = np.array([0.0, 0.0, 0.5])


def ray(bearing_deg: float, elevation_deg: float) -> list[float]:
    bearing, up = math.radians(bearing_deg), math.radians(elevation_deg)
    return [math.cos(up) * math.cos(bearing), math.cos(up) * math.sin(bearing), math.sin(up)]


@pytest.mark.parametrize(
    ("shape", "first_m"),
    [
        (Shape("ball", (3.0, 0.0, 0.5), (0.5, 0.5, 0.5)), 2.5),
        (Shape("barrel", (3.0, 0.0, 0.5), (0.3, 0.3, 0.5)), 2.7),
        (Shape("post", (3.0, 0.0, 0.5), (0.05, 0.05, 0.5), 1.0), 2.95),
        (Shape("tower", (3.0, 0.0, 0.5), (0.05, 0.2, 1.0)), 2.95),
        (Shape("plank", (3.0, 0.0, 0.5), (1.0, 0.05, 0.1), math.pi / 2), 2.95),
        (Shape("slab", (3.0, 0.0, 0.5), (1.0, 0.5, 0.1), math.pi), 2.0),
    ],
    ids=lambda value: value.kind if isinstance(value, Shape) else "",
)
def test_rays_meet_the_near_side_and_pass_by_and_behind(shape: Shape, first_m: float) -> None:
    ahead, beside, behind, above = shape.meets(HERE, np.array([ray(0, 0), ray(35, 0), ray(180, 0), ray(0, 60)]))
    assert ahead == pytest.approx(first_m) and [beside, behind, above] == [math.inf] * 3


def test_a_cylinder_is_met_on_top_from_above() -> None:
    barrel = Shape("barrel", (2.0, 0.0, 0.5), (0.3, 0.3, 0.5))
    (down,) = barrel.meets(np.array([2.0, 0.1, 3.0]), np.array([[0.0, 0.0, -1.0]]))
    assert down == pytest.approx(2.0)


def test_a_cylinder_ends_where_its_height_does() -> None:
    post = Shape("post", (2.0, 0.0, 0.25), (0.05, 0.05, 0.25))
    low, high = post.meets(HERE, np.array([ray(0, -2), ray(0, 2)]))
    assert low == pytest.approx(1.95 / math.cos(math.radians(2))) and high == math.inf


def test_what_is_drawn_stands_on_the_ground_and_all_kinds_are() -> None:
    random = Random(4)
    shapes = [drawn(random, 2.0, 1.0, -0.3) for _ in range(60)]
    assert {shape.kind for shape in shapes} == set(KINDS)
    for shape in shapes:
        assert shape.middle_m[2] - shape.half_m[2] == pytest.approx(-0.3)
        (down,) = shape.meets(np.array([2.0, 1.0, 5.0]), np.array([[0.0, 0.0, -1.0]]))
        assert down == pytest.approx(5.3 - 2 * shape.half_m[2])
