"""Scene patches between a robot and a site: their bytes, how far off an obstacle is, and how they fare over a thin link
that loses 5 %, beside poses. The real core and the real scenes in virtual time."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, Final

import numpy as np

from benchmarks.common import Report, percentile
from sern_client.scene.bodies import Marker, Scan
from sern_client.scene.hearing import Placed
from sern_client.scene.node import PERIOD_S, SceneNode
from sern_client.scene.options import SceneOptions
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.objects.xr_object import XrObject
from sern_core.site.object_mirror import Selection
from sern_core.vocabulary.types import Encoding, ObjectKind, PriorityClass
from sern_sim.models import LinkModel
from sern_sim.pilot import FigureOfEight, Pilot
from sern_sim.robot import LIDAR_RANGE_M, STEP_S, SimulatedJackal
from sern_sim.world import World as Yard
from sern_twin.world.grid import Grid
from sern_twin.world.offset import find, object_offset
from sern_twin.world.patches import OCCUPIED, Refusal, read_header
from tests.world import SimClient, World, spec

GRID: Final = Grid(-12.0, -12.0, 0.1, 240, 240, frame_id="odom")
OPTIONS: Final = SceneOptions("yard")
THIN: Final = LinkModel(rate_bps=256_000.0, delay_s=0.05)
POSE_HZ: Final = 20.0
POSE_BYTES: Final = 724
"""A nav_msgs/Odometry as CDR."""
SETTLES_S: Final = 5.0
EXPLORES_S: Final = 40.0
DRIVES_S: Final = 30.0
CATCHES_UP_S: Final = 10.0
SIDE_M: Final = 1.0


def square(x_m: float, y_m: float, side_m: float, yaw_rad: float = 0.0) -> Marker:
    """An obstacle that somebody adds."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) * side_m
    outline = corners @ np.array([(cos, sin), (-sin, cos)]) + (x_m, y_m)
    return Marker(("bench", 0), GRID.frame_id, outline, (x_m, y_m))


@dataclass(eq=False)
class End:
    """A client with a scene. `told`: when a patch of others came, of which object and version; `said`: of its own."""

    client: SimClient
    told: list[tuple[float, str, int]] = field(default_factory=list)
    said: list[tuple[float, str, int]] = field(default_factory=list)
    put_bytes: list[int] = field(default_factory=list)
    puts: dict[str, float] = field(default_factory=dict)
    late_s: list[float] = field(default_factory=list)
    peer: "End | None" = None

    def __post_init__(self) -> None:
        client = self.client
        nothing: Any = lambda *_args: self  # noqa: E731  (nobody listens to its topics)
        self.node = SceneNode(
            OPTIONS, GRID, client.name, base=None, encoding=Encoding.CDR, subscribe=nothing, advertise=nothing,
            objects=self, now=lambda: client.now, wall_ns=lambda: round(client.now * 1e9),
        )  # fmt: skip
        client.core.subscribe_objects([Selection(ObjectKind.PATCH, "/scene/.*")], now=client.now)

    def put(self, object_id: str, kind: ObjectKind, type_name: str, *, value: bytes = b"", **_more: Any) -> None:
        if kind is not ObjectKind.PATCH:
            self.client.core.objects.put(object_id, kind, type_name, wall_ns=0, now=self.client.now, value=value)
            return
        self.put_bytes.append(len(value))
        self.puts[object_id] = self.client.now
        self.said.append((self.client.now, object_id, _version(value)))
        self.client.core.objects.put(object_id, kind, type_name, wall_ns=0, now=self.client.now, value=value)

    def delete(self, object_id: str) -> bool:
        return self.client.core.objects.delete(object_id, now=self.client.now)

    def listen(self, listener: Any) -> None:
        self.client.core.mirror.listeners += [listener, self]

    def changed(self, item: XrObject) -> None:
        now = self.client.now
        self.told.append((now, item.id, _version(item.value or b"")))
        if self.peer is not None:
            self.late_s.append(now - self.peer.puts[item.id])

    def deleted(self, object_id: str) -> None: ...

    def publish(self, body: bytes, stamp_ns: int) -> None:
        """The map of the site, which nobody takes."""

    def mark(self, marker: Marker) -> None:
        self.node.obstacles.markers[("bench", 0)] = marker
        self.node.obstacles.changed = True


def _version(patch: bytes) -> int:
    header = read_header(GRID, patch)
    assert not isinstance(header, Refusal)
    return header.version


