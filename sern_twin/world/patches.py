"""One block of a scene in bytes and back: what the paper calls a scene patch.

    0      2        3          4         12      13       14          16             18        26
    | "SP" | format | encoding | grid_id | layer | length | block row | block column | version | writer | cells | CRC-32
             u8       u8         8 bytes   u8      u8       u16         u16            u64       UTF-8            u32

All little-endian. `length` is that of the writer's name in bytes. The cells are in the smallest of three encodings: as
they are (int8, row by row), as runs (length - 1 as u8, value as int8), or deflated without a header (RFC 1951). A patch
has the whole block, not a difference: whoever missed one is right again with the next.
"""

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid

Cells = NDArray[np.int8]

MAGIC: Final = b"SP"
FORMAT: Final = 1
LAYERS: Final = ("base", "live", "twin_only")
"""By their numbers in a patch: what the map says, what robots see now, what is in the twin alone."""
UNKNOWN: Final = -1
FREE: Final = 0
OCCUPIED: Final = 100
CLEARED: Final = 1
"""A cell of `live`: scans see through what the twin has there. It is free on the map, whatever was added."""
LASTING: Final = 99
"""A cell of `twin_only` or `base` of a kind that scans do not see. It is occupied on the map, whatever they say."""
MOST_VERSION: Final = 2**64 - 1
MOST_WRITER_BYTES: Final = 64
MOST_PATCH_BYTES: Final = 8_000
"""More than the largest block takes."""

_HEADER: Final = struct.Struct("<2sBB8sBBHHQ")
_CRC: Final = struct.Struct("<I")
_RAW, _RUNS, _DEFLATED = 0, 1, 2
_LONGEST_RUN: Final = 256


class Refusal(Enum):
    """Why bytes are no patch for this grid."""

    TOO_LONG = "too_long"
    CORRUPT = "corrupt"
    """Not a whole patch as it was sent."""
    OTHER_FORMAT = "other_format"
    OTHER_GRID = "other_grid"
    UNKNOWN_LAYER = "unknown_layer"
    OUT_OF_RANGE = "out_of_range"
    """A block that the grid does not have."""
    CELLS = "cells"
    """Cells that are too few or not -1 to 100."""
    TOO_MANY_CELLS = "too_many_cells"
    """It unpacks to more than the block has."""


@dataclass(frozen=True, slots=True, order=True)
class BlockKey:
    """A block of one layer, of one writer: each writer has cells of its own."""

    writer: str
    layer: str
    block: int


@dataclass(frozen=True, slots=True)
class Header:
    """What a patch says of itself before its cells. `body` is where they lie in the bytes."""

    key: BlockKey
    version: int
    encoding: int
    body: slice


def need_writer(writer: str) -> bytes:
    """The name as bytes. UsageError: none, or more than `MOST_WRITER_BYTES`."""
    try:
        name = writer.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"the writer's name {writer!r} is not UTF-8") from error
    if not 1 <= len(name) <= MOST_WRITER_BYTES:
        raise UsageError(f"a writer's name of {len(name)} bytes: give 1 to {MOST_WRITER_BYTES}")
    return name


def encode(grid: Grid, key: BlockKey, version: int, cells: Cells) -> bytes:
    """The patch of a block, (block rows, block columns) of int8.

    UsageError: no such block or layer, a version that does not fit, a writer without a name, cells of another shape.
    """
    row, column = grid.block_place(key.block)
    rows, columns = grid.block_slices(key.block)
    if key.layer not in LAYERS:
        raise UsageError(f"there is no layer {key.layer!r}: give one of {', '.join(LAYERS)}")
    if not 0 < version <= MOST_VERSION:
        raise UsageError(f"version {version} of a block: give 1 to {MOST_VERSION}")
    if cells.shape != (rows.stop - rows.start, columns.stop - columns.start):
        raise UsageError(f"cells of {cells.shape} for block {key.block}, which has another shape")
    name = need_writer(key.writer)
    encoding, body = _packed(np.ascontiguousarray(cells, np.int8).ravel())
    header = _HEADER.pack(
        MAGIC, FORMAT, encoding, bytes.fromhex(grid.grid_id), LAYERS.index(key.layer), len(name), row, column, version
    )
    patch = header + name + body
    return patch + _CRC.pack(zlib.crc32(patch))


