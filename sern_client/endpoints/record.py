"""Records what arrives: ROS 1 topics into `<stem>.bag`, ROS 2 (CDR) topics into `<stem>.mcap`, byte for byte.

Files grow under `<name>.active` and get their own name when they are complete, so a file with its own name is always
readable. One thread writes; the event loop only appends to a bounded buffer. When the disk refuses, the file is
finished with what it already holds, and everything later is counted as dropped.
"""

import asyncio
import atexit
import logging
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Final, NamedTuple

from sern_client.endpoints.bag_files import BagFile, McapFile, RecordFile, active_path
from sern_client.endpoints.base import Difference, Held, Sink, Subscription, TopicEvents
from sern_core.errors import ConfigError, UsageError
from sern_core.message import TopicInfo
from sern_core.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import one_line

MAX_STAMP_NS: Final = 2**32 * 10**9 - 1
"""The latest time a ROS 1 bag can hold (32-bit seconds)."""
JOIN_AT_EXIT_S: Final = 30.0
"""How long an interpreter that exits without `stop` waits for the file to be finished."""
_OVERHEAD_BYTES: Final = 256
"""What a buffered message costs besides its body."""

_LOG = logging.getLogger(__name__)
_SUFFIXES: Final = {Encoding.ROS1: ".bag", Encoding.CDR: ".mcap"}


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """Where to. `path`: a `.bag` or `.mcap` (the other encoding goes beside it under the same stem), an existing
    folder (named by date), or a name without suffix. `max_buffer_bytes` bounds what waits for the disk.
    """

    path: Path
    overwrite: bool = False
    max_buffer_bytes: int = 64 * 2**20


@dataclass(slots=True)
class RecordCounters:
    """Messages by fate; `written` rises when the writer thread took a message into its file."""

    written: int = 0
    dropped: int = 0  # buffer full, disk full, file unwritable, or a stamp no bag can hold
    errors: int = 0


class _Job(NamedTuple):
    info: TopicInfo
    stamp_ns: int
    body: bytes


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
        self._jobs: SimpleQueue[_Job | TopicInfo | None] = SimpleQueue()
        # Each counter has one writer (event loop, thread), so their difference needs no lock.
        self._taken_bytes = 0
        self._done_bytes = 0
        self._overflowing = False
        self._lock = threading.Lock()  # for the counters that both sides raise
        self._files: dict[Encoding, RecordFile | None] = {}  # None: could not be opened
        self._claimed: set[Encoding] = set()
        self._mcap_hashes: dict[str, str] = {}
        self._thread: threading.Thread | None = None
        self._open = False

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the place cannot be written or a file is in the way."""
        del events  # a recorder announces nothing
        self._stem, named = self._resolve(self.options.path)
        try:
            self._stem.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._error(f"its folder cannot be made ({error.strerror}); choose another path") from None
        for encoding in named:
            self._claim(encoding)
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
        self._count_dropped()

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

    def take(self, job: _Job) -> None:
        """Buffer one message for the writer thread; called by this recorder's publishers on the event loop."""
        cost = len(job.body) + _OVERHEAD_BYTES
        full = self._taken_bytes - self._done_bytes + cost > self.options.max_buffer_bytes
        if full and not self._overflowing:
            self._complain("the disk is slower than the messages; dropping until it catches up")
        self._overflowing = full
        if full or not self._open or not 0 <= job.stamp_ns <= MAX_STAMP_NS:
            self._count_dropped()
            return
        self._taken_bytes += cost
        self._jobs.put(job)

    # On the event loop

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
        for taken in (path, active_path(path)):
            if taken.exists() and not self.options.overwrite:
                left = " (left by a recording that did not finish)" if taken != path else ""
                raise ConfigError(f"exists already{left}; move it away or set `overwrite`", file=str(taken))
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
        if info.encoding is Encoding.CDR:
            first = self._mcap_hashes.setdefault(type_name, computed)
            if first != computed:
                raise self._error(
                    f"{info.name}: {type_name} has hash {computed} here and {first} on another topic; "
                    "one .mcap holds one definition of a type"
                )
        return TopicInfo(info.name, type_name, info.encoding, computed, definition, info.latched, info.reliable)

    # On the writer thread

    def _write_all(self) -> None:
        try:
            while (job := self._jobs.get()) is not None:
                if isinstance(job, _Job):
                    self._write(job)
                    self._done_bytes += len(job.body) + _OVERHEAD_BYTES
                elif (file := self._file(job.encoding)) is not None:
                    file.add(job)
        finally:
            for encoding, file in self._files.items():
                self._finish(encoding, file)

    def _file(self, encoding: Encoding) -> RecordFile | None:
        if encoding not in self._files:
            self._files[encoding] = None
            try:
                self._files[encoding] = (BagFile if encoding is Encoding.ROS1 else McapFile)(self._path(encoding))
            except OSError as error:
                self._complain(f"cannot be written ({_reason(error)}); nothing is recorded there", encoding)
        return self._files[encoding]

    def _write(self, job: _Job) -> None:
        file = self._files[job.info.encoding]
        if file is None or file.full:
            self._count_dropped()
            return
        try:
            file.write(job.info, job.stamp_ns, job.body)
            self.counters.written += 1
        except OSError as error:
            lost = file.give_up()
            self.counters.written -= lost - 1  # this one had not been counted yet
            self._count_dropped(lost)
            what = f"writing failed ({_reason(error)}); the recording ends here, make room and start a new one"
            self._complain(what, job.info.encoding)

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
            self._count_dropped(lost)
            self._complain(f"the disk is full; its last {lost} messages are missing", encoding)

    # On both

    def _count_dropped(self, count: int = 1) -> None:
        with self._lock:
            self.counters.dropped += count

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


def _reason(error: OSError) -> str:
    return error.strerror or one_line(error)
