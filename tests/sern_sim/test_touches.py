"""What a disc that moves in small steps touches, without a look at all walls each time."""

import math
from random import Random

import pytest

from sern_sim.world import World
from tests.exploring import seeds


@pytest.mark.parametrize("seed", seeds(10))
def test_a_disc_touches_what_is_nearer_than_its_radius(seed: int) -> None:
    random = Random(seed)
    world, other = World.yard(random), World.yard(Random(seed))
    x_m, y_m, yaw_rad, touched = 0.0, 0.0, random.uniform(-3, 3), 0
    for _ in range(600):
        yaw_rad += random.gauss(0, 0.1)
        step_m = 0.02 if random.random() < 0.98 else random.uniform(0, 5)
        x_m = min(max(x_m + step_m * math.cos(yaw_rad), -10.5), 10.5)
        y_m = min(max(y_m + step_m * math.sin(yaw_rad), -10.5), 10.5)
        radius_m = random.choice((0.33, 1.0))
        found = world.touches(x_m, y_m, radius_m)
        assert found is (other.clearance_m(x_m, y_m) < radius_m)
        touched += found
    assert touched


def test_a_disc_touches_nothing_where_nothing_is() -> None:
    world = World.yard(Random(1), boxes=0, pillars=0)
    assert not world.touches(0.0, 0.0, 9.9) and world.touches(0.0, 0.0, 10.1)
