"""Occupancy grids as their changes: whole grids now and then, rectangles of changed cells in between.

Two streams of ordinary ROS messages, as costmaps have always published them:

    <topic>           nav_msgs/OccupancyGrid          a whole grid (keyframe)
    <topic>_updates   map_msgs/OccupancyGridUpdate    rectangles of cells since the grid before

Each stream keeps its own order, but nothing orders one against the other, and messages can be lost. So every change
ends with an update without cells, which costs 60 bytes, says nothing to other readers, and tells ours two things:

    width 0, height 0    the change is complete: all rectangles of this stamp belong together
    width w, height 0    the change is the whole grid of this stamp, on the other stream

The origin gives all messages of a change one stamp, and updates have gapless sequence numbers, so the receiver knows
for certain whether it has everything. Until it does it keeps the last complete grid, and the next keyframe mends it.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.bodies import Header
from sern_core.summaries.grids import (
    Grid,
    GridUpdate,
    read_grid,
    read_update,
    write_grid,
    write_update,
)
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding

MAX_RECTANGLES: Final = 8
RECTANGLE_BYTES: Final = 128
"""What another rectangle costs: its own fields and its share of a datagram. A split must save more cells than that."""
MAX_WAITING: Final = 1024
MAX_WAITING_BYTES: Final = 32 * 2**20
"""Updates kept for a keyframe that has not come yet, by count and by cells."""


class Rectangle(NamedTuple):
    x: int
    y: int
    width: int
    height: int


def _bounds(changed: NDArray[np.bool_], at: Rectangle) -> Rectangle | None:
    """The smallest rectangle inside `at` around all changed cells; None when there is none."""
    part = changed[at.y : at.y + at.height, at.x : at.x + at.width]
    rows = np.flatnonzero(part.any(axis=1))
    if not len(rows):
        return None
    columns = np.flatnonzero(part.any(axis=0))
    x, y = int(columns[0]), int(rows[0])
    return Rectangle(at.x + x, at.y + y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1)


def _widest_gap(used: NDArray[np.bool_]) -> tuple[int, int]:
    """(start, length) of the longest run without a change; the first and the last are used."""
    places = np.flatnonzero(used)
    if len(places) < 2:
        return 0, 0
    steps = np.diff(places)
    widest = int(steps.argmax())
    return int(places[widest]) + 1, int(steps[widest]) - 1


def _cut(changed: NDArray[np.bool_], at: Rectangle) -> tuple[int, Rectangle, Rectangle]:
    """Cells saved by leaving out the widest unchanged band of `at`, and the two parts that remain."""
    part = changed[at.y : at.y + at.height, at.x : at.x + at.width]
    row, rows = _widest_gap(np.logical_or.reduce(part, axis=1))
    column, columns = _widest_gap(np.logical_or.reduce(part, axis=0))
    if rows * at.width >= columns * at.height:
        below = Rectangle(at.x, at.y + row + rows, at.width, at.height - row - rows)
        return rows * at.width, Rectangle(at.x, at.y, at.width, row), below
    right = Rectangle(at.x + column + columns, at.y, at.width - column - columns, at.height)
    return columns * at.height, Rectangle(at.x, at.y, column, at.height), right


def changed_rectangles(before: NDArray[np.int8], after: NDArray[np.int8]) -> list[Rectangle]:
    """The rectangles, MAX_RECTANGLES at most, that hold every cell in which two grids of one shape differ."""
    changed = before != after
    first = _bounds(changed, Rectangle(0, 0, changed.shape[1], changed.shape[0]))
    if first is None:
        return []
    cuts = [(first, _cut(changed, first))]
    while len(cuts) < MAX_RECTANGLES:
        best = max(range(len(cuts)), key=lambda i: cuts[i][1][0])
        saved, *parts = cuts[best][1]
        if saved <= RECTANGLE_BYTES:
            break
        bounds = [inner for part in parts if (inner := _bounds(changed, part)) is not None]
        cuts[best : best + 1] = [(inner, _cut(changed, inner)) for inner in bounds]
    return [rectangle for rectangle, _ in cuts]


@dataclass(frozen=True, slots=True)
class PatchParams:
    """When a whole grid is sent instead of its changes.

    `keyframe_updates`: after so many updates, so that what late joiners get is bounded. `keyframe_part`: when the
    changes are more than this part of its cells. `keyframe_s`: when the last one is older and the grid has changed
    since; None: never for that reason (reliable streams need no repetition).
    """

    keyframe_updates: int = 512
    keyframe_part: float = 0.5
    keyframe_s: float | None = None


class Change(NamedTuple):
    """What goes out for one grid: a whole one or None, and updates, in this order. All get one stamp."""

    whole: bytes | None
    updates: tuple[bytes, ...]


class PatchMaker:
    """The sending side of one topic."""

    def __init__(self, params: PatchParams, encoding: Encoding) -> None:
        self.params = params
        self.keyframes = 0
        self._encoding = encoding
        self._last: Grid | None = None
        self._updates = 0  # since the last keyframe
        self._changed = False
        self._keyframe_at_s = 0.0

    def forget(self) -> None:
        """Something was lost on its way: the next grid goes whole."""
        self._last = None

    def change(self, body: bytes, *, now: float, whole: bool = False) -> Change:
        """The messages for one more OccupancyGrid body. `whole`: send it whole in any case. BodyError."""
        grid = read_grid(body, self._encoding)
        last, params = self._last, self.params
        self._last = grid
        due = params.keyframe_s is not None and self._changed and now - self._keyframe_at_s >= params.keyframe_s
        if whole or due or last is None or last.frame != grid.frame or last.header.frame_id != grid.header.frame_id:
            return self._keyframe(grid, body, now)
        rectangles = changed_rectangles(last.cells, grid.cells)
        cells = sum(at.width * at.height for at in rectangles)
        if (
            self._updates + len(rectangles) + 1 > params.keyframe_updates
            or cells > params.keyframe_part * grid.cells.size
        ):
            return self._keyframe(grid, body, now)
        updates = [
            GridUpdate(grid.header, at.x, at.y, grid.cells[at.y : at.y + at.height, at.x : at.x + at.width])
            for at in rectangles
        ]
        updates.append(GridUpdate(grid.header, 0, 0, np.empty((0, 0), np.int8)))
        self._updates += len(updates)
        self._changed |= bool(rectangles)
        return Change(None, tuple(write_update(update, self._encoding) for update in updates))

    def _keyframe(self, grid: Grid, body: bytes, now: float) -> Change:
        self._updates, self._changed, self._keyframe_at_s = 1, False, now
        self.keyframes += 1
        mark = GridUpdate(grid.header, 0, 0, np.empty((0, max(grid.frame.width, 1)), np.int8))
        return Change(body, (write_update(mark, self._encoding),))


class _Waiting(NamedTuple):
    stamp_ns: int
    update: GridUpdate

    @property
    def keyframe(self) -> bool:
        height, width = self.update.cells.shape
        return not height and bool(width)

    @property
    def complete(self) -> bool:
        height, width = self.update.cells.shape
        return not height and not width


class GridRebuilder:
    """The receiving side of one topic: whole grids from keyframes and updates, never one that is incomplete.

    `update` gives a grid for every complete change. Writing one costs its size, and the change may be of a few bytes:
    who cannot trust the origin calls `accept` instead, and `whole` when a grid that is `due` may cost what it does.

    `gaps` counts how often something was missing, so that the next keyframe had to be waited for; `stamp_ns` is when
    the last complete grid was taken.
    """

    def __init__(self, encoding: Encoding) -> None:
        self.gaps = 0
        self.stamp_ns = 0
        self._encoding = encoding
        self._base: Grid | None = None
        self._base_ns = 0
        self._cells: NDArray[np.int8] = np.empty((0, 0), np.int8)
        self._next_seq: int | None = None  # of the update that goes on from what we have; None: its mark is awaited
        self._waiting: dict[int, _Waiting] = {}  # by seq, ascending
        self._waiting_bytes = 0
        self._due: Header | None = None

    @property
    def due(self) -> bool:
        """Whether there is a complete grid that `whole` has not given yet."""
        return self._due is not None

    @property
    def nbytes(self) -> int:
        """What it keeps: the grid, and what waits for another."""
        return self._cells.nbytes + self._waiting_bytes

    def forget(self) -> None:
        """Let go of everything; the next keyframe is waited for."""
        self.gaps += self._base is not None
        self._base, self._due = None, None
        self._cells = np.empty((0, 0), np.int8)
        self.updates_ended()

    def updates_ended(self) -> None:
        """No update goes on from those that there were."""
        self._next_seq = None
        self._waiting.clear()
        self._waiting_bytes = 0

    def keyframe(self, body: bytes, *, stamp_ns: int) -> bytes | None:
        """A whole grid has arrived. Returns the grid to show, None when a newer one is shown already. BodyError."""
        if self._base is not None and stamp_ns <= self._base_ns:
            return None
        grid = read_grid(body, self._encoding)
        self._cells = grid.cells.copy()
        self._base, self._base_ns = replace(grid, cells=self._cells), stamp_ns
        self._next_seq = next((seq for seq, item in self._waiting.items() if self._is_mark(item)), None)
        self._due, self.stamp_ns = None, stamp_ns
        self._advance()
        return self.whole() or body

    def _is_mark(self, item: _Waiting) -> bool:
        return item.keyframe and item.stamp_ns == self._base_ns

    def update(self, body: bytes, *, seq: int, stamp_ns: int) -> bytes | None:
        """An update has arrived, `seq` its number in its stream. Returns the grid to show, None: nothing complete.
        BodyError; then what follows waits for the next keyframe."""
        self.accept(body, seq=seq, stamp_ns=stamp_ns)
        return self.whole()

    def whole(self) -> bytes | None:
        """Write the grid that is due; None: none is."""
        header, self._due = self._due, None
        if header is None or self._base is None:
            return None
        return write_grid(replace(self._base, header=header, cells=self._cells), self._encoding)

    def accept(self, body: bytes, *, seq: int, stamp_ns: int) -> None:
        """Take an update as `update` does, without writing the grid that comes of it."""
        if self._next_seq is not None and seq < self._next_seq:
            return
        item = _Waiting(stamp_ns, read_update(body, self._encoding))
        if self._next_seq is not None and seq > self._next_seq:
            # A stream keeps its order, so what is missing will not come any more.
            self._next_seq = None
            self.gaps += 1
        if self._next_seq is None and self._base is not None and self._is_mark(item):
            self._next_seq = seq
        self._waiting[seq] = item
        self._waiting_bytes += item.update.cells.size
        while len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
            self._forget(next(iter(self._waiting)))
        self._advance()

    def _forget(self, seq: int) -> None:
        self._waiting_bytes -= self._waiting.pop(seq).update.cells.size

    def _advance(self) -> None:
        """Apply what waits and goes on from what we have. The last complete grid that comes of it is due; one that was
        due before is not any more once another change has begun."""
        while self._base is not None and self._next_seq is not None and (item := self._waiting.get(self._next_seq)):
            if item.keyframe and not self._is_mark(item):
                self._next_seq = None  # its whole grid is still on its way; this and what follows waits for it
                break
            for seq in [seq for seq in self._waiting if seq <= self._next_seq]:
                self._forget(seq)
            self._next_seq += 1
            if item.complete:
                self._due, self.stamp_ns = item.update.header, item.stamp_ns
            elif not item.keyframe:
                self._due = None
                self._apply(item.update)

    def _apply(self, update: GridUpdate) -> None:
        height, width = update.cells.shape
        if not (0 <= update.x <= self._cells.shape[1] - width and 0 <= update.y <= self._cells.shape[0] - height):
            self._next_seq = None
            self.gaps += 1
            raise BodyError(f"{width} x {height} cells at {update.x}, {update.y} do not lie in the grid")
        self._cells[update.y : update.y + height, update.x : update.x + width] = update.cells
