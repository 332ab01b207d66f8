"""The layers of the world on one grid: what this writer knows, what others said, and the patches between them.

Each writer has cells of its own in each layer, so nobody's patch undoes another's. `publish` compares what was set with
what was published last and gives the blocks that differ a version: a cell that flickers and is back makes none. Patches
may be lost, doubled and reordered: of each writer's block the newest stays. Versions are Lamport's clock (CACM 21:7):
above all that this scene has seen, so that all scenes which hold the same blocks merge them into the same cells.
"""

from collections.abc import Iterable, Mapping
from enum import Enum
from hashlib import sha256
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import MOST_M
from sern_twin.world.grid import Floats, Grid, need_cells
from sern_twin.world.patches import (
    CLEARED,
    FREE,
    LAYERS,
    MOST_VERSION,
    UNKNOWN,
    BlockKey,
    Cells,
    Refusal,
    encode,
    need_writer,
    read_cells,
    read_header,
)

MOST_WRITERS: Final = 16
"""In one scene, itself included: each takes a byte for each cell of a layer, two of its own."""
MOST_LEAP: Final = 2**42
"""A version may be so much above all that is known: 139 years of milliseconds. A liar does not use them up soon."""
MOST_CORNERS: Final = 1_000


class Outcome(Enum):
    """What became of a patch."""

    TAKEN = "taken"
    OLD = "old"
    """This version of the block is known, or a newer one: nothing was done."""
    OWN = "own"
    """It is this scene's writer's, from another process before, and newer: the scene says its own anew."""
    LEAP = "leap"
    """Its version is too far above all others."""
    TOO_MANY_WRITERS = "too_many_writers"
    TOO_LONG = Refusal.TOO_LONG.value
    CORRUPT = Refusal.CORRUPT.value
    OTHER_FORMAT = Refusal.OTHER_FORMAT.value
    OTHER_GRID = Refusal.OTHER_GRID.value
    UNKNOWN_LAYER = Refusal.UNKNOWN_LAYER.value
    OUT_OF_RANGE = Refusal.OUT_OF_RANGE.value
    CELLS = Refusal.CELLS.value
    TOO_MANY_CELLS = Refusal.TOO_MANY_CELLS.value


class _Plane:
    """What one writer said of one layer: its cells, and the version of each block; 0: it said nothing of it."""

    def __init__(self, grid: Grid) -> None:
        self.cells: Cells = np.full(grid.shape, UNKNOWN, np.int8)
        self.versions: NDArray[np.uint64] = np.zeros(grid.blocks, np.uint64)


