"""The twins as an endpoint: what robots say goes in, twins come out, in time that the test makes."""

import logging
import math
from dataclasses import replace
from typing import Any

import pytest

from sern_client.endpoints.base import Held
from sern_client.endpoints.twin import bodies
from sern_client.endpoints.twin.endpoint import TYPES, TwinEndpoint
from sern_client.endpoints.twin.options import RobotOptions, TwinOptions
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, ObjectKind, TopicName
from sern_runtime import ros_types
from sern_twin.motion import Motion, Twist
from tests.support import until

ROBOT_S = 1_000.0
"""The robot's clock, which thinks it is 1970, when ours is at 0."""
STEP_S = 0.05
JACKAL = RobotOptions("jackal1", "/jackal1/odom", "/jackal1/plan")


class World:
    """An endpoint, its robots' publishers, and what it published."""

    def __init__(self, *robots: RobotOptions, encoding: Encoding = Encoding.CDR) -> None:
        self.now = 0.0
        self.encoding = encoding
        self.writer = bodies.Writer(encoding)
        self.endpoint = TwinEndpoint(
            TwinOptions(robots or (JACKAL,), encoding=encoding.value, unity=True),  # type: ignore[arg-type]
            now=lambda: self.now,
            wall_ns=lambda: round((1.7e9 + self.now) * 1e9),
        )
        self.got: dict[str, list[Any]] = {}
        for name in self.endpoint.robots:
            for part, type_name in TYPES.items():
                self._listen(f"/twin/{name}/{part}", type_name)

    def _listen(self, topic: str, type_name: str) -> None:
        got = self.got.setdefault(topic, [])

        def sink(body: bytes, stamp_ns: int) -> bool:
            got.append(ros_types.deserialise(body, type_name, self.encoding))
            return True

        self.endpoint.subscribe(TopicName(topic), sink)

    def publisher(self, topic: str, type_name: str = bodies.ODOMETRY) -> Any:
        return self.endpoint.advertise(ros_types.topic_info(topic, type_name, self.encoding))

    def stamp_ns(self, time_s: float) -> int:
        return round((ROBOT_S + time_s) * 1e9)

    def say(self, publisher: Any, motion: Motion, *, at_s: float, age_s: float = 0.0, frame_id: str = "map") -> None:
        """The robot was there at `at_s`; its client took it then, `age_s` ago."""
        body = self.writer.odometry(
            motion, 0.0, z_m=0.3, stamp_ns=self.stamp_ns(at_s), frame_id=frame_id, child_frame_id="base_link"
        )
        publisher.tell_age(age_s)
        publisher.publish(body, self.stamp_ns(self.now - age_s))

    def plan(self, publisher: Any, places: list[tuple[float, float, float]], *, frame_id: str = "map") -> None:
        """Places x, y of a path, each with the time at which the robot is to be there."""
        body = self.writer.path(
            [Motion(x_m, y_m, 0.0) for x_m, y_m, _ in places], z_m=0.0,
            stamps_ns=[self.stamp_ns(time_s) for *_, time_s in places], frame_id=frame_id,
        )  # fmt: skip
        publisher.tell_age(0.0)
        publisher.publish(body, self.stamp_ns(self.now))

    def shown(self, robot: str = "jackal1") -> Motion:
        twin = self.endpoint.robots[robot].twin(now=self.now)
        assert twin is not None
        return twin.shown


def ahead(time_s: float) -> Motion:
    return Motion(time_s, 0.0, 0.0, Twist(1.0))


def drive(world: World, publisher: Any, start_s: float, end_s: float, *, age_s: float = 0.0) -> None:
    """East at 1 m/s, heard 20 times a second."""
    for step in range(round((end_s - start_s) / STEP_S)):
        world.now = start_s + step * STEP_S
        world.say(publisher, ahead(world.now - age_s), at_s=world.now - age_s, age_s=age_s)


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_a_twin_is_where_the_robot_is_by_now(encoding: Encoding) -> None:
    """Its poses are 200 ms under way, and its clock thinks it is 1970."""
    world = World(encoding=encoding)
    drive(world, world.publisher("/jackal1/odom"), 0.0, 3.0, age_s=0.2)
    world.endpoint.publish(slow=True)
    odom = world.got["/twin/jackal1/odom"][-1]
    assert odom.pose.pose.position.x == pytest.approx(world.now, abs=0.01)
    assert (odom.header.frame_id, odom.child_frame_id) == ("map", "twin/jackal1/base_link")
    assert odom.pose.pose.position.z == 0.3
    assert odom.header.stamp.sec == 1_700_000_002, "the twin is of now, by our clock"
    age, error = (world.got[f"/twin/jackal1/{part}"][-1].data for part in ("age", "error"))
    assert age == pytest.approx(0.2)
    assert math.sqrt(odom.pose.covariance[0]) == pytest.approx(error / 2, rel=1e-5)
    path = world.got["/twin/jackal1/path"][-1].poses
    assert len(path) == 21 and path[-1].pose.position.x == pytest.approx(world.now + 5, abs=0.1)
    (status,) = world.got["/twin/jackal1/status"][-1].status
    assert ord(status.level) if isinstance(status.level, bytes) else status.level == 0
    assert status.message == f"0.20 s old, error at most {error:.2f} m"
    assert {each.key: each.value for each in status.values}["poses_taken"] == "60"


