"""One file of kept messages: MCAP without chunks, so that what was flushed is whole whatever happens then.

A channel is a topic of one process of its origin, with who that is in its metadata; `sequence` of a message is the low
half of its seq, `log_time` and `publish_time` are the stamp with which the endpoint took it. Each message is followed
by a record of ours with its CRC-32, which other readers of MCAP skip: without chunks the format has no checksum. A
finished file ends with an index of ours as metadata. One that was cut off (power, kill -9, a full disk) is read to
where it is whole.
"""

import json
import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from sern_core.site.runs import Run
from sern_core.vocabulary.message import StreamId, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName

LIBRARY: Final = "sern"
INDEX: Final = "sern.spool"
"""The name of the metadata with the index."""
MARK_BYTES: Final = 128 * 2**10
"""How far apart the places are of which the index knows which message is there."""
MAX_STAMP_NS: Final = 2**63 - 1
MAX_RECORD_BYTES: Final = 2**30
CHECK: Final = struct.Struct("<BQI")
"""The record behind a message: opcode, length of what follows, CRC-32 of channel, sequence, stamp and body."""
CHECK_OPCODE: Final = 0x80
"""MCAP keeps the opcodes from here on for records of applications."""
CHECK_LENGTH: Final = CHECK.size - 9
CHECKED: Final = struct.Struct("<HIQ")
RECORD_BYTES: Final = 31 + CHECK.size
"""What a message takes in the file beside its body."""
_SCHEMAS: Final = {Encoding.ROS1: ("ros1", "ros1msg"), Encoding.CDR: ("cdr", "ros2msg")}
_ENCODINGS: Final = {words[0]: encoding for encoding, words in _SCHEMAS.items()}
UNREADABLE: Final = (McapError, struct.error, ValueError, KeyError, TypeError, EOFError, MemoryError, OverflowError)
"""What reading bytes that are no MCAP, or no file of ours, may raise. OSError is the disk's."""


class KeptStream(NamedTuple):
    """A stream of which messages are kept: `info` under its global name (a site's: as it is recorded there)."""

    id: StreamId
    info: TopicInfo

    @property
    def key(self) -> tuple[object, ...]:
        return self.id, self.info.type_name, self.info.type_hash, self.info.encoding


class Kept(NamedTuple):
    """A message to keep, or as it was kept."""

    stream: KeptStream
    seq: int
    stamp_ns: int
    body: bytes

    @property
    def cost_bytes(self) -> int:
        return len(self.body) + RECORD_BYTES


@dataclass(slots=True)
class Content:
    """What a file holds of one stream. `marks`: now and then a seq, and where in the file it stands; both rise, if
    seqs were put in order."""

    stream: KeptStream
    first: int
    last: int
    first_ns: int
    last_ns: int
    messages: int = 0
    nbytes: int = 0
    marks: list[tuple[int, int]] = field(default_factory=list)

    def add(self, seq: int, stamp_ns: int, size_bytes: int, offset: int) -> None:
        self.first, self.last = min(self.first, seq), max(self.last, seq)
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        self.messages += 1
        self.nbytes += size_bytes
        if not self.marks or offset - self.marks[-1][1] >= MARK_BYTES:
            self.marks.append((seq, offset))

    def offset(self, seq: int) -> int:
        """The place in the file from which to look for a seq."""
        index = bisect_right(self.marks, seq, key=lambda mark: mark[0]) - 1
        return self.marks[max(index, 0)][1]


