"""The two kinds of file a recording is written to, on top of the rosbags writers; used from one thread only.

A file grows as `<name>.active` and takes its name in `finish`. Both formats are written in chunks, of about 1 MB or
of what came before a `flush`. What lies before the end of the last flushed chunk is safe: the operating system has it,
and leftovers.py reads it when this process was killed. When the disk refuses, `give_up` cuts the file back to there,
which also frees the room that the index needs, so that `finish` leaves a readable file.
"""

import errno
import os
import shutil
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from io import BufferedWriter, BytesIO, FileIO
from pathlib import Path
from typing import BinaryIO, Final, cast

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk

from sern_client.endpoints.leftovers import lock
from sern_core.message import TopicInfo

MAX_TIME: Final = 2**63 - 1
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
        self._unsafe: Counter[int] = Counter()  # messages per connection since the last flushed chunk
        self._lock: int | None = None  # says that a living process writes here

    @staticmethod
    @abstractmethod
    def key(info: TopicInfo) -> tuple[object, ...]:
        """What makes a connection of its own in this format."""

    def add(self, info: TopicInfo) -> None:
        """Announces a topic; again is harmless. `info` must have a definition and a hash."""
        key = self.key(info)
        if key not in self._connections and not self.full:
            self._connections[key] = self._connect(info)

    def knows(self, info: TopicInfo) -> bool:
        """Whether the topic was announced."""
        return self.key(info) in self._connections

    def write(self, info: TopicInfo, stamp_ns: int, body: bytes) -> bool:
        """Add a message. True: with it a chunk was completed, and everything so far is safe."""
        connection = self._connections[self.key(info)]
        self._unsafe[connection.id] += 1
        self.messages += 1
        self._put(connection, stamp_ns, body)
        return self._flushed()

    def flush(self) -> None:
        """Make everything so far safe."""
        if self._unsafe and not self.full:
            self._end_chunk()
            self._flushed()

    def _flushed(self) -> bool:
        if not self._flush_chunks():
            return False
        if self.sync:
            os.fsync(self._descriptor())
        if not os.fstat(self._descriptor()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "it was deleted while it was being written")
        self._unsafe.clear()
        return True

    def _take_lock(self, growing: Path) -> None:
        try:
            self._lock = lock(growing)
        except BlockingIOError:
            raise
        except OSError:
            self._lock = None  # a file system without locks

    def give_up(self) -> int:
        """Cut the file back to its last flushed chunk and take no more. Returns how many messages that loses."""
        lost = self._unsafe.total()
        self.full = True
        self.messages -= lost
        try:
            self._cut_back()
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
    def _flush_chunks(self) -> bool:
        """Flush to the disk if a chunk was completed; tells whether it was."""

    @abstractmethod
    def _end_chunk(self) -> None: ...

    @abstractmethod
    def _descriptor(self) -> int: ...

    @abstractmethod
    def _cut_back(self) -> None: ...

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
        self._writer = Writer1(self.active)
        self._writer.open()
        self._take_lock(self.active)
        self._safe_chunks = 0
        self._safe_position = self._flushed_position()

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

    def _flush_chunks(self) -> bool:
        chunks = self._writer.chunks
        if len(chunks) <= self._safe_chunks + 1:
            return False
        self._safe_position = self._flushed_position()
        for chunk in chunks[self._safe_chunks : -1]:
            # The writer would hold every message's index for ever, but of a written chunk it only needs the counts.
            for connection_id, entries in chunk.connections.items():
                chunk.connections[connection_id] = cast("list[tuple[int, int]]", range(len(entries)))
        self._safe_chunks = len(chunks) - 1
        return True

    def _end_chunk(self) -> None:
        self._writer.write_chunk(self._writer.chunks[-1])

    def _descriptor(self) -> int:
        assert self._writer.bio is not None
        return self._writer.bio.fileno()

    def _cut_back(self) -> None:
        del self._writer.chunks[self._safe_chunks :]
        self._writer.bio = _cut(self._writer.bio, self.active, self._safe_position)

    def _close(self) -> None:
        self._writer.close()

    def _abandon(self) -> None:
        _discard(self._writer.bio)
        self._writer.bio = None

    def _take_name(self) -> None:
        self.active.replace(self.path)

    def _flushed_position(self) -> int:
        assert self._writer.bio is not None
        self._writer.bio.flush()
        return self._writer.bio.tell()


class McapFile(RecordFile):
    """An MCAP file with the ROS 2 profile. rosbags makes a folder; the file inside becomes `path` in the end."""

    def __init__(self, path: Path, *, sync: bool = False) -> None:
        super().__init__(path, sync=sync)
        self._writer = Writer2(self.active, version=Writer2.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        assert isinstance(self._writer.storage, McapWriter)
        self._storage = self._writer.storage
        self._take_lock(self._storage.path)
        self._safe_chunks = 0
        self._safe_position = self._flushed_position()

    @staticmethod
    def key(info: TopicInfo) -> tuple[object, ...]:
        return info.name, info.type_name, info.latched, info.reliable

    def _connect(self, info: TopicInfo) -> Connection:
        return self._writer.add_connection(
            info.name, info.type_name, msgdef=info.definition, rihs01=info.type_hash, offered_qos_profiles=[_qos(info)]
        )

    def _put(self, connection: Connection, stamp_ns: int, body: bytes) -> None:
        self._writer.write(connection, stamp_ns, body)

    def _flush_chunks(self) -> bool:
        if len(self._storage.chunks) <= self._safe_chunks:
            return False
        self._safe_position = self._flushed_position()
        self._safe_chunks = len(self._storage.chunks)
        return True

    def _end_chunk(self) -> None:
        self._storage.close_chunk()

    def _descriptor(self) -> int:
        return self._storage.bio.fileno()

    def _cut_back(self) -> None:
        storage = self._storage
        del storage.chunks[self._safe_chunks :]
        storage.chunk = PendingChunk(MAX_TIME, 0, BytesIO(), defaultdict(list))
        for connection_id, count in self._unsafe.items():
            # A message counts only once it is in its chunk, which the failed one may not be.
            storage.channel_stats[connection_id] = max(0, storage.channel_stats[connection_id] - count)
            self._writer.counts[connection_id] = storage.channel_stats[connection_id]
        storage.bio = _cut(storage.bio, storage.path, self._safe_position)

    def _close(self) -> None:
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

    def _flushed_position(self) -> int:
        self._storage.bio.flush()
        return self._storage.bio.tell()


def _cut(old: BinaryIO | None, path: Path, position: int) -> BufferedWriter:
    """A new handle at the end of the file cut to `position`; what the old one could not write is thrown away."""
    _discard(old)
    new: BufferedWriter = BufferedWriter(FileIO(path, "r+"))
    new.truncate(position)
    new.seek(position)
    return new


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
