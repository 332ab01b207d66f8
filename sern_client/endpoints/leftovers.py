"""Finishes recordings that a killed process left behind: everything up to the last whole chunk becomes readable.

A recording grows as `<name>.active` (bag_files.py) in whole chunks, and its index is written at the end. `finish`
reads the chunks, cuts off what is not whole, writes the index in place and gives the file a name of its own. Nothing is
copied and no file is deleted: what cannot be read is moved aside as `<name>.broken`.
"""

import errno
import fcntl
import os
import struct
from collections import defaultdict
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag1.writer import WriteChunk
from rosbags.rosbag2 import ReaderError, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.storage_mcap import (
    Channel,
    McapWriter,
    PendingChunk,
    Schema,
    get_qos,
    read_string,
    write_record,
    write_string,
    write_uint16,
    write_uint32,
    write_uint64,
)

from sern_core.errors import ConfigError
from sern_core.types import Encoding
from sern_runtime import ros_types

ACTIVE: Final = ".active"
MAX_TIME: Final = 2**63 - 1
_BAG_MAGIC: Final = b"#ROSBAG V2.0\n"
_BAG_HEADER_BYTES: Final = 4096
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_MAX_NUMBER: Final = 10_000
_U32: Final = struct.Struct("<I")
_U64: Final = struct.Struct("<Q")
_TIME: Final = struct.Struct("<II")
_CHUNK_TIMES: Final = struct.Struct("<QQQI")
_MCAP_RECORD: Final = struct.Struct("<BQ")
_UNREADABLE: Final = (EOFError, ValueError, KeyError, IndexError, struct.error, ReaderError, ConfigError)
"""What bytes that are no record of theirs raise here."""


class Finished(NamedTuple):
    """What became of a leftover: where it is now, and how many messages it holds (None: it could not be read, why)."""

    path: Path
    messages: int | None
    problem: str = ""


class _BadFileError(Exception):
    """One line: why nothing of a file can be read."""


def in_use(active: Path) -> bool:
    """Whether a living process is recording there: it holds a lock on the file that grows."""
    try:
        handle = lock(_growing(active))
    except BlockingIOError:
        return True
    except OSError:
        return False  # no such file, or a file system without locks
    os.close(handle)
    return False


