"""A folder of files of kept messages: they grow one after the other, and of too much the oldest file goes first.

Used from one thread. A store that fills up is of a robot, which deletes its oldest file; or of a site (`keeps_all`),
which takes no more.
"""

import errno
import fcntl
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from sern_core.site.runs import Run
from sern_core.site.spool import MAX_SPANS, Span
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import TopicName
from sern_runtime.spool.files import (
    UNREADABLE,
    Content,
    FileIndex,
    GrowingFile,
    Kept,
    KeptStream,
    read_index,
    read_runs,
)

FILES: Final = 16
"""A store has at least so many files when it is full, so that little is lost with one."""
MAX_FILE_BYTES: Final = 64 * 2**20
SUFFIX: Final = ".mcap"
LOCK: Final = ".lock"

_log = logging.getLogger(__name__)


class FullError(OSError):
    """A store that keeps all has reached its limit."""


class Answer(NamedTuple):
    """Messages that were asked for. `rest`: what was not looked at yet."""

    messages: tuple[Kept, ...]
    rest: tuple[Run, ...]


class Store:
    """The files `PREFIX-00000001.mcap` and so on of a folder."""

    def __init__(self, directory: Path, prefix: str, *, max_bytes: int, keeps_all: bool = False) -> None:
        self.directory = directory
        self.max_bytes = max_bytes
        self.kept_bytes = 0
        """Bytes of all files, as far as they are flushed."""
        self.deleted_files = 0
        self.deleted_messages = 0
        self.damaged_files = 0
        self.damaged_messages = 0
        self._said_damaged: set[Path] = set()
        """Files that are not whole, other than at their end."""
        self._prefix = prefix
        self._keeps_all = keeps_all
        self._file_bytes = min(MAX_FILE_BYTES, max_bytes // FILES)
        self._closed: list[FileIndex] = []
        self._growing: GrowingFile | None = None
        self._number = 0
        self._lock: int | None = None

    # --- life -------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Make the folder, and read what earlier processes have left. Raises ConfigError when it cannot be used, or
        another process does; OSError when the disk fails."""
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.directory / f"{self._prefix}{LOCK}", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise
            raise ConfigError(
                f"cannot be written ({error.strerror}); give this user the right to, or name another directory",
                file=str(self.directory),
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                "another process keeps messages there; give each client its own", file=str(self.directory)
            ) from error
        for path in sorted(self.directory.glob(f"{self._prefix}-*{SUFFIX}")):
            digits = path.name[len(self._prefix) + 1 : -len(SUFFIX)]
            if not (digits.isascii() and digits.isdecimal()):
                continue
            self._number = max(self._number, int(digits))
            self._found(path)
        self.kept_bytes = sum(index.size_bytes for index in self._closed)

    def _found(self, path: Path) -> None:
        index = read_index(path)
        if index.problem is not None and not index.contents:
            self.damaged_files += 1
            _log.error("%s: nothing of it can be read (%s); it is left as it is, delete it or move it away", path,
                       index.problem)  # fmt: skip
            return
        if index.problem is not None:
            _log.warning("%s was cut off; its first %d messages are whole", path, index.messages)
        self._closed.append(index)

    def close(self) -> list[Kept]:
        """Finish the file. Returns what could not be written. Idempotent."""
        lost: list[Kept] = []
        if self._growing is not None:
            try:
                self._end_file()
            except OSError:
                lost = self.give_up()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        return lost

    # --- writing ----------------------------------------------------------------------------------------------------

    def add(self, kept: Kept) -> list[Kept]:
        """Add a message. Returns those that became safe on the way. Raises OSError; then call `give_up`."""
        safe: list[Kept] = []
        growing = self._growing
        if growing is not None and growing.size_bytes + kept.cost_bytes > self._file_bytes and growing.messages:
            safe = self._end_file()
            growing = None
        self._make_room(kept.cost_bytes)
        if growing is None:
            self._number += 1
            growing = GrowingFile(self.directory / f"{self._prefix}-{self._number:08}{SUFFIX}")
            self._growing = growing
        growing.add(kept)
        return safe

    def _make_room(self, size_bytes: int) -> None:
        growing_bytes = 0 if self._growing is None else self._growing.size_bytes
        while self._closed_bytes + growing_bytes + size_bytes > self.max_bytes:
            if self._keeps_all:
                raise FullError(errno.EDQUOT, f"spool.max_bytes ({self.max_bytes}) is reached")
            if not self.delete_oldest():
                return

    @property
    def _closed_bytes(self) -> int:
        return sum(index.size_bytes for index in self._closed)

    def delete_oldest(self) -> bool:
        """Let the oldest finished file go. False: there is none, or none may go. Raises OSError."""
        if not self._closed or self._keeps_all:
            return False
        self._closed[0].path.unlink(missing_ok=True)
        index = self._closed.pop(0)
        self.deleted_files += 1
        self.deleted_messages += index.messages
        self._count()
        return True

    def flush(self) -> list[Kept]:
        """Returns what is safe now. Raises OSError; then call `give_up`."""
        if self._growing is None:
            return []
        safe = self._growing.flush()
        self._count()
        return safe

    def _end_file(self) -> list[Kept]:
        assert self._growing is not None
        safe = self._growing.finish()
        self._closed.append(self._growing.index)
        self._growing = None
        self._count()
        return safe

    def give_up(self) -> list[Kept]:
        """The disk has refused something: end the file with what is safe in it. Returns what is not."""
        growing, self._growing = self._growing, None
        if growing is None:
            return []
        lost = growing.abandon()
        if growing.index.contents:
            self._closed.append(growing.index)
        self._count()
        return lost

    def _count(self) -> None:
        growing_bytes = 0 if self._growing is None else self._growing.index.size_bytes
        self.kept_bytes = self._closed_bytes + growing_bytes

    @property
    def damaged(self) -> int:
        """Files and messages that could not be read as they were written."""
        return self.damaged_files + self.damaged_messages

    # --- reading ----------------------------------------------------------------------------------------------------

    def _indexes(self) -> list[FileIndex]:
        return [*self._closed, *(() if self._growing is None else (self._growing.index,))]

    def topics(self) -> dict[TopicName, tuple[Span, ...]]:
        """What there is of each topic, by boot number, the oldest first, as far as it is flushed."""
        found: dict[TopicName, dict[int, list[Content]]] = {}
        for index in self._indexes():
            for content in index.contents.values():
                stream = content.stream.id
                found.setdefault(stream.topic, {}).setdefault(stream.boot, []).append(content)
        return {
            topic: tuple(_span(boot, contents) for boot, contents in boots.items())[-MAX_SPANS:]
            for topic, boots in found.items()
        }

    def streams(self) -> dict[TopicName, KeptStream]:
        """The stream of each topic that was kept last."""
        contents = (content for index in self._indexes() for content in index.contents.values())
        return {content.stream.id.topic: content.stream for content in contents}

    def read(
        self, topic: TopicName, boot: int, runs: Sequence[Run], from_ns: int, to_ns: int, *, max_bytes: int
    ) -> Answer:
        """The kept messages of rising `runs` and these stamps, in order, until `max_bytes` are reached. A file that
        cannot be read is left out: said, and counted. Raises OSError where the disk fails."""
        messages: list[Kept] = []
        size_bytes = 0
        for index in list(self._indexes()):
            for channel, content in list(index.contents.items()):
                stream = content.stream
                if stream.id.topic != topic or stream.id.boot != boot:
                    continue
                try:
                    for found in read_runs(index, channel, runs):
                        if not found.whole:
                            self._damaged(index, found.seq)
                            continue
                        message = found.message
                        if not from_ns <= message.log_time <= to_ns:
                            continue
                        if messages and size_bytes + len(message.data) > max_bytes:
                            return Answer(tuple(messages), _from(runs, found.seq))
                        messages.append(Kept(stream, found.seq, message.log_time, message.data))
                        size_bytes += len(message.data)
                except FileNotFoundError:
                    _log.error("%s was deleted by somebody else", index.path)
                    self._drop(index)
                    break
                except UNREADABLE as error:
                    self.damaged_files += 1
                    _log.error(
                        "%s is damaged (%s); the rest of it is left out", index.path, error or type(error).__name__
                    )
                    self._drop(index)
                    break
        return Answer(tuple(messages), ())

    def _damaged(self, index: FileIndex, seq: int) -> None:
        """A message is not what was written: whoever asks for it is told that there is none."""
        self.damaged_messages += 1
        if index.path not in self._said_damaged:
            self._said_damaged.add(index.path)
            _log.error("%s: message %d is damaged; it is left out, and others that are", index.path, seq)

    def _drop(self, index: FileIndex) -> None:
        if index in self._closed:
            self._closed.remove(index)
        self._count()


def _span(boot: int, contents: Sequence[Content]) -> Span:
    return Span(
        boot,
        min(content.first for content in contents),
        max(content.last for content in contents),
        min(content.first_ns for content in contents),
        max(content.last_ns for content in contents),
        sum(content.messages for content in contents),
        sum(content.nbytes for content in contents),
        bool(contents[-1].stream.info.reliable),
    )


def _from(runs: Sequence[Run], seq: int) -> tuple[Run, ...]:
    """What is left of the runs from this seq on."""
    return tuple((max(first, seq), last) for first, last in runs if last >= seq)
