"""The scene of a site: scans and markers in, patches and maps out, and back, in time that the test makes."""

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sern_client.endpoints.twin.bodies import ODOMETRY
from sern_client.endpoints.twin.bodies import Writer as TwinWriter
from sern_client.scene import bodies
from sern_client.scene.hearing import MOST_MARKERS, Unused
from sern_client.scene.node import SceneNode
from sern_client.scene.options import ScannerOptions, SceneOptions
from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, TopicName
from sern_runtime import ros_types
from sern_twin.motion import Motion
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED, UNKNOWN, Cells
from sern_twin.world.scene import Outcome

GRID = Grid(-5.0, -5.0, 0.1, 100, 100, frame_id="odom")
OPTIONS = SceneOptions("yard", (ScannerOptions("/scan", "/odom"),), "/scene/add")
NS = 10**9


class Air:
    """Carries objects between the scenes of a test: what is put is given to all others, unless it is lost."""

    def __init__(self) -> None:
        self.nodes: dict[str, SceneNode] = {}
        self.sizes: list[int] = []
        self.lost: Callable[[str], bool] = lambda _object_id: False

    def put(
        self, client: str, object_id: str, kind: ObjectKind, type_name: str, value: bytes, attributes: dict[str, str]
    ) -> None:
        self.sizes.append(len(value))
        for name, node in self.nodes.items():
            if name != client and not self.lost(object_id):
                node.changed(told(object_id, client, value, kind, attributes))

    def delete(self, client: str, object_id: str) -> None:
        for name, node in self.nodes.items():
            if name != client:
                node.deleted(object_id)


def told(
    object_id: str,
    owner: str,
    value: bytes | None,
    kind: ObjectKind = ObjectKind.PATCH,
    attributes: dict[str, str] | None = None,
) -> XrObject:
    return XrObject(
        id=object_id, owner=ClientName(owner), kind=kind, type_name="sern/ScenePatch", definition="",
        definition_hash="", attributes=attributes or {}, value=value, value_bytes=len(value or b""), value_sha256=None,
        seq=1, ros_stamp_ns=None, wall_ns=0, created_s=0.0, updated_s=0.0, version=1,
    )  # fmt: skip


class Site:
    """A scene with what it published, and the topics that it hears."""

    def __init__(
        self,
        air: Air,
        name: str,
        *,
        grid: Grid = GRID,
        base: Cells | None = None,
        wall_s: int = 1000,
        options: SceneOptions = OPTIONS,
    ) -> None:
        self.air, self.name = air, name
        self.now = 0.0
        self.sinks: dict[str, list[Any]] = {}
        self.published: dict[str, list[bytes]] = {}
        self.node = SceneNode(
            options,
            grid,
            name,
            base=base,
            encoding=Encoding.CDR,
            subscribe=self.subscribe,
            advertise=self.advertise,
            objects=self,
            now=lambda: self.now,
            wall_ns=lambda: wall_s * NS + round(self.now * NS),
        )
        air.nodes[name] = self.node

    # SiteObjects
    def put(
        self,
        object_id: str,
        kind: ObjectKind,
        type_name: str,
        *,
        value: bytes = b"",
        attributes: dict[str, str] | None = None,
        ros_stamp_ns: int | None = None,
    ) -> None:
        self.air.put(self.name, object_id, kind, type_name, value, attributes or {})

    def delete(self, object_id: str) -> bool:
        self.air.delete(self.name, object_id)
        return True

    def listen(self, listener: object) -> None: ...

    # the endpoint
    def subscribe(self, name: TopicName, sink: Any) -> Any:
        row = self.sinks.setdefault(name, [])
        row.append(sink)

        class Subscription:
            def close(self) -> None:
                row.remove(sink)

        return Subscription()

    def advertise(self, info: TopicInfo) -> Any:
        row = self.published.setdefault(info.name, [])

        class Publisher:
            def publish(self, body: bytes, stamp_ns: int) -> None:
                row.append(body)

            def close(self) -> None: ...

        return Publisher()

    def hear(self, topic: str, type_name: str, body: bytes) -> None:
        if topic not in self.sinks:
            self.node.topic_added(ros_types.topic_info(topic, type_name, Encoding.CDR))
        for sink in list(self.sinks[topic]):
            assert sink(body, 0)

    def odometry(self, x_m: float, y_m: float, yaw_rad: float, at_s: float, frame_id: str = "odom") -> None:
        body = TwinWriter(Encoding.CDR).odometry(
            Motion(x_m, y_m, yaw_rad), 0.0, z_m=0.0, stamp_ns=round(at_s * NS), frame_id=frame_id, child_frame_id="b"
        )
        self.hear("/odom", ODOMETRY, body)

    def scan(self, ranges_m: Any, at_s: float) -> None:
        ranges = np.asarray(ranges_m, np.float32)
        message = ros_types.new(
            bodies.SCAN, Encoding.CDR, header=ros_types.header(round(at_s * NS), "laser", Encoding.CDR),
            angle_min=-math.pi, angle_increment=2 * math.pi / len(ranges), range_min=0.05, range_max=8.0, ranges=ranges,
        )  # fmt: skip
        self.hear("/scan", bodies.SCAN, ros_types.serialise(message, bodies.SCAN, Encoding.CDR))

    def marker(self, number: int = 0, **fields: Any) -> None:
        self.hear("/scene/add", bodies.MARKER, marker(number, **fields))

    def turn(self) -> None:
        """One turn of the daemon's loop."""
        placed = self.node.take()
        self.node.fuse(placed, self.node.twin_cells())
        self.node.tick(seen=bool(placed))

    def seen(self) -> Cells:
        """The map as a node of this site has it: the last whole one, and what changed since."""
        whole = ros_types.deserialise(self.published["/scene/map"][-1], bodies.GRID, Encoding.CDR)
        return np.asarray(whole.data, np.int8).reshape(whole.info.height, whole.info.width)