def lock(path: Path) -> int:
    """A descriptor that says that `path` is in use until it is closed. BlockingIOError when another says so."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise
    return handle


def _growing(active: Path) -> Path:
    """The file itself: rosbags makes a folder around an MCAP file."""
    if not active.is_dir():
        return active
    return next(active.glob("*.mcap"), active / f"{active.name}.mcap")


def put_aside(active: Path) -> Path:
    """Give what is left as `<name>.active` another such name, to be finished later. Returns it. OSError as `finish`."""
    aside = _free(active.with_suffix(""), first=1, suffix=ACTIVE)
    active.replace(aside)
    return aside


def finish(active: Path, *, spare: bool = False) -> Finished:
    """Finish `<name>.active` and give it a free name of its own, or move it aside. `spare`: <name> itself is for
    another recording, take the next one. OSError where the disk refuses, ConfigError for a file of another name."""
    if active.suffix != ACTIVE:
        raise ConfigError("is not a recording that was left unfinished; those end in .active", file=str(active))
    name = active.with_suffix("")
    try:
        if active.is_dir():
            messages = _finish_mcap(_growing(active), active)
            target = _free(name, first=int(spare))
            _growing(active).replace(target)
            _remove_folder(active)
        else:
            messages = _finish_bag(active)
            target = _free(name, first=int(spare))
            active.replace(target)
    except (_BadFileError, FileNotFoundError) as error:
        aside = _free(active.with_name(f"{name.name}.broken"))
        active.replace(aside)
        return Finished(aside, None, "there is no file in it" if isinstance(error, OSError) else str(error))
    return Finished(target, messages)


def _free(path: Path, *, first: int = 0, suffix: str = "") -> Path:
    """`path` with `suffix`, with a number before its own suffix where that is taken: run.bag, run.1.bag, run.2.bag."""
    for number in range(first, _MAX_NUMBER):
        name = path.name if not number else f"{path.stem}.{number}{path.suffix}"
        candidate = path.with_name(name + suffix)
        if not candidate.exists():
            return candidate
    raise FileExistsError(errno.EEXIST, f"{_MAX_NUMBER} files of that name exist already", str(path))


def _remove_folder(folder: Path) -> None:
    """The folder that rosbags made, and its own files only."""
    for name in ("metadata.yaml", "metadata.yaml.tmp"):
        (folder / name).unlink(missing_ok=True)
    folder.rmdir()


# --- ROS 1 bags -------------------------------------------------------------------------------------------------------


def _finish_bag(path: Path) -> int:
    with path.open("r+b") as file:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(_BAG_MAGIC)) != _BAG_MAGIC:
            raise _BadFileError("it is not a ROS 1 bag" if size else "it is empty")
        writer = Writer1(path.with_name(path.name + ".none"))
        writer.bio = file
        writer.chunks = []
        messages = 0
        try:
            header, _ = _bag_record(file, size)
            complete = _U64.unpack(header["index_pos"])[0] > 0
        except _UNREADABLE:
            raise _BadFileError("its header is damaged") from None
        position = len(_BAG_MAGIC) + _BAG_HEADER_BYTES
        connections: dict[int, Connection] = {}
        try:
            while position < size:
                file.seek(position)
                header, body = _bag_record(file, size)
                if header["op"] != b"\x05" or header["compression"] != b"none":
                    break
                chunk, new = _bag_chunk(position, body, writer)
                after_chunk = file.tell()
                position, indexed = _bag_index(file, size, chunk)
                connections |= {c.id: c for c in new if c.id not in connections}
                writer.chunks.append(chunk)
                messages += sum(map(len, chunk.connections.values()))
                if not indexed:  # cut off in the middle of the chunk's index: write that again
                    position = after_chunk
                    file.seek(position)
                    position = _write_bag_index(file, chunk)
                    break
        except _UNREADABLE:
            pass  # what follows is not whole
        if complete:
            return messages
        file.truncate(position)
        file.seek(position)
        for chunk in writer.chunks:
            chunk.connections = {cid: entries for cid, entries in chunk.connections.items() if entries}
        writer.connections = list(connections.values())
        writer.close()
        return messages


def _bag_record(file: BinaryIO, size: int) -> tuple[dict[str, bytes], bytes]:
    """(header fields, data) of the record at hand. EOFError when the file ends before it does."""
    header = _fields(_exact(file, _U32.unpack(_exact(file, 4, size))[0], size))
    return header, _exact(file, _U32.unpack(_exact(file, 4, size))[0], size)


def _exact(file: BinaryIO, count: int, size: int) -> bytes:
    if file.tell() + count > size:
        raise EOFError
    data = file.read(count)
    if len(data) < count:
        raise EOFError
    return data


def _fields(data: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(data):
        length = _U32.unpack_from(data, position)[0]
        name, equals, value = data[position + 4 : position + 4 + length].partition(b"=")
        if not equals:
            raise ValueError("a header field without a value")
        fields[name.decode()] = value
        position += 4 + length
    return fields


def _bag_chunk(position: int, body: bytes, owner: Writer1) -> tuple[WriteChunk, list[Connection]]:
    chunk = WriteChunk(BytesIO(), position, MAX_TIME, 0, defaultdict(list))
    connections: list[Connection] = []
    inner = BytesIO(body)
    while inner.tell() < len(body):
        offset = inner.tell()
        header, data = _bag_record(inner, len(body))
        number = _U32.unpack(header["conn"])[0]
        if header["op"] == b"\x07":
            fields = _fields(data)
            latching = fields.get("latching")
            extension = ConnectionExtRosbag1(
                fields["callerid"].decode() if "callerid" in fields else None,
                None if latching is None else int(latching),
            )
            definition = MessageDefinition(MessageDefinitionFormat.MSG, fields["message_definition"].decode())
            type_name = ros_types.canonical(fields["type"].decode())
            topic, digest = header["topic"].decode(), fields["md5sum"].decode()
            connections.append(Connection(number, topic, type_name, definition, digest, -1, extension, owner))
        elif header["op"] == b"\x02":
            seconds, nanoseconds = _TIME.unpack(header["time"])
            stamp_ns = seconds * 10**9 + nanoseconds
            chunk.start, chunk.end = min(chunk.start, stamp_ns), max(chunk.end, stamp_ns)
            chunk.connections[number].append((stamp_ns, offset))
    return chunk, connections


def _bag_index(file: BinaryIO, size: int, chunk: WriteChunk) -> tuple[int, bool]:
    """(position behind the index records of a chunk, whether they are all there)."""
    left = {number for number, entries in chunk.connections.items() if entries}
    position = file.tell()
    while left:
        try:
            header, _ = _bag_record(file, size)
            if header["op"] != b"\x04":
                return position, False
            left.discard(_U32.unpack(header["conn"])[0])
        except _UNREADABLE:
            return position, False
        position = file.tell()
    return position, True


def _write_bag_index(file: BinaryIO, chunk: WriteChunk) -> int:
    for number, entries in chunk.connections.items():
        if entries:
            conn, count = _U32.pack(number), _U32.pack(len(entries))
            values = (b"op=\x04", b"ver=" + _U32.pack(1), b"conn=" + conn, b"count=" + count)
            header = b"".join(_U32.pack(len(value)) + value for value in values)
            file.write(_U32.pack(len(header)) + header + _U32.pack(12 * len(entries)))
            for stamp_ns, offset in entries:
                file.write(_TIME.pack(*divmod(stamp_ns, 10**9)) + _U32.pack(offset))
    return file.tell()


# --- MCAP -------------------------------------------------------------------------------------------------------------


class _Scan:
    """What the whole chunks of an MCAP file hold."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[BytesIO] = []
        self.counts: dict[int, int] = {}
        self.start_ns, self.end_ns = MAX_TIME, 0

    def chunk(self, body: bytes) -> dict[int, list[tuple[int, int]]]:
        """Take in a chunk record; its messages by channel, as (time, offset)."""
        start_ns, end_ns, _size, _crc = _CHUNK_TIMES.unpack_from(body)
        source = BytesIO(body)
        source.seek(_CHUNK_TIMES.size)
        if read_string(source):
            raise ValueError("it is compressed")
        records = body[source.tell() + 8 :]
        entries: dict[int, list[tuple[int, int]]] = {}
        for offset, op, data in _mcap_records(records):
            if op == 0x03:
                inner = BytesIO(data)
                number = int.from_bytes(inner.read(2), "little")
                schema = Schema(number, read_string(inner), read_string(inner), read_string(inner))
                self.schemas.setdefault(number, schema)
            elif op == 0x04:
                inner = BytesIO(data)
                number, of = int.from_bytes(inner.read(2), "little"), int.from_bytes(inner.read(2), "little")
                topic, encoding = read_string(inner), read_string(inner)
                metadata = inner.read()[4:]
                self.channels.setdefault(number, Channel(number, self.schemas[of].name, topic, encoding, metadata))
            elif op == 0x05:
                number, stamp_ns = int.from_bytes(data[:2], "little"), _U64.unpack_from(data, 6)[0]
                if number not in self.channels:
                    raise ValueError("a message of no channel")
                entries.setdefault(number, []).append((stamp_ns, offset))
        for number, found in entries.items():
            self.counts[number] = self.counts.get(number, 0) + len(found)
        if entries:
            self.start_ns, self.end_ns = min(self.start_ns, start_ns), max(self.end_ns, end_ns)
        return entries


