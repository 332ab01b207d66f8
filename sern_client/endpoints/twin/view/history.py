"""The last minutes, for the slider: snapshots, and the scene as it was, up to an age and a size."""

import zlib
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.twin.view.frames import Snapshot

if TYPE_CHECKING:  # they need what a scene does
    from sern_twin.world.discrepancy import SeenDiscrepancy
    from sern_twin.world.patches import Cells

LENGTH_S: Final = 600.0
STEP_S: Final = 0.2
MOST_BYTES: Final = 64 * 2**20
"""Ten minutes of about twenty robots; of more robots it goes less far back."""
MOST_SCENE_BYTES: Final = 32 * 2**20
SCENE_STEP_S: Final = 1.0
_MOMENT_BYTES: Final = 512
_DISCREPANCY_BYTES: Final = 512
"""What their Python objects take."""
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


@dataclass(frozen=True, slots=True)
class SceneMoment:
    """The scene as it was from `time_s` on."""

    time_s: float
    discrepancies: "tuple[SeenDiscrepancy, ...]"
    _shape: tuple[int, ...]
    _cells: bytes
    _ages_s: bytes

    @classmethod
    def of(
        cls, time_s: float, cells: "Cells", ages_s: NDArray[np.float64], discrepancies: "tuple[SeenDiscrepancy, ...]"
    ) -> "SceneMoment":
        ages = ages_s.astype(np.float32).tobytes()
        return cls(time_s, discrepancies, cells.shape, zlib.compress(cells.tobytes(), 1), zlib.compress(ages, 1))

    @property
    def cells(self) -> "Cells":
        return np.frombuffer(zlib.decompress(self._cells), np.int8).reshape(self._shape)

    @property
    def ages_s(self) -> NDArray[np.float64]:
        return np.frombuffer(zlib.decompress(self._ages_s), np.float32).astype(np.float64)

    @property
    def size_bytes(self) -> int:
        return _MOMENT_BYTES + len(self._cells) + len(self._ages_s) + _DISCREPANCY_BYTES * len(self.discrepancies)


class SceneHistory:
    """Moments of a scene, one whenever it has changed, at least `SCENE_STEP_S` apart."""

    def __init__(self, *, most_bytes: int = MOST_SCENE_BYTES) -> None:
        self._most_bytes = most_bytes
        self._moments: deque[SceneMoment] = deque()
        self._bytes = 0
        self._changes = -1

    def __len__(self) -> int:
        return len(self._moments)

    @property
    def size_bytes(self) -> int:
        return self._bytes

    def due(self, now: float, changes: int) -> bool:
        """Whether to add one now; `changes`: of the scene."""
        late = not self._moments or now - self._moments[-1].time_s >= SCENE_STEP_S - 1e-6
        return late and changes != self._changes

    def add(self, moment: SceneMoment, changes: int) -> None:
        self._changes = changes
        self._moments.append(moment)
        self._bytes += moment.size_bytes
        # The oldest still says what was, until the next one is as old as all that is kept.
        while len(self._moments) > 1 and (
            self._bytes > self._most_bytes or moment.time_s - self._moments[1].time_s > LENGTH_S
        ):
            self._bytes -= self._moments.popleft().size_bytes

    def at(self, time_s: float) -> SceneMoment | None:
        """The scene as it was then, or at first where that is before. None: there is nothing."""
        if not self._moments:
            return None
        return self._moments[max(0, bisect_right(self._moments, time_s, key=_time_s) - 1)]


def _time_s(entry: Snapshot | SceneMoment) -> float:
    return entry.time_s
