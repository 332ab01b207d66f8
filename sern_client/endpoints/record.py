"""Records what arrives: ROS 1 topics into `<stem>.bag`, ROS 2 (CDR) topics into `<stem>.mcap`, byte for byte.

Files grow under `<name>.active` and get their own name when they are complete, so a file with its own name is always
readable. One thread writes; the event loop only appends to a bounded buffer. What was written is flushed to the
operating system at each megabyte, `flush_s` after it came, and when asked, and said to be kept from then on
(`KeepingEndpoint`): it survives the end of this process, however that comes, and with `sync` that of the machine. What
a killed process left is finished by the next one, under a name of its own (leftovers.py). When the disk refuses, the
file is finished with what it already holds, and everything later is counted as dropped.
"""

import asyncio
import atexit
import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryFile
from typing import Final, NamedTuple

from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from sern_client.endpoints.bag_files import BagFile, McapFile, RecordFile, active_path
from sern_client.endpoints.base import Difference, Held, KeptUpTo, Sink, Subscription, TopicEvents
from sern_client.endpoints.leftovers import ACTIVE, finish, in_use, put_aside
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.ros_types import one_line

MAX_STAMP_NS: Final = 2**32 * 10**9 - 1
"""The latest time a ROS 1 bag can hold (32-bit seconds)."""
JOIN_AT_EXIT_S: Final = 30.0
"""How long an interpreter that exits without `stop` waits for the file to be finished."""
MAX_COMPLAINTS: Final = 1000
"""Topics of which it is said that they are not recorded."""
_OVERHEAD_BYTES: Final = 256
"""What a buffered message costs besides its body."""

_LOG = logging.getLogger(__name__)
_SUFFIXES: Final = {Encoding.ROS1: ".bag", Encoding.CDR: ".mcap"}


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """Where to. `path`: a `.bag` or `.mcap` (the other encoding goes beside it under the same stem), an existing
    folder (named by date), or a name without suffix. `max_buffer_bytes` bounds what waits for the disk. A message waits
    for `flush_s` at most before it is flushed; `sync`: to the disk.
    """

    path: Path
    overwrite: bool = False
    max_buffer_bytes: int = 64 * 2**20
    flush_s: float = 1.0
    sync: bool = False


@dataclass(slots=True)
class RecordCounters:
    """Messages by fate; `written` rises when the writer thread took a message into its file."""

    written: int = 0
    dropped: int = 0  # buffer full, disk full, file unwritable, or a stamp no bag can hold
    errors: int = 0


class _Order(Enum):
    """What the writer thread is told beside messages and topics."""

    FLUSH = auto()


class _Job(NamedTuple):
    info: TopicInfo
    stamp_ns: int
    body: bytes


class _Numbered(NamedTuple):
    """A message that was taken; they count from 1."""

    number: int
    job: _Job


class _Publisher:
    def __init__(self, recorder: "RecordEndpoint", info: TopicInfo) -> None:
        self._recorder = recorder
        self._info: TopicInfo | None = info

    def publish(self, body: bytes, stamp_ns: int) -> None:
        if self._info is None:
            self._recorder.count_dropped()
        else:
            self._recorder.take(_Job(self._info, stamp_ns, body))

    def close(self) -> None:
        info, self._info = self._info, None
        if info is not None:
            self._recorder.publishers[info.name] -= 1


