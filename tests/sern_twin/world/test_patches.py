"""Blocks in bytes and back, and bytes that are no patch."""

import dataclasses
import struct
import zlib
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import BLOCK_CELLS, Grid
from sern_twin.world.patches import (
    LAYERS,
    MOST_PATCH_BYTES,
    MOST_VERSION,
    MOST_WRITER_BYTES,
    BlockKey,
    Cells,
    Refusal,
    encode,
    read_cells,
    read_header,
)

GRID = Grid(0.0, 0.0, 0.1, 40, 25)
KEY = BlockKey("robot1", "live", 5)
HEADER_BYTES: Final = 26


def signed(patch: bytes) -> bytes:
    """With the right checksum, as a liar would give it."""
    return patch + struct.pack("<I", zlib.crc32(patch))


def lie(encoding: int, body: bytes) -> Cells | Refusal:
    """What is read of a patch with another body."""
    head = bytearray(encode(GRID, KEY, 1, np.zeros((9, 8), np.int8))[: HEADER_BYTES + len(KEY.writer)])
    head[3] = encoding
    patch = signed(bytes(head) + body)
    header = read_header(GRID, patch)
    assert not isinstance(header, Refusal)
    return read_cells(GRID, patch, header)


def deflated(body: bytes) -> bytes:
    packing = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packing.compress(body) + packing.flush()


def shape_of(grid: Grid, block: int) -> tuple[int, int]:
    rows, columns = grid.block_slices(block)
    return rows.stop - rows.start, columns.stop - columns.start


@given(
    st.integers(0, 5),
    st.sampled_from(LAYERS),
    st.integers(1, MOST_VERSION),
    st.text(min_size=1, max_size=16),
    st.integers(0, 2**32 - 1),
    st.sampled_from([(-1, 0), (0, 2), (-1, 101)]),
)
def test_a_block_comes_back(
    block: int, layer: str, version: int, writer: str, seed: int, values: tuple[int, int]
) -> None:
    cells = np.random.default_rng(seed).integers(*values, shape_of(GRID, block)).astype(np.int8)
    key = BlockKey(writer, layer, block)
    patch = encode(GRID, key, version, cells)
    header = read_header(GRID, patch)
    assert not isinstance(header, Refusal)
    assert (header.key, header.version) == (key, version)
    found = read_cells(GRID, patch, header)
    assert not isinstance(found, Refusal)
    assert (found == cells).all()


def test_no_patch_is_larger_than_the_limit() -> None:
    """Noise does not compress: then the cells are as they are, with 94 bytes beside them at the most."""
    size = BLOCK_CELLS.stop - 1
    grid = Grid(0.0, 0.0, 0.1, size, size, block_cells=size)
    cells = np.random.default_rng(1).integers(-1, 101, (size, size)).astype(np.int8)
    patch = encode(grid, BlockKey("x" * MOST_WRITER_BYTES, "base", 0), MOST_VERSION, cells)
    assert len(patch) <= HEADER_BYTES + MOST_WRITER_BYTES + size * size + 4 <= MOST_PATCH_BYTES
    all_one = encode(grid, BlockKey("r", "base", 0), 1, np.zeros((size, size), np.int8))
    assert len(all_one) <= 64, "and one value takes hardly more than the header"


def test_the_layout_is_as_documented() -> None:
    patch = encode(GRID, KEY, 7, np.full((9, 8), 100, np.int8))
    head = struct.pack("<2sBB8sBBHHQ", b"SP", 1, 1, bytes.fromhex(GRID.grid_id), 1, 6, 1, 2, 7)
    assert patch == signed(head + b"robot1" + bytes([71, 100]))


@given(st.binary(max_size=200))
def test_any_bytes_are_refused(data: bytes) -> None:
    assert read_header(GRID, data) is Refusal.CORRUPT


@given(st.integers(0, 10**6), st.integers(1, 255))
def test_a_damaged_patch_is_refused(place: int, flip: int) -> None:
    patch = bytearray(encode(GRID, KEY, 7, np.random.default_rng(3).integers(-1, 101, (9, 8)).astype(np.int8)))
    patch[place % len(patch)] ^= flip
    assert read_header(GRID, bytes(patch)) is Refusal.CORRUPT
    assert read_header(GRID, bytes(patch[: place % len(patch)])) is Refusal.CORRUPT


