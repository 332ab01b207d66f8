"""The thread that waits for DDS, and what it hands to the event loop."""

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple, Protocol
from uuid import UUID

from cyclonedds.builtin import (
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import DDSException, GuardCondition, InstanceState
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader

from sern_client.endpoints.dds import raw
from sern_client.endpoints.dds.graph import Participant, Remote
from sern_client.endpoints.dds.names import SERN_KEY, read_user_data
from sern_client.endpoints.dds.qos import read_qos
from sern_runtime.ros_types import one_line

TAKE_AT_ONCE: Final = 64
"""Samples taken from one reader before the next has its turn."""
LAST_TAKES: Final = 16
"""How often a reader is taken from before it is let go: all that it holds, but not for as long as its writers go on."""
MAX_FAULTS_SAID: Final = 10
_WAKE, _PARTICIPANTS, _WRITERS, _READERS, _FIRST = 1, 2, 3, 4, 5

_log = logging.getLogger(__name__)


class Sample(NamedTuple):
    body: bytes
    stamp_ns: int
    handle: int  # of its writer


class Inbox:
    """What one reader has received and the event loop has not yet seen: bounded, the oldest go first.

    The worker appends, the event loop drains; a deque needs no lock for that.
    """

    def __init__(self, depth: int, deliver: Callable[[Sample], None]) -> None:
        self.depth = depth
        self.deliver = deliver
        self.samples: deque[Sample] = deque()
        self.dropped = 0
        self.closed = False


class DiscoveryEvents(Protocol):
    """Told on the event loop, in the order in which DDS said it."""

    def participant_added(self, participant: Participant) -> None: ...

    def participant_removed(self, guid: UUID) -> None: ...

    def remote_added(self, remote: Remote) -> None: ...

    def remote_removed(self, guid: UUID) -> None: ...


class Worker:
    """One thread for all readers of a participant. `stop` ends it."""

    def __init__(self, participant: DomainParticipant, events: DiscoveryEvents, *, max_buffer_bytes: int) -> None:
        self._loop = asyncio.get_running_loop()
        self._events = events
        self._max_buffer_bytes = max_buffer_bytes
        self._guard = GuardCondition(participant)
        self._waiter = raw.Waiter(participant)
        self._waiter.attach(self._guard, _WAKE)
        self._discovery = {
            _PARTICIPANTS: raw.DiscoveryReader(participant, BuiltinTopicDcpsParticipant),
            _WRITERS: raw.DiscoveryReader(participant, BuiltinTopicDcpsPublication),
            _READERS: raw.DiscoveryReader(participant, BuiltinTopicDcpsSubscription),
        }
        for number, discovered in self._discovery.items():
            self._waiter.attach_reader(discovered.reader, number)
        self._inboxes: dict[int, tuple[DataReader[Any], Inbox]] = {}
        self._next = _FIRST
        self._jobs: deque[Callable[[], None]] = deque()
        self._ready: deque[Inbox | Callable[[], None]] = deque()
        self._drain_due = False
        # Each counter has one writer (thread, event loop), so what is buffered needs no lock.
        self._taken_bytes = 0
        self._done_bytes = 0
        self._known_writers: set[int] = set()
        self.faults = 0
        self._stopping = False
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
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    async def stop(self) -> None:
        """Ends the thread; it has let go of all readers then."""
        self._stopping = True
        self._guard.set(True)
        await self._loop.run_in_executor(None, self._thread.join)
        self._drain()

    def _drain(self) -> None:
        self._drain_due = False
        try:
            for _ in range(len(self._ready)):  # what comes meanwhile has its own turn
                item = self._ready.popleft()
                if isinstance(item, Inbox):
                    self._empty(item)
                else:
                    item()
        finally:
            # A fault in one of them is reported by the loop; the others must not wait for the next event.
            if self._ready and not self._drain_due and not self._stopping:
                self._drain_due = True
                self._loop.call_soon(self._drain)

    def _empty(self, inbox: Inbox) -> None:
        for _ in range(len(inbox.samples)):
            try:
                sample = inbox.samples.popleft()
            except IndexError:
                return  # the thread dropped it for a newer one
            self._done_bytes += len(sample.body)
            if not inbox.closed:
                inbox.deliver(sample)

    # On the thread

    def _run(self) -> None:
        while not self._stopping:
            numbers = self._waiter.wait()
            self._guard.take()
            while self._jobs:
                self._try(self._jobs.popleft())
            for number in sorted(numbers):
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
            self._fault(error)

    def _fault(self, error: Exception) -> None:
        self.faults += 1
        if self.faults <= MAX_FAULTS_SAID:
            _log.error("a fault in reading from DDS: %s", one_line(error), exc_info=error)

    def _discover(self, number: int) -> None:
        while True:
            try:
                found = self._discovery[number].take()
            except ValueError as error:
                self._fault(error)  # the others are still to be taken
                continue
            if found is None:
                return
            alive = found.sample_info.instance_state == InstanceState.Alive
            if number == _PARTICIPANTS:
                self._participant(found, alive)
            else:
                self._endpoint(found, alive, writer=number == _WRITERS)

    def _participant(self, found: Any, alive: bool) -> None:
        if not alive:
            self._hand_over(partial(self._events.participant_removed, found.key))
            return
        sern = read_user_data(found.qos.user_data).get(SERN_KEY, "")
        self._hand_over(partial(self._events.participant_added, Participant(found.key, found.qos.name, sern)))

    def _endpoint(self, found: Any, alive: bool, *, writer: bool) -> None:
        handle = int(found.sample_info.instance_handle)
        if not alive:
            self._known_writers.discard(handle)
            self._hand_over(partial(self._events.remote_removed, found.key))
            return
        qos = read_qos(found.qos)
        participant, topic, type_name = found.participant_key, found.topic_name, found.type_name
        self._hand_over(
            partial(self._events.remote_added, Remote(found.key, participant, writer, topic, type_name, qos, handle))
        )

    def _take(self, number: int) -> int:
        """Take from a reader what its inbox is open for. How many samples there were."""
        entry = self._inboxes.get(number)
        if entry is None or entry[1].closed:
            return 0
        reader, inbox = entry
        added = False
        taken = raw.take(reader, TAKE_AT_ONCE)
        for body, info in taken:
            if not info.valid_data:
                continue
            if info.publication_handle not in self._known_writers:
                # A sample can be here before its writer was looked at: who speaks is to be known before what is said.
                self._discover(_PARTICIPANTS)
                self._discover(_WRITERS)
                self._known_writers.add(info.publication_handle)
            inbox.samples.append(Sample(body, info.source_timestamp, info.publication_handle))
            self._taken_bytes += len(body)
            added = True
        while inbox.samples and (
            len(inbox.samples) > inbox.depth or self._taken_bytes - self._done_bytes > self._max_buffer_bytes
        ):
            try:
                self._taken_bytes -= len(inbox.samples.popleft().body)
            except IndexError:
                break  # the event loop took the last one meanwhile
            inbox.dropped += 1
        if added:
            self._hand_over(inbox)
        return len(taken)

    def _hand_over(self, item: Inbox | Callable[[], None]) -> None:
        self._ready.append(item)
        if not self._drain_due:
            self._drain_due = True
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:
                self._stopping = True  # the loop is closed: nobody is left to hear it
