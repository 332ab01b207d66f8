"""What comes and goes in a domain, as DDS tells it, made into events. It runs on the thread that waits for DDS."""

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, Protocol
from uuid import UUID

from sern_client.endpoints.dds.graph import Participant, Remote
from sern_client.endpoints.dds.names import SERN_ENCLAVE, SERN_KEY, read_user_data
from sern_client.endpoints.dds.qos import read_qos
from sern_client.endpoints.dds.raw import Change

PARTICIPANTS: Final = 1
WRITERS: Final = 2
READERS: Final = 3

AT_ONCE: Final = 64
"""How many changes are taken from DDS in one call; each may have 64 kB of user data."""
CALLS: Final = 4
"""How many calls are made before others have their turn."""
MOST_ROUNDS: Final = 4
"""How often others wait until what they ask for is found: a flood of announcements must not hold them for ever."""


class Source(Protocol):
    """What participants, or writers, or readers there are."""

    def take(self, count: int) -> tuple[list[Change], int]:
        """Up to `count` changes that were not taken before, and how many of them could not be read."""
        ...


class DiscoveryEvents(Protocol):
    """Told on the event loop, in the order in which DDS said it."""

    def participant_added(self, participant: Participant) -> None:
        """It came, or says something else of itself."""

    def participant_removed(self, guid: UUID) -> None: ...

    def remote_added(self, remote: Remote) -> None:
        """It came, or has other policies."""

    def remote_removed(self, guid: UUID) -> None: ...


class Discovery:
    """Events of three sources. `found`: those to be told; `unreadable`: how many announcements were passed over."""

    def __init__(self, sources: Mapping[int, Source], events: DiscoveryEvents) -> None:
        self._sources = sources
        self._events = events
        self._writers: set[int] = set()
        self.found: deque[Callable[[], None]] = deque()
        self.unreadable = 0

    def look(self, number: int) -> bool:
        """Find what is new in one of the sources, some hundred changes at most. Whether there may be more."""
        for _ in range(CALLS):
            changes, unreadable = self._sources[number].take(AT_ONCE)
            self.unreadable += unreadable
            if number == PARTICIPANTS:
                for change in changes:
                    self._participant(change)
            elif changes:
                # Whose they are is to be known before they are: a SERN endpoint's writer is none of this site.
                self._look_until(PARTICIPANTS, lambda: False)
                for change in changes:
                    self._endpoint(change, writer=number == WRITERS)
            if len(changes) + unreadable < AT_ONCE:
                return False
        return True

    def find_writer(self, handle: int) -> bool:
        """Find the writer with this handle, if it is new: who speaks is to be known before what is said.

        False when there are so many others that it was given up.
        """
        return handle in self._writers or self._look_until(WRITERS, lambda: handle in self._writers)

    def _look_until(self, number: int, found: Callable[[], bool]) -> bool:
        """Look until it is found or nothing is left; False when there was still more after `MOST_ROUNDS`."""
        return any(not self.look(number) or found() for _ in range(MOST_ROUNDS))

    def _participant(self, change: Change) -> None:
        said = change.announced
        if said is None:
            self.found.append(partial(self._events.participant_removed, change.guid))
            return
        told = read_user_data(said.user_data)
        sern = told.get(SERN_KEY, "") or ("sern" if told.get("enclave") == SERN_ENCLAVE else "")
        self.found.append(partial(self._events.participant_added, Participant(change.guid, said.name, sern)))

    def _endpoint(self, change: Change, *, writer: bool) -> None:
        if change.announced is None:
            self._writers.discard(change.handle)
            self.found.append(partial(self._events.remote_removed, change.guid))
            return
        if writer:
            self._writers.add(change.handle)
        qos = read_qos(change.announced)
        remote = Remote(change.guid, change.participant, writer, change.topic, change.type_name, qos, change.handle)
        self.found.append(partial(self._events.remote_added, remote))