def marker(
    number: int = 0, *, x_m: float = 1.0, y_m: float = 2.0, size_m: float = 1.0, kind: int = 1, action: int = 0,
    frame_id: str = "odom", yaw_rad: float = 0.0, namespace: str = "test",
) -> bytes:  # fmt: skip
    new, encoding = ros_types.new, Encoding.CDR
    place = new("geometry_msgs/msg/Point", encoding, x=x_m, y=y_m)
    turn = new("geometry_msgs/msg/Quaternion", encoding, z=math.sin(yaw_rad / 2), w=math.cos(yaw_rad / 2))
    message = new(
        bodies.MARKER, encoding, header=ros_types.header(0, frame_id, encoding), ns=namespace, id=number, type=kind,
        action=action, pose=new("geometry_msgs/msg/Pose", encoding, position=place, orientation=turn),
        scale=new("geometry_msgs/msg/Vector3", encoding, x=size_m, y=size_m, z=1.0),
    )  # fmt: skip
    return ros_types.serialise(message, bodies.MARKER, encoding)


def around(x_m: float, y_m: float, radius_m: float, beams: int = 720) -> Any:
    """Ranges from the origin to a pillar, and to a wall all around at 4 m."""
    angles = -math.pi + 2 * math.pi / beams * np.arange(beams)
    along = x_m * np.cos(angles) + y_m * np.sin(angles)
    inside = radius_m**2 - (x_m**2 + y_m**2 - along**2)
    hits = np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0)), np.inf)
    return np.minimum(hits, 4.0)


def test_an_obstacle_that_is_added_at_the_site_reaches_the_robot_and_goes_again() -> None:
    air = Air()
    site, robot = Site(air, "site"), Site(air, "robot")
    site.marker()
    for each in (site, robot):
        each.turn()
        each.now += 6.0
        each.turn()
    row, column = (int(value) for value in GRID.index([1.0, 2.0]))
    assert robot.seen()[row, column] == OCCUPIED and (robot.seen() == OCCUPIED).sum() == 100
    assert (robot.node.cells() == site.node.cells()).all()
    assert sum(air.sizes) <= 8000
    site.marker(action=2)
    for each in (site, robot):
        each.turn()
    assert (robot.node.cells() == UNKNOWN).all()
    update = ros_types.deserialise(robot.published["/scene/map_updates"][-1], bodies.UPDATE, Encoding.CDR)
    assert update.width == 16 and set(update.data) == {-1}


def test_what_the_robot_sees_reaches_the_site_and_the_offset_of_what_was_added_is_told() -> None:
    air = Air()
    site, robot = Site(air, "site"), Site(air, "robot")
    site.marker(x_m=2.0, y_m=0.0, size_m=0.4, kind=3)
    site.turn()
    robot.odometry(0.0, 0.0, 0.0, 0.9)
    for step in range(12):
        robot.odometry(0.0, 0.0, 0.0, 1.0 + 0.1 * step)
        robot.scan(around(2.0, 0.0, 0.2), 1.0 + 0.1 * step)
        robot.turn()
    site.now += 2.0
    site.turn()
    row, column = (int(value) for value in GRID.index([1.85, 0.0]))
    assert site.node.scene.merged("live")[row, column] == OCCUPIED
    assert (site.node.scene.merged("live") == OCCUPIED).sum() > 100
    assert site.node.scene.merged("live")[tuple(int(v) for v in GRID.index([1.0, 0.0]))] == 0
    assert site.node.offsets_m.keys() == {"test/0"} and site.node.offsets_m["test/0"] < 0.25
    assert site.node.scene.digest("live") == robot.node.scene.digest("live")


