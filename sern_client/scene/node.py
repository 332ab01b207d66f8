"""The scene of a site: its own scans and obstacles go into it and to all others as objects, theirs come in, and all of
it together is a map on a topic of this site.

Each block of each layer is an object `/scene/NAME/LAYER/BLOCK@CLIENT` of kind patch, whose value is the whole block as
it is now (`sern_twin.world.patches`): whoever missed one is right with the next, and after a blackout only blocks that
have changed are told. The map is nav_msgs/OccupancyGrid, latched, and what changes in it map_msgs/OccupancyGridUpdate:
the static layer of a costmap takes both. Where scanners see something else than the twin has is told beside it
(`differing.py`), and what they see is what the map has there.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.base import Held, Publisher, Sink, SiteObjects, Subscription
from sern_client.endpoints.common.saying import SayOnce
from sern_client.scene import bodies
from sern_client.scene.differing import SceneDiscrepancies
from sern_client.scene.hearing import Obstacles, Placed, Scanner, Unused
from sern_client.scene.options import SceneOptions
from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.errors import BodyError, ConfigError, RefusedError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import Encoding, ObjectKind, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.map_bodies import MapWriter
from sern_runtime.metrics import Metrics
from sern_twin.world.correction import corrected, map_cells, twin_cells
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.grid import Grid
from sern_twin.world.map_updates import MapUpdateOptions, MapUpdates
from sern_twin.world.mesh import Mesh
from sern_twin.world.occupancy import Occupancy
from sern_twin.world.offset import object_offset
from sern_twin.world.patches import (
    CLEARED,
    LASTING,
    LAYERS,
    OCCUPIED,
    UNKNOWN,
    BlockKey,
    Cells,
    Refusal,
    read_header,
)
from sern_twin.world.scene import Scene
from sern_twin.world.terrain import Terrain
from sern_twin.world.update_rates import UpdateRates

PERIOD_S: Final = 0.1
WHOLE_S: Final = 5.0
"""How often the whole map is published at most: to who comes late, the last one is latched."""
MOST_UPDATES: Final = 64
"""The most blocks that are published at once."""
REPEAT_S: Final = 1.0
"""One block is published over again so often where nothing changes: who missed an update has it in the end, and who
navigates by the map knows that it is one of now."""
DISCREPANCIES_S: Final = 0.5
"""How often discrepancies are published at most."""
OFFSETS_S: Final = 1.0
OFFSET_RADIUS_M: Final = 0.5
"""How far from where it was added an obstacle is looked for in what is seen."""
PATCH_TYPE: Final = "sern/ScenePatch"
MOST_OBJECTS: Final = 4_000
"""Blocks of one site's layers: a client may have 4,096 objects."""

_log = logging.getLogger(__name__)


