"""The last minutes of what was to be seen: bounded in time and in bytes."""

import tracemalloc

import numpy as np
import pytest

from sern_client.endpoints.twin.view.frames import OK, Place, RobotFrame, Snapshot
from sern_client.endpoints.twin.view.history import (
    LENGTH_S,
    MOST_SNAPSHOTS,
    SCENE_STEP_S,
    STEP_S,
    History,
    SceneHistory,
    SceneMoment,
)
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy


def snapshot(time_s: float, robots: int = 1, link: str = "") -> Snapshot:
    def place() -> Place:
        return Place(time_s + 0.25, time_s + 0.5, time_s + 0.75, time_s + 0.125)

    return Snapshot(
        time_s,
        tuple(
            RobotFrame(
                f"jackal{number}",
                "map",
                place(),
                place(),
                np.zeros((21, 2), np.float32) + time_s,
                time_s + 0.01,
                time_s + 0.02,
                OK,
                f"{time_s:.2f} s old, error at most {number:.2f} m",
            )
            for number in range(robots)
        ),
        link,
    )


def test_it_says_what_was_to_be_seen_then() -> None:
    history = History()
    assert history.at(5.0) is None and history.reaches_s(5.0) == 0.0
    for step in range(51):
        history.add(snapshot(step * STEP_S))
    found = history.at(5.05)
    assert found is not None and found.time_s == pytest.approx(5.0)
    assert history.at(-1.0) is history.at(0.0), "the oldest, for what is before all"
    last = history.at(1e9)
    assert last is not None and last.time_s == pytest.approx(10.0)
    assert history.reaches_s(12.0) == pytest.approx(12.0)


def test_it_takes_five_a_second_and_goes_ten_minutes_back() -> None:
    history = History()
    for step in range(round((LENGTH_S + 100.0) * 20)):
        history.add(snapshot(step * 0.05))
    assert len(history) == MOST_SNAPSHOTS
    assert history.reaches_s(LENGTH_S + 100.0) == pytest.approx(LENGTH_S, abs=2 * STEP_S)


def test_it_goes_less_far_back_where_that_takes_too_much() -> None:
    most_bytes = 100_000
    history = History(most_bytes=most_bytes)
    for step in range(1000):
        history.add(snapshot(float(step), robots=3))
        assert history.size_bytes <= most_bytes
    assert 20 < len(history) < 100
    history.add(snapshot(2000.0, robots=300))
    assert len(history) == 1 and history.size_bytes > most_bytes, "what is now is always there"
    history.add(snapshot(2001.0))
    assert len(history) == 1 and history.size_bytes == snapshot(2001.0).size_bytes


@pytest.mark.parametrize("robots", [0, 1, 40])
def test_a_snapshot_takes_no_more_memory_than_it_says(robots: int) -> None:
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        kept = [snapshot(float(step), robots, link="é" * 100 + str(step)) for step in range(200)]
        taken = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    said = sum(each.size_bytes for each in kept)
    assert taken <= said
    assert robots == 0 or taken > said / 3, "nor much less, or the history would be short for nothing"


PHANTOM = SeenDiscrepancy("/scene/yard/discrepancy/1@robot", "robot", DiscrepancyKind.PHANTOM, 1.0, 2.0, 0.5, 9)


def moment(time_s: float, *, noisy: bool = False) -> SceneMoment:
    cells = np.full((80, 90), round(time_s) % 100, np.int8)
    if noisy:
        cells = np.random.default_rng(round(time_s)).integers(-1, 101, cells.shape, np.int8)
    return SceneMoment.of(time_s, cells, np.full(30, time_s), (PHANTOM,))


def test_the_scene_is_as_it_was_then() -> None:
    history = SceneHistory()
    assert history.at(1.0) is None
    for step in range(50):
        history.add(moment(10.0 * step), step)
    found = history.at(77.0)
    assert found is not None and found.time_s == 70.0 and found.discrepancies == (PHANTOM,)
    assert (found.cells == 70).all() and found.cells.shape == (80, 90) and found.ages_s.tolist() == [70.0] * 30
    first = history.at(-5.0)
    assert first is not None and first.time_s == 0.0


def test_a_scene_is_kept_when_it_has_changed_once_a_second() -> None:
    history = SceneHistory()
    assert history.due(0.0, 0)
    history.add(moment(0.0), 0)
    assert not history.due(SCENE_STEP_S, 0) and not history.due(SCENE_STEP_S / 2, 1)
    assert history.due(SCENE_STEP_S, 1)


def test_what_was_before_the_last_ten_minutes_is_known_if_nothing_has_changed_since() -> None:
    history = SceneHistory()
    history.add(moment(0.0), 0)
    history.add(moment(10.0), 1)
    history.add(moment(10.0 + LENGTH_S), 2)
    assert len(history) == 3, "what was ten minutes ago is what is so since 10 s"
    history.add(moment(11.0 + LENGTH_S), 3)
    assert len(history) == 3
    oldest = history.at(0.0)
    assert oldest is not None and oldest.time_s == 10.0


def test_a_scene_that_changes_a_lot_goes_less_far_back() -> None:
    history = SceneHistory(most_bytes=100_000)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for step in range(100):
            history.add(moment(float(step), noisy=True), step)
        taken = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 5 < len(history) < 50 and history.size_bytes <= 100_000
    assert taken <= history.size_bytes
