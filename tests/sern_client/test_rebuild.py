"""Whole grids of patches cost the event loop a share of its time, and memory has a bound, whatever an origin sends."""

import logging
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from sern_client.rebuild import MAX_OWED, REST, Owed, Rebuilds
from sern_core.summaries.bodies import Header
from sern_core.summaries.grids import (
    GRID_TYPE,
    UPDATE_TYPE,
    Grid,
    GridFrame,
    GridUpdate,
    read_grid,
    write_grid,
    write_update,
)
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from tests.support import until

CDR = Encoding.CDR
HEADER = Header(1, 0, "map")
SIDE = 100
COST_S = 0.015
"""What publishing a grid takes, as its receiver's clock tells."""


class Site:
    """Takes the streams of one origin; its clock stands still but for what publishing takes."""

    def __init__(self, *, max_bytes: int = 2**20) -> None:
        self.now = 100.0
        self.kept: list[Owed] = []
        self.settled: list[Owed] = []
        self.rebuilds = Rebuilds(self._publish, self.settled.extend, clock=lambda: self.now, max_bytes=max_bytes)
        self.shown: list[tuple[str, NDArray[np.int8], int]] = []

    def _publish(self, publish: Callable[[], None], owed: Sequence[Owed]) -> None:
        publish()
        self.kept += owed

    def open(self, name: str, *, origin: str = "robot1") -> None:
        whole = stream(name, GRID_TYPE, name, origin)

        def show(body: bytes, stamp_ns: int) -> None:
            self.now += COST_S
            self.shown.append((name, read_grid(body, CDR).cells.copy(), stamp_ns))

        assert self.rebuilds.opened(whole, show) == f"{name}_updates"
        self.rebuilds.opened(stream(f"{name}_updates", UPDATE_TYPE, name, origin), None)

    def keyframe(self, name: str, stamp_ns: int, value: int = 0, *, mark: int = 1, origin: str = "robot1") -> None:
        whole = message(name, 1, grid_body(value), stamp_ns)
        assert self.rebuilds.message(stream(name, GRID_TYPE, name, origin), whole)
        self.update(name, mark, stamp_ns, np.empty((0, SIDE), np.int8), origin)

    def update(self, name: str, seq: int, stamp_ns: int, cells: NDArray[np.int8], origin: str = "robot1") -> None:
        updates = stream(f"{name}_updates", UPDATE_TYPE, name, origin)
        body = write_update(GridUpdate(HEADER, 0, 0, cells), CDR)
        assert not self.rebuilds.message(updates, message(f"{name}_updates", seq, body, stamp_ns), owed=True)

    def change(self, name: str, seq: int, stamp_ns: int, value: int, origin: str = "robot1") -> int:
        """One cell, and the mark of a complete change; the seq that follows."""
        self.update(name, seq, stamp_ns, np.full((1, 1), value, np.int8), origin)
        self.update(name, seq + 1, stamp_ns, np.empty((0, 0), np.int8), origin)
        return seq + 2


def grid_body(value: int) -> bytes:
    cells = np.full((SIDE, SIDE), value, np.int8)
    frame = GridFrame(0.05, SIDE, SIDE, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))
    return write_grid(Grid(HEADER, (0, 0), frame, cells), CDR)


def stream(name: str, type_name: str, of: str, origin: str = "robot1") -> StreamInfo:
    identity = StreamId(ClientName(origin), 1, TopicName(name))
    info = TopicInfo(identity.topic, type_name, CDR)
    return StreamInfo(identity, info, TopicSpec(), {"summary": "patches", "summary_of": of})


def message(name: str, seq: int, body: bytes, stamp_ns: int) -> Message:
    return Message(StreamId(ClientName("robot1"), 1, TopicName(name)), seq, body, stamp_ns, 0.0)


async def test_a_thousand_small_changes_are_a_few_grids_and_the_last_is_shown() -> None:
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    assert len(site.shown) == 1
    seq = 2
    for number in range(1000):
        seq = site.change("/map", seq, 6 + number, number % 100)
    assert len(site.shown) == 2, "one at once, the others while the loop rests"
    site.now += REST * COST_S
    await until(lambda: len(site.shown) == 3, "the last one has its turn")
    name, cells, stamp_ns = site.shown[-1]
    assert (name, cells[0, 0], stamp_ns) == ("/map", 99, 1005)
    site.rebuilds.close()


