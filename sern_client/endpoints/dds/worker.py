"""The thread that waits for DDS, and what it hands to the event loop."""

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final, NamedTuple

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
LAST_TAKES: Final = 16
"""How often a reader is taken from before it is let go: all that it holds, but not for as long as its writers go on."""
_WAKE, _FIRST = 4, 5

_log = logging.getLogger(__name__)


class Sample(NamedTuple):
    body: bytes
    stamp_ns: int
    handle: int  # of its writer


class Inbox:
    """What one reader has received and the event loop has not yet seen: bounded, the oldest go first.

    The worker appends, the event loop drains; a deque needs no lock for that. Samples are numbered; `came` is the last
    number.
    """

    def __init__(self, depth: int, deliver: Callable[[Sample], None]) -> None:
        self.depth = depth
        self.deliver = deliver
        self.samples: deque[tuple[int, Sample]] = deque()
        self.came = 0
        self.dropped = 0
        self.closed = False


class Arrived(NamedTuple):
    """An inbox, and the number of the last sample in it when this was handed over: what came later may be of a writer
    that the event loop has not been told of."""

    inbox: Inbox
    last: int


class Worker:
    """One thread for all readers of a participant. `stop` ends it."""

    def __init__(self, participant: DomainParticipant, events: DiscoveryEvents, *, max_buffer_bytes: int) -> None:
        self._loop = asyncio.get_running_loop()
        self._max_buffer_bytes = max_buffer_bytes
        self._guard = GuardCondition(participant)
        self._waiter = raw.Waiter(participant)
        self._waiter.attach(self._guard, _WAKE)
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
        # Each counter has one writer (thread, event loop), so what is buffered needs no lock.
        self._taken_bytes = 0
        self._done_bytes = 0
        self._faults = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sern-dds", daemon=True)
        self._thread.start()

    # On the event loop

    def watch(self, reader: DataReader[Any], inbox: Inbox) -> int:
        """Take what the reader receives; the number is for `unwatch`."""
        number = self._next
        self._next += 1

        def begin() -> None:
            self._inboxes[number] = reader, inbox
            self._waiter.attach_reader(reader, number)
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
            try:
                for _ in range(LAST_TAKES):
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
        """Serve what is ready, for a few milliseconds; the rest after what else the event loop has to do."""
        self._drain_due = False
        end_s = now() + SERVE_S
        try:
            for _ in range(len(self._ready)):  # what comes meanwhile has its own turn
                item = self._ready[0]
                if not isinstance(item, Arrived):
                    self._ready.popleft()
                    item()
                elif self._empty(*item, end_s):
                    self._ready.popleft()
                if now() >= end_s:
                    break
        finally:
            # A fault in one of them is reported by the loop; the others must not wait for the next event.
            if self._ready and not self._drain_due and not self._stopping.is_set():
                self._drain_due = True
                self._loop.call_soon(self._drain)

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
            numbers = self._waiter.wait()
            self._guard.take()
            while self._jobs:
                self._try(self._jobs.popleft())
            for number in sorted(numbers):
                if self._stopping.is_set():
                    break
                if number >= _FIRST:
                    self._try(partial(self._take, number))
                elif number != _WAKE:
                    self._try(partial(self._discover, number))
        self._waiter.close()
        self._inboxes.clear()
        self._jobs.clear()

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
            if not info.valid_data:
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
        self._ready.append(item)
        if not self._drain_due:
            self._drain_due = True
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:
                self._stopping.set()  # the loop is closed: nobody is left to hear it
