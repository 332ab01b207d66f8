"""Keeps messages in a thread of its own: the event loop only appends to a bounded buffer, and asks for what is kept.

A disk that is slow or full costs what should have been kept: counted, said once, and tried again every `RETRY_S`.
"""

import errno
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import Enum, auto
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple

from sern_core.site.runs import Run
from sern_core.site.spool import Span
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_runtime.spool.files import Kept, KeptStream
from sern_runtime.spool.store import Answer, FullError, Store

BUFFER_BYTES: Final = 16 * 2**20
"""What waits for the disk at most."""
FLUSH_S: Final = 1.0
"""How long what was taken may be unsafe."""
RETRY_S: Final = 5.0
OVERHEAD_BYTES: Final = 256
"""What a message costs in memory beside its body."""

_log = logging.getLogger(__name__)

OnKept = Callable[[Sequence[Kept], bool], None]
"""`on_kept(messages, safe)`: these are safe by now, or they are lost."""
OnAnswer = Callable[[Answer], None]


class _Read(NamedTuple):
    topic: TopicName
    boot: int
    runs: Sequence[Run]
    from_ns: int
    to_ns: int
    max_bytes: int
    on_answer: OnAnswer


class _Order(Enum):
    FLUSH = auto()
    END = auto()


class SpoolKeeper:
    """`call_soon` has `on_kept`, and the answers of `read`, called in the event loop. `start` once, then `close`."""

    def __init__(self, store: Store, *, call_soon: Callable[..., object], on_kept: OnKept | None = None) -> None:
        self.store = store
        self.problem: str | None = None
        """Why nothing is kept at the moment, in one line; None: it is."""
        self.written = 0
        """Messages that are safe."""
        self.overflowed = 0
        """Messages that were not kept because the disk was slower than they came."""
        self.failed = 0
        """Messages that were not kept because the disk refused them, or the store is full."""
        self.topics: Mapping[TopicName, tuple[Span, ...]] = {}
        """What there is, as of the last flush."""
        self.streams: Mapping[TopicName, KeptStream] = {}
        self._call_soon = call_soon
        self._on_kept = on_kept
        self._jobs: SimpleQueue[Kept | _Read | _Order] = SimpleQueue()
        self._taken_bytes = 0  # of the loop; the difference to `_done_bytes` needs no lock, each has one writer
        self._done_bytes = 0
        self._overflowing = False
        self._open = False
        self._thread = threading.Thread(target=self._run, name="spool", daemon=True)
        # Of the thread:
        self._flush_due_s: float | None = None
        self._retry_s: float | None = None  # the disk has refused something; until then it is not asked again
        self._recovering = False  # it has taken something since

    # --- in the loop ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the store, and begin. Raises ConfigError where it cannot be used. A disk that fails, or is full, is
        `problem`: what is there is not known then, and nothing is kept by this process."""
        try:
            self.store.open()
        except ConfigError:
            self.store.close()
            raise
        except OSError as error:
            self.store.close()
            self.problem = f"{self.store.directory}: {error.strerror}"
            _log.error("nothing is kept in the spool by this process: %s; make room and start it again", self.problem)
            return
        self._look()
        self._open = True
        self._thread.start()

    def put(self, kept: Kept) -> bool:
        """Keep a message. False: there is no room in the buffer, or the store is not open; it is counted."""
        cost_bytes = len(kept.body) + OVERHEAD_BYTES
        waiting_bytes = self._taken_bytes - self._done_bytes
        full = waiting_bytes + cost_bytes > BUFFER_BYTES
        if full and not self._overflowing:
            self._overflowing = True
            _log.error("%s: the disk is slower than the messages; they are not kept until it catches up",
                       self.store.directory)  # fmt: skip
        elif waiting_bytes < BUFFER_BYTES // 2:
            self._overflowing = False  # else a disk that is just too slow would be said with every other message
        if full or not self._open:
            self.overflowed += full
            self.failed += not full
            return False
        self._taken_bytes += cost_bytes
        self._jobs.put(kept)
        return True

    def read(
        self,
        topic: TopicName,
        boot: int,
        runs: Sequence[Run],
        stamps_ns: tuple[int, int],
        max_bytes: int,
        on_answer: OnAnswer,
    ) -> bool:
        """Have `on_answer` called with kept messages, as `Store.read` finds them. False: the store is not open."""
        if self._open:
            self._jobs.put(_Read(topic, boot, runs, *stamps_ns, max_bytes, on_answer))
        return self._open

    def flush(self) -> None:
        """Have what was taken so far safe soon."""
        if self._open:
            self._jobs.put(_Order.FLUSH)

    def close(self) -> None:
        """Have everything safe that was taken, if the disk takes it. Idempotent."""
        if self._open:
            self._open = False
            self._jobs.put(_Order.END)
            self._thread.join()

    # --- in the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while (job := self._next()) is not _Order.END:
                try:
                    self._do(job)
                except OSError as error:
                    self._refused(error)
                except Exception:  # noqa: BLE001  (of one message; the others are kept)
                    _log.exception("%s: a message could not be kept", self.store.directory)
                    self._lost([job] if isinstance(job, Kept) else [])
        finally:
            try:
                self._safe(self.store.flush())
            except OSError as error:
                self._refused(error)
            self._lost(self.store.close())

    def _next(self) -> Kept | _Read | _Order:
        try:
            due_s = self._flush_due_s
            return self._jobs.get(timeout=None if due_s is None else max(0.0, due_s - clock.now()))
        except Empty:
            return _Order.FLUSH

    def _do(self, job: Kept | _Read | _Order) -> None:
        """Raises OSError."""
        if isinstance(job, Kept):
            self._done_bytes += len(job.body) + OVERHEAD_BYTES
            self._keep(job)
        elif isinstance(job, _Read):
            self._read(job)
        else:
            self._flush()

    def _keep(self, kept: Kept) -> None:
        now = clock.now()
        if self._retry_s is not None and now < self._retry_s:
            self._lost([kept])
            return
        while True:
            try:
                self._safe(self.store.add(kept))
            except FullError:
                self._lost([kept])
                raise
            except OSError as error:
                self._lost(self.store.give_up())
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not self.store.delete_oldest():
                    self._lost([kept])
                    raise
                continue  # others have filled the disk; ours goes on with less
            break
        self._recovering = self._retry_s is not None
        if self._flush_due_s is None:
            self._flush_due_s = now + FLUSH_S

    def _flush(self) -> None:
        self._flush_due_s = None
        self._safe(self.store.flush())
        if self._recovering:
            self._recovering, self._retry_s = False, None
            self._tell(self._recovered)

    def _read(self, job: _Read) -> None:
        answer = Answer((), ())
        try:
            answer = self.store.read(job.topic, job.boot, job.runs, job.from_ns, job.to_ns, max_bytes=job.max_bytes)
        finally:
            self._tell(job.on_answer, answer)

    def _refused(self, error: OSError) -> None:
        """The disk did not take something, or gave nothing."""
        self._lost(self.store.give_up() if not isinstance(error, FullError) else [])
        self._flush_due_s, self._recovering = None, False
        self._retry_s = clock.now() + RETRY_S
        self._tell(self._told, error.strerror or str(error))

    def _safe(self, kept: Sequence[Kept]) -> None:
        if kept:
            self.written += len(kept)
            self._tell(self._now_kept, kept, True)
            self._look()

    def _lost(self, kept: Sequence[Kept]) -> None:
        if kept:
            self.failed += len(kept)
            self._tell(self._now_kept, kept, False)

    def _look(self) -> None:
        self.topics, self.streams = self.store.topics(), self.store.streams()

    def _tell(self, call: Callable[..., None], *args: object) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            self._call_soon(call, *args)

    # --- in the loop again ------------------------------------------------------------------------------------------

    def _now_kept(self, kept: Sequence[Kept], safe: bool) -> None:
        if self._on_kept is not None:
            self._on_kept(kept, safe)

    def _told(self, problem: str) -> None:
        if self.problem is None:
            _log.error("%s: nothing is kept there now: %s; make room, or mend it: it is tried again",
                       self.store.directory, problem)  # fmt: skip
        self.problem = problem

    def _recovered(self) -> None:
        self.problem = None
        _log.error("%s: messages are kept again", self.store.directory)
