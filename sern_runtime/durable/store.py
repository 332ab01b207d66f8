"""What a daemon keeps on disk of durable topics: streams, their messages, and how far each has been delivered.

One SQLite file with a rollback journal, `synchronous=EXTRA`: what `apply` was given is on disk, or not at all, when it
returns. SQLite was chosen over segments of our own because its behaviour in crashes, power cuts and full disks has been
tested by far more people; the journal over its write-ahead log because a flipped bit in a write-ahead log makes SQLite
take what follows for never written, while here it shows: every row has a CRC, and opening checks the pages.

A damaged file is put aside (`NAME.damaged-1`), never deleted; what can be read of it goes into a new one.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import apsw
import msgpack

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime.durable.names import DURABLE_FILE

VERSION: Final = 1
PAGE_BYTES: Final = 8192
ROW_BYTES: Final = 256
"""What a message takes beside its body."""

_SCHEMA: Final = """
create table if not exists meta (name text primary key, value) without rowid;
create table if not exists stream (
  id integer primary key, origin text, boot integer, topic text, said blob, last integer, crc integer,
  unique (origin, boot, topic));
create table if not exists message (
  stream integer, seq integer, born_ns integer, stamp_ns integer, codec integer, marker integer, body blob, crc integer,
  primary key (stream, seq));
create table if not exists place (stream integer, client text, seq integer, primary key (stream, client)) without rowid;
"""


class StoreError(SernError):
    """The disk did not take it; nothing of it is there."""


@dataclass(frozen=True, slots=True)
class Row:
    """One message. `born_ns`: the wall time at which it was taken, less the age that it had; `marker`: 0, or the code
    of a drop marker."""

    seq: int
    born_ns: int
    stamp_ns: int
    body: bytes
    codec: int = 0
    marker: int = 0


@dataclass(slots=True)
class KeptStream:
    """A stream as it was found. `announcement`: the envelope that announces it; `last`: the highest seq it ever had;
    `places`: up to which seq each client has it, where that is known."""

    id: StreamId
    announcement: dict[str, Any]
    definition: str
    required: tuple[str, ...]
    last: int
    rows: list[Row] = field(default_factory=list)
    places: dict[ClientName, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Described:
    """What a stream is, or is now."""

    stream: StreamId
    announcement: dict[str, Any]
    definition: str
    required: tuple[str, ...]
    last: int


@dataclass(frozen=True, slots=True)
class Put:
    """One more message of a stream that was described."""

    stream: StreamId
    row: Row


@dataclass(frozen=True, slots=True)
class Trim:
    """Everything up to seq `upto` is done with."""

    stream: StreamId
    upto: int


@dataclass(frozen=True, slots=True)
class Place:
    """The client has everything up to `seq`."""

    stream: StreamId
    client: ClientName
    seq: int


@dataclass(frozen=True, slots=True)
class Forget:
    """The stream is gone, with all that is left of it."""

    stream: StreamId


Change = Described | Put | Trim | Place | Forget


@dataclass(slots=True)
class Contents:
    """What was found. `boot`: the store's number, which its streams have. `damage`: a line for each thing lost."""

    boot: int
    streams: dict[StreamId, KeptStream]
    damage: list[str] = field(default_factory=list)


