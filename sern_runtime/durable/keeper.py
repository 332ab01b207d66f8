"""Writes to the store in a thread of its own, many messages with one sync (group commit).

While one commit is on its way to the disk the next batch gathers, so a quiet topic waits for one sync and a busy one
shares it. What only makes room (`Trim`, `Place`) waits for company, `IDLE_S` at most.
"""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.durable.store import (
    ROW_BYTES,
    Change,
    Contents,
    Described,
    Forget,
    Place,
    Put,
    Store,
    StoreError,
    Trim,
)

IDLE_S: Final = 0.25
RETRY_S: Final = 1.0
"""How often a disk that did not take a batch is asked again."""
SLOW_S: Final = 10.0
"""One attempt may take as long before the thread counts as stuck: cards and disks do stand still for seconds."""
BATCH_BYTES: Final = 4 * 2**20
"""Bodies of one commit: it holds nothing up, but all of it is to be read again if it fails."""

_log = logging.getLogger(__name__)


Stored = Callable[[Sequence[Put]], None]
"""`stored(puts)`: these are on disk now, in this order."""


class Keeps(Protocol):
    """What a user of the store sees of a `Keeper`."""

    kept_bytes: int
    problem: str | None
    messages: int
    commits: int
    failures: int

    def start(self) -> None: ...

    def has_room(self, origin: ClientName, size_bytes: int) -> bool: ...

    def found(self, stream: StreamId, seq: int, size_bytes: int) -> None: ...

    def put(self, change: Put) -> None: ...

    def trim(self, stream: StreamId, upto: int) -> None: ...

    def forget(self, stream: StreamId) -> None: ...

    def change(self, change: Described | Place) -> None: ...

    def progress(self, *, now: float) -> int: ...

    def close(self) -> None: ...


class OpensStore(Protocol):
    """What a user of the store sees of a `Store`."""

    def open(self, *, new_boot: int) -> Contents: ...

    def close(self) -> None: ...