class Objects:
    """`SiteObjects` that keeps what was put."""

    def __init__(self) -> None:
        self.put_last: dict[str, dict[str, Any]] = {}

    def put(self, object_id: str, kind: ObjectKind, type_name: str, **fields: Any) -> None:
        self.put_last[object_id] = {"kind": kind, "type": type_name, **fields}

    def delete(self, object_id: str) -> bool:
        return self.put_last.pop(object_id, None) is not None

    def listen(self, listener: object) -> None: ...


def test_the_contract_is_in_the_object_of_a_robot() -> None:
    world, objects = World(), Objects()
    world.endpoint.use_objects(objects)
    world.endpoint.publish(slow=True)
    assert objects.put_last == {}, "it was not heard yet"
    drive(world, world.publisher("/jackal1/odom"), 0.0, 3.0)
    world.now += 4.0
    world.endpoint.publish(slow=False)
    assert objects.put_last == {}
    world.endpoint.publish(slow=True)
    ((object_id, told),) = objects.put_last.items()
    assert (object_id, told["kind"], told["type"]) == ("/twin/jackal1", ObjectKind.ROBOT, bodies.ODOMETRY)
    odom = world.got["/twin/jackal1/odom"][-1]
    shown = ros_types.deserialise(told["value"], bodies.ODOMETRY, world.encoding)
    assert shown.pose.pose.position.x == odom.pose.pose.position.x
    fields = told["attributes"]
    assert fields["says"] == f"{fields['age_s']} s old, error at most {float(fields['error_m']):.2f} m"
    assert float(fields["age_s"]) == pytest.approx(4.0) and fields["level"] == "warn"
    assert float(fields["x_m"]) == pytest.approx(odom.pose.pose.position.x, abs=0.001)


def test_before_it_is_heard_there_is_its_status_alone() -> None:
    world = World()
    world.endpoint.publish(slow=True)
    assert [name for name, got in world.got.items() if got] == ["/twin/jackal1/status"]
    (status,) = world.got["/twin/jackal1/status"][0].status
    assert status.message == "not heard yet: /jackal1/odom" and status.level == 3


def test_a_plan_leads_it_through_a_blackout() -> None:
    """Half a minute along a bend that nobody tells it of, but the plan."""
    world = World()
    pose, plan = world.publisher("/jackal1/odom"), world.publisher("/jackal1/plan", bodies.PATH)
    radius_m = 10.0

    def there(time_s: float) -> Motion:
        turned = time_s / radius_m
        return Motion(
            radius_m * math.sin(turned), radius_m * (1 - math.cos(turned)), math.remainder(turned, 2 * math.pi),
            Twist(1.0, 0.0, 1 / radius_m),
        )  # fmt: skip

    world.plan(plan, [(there(n * 0.5).x_m, there(n * 0.5).y_m, n * 0.5) for n in range(100)])
    for step in range(200):
        world.now = step * STEP_S
        world.say(pose, there(world.now), at_s=world.now)
    assert world.endpoint.robots["jackal1"].goes_by == "trajectory"
    world.now += 30.0
    assert world.shown().distance_m(there(world.now)) < 0.05
    world.endpoint.publish(slow=True)
    (status,) = world.got["/twin/jackal1/status"][-1].status
    assert status.level == 1, "30 s old: a warning"


def test_a_stop_in_the_gap_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    pose, plan = world.publisher("/jackal1/odom"), world.publisher("/jackal1/plan", bodies.PATH)
    world.plan(plan, [(float(n), 0.0, float(n)) for n in range(100)])
    drive(world, pose, 0.0, 10.0)
    world.now = 25.0
    with caplog.at_level(logging.WARNING):
        world.say(pose, Motion(11.0, 0.0, 0.0), at_s=25.0)
    assert "it stands, and was to move" in caplog.text and "after 15.0 s of silence it is 14.00 m" in caplog.text
    robot = world.endpoint.robots["jackal1"]
    assert (robot.gaps, robot.stops, robot.snaps) == (1, 1, 1)