class Store:
    """The file in `directory`. Not thread-safe. `vfs`: the name of another file system of apsw, for tests."""

    def __init__(self, directory: Path, *, vfs: str | None = None) -> None:
        self.path = directory / DURABLE_FILE
        self._vfs = vfs
        self._db: apsw.Connection | None = None
        self._ids: dict[StreamId, int] = {}

    # --- opening --------------------------------------------------------------------------------------------------

    def open(self, *, new_boot: int) -> Contents:
        """Read all that is there. `new_boot`: the number of a store that is new. Raises ConfigError for what a person
        has to put right, StoreError for a disk that is full or fails."""
        directory = self.path.parent
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"cannot be made: {error.strerror}; it is for durable topics", file=str(directory)
            ) from None
        try:
            self._connect()
            contents, damage = self._read(new_boot)
        except (apsw.CorruptError, apsw.NotADBError) as error:
            contents, damage = None, [f"{self.path} is damaged: {error}"]
        except apsw.Error as error:
            self.close()
            raise self._said(error) from error
        if not damage:
            assert contents is not None
            return contents
        return self._rebuild(new_boot, damage)

    def _connect(self) -> apsw.Connection:
        flags = apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_CREATE
        db = self._db = apsw.Connection(str(self.path), flags=flags, vfs=self._vfs)
        db.pragma("page_size", PAGE_BYTES)
        db.pragma("locking_mode", "exclusive")  # a second daemon would number its messages as this one does
        db.pragma("journal_mode", "persist")
        db.pragma("synchronous", "extra")
        with _transaction(db):
            db.execute(_SCHEMA)
        self.path.chmod(0o600)
        return db

    def _said(self, error: apsw.Error) -> SernError:
        """What a person can do about an error of the disk."""
        text = str(error).removeprefix(f"{type(error).__name__}: ")
        if isinstance(error, apsw.BusyError):
            return ConfigError("another process has it; give each client a directory of its own", file=str(self.path))
        if isinstance(error, (apsw.CantOpenError, apsw.ReadOnlyError, apsw.PermissionsError)):
            return ConfigError(f"cannot be written ({text}); who runs this must own its directory", file=str(self.path))
        return StoreError(f"{self.path}: {text}")

    def _read(self, new_boot: int) -> tuple[Contents, list[str]]:
        db = self._db
        assert db is not None
        check = db.pragma("quick_check", 1)
        damage = [] if check == "ok" else [f"{self.path} is damaged: {str(check).splitlines()[-1]}"]
        version = db.execute("select value from meta where name = 'version'").get
        if version is None and not damage:
            with _transaction(db):
                db.execute("insert into meta values ('version', ?), ('boot', ?)", (VERSION, new_boot))
        elif version not in (None, VERSION):
            raise ConfigError(f"is of version {version}; this SERN reads version {VERSION}", file=str(self.path))
        boot = db.execute("select value from meta where name = 'boot'").get
        if not isinstance(boot, int):
            boot = new_boot
        contents = Contents(boot, {})
        by_id: dict[int, KeptStream] = {}
        for number, origin, stream_boot, topic, said, last, crc in _rows(db, "stream", damage):
            if crc != _crc(origin, stream_boot, topic, said, last):
                damage.append(f"what {topic!r} of {origin} is could not be read, and its messages are lost")
                continue
            about = msgpack.unpackb(said)
            identity = StreamId(ClientName(origin), stream_boot, TopicName(topic))
            kept = KeptStream(identity, about["announcement"], about["definition"], tuple(about["required"]), last)
            by_id[number] = contents.streams[identity] = kept
            self._ids[identity] = number
        for number, seq, born_ns, stamp_ns, codec, marker, body, crc in _rows(db, "message", damage):
            stream = by_id.get(number)
            if stream is None or crc != _crc(number, seq, born_ns, stamp_ns, codec, marker, body):
                damage.append(f"message {seq} of {stream.id.topic if stream else 'an unknown topic'} is lost")
                continue
            stream.rows.append(Row(seq, born_ns, stamp_ns, body, codec, marker))
        for number, client, seq in _rows(db, "place", damage):
            if number in by_id:
                by_id[number].places[ClientName(client)] = seq
        for stream in contents.streams.values():
            by_seq = {row.seq: row for row in stream.rows}  # where a page is broken, some may be read twice
            stream.rows = [by_seq[seq] for seq in sorted(by_seq)]
        return contents, damage

    def _rebuild(self, new_boot: int, damage: list[str]) -> Contents:
        """Put the file aside, and what can be read of it into a new one."""
        contents = Contents(new_boot, {})
        with suppress(apsw.Error):
            if self._db is not None:
                contents, _ = self._read(new_boot)
        self.close()
        number = 1
        while (aside := self.path.with_name(f"{DURABLE_FILE}.damaged-{number}")).exists():
            number += 1
        try:
            self.path.rename(aside)
            self.path.with_name(f"{DURABLE_FILE}-journal").unlink(missing_ok=True)
            self._ids.clear()
            db = self._connect()
            with _transaction(db):
                db.execute("insert into meta values ('version', ?), ('boot', ?)", (VERSION, contents.boot))
            self.apply(list(_changes(contents)))
        except (OSError, apsw.Error) as error:
            raise StoreError(f"{self.path} is damaged, and cannot be made anew: {error}") from error
        contents.damage = [*damage, f"the damaged file is {aside}"]
        return contents

    # --- writing --------------------------------------------------------------------------------------------------

    def apply(self, changes: Sequence[Change]) -> None:
        """Make all of these changes, in their order, and have them on disk. Raises StoreError; then none is made."""
        trims: dict[StreamId, int] = {}
        for change in changes:
            if isinstance(change, Trim):
                trims[change.stream] = max(change.upto, trims.get(change.stream, 0))
        known = dict(self._ids)
        try:
            if self._db is None:
                self._connect()
            assert self._db is not None
            with _transaction(self._db):
                self._write(self._db, changes, trims)
        except apsw.Error as error:
            self._ids = known
            with suppress(apsw.Error):
                self.close()  # what it holds of the file in memory is not to be trusted after a failed sync
            raise StoreError(f"{self.path}: {error}") from error

    def _write(self, db: apsw.Connection, changes: Sequence[Change], trims: dict[StreamId, int]) -> None:
        rows: list[tuple[Any, ...]] = []
        last: dict[StreamId, int] = {}
        for change in changes:
            match change:
                case Put(stream, row):
                    last[stream] = max(row.seq, last.get(stream, 0))
                    if row.seq > trims.get(stream, 0):  # else it is delivered already
                        rows.append(_message(self._ids[stream], row))
                case Described():
                    self._describe(db, change)
                case Place(stream, client, seq):
                    if stream in self._ids:
                        db.execute("insert or replace into place values (?, ?, ?)", (self._ids[stream], client, seq))
                case Forget(stream):
                    number = self._ids.pop(stream, None)
                    last.pop(stream, None)
                    rows = [row for row in rows if row[0] != number]
                    for table, key in (("message", "stream"), ("place", "stream"), ("stream", "id")):
                        db.execute(f"delete from {table} where {key} = ?", (number,))
                case Trim():
                    pass
        db.executemany("insert or replace into message values (?, ?, ?, ?, ?, ?, ?, ?)", rows)
        for stream, seq in last.items():
            self._count(db, self._ids[stream], seq)
        for stream, upto in trims.items():
            if stream in self._ids:
                db.execute("delete from message where stream = ? and seq <= ?", (self._ids[stream], upto))

    def _describe(self, db: apsw.Connection, change: Described) -> None:
        said = msgpack.packb(
            {"announcement": change.announcement, "definition": change.definition, "required": list(change.required)}
        )
        stream = change.stream
        number = self._ids.get(stream)
        if number is None:
            number = 1 + (db.execute("select max(id) from stream").get or 0)
            self._ids[stream] = number
        crc = _crc(stream.origin, stream.boot, stream.topic, said, change.last)
        row = (number, stream.origin, stream.boot, stream.topic, said, change.last, crc)
        db.execute("insert or replace into stream values (?, ?, ?, ?, ?, ?, ?)", row)

    def _count(self, db: apsw.Connection, number: int, seq: int) -> None:
        """The stream has had message `seq`."""
        origin, boot, topic, said, last = db.execute(
            "select origin, boot, topic, said, last from stream where id = ?", (number,)
        ).get
        if seq > last:
            crc = _crc(origin, boot, topic, said, seq)
            db.execute("update stream set last = ?, crc = ? where id = ?", (seq, crc, number))

    def close(self) -> None:
        db, self._db = self._db, None
        if db is not None:
            db.close(force=True)