async def test_marks_alone_are_grids_at_the_same_pace() -> None:
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    for seq in range(2, 902):
        site.update("/map", seq, 6, np.empty((0, 0), np.int8))
    assert len(site.shown) == 2
    site.rebuilds.close()


async def test_a_change_that_is_not_complete_is_never_shown() -> None:
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    seq = site.change("/map", site.change("/map", 2, 6, 1), 7, 2)  # shown; due
    site.update("/map", seq, 8, np.full((1, 1), 3, np.int8))
    site.now += REST * COST_S
    site.update("/map", seq + 1, 8, np.empty((0, 0), np.int8))
    assert [int(cells[0, 0]) for _, cells, _ in site.shown] == [0, 1, 3]
    site.rebuilds.close()


async def test_every_map_has_its_turn() -> None:
    site = Site()
    names = [f"/map{number}" for number in range(5)]
    for name in names:
        site.open(name)
        site.keyframe(name, 5)
        site.change(name, 2, 6, 7)
    for count in range(len(site.shown), 2 * len(names) + 1):
        await until(lambda count=count: len(site.shown) >= count)  # type: ignore[misc]
        site.now += REST * COST_S
    assert {name for name, cells, _ in site.shown if cells[0, 0] == 7} == set(names)
    site.rebuilds.close()


async def test_a_map_that_ends_is_not_shown_any_more() -> None:
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    site.change("/map", site.change("/map", 2, 6, 1), 7, 2)
    site.rebuilds.closed(stream("/map", GRID_TYPE, "/map"))
    site.now += 10.0
    site.open("/other")
    site.keyframe("/other", 5)
    assert [name for name, _, _ in site.shown] == ["/map", "/map", "/other"]
    site.rebuilds.close()


async def test_all_maps_together_have_a_bound(caplog: pytest.LogCaptureFixture) -> None:
    """Who has most gives: another origin's map stays."""
    site = Site(max_bytes=3 * SIDE * SIDE)
    site.open("/own", origin="robot2")
    site.keyframe("/own", 5, origin="robot2")
    names = [f"/map{number}" for number in range(4)]
    with caplog.at_level(logging.WARNING):
        for name in names:
            site.open(name)
            site.keyframe(name, 5)
    assert ["is forgotten until it comes whole again" in record.message for record in caplog.records] == [True, True]
    assert [grid.rebuilder.nbytes > 0 for grid in site.rebuilds._grids.values()] == [True, False, False, True, True]
    assert site.rebuilds.gaps == 2
    before = len(site.shown)
    for name in names:
        site.now += 10.0
        site.change(name, 2, 6, 7)
    site.now += 10.0
    site.change("/own", 2, 6, 7, origin="robot2")
    assert [name for name, _, _ in site.shown[before:]] == [*names[2:], "/own"]
    site.now += 10.0
    site.keyframe(names[0], 7, value=1, mark=4)
    site.now += 10.0
    site.change(names[0], 5, 8, 9)
    assert [int(cells[0, 0]) for name, cells, _ in site.shown if name == names[0]] == [0, 1, 9]
    site.rebuilds.close()


async def test_nothing_is_kept_of_streams_that_have_ended() -> None:
    site = Site()
    for number in range(50):
        name = f"/map{number}"
        site.open(name)
        site.keyframe(name, 5)
        site.change(name, 2, 6, 7)
        for ended in (name, f"{name}_updates")[:: 1 if number % 2 else -1]:
            site.rebuilds.closed(stream(ended, GRID_TYPE if ended == name else UPDATE_TYPE, name))
    rebuilds = site.rebuilds
    assert (rebuilds._grids, rebuilds._due, rebuilds._kept_bytes, rebuilds.gaps) == ({}, {}, 0, 0)