class FileIndex:
    """What a file holds. `problem`: why not all of it can be read; None: it can."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size_bytes = 0
        self.contents: dict[int, Content] = {}
        """What there is of each channel."""
        self.problem: str | None = None

    @property
    def messages(self) -> int:
        return sum(content.messages for content in self.contents.values())

    def to_json(self) -> str:
        return json.dumps({str(number): _row(content) for number, content in self.contents.items()})


def _crc(channel: int, sequence: int, stamp_ns: int, body: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(CHECKED.pack(channel, sequence, stamp_ns)))


def _row(content: Content) -> list[object]:
    return [
        content.first, content.last, content.first_ns, content.last_ns, content.messages, content.nbytes, content.marks,
    ]  # fmt: skip


class GrowingFile:
    """A file that messages are added to. What is added is safe (from the end of this process) after `flush`. Every
    method may raise OSError; then call `abandon`: the file ends with what was flushed."""

    def __init__(self, path: Path) -> None:
        """FileExistsError where there is one."""
        self.index = FileIndex(path)
        self._file: IO[bytes] = path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.NONE, use_chunking=False)
        self._writer.start("", LIBRARY)
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, str], int] = {}
        self._new: list[tuple[int, Kept, int]] = []  # channel, message, offset: not flushed
        self.messages = 0
        """Messages in it, flushed or not."""

    @property
    def path(self) -> Path:
        return self.index.path

    @property
    def size_bytes(self) -> int:
        """What it has come to, flushed or not."""
        return self._file.tell()

    @property
    def unflushed(self) -> list[Kept]:
        return [kept for _channel, kept, _offset in self._new]

    def add(self, kept: Kept) -> None:
        channel = self._channel(kept.stream, kept.seq >> 32)
        offset = self._file.tell()
        stamp_ns = min(max(kept.stamp_ns, 0), MAX_STAMP_NS)
        sequence = kept.seq & 0xFFFFFFFF
        self._writer.add_message(channel, stamp_ns, kept.body, stamp_ns, sequence)
        self._file.write(CHECK.pack(CHECK_OPCODE, CHECK_LENGTH, _crc(channel, sequence, stamp_ns, kept.body)))
        self._new.append((channel, kept, offset))
        self.messages += 1

    def _channel(self, stream: KeptStream, high: int) -> int:
        key = (*stream.key, high)
        channel = self._channels.get(key)
        if channel is None:
            info = stream.info
            encoding, language = _SCHEMAS[info.encoding]
            schema_key = (info.type_name, language, info.definition)
            schema = self._schemas.get(schema_key)
            if schema is None:
                schema = self._writer.register_schema(info.type_name, language, info.definition.encode())
                self._schemas[schema_key] = schema
            about = {
                "origin": stream.id.origin,
                "boot": str(stream.id.boot),
                "high": str(high),
                "hash": info.type_hash,
                "latched": str(int(info.latched)),
                "reliable": "" if info.reliable is None else str(int(info.reliable)),
            }
            channel = self._channels[key] = self._writer.register_channel(info.name, encoding, schema, about)
        return channel

    def flush(self) -> list[Kept]:
        """Returns what is safe now, and was not before."""
        self._file.flush()
        new, self._new = self._new, []
        contents = self.index.contents
        for channel, kept, offset in new:
            content = contents.get(channel)
            if content is None:
                seq, stamp_ns = kept.seq, kept.stamp_ns
                content = contents[channel] = Content(kept.stream, seq, seq, stamp_ns, stamp_ns)
            content.add(kept.seq, kept.stamp_ns, len(kept.body), offset)
        self.index.size_bytes = self._file.tell()
        return [kept for _channel, kept, _offset in new]

    def finish(self) -> list[Kept]:
        """Flush, write the index and close. Returns as `flush` does."""
        safe = self.flush()
        self._writer.add_metadata(INDEX, {"index": self.index.to_json()})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self.index.size_bytes = self._file.tell()
        self._file.close()
        return safe

    def abandon(self) -> list[Kept]:
        """Close it as it is. Returns what was added and is not safe."""
        lost, self._new = self.unflushed, []
        with suppress(OSError):  # what could not be written is lost, and the descriptor is closed all the same
            self._file.close()
        return lost


def read_index(path: Path) -> FileIndex:
    """What a file holds, from its own index or by reading all of it. Raises OSError; what cannot be read, or is no file
    of ours, is the index's `problem`."""
    index = FileIndex(path)
    with path.open("rb") as file:
        index.size_bytes = file.seek(0, os.SEEK_END)
        file.seek(0)
        try:
            if not _from_metadata(file, index):
                index.problem = "it has no index"
        except (OSError, *UNREADABLE) as error:  # it may seek to where nothing is; what the disk has is read below
            index.problem = str(error) or type(error).__name__
        if index.problem is not None:
            index.contents.clear()
            file.seek(0)
            index.problem = None
            try:
                _from_messages(file, index)
            except UNREADABLE as error:
                index.problem = str(error) or type(error).__name__
    return index


def _from_metadata(file: IO[bytes], index: FileIndex) -> bool:
    reader = make_reader(file)
    summary = reader.get_summary()
    found = next((meta for meta in reader.iter_metadata() if meta.name == INDEX), None)
    if summary is None or found is None:
        return False
    for text, row in json.loads(found.metadata["index"]).items():
        channel = summary.channels[int(text)]
        first, last, first_ns, last_ns, messages, nbytes, marks = row
        stream = stream_of(channel, summary.schemas[channel.schema_id])
        places = [(int(seq), int(offset)) for seq, offset in marks]
        index.contents[int(text)] = Content(
            stream, int(first), int(last), int(first_ns), int(last_ns), int(messages), int(nbytes), places
        )
    return True