def read_header(grid: Grid, patch: bytes) -> Header | Refusal:
    """What the bytes are a patch of, without unpacking its cells."""
    if len(patch) > MOST_PATCH_BYTES:
        return Refusal.TOO_LONG
    if len(patch) < _HEADER.size + _CRC.size:
        return Refusal.CORRUPT
    end = len(patch) - _CRC.size
    magic, form, encoding, grid_id, layer, length, row, column, version = _HEADER.unpack_from(patch)
    if magic != MAGIC or _CRC.unpack_from(patch, end)[0] != zlib.crc32(memoryview(patch)[:end]):
        return Refusal.CORRUPT
    if form != FORMAT:
        return Refusal.OTHER_FORMAT
    if grid_id.hex() != grid.grid_id:
        return Refusal.OTHER_GRID
    if layer >= len(LAYERS):
        return Refusal.UNKNOWN_LAYER
    if row >= grid.block_rows or column >= grid.block_columns:
        return Refusal.OUT_OF_RANGE
    start = _HEADER.size + length
    if not 1 <= length <= MOST_WRITER_BYTES or start > end or version == 0:
        return Refusal.CORRUPT
    try:
        writer = patch[_HEADER.size : start].decode()
    except UnicodeDecodeError:
        return Refusal.CORRUPT
    key = BlockKey(writer, LAYERS[layer], row * grid.block_columns + column)
    return Header(key, version, encoding, slice(start, end))


def read_cells(grid: Grid, patch: bytes, header: Header) -> Cells | Refusal:
    """The cells of a patch, a copy in the block's shape. No more is unpacked than the block has."""
    rows, columns = grid.block_slices(header.key.block)
    shape = rows.stop - rows.start, columns.stop - columns.start
    size = shape[0] * shape[1]
    body = patch[header.body]
    if header.encoding == _RAW:
        found = np.frombuffer(body, np.int8)
    elif header.encoding == _RUNS:
        if len(body) % 2:
            return Refusal.CORRUPT
        pairs = np.frombuffer(body, np.uint8).reshape(-1, 2)
        lengths = pairs[:, 0].astype(np.int64) + 1
        if int(lengths.sum()) > size:
            return Refusal.TOO_MANY_CELLS
        found = np.repeat(pairs[:, 1].view(np.int8), lengths)
    elif header.encoding == _DEFLATED:
        unpacking = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            found = np.frombuffer(unpacking.decompress(body, size + 1), np.int8)
        except zlib.error:
            return Refusal.CORRUPT
        if len(found) <= size and (not unpacking.eof or unpacking.unused_data):
            return Refusal.CORRUPT
    else:
        return Refusal.CORRUPT
    if len(found) > size:
        return Refusal.TOO_MANY_CELLS
    if len(found) < size or found.min() < UNKNOWN or found.max() > OCCUPIED:
        return Refusal.CELLS
    return found.reshape(shape).copy()


def _packed(cells: Cells) -> tuple[int, bytes]:
    """The number of the smallest encoding, and the cells in it."""
    deflating = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    ways = [
        (_RAW, cells.tobytes()),
        (_RUNS, _runs(cells)),
        (_DEFLATED, deflating.compress(cells.tobytes()) + deflating.flush()),
    ]
    return min(ways, key=lambda way: len(way[1]))


def _runs(cells: Cells) -> bytes:
    changes = np.flatnonzero(np.diff(cells)) + 1
    starts = np.concatenate(([0], changes))
    lengths = np.diff(np.concatenate((starts, [len(cells)])))
    # A run that is too long for a byte becomes whole pieces and a rest.
    pieces = -(-lengths // _LONGEST_RUN)
    values = np.repeat(cells[starts], pieces)
    counts = np.full(len(values), _LONGEST_RUN, np.int64)
    last = np.cumsum(pieces) - 1
    counts[last] = lengths - (pieces - 1) * _LONGEST_RUN
    pairs = np.empty((len(values), 2), np.uint8)
    pairs[:, 0] = counts - 1
    pairs[:, 1] = values.view(np.uint8)
    return pairs.tobytes()