class Scene:
    """The world as `writer` sees it. `first_version` is where a new process begins, such as the time in milliseconds:
    above what it said before, so that this is not taken for old.

    UsageError: a name that is none, a version that does not fit.
    """

    def __init__(self, grid: Grid, writer: str, *, first_version: int = 0) -> None:
        need_writer(writer)
        if not 0 <= first_version < MOST_VERSION:
            raise UsageError(f"the first version is {first_version}: give 0 to {MOST_VERSION - 1}")
        self.grid: Final = grid
        self.writer: Final = writer
        self._version = first_version
        """The highest that this scene gave or took."""
        self._set: dict[str, Cells] = {}
        """What this writer wants to be known, by layer."""
        self._planes: dict[tuple[str, str], _Plane] = {}
        """What was published, by (writer, layer)."""
        self._again: set[BlockKey] = set()
        self._merged: dict[str, Cells] = {}
        self._counts = dict.fromkeys(Outcome, 0)

    @property
    def version(self) -> int:
        """The version of what was published last, or heard: to ask `changed` with later."""
        return self._version

    @property
    def counts(self) -> Mapping[Outcome, int]:
        """What became of the patches that came."""
        return self._counts

    # What this writer says

    def cells(self, layer: str) -> Cells:
        """What this writer has set in a layer, (rows, columns), a copy. UsageError: no such layer."""
        return self._own(layer).copy()

    def set_cells(self, layer: str, cells: Cells, *, row: int = 0, column: int = 0) -> None:
        """Set a rectangle of cells whose first lies at `row`, `column`: -1 unknown, 0 free, to 100 occupied.

        UsageError: no such layer, cells that are not int8 or beyond these values, a place outside the grid.
        """
        own = self._own(layer)
        if cells.ndim != 2:
            raise UsageError(f"cells of {cells.ndim} dimensions: give rows and columns")
        height, width = cells.shape
        if not (0 <= row <= self.grid.rows - height and 0 <= column <= self.grid.columns - width):
            raise UsageError(f"cells of {cells.shape} at ({row}, {column}) do not fit a grid of {self.grid.shape}")
        need_cells(cells, (height, width), layer)
        own[row : row + height, column : column + width] = cells

    def paint(self, layer: str, polygon: ArrayLike, value: int) -> int:
        """Set the cells whose middles lie inside a polygon, (n, 2) corners east, north [m]: an obstacle that is added.

        How many they are; the part of the polygon that is outside the grid has none. UsageError: no such layer, a value
        that is not -1 to 100, fewer than three corners or more than `MOST_CORNERS`, one beyond `MOST_M`.
        """
        own = self._own(layer)
        corners = np.asarray(polygon, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or not 3 <= len(corners) <= MOST_CORNERS:
            raise UsageError(f"a polygon of {corners.shape}: give 3 to {MOST_CORNERS} corners of east and north")
        if not (np.abs(corners) <= MOST_M).all():  # and no NaN
            raise UsageError(f"a polygon with a corner that is not within {MOST_M:.0f} m of the origin: give metres")
        if not -1 <= value <= 100:
            raise UsageError(f"a value of {value}: give -1 (unknown) to 100 (occupied)")
        rows, columns, inside = _inside(self.grid, corners)
        own[rows, columns][inside] = value
        return int(np.count_nonzero(inside))

    def publish(self, due: Mapping[str, NDArray[np.bool_]] | None = None) -> tuple[BlockKey, ...]:
        """Give a version to each block of this writer that differs from what was published: those are to be sent.

        `due`: which blocks of a layer may be, (blocks,); all of one that it does not name.

        UsageError: there is no version left.
        """
        found: list[BlockKey] = []
        for layer, own in self._set.items():
            plane = self._plane(self.writer, layer)
            blocks = self.grid.blocks_where(own != plane.cells)
            if due is not None and layer in due:
                blocks = blocks[due[layer][blocks]]
            differs = {*blocks.tolist()}
            differs |= {key.block for key in self._again if key.layer == layer}
            found += [BlockKey(self.writer, layer, block) for block in sorted(differs)]
        if found:
            if self._version >= MOST_VERSION:
                raise UsageError("the scene has no versions left: let all who hold it begin anew")
            self._version += 1
        for key in found:
            plane = self._planes[key.writer, key.layer]
            where = self.grid.block_slices(key.block)
            plane.cells[where] = self._set[key.layer][where]
            plane.versions[key.block] = self._version
            self._merge(key.layer, key.block)
        self._again.clear()
        return tuple(found)

    def changed(self, since_version: int) -> tuple[BlockKey, ...]:
        """The blocks that this writer published after that version: what a reader that has the rest lacks."""
        return tuple(
            key for key, version in self.versions().items() if key.writer == self.writer and version > since_version
        )

    # What goes between scenes

    def encode_block(self, key: BlockKey) -> bytes:
        """The patch of a block as it was published, by this writer or another. UsageError: nothing is known of it."""
        plane = self._planes.get((key.writer, key.layer))
        where = self.grid.block_slices(key.block)
        if plane is None or not plane.versions[key.block]:
            raise UsageError(f"nothing was published of block {key.block} of {key.layer} by {key.writer}")
        return encode(self.grid, key, int(plane.versions[key.block]), plane.cells[where])

    def apply(self, patch: bytes) -> Outcome:
        """Take a patch, whatever the bytes are. What became of it, which is counted."""
        outcome = self._apply(patch)
        self._counts[outcome] += 1
        return outcome

    def versions(self) -> dict[BlockKey, int]:
        """The version of each block that this scene holds, of all writers."""
        return {
            BlockKey(writer, layer, block): int(plane.versions[block])
            for (writer, layer), plane in sorted(self._planes.items())
            for block in np.flatnonzero(plane.versions).tolist()
        }

    def missing(self, theirs: Mapping[BlockKey, int]) -> tuple[BlockKey, ...]:
        """The blocks that this scene holds and another with these `versions` lacks, or has an older version of."""
        return tuple(key for key, version in self.versions().items() if version > theirs.get(key, 0))

    def withdraw(self, key: BlockKey) -> bool:
        """Another writer has taken a block back: its cells are unknown, and a newer patch of it still counts.

        False: nothing is known of it. UsageError: it is this scene's own.
        """
        if key.writer == self.writer:
            raise UsageError(f"the scene is that of {key.writer}: set its cells to unknown instead")
        plane = self._planes.get((key.writer, key.layer))
        if plane is None or not plane.versions[key.block]:
            return False
        plane.cells[self.grid.block_slices(key.block)] = UNKNOWN
        self._merge(key.layer, key.block)
        return True

    def forget(self, writer: str) -> None:
        """Drop what another writer said: it has gone for good. Scenes that hold it still may bring it back.

        UsageError: it is this scene's own.
        """
        if writer == self.writer:
            raise UsageError(f"the scene is that of {writer}: set its cells to unknown instead")
        for layer in LAYERS:
            plane = self._planes.pop((writer, layer), None)
            for block in () if plane is None else np.flatnonzero(plane.versions).tolist():
                self._merge(layer, block)

    # What all say together

    def merged(self, layer: str) -> Cells:
        """For each cell what the newest block says in which it is not unknown, (rows, columns), a copy.

        Newest is by block, not by cell: who changes a cell says the others of its block anew. A cell that is CLEARED
        stays so where a newer block says FREE.

        UsageError: no such layer.
        """
        _need_layer(layer)
        known = self._merged.get(layer)
        return np.full(self.grid.shape, UNKNOWN, np.int8) if known is None else known.copy()

    def digest(self, layer: str) -> str:
        """32 hexadecimal digits, the same in scenes that hold the same blocks of a layer. UsageError: no such layer."""
        _need_layer(layer)
        told = sha256(self.grid.grid_id.encode())
        for (writer, of), plane in sorted(self._planes.items()):
            if of != layer:
                continue
            for block in np.flatnonzero(plane.versions).tolist():
                cells = plane.cells[self.grid.block_slices(block)]
                told.update(f"\0{writer}\0{block}\0{plane.versions[block]}\0".encode() + cells.tobytes())
        return told.hexdigest()[:32]

    # In here

    def _apply(self, patch: bytes) -> Outcome:
        header = read_header(self.grid, patch)
        if isinstance(header, Refusal):
            return Outcome(header.value)
        key = header.key
        known = self._planes.get((key.writer, key.layer))
        if known is not None and header.version <= known.versions[key.block]:
            return Outcome.OLD
        if header.version - self._version > MOST_LEAP:
            return Outcome.LEAP
        cells = read_cells(self.grid, patch, header)
        if isinstance(cells, Refusal):
            return Outcome(cells.value)
        if key.writer == self.writer:
            self._own(key.layer)
            self._again.add(key)
            self._version = max(self._version, header.version)
            return Outcome.OWN
        if known is None and len({self.writer, key.writer, *(writer for writer, _ in self._planes)}) > MOST_WRITERS:
            return Outcome.TOO_MANY_WRITERS
        plane = self._plane(key.writer, key.layer)
        plane.cells[self.grid.block_slices(key.block)] = cells
        plane.versions[key.block] = header.version
        self._version = max(self._version, header.version)
        self._merge(key.layer, key.block)
        return Outcome.TAKEN

    def _own(self, layer: str) -> Cells:
        _need_layer(layer)
        own = self._set.get(layer)
        if own is None:
            own = self._set[layer] = np.full(self.grid.shape, UNKNOWN, np.int8)
        return own

    def _plane(self, writer: str, layer: str) -> _Plane:
        plane = self._planes.get((writer, layer))
        if plane is None:
            plane = self._planes[writer, layer] = _Plane(self.grid)
        return plane

    def _merge(self, layer: str, block: int) -> None:
        merged = self._merged.get(layer)
        if merged is None:
            merged = self._merged[layer] = np.full(self.grid.shape, UNKNOWN, np.int8)
        where = self.grid.block_slices(block)
        merged[where] = _newest(
            (int(plane.versions[block]), writer, plane.cells[where])
            for (writer, of), plane in self._planes.items()
            if of == layer
        )


def _newest(said: Iterable[tuple[int, str, Cells]]) -> Cells:
    """The cells of one block, oldest first: of equal versions the writer whose name sorts later counts as newer."""
    oldest, *newer = [cells for _version, _writer, cells in sorted(said, key=lambda one: one[:2])] or [
        np.array(UNKNOWN, np.int8)
    ]
    found = oldest.copy()
    for cells in newer:
        # Who sees that a cell is free does not say that what was cleared there is right.
        np.copyto(found, cells, where=(cells != UNKNOWN) & ~((cells == FREE) & (found == CLEARED)))
    return found


def _need_layer(layer: str) -> None:
    if layer not in LAYERS:
        raise UsageError(f"there is no layer {layer!r}: give one of {', '.join(LAYERS)}")


def _inside(grid: Grid, corners: Floats) -> tuple[slice, slice, NDArray[np.bool_]]:
    """A rectangle of cells around the polygon, and which of them have their middles inside (even-odd rule)."""
    low = (corners.min(axis=0) - (grid.west_m, grid.south_m)) / grid.cell_m
    high = (corners.max(axis=0) - (grid.west_m, grid.south_m)) / grid.cell_m
    columns, rows = (
        slice(*np.clip([np.floor(low[axis]), np.ceil(high[axis])], 0, size).astype(np.int64).tolist())
        for axis, size in enumerate((grid.columns, grid.rows))
    )
    easts = grid.centres(0, np.arange(columns.start, columns.stop))[:, 0]
    norths = grid.centres(np.arange(rows.start, rows.stop), 0)[:, 1]
    # How many sides cross each row of middles just before a column: the cells west of an odd number are inside.
    crossings = np.zeros((len(norths), len(easts) + 1), np.int16)
    for (x, y), (next_x, next_y) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crossed = np.flatnonzero((y <= norths) != (next_y <= norths))
        cross = x + (norths[crossed] - y) / (next_y - y if len(crossed) else 1.0) * (next_x - x)
        crossings[crossed, np.searchsorted(easts, cross)] += 1
    east_of = crossings.sum(axis=1, keepdims=True) - np.cumsum(crossings, axis=1)[:, :-1]
    return rows, columns, east_of % 2 == 1