class SceneNode:
    """`subscribe` and `advertise` are the endpoint's, `encoding` is that of the map. `wall_ns`: a new process begins
    its versions there."""

    def __init__(
        self,
        options: SceneOptions,
        grid: Grid,
        client: str,
        *,
        base: Cells | None,
        ground: Mesh | None = None,
        terrain: Terrain | None = None,
        encoding: Encoding,
        subscribe: Callable[[TopicName, Sink], Subscription],
        advertise: Callable[[TopicInfo], Publisher],
        objects: SiteObjects,
        now: Callable[[], float] = clock.now,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.options = options
        self.grid = grid
        self.scene = Scene(grid, client, first_version=wall_ns() // 1_000_000)
        self.occupancy = Occupancy(grid)
        self.ground = ground
        """The ground and what stands on it, for who looks at it."""
        self.terrain = terrain
        self.unused: Counter[Unused] = Counter()
        self.offsets_m: dict[str, float] = {}
        """How far what is seen of an obstacle is from where it was added, by its marker."""
        self._client = client
        self._subscribe = subscribe
        self._advertise = advertise
        self._objects = objects
        self._now = now
        self._wall_ns = wall_ns
        self._prefix = f"/scene/{options.name}/"
        self._scanners = [Scanner(each, grid, self.unused) for each in options.scanners]
        self._rates = UpdateRates(grid, options.rates)
        self._twin: tuple[Cells, NDArray[np.bool_]] | None = None
        """What the twin has without what is seen, and where somebody added something; None: it has changed since."""
        self._pose_error_m = max((each.pose_error_m for each in options.scanners), default=0.0)
        self.obstacles = Obstacles(grid, self.unused)
        self._map_writer = MapWriter(grid, encoding)
        self._writer = bodies.Writer(self._map_writer, encoding)
        self._updates = MapUpdates(grid, MapUpdateOptions(WHOLE_S, 0.0, MOST_UPDATES, REPEAT_S))
        self._encoding = encoding
        self._subscriptions: dict[TopicName, list[Subscription]] = {}
        self._publishers: dict[TopicName, Publisher] = {}
        self._published_changes = -1
        self._changed_s: NDArray[np.float64] = np.full(grid.blocks, np.nan)
        self.changes = 0
        """How often any block has changed: while it is the same, so are the cells."""
        self._offsets_due_s = now()
        self._said = SayOnce(_log)
        self.differing = SceneDiscrepancies(
            options.name, client, grid, objects, corrects=options.corrects,
            unused=self._unused, said=lambda text: self._said(f"scene: {text}", text),
        )  # fmt: skip
        self._differing_due_s = now()
        self._differing_changes = 0
        if base is not None:
            self.scene.set_cells("base", base)
        objects.listen(self)

    # --- topics of the site -------------------------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        if info.name in self._subscriptions:
            return
        found: list[Subscription] = []
        wanted = [(scanner.options.scan, bodies.SCAN, scanner.scan) for scanner in self._scanners]
        wanted += [(scanner.options.pose, bodies.ODOMETRY, scanner.pose) for scanner in self._scanners]
        if self.options.obstacles is not None:
            wanted.append((self.options.obstacles, bodies.MARKER, self.obstacles.heard))
        for name, type_name, hear in wanted:
            if name != info.name:
                continue
            if plain_type(info.type_name) != plain_type(type_name) or info.encoding is Encoding.RAW:
                self._said(f"scene: {name} is {info.type_name}, and {type_name} is read; it is left out", name)
                continue
            found.append(self._subscribe(info.name, partial(self._heard, info, hear)))
        if found:
            self._subscriptions[info.name] = found

    def topic_removed(self, name: TopicName) -> None:
        for subscription in self._subscriptions.pop(name, ()):
            subscription.close()

    def _heard(self, info: TopicInfo, hear: Callable[[bytes, Encoding], None], body: bytes, stamp_ns: int) -> bool:
        try:
            hear(body, info.encoding)
        except BodyError as error:
            self.unused[Unused.UNREADABLE] += 1
            self._said(f"scene: {info.name}: {error}", str(info.name))
        return True

    @property
    def held(self) -> Held:
        return Held(
            Counter(self._publishers.keys()),
            Counter({name: len(held) for name, held in self._subscriptions.items()}),
        )

    def close(self) -> None:
        for name in list(self._subscriptions):
            self.topic_removed(name)
        for publisher in self._publishers.values():
            publisher.close()
        self._publishers.clear()

    # --- objects of others --------------------------------------------------------------------------------------------

    def changed(self, item: XrObject) -> None:
        if item.kind is ObjectKind.DISCREPANCY and item.id.startswith(self.differing.prefix):
            self.differing.changed(item)
            return
        if item.kind is not ObjectKind.PATCH or item.value is None or not item.id.startswith(self._prefix):
            return
        header = read_header(self.grid, item.value)
        if not isinstance(header, Refusal) and header.key.writer != item.owner:
            self._said(
                f"scene: {item.owner} sends patches in the name of {header.key.writer}; none is taken", item.owner
            )
            return
        outcome = self.scene.apply(item.value)
        if isinstance(header, Refusal):
            self._said(f"scene: a patch of {item.owner} is not for this grid ({outcome.value})", item.owner, outcome)
        else:
            self._change(header.key)

    def deleted(self, object_id: str) -> None:
        self.differing.deleted(object_id)
        key = self._key(object_id)
        if key is not None and key.writer != self._client and self.scene.withdraw(key):
            self._change(key)

    def _id(self, key: BlockKey) -> str:
        return f"{self._prefix}{key.layer}/{key.block}@{key.writer}"

    def _key(self, object_id: str) -> BlockKey | None:
        place, _, writer = object_id.removeprefix(self._prefix).rpartition("@")
        layer, _, number = place.partition("/")
        if not object_id.startswith(self._prefix) or layer not in LAYERS or not number.isdecimal():
            return None
        return BlockKey(writer, layer, int(number)) if int(number) < self.grid.blocks else None

    # --- in time ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        while True:
            await asyncio.sleep(PERIOD_S)
            placed = self.take()
            if placed:  # takes milliseconds: not where poses and commands wait
                await asyncio.to_thread(self.fuse, placed, self.twin_cells())
            self.tick(seen=bool(placed))

    def take(self) -> list[Placed]:
        """What scanners have seen since the last call."""
        return [placed for scanner in self._scanners if (placed := scanner.take()) is not None]

    def fuse(self, placed: list[Placed], twin: Cells) -> None:
        """Have scans change the occupancy, and compare them with the twin. Nobody else touches either meanwhile."""
        sights = [
            (
                self.occupancy.fuse(
                    each.pose, each.scan.angles_rad, each.scan.ranges_m, each.scan.most_m, range_min_m=each.scan.least_m
                ),
                each.pose[:2],
            )
            for each in placed
        ]
        self.differing.saw(sights, twin, now_s=self._now(), pose_error_m=self._pose_error_m)

    def tick(self, *, seen: bool) -> None:
        """Tell the others what has changed here, and this site what has changed anywhere."""
        if seen:
            seen_cells, correction = self.occupancy.classes(), self.differing.correction
            self.scene.set_cells("live", seen_cells if correction is None else corrected(seen_cells, correction))
        if self.obstacles.changed:
            self.obstacles.changed = False
            self._paint()
        now = self._now()
        if self._scanners:
            places_m = [scanner.place_m for scanner in self._scanners if scanner.place_m]
            self._rates.look(places_m, self._twin_now()[1], now=now)
        for key in self.scene.publish({"live": self._rates.due(now)}):
            self._change(key)
            if key.layer == "live":
                self._rates.told(key.block, now)
            try:
                self._objects.put(self._id(key), ObjectKind.PATCH, PATCH_TYPE, value=self.scene.encode_block(key))
            except (RefusedError, UsageError) as error:
                self._said(f"scene: {error}", type(error).__name__)
        self.differing.tell(now)
        self._publish(now)
        self._publish_discrepancies(now)
        if now >= self._offsets_due_s:
            self._offsets_due_s = now + OFFSETS_S
            self._measure()

    def _paint(self) -> None:
        cells = self.scene.cells("twin_only")
        cells[:] = UNKNOWN
        self.scene.set_cells("twin_only", cells)
        lasting = self.options.lasting
        # What lasts comes last: it is not cleared where something else was added over it.
        for (namespace, _number), marker in sorted(
            self.obstacles.markers.items(), key=lambda item: item[0][0] in lasting
        ):
            if marker.outline is not None:
                self.scene.paint("twin_only", marker.outline, LASTING if namespace in lasting else OCCUPIED)

    def cells(self) -> Cells:
        """All layers together: what is added over what is seen over what the map says, without what scans see through
        (`sern_twin.world.correction`)."""
        scene = self.scene
        return map_cells(scene.merged("base"), scene.merged("live"), scene.merged("twin_only"))

    def twin_cells(self) -> Cells:
        """What the twin has without what is seen: what is added over what the map says. To be read alone."""
        return self._twin_now()[0]

    def _twin_now(self) -> tuple[Cells, NDArray[np.bool_]]:
        """All cells are looked at when they have changed, and not ten times a second."""
        if self._twin is None:
            added = self.scene.merged("twin_only")
            self._twin = twin_cells(self.scene.merged("base"), added), added >= LASTING
        return self._twin

    def discrepancies(self) -> tuple[SeenDiscrepancy, ...]:
        """Where scanners of any site see something else than the twin has."""
        return self.differing.all()

    def ages_s(self) -> NDArray[np.float64]:
        """Seconds since each block was changed here or from elsewhere, (blocks,); NaN: it is as the map has it."""
        return self._now() - self._changed_s

    def _change(self, key: BlockKey) -> None:
        if key.layer != "live":
            self._twin = None
        if key.layer != "base":
            self._changed_s[key.block] = self._now()
        self.changes += 1

    def _publish(self, now: float) -> None:
        if self.changes == self._published_changes and self._updates.idle(now):
            return
        self._published_changes = self.changes
        stamp_ns, due = self._wall_ns(), self._updates.due(self.cells(), now)
        if isinstance(due, tuple):
            for update in due:
                body = self._map_writer.update(update, stamp_ns=stamp_ns)
                self._say(f"{self.options.publish}_updates", bodies.UPDATE, body, stamp_ns)
        else:
            self._say(self.options.publish, bodies.GRID, self._map_writer.whole(due, stamp_ns=stamp_ns), stamp_ns)

    def _publish_discrepancies(self, now: float) -> None:
        if self.differing.changes == self._differing_changes or now < self._differing_due_s:
            return
        self._differing_changes, self._differing_due_s = self.differing.changes, now + DISCREPANCIES_S
        stamp_ns = self._wall_ns()
        body = self._writer.discrepancies(self.differing.all(), stamp_ns=stamp_ns)
        self._say(self.options.discrepancies, bodies.MARKERS, body, stamp_ns)

    def _say(self, topic: str, type_name: str, body: bytes, stamp_ns: int) -> None:
        name = TopicName(topic)
        publisher = self._publishers.get(name)
        if publisher is None:
            info = ros_types.topic_info(topic, type_name, self._encoding, latched=type_name != bodies.UPDATE)
            try:
                publisher = self._publishers[name] = self._advertise(info)
            except ConfigError as error:
                self._said(f"scene: {error}", topic)
                return
        publisher.publish(body, stamp_ns)

    def _measure(self) -> None:
        """How far what robots see of each obstacle is from where it was added."""
        self.offsets_m.clear()
        if not self.obstacles.markers:
            return
        added = (self.grid, self.scene.cells("twin_only"))
        seen = (self.grid, self.scene.merged("live"))
        base = self.scene.merged("base")
        for (namespace, number), marker in self.obstacles.markers.items():
            offset = object_offset(added, seen, marker.middle_m, OFFSET_RADIUS_M, before=(None, base))
            if offset is not None:
                self.offsets_m[f"{namespace}/{number}"] = offset.distance_m

    # --- what is told of it -------------------------------------------------------------------------------------------

    def to_json(self) -> dict[str, object]:
        """What `/api/scene` says."""
        cells = self.cells()
        return {
            "name": self.options.name,
            "grid_id": self.grid.grid_id,
            "columns": self.grid.columns,
            "rows": self.grid.rows,
            "cell_m": self.grid.cell_m,
            "occupied_cells": int((cells >= OCCUPIED).sum()),
            "known_cells": int((cells != UNKNOWN).sum()),
            "added_cells": int((self.scene.merged("twin_only") != UNKNOWN).sum()),
            "cleared_cells": int((self.scene.merged("live") == CLEARED).sum()),
            "blocks": len(self.scene.versions()),
            "digests": {layer: self.scene.digest(layer) for layer in LAYERS},
            "patches": {outcome.value: count for outcome, count in self.scene.counts.items()},
            "unused": dict(self.unused),
            "ignored_readings": {reason.value: count for reason, count in self.occupancy.ignored.items()},
            "obstacles": len(self.obstacles.markers),
            "offsets_m": dict(self.offsets_m),
            "discrepancies": [
                {
                    "id": each.object_id,
                    "seen_by": each.owner,
                    "kind": each.kind.value,
                    "east_m": each.east_m,
                    "north_m": each.north_m,
                    "radius_m": each.radius_m,
                    "cells": each.cells,
                    "corrected": each.corrected,
                }
                for each in self.differing.all()
            ],
            "discrepancies_left_out": self.differing.left_out,
        }

    def _unused(self, reason: Unused) -> None:
        self.unused[reason] += 1

    def register(self, metrics: Metrics) -> None:
        metrics.counter(
            "sern_scene_patches_total",
            "Patches of others that came, by outcome.",
            ("outcome",),
            lambda: [((outcome.value,), float(count)) for outcome, count in self.scene.counts.items()],
        )
        metrics.counter(
            "sern_scene_unused_total",
            "Poses, scans and obstacles of this site that are not in the scene, by reason.",
            ("reason",),
            lambda: [((str(reason),), float(count)) for reason, count in self.unused.items()],
        )
        metrics.gauge(
            "sern_scene_blocks",
            "Blocks of the scene that something is known of, of all layers and writers.",
            read=lambda: [((), float(len(self.scene.versions())))],
        )
        metrics.gauge(
            "sern_scene_discrepancies",
            "Where scanners of any site see something else than the twin has, by kind.",
            ("kind",),
            lambda: [
                ((kind.value,), float(sum(each.kind is kind for each in self.differing.all())))
                for kind in DiscrepancyKind
            ],
        )
        metrics.gauge(
            "sern_scene_offset_metres",
            "How far what is seen of an obstacle is from where it was added here.",
            ("obstacle",),
            lambda: [((name,), offset_m) for name, offset_m in self.offsets_m.items()],
        )
