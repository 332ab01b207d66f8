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
)

from sern_client.endpoints.bag_index import (
    MCAP_CHUNK,
    MCAP_RECORD,
    SchemaName,
    bag_chunk_head,
    mcap_chunk_head,
    mcap_chunk_index,
    write_bag_index,
    write_mcap_index,
)
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
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
_BAG_HEAD_BYTES: Final = len(bag_chunk_head(0))
_BAG_TAIL: Final = frozenset({2, 4, 6, 7})
_MCAP_TAIL: Final = frozenset({2, 3, 4, 5, 7, 8, 11, 12, 13, 14, 15})
"""Records that may stand behind the last whole chunk of a recording of ours."""
_MAX_TAIL_BYTES: Final = 4096
"""Most bytes there that are not even the beginning of a record."""
_FLOCK: Final = struct.Struct("hhqqi0q")
"""The kernel's struct flock: kind, whence, start, length, process."""
_WHOLE_FILE: Final = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
_UNREADABLE: Final = (EOFError, ValueError, KeyError, IndexError, struct.error, ReaderError, ConfigError)
"""What reading raises for bytes that are no record."""


class Finished(NamedTuple):
    """What became of a leftover: where it is now, and how many messages it holds (None: it could not be read, why)."""

    path: Path
    messages: int | None
    problem: str = ""


class _BadFileError(Exception):
    """One line: why nothing of a file can be read."""


