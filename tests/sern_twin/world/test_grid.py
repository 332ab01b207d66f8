"""Where cells and blocks lie, and what is no grid."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import MOST_BLOCKS, NOWHERE, Grid, need_cells

GRID = Grid(-2.0, -1.0, 0.5, 21, 9, block_cells=4, plane=TangentPlane.from_degrees(48.0, 10.0, 500.0))


def test_the_middle_of_each_cell_is_in_it() -> None:
    rows, columns = GRID.index(GRID.all_centres())
    assert (rows == np.arange(9)[:, None]).all()
    assert (columns == np.arange(21)).all()
    assert (GRID.flat(GRID.all_centres()).ravel() == np.arange(9 * 21)).all()
    assert GRID.centres(0, 0).tolist() == [-1.75, -0.75]


def test_what_is_not_on_the_grid_is_nowhere() -> None:
    outside = [[-2.01, 0], [8.5, 0], [0, -1.01], [0, 3.5], [math.nan, 0], [0, math.inf], [-1e300, 1e300], [1e308, 0]]
    rows, columns = GRID.index(outside)
    assert (rows == NOWHERE).all() and (columns == NOWHERE).all()
    assert (GRID.flat(outside) == NOWHERE).all()
    assert (GRID.block_of([-1, 9, 0, 0], [0, 0, -1, 21]) == NOWHERE).all()
    assert GRID.flat([-2.0, -1.0]) == 0, "the south-west corner belongs to the first cell"


def test_each_cell_is_in_one_block() -> None:
    seen = np.zeros(GRID.shape, np.int64)
    for block in range(GRID.blocks):
        seen[GRID.block_slices(block)] += 1
        rows, columns = np.mgrid[GRID.block_slices(block)]
        assert (GRID.block_of(rows, columns) == block).all()
    assert (seen == 1).all()
    assert (GRID.block_rows, GRID.block_columns, GRID.blocks) == (3, 6, 18)
    marked = np.zeros(GRID.shape, np.bool_)
    marked[8, 20] = marked[0, 0] = marked[0, 1] = True
    assert GRID.blocks_where(marked).tolist() == [0, 17]
    for block in (-1, 18):
        with pytest.raises(UsageError, match="of a grid that has 18"):
            GRID.block_slices(block)


def test_equal_grids_have_one_id_and_others_another() -> None:
    assert dataclasses.replace(GRID).grid_id == GRID.grid_id
    assert dataclasses.replace(GRID, west_m=-0.0).grid_id == dataclasses.replace(GRID, west_m=0.0).grid_id
    others = [
        dataclasses.replace(GRID, **change)
        for change in (
            {}, {"west_m": -2.5}, {"south_m": 0.0}, {"cell_m": 0.25}, {"columns": 20}, {"rows": 8}, {"block_cells": 5},
            {"frame_id": "odom"},
        )
    ]  # fmt: skip
    assert len({grid.grid_id for grid in others}) == len(others)
    assert dataclasses.replace(GRID, plane=None).grid_id == GRID.grid_id, "a robot need not know where it is on Earth"
    assert Grid(0, 0, 1, 2, 3).grid_id == "73cc3d563371dd50", "it is part of the format"


def test_the_grid_is_placed_on_the_earth_by_its_plane() -> None:
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 1.0]])
    np.testing.assert_allclose(GRID.to_local(GRID.to_geodetic(points)), points, atol=1e-8)
    with pytest.raises(UsageError, match="give it a plane"):
        dataclasses.replace(GRID, plane=None).to_local(points)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cell_m": 0.0}, "cells of 0.0 m"),
        ({"cell_m": math.nan}, "cells of nan m"),
        ({"columns": 0}, "0 x 9 cells"),
        ({"rows": 70_000}, "give 1 to 65535"),
        ({"columns": 4000, "rows": 4000}, "4000000 are the most"),
        ({"block_cells": 3}, "give 4 to 64"),
        ({"block_cells": 65}, "give 4 to 64"),
        ({"columns": 2000, "rows": 2000}, f"{MOST_BLOCKS} are the most"),
        ({"west_m": math.inf}, "corners"),
        ({"south_m": math.nan}, "corners"),
        ({"frame_id": "x" * 257}, "257 characters"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        dataclasses.replace(GRID, **change)


@pytest.mark.parametrize(
    "cells",
    [
        np.zeros((2, 3), np.int8),
        np.zeros((2, 2), np.int16),
        np.full((2, 2), 101, np.int8),
        np.full((2, 2), -2, np.int8),
    ],
)
def test_cells_are_those_of_ros(cells: NDArray[Any]) -> None:
    with pytest.raises(UsageError, match="a map: cells"):
        need_cells(cells, (2, 2), "a map")
    need_cells(np.array([[-1, 0], [50, 100]], np.int8), (2, 2), "a map")
