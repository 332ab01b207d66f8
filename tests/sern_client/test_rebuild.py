"""Whole grids of patches cost the event loop a share of its time, and memory has a bound, whatever an origin sends."""

import logging

import numpy as np
import pytest
from numpy.typing import NDArray

from sern_client.rebuild import REST, Rebuilds
from sern_core.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.rules import TopicSpec
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
from sern_core.types import ClientName, Encoding, TopicName
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
        self.rebuilds = Rebuilds(clock=lambda: self.now, max_bytes=max_bytes)
        self.shown: list[tuple[str, NDArray[np.int8], int]] = []

    def open(self, name: str) -> None:
        whole = stream(name, GRID_TYPE, name)

        def show(body: bytes, stamp_ns: int) -> None:
            self.now += COST_S
            self.shown.append((name, read_grid(body, CDR).cells.copy(), stamp_ns))

        assert self.rebuilds.opened(whole, show) == f"{name}_updates"
        self.rebuilds.opened(stream(f"{name}_updates", UPDATE_TYPE, name), None)

    def keyframe(self, name: str, stamp_ns: int, value: int = 0, *, mark: int = 1) -> None:
        cells = np.full((SIDE, SIDE), value, np.int8)
        body = write_grid(
            Grid(HEADER, (0, 0), GridFrame(0.05, SIDE, SIDE, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0)), cells), CDR
        )
        assert self.rebuilds.message(stream(name, GRID_TYPE, name), message(name, 1, body, stamp_ns))
        self.update(name, mark, stamp_ns, np.empty((0, SIDE), np.int8))

    def update(self, name: str, seq: int, stamp_ns: int, cells: NDArray[np.int8]) -> None:
        updates = stream(f"{name}_updates", UPDATE_TYPE, name)
        body = write_update(GridUpdate(HEADER, 0, 0, cells), CDR)
        assert not self.rebuilds.message(updates, message(f"{name}_updates", seq, body, stamp_ns))

    def change(self, name: str, seq: int, stamp_ns: int, value: int) -> int:
        """One cell, and the mark of a complete change; the seq that follows."""
        self.update(name, seq, stamp_ns, np.full((1, 1), value, np.int8))
        self.update(name, seq + 1, stamp_ns, np.empty((0, 0), np.int8))
        return seq + 2


def stream(name: str, type_name: str, of: str) -> StreamInfo:
    identity = StreamId(ClientName("robot1"), 1, TopicName(name))
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
    site = Site(max_bytes=3 * SIDE * SIDE)
    names = [f"/map{number}" for number in range(5)]
    with caplog.at_level(logging.WARNING):
        for name in names:
            site.open(name)
            site.keyframe(name, 5)
    assert ["is forgotten until it comes whole again" in record.message for record in caplog.records] == [True, True]
    assert sum(grid.rebuilder.nbytes for grid in site.rebuilds._grids.values()) == 3 * SIDE * SIDE
    assert site.rebuilds.gaps == 2
    site.now += 10.0
    before = len(site.shown)
    site.change(names[0], 2, 6, 7)
    site.change(names[4], 2, 6, 7)
    assert [name for name, _, _ in site.shown[before:]] == [names[4]]
    site.now += 10.0
    site.keyframe(names[0], 7, value=1, mark=4)
    site.now += 10.0
    site.change(names[0], 5, 8, 9)
    assert [int(cells[0, 0]) for name, cells, _ in site.shown if name == names[0]] == [0, 1, 9]
    site.rebuilds.close()