def in_use(active: Path) -> bool:
    """Whether a living process is recording there: it holds a lock on the file that grows.

    To ask takes no lock: a recording that begins just now would find its own file locked.
    """
    try:
        handle = os.open(_growing(active), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False  # no such file
    try:
        found = _FLOCK.unpack(fcntl.fcntl(handle, fcntl.F_OFD_GETLK, _WHOLE_FILE))
    except OSError:
        return False  # a file system without locks
    finally:
        os.close(handle)
    return bool(found[0] != fcntl.F_UNLCK)


def lock(path: Path) -> int:
    """A descriptor that says that `path` is in use until it is closed. BlockingIOError when another says so."""
    handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.fcntl(handle, fcntl.F_OFD_SETLK, _WHOLE_FILE)
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
        while position < size:
            file.seek(position)
            head = file.read(_BAG_HEAD_BYTES)
            length = _U32.unpack(head[-4:])[0] if len(head) == _BAG_HEAD_BYTES else 0
            if not length or head != bag_chunk_head(length):
                _check_tail(
                    path, position, size, _bag_op(file, position + (head == bag_chunk_head(0)) * len(head), size)
                )
                break
            chunk, new, whole = _bag_chunk(position, file.read(length), writer)
            behind = position + len(head) + whole
            if whole < length:
                _check_end(path, behind, position + len(head) + length, size)
                file.seek(position)
                file.write(bag_chunk_head(whole))
            connections |= {c.id: c for c in new if c.id not in connections}
            writer.chunks.append(chunk)
            messages += sum(map(len, chunk.connections.values()))
            file.seek(behind)
            indexed = _bag_index(file, size, chunk) if whole == length else None
            if indexed is None:  # cut off in the chunk or its index
                file.seek(behind)
                write_bag_index(file, chunk.connections)
                position = file.tell()
                break
            position = indexed
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


def _bag_chunk(position: int, body: bytes, owner: Writer1) -> tuple[WriteChunk, list[Connection], int]:
    """What the chunk at `position` holds, its connections, and how many of its bytes are whole records."""
    chunk = WriteChunk(BytesIO(), position, MAX_TIME, 0, defaultdict(list))
    connections: list[Connection] = []
    inner = BytesIO(body)
    offset = 0
    try:
        while offset < len(body):
            header, data = _bag_record(inner, len(body))
            number = _U32.unpack(header["conn"])[0]
            if header["op"] == b"\x07":
                connections.append(_bag_connection(number, header["topic"].decode(), _fields(data), owner))
            elif header["op"] == b"\x02":
                seconds, nanoseconds = _TIME.unpack(header["time"])
                stamp_ns = seconds * 10**9 + nanoseconds
                chunk.start, chunk.end = min(chunk.start, stamp_ns), max(chunk.end, stamp_ns)
                chunk.connections[number].append((stamp_ns, offset))
            else:
                break
            offset = inner.tell()
    except _UNREADABLE:
        pass  # the rest is not whole
    return chunk, connections, offset


def _bag_connection(number: int, topic: str, fields: dict[str, bytes], owner: Writer1) -> Connection:
    latching = fields.get("latching")
    extension = ConnectionExtRosbag1(
        fields["callerid"].decode() if "callerid" in fields else None, None if latching is None else int(latching)
    )
    definition = MessageDefinition(MessageDefinitionFormat.MSG, fields["message_definition"].decode())
    type_name = ros_types.canonical(fields["type"].decode())
    return Connection(number, topic, type_name, definition, fields["md5sum"].decode(), -1, extension, owner)


def _bag_op(file: BinaryIO, position: int, size: int) -> int | None:
    """What kind of record stands there; None where that cannot be told."""
    file.seek(position)
    try:
        return _fields(_exact(file, _U32.unpack(_exact(file, 4, size))[0], size))["op"][0]
    except _UNREADABLE:
        return None


def _check_tail(path: Path, position: int, size: int, op: int | None) -> None:
    """What stands behind the last chunk is cut off only if it is ours: content that its head does not count yet, or
    the beginning of the index of the whole file."""
    ours = _BAG_TAIL if path.suffix == ACTIVE else _MCAP_TAIL
    if op not in ours if op is not None else size - position > _MAX_TAIL_BYTES:
        raise _BadFileError(f"at byte {position} stands what SERN does not write; it may be another program's")


def _check_end(path: Path, whole: int, end: int, size: int) -> None:
    """A damaged chunk is cut back only if it is the last thing in the file."""
    if end < size:
        raise _BadFileError(f"it is damaged at byte {whole}, and more follows")


def _bag_index(file: BinaryIO, size: int, chunk: WriteChunk) -> int | None:
    """The position behind the index records of a chunk; None when they are not all there."""
    left = {number for number, entries in chunk.connections.items() if entries}
    try:
        while left:
            header, _ = _bag_record(file, size)
            if header["op"] != b"\x04":
                return None
            left.discard(_U32.unpack(header["conn"])[0])
    except _UNREADABLE:
        return None
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

    def chunk(self, records: bytes) -> tuple[dict[int, list[tuple[int, int]]], int]:
        """Take in the content of a chunk: its messages by channel, as (time, offset), and how many of its bytes are
        whole records."""
        entries: dict[int, list[tuple[int, int]]] = {}
        offset = 0
        try:
            while offset < len(records):
                op, length = MCAP_RECORD.unpack_from(records, offset)
                begin = offset + MCAP_RECORD.size
                data = records[begin : begin + length]
                if len(data) < length or not self._record(op, data, offset, entries):
                    break
                offset = begin + length
        except _UNREADABLE:
            pass  # the rest is not whole
        for number, found in entries.items():
            self.counts[number] = self.counts.get(number, 0) + len(found)
            self.start_ns = min(self.start_ns, *(stamp_ns for stamp_ns, _ in found))
            self.end_ns = max(self.end_ns, *(stamp_ns for stamp_ns, _ in found))
        return entries, offset

    def _record(self, op: int, data: bytes, offset: int, entries: dict[int, list[tuple[int, int]]]) -> bool:
        """Take in one record of a chunk. False for one that no chunk of ours holds."""
        inner = BytesIO(data)
        number = int.from_bytes(inner.read(2), "little")
        if op == 0x03:
            schema = Schema(number, SchemaName(read_string(inner)), read_string(inner), read_string(inner))
            self.schemas.setdefault(number, schema)
        elif op == 0x04:
            of = int.from_bytes(inner.read(2), "little")
            topic, encoding = read_string(inner), read_string(inner)
            self.channels.setdefault(number, Channel(number, self.schemas[of].name, topic, encoding, inner.read()[4:]))
        elif op == 0x05 and number in self.channels:
            entries.setdefault(number, []).append((_U64.unpack_from(data, 6)[0], offset))
        else:
            return False
        return True


def _mcap_record(file: BinaryIO, size: int) -> tuple[int, bytes]:
    op, length = MCAP_RECORD.unpack(_exact(file, MCAP_RECORD.size, size))
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
        while position < size:
            begin = position
            file.seek(begin)
            head = file.read(MCAP_CHUNK.size)
            fields = MCAP_CHUNK.unpack(head) if len(head) == MCAP_CHUNK.size else None
            if fields is None or not fields[-1] or head != mcap_chunk_head(fields[2], fields[3], fields[-1]):
                ours = fields is not None and head == mcap_chunk_head(fields[2], fields[3], 0)
                tail = begin + ours * len(head)
                file.seek(tail)
                op = file.read(1)
                complete = op == b"\x0c" and _ends_whole(file, size)
                _check_tail(path, begin, size, op[0] if op else None)
                break
            length = fields[-1]
            entries, whole = scan.chunk(file.read(length))
            times = [stamp_ns for found in entries.values() for stamp_ns, _ in found]
            start_ns, end_ns = min(times, default=fields[2]), max(times, default=fields[3])
            behind = begin + len(head) + whole
            if whole < length:
                _check_end(path, behind, begin + len(head) + length, size)
                file.seek(begin)
                file.write(mcap_chunk_head(start_ns, end_ns, whole))
            file.seek(behind)
            position = _mcap_index(file, size, behind, entries if whole == length else None)
            if position < 0:  # cut off in the chunk or its index
                file.seek(behind)
                file.truncate()
                write_mcap_index(file, entries)
                position = size = file.tell()
            scan.chunks.append(mcap_chunk_index(start_ns, end_ns, begin, behind, entries))
        if not complete:
            file.truncate(position)
            file.seek(position)
            _end_mcap(file, path, folder, scan)
        return sum(scan.counts.values())


def _ends_whole(file: BinaryIO, size: int) -> bool:
    """Whether the file was finished, and only its name is missing."""
    file.seek(size - len(_MCAP_MAGIC))
    return file.read() == _MCAP_MAGIC


def _mcap_index(file: BinaryIO, size: int, behind: int, entries: dict[int, list[tuple[int, int]]] | None) -> int:
    """The position behind the index records of a chunk; -1 when they are not all there, or the chunk is not whole."""
    if entries is None:
        return -1
    left = set(entries)
    try:
        while left:
            op, body = _mcap_record(file, size)
            if op != 0x07:
                return -1
            left.discard(int.from_bytes(body[:2], "little"))
    except EOFError:
        return -1
    return file.tell()


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
        type_name = str(channel.schema)
        definition = schemas[channel.schema].data
        extension = ConnectionExtRosbag2(channel.message_encoding, get_qos(channel.metadata))
        writer.connections.append(
            Connection(
                channel.id,
                channel.topic,
                type_name,
                MessageDefinition(MessageDefinitionFormat.MSG, definition),
                _hash_of(type_name, definition),
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
