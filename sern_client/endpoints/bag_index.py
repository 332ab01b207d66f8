"""Chunks of recordings, as bytes: what stands before one and what behind it. Used while recording and to finish
leftovers."""

import struct
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import BinaryIO, Final

from rosbags.rosbag2.storage_mcap import write_record, write_string, write_uint16, write_uint32, write_uint64

Entries = Mapping[int, Sequence[tuple[int, int]]]
"""Messages of a chunk by connection: (time in ns, offset in the chunk)."""

MCAP_CHUNK: Final = struct.Struct("<BQQQQIIQ")
"""Opcode, length; first time, last time, size, no checksum, no compression, size again."""
MCAP_RECORD: Final = struct.Struct("<BQ")
_U32: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")


class SchemaName(str):
    """The name of one schema of an MCAP file. It equals no other, however that is written.

    A file may hold two definitions of one type. rosbags looks for the schema of a channel by its name.
    """

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return self is other

    def __ne__(self, other: object) -> bool:
        return self is not other

    def __hash__(self) -> int:
        return id(self)


def _bag_header(*fields: bytes) -> bytes:
    header = b"".join(_U32.pack(len(field)) + field for field in fields)
    return _U32.pack(len(header)) + header


def bag_chunk_head(size: int) -> bytes:
    """What stands before the `size` bytes of a chunk in a ROS 1 bag; always as long."""
    return _bag_header(b"op=\x05", b"compression=none", b"size=" + _U32.pack(size)) + _U32.pack(size)


def write_bag_index(file: BinaryIO, entries: Entries) -> None:
    """The index records behind a chunk of a ROS 1 bag."""
    for number, found in entries.items():
        if found:
            conn, count = _U32.pack(number), _U32.pack(len(found))
            file.write(_bag_header(b"op=\x04", b"ver=" + _U32.pack(1), b"conn=" + conn, b"count=" + count))
            file.write(_U32.pack(12 * len(found)))
            file.write(b"".join(_TIME.pack(*divmod(stamp_ns, 10**9)) + _U32.pack(offset) for stamp_ns, offset in found))


def mcap_chunk_head(start_ns: int, end_ns: int, size: int) -> bytes:
    """What stands before the `size` bytes of a chunk in an MCAP file; always as long."""
    return MCAP_CHUNK.pack(0x06, MCAP_CHUNK.size - MCAP_RECORD.size + size, start_ns, end_ns, size, 0, 0, size)


def write_mcap_index(file: BinaryIO, entries: Entries) -> None:
    """The message index records behind a chunk of an MCAP file."""
    for number, found in entries.items():
        record = BytesIO()
        write_uint16(record, number)
        write_uint32(record, len(found) * 16)
        for stamp_ns, offset in found:
            write_uint64(record, stamp_ns)
            write_uint64(record, offset)
        write_record(file, 0x07, record)


def mcap_chunk_index(start_ns: int, end_ns: int, begin: int, behind: int, entries: Entries) -> BytesIO:
    """What the summary of an MCAP file says of the chunk at `begin`, behind which its index begins."""
    record = BytesIO()
    for value in (start_ns, end_ns, begin, behind - begin):
        write_uint64(record, value)
    write_uint32(record, len(entries) * 10)
    position = behind
    for number, found in entries.items():
        write_uint16(record, number)
        write_uint64(record, position)
        position += MCAP_RECORD.size + 6 + 16 * len(found)
    write_uint64(record, position - behind)
    write_string(record, "")
    size = behind - begin - MCAP_CHUNK.size
    write_uint64(record, size)
    write_uint64(record, size)
    return record