def test_scans_are_placed_by_their_stamps_and_what_cannot_be_placed_is_counted() -> None:
    site = Site(Air(), "robot")
    site.scan(around(2.0, 0.0, 0.2), 1.0)
    site.turn()
    assert site.node.unused == {Unused.NO_POSE: 1}
    site.odometry(0.0, 0.0, 0.0, 2.0)
    site.odometry(1.0, 0.0, 0.0, 2.1)
    site.scan(around(1.0, 0.0, 0.2), 2.05)
    (placed,) = site.node.take()
    assert placed.pose == pytest.approx((0.5, 0.0, 0.0))
    site.scan(around(1.0, 0.0, 0.2), 3.0)
    assert site.node.take() == [], "its pose is under way"
    site.scan(around(1.0, 0.0, 0.2), 3.1)
    assert site.node.unused[Unused.SUPERSEDED] == 1
    site.odometry(0.0, 0.0, 0.0, 4.0, frame_id="elsewhere")
    site.marker(frame_id="elsewhere")
    assert site.node.unused[Unused.FRAME] == 2
    site.odometry(math.nan, 0.0, 0.0, 3.12)
    site.turn()
    assert (site.node.cells() == UNKNOWN).all()


@pytest.mark.parametrize(
    ("topic", "type_name", "body"),
    [
        ("/scan", bodies.SCAN, b""),
        ("/scan", bodies.SCAN, bytes(600_000)),
        ("/odom", ODOMETRY, b"\x00\x01\x00\x00"),
        ("/scene/add", bodies.MARKER, marker(kind=10)),
        ("/scene/add", bodies.MARKER, marker(x_m=math.nan)),
        ("/scene/add", bodies.MARKER, marker(size_m=0.0)),
        ("/scene/add", bodies.MARKER, marker(action=7)),
    ],
)
def test_what_cannot_be_read_is_one_line_and_counted(
    topic: str, type_name: str, body: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    site = Site(Air(), "robot")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            site.hear(topic, type_name, body)
    site.turn()
    assert site.node.unused == {Unused.UNREADABLE: 3}
    assert [record.message.startswith(f"scene: {topic}: ") for record in caplog.records] == [True]
    assert (site.node.cells() == UNKNOWN).all()


def test_obstacles_are_as_many_as_they_may_be() -> None:
    site = Site(Air(), "site")
    for number in range(MOST_MARKERS + 5):
        site.marker(number, x_m=4.0 * math.cos(number), y_m=4.0 * math.sin(number), size_m=0.2)
    assert len(site.node.obstacles.markers) == MOST_MARKERS and site.node.unused == {Unused.FULL: 5}
    site.marker(action=3)
    assert site.node.obstacles.markers == {}


def test_patches_in_anothers_name_or_for_another_grid_change_nothing(caplog: pytest.LogCaptureFixture) -> None:
    air = Air()
    site, robot, mallory = Site(air, "site"), Site(air, "robot"), Site(Air(), "mallory")
    other = Site(Air(), "other", grid=Grid(-5.0, -5.0, 0.2, 50, 50, frame_id="odom"))
    taken: list[bytes] = []
    for source in (robot, mallory, other):
        source.air.put = lambda _client, _id, _kind, _type, value, _attributes: taken.append(value)  # type: ignore[method-assign, assignment]
        source.marker()
        source.turn()
    caplog.clear()
    before = site.node.cells()
    with caplog.at_level(logging.WARNING):
        site.node.changed(told("/scene/yard/twin_only/1@mallory", "mallory", taken[0]))
        site.node.changed(told("/scene/yard/twin_only/1@other", "other", taken[-1]))
        site.node.changed(told("/scene/yard/twin_only/1@other", "other", b"nonsense"))
        site.node.changed(told("/scene/elsewhere/live/1@robot", "robot", taken[0]))
        site.node.changed(told("/scene/yard/live/1@robot", "robot", None))
        site.node.changed(told("/scene/yard/live/1@robot", "robot", taken[0], ObjectKind.TERRAIN))
    assert (site.node.cells() == before).all()
    assert [record.message.split(": ")[1] for record in caplog.records] == [
        "mallory sends patches in the name of robot; none is taken",
        "a patch of other is not for this grid (other_grid)",
        "a patch of other is not for this grid (corrupt)",
    ]
    assert site.node.scene.counts[Outcome.OTHER_GRID] == 1 and site.node.scene.counts[Outcome.CORRUPT] == 1


def test_what_a_robot_takes_back_or_had_before_it_started_anew_is_gone() -> None:
    air = Air()
    site, robot = Site(air, "site"), Site(air, "robot")
    robot.marker()
    robot.turn()
    assert (site.node.cells() == OCCUPIED).sum() == 100
    for key in robot.node.scene.versions():
        site.node.deleted(f"/scene/yard/{key.layer}/{key.block}@robot")
    for nonsense in ("", "/scene/yard/live/x@robot", "/scene/yard/live/99999@robot", "/scene/yard/attic/1@robot"):
        site.node.deleted(nonsense)
    assert (site.node.cells() == UNKNOWN).all()
    again = Site(air, "robot", wall_s=2000)
    again.marker(x_m=-2.0)
    again.turn()
    assert (site.node.cells() == OCCUPIED).sum() == 100
    assert (site.node.cells() == again.node.cells()).all()


def test_layers_lie_over_each_other_and_a_topic_of_another_type_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    base = np.full(GRID.shape, UNKNOWN, np.int8)
    base[:, 50:] = 0
    site = Site(Air(), "site", base=base)
    site.turn()
    assert (site.node.cells() == base).all() and (site.seen() == base).all()
    site.marker(x_m=2.0, y_m=0.0)
    site.turn()
    assert (site.node.cells() == OCCUPIED).sum() == 100
    with caplog.at_level(logging.WARNING):
        site.node.topic_added(ros_types.topic_info("/scan", ODOMETRY, Encoding.CDR))
    assert "/scan is nav_msgs/msg/Odometry, and sensor_msgs/msg/LaserScan is read" in caplog.text
    assert "/scan" not in site.node.held.subscriptions
    site.node.close()
    assert site.node.held.subscriptions == {} == site.node.held.publishers


def test_a_lost_patch_is_made_good_by_the_next_of_its_block() -> None:
    air = Air()
    site, robot = Site(air, "site"), Site(air, "robot")
    air.lost = lambda _object_id: True
    site.marker(1, x_m=1.0)
    site.turn()
    air.lost = lambda _object_id: False
    site.marker(2, x_m=1.3)
    site.turn()
    told_of = robot.node.scene.merged("twin_only") == OCCUPIED
    said = site.node.scene.merged("twin_only") == OCCUPIED
    assert told_of.any() and not (told_of & ~said).any()
    for key in site.node.scene.missing(robot.node.scene.versions()):
        robot.node.changed(told("/scene/yard/x", "site", site.node.scene.encode_block(key)))
    assert (robot.node.cells() == site.node.cells()).all()
    robot.node.changed(
        told("/scene/yard/x", "site", site.node.scene.encode_block(next(iter(site.node.scene.versions()))))
    )
    assert robot.node.scene.counts[Outcome.OLD] == 1


def test_blocks_are_as_old_as_what_was_changed_in_them_last() -> None:
    """What the map of the site says has no age, there and where it comes to."""
    air = Air()
    base = np.full(GRID.shape, UNKNOWN, np.int8)
    base[0, 0] = OCCUPIED
    site, robot = Site(air, "site", base=base), Site(air, "robot")
    for each in (site, robot):
        each.turn()
    assert all(np.isnan(each.node.ages_s()).all() for each in (site, robot))
    assert site.node.changes > 0 and robot.node.cells()[0, 0] == OCCUPIED
    before = (site.node.changes, robot.node.changes)
    for each in (site, robot):
        each.now = 5.0
    site.marker()
    for each in (site, robot):
        each.turn()
        each.now = 8.0
    block = int(GRID.block_of(*GRID.index([1.0, 2.0])))
    for each, changes in zip((site, robot), before, strict=True):
        assert each.node.changes > changes
        assert each.node.ages_s()[block] == 3.0 and np.isnan(each.node.ages_s()[0])
        changes = each.node.changes
        each.turn()
        assert each.node.changes == changes, "nothing was changed"
    site.marker(action=2)
    site.turn()
    assert site.node.ages_s()[block] == robot.node.ages_s()[block] == 0.0, "it has gone now"
