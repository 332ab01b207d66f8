"""The last minutes, for the slider: snapshots up to an age and a size, the oldest go first."""

from bisect import bisect_right
from collections import deque
from typing import Final

from sern_client.endpoints.twin.view.frames import Snapshot

LENGTH_S: Final = 600.0
STEP_S: Final = 0.2
MOST_BYTES: Final = 64 * 2**20
"""Ten minutes of about twenty robots; of more robots it goes less far back."""
MOST_SNAPSHOTS: Final = round(LENGTH_S / STEP_S) + 1


class History:
    """Snapshots of one clock, each at least `STEP_S` after the one before."""

    def __init__(self, *, most_bytes: int = MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._snapshots: deque[Snapshot] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._snapshots)

    @property
    def size_bytes(self) -> int:
        return self._bytes

    def due(self, now: float) -> bool:
        """Whether it is time for another one."""
        return not self._snapshots or now - self._snapshots[-1].time_s >= STEP_S - 1e-6

    def add(self, snapshot: Snapshot) -> None:
        """Keep a snapshot, if it is time. One that is too large for all of the history is the only one."""
        if not self.due(snapshot.time_s):
            return
        self._snapshots.append(snapshot)
        self._bytes += snapshot.size_bytes
        while len(self._snapshots) > 1 and (
            self._bytes > self._most_bytes
            or len(self._snapshots) > MOST_SNAPSHOTS
            or snapshot.time_s - self._snapshots[0].time_s > LENGTH_S
        ):
            self._bytes -= self._snapshots.popleft().size_bytes

    def at(self, time_s: float) -> Snapshot | None:
        """The last one that is not after that time; the oldest where all are. None: there are none."""
        if not self._snapshots:
            return None
        place = bisect_right(self._snapshots, time_s, key=_time_s)
        return self._snapshots[max(0, place - 1)]

    def reaches_s(self, now: float) -> float:
        """How far back it goes."""
        return now - self._snapshots[0].time_s if self._snapshots else 0.0


def _time_s(snapshot: Snapshot) -> float:
    return snapshot.time_s