@pytest.mark.parametrize("begin_s", [0.0, 2.0], ids=["now", "in two seconds"])
def test_a_trajectory_is_a_plan(begin_s: float) -> None:
    """trajectory_msgs: it says when it begins, or begins when it comes."""
    world = World()
    pose, plan = world.publisher("/jackal1/odom"), world.publisher("/jackal1/plan", bodies.TRAJECTORY)

    def new(type_name: str, **fields: Any) -> Any:
        return ros_types.new(type_name, world.encoding, **fields)

    points = [
        new(
            "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint",
            transforms=[new("geometry_msgs/msg/Transform", translation=new("geometry_msgs/msg/Vector3", x=float(n)))],
            velocities=[], accelerations=[],
            time_from_start=new("builtin_interfaces/msg/Duration", sec=n, nanosec=0),
        )
        for n in range(100)
    ]  # fmt: skip
    stamp_ns = world.stamp_ns(begin_s) if begin_s else 0
    trajectory = new(
        bodies.TRAJECTORY, header=ros_types.header(stamp_ns, "map", world.encoding), joint_names=["base"], points=points
    )
    plan.publish(ros_types.serialise(trajectory, bodies.TRAJECTORY, world.encoding), world.stamp_ns(0.0))
    for step in range(200):
        world.now = begin_s + step * STEP_S
        world.say(pose, ahead(step * STEP_S), at_s=world.now)
    assert world.endpoint.robots["jackal1"].goes_by == "trajectory"
    world.now += 30.0
    assert world.shown().distance_m(ahead(world.now - begin_s)) < 0.05


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, math.pi / 2, -2.0])
def test_in_unity_it_looks_where_it_looks_here(yaw_rad: float) -> None:
    world = World()
    world.say(world.publisher("/jackal1/odom"), Motion(3.0, 4.0, yaw_rad), at_s=0.0)
    world.endpoint.publish(slow=False)
    (said,) = world.got["/twin/jackal1/unity"]
    assert (said.pose.position.x, said.pose.position.y, said.pose.position.z) == (3.0, 0.3, 4.0)
    assert said.header.frame_id == "unity/map"
    turn = 2 * math.atan2(said.pose.orientation.y, said.pose.orientation.w)
    # Unity's forward is z, and it turns about y from z to x.
    assert (math.sin(turn), math.cos(turn)) == pytest.approx((math.cos(yaw_rad), math.sin(yaw_rad)))


def test_a_path_without_times_is_followed_at_the_robots_speed() -> None:
    world = World()
    pose, plan = world.publisher("/jackal1/odom"), world.publisher("/jackal1/plan", bodies.PATH)
    drive(world, pose, 0.0, 5.0)
    world.plan(plan, [(0.0, 0.0, -ROBOT_S), (10.0, 0.0, -ROBOT_S), (10.0, 10.0, -ROBOT_S)])
    assert world.endpoint.robots["jackal1"].goes_by == "path"
    drive(world, pose, 5.0, 8.0)
    world.now += 7.0  # two metres to the corner, five north
    assert world.shown().distance_m(Motion(10.0, 5.0, 0.0)) < 0.3


