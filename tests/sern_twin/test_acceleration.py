"""Accelerations of speeds."""

import math

import pytest

from sern_twin.acceleration import Accelerations
from sern_twin.motion import Motion, Twist


def at(speed_mps: float, yaw_radps: float = 0.0) -> Motion:
    return Motion(0.0, 0.0, 0.0, Twist(speed_mps, 0.0, yaw_radps))


def test_it_is_found_within_a_second() -> None:
    accelerations = Accelerations()
    for step in range(50):
        found = accelerations.of(step * 0.02, at(0.5 * step * 0.02, -0.3 * step * 0.02))
        accelerations.took(step * 0.02, found)
    assert found.forward_mps2 == pytest.approx(0.5, rel=0.02)
    assert found.yaw_radps2 == pytest.approx(-0.3, rel=0.02)


@pytest.mark.parametrize("later_s", [0.0, -1.0, 0.6, 100.0, math.nan])
def test_where_nothing_tells_there_is_none(later_s: float) -> None:
    accelerations = Accelerations()
    assert accelerations.of(5.0, at(1.0)) == at(1.0), "the first one"
    accelerations.took(5.0, at(1.0))
    assert accelerations.of(5.0 + later_s, at(2.0)) == at(2.0)


def test_what_is_not_finite_stays_so() -> None:
    accelerations = Accelerations()
    accelerations.took(0.0, at(1.0))
    assert accelerations.of(0.1, at(math.inf)) == at(math.inf)