def ends(seed: int, link: LinkModel) -> tuple[World, End, End]:
    world = World(seed, lossless=False)
    world.tell_objects()
    robot, site = End(world.client("robot", link)), End(world.client("site", patterns=["/robot/.*"]))
    robot.peer, site.peer = site, robot
    return world, robot, site


def drive(
    world: World, robot: End, seed: int, pillar_m: tuple[float, float, float] | None = None
) -> Callable[[], None]:
    """Have the robot drive and see: a scan ten times a second. Returns what ends it."""
    random = Random(seed)
    yard = Yard.yard(random)
    if pillar_m:
        yard = Yard(yard.walls, np.vstack((yard.pillars, (*pillar_m, 2.0))), yard.half_size_m)
    jackal = SimulatedJackal(random, world=yard)
    pilot = Pilot(random, jackal, FigureOfEight(random, jackal.state.pose, 0.0).at)
    angles = np.linspace(-0.75 * math.pi, 0.75 * math.pi, 720)

    def turn(_now: float) -> None:
        scan = Scan(0, angles, jackal.scan().astype(np.float64), 0.05, LIDAR_RANGE_M)
        found = pilot.step()  # where the localisation has it at the scan
        for _ in range(round(PERIOD_S / STEP_S) - 1):
            pilot.step()
        placed = Placed((found.pose.x_m, found.pose.y_m, found.pose.yaw_rad), scan)
        robot.node.fuse([placed], robot.node.twin_cells())
        robot.node.tick(seen=True)

    return world.network.every(PERIOD_S, turn, node=robot.client).cancel


def patches(seeds: int, report: Report) -> None:
    obstacle(20 * seeds, report)
    for loss in (0.0, 0.05):
        thin(seeds, loss, report)
    seen(seeds, report)


def obstacle(count: int, report: Report) -> None:
    """Obstacles of a square metre that a site adds: their bytes beside the whole scene's, and where the robot has
    them."""
    world, robot, site = ends(1, LinkModel(delay_s=0.01))
    end = drive(world, robot, 1)
    world.run(EXPLORES_S)
    end()
    whole = sum(len(robot.node.scene.encode_block(key)) for key in robot.node.scene.versions())
    random = Random(1)
    bytes_each, off_m = [], []
    for _ in range(count):
        x_m, y_m, yaw_rad = random.uniform(-9, 9), random.uniform(-9, 9), random.uniform(0, math.pi)
        site.put_bytes.clear()
        site.mark(square(x_m, y_m, SIDE_M, yaw_rad))
        site.node.tick(seen=False)
        bytes_each.append(sum(site.put_bytes))
        world.run(1.0)
        there = find(GRID, robot.node.scene.merged("twin_only"), (x_m, y_m), 1.0)
        off_m.append(math.inf if there is None else math.dist((there.east_m, there.north_m), (x_m, y_m)))
        site.node.obstacles.markers.clear()
        site.node.obstacles.changed = True
        site.node.tick(seen=False)
        world.run(1.0)
    bytes_each.sort()
    off_m.sort()
    report.row(
        "scene patches: a new obstacle of 1 m²", "site to robot",
        median_bytes=percentile(bytes_each, 0.5), largest_bytes=bytes_each[-1], whole_scene_bytes=whole,
        offset_median_cm=100 * percentile(off_m, 0.5), offset_p95_cm=100 * percentile(off_m, 0.95),
    )  # fmt: skip
    report.reach("a new obstacle, bytes at the most", bytes_each[-1], 8000)
    report.reach(
        "offset of what was added, as the other has it, median, cm (paper: 2.3)", 100 * percentile(off_m, 0.5), 2.3
    )