@pytest.mark.parametrize(
    ("places", "frame_id", "why", "said"),
    [
        ([(0.0, 0.0, 1.0), (1.0, 0.0, 2.0)], "odom", "frame", "its frame is 'odom', and that of the poses 'map'"),
        ([(0.0, 0.0, 0.5), (1.0, 0.0, 1.05)], "map", "past", "it ended 3.9 s ago"),
        ([(0.0, 0.0, 9.0)], "map", "short", "it has 1 poses"),
        ([(0.0, 0.0, 9.0), (math.nan, 0.0, 10.0)], "map", "bad", "waypoint 1 of the trajectory is not finite"),
    ],
    ids=["another frame", "in the past", "too short", "not finite"],
)
def test_a_plan_that_cannot_be_used(
    places: list[tuple[float, float, float]], frame_id: str, why: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It is counted and said, and the twin goes on as without."""
    world, beside = World(), World()
    pose = world.publisher("/jackal1/odom")
    drive(world, pose, 0.0, 5.0)
    drive(beside, beside.publisher("/jackal1/odom"), 0.0, 5.0)
    with caplog.at_level(logging.WARNING):
        world.plan(world.publisher("/jackal1/plan", bodies.PATH), places, frame_id=frame_id)
    assert said in caplog.text
    robot = world.endpoint.robots["jackal1"]
    assert dict(robot.refused) == {why: 1} and robot.goes_by == "acceleration"
    assert world.endpoint.drops == {DropReason.UNDECODABLE: 1}
    world.now = beside.now = 6.0
    assert world.shown().distance_m(beside.shown()) < 1e-6


def test_a_plan_that_takes_too_long_to_read_is_not_read(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    plan = world.publisher("/jackal1/plan", bodies.PATH)
    with caplog.at_level(logging.WARNING):
        world.plan(plan, [(float(n), 0.0, float(n)) for n in range(8_000)])
    assert "524288 at most, so publish fewer of its poses" in caplog.text
    assert world.endpoint.drops == {DropReason.UNDECODABLE: 1}


def test_poses_that_are_none_move_nothing(caplog: pytest.LogCaptureFixture) -> None:
    world, beside = World(), World()
    pose = world.publisher("/jackal1/odom")
    drive(world, pose, 0.0, 5.0)
    drive(beside, beside.publisher("/jackal1/odom"), 0.0, 5.0)
    now = world.now
    for wrong in (Motion(math.nan, 0.0, 0.0), Motion(500.0, 0.0, 0.0), Motion(now, 0.0, 0.0, Twist(1e200))):
        world.say(pose, wrong, at_s=now + 0.01)
    world.say(pose, ahead(now), at_s=now + 3600.0)
    world.say(pose, ahead(now), at_s=now - 3600.0)
    with caplog.at_level(logging.WARNING):
        pose.publish(b"\0\1\0\0nonsense", world.stamp_ns(now))
    assert "/jackal1/odom: " in caplog.text
    counts = world.endpoint.robots["jackal1"].counts
    assert {name: count for name, count in counts.items() if count} == {
        "taken": 100, "not_finite": 1, "jump": 1, "implausible": 1, "future": 1, "old": 1,
    }  # fmt: skip
    assert world.shown() == beside.shown()


def test_another_frame_drops_the_plan(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    pose, plan = world.publisher("/jackal1/odom"), world.publisher("/jackal1/plan", bodies.PATH)
    world.plan(plan, [(float(n), 0.0, float(n)) for n in range(100)])
    drive(world, pose, 0.0, 5.0)
    with caplog.at_level(logging.WARNING):
        world.now = 5.0
        world.say(pose, ahead(5.0), at_s=5.0, frame_id="odom")
    assert "is in frame 'odom' now" in caplog.text
    assert world.endpoint.robots["jackal1"].goes_by == "acceleration"


def test_several_robots_are_apart() -> None:
    other = replace(JACKAL, name="jackal2", pose="/jackal2/odom", plan=None)
    world = World(JACKAL, other)
    drive(world, world.publisher("/jackal1/odom"), 0.0, 2.0)
    world.say(world.publisher("/jackal2/odom"), Motion(-5.0, 3.0, 1.0), at_s=world.now)
    assert world.shown("jackal2") == Motion(-5.0, 3.0, 1.0)
    assert world.shown("jackal1").x_m == pytest.approx(world.now, abs=0.01)
    told: Any = world.endpoint.to_json()
    assert told["jackal2"]["pose"] == [-5.0, 3.0, 1.0] and told["jackal1"]["frame_id"] == "map"


def test_what_is_not_theirs_is_refused() -> None:
    world = World()
    with pytest.raises(ConfigError, match="no robot of the twins has it"):
        world.publisher("/jackal1/imu")
    with pytest.raises(ConfigError, match=r"reads nav_msgs/msg/Odometry, not std_msgs/msg/Float32"):
        world.publisher("/jackal1/odom", bodies.FLOAT)
    with pytest.raises(UsageError, match="no such topic"):
        world.endpoint.subscribe(TopicName("/twin/nobody/odom"), lambda _body, _stamp_ns: True)


def test_what_is_closed_hears_nothing() -> None:
    world = World()
    pose = world.publisher("/jackal1/odom")
    held = Held()
    held.publishers[TopicName("/jackal1/odom")] = 1
    for part in TYPES:
        held.subscriptions[TopicName(f"/twin/jackal1/{part}")] = 1
    assert world.endpoint.validate(held) == []
    pose.close()
    world.say(pose, ahead(0.0), at_s=0.0)
    assert world.endpoint.robots["jackal1"].twin(now=0.0) is None
    assert [str(each.name) for each in world.endpoint.validate(held)] == ["/jackal1/odom"]


class Told:
    def __init__(self) -> None:
        self.added: list[str] = []

    def topic_added(self, info: TopicInfo) -> None:
        self.added.append(info.name)

    def topic_removed(self, name: TopicName) -> None:
        raise AssertionError(name)


async def test_it_announces_its_topics_and_ends() -> None:
    world, told = World(), Told()
    await world.endpoint.start(told)
    assert "/twin/jackal1/unity" in told.added
    assert set(told.added) == {f"/twin/jackal1/{part}" for part in TYPES}
    await until(lambda: world.got["/twin/jackal1/status"])
    await world.endpoint.stop()
    assert world.endpoint.validate(Held()) == []