def _from_messages(file: IO[bytes], index: FileIndex) -> None:
    contents = index.contents
    for seq, message, stream, offset, whole in messages_of(file):
        if not whole:
            continue
        content = contents.get(message.channel_id)
        if content is None:
            stamp_ns = message.log_time
            content = contents[message.channel_id] = Content(stream, seq, seq, stamp_ns, stamp_ns)
        content.add(seq, message.log_time, len(message.data), offset)


def stream_of(channel: Channel, schema: Schema) -> KeptStream:
    """Raises KeyError or ValueError where it is not one of ours."""
    about = channel.metadata
    info = TopicInfo(
        TopicName(channel.topic),
        schema.name,
        _ENCODINGS[channel.message_encoding],
        about["hash"],
        schema.data.decode(),
        about["latched"] == "1",
        None if about["reliable"] == "" else about["reliable"] == "1",
    )
    return KeptStream(StreamId(ClientName(about["origin"]), int(about["boot"]), TopicName(channel.topic)), info)


def _records(file: IO[bytes], *, skip_magic: bool) -> Iterator[tuple[McapRecord, int, bool]]:
    """The records from here on, each with where it begins, and whether a message is as it was written. Ends at the
    footer or the end of the file; raises one of UNREADABLE for what is none."""
    offset = file.tell() + (0 if skip_magic else 8)
    for record in StreamReader(file, skip_magic=skip_magic, record_size_limit=MAX_RECORD_BYTES).records:
        yield record, offset, not isinstance(record, McapMessage) or _as_written(file, record)
        offset = file.tell()


def _as_written(file: IO[bytes], message: McapMessage) -> bool:
    """Read the record behind a message. ValueError where there is none: the message itself may not be what it seems."""
    found = file.read(CHECK.size)
    if len(found) < CHECK.size:
        raise ValueError("it is cut off")
    opcode, length, crc = CHECK.unpack(found)
    if (opcode, length) != (CHECK_OPCODE, CHECK_LENGTH):
        raise ValueError(f"no checksum follows the message before {file.tell() - CHECK.size}")
    return bool(crc == _crc(message.channel_id, message.sequence, message.log_time, message.data))


class FoundMessage(NamedTuple):
    """A message of a file; it stands at `offset`. `whole`: as it was written."""

    seq: int
    message: McapMessage
    stream: KeptStream
    offset: int
    whole: bool


def messages_of(file: IO[bytes]) -> Iterator[FoundMessage]:
    """All messages of a file, from its beginning. Raises one of UNREADABLE where it is not whole."""
    schemas: dict[int, Schema] = {}
    streams: dict[int, tuple[KeptStream, int]] = {}
    for record, offset, whole in _records(file, skip_magic=False):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            streams[record.id] = stream_of(record, schemas[record.schema_id]), int(record.metadata["high"]) << 32
        elif isinstance(record, McapMessage):
            stream, high = streams[record.channel_id]
            yield FoundMessage(high | record.sequence, record, stream, offset, whole)


def message_at(file: IO[bytes], offset: int) -> McapMessage | None:
    """The message at an offset that `messages_of` has named; None: it is not there any more. Raises OSError."""
    file.seek(offset)
    try:
        record, _offset, whole = next(_records(file, skip_magic=True))
    except (StopIteration, *UNREADABLE):
        return None
    return record if isinstance(record, McapMessage) and whole else None


def read_runs(index: FileIndex, channel: int, runs: Sequence[Run]) -> Iterator[FoundMessage]:
    """The messages of a channel whose seqs are in rising `runs`, in order. Raises OSError or one of UNREADABLE."""
    content = index.contents[channel]
    high = content.first >> 32 << 32
    wanted = [
        (max(a, content.first), min(b, content.last)) for a, b in runs if a <= content.last and b >= content.first
    ]
    if not wanted:
        return
    with index.path.open("rb") as file:
        for first, last in wanted:
            offset = content.offset(first)
            if file.tell() <= offset or file.tell() == 0:
                file.seek(offset)
            for record, at, whole in _records(file, skip_magic=True):
                if at >= index.size_bytes:
                    break
                if not isinstance(record, McapMessage) or record.channel_id != channel:
                    continue
                seq = high | record.sequence
                if seq >= first and seq <= last:
                    yield FoundMessage(seq, record, content.stream, at, whole)
                if seq >= last:
                    break
