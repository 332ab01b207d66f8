"""Where the twin and what scanners see differ: found at the site of the scanners, told to the others as objects.

A discrepancy is the object `/scene/NAME/discrepancy/NUMBER@CLIENT` of kind discrepancy while it lasts. Its attributes
say all of it: `kind` (phantom, unknown_obstacle), `east_m`, `north_m` and `radius_m` of the circle around it, `cells`,
`corrected` (true, false): whether the live layer of its site says what is there instead.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sern_client.endpoints.base import SiteObjects
from sern_client.scene.hearing import Unused
from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.errors import RefusedError, UsageError
from sern_core.vocabulary.types import ObjectKind
from sern_twin.motion import MOST_M
from sern_twin.world.discrepancy import Discrepancies, Discrepancy, DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Sight
from sern_twin.world.patches import Cells

TYPE: Final = "sern/Discrepancy"
TOLD_S: Final = 0.5
"""A discrepancy that grows, as the robot comes nearer, is told so often at most, and is over after so long."""
MOST_OF_OTHERS: Final = 256


class SceneDiscrepancies:
    """`changes` counts: while it is the same, so is `all`. `unused(reason)` counts what others said and is not kept.
    `corrects`: what is found here is corrected on the map (`correction`), and told as such."""

    def __init__(
        self,
        name: str,
        client: str,
        grid: Grid,
        objects: SiteObjects,
        *,
        corrects: bool,
        unused: Callable[[Unused], None],
        said: Callable[[str], None],
    ) -> None:
        self.prefix: Final = f"/scene/{name}/discrepancy/"
        self.changes = 0
        self._client = client
        self._grid = grid
        self._objects = objects
        self._corrects = corrects
        self._unused = unused
        self._said = said
        self._world = Discrepancies(grid)
        self._correction: Cells | None = None
        self._found: tuple[Discrepancy, ...] = ()
        self._told: dict[int, tuple[Discrepancy, float]] = {}
        self._gone_s: dict[int, float] = {}
        """Since when those that were told are found no more."""
        self._all: dict[str, SeenDiscrepancy] = {}

    @property
    def left_out(self) -> int:
        """How many of this site are not told, because there are too many."""
        return self._world.left_out

    def all(self) -> tuple[SeenDiscrepancy, ...]:
        """Those of all sites, by id."""
        return tuple(each for _object_id, each in sorted(self._all.items()))

    def saw(
        self, sights: Sequence[tuple[Sight, tuple[float, float]]], twin: Cells, *, now_s: float, pose_error_m: float
    ) -> None:
        """Take what scans say, each with where its scanner was, and compare it with the twin. By any thread, one at a
        time."""
        for sight, place_m in sights:
            self._world.saw(sight.free, sight.occupied, place_m)
        self._found = self._world.compare(twin, now_s=now_s, pose_error_m=pose_error_m)
        self._correction = self._world.correction() if self._corrects else None

    @property
    def correction(self) -> Cells | None:
        """What the twin is to have where it is wrong, else unknown. None: nothing is corrected, or was compared."""
        return self._correction

    def tell(self, now_s: float) -> None:
        """Tell the others what was found, and what is over."""
        found = {each.number: each for each in self._found}
        for number in found.keys() & self._gone_s.keys():
            del self._gone_s[number]
        for number in self._told.keys() - found.keys():
            if now_s - self._gone_s.setdefault(number, now_s) < TOLD_S:
                continue  # it may be back with the next scan
            del self._told[number], self._gone_s[number]
            self._objects.delete(self._id(number))
            self._all.pop(self._id(number), None)
            self.changes += 1
        for number, thing in found.items():
            known = self._told.get(number)
            if known is not None and (now_s < known[1] + TOLD_S or self._alike(known[0], thing)):
                continue
            try:
                attributes = attributes_of(thing, self._grid.frame_id, corrected=self._corrects)
                self._objects.put(self._id(number), ObjectKind.DISCREPANCY, TYPE, attributes=attributes)
            except (RefusedError, UsageError) as error:
                self._said(str(error))
                continue
            self._told[number] = (thing, now_s)
            self._all[self._id(number)] = SeenDiscrepancy(
                self._id(number),
                self._client,
                thing.kind,
                thing.east_m,
                thing.north_m,
                thing.radius_m,
                thing.cells,
                self._corrects,
            )
            self.changes += 1

    def changed(self, item: XrObject) -> None:
        """Another site has told one."""
        seen = read_discrepancy(item)
        if seen is None:
            self._unused(Unused.UNREADABLE)
            self._said(f"{item.owner} tells of a discrepancy that cannot be read: {item.id}")
            return
        if item.id not in self._all and len(self._all) - len(self._told) >= MOST_OF_OTHERS:
            self._unused(Unused.FULL)
            return
        self._all[item.id] = seen
        self.changes += 1

    def deleted(self, object_id: str) -> None:
        if self._all.pop(object_id, None) is not None:
            self.changes += 1

    def _id(self, number: int) -> str:
        return f"{self.prefix}{number}@{self._client}"

    def _alike(self, one: Discrepancy, other: Discrepancy) -> bool:
        moved_m = math.hypot(one.east_m - other.east_m, one.north_m - other.north_m)
        return max(moved_m, abs(one.radius_m - other.radius_m)) < self._grid.cell_m


def attributes_of(thing: Discrepancy, frame_id: str, *, corrected: bool) -> dict[str, str]:
    return {
        "kind": thing.kind.value,
        "east_m": f"{thing.east_m:.3f}",
        "north_m": f"{thing.north_m:.3f}",
        "radius_m": f"{thing.radius_m:.3f}",
        "cells": str(thing.cells),
        "corrected": str(corrected).lower(),
        "frame_id": frame_id,
    }


def read_discrepancy(item: XrObject) -> SeenDiscrepancy | None:
    """None: it is none."""
    said: Mapping[str, str] = item.attributes
    try:
        kind = DiscrepancyKind(said["kind"])
        east_m, north_m, radius_m = (float(said[key]) for key in ("east_m", "north_m", "radius_m"))
        cells = int(said["cells"])
    except (KeyError, ValueError):
        return None
    if not (abs(east_m) <= MOST_M and abs(north_m) <= MOST_M and 0 < radius_m <= MOST_M and cells > 0):
        return None
    corrected = said.get("corrected") == "true"
    return SeenDiscrepancy(item.id, str(item.owner), kind, east_m, north_m, radius_m, cells, corrected)