@contextmanager
def _transaction(db: apsw.Connection) -> Iterator[None]:
    """All of it or nothing; what went wrong is raised as it was, also where SQLite has rolled back by itself."""
    db.execute("begin immediate")
    try:
        yield
        db.execute("commit")
    except BaseException:
        if db.in_transaction:
            with suppress(apsw.Error):
                db.execute("rollback")
        raise


def _message(number: int, row: Row) -> tuple[Any, ...]:
    crc = _crc(number, row.seq, row.born_ns, row.stamp_ns, row.codec, row.marker, row.body)
    return number, row.seq, row.born_ns, row.stamp_ns, row.codec, row.marker, row.body, crc


def _crc(*values: object) -> int:
    """The CRC-32 of a row."""
    crc = 0
    for value in values:
        data = value if isinstance(value, bytes) else str(value).encode()
        crc = zlib.crc32(data, zlib.crc32(len(data).to_bytes(8, "big"), crc))
    return crc


def _rows(db: apsw.Connection, table: str, damage: list[str]) -> Iterator[tuple[Any, ...]]:
    """All rows of a table that can be read: where a page is broken those before it, and from the end those behind."""
    key = "client" if table == "place" else "rowid"
    for order in ("", " desc"):
        try:
            yield from db.execute(f"select * from {table} not indexed order by {key}{order}")
        except apsw.CorruptError as error:
            damage.append(f"a part of the {table}s cannot be read: {error}")
        else:
            return


def _changes(contents: Contents) -> Iterable[Change]:
    for stream in contents.streams.values():
        yield Described(stream.id, stream.announcement, stream.definition, stream.required, stream.last)
        for row in stream.rows:
            yield Put(stream.id, row)
        for client, seq in stream.places.items():
            yield Place(stream.id, client, seq)
