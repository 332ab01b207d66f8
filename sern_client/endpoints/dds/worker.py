"""The thread that waits for DDS, and what it hands to the event loop."""

import asyncio
import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias

from cyclonedds.builtin import (
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import DDSException, GuardCondition
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader

from sern_client.endpoints.dds import raw
from sern_client.endpoints.dds.discovery import PARTICIPANTS, READERS, WRITERS, Discovery, DiscoveryEvents
from sern_runtime.clock import now
from sern_runtime.ros_types import one_line

TAKE_AT_ONCE: Final = 64
"""Samples taken from one reader before the next has its turn."""
SERVE_S: Final = 0.005
"""How long the event loop is held by what the thread hands over before others have their turn."""
READER_HISTORY: Final = 1000
"""What DDS may hold until the worker takes it, usually within a millisecond. What overflows there nobody could count,
so the bound that counts is the inbox behind it."""
MAX_FOUND: Final = 1000
"""Discoveries that wait for the event loop until DDS is asked for no more: it keeps the state, not each change."""
SAME_S: Final = 10.0
"""A reader in place of another may get what that one had received so late after its first look."""
_WAKE, _FIRST = 4, 5

_log = logging.getLogger(__name__)


Key: TypeAlias = tuple[int, int, int]
"""Which sample it is, as far as two readers can tell: handle of its writer, source time stamp, hash of its body."""


class Sample(NamedTuple):
    body: bytes
    stamp_ns: int
    handle: int  # of its writer


class Inbox:
    """What one reader has received and the event loop has not yet seen: bounded, the oldest go first.

    The worker appends, the event loop drains; a deque needs no lock for that. Samples are numbered; `came` is the last
    number. `history`: how many samples its reader may hold. With `repeats`, the reader may be made anew at any time and
    then gets its history again.
    """

    def __init__(self, depth: int, deliver: Callable[[Sample], None], *, repeats: bool = False) -> None:
        self.depth = depth
        self.history = max(depth, READER_HISTORY)
        self.deliver = deliver
        self.samples: deque[tuple[int, Sample]] = deque()
        self.came = 0
        self.dropped = 0
        self.closed = False
        self._repeats = repeats
        self._taken: deque[Key] | None = None
        """The last that its reader has taken, while another reader may get the same."""
        self._skipped: Counter[Key] = Counter()
        """What the reader before took."""
        self._skip_until_s = 0.0
        self.record(on=repeats)

    # On the event loop

    def record(self, *, on: bool = True) -> None:
        """Note what is taken from now on, for the reader to come; to be called before that one is made.

        Off: it is not to come after all.
        """
        if on and self._taken is None:
            self._taken = deque(maxlen=self.history)
        elif not on and not self._repeats:
            self._taken = None

    # On the thread

    def follow(self, before: "Inbox") -> None:
        """Skip once each that the reader of `before` has taken, and what that one was still to skip.

        Both readers receive for a while, so that nothing is lost between them, and a transient-local one gets history.
        """
        keys = [*before._skipped.elements(), *(before._taken or ())]
        self._skipped = Counter(keys[-self.history :])
        self._skip_until_s = now() + SAME_S

    def is_new(self, body: bytes, stamp_ns: int, handle: int) -> bool:
        """Whether a sample that is taken was not taken by the reader before."""
        taken = self._taken
        if taken is None and not self._skipped:
            return True
        key = handle, stamp_ns, hash(body)
        if taken is not None:
            taken.append(key)
        if not self._skipped:
            return True
        if now() >= self._skip_until_s:
            self._skipped.clear()
            return True
        times = self._skipped.pop(key, 0)
        if times > 1:
            self._skipped[key] = times - 1
        return not times


class Arrived(NamedTuple):
    """An inbox, and the number of the last sample in it when this was handed over: what came later may be of a writer
    that the event loop has not been told of."""

    inbox: Inbox
    last: int


class Worker:
    """One thread for all readers of a participant. `stop` ends it.

    `settle` is called on the event loop after discoveries were told, until it returns False: one step of what follows
    from all of them together.
    """

    def __init__(
        self,
        participant: DomainParticipant,
        events: DiscoveryEvents,
        settle: Callable[[], bool],
        *,
        max_buffer_bytes: int,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._max_buffer_bytes = max_buffer_bytes
        self._guard = GuardCondition(participant)
        self._waiter = raw.Waiter(participant)
        self._waiter.attach(self._guard, _WAKE)
        self._held_waiter = raw.Waiter(participant)
        self._held_waiter.attach(self._guard, _WAKE)
        readers = {
            PARTICIPANTS: raw.DiscoveryReader(participant, BuiltinTopicDcpsParticipant),
            WRITERS: raw.DiscoveryReader(participant, BuiltinTopicDcpsPublication),
            READERS: raw.DiscoveryReader(participant, BuiltinTopicDcpsSubscription),
        }
        self._discovery = Discovery(readers, events)
        for number, discovered in readers.items():
            self._waiter.attach_reader(discovered.reader, number)
        self._inboxes: dict[int, tuple[DataReader[Any], Inbox]] = {}
        self._next = _FIRST
        self._jobs: deque[Callable[[], None]] = deque()
        self._ready: deque[Arrived | Callable[[], None]] = deque()
        self._drain_due = False
        self._settle = settle
        self._unsettled = False
        # Each counter has one writer (thread, event loop), so what is buffered needs no lock.
        self._taken_bytes = 0
        self._done_bytes = 0
        # So do these: what was handed over that is no message.
        self._found = 0
        self._served = 0
        self._held = False
        self._faults = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sern-dds", daemon=True)
        self._thread.start()

    # On the event loop

    def watch(self, reader: DataReader[Any], inbox: Inbox, before: Inbox | None = None) -> int:
        """Take what the reader receives; the number is for `unwatch`.

        `before`: inbox of the reader in whose place it is, which is unwatched already; what that took is skipped.
        """
        number = self._next
        self._next += 1

        def begin() -> None:
            if before is not None:
                inbox.follow(before)
            self._inboxes[number] = reader, inbox
            self._waiter.attach_reader(reader, number)
            if not self._behind:
                self._take(number)  # what came before

        self._do(begin)
        return number

    def unwatch(self, number: int, ended: Callable[[], None]) -> None:
        """Let go of a reader, which is deleted on this worker's thread unless somebody else holds it.

        What it has received is taken first, unless its inbox is closed. `ended` is called on the event loop when no
        more comes, but not after `stop`.
        """

        def end() -> None:
            self._waiter.detach(number)
            entry = self._inboxes[number]
            try:
                # All that it can hold, but not for as long as its writers go on.
                for _ in range(entry[1].history // TAKE_AT_ONCE + 1):
                    if self._take(number) < TAKE_AT_ONCE:
                        break
            finally:
                del self._inboxes[number]
                self._hand_over(ended)

        self._do(end)

    def let_go(self, kept: list[Any]) -> None:
        """Empty the list, which alone holds an entity, on the thread rather than on the event loop: DDS may wait."""
        self._do(kept.clear)

    def _do(self, job: Callable[[], None]) -> None:
        self._jobs.append(job)
        self._guard.set(True)

    @property
    def faults(self) -> int:
        """How many announcements could not be read, and how many readers could not be read from."""
        return self._faults + self._discovery.unreadable

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    async def stop(self) -> None:
        """Ends the thread; it has let go of all readers then."""
        self._stopping.set()
        self._guard.set(True)
        await self._loop.run_in_executor(None, self._thread.join)
        while self._ready:
            self._drain()

    def _drain(self) -> None:
        """Serve what is ready, for a few milliseconds; the rest after what else the event loop has to do.

        What follows from all discoveries of a turn is settled at its end, or first in the next: a topic with thousands
        of writers is not looked at for each of them.
        """
        self._drain_due = False
        end_s = now() + SERVE_S
        try:
            if not self._settled(end_s):
                return
            for _ in range(len(self._ready)):  # what comes meanwhile has its own turn
                item = self._ready[0]
                if not isinstance(item, Arrived):
                    self._ready.popleft()
                    self._served += 1
                    self._unsettled = True
                    item()
                elif self._empty(*item, end_s):
                    self._ready.popleft()
                if now() >= end_s:
                    return
            self._settled(end_s)
        finally:
            if self._held and not self._behind:
                self._guard.set(True)
            # A fault in one of them is reported by the loop; the others must not wait for the next event.
            if (self._ready or self._unsettled) and not self._drain_due and not self._stopping.is_set():
                self._drain_due = True
                self._loop.call_soon(self._drain)

    def _settled(self, end_s: float) -> bool:
        """Settle what was found, until `end_s`. Whether nothing is left, nor the time over."""
        while self._unsettled:
            self._unsettled = self._settle()
            if now() >= end_s:
                return False
        return True

    def _empty(self, inbox: Inbox, last: int, end_s: float) -> bool:
        """Deliver the samples up to number `last`, or until `end_s`. Whether none of them is left."""
        while inbox.samples:
            try:
                number, sample = inbox.samples.popleft()
            except IndexError:
                return True  # the thread dropped it for a newer one
            if number > last:
                inbox.samples.appendleft((number, sample))
                return True
            self._done_bytes += len(sample.body)
            if not inbox.closed:
                inbox.deliver(sample)
            if number < last and now() >= end_s:
                return False
        return True

    # On the thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            numbers = self._wait()
            self._guard.take()
            while self._jobs:
                self._try(self._jobs.popleft())
            # Messages first: discoveries may leave no time for more. Writers that are new are found before those are.
            for number in sorted(numbers, reverse=True):
                if self._stopping.is_set() or self._behind:
                    break
                if number >= _FIRST:
                    self._try(partial(self._take, number))
                elif number != _WAKE:
                    self._try(partial(self._discover, number))
        self._waiter.close()
        self._held_waiter.close()
        self._inboxes.clear()
        self._jobs.clear()

    def _wait(self) -> list[int]:
        """The numbers of what is ready. None while the event loop is behind, but there may be jobs.

        All is left in DDS then, messages too: who speaks is to be known before what is said.
        """
        self._held = True  # first: the event loop may catch up at any moment, and has to wake this thread
        if self._behind:
            return self._held_waiter.wait()
        self._held = False
        return self._waiter.wait()

    @property
    def _behind(self) -> bool:
        return self._found - self._served >= MAX_FOUND

    def _try(self, step: Callable[[], object]) -> None:
        """What one peer says or one reader does must not end the thread for all."""
        try:
            step()
        except (DDSException, OSError, ValueError, TypeError, AttributeError) as error:
            self._faults += 1
            _log.error("a fault in reading from DDS: %s", one_line(error), exc_info=error)

    def _discover(self, number: int) -> None:
        """What is left after one look makes the next wait a short one."""
        try:
            self._discovery.look(number)
        finally:
            self._tell_found()

    def _find_writers(self, handles: Iterable[int]) -> None:
        try:
            for handle in handles:
                if not self._discovery.find_writer(handle):
                    break
        finally:
            self._tell_found()

    def _tell_found(self) -> None:
        while self._discovery.found:
            self._hand_over(self._discovery.found.popleft())

    def _take(self, number: int) -> int:
        """Take from a reader what its inbox is open for. How many samples there were."""
        entry = self._inboxes.get(number)
        if entry is None or entry[1].closed:
            return 0
        reader, inbox = entry
        added = False
        taken = raw.take(reader, TAKE_AT_ONCE)
        self._try(partial(self._find_writers, {info.publication_handle: None for _, info in taken}))
        for body, info in taken:
            if not info.valid_data or not inbox.is_new(body, info.source_timestamp, info.publication_handle):
                continue
            inbox.came += 1
            inbox.samples.append((inbox.came, Sample(body, info.source_timestamp, info.publication_handle)))
            self._taken_bytes += len(body)
            added = True
        while inbox.samples and (
            len(inbox.samples) > inbox.depth or self._taken_bytes - self._done_bytes > self._max_buffer_bytes
        ):
            try:
                self._taken_bytes -= len(inbox.samples.popleft()[1].body)
            except IndexError:
                break  # the event loop took the last one meanwhile
            inbox.dropped += 1
        if added:
            self._hand_over(Arrived(inbox, inbox.came))
        return len(taken)

    def _hand_over(self, item: Arrived | Callable[[], None]) -> None:
        self._found += not isinstance(item, Arrived)
        self._ready.append(item)
        if not self._drain_due:
            self._drain_due = True
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:
                self._stopping.set()  # the loop is closed: nobody is left to hear it