def _mcap_records(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """(offset, opcode, content) of every record; EOFError when the last one is not whole."""
    position = 0
    while position < len(data):
        if position + _MCAP_RECORD.size > len(data):
            raise EOFError
        op, length = _MCAP_RECORD.unpack_from(data, position)
        begin = position + _MCAP_RECORD.size
        if begin + length > len(data):
            raise EOFError
        yield position, op, data[begin : begin + length]
        position = begin + length


def _mcap_record(file: BinaryIO, size: int) -> tuple[int, bytes]:
    op, length = _MCAP_RECORD.unpack(_exact(file, _MCAP_RECORD.size, size))
    return op, _exact(file, length, size)


def _finish_mcap(path: Path, folder: Path) -> int:
    with path.open("r+b") as file:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise _BadFileError("it is not an MCAP file" if size else "it is empty")
        scan = _Scan()
        complete = False
        try:
            _mcap_record(file, size)
        except _UNREADABLE:
            raise _BadFileError("its header is damaged") from None
        position = file.tell()
        try:
            while position < size:
                begin = position
                op, body = _mcap_record(file, size)
                if op == 0x0C:
                    complete = _ends_whole(file, size)
                if op != 0x06:
                    break
                entries = scan.chunk(body)
                behind = file.tell()
                position = _mcap_index(file, size, behind, entries)
                scan.chunks.append(_chunk_index(body, begin, behind, position, entries))
        except _UNREADABLE:
            pass  # what follows is not whole
        if not complete:
            file.truncate(position)
            file.seek(position)
            _end_mcap(file, path, folder, scan)
        return sum(scan.counts.values())


def _ends_whole(file: BinaryIO, size: int) -> bool:
    """Whether the file was finished, and only its name is missing."""
    file.seek(size - len(_MCAP_MAGIC))
    return file.read() == _MCAP_MAGIC


def _mcap_index(file: BinaryIO, size: int, behind: int, entries: dict[int, list[tuple[int, int]]]) -> int:
    """The position behind the index records of a chunk; they are written again where they are not all there."""
    left = set(entries)
    position = behind
    try:
        while left:
            op, body = _mcap_record(file, size)
            if op != 0x07:
                break
            left.discard(int.from_bytes(body[:2], "little"))
            position = file.tell()
    except EOFError:
        pass
    if not left:
        return position
    file.seek(behind)
    file.truncate()
    for number, found in entries.items():
        record = BytesIO()
        write_uint16(record, number)
        write_uint32(record, len(found) * 16)
        for stamp_ns, offset in found:
            write_uint64(record, stamp_ns)
            write_uint64(record, offset)
        write_record(file, 0x07, record)
    return file.tell()


def _chunk_index(body: bytes, begin: int, behind: int, end: int, entries: dict[int, list[tuple[int, int]]]) -> BytesIO:
    start_ns, end_ns, raw_bytes, _crc = _CHUNK_TIMES.unpack_from(body)
    record = BytesIO()
    for value in (start_ns, end_ns, begin, behind - begin):
        write_uint64(record, value)
    write_uint32(record, len(entries) * 10)
    position = behind
    for number, found in entries.items():
        write_uint16(record, number)
        write_uint64(record, position)
        position += _MCAP_RECORD.size + 6 + 16 * len(found)
    write_uint64(record, end - behind)
    write_string(record, "")
    write_uint64(record, raw_bytes)
    write_uint64(record, raw_bytes)
    return record


def _end_mcap(file: BinaryIO, path: Path, folder: Path, scan: _Scan) -> None:
    """Write what comes behind the chunks, as the writer would have."""
    storage = McapWriter.__new__(McapWriter)
    storage.path = path
    storage.bio = file  # type: ignore[assignment]
    storage.schemas, storage.channels = list(scan.schemas.values()), list(scan.channels.values())
    storage.chunks = scan.chunks
    storage.chunk = PendingChunk(MAX_TIME, 0, BytesIO(), defaultdict(list))
    storage.compression, storage.compressor = "", bytes
    storage.message_start_time, storage.message_end_time = scan.start_ns, scan.end_ns
    storage.channel_stats = {number: scan.counts.get(number, 0) for number in scan.channels}
    writer = Writer2(folder / "none", version=Writer2.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
    writer.metapath = folder / "metadata.yaml"
    writer.storage = storage
    writer.counts = storage.channel_stats
    writer.min_timestamp, writer.max_timestamp = scan.start_ns, scan.end_ns
    schemas = {schema.name: schema for schema in scan.schemas.values()}
    for channel in scan.channels.values():
        definition = schemas[channel.schema].data
        extension = ConnectionExtRosbag2(channel.message_encoding, get_qos(channel.metadata))
        writer.connections.append(
            Connection(
                channel.id,
                channel.topic,
                channel.schema,
                MessageDefinition(MessageDefinitionFormat.MSG, definition),
                _hash_of(channel.schema, definition),
                0,
                extension,
                writer,
            )
        )
    writer.close()


def _hash_of(type_name: str, definition: str) -> str:
    """Empty for a type that cannot be read: the file says of it what it said before."""
    try:
        return ros_types.hash_of(type_name, definition, Encoding.CDR)
    except ConfigError:
        return ""