async def test_updates_that_wait_for_a_map_that_never_comes_have_a_bound() -> None:
    site = Site(max_bytes=10 * SIDE * SIDE)
    for number in range(50):
        updates = stream(f"/map{number}_updates", UPDATE_TYPE, f"/map{number}")
        assert site.rebuilds.opened(updates, None) is None
        site.update(f"/map{number}", 1, 5, np.zeros((SIDE, SIDE), np.int8))
        assert sum(grid.rebuilder.nbytes for grid in site.rebuilds._grids.values()) <= 10 * SIDE * SIDE
    assert len(site.rebuilds._grids) == 50
    named_otherwise = stream("/map0_updates", UPDATE_TYPE, "/elsewhere")
    site.rebuilds.opened(named_otherwise, None)
    assert len(site.rebuilds._grids) == 50, "a stream of updates is named for its map"
    site.rebuilds.close()


async def test_an_update_is_owed_until_its_grid_has_been_published() -> None:
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    updates = stream("/map_updates", UPDATE_TYPE, "/map")
    assert site.rebuilds.owes(updates, 1), "the mark is part of the next grid"
    site.now += 10.0
    seq = site.change("/map", 2, 6, 1)
    assert site.kept == [(updates.id, seq) for seq in (1, 2, 3)] and not site.rebuilds.owes(updates, 3)
    seq = site.change("/map", site.change("/map", seq, 7, 2), 8, 3)
    assert len(site.kept) == 3 and site.rebuilds.owes(updates, seq - 1), "the loop rests"
    site.now += REST * COST_S
    await until(lambda: len(site.shown) == 3, "the last one has its turn")
    assert site.kept == [(updates.id, each) for each in range(1, seq)] and site.settled == []
    site.change("/map", seq, 9, 4)
    site.keyframe("/map", 10, mark=seq + 2)
    assert site.kept[-2:] == [(updates.id, seq), (updates.id, seq + 1)], "a newer grid has taken its place"
    assert site.settled == []
    for each in range(seq + 3, seq + 3 + MAX_OWED + 10):
        site.update("/map", each, 11, np.full((1, 1), 5, np.int8))
    assert len(site.settled) > MAX_OWED // 2, "a change without an end is not waited for"
    site.rebuilds.closed(stream("/map", GRID_TYPE, "/map"))
    assert len(site.kept) + len(site.settled) == seq + 2 + MAX_OWED + 10
    site.rebuilds.close()


def site_with_a_grid_due() -> tuple[Site, int]:
    """A site that has shown a change, and waits to show the next one, of stamp 7; the seq of the update after that."""
    site = Site()
    site.open("/map")
    site.keyframe("/map", 5)
    site.now += 10.0
    return site, site.change("/map", site.change("/map", 2, 6, 1), 7, 2)


async def test_a_whole_grid_that_comes_late_or_broken_leaves_what_is_due() -> None:
    """Copies of a keyframe are as old as what they repeat: what was taken since waits for its turn all the same."""
    site, seq = site_with_a_grid_due()
    updates, whole = stream("/map_updates", UPDATE_TYPE, "/map"), stream("/map", GRID_TYPE, "/map")
    assert len(site.shown) == 2 and site.rebuilds.owes(updates, seq - 1), "the loop rests"
    assert site.rebuilds.message(whole, message("/map", 2, grid_body(0), 5)), "late: a newer one is shown"
    assert not site.rebuilds.message(whole, message("/map", 3, b"no grid", 9)), "published as it came"
    assert len(site.shown) == 2 and site.settled == [] and site.rebuilds.owes(updates, seq - 1)
    site.now += REST * COST_S
    await until(lambda: len(site.shown) == 3, "the change has its turn")
    name, cells, stamp_ns = site.shown[-1]
    assert (name, cells[0, 0], stamp_ns) == ("/map", 2, 7)
    assert site.kept == [(updates.id, each) for each in range(1, seq)] and site.settled == []
    site.rebuilds.close()


async def test_a_grid_that_is_due_keeps_its_stamp() -> None:
    """An update that waits for another one has no part in it."""
    site, seq = site_with_a_grid_due()
    site.update("/map", seq + 1, 99, np.empty((0, 0), np.int8))  # one is missing before it
    site.now += REST * COST_S
    await until(lambda: len(site.shown) == 3, "the change has its turn")
    assert site.shown[-1][2] == 7
    site.rebuilds.close()