class RecordEndpoint:
    """An `Endpoint` that takes everything and gives nothing. `folder`: the path is a folder, to be made if need be."""

    def __init__(self, options: RecordOptions, *, folder: bool = False) -> None:
        self.options = options
        self._folder = folder
        self.counters = RecordCounters()
        self.problem: str | None = None
        """The last thing that went wrong, in one line; None while all is well."""
        self.publishers: Counter[TopicName] = Counter()
        """How many are open, by topic."""
        self._stem: Path | None = None
        self._jobs: SimpleQueue[_Numbered | TopicInfo | _Order | None] = SimpleQueue()
        # Each counter has one writer (event loop, thread), so their difference needs no lock.
        self._taken_bytes = 0
        self._done_bytes = 0
        self._overflowing = False
        self._lock = threading.Lock()  # for the counters that both sides raise
        self._files: dict[Encoding, RecordFile | None] = {}  # None: could not be opened
        self._claimed: set[Encoding] = set()
        self._thread: threading.Thread | None = None
        self._open = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._told: list[KeptUpTo] = []
        self._taken = 0
        self._refused: dict[int, DropReason] = {}  # numbers of what did not get into the buffer, not told of yet
        reasons = (DropReason.QUEUE_FULL, DropReason.STORAGE, DropReason.DISCONNECTED)
        self._drops: dict[DropReason, int] = dict.fromkeys(reasons, 0)
        # Of the writer thread:
        self._lost: dict[int, DropReason] = {}  # by number, not told of yet
        self._unsafe: dict[Encoding, list[int]] = {}  # numbers of messages that are written and not flushed
        self._unrecorded: set[TopicName] = set()  # of which was said that not all of them is written
        self._done = 0  # number of the last message that was dealt with
        self._flush_due_s: float | None = None

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the place cannot be written or a file is in the way."""
        del events  # a recorder announces nothing
        self._stem, named = self._resolve(self.options.path)
        try:
            self._stem.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._error(f"its folder cannot be made ({error.strerror}); choose another path") from None
        try:
            with TemporaryFile(dir=self._stem.parent):
                pass
        except OSError as error:
            raise self._error(
                f"nothing can be written in {self._stem.parent} ({_reason(error)}); make room, give this user the "
                "right to write there, or choose another path"
            ) from None
        for encoding in named:
            self._claim(encoding)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._write_all, name="sern-record", daemon=True)
        self._thread.start()
        self._open = True
        atexit.register(self._finish_at_exit)

    async def stop(self) -> None:
        """Writes what is buffered and finishes the files; they are finished even if this call is cancelled."""
        if self._thread is None or not self._open:
            return
        self._open = False
        self._jobs.put(None)
        await asyncio.get_running_loop().run_in_executor(None, self._thread.join)
        atexit.unregister(self._finish_at_exit)
        if self.counters.dropped:
            _LOG.warning("%s: %d messages were not recorded", self.options.path, self.counters.dropped)

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        del sink
        raise UsageError(f"{name}: a recorder gives no topics")

    def advertise(self, info: TopicInfo) -> _Publisher:
        """ConfigError for raw bodies, for a type without a usable definition, and for a hash that is another type's."""
        if not self._open:
            raise UsageError("advertise before start or after stop")
        info = self._complete(info)
        self._claim(info.encoding)
        self._jobs.put(info)
        self.publishers[info.name] += 1
        return _Publisher(self, info)

    def validate(self, held: Held) -> list[Difference]:
        """Nothing is written any more: that is a difference of every topic."""
        found = held.differences(Held(+self.publishers))
        if self._open and (self._thread is None or not self._thread.is_alive()):
            found.append(Difference(TopicName(""), f"{self.options.path}: the thread that records has ended"))
        return found

    def count_dropped(self) -> None:
        """A message came to a publisher that is closed."""
        self._count_dropped(DropReason.DISCONNECTED)

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Makes no difference here."""

    @property
    def encoding(self) -> None:
        """Records every encoding as it is."""
        return None

    @property
    def exhausted(self) -> bool:
        """Always true: a recorder offers nothing."""
        return True

    @property
    def paths(self) -> dict[Encoding, Path]:
        """The final names of the files begun so far."""
        return {encoding: self._path(encoding) for encoding, file in self._files.items() if file is not None}

    @property
    def drops(self) -> Mapping[DropReason, int]:
        """Messages that are in no file, by reason."""
        return self._drops

    @property
    def taken(self) -> int:
        """Messages that were published here."""
        return self._taken

    def watch_kept(self, told: KeptUpTo) -> None:
        """Whom to tell what is flushed."""
        self._told.append(told)

    def flush(self) -> None:
        """Flush what was taken so far, without waiting for `flush_s`."""
        self._jobs.put(_Order.FLUSH)

    def keep_soon(self) -> None:
        """Flush what was taken so far; to the disk itself (`sync`) only every `flush_s`."""
        if not self.options.sync:
            self.flush()

    def take(self, job: _Job) -> None:
        """Buffer one message for the writer thread; called by this recorder's publishers on the event loop."""
        self._taken += 1
        cost = len(job.body) + _OVERHEAD_BYTES
        full = self._taken_bytes - self._done_bytes + cost > self.options.max_buffer_bytes
        if full and not self._overflowing:
            self._complain("the disk is slower than the messages; dropping until it catches up")
        self._overflowing = full
        if full or not self._open or not 0 <= job.stamp_ns <= MAX_STAMP_NS:
            reason = DropReason.QUEUE_FULL if full else DropReason.STORAGE
            self._count_dropped(reason)
            if not self._refused:
                self.flush()  # tells of it, too
            self._refused[self._taken] = reason
            return
        self._taken_bytes += cost
        self._jobs.put(_Numbered(self._taken, job))

    # On the event loop

    def _tell(self, upto: int, lost: dict[int, DropReason]) -> None:
        refused, self._refused = self._refused, {}
        for told in self._told:
            told(upto, refused | lost)

    def _resolve(self, path: Path) -> tuple[Path, tuple[Encoding, ...]]:
        """(stem without suffix, encodings whose file must not be in the way)."""
        if self._folder or path.is_dir():
            return path / time.strftime("sern_%Y-%m-%d-%H-%M-%S", time.gmtime()), tuple(_SUFFIXES)
        for encoding, suffix in _SUFFIXES.items():
            if path.suffix == suffix:
                return path.with_suffix(""), (encoding,)
        if path.suffix == ".db3":
            raise self._error("recording to .db3 is not supported; use .mcap, or .bag for ROS 1")
        return path, tuple(_SUFFIXES)

    def _path(self, encoding: Encoding) -> Path:
        assert self._stem is not None
        return self._stem.with_name(self._stem.name + _SUFFIXES[encoding])

    def _claim(self, encoding: Encoding) -> None:
        if encoding in self._claimed:
            return
        path = self._path(encoding)
        if path.exists() and not self.options.overwrite:
            raise ConfigError("exists already; move it away or set `overwrite`", file=str(path))
        if in_use(active_path(path)):
            raise ConfigError("another process is recording there; choose another path", file=str(active_path(path)))
        self._claimed.add(encoding)

    def _complete(self, info: TopicInfo) -> TopicInfo:
        """Definition and hash filled in where missing, and checked against each other where both came."""
        if info.encoding is Encoding.RAW:
            raise self._error(f"{info.name}: raw bodies cannot be recorded; only ros1 and cdr can")
        type_name = ros_types.canonical(info.type_name)
        definition, offered = info.definition, info.type_hash
        if definition:
            computed = ros_types.hash_of(type_name, definition, info.encoding)
        else:
            known = ros_types.describe(type_name, info.encoding)
            if known is None:
                raise self._error(f"{info.name}: no definition of {type_name} is known, so no bag can hold it")
            definition, computed = known
        if offered and offered != computed:
            raise self._error(
                f"{info.name}: {type_name} came with hash {offered}, but its definition here has {computed}; "
                "both sides need the same version of the type"
            )
        try:
            definition.encode()
        except UnicodeEncodeError:  # the writers would find out with half of it in the file
            raise self._error(f"{info.name}: the definition of {type_name} is no UTF-8") from None
        return TopicInfo(info.name, type_name, info.encoding, computed, definition, info.latched, info.reliable)

    # On the writer thread

    def _write_all(self) -> None:
        try:
            self._finish_leftovers()
            while (job := self._next_job()) is not None:
                if isinstance(job, _Numbered):
                    self._write(job.number, job.job)
                    self._done = job.number
                    self._done_bytes += len(job.job.body) + _OVERHEAD_BYTES
                elif isinstance(job, TopicInfo):
                    self._add(job)
                if job is _Order.FLUSH or (self._flush_due_s is not None and clock.now() >= self._flush_due_s):
                    self._flush()
        finally:
            self._flush()
            for encoding, file in self._files.items():
                self._finish(encoding, file)

    def _next_job(self) -> _Numbered | TopicInfo | _Order | None:
        """The next one, or the order to flush when it is time for that."""
        if self._flush_due_s is None:
            return self._jobs.get()
        try:
            return self._jobs.get(timeout=max(0.0, self._flush_due_s - clock.now()))
        except Empty:
            return _Order.FLUSH

    def _finish_leftovers(self) -> None:
        """What killed processes left in the way, or in our folder of recordings."""
        assert self._stem is not None
        actives = {active_path(self._path(encoding)) for encoding in _SUFFIXES}
        if self._folder or self.options.path.is_dir():
            actives.update(self._stem.parent.glob(f"sern_*{ACTIVE}"))
        for active in sorted(actives):
            if not active.exists() or in_use(active):
                continue
            try:
                left = finish(active, spare=active.name.startswith(f"{self._stem.name}."))
                if left.messages is None:
                    _LOG.error("%s: nothing of it can be read (%s); it is kept as %s", active, left.problem, left.path)
                else:
                    _LOG.warning(
                        "%s was left by a recording that did not finish; its %d messages are in %s now",
                        active, left.messages, left.path,
                    )  # fmt: skip
            except Exception as error:  # noqa: BLE001  (whatever it is, it must not be in the way of this recording)
                self._put_aside(active, error)

    def _put_aside(self, active: Path, error: Exception) -> None:
        try:
            aside = put_aside(active)
        except OSError as second:
            _LOG.error("%s is in the way and cannot be moved (%s)", active, _reason(second))
        else:
            _LOG.error("%s cannot be finished (%s); `sern recover %s` tries it again", active, _reason(error), aside)

    def _add(self, info: TopicInfo) -> None:
        file = self._file(info.encoding)
        if file is None:
            return
        try:
            file.add(info)
        except Exception as error:  # noqa: BLE001  (of one topic; what comes of it is counted as dropped)
            if info.name not in self._unrecorded and len(self._unrecorded) < MAX_COMPLAINTS:
                self._unrecorded.add(info.name)
                self._complain(f"{info.name} is not recorded ({_reason(error)})", info.encoding)

    def _file(self, encoding: Encoding) -> RecordFile | None:
        if encoding not in self._files:
            self._files[encoding] = None
            try:
                kind = BagFile if encoding is Encoding.ROS1 else McapFile
                self._files[encoding] = kind(self._path(encoding), sync=self.options.sync)
            except (OSError, WriterError1, WriterError2) as error:
                self._complain(f"cannot be written ({_reason(error)}); nothing is recorded there", encoding)
        return self._files[encoding]

    def _write(self, number: int, job: _Job) -> None:
        encoding = job.info.encoding
        file = self._files[encoding]
        if file is None or file.full or not file.knows(job.info):
            self._count_dropped(DropReason.STORAGE)
            self._lost[number] = DropReason.STORAGE
        else:
            self._unsafe.setdefault(encoding, []).append(number)
            try:
                self.counters.written += 1
                if file.write(job.info, job.stamp_ns, job.body):
                    self._unsafe[encoding].clear()
            except Exception as error:  # noqa: BLE001  (whatever it is, it ends this file and not the thread)
                self._failed(encoding, file, error)
        if self._flush_due_s is None:
            self._flush_due_s = clock.now() + self.options.flush_s

    def _failed(self, encoding: Encoding, file: RecordFile, error: Exception) -> None:
        lost = file.give_up()
        self.counters.written -= lost
        self._count_dropped(DropReason.STORAGE, lost)
        self._lost.update(dict.fromkeys(self._unsafe.pop(encoding, ()), DropReason.STORAGE))
        cure = "start a new one" if file.gone else "make room and start a new one"
        self._complain(f"writing failed ({_reason(error)}); the recording ends here, {cure}", encoding)

    def _flush(self) -> None:
        """Everything so far is safe from now on, or was dropped; tell whoever waits for that."""
        self._flush_due_s = None
        for encoding, file in self._files.items():
            if file is None or file.full:
                continue
            try:
                file.flush()
            except Exception as error:  # noqa: BLE001  (as above)
                self._failed(encoding, file, error)
        self._unsafe.clear()
        lost, self._lost = self._lost, {}
        assert self._loop is not None
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            self._loop.call_soon_threadsafe(self._tell, self._done, lost)

    def _finish(self, encoding: Encoding, file: RecordFile | None) -> None:
        if file is None:
            return
        try:
            lost = file.finish()
        except OSError as error:
            self._complain(f"cannot be finished ({_reason(error)}); what there is, is in {file.active}", encoding)
            return
        if lost:
            self.counters.written -= lost
            self._count_dropped(DropReason.STORAGE, lost)
            self._complain(f"the disk is full; its last {lost} messages are missing", encoding)

    # On both

    def _count_dropped(self, reason: DropReason, count: int = 1) -> None:
        with self._lock:
            self.counters.dropped += count
            self._drops[reason] += count

    def _complain(self, problem: str, encoding: Encoding | None = None) -> None:
        path = self.options.path if encoding is None else self._path(encoding)
        with self._lock:
            self.counters.errors += 1
        self.problem = str(ConfigError(problem, file=str(path)))
        _LOG.error("%s", self.problem)

    def _finish_at_exit(self) -> None:
        self._open = False
        self._jobs.put(None)
        if self._thread is not None:
            self._thread.join(JOIN_AT_EXIT_S)

    def _error(self, problem: str) -> ConfigError:
        return ConfigError(problem, file=str(self.options.path))


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or one_line(error)