def thin(seeds: int, loss: float, report: Report) -> None:
    """Measure over 256 kbit/s: a robot that sees and says where it is, and an obstacle that moves all the time."""
    rows: dict[str, list[float]] = {}
    for seed in range(seeds):
        ages = {}
        for patched in (False, True):
            world, robot, site = ends(seed + 1, replace(THIN, loss=loss))
            pose = robot.client.publish("/robot/pose", spec(PriorityClass.CONTROL))
            stop_poses = robot.client.every(1.0 / POSE_HZ, pose, bytes(POSE_BYTES), first_s=SETTLES_S)
            end = drive(world, robot, seed) if patched else lambda: None
            world.run(SETTLES_S + EXPLORES_S)
            since, moved_from_s = len(site.client.on("/robot/pose")), world.now
            told_before, said_before, late_before = len(site.told), len(robot.said), len(site.late_s)
            sent_before = _sent_bytes(robot)
            if patched:
                _move(world, robot, moved_from_s)
            world.run(DRIVES_S)
            ages[patched] = sorted(got.age_s for got in site.client.on("/robot/pose")[since:])
            if not patched:
                continue
            told = site.told[told_before:]
            for name, some in (("moved_hz", robot.said[said_before:]), ("updates_hz", told)):
                versions = {version for _, object_id, version in some if "/twin_only/" in object_id}
                rows.setdefault(name, []).append(len(versions) / DRIVES_S)
            rows.setdefault("patches_hz", []).append(len(told) / DRIVES_S)
            rows.setdefault("kbit_s", []).append((_sent_bytes(robot) - sent_before) * 8e-3 / DRIVES_S)
            rows.setdefault("late_p95_ms", []).append(1e3 * percentile(sorted(site.late_s[late_before:]), 0.95))
            end()
            stop_poses()
            ended_s = world.now
            world.run(CATCHES_UP_S)
            same = all(
                robot.node.scene.digest(layer) == site.node.scene.digest(layer) for layer in ("live", "twin_only")
            )
            rows.setdefault("same", []).append(float(same))
            last_s = max((at_s for at_s, *_ in site.told), default=ended_s)
            rows.setdefault("caught_up_s", []).append(max(0.0, last_s - ended_s))
        for name, ordered in (("pose", ages[True]), ("alone", ages[False])):
            for share in (0.95, 0.99):
                rows.setdefault(f"{name}_p{100 * share:.0f}_ms", []).append(1e3 * percentile(ordered, share))
    mean = {name: sum(values) / seeds for name, values in rows.items()}
    report.row(
        f"scene patches: 256 kbit/s, {100 * loss:g} % loss, poses at 20 Hz", "robot to site",
        moved_hz=mean["moved_hz"], told_hz=mean["updates_hz"], patches_hz=mean["patches_hz"],
        patches_kbit_s=mean["kbit_s"],
        late_p95_ms=mean["late_p95_ms"], pose_p95_ms=mean["pose_p95_ms"], pose_p99_ms=mean["pose_p99_ms"],
        pose_alone_p95_ms=mean["alone_p95_ms"], pose_alone_p99_ms=mean["alone_p99_ms"],
        converged_percent=100 * mean["same"], last_after_s=max(rows["caught_up_s"]),
    )  # fmt: skip
    case = f"patches, 256 kbit/s, {100 * loss:g} %"
    report.reach(f"{case}: scenes that converged, %", 100 * mean["same"], 100, at_least=True)
    if not loss:
        share = mean["updates_hz"] / mean["moved_hz"]
        report.reach(f"{case}: of 10 changes a second told beside poses", share, 0.95, at_least=True)


def _move(world: World, robot: End, since_s: float) -> None:
    def move(_now: float) -> None:
        angle = 0.25 * (world.now - since_s)
        robot.mark(square(6.0 * math.cos(angle), 6.0 * math.sin(angle), 0.4))

    world.network.every(PERIOD_S, move, node=robot.client)


def _sent_bytes(end: End) -> int:
    counters = end.client.core.link.sender.ledger.topics.get(OBJECTS_TOPIC)
    return 0 if counters is None else counters.offered_bytes


def seen(seeds: int, report: Report) -> None:
    """A pillar of 0.4 m in the yard, and the same as the site adds it: how far what the robot sees of it is off."""
    off_m = []
    for seed in range(seeds):
        world, robot, site = ends(seed + 1, LinkModel(delay_s=0.05, loss=0.05))
        place = (0.0, 1.9)
        site.node.obstacles.markers.clear()
        angles = np.linspace(0, 2 * math.pi, 16, endpoint=False)
        outline = np.stack((place[0] + 0.2 * np.cos(angles), place[1] + 0.2 * np.sin(angles)), axis=1)
        site.mark(Marker(("bench", 0), GRID.frame_id, outline, place))
        site.node.tick(seen=False)
        end = drive(world, robot, seed, (*place, 0.2))
        world.run(EXPLORES_S)
        end()
        world.run(2.0)
        added = site.node.scene.cells("twin_only")
        offset = object_offset((GRID, added), (GRID, site.node.scene.merged("live")), place, 0.5)
        off_m.append(math.inf if offset is None else offset.distance_m)
        assert (added == OCCUPIED).any()
    off_m.sort()
    report.row(
        "scene patches: a pillar in the yard, as its twin has it", "robot to site",
        offset_median_cm=100 * percentile(off_m, 0.5), offset_worst_cm=100 * off_m[-1],
    )  # fmt: skip
