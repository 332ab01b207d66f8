"""Labelled scans of the stand-in."""

from random import Random

import numpy as np
import pytest

from sern_perception.classes import PointClass
from sern_sim.terrain import Label

pytest.importorskip("mujoco", reason="needs mujoco: pip install 'sern[sim]'")

from sern_perception.training.scans import (
    APART_M,
    FIRST_THING,
    FREE_M,
    SHIFTED,
    SOURCE,
    cloud,
    make,
    places,
    scattered,
    things_around,
)
from sern_sim.mujoco_jackal import MujocoJackal


def test_classes_are_the_labels_of_the_stand_in() -> None:
    assert {each.name: int(each) for each in PointClass} == {each.name: int(each) for each in Label}


def test_the_same_seed_gives_the_same_scans_and_another_others() -> None:
    one, same, other = make(3, 4, SOURCE, each_world=2), make(3, 4, SOURCE, each_world=2), make(4, 4, SOURCE)
    assert np.array_equal(one.channels, same.channels) and np.array_equal(one.labels, same.labels)
    assert not np.array_equal(one.channels, other.channels)
    assert one.channels.shape == (4, 5, 16, 900) and len(np.unique(one.channels[:, 4], axis=0)) == 4


def test_labels_lie_on_what_they_name() -> None:
    scans = make(5, 6, SOURCE)
    for channels, labels in zip(scans.channels, scans.labels, strict=True):
        assert np.array_equal(labels > 0, channels[4] > 0)
        lowest = labels[-1]
        assert (lowest == Label.GROUND).mean() > 0.5, "the lowest ring looks at the ground around"
    assert {int(label) for label in np.unique(scans.labels)} >= {Label.GROUND, Label.CAR, Label.LOG, Label.OTHER}


def test_the_shifted_scanner_is_another_one() -> None:
    """Lower rings, missing points, and an intensity that tells a car from the ground at one range."""
    source, shifted = make(6, 6, SOURCE), make(6, 6, SHIFTED)

    def lost(scans: object) -> float:
        near = (scans.labels[:, -1] > 0).mean()  # type: ignore[attr-defined]
        return 1.0 - float(near)

    assert lost(shifted) > lost(source) + 0.02
    assert shifted.channels[:, 2][shifted.labels > 0].min() < source.channels[:, 2][source.labels > 0].min() - 0.1
    ranges, intensities = shifted.channels[:, 4], shifted.channels[:, 3]
    band = (ranges > 4) & (ranges < 9)
    car, ground = (intensities[band & (shifted.labels == label)].mean() for label in (Label.CAR, Label.GROUND))
    assert car > 2 * ground


def test_places_are_free() -> None:
    world = scattered(Random(9))
    found = places(Random(9), world, 20)
    for place in found:
        for block in world.blocks:
            if block.label in (Label.CAR, Label.LOG):
                assert np.hypot(place.x_m - block.x_m, place.y_m - block.y_m) > FREE_M * 0.9


def test_other_things_stand_on_the_ground_apart_and_are_in_the_cloud_by_number() -> None:
    random = Random(11)
    jackal = MujocoJackal(random, world=scattered(random))
    (place,) = places(random, jackal.world, 1)
    jackal.stand(place)
    things = things_around(jackal, random, 4)
    assert len(things) == 4
    said = cloud(jackal, SOURCE, np.random.default_rng(1), things)
    plain = cloud(jackal, SOURCE, np.random.default_rng(1))
    for number, thing in enumerate(things):
        points = said[said[:, 4] == FIRST_THING + number, :3].astype(float)
        assert len(points)
        away = np.linalg.norm(points - np.array(thing.middle_m) + np.array([0.0, 0.0, SOURCE.height_m]), axis=1)
        assert away.max() < np.linalg.norm(thing.half_m) + 0.1
        others = [each for each in things if each is not thing]
        assert all(np.hypot(*np.subtract(thing.middle_m, each.middle_m)[:2]) >= APART_M for each in others)
    elsewhere = said[:, 4] < FIRST_THING
    assert np.array_equal(said[elsewhere], plain[elsewhere], equal_nan=True)