class Keeper:
    """`stored(changes)` is called in the loop, by `call_soon`, with what is on disk now, in its order. `problem`: why
    nothing gets there, None: it does.

    `shared`: an origin may have no more than is left free then, so that none can take the room of the others: one alone
    has half of it, of n each the part 1/(n + 1) (dynamic thresholds with α = 1, Choudhury and Hahne 1998).
    """

    def __init__(
        self,
        store: Store,
        *,
        call_soon: Callable[..., object],
        stored: Stored,
        max_bytes: int,
        shared: bool = False,
    ) -> None:
        self._store = store
        self._call_soon = call_soon
        self._stored = stored
        self._max_bytes = max_bytes
        self._shared = shared
        self._changes: deque[Change] = deque()
        self._urgent = 0  # of those, how many somebody waits for
        self._closing = False
        self._busy = False  # something is to be written, or is being written
        self._at_s = clock.now()  # when that began, or the last attempt
        self._looks = 0
        self._condition = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="durable", daemon=True)
        self._sizes: dict[StreamId, deque[tuple[int, int]]] = {}  # of what is kept: seq, bytes
        self._of: Counter[ClientName] = Counter()
        self.kept_bytes = 0
        """What is kept, or about to be, overhead included."""
        self.problem: str | None = None
        self.messages = 0
        self.commits = 0
        self.failures = 0

    # --- in the loop ----------------------------------------------------------------------------------------------

    def start(self) -> None:
        self._thread.start()

    def has_room(self, origin: ClientName, size_bytes: int) -> bool:
        """Whether a message of this size may be put."""
        needed = size_bytes + ROW_BYTES
        free = self._max_bytes - self.kept_bytes
        return needed + (self._of[origin] if self._shared else 0) <= free

    def found(self, stream: StreamId, seq: int, size_bytes: int) -> None:
        """This message was in the store from the beginning."""
        self._sizes.setdefault(stream, deque()).append((seq, size_bytes + ROW_BYTES))
        self._count(stream, size_bytes + ROW_BYTES)

    def _count(self, stream: StreamId, more_bytes: int) -> None:
        self.kept_bytes += more_bytes
        self._of[stream.origin] += more_bytes
        if not self._of[stream.origin]:
            del self._of[stream.origin]

    def put(self, change: Put) -> None:
        """Keep a message; the seqs of a stream rise."""
        self.found(change.stream, change.row.seq, len(change.row.body))
        self._add(change, urgent=True)

    def trim(self, stream: StreamId, upto: int) -> None:
        """Let go of what is delivered."""
        sizes = self._sizes.get(stream, ())
        while sizes and sizes[0][0] <= upto:
            self._count(stream, -sizes.popleft()[1])
        if not sizes:
            self._sizes.pop(stream, None)
        self._add(Trim(stream, upto), urgent=False)

    def forget(self, stream: StreamId) -> None:
        """Let go of a stream with all that is left of it."""
        self._count(stream, -sum(size_bytes for _seq, size_bytes in self._sizes.pop(stream, ())))
        self._add(Forget(stream), urgent=False)

    def change(self, change: Described | Place) -> None:
        """Whatever else is to be written, in its turn."""
        self._add(change, urgent=False)

    def progress(self, *, now: float) -> int:
        """A number for the watchdog, another one at each look: but not when an attempt takes longer than `SLOW_S`, and
        not when the thread has ended. A disk that refuses is no lack of progress: it is asked again."""
        if self._thread.is_alive() and (not self._busy or now - self._at_s < SLOW_S):
            self._looks += 1
        return self._looks

    def _add(self, change: Change, *, urgent: bool) -> None:
        with self._condition:
            if not self._busy:
                self._busy, self._at_s = True, clock.now()
            self._changes.append(change)
            self._urgent += urgent
            self._condition.notify()

    def close(self) -> None:
        """Write what waits, if the disk takes it, and end the thread."""
        with self._condition:
            self._closing = True
            self._condition.notify()
        if self._thread.is_alive():
            self._thread.join()
        left = sum(isinstance(change, Put) for change in self._changes)
        if left:
            _log.error("%d durable messages could not be kept, and are lost if nobody got them: %s", left, self.problem)

    # --- in the thread --------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while True:
                batch = self._take()
                if batch is None:
                    return
                if not self._write(batch):
                    with self._condition:
                        self._changes.extendleft(reversed(batch))
                    return
        finally:
            self._store.close()

    def _take(self) -> list[Change] | None:
        """The next batch, once there is one; None: there is none, and nothing more will come."""
        with self._condition:
            self._busy = bool(self._changes)
            self._condition.wait_for(lambda: self._changes or self._closing)
            self._condition.wait_for(lambda: self._urgent or self._closing, timeout=IDLE_S)
            if not self._changes:
                return None
            batch: list[Change] = []
            size_bytes = 0
            while self._changes and size_bytes < BATCH_BYTES:
                change = self._changes.popleft()
                batch.append(change)
                if isinstance(change, Put):
                    self._urgent -= 1
                    size_bytes += len(change.row.body) + ROW_BYTES
            return batch

    def _write(self, batch: list[Change]) -> bool:
        """Have a batch on disk, however long that takes. False: we are closing, and it does not take it."""
        while True:
            self._at_s = clock.now()
            try:
                self._store.apply(batch)
            except StoreError as error:
                self.failures += 1
                self._call_soon(self._failed, str(error))
            else:
                self.commits += 1
                puts = [change for change in batch if isinstance(change, Put)]
                self._call_soon(self._done, puts)
                return True
            with self._condition:
                if self._condition.wait_for(lambda: self._closing, timeout=RETRY_S):
                    return False

    # --- in the loop again ----------------------------------------------------------------------------------------

    def _failed(self, problem: str) -> None:
        if self.problem is None:
            _log.error("durable topics wait for the disk: %s; make room, or mend it: it is tried again", problem)
        self.problem = problem

    def _done(self, puts: list[Put]) -> None:
        if self.problem is not None:
            _log.error("durable topics are kept again")
            self.problem = None
        self.messages += len(puts)
        if puts:
            self._stored(puts)
