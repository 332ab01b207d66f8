"""What can go wrong with a simulated run, and a record of one."""

from collections import deque
from hashlib import blake2b
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import SernError

RECENT_EVENTS: Final = 1000


class SimulationError(SernError):
    """A simulated run cannot go on."""


class SimulationStuck(SimulationError):  # noqa: N818 - a state, read as one: `except SimulationStuck`
    """Time stands still: too many events at one instant. `events` holds the last of them, oldest first."""

    def __init__(self, elapsed_s: float, limit: int, events: list[str]) -> None:
        super().__init__(
            f"simulation stuck at {elapsed_s:.9f} s after {limit} events at this instant, a deadline that stays in "
            f"the past or an endless exchange; the last were: {'; '.join(events)}"
        )
        self.events = events


class SimulationTimeoutError(SimulationError):
    """A condition did not come true within the time given."""


class Event(NamedTuple):
    """One thing that happened. `elapsed_ns` is scenario time; `place` names the port or direction."""

    elapsed_ns: int
    kind: str  # send, lost, receive, timeout, connected, disconnected, call
    place: str
    size_bytes: int


class EventLog:
    """Everything that happened in a run, as a digest and the most recent events.

    Two runs are the same exactly when their digests are: the contents of datagrams count. Costs time; off unless
    handed to the network.
    """

    def __init__(self, recent: int = RECENT_EVENTS) -> None:
        self._hash = blake2b(digest_size=16)
        self.recent: deque[Event] = deque(maxlen=recent)
        self.count = 0

    def add(self, elapsed_ns: int, kind: str, place: str, data: bytes = b"") -> None:
        self._hash.update(f"{elapsed_ns} {kind} {place} {len(data)} ".encode())
        self._hash.update(data)
        self.recent.append(Event(elapsed_ns, kind, place, len(data)))
        self.count += 1

    def digest(self) -> str:
        return self._hash.hexdigest()
