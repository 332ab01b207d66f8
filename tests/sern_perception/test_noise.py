"""What noise scans show, and the same noise put on others."""

import math

import numpy as np
import pytest

from sern_perception.training.noise import LOST_BINS_M, RANGE, Noise, noise_of, noised
from sern_perception.training.scans import Scans

ROWS, COLUMNS = 16, 900


def scans(noise_m: float, lost: float) -> Scans:
    """Four, of surfaces that bend a little, 1 to 29 m away; points are lost the more the further."""
    draw = np.random.default_rng(1)
    bearings = math.pi - np.arange(COLUMNS) / COLUMNS * math.tau
    ranges_m = 15.0 + 14.0 * np.sin(bearings + np.arange(ROWS)[:, None]) + np.zeros((4, ROWS, COLUMNS))
    kept = draw.random(ranges_m.shape) >= lost * ranges_m / 30.0
    ranges_m = np.where(kept, ranges_m + draw.normal(0.0, noise_m, ranges_m.shape), 0.0)
    channels = np.zeros((4, 5, ROWS, COLUMNS), np.float32)
    channels[:, 0], channels[:, 1], channels[:, RANGE] = (
        ranges_m * np.cos(bearings),
        ranges_m * np.sin(bearings),
        ranges_m,
    )
    channels[:, 3] = 50.0 * kept
    return Scans(channels, kept.astype(np.uint8))


def middles_m() -> np.ndarray:
    return (LOST_BINS_M[1:] + LOST_BINS_M[:-1]) / 2


@pytest.mark.parametrize(("noise_m", "lost"), [(0.01, 0.0), (0.03, 0.4), (0.05, 0.1)])
def test_noise_is_told_from_scans_alone(noise_m: float, lost: float) -> None:
    found = noise_of(scans(noise_m, lost).channels)
    assert found.range_m == pytest.approx(noise_m, rel=0.1)
    assert found.lost == pytest.approx(lost * middles_m() / 30.0, abs=0.03)


def test_edges_of_things_are_no_noise() -> None:
    still = scans(0.01, 0.0)
    still.channels[..., 100:110] *= 0.5
    assert noise_of(still.channels).range_m == pytest.approx(0.01, rel=0.1)


def test_scans_get_what_they_lack_and_what_is_lost_is_of_no_class() -> None:
    clean, wanted = scans(0.01, 0.1), noise_of(scans(0.03, 0.4).channels)
    before = clean.channels.copy()
    found = noised(clean, wanted, np.random.default_rng(2))
    again = noise_of(found.channels)
    assert again.range_m == pytest.approx(0.03, rel=0.1) and again.lost == pytest.approx(wanted.lost, abs=0.03)
    assert np.array_equal(found.labels > 0, found.channels[:, RANGE] > 0)
    assert not found.channels[:, :, found.labels[0] == 0][0].any()
    assert np.array_equal(clean.channels, before), "the scans that were given are left as they are"
    flat_m = np.hypot(found.channels[:, 0], found.channels[:, 1])
    assert flat_m == pytest.approx(found.channels[:, RANGE], abs=1e-4), "points move along their rays"


def test_who_has_as_much_noise_as_is_wanted_is_left_alone() -> None:
    noisy = scans(0.03, 0.2)
    found = noised(noisy, Noise(0.01, np.zeros(len(LOST_BINS_M) - 1)), np.random.default_rng(2))
    assert np.array_equal(found.channels, noisy.channels) and np.array_equal(found.labels, noisy.labels)