@pytest.mark.parametrize(
    ("place", "bytes_", "refusal"),
    [
        (2, b"\x02", Refusal.OTHER_FORMAT),
        (4, b"\0" * 8, Refusal.OTHER_GRID),
        (12, b"\x03", Refusal.UNKNOWN_LAYER),
        (13, b"\0", Refusal.CORRUPT),  # a name of no bytes
        (13, b"\xff", Refusal.CORRUPT),  # one that is longer than the patch
        (14, b"\x02\0", Refusal.OUT_OF_RANGE),
        (16, b"\xff\xff", Refusal.OUT_OF_RANGE),
        (18, b"\0" * 8, Refusal.CORRUPT),  # version 0
        (HEADER_BYTES, b"\xff", Refusal.CORRUPT),  # no UTF-8
    ],
)
def test_a_lie_in_the_header_is_refused(place: int, bytes_: bytes, refusal: Refusal) -> None:
    patch = bytearray(encode(GRID, KEY, 7, np.zeros((9, 8), np.int8))[:-4])
    patch[place : place + len(bytes_)] = bytes_
    assert read_header(GRID, signed(bytes(patch))) is refusal


@pytest.mark.parametrize(
    ("encoding", "body", "refusal"),
    [
        (0, b"\0" * 71, Refusal.CELLS),
        (0, b"\0" * 73, Refusal.TOO_MANY_CELLS),
        (0, b"\0" * 71 + b"\x65", Refusal.CELLS),  # 101
        (0, b"\0" * 71 + b"\xfe", Refusal.CELLS),  # -2
        (1, b"", Refusal.CELLS),
        (1, b"\x47", Refusal.CORRUPT),
        (1, b"\x46\0", Refusal.CELLS),
        (1, b"\xff\0" * 3000, Refusal.TOO_MANY_CELLS),
        (1, b"\x48\0", Refusal.TOO_MANY_CELLS),
        (2, b"", Refusal.CORRUPT),
        (2, b"nonsense", Refusal.CORRUPT),
        (2, deflated(b"\0" * 72)[:-1], Refusal.CORRUPT),
        (2, deflated(b"\0" * 72) + b"x", Refusal.CORRUPT),
        (2, deflated(b"\0" * 71), Refusal.CELLS),
        (2, deflated(b"\0" * 5_000_000), Refusal.TOO_MANY_CELLS),
        (3, b"\0" * 72, Refusal.CORRUPT),
    ],
)
def test_a_lie_in_the_cells_is_refused(encoding: int, body: bytes, refusal: Refusal) -> None:
    assert lie(encoding, body) is refusal


def test_honest_bodies_of_each_encoding_are_read() -> None:
    for encoding, body in ((0, b"\x07" * 72), (1, b"\x47\x07"), (2, deflated(b"\x07" * 72))):
        found = lie(encoding, body)
        assert not isinstance(found, Refusal)
        assert found.shape == (9, 8) and (found == 7).all()


def test_what_is_too_long_is_not_even_looked_at() -> None:
    assert read_header(GRID, b"\0" * (MOST_PATCH_BYTES + 1)) is Refusal.TOO_LONG


@pytest.mark.parametrize(
    ("key", "version", "cells", "said"),
    [
        (dataclasses.replace(KEY, layer="sky"), 1, (9, 8), "no layer 'sky'"),
        (dataclasses.replace(KEY, block=6), 1, (9, 8), "block 6 of a grid that has 6"),
        (dataclasses.replace(KEY, writer=""), 1, (9, 8), "name of 0 bytes"),
        (dataclasses.replace(KEY, writer="\ud800"), 1, (9, 8), "is not UTF-8"),
        (dataclasses.replace(KEY, writer="ö" * 33), 1, (9, 8), "name of 66 bytes"),
        (KEY, 0, (9, 8), "version 0"),
        (KEY, 2**64, (9, 8), "version 18446744073709551616"),
        (KEY, 1, (8, 9), "another shape"),
    ],
)
def test_what_cannot_be_said_is_refused(key: BlockKey, version: int, cells: tuple[int, int], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        encode(GRID, key, version, np.zeros(cells, np.int8))
