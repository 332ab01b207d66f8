"""The two kinds of file a recording is written to, on top of the rosbags writers; used from one thread only.

A file grows as `<name>.active` and takes its name in `finish`. Both formats are written in chunks of about 1 MB, each
with an index behind it. The last one grows in the file with each `flush`: first its content, then its head, which says
how long it is. So what was flushed is safe at any moment: the operating system has it, and leftovers.py reads it when
this process was killed. When the disk refuses, `give_up` cuts the file back to what is safe.
"""

import errno
import logging
import os
import shutil
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BufferedWriter, BytesIO, FileIO
from pathlib import Path
from tempfile import mkdtemp
from typing import BinaryIO, Final, cast

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag1.writer import WriteChunk
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk

from sern_client.endpoints.bag_index import (
    SchemaName,
    bag_chunk_head,
    mcap_chunk_head,
    mcap_chunk_index,
    write_bag_index,
    write_mcap_index,
)
from sern_client.endpoints.leftovers import lock
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName

MAX_TIME: Final = 2**63 - 1
CHUNK_BYTES: Final = 2**20
MAX_TOPIC_CONNECTIONS: Final = 32
"""Connections of one topic: one for each definition of its type, and for each latching and reliability."""
MAX_CONNECTIONS: Final = 10_000
MAX_DEFINITION_BYTES: Final = 64 * 2**20
"""Connections in one file, and bytes of their definitions, each counted once. Both are in memory until its end."""
_LOG = logging.getLogger(__name__)
_NO_LIMIT: Final = QosTime(MAX_TIME // 10**9, MAX_TIME % 10**9)


def active_path(path: Path) -> Path:
    """Where the file grows until it is complete (the custom of `rosbag record`)."""
    return path.with_name(path.name + ".active")


class RecordFile(ABC):
    """One file being recorded. Every method but `give_up` may raise OSError."""

    def __init__(self, path: Path, *, sync: bool = False) -> None:
        """Starts a new file; its active name must be free. `sync`: what is flushed is on the disk, not only in the
        memory of the operating system."""
        self.path = path
        self.active = active_path(path)
        self.full = False
        self.gone = False
        """Somebody has deleted the file."""
        self.sync = sync
        self.messages = 0
        """Messages in the file, safe or not."""
        self._connections: dict[tuple[object, ...], Connection] = {}
        self._per_topic: Counter[TopicName] = Counter()
        self._definitions: dict[str, str] = {}  # each once in memory
        self._definition_bytes = 0
        self._unsafe: Counter[int] = Counter()  # messages per connection since the last flushed chunk
        self._lock: int | None = None  # says that a living process writes here
        self._begin: int | None = None  # where in the file the open chunk begins; None: nothing of it is there
        self._written = 0  # bytes of its content that are there
        self._end = 0  # of what is safe in the file

    @staticmethod
    @abstractmethod
    def key(info: TopicInfo) -> tuple[object, ...]:
        """What makes a connection of its own in this format."""

    def add(self, info: TopicInfo) -> None:
        """Announces a topic; again is harmless. `info` must have a definition and a hash.

        ConfigError for one more connection than a topic or a file may have.
        """
        if self.full or self.key(info) in self._connections:
            return
        if self._per_topic[info.name] >= MAX_TOPIC_CONNECTIONS:
            raise ConfigError(f"the file has {MAX_TOPIC_CONNECTIONS} definitions or qualities of service of it already")
        if len(self._connections) >= MAX_CONNECTIONS:
            raise ConfigError(f"the file has {MAX_CONNECTIONS} topics already")
        definition = self._definitions.get(info.definition)
        if definition is None:
            definition, size = info.definition, len(info.definition.encode())
            if self._definition_bytes + size > MAX_DEFINITION_BYTES:
                raise ConfigError(f"the file has {self._definition_bytes} bytes of definitions already")
            self._definition_bytes += size
            self._definitions[definition] = definition
        info = replace(info, definition=definition)
        self._connections[self.key(info)] = self._connect(info)
        self._per_topic[info.name] += 1

    def knows(self, info: TopicInfo) -> bool:
        """Whether the topic was announced."""
        return self.key(info) in self._connections

    def write(self, info: TopicInfo, stamp_ns: int, body: bytes) -> bool:
        """Add a message. True: with it a chunk was completed, and everything so far is safe."""
        connection = self._connections[self.key(info)]
        self._unsafe[connection.id] += 1
        self.messages += 1
        self._put(connection, stamp_ns, body)
        if self._content().tell() <= CHUNK_BYTES:
            return False
        self._end_chunk()
        self._made_safe()
        return True

    def flush(self) -> None:
        """Make everything so far safe."""
        if self._unsafe and not self.full:
            self._extend()
            self._made_safe()

    def _extend(self) -> None:
        """Bring the open chunk in the file up to date. Its head is changed last: what is killed in between leaves the
        shorter one."""
        content, file = self._content(), self._file()
        size = content.tell()
        if self._begin is None:
            self._begin = self._end
            file.write(self._head(0))
        elif size == self._written:
            return
        with content.getbuffer() as view, view[self._written :] as new:
            file.write(new)
        file.flush()
        head = self._head(size)
        os.pwrite(file.fileno(), head, self._begin)
        self._written = size
        self._end = self._begin + len(head) + size

    def _end_chunk(self) -> None:
        """Write the open chunk and its index, and begin another."""
        self._extend()
        assert self._begin is not None
        file = self._file()
        self._write_index(file)
        file.flush()
        self._chunk_ended(self._begin, self._end)
        self._begin, self._written, self._end = None, 0, file.tell()

    def _made_safe(self) -> None:
        if self.sync:
            os.fsync(self._file().fileno())
        if not os.fstat(self._file().fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "it was deleted while it was being written")
        self._unsafe.clear()

    def _appear(self, made: Path, growing: Path) -> None:
        """Give the new file or folder `made`, in which `growing` grows, its active name, locked.

        Who looks for leftovers never sees it without its lock. FileExistsError when the name is not free.
        """
        try:
            self._file().flush()
            self._end = self._file().tell()
            self._take_lock(growing)
            _move(made, self.active)
        except BaseException:
            self._abandon()
            self._unlock()
            raise

    def _take_lock(self, growing: Path) -> None:
        try:
            self._lock = lock(growing)
        except BlockingIOError:
            raise
        except OSError:
            self._lock = None  # a file system without locks

    def give_up(self) -> int:
        """Cut the file back to what is safe and take no more. Returns how many messages that loses."""
        lost = self._unsafe.total()
        self.full = True
        self.messages -= lost
        if not self._written:
            self._end, self._begin = self._end if self._begin is None else self._begin, None
        self._forget(self._written)
        try:
            self._reopen(self._end)
        except FileNotFoundError:
            self.gone = True
            lost, self.messages = lost + self.messages, 0
        except OSError:
            pass  # then finish fails too, and says so
        self._unsafe.clear()
        return lost

    def finish(self) -> int:
        """Complete the file and give it its name. Returns how many messages were lost on the way (a full disk)."""
        lost = 0
        if self.gone:
            self._abandon()
            self._unlock()
            return 0
        try:
            self._close()
        except OSError:
            lost = self.give_up()
            try:
                self._close()
            except OSError:
                self._abandon()
                self._unlock()
                raise
        try:
            self._take_name()
        finally:
            self._unlock()
        return lost

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @abstractmethod
    def _connect(self, info: TopicInfo) -> Connection: ...

    @abstractmethod
    def _put(self, connection: Connection, stamp_ns: int, body: bytes) -> None: ...

    @abstractmethod
    def _content(self) -> BytesIO:
        """What the open chunk holds; it is at its end."""

    @abstractmethod
    def _file(self) -> BufferedWriter: ...

    @abstractmethod
    def _head(self, size: int) -> bytes:
        """What stands before the open chunk when it holds `size` bytes; always as long."""

    @abstractmethod
    def _write_index(self, file: BufferedWriter) -> None:
        """What stands behind the open chunk."""

    @abstractmethod
    def _chunk_ended(self, begin: int, behind: int) -> None:
        """The open chunk is in the file, from `begin` on, and its index `behind` it: begin another."""

    @abstractmethod
    def _forget(self, size: int) -> None:
        """Leave `size` bytes in the open chunk; `_unsafe` counts the messages behind them."""

    @abstractmethod
    def _reopen(self, size: int) -> None:
        """Cut the file to `size` bytes."""

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _abandon(self) -> None: ...

    @abstractmethod
    def _take_name(self) -> None: ...


class BagFile(RecordFile):
    """A ROS 1 bag, format 2.0."""

    def __init__(self, path: Path, *, sync: bool = False) -> None:
        super().__init__(path, sync=sync)
        with _hidden_folder(self.active) as folder:
            self._writer = Writer1(folder / self.active.name)
            self._writer.open()
            self._appear(self._writer.path, self._writer.path)
        self._writer.path = self.active
        self._writer.chunk_threshold = MAX_TIME  # chunks are ended here

    @staticmethod
    def key(info: TopicInfo) -> tuple[object, ...]:
        return info.name, info.type_name, info.type_hash, info.definition, info.latched

    def _connect(self, info: TopicInfo) -> Connection:
        return self._writer.add_connection(
            info.name,
            info.type_name,
            msgdef=info.definition,
            md5sum=info.type_hash,
            latching=1 if info.latched else None,
        )

    def _put(self, connection: Connection, stamp_ns: int, body: bytes) -> None:
        self._writer.write(connection, stamp_ns, body)

    def _content(self) -> BytesIO:
        return self._writer.chunks[-1].data

    def _file(self) -> BufferedWriter:
        return cast("BufferedWriter", self._writer.bio)

    def _head(self, size: int) -> bytes:
        return bag_chunk_head(size)

    def _write_index(self, file: BufferedWriter) -> None:
        write_bag_index(file, self._writer.chunks[-1].connections)

    def _chunk_ended(self, begin: int, behind: int) -> None:
        chunk = self._writer.chunks[-1]
        chunk.pos = begin
        chunk.data.close()
        # The writer would hold every message's index for ever, but of a written chunk it only needs the counts.
        for connection_id, entries in chunk.connections.items():
            chunk.connections[connection_id] = cast("list[tuple[int, int]]", range(len(entries)))
        self._writer.chunks.append(WriteChunk(BytesIO(), -1, MAX_TIME, 0, defaultdict(list)))

    def _forget(self, size: int) -> None:
        chunk = self._writer.chunks[-1]
        _shorten(chunk.data, size)
        _drop_behind(chunk.connections, size)
        times = [stamp_ns for entries in chunk.connections.values() for stamp_ns, _ in entries]
        chunk.start, chunk.end = min(times, default=MAX_TIME), max(times, default=0)

    def _reopen(self, size: int) -> None:
        self._writer.bio = _cut(self._writer.bio, self.active, size)

    def _close(self) -> None:
        if self._content().tell():
            self._end_chunk()
        self._writer.close()

    def _abandon(self) -> None:
        _discard(self._writer.bio)
        self._writer.bio = None

    def _take_name(self) -> None:
        self.active.replace(self.path)


class McapFile(RecordFile):
    """An MCAP file with the ROS 2 profile. rosbags makes a folder; the file inside becomes `path` in the end."""

    def __init__(self, path: Path, *, sync: bool = False) -> None:
        super().__init__(path, sync=sync)
        with _hidden_folder(self.active) as folder:
            made = folder / self.active.name
            self._writer = Writer2(made, version=Writer2.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
            assert isinstance(self._writer.storage, McapWriter)
            self._storage = self._writer.storage
            self._appear(made, self._storage.path)
        self._writer.path, self._writer.metapath = self.active, self.active / self._writer.metapath.name
        self._storage.path = self.active / self._storage.path.name
        self._storage.close_chunk = _nothing  # type: ignore[method-assign]  # chunks are ended here
        self._schemas: dict[tuple[str, str], SchemaName] = {}  # by type and hash

    @staticmethod
    def key(info: TopicInfo) -> tuple[object, ...]:
        return info.name, info.type_name, info.type_hash, info.latched, info.reliable

    def _connect(self, info: TopicInfo) -> Connection:
        schema = self._schemas.setdefault((info.type_name, info.type_hash), SchemaName(info.type_name))
        connection = self._writer.add_connection(
            info.name, schema, msgdef=info.definition, rihs01=info.type_hash, offered_qos_profiles=[_qos(info)]
        )
        # For the metadata, whose writer takes no other text than a plain one.
        plain = self._writer.connections[-1] = connection._replace(msgtype=info.type_name)
        return plain

    def _put(self, connection: Connection, stamp_ns: int, body: bytes) -> None:
        self._writer.write(connection, stamp_ns, body)

    def _content(self) -> BytesIO:
        return self._storage.chunk.bio

    def _file(self) -> BufferedWriter:
        return self._storage.bio

    def _head(self, size: int) -> bytes:
        chunk = self._storage.chunk
        return mcap_chunk_head(chunk.message_start_time, chunk.message_end_time, size)

    def _write_index(self, file: BufferedWriter) -> None:
        write_mcap_index(file, self._storage.chunk.msgs)

    def _chunk_ended(self, begin: int, behind: int) -> None:
        storage, chunk = self._storage, self._storage.chunk
        times = chunk.message_start_time, chunk.message_end_time
        storage.chunks.append(mcap_chunk_index(*times, begin, behind, chunk.msgs))
        storage.chunk = PendingChunk(MAX_TIME, 0, BytesIO(), defaultdict(list))

    def _forget(self, size: int) -> None:
        storage = self._storage
        _shorten(storage.chunk.bio, size)
        _drop_behind(storage.chunk.msgs, size)
        for connection_id, count in self._unsafe.items():
            storage.channel_stats[connection_id] -= count
            self._writer.counts[connection_id] -= count

    def _reopen(self, size: int) -> None:
        self._storage.bio = _cut(self._storage.bio, self._storage.path, size)

    def _close(self) -> None:
        if self._content().tell():
            self._end_chunk()
        try:
            self._writer.close()
        except OSError:
            if self._writer.storage is not None:
                raise
            # Only the folder's metadata.yaml failed, which a lone .mcap does not have.

    def _abandon(self) -> None:
        _discard(self._storage.bio)

    def _take_name(self) -> None:
        self._storage.path.replace(self.path)
        shutil.rmtree(self.active)


@contextmanager
def _hidden_folder(active: Path) -> Iterator[Path]:
    """A new folder beside `active`, under a name that nobody looks for; it is gone in the end.

    Where it cannot be removed, that is logged, and the file is recorded all the same: NFS, for one, keeps another name
    of an open file in it.
    """
    folder = Path(mkdtemp(prefix=f".{active.name}.", dir=active.parent))
    try:
        yield folder
    finally:
        try:
            shutil.rmtree(folder)
        except OSError as error:
            _LOG.warning("%s cannot be removed (%s)", folder, error.strerror)


def _move(made: Path, target: Path) -> None:
    """Rename a file or folder. FileExistsError when there is something of that name."""
    if not made.is_dir():
        try:
            os.link(made, target)
        except FileExistsError:
            raise
        except OSError:
            pass  # a file system without links
        else:
            made.unlink()
            return
    if target.exists():
        raise FileExistsError(errno.EEXIST, "it exists already", str(target))
    made.rename(target)  # a folder never takes the place of another that holds something


def _cut(old: BinaryIO | None, path: Path, position: int) -> BufferedWriter:
    """A new handle at the end of the file cut to `position`; what the old one could not write is thrown away."""
    _discard(old)
    new: BufferedWriter = BufferedWriter(FileIO(path, "r+"))
    new.truncate(position)
    new.seek(position)
    return new


def _nothing() -> None:
    """Replaces what a writer does by itself."""


def _shorten(content: BytesIO, size: int) -> None:
    content.truncate(size)
    content.seek(size)


def _drop_behind(entries: dict[int, list[tuple[int, int]]], size: int) -> None:
    for connection_id, found in list(entries.items()):
        kept = [entry for entry in found if entry[1] < size]
        if kept:
            entries[connection_id] = kept
        else:
            del entries[connection_id]


def _discard(file: BinaryIO | None) -> None:
    """Close without writing what is buffered, which would only fail again."""
    if isinstance(file, BufferedWriter):
        file.raw.close()


def _qos(info: TopicInfo) -> Qos:
    reliability = {
        None: QosReliability.SYSTEM_DEFAULT,
        True: QosReliability.RELIABLE,
        False: QosReliability.BEST_EFFORT,
    }[info.reliable]
    durability = QosDurability.TRANSIENT_LOCAL if info.latched else QosDurability.VOLATILE
    liveliness = QosLiveliness.AUTOMATIC
    return Qos(
        QosHistory.KEEP_LAST, 10, reliability, durability, _NO_LIMIT, _NO_LIMIT, liveliness, _NO_LIMIT, False
    )  # fmt: skip
