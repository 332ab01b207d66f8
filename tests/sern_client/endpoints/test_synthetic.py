"""The simulated robot and operator as endpoints: true types, honest rates, obedience, and seeds."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from sern_client.endpoints.jackal import JACKAL, PLAN, JackalSource, Plan, Sizes
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import topic_info

Until = Callable[[Callable[[], bool]], Awaitable[None]]
Rows = dict[str, list[tuple[bytes, int]]]
TWIST = "geometry_msgs/msg/Twist"


def subscribe_all(endpoint: SyntheticEndpoint, events: Any) -> Rows:
    rows: Rows = {name: [] for name in events.infos}
    for name in events.infos:

        def sink(body: bytes, stamp_ns: int, row: list[tuple[bytes, int]] = rows[name]) -> bool:
            row.append((body, stamp_ns))
            return True

        endpoint.subscribe(name, sink)
    return rows


def twist(speed: float, turn: float, encoding: Encoding, *, stamped: bool = False) -> bytes:
    linear = ros_types.new("geometry_msgs/msg/Vector3", encoding, x=speed)
    angular = ros_types.new("geometry_msgs/msg/Vector3", encoding, z=turn)
    message = ros_types.new(TWIST, encoding, linear=linear, angular=angular)
    if not stamped:
        return ros_types.serialise(message, TWIST, encoding)
    name = "geometry_msgs/msg/TwistStamped"
    return ros_types.serialise(ros_types.new(name, encoding, twist=message), name, encoding)


async def run(options: SyntheticOptions, events: Any, clock: Any, until: Until, seconds: float) -> Rows:
    endpoint = SyntheticEndpoint(options, clock=clock)
    end_s = clock.now_s + seconds
    await endpoint.start(events)
    rows = subscribe_all(endpoint, events)
    while clock.now_s < end_s:  # noqa: ASYNC110  virtual time: every turn of the loop moves it
        await asyncio.sleep(0)
    await endpoint.stop()
    return rows


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
async def test_every_topic_is_what_it_says(encoding: str, events: Any, clock: Any, until: Until) -> None:
    """Each body decodes with its declared type; hash and definition belong to it; rates and sizes are as tabled."""
    options = SyntheticOptions(seed=3, encoding=encoding, patrol=True, load_factor=2.0)  # type: ignore[arg-type]
    rows = await run(options, events, clock, until, 2.0)
    assert list(events.infos) == [plan.name for plan in JACKAL] and len(JACKAL) == 20
    for plan in JACKAL:
        info, got = events.infos[plan.name], rows[plan.name]
        assert info == topic_info(
            plan.name,
            plan.type_name,
            Encoding(encoding),
            latched=plan.latched,
            reliable=plan.reliable if encoding == "cdr" else None,
        )
        assert ros_types.hash_of(info.type_name, info.definition, info.encoding) == info.type_hash
        for body, _ in got:
            message = ros_types.deserialise(body, info.type_name, info.encoding)
            assert ros_types.serialise(message, info.type_name, info.encoding) == body
        rate = plan.rate_hz * (2.0 if plan.bulk else 1.0)
        assert abs(len(got) - (2.0 * rate + 1)) <= 1.01 + plan.latched
    assert abs(len(rows["/points"][0][0]) - 100_000) < 300
    assert abs(len(rows["/map"][0][0]) - 40_000) < 300
    assert abs(len(rows["/camera/image_raw"][0][0]) - 9_216) < 300


async def test_a_seed_decides_everything(events: Any, clock: Any, until: Until) -> None:
    start_s = clock.now_s

    async def story(seed: int) -> Rows:
        clock.now_s = start_s
        events.infos.clear()
        return await run(SyntheticOptions(seed=seed, patrol=True), events, clock, until, 1.0)

    first, again, other = await story(5), await story(5), await story(6)
    assert first == again
    assert first["/pose"] != other["/pose"]


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("stamped", [False, True])
async def test_cmd_vel_moves_the_robot(
    encoding: Encoding, stamped: bool, events: Any, clock: Any, until: Until
) -> None:
    """Whatever the robot's own encoding is."""
    endpoint = SyntheticEndpoint(SyntheticOptions(topics=("/pose", "/status")), clock=clock)
    await endpoint.start(events)
    rows = subscribe_all(endpoint, events)
    await until(lambda: endpoint.state().time_s > 1.0)
    assert endpoint.state().travelled_m == 0.0
    type_name = "geometry_msgs/msg/TwistStamped" if stamped else TWIST
    publisher = endpoint.advertise(topic_info("/cmd_vel", type_name, encoding))
    publisher.publish(twist(0.5, 0.0, encoding, stamped=stamped), 1)
    began_s = endpoint.state().time_s
    await until(lambda: endpoint.state().time_s > began_s + 2.0)
    assert endpoint.state().pose.x_m > 0.7
    last = ros_types.deserialise(rows["/pose"][-1][0], "geometry_msgs/msg/PoseStamped", Encoding.ROS1)
    assert abs(last.pose.position.x - endpoint.state().pose.x_m) < 0.05
    status = ros_types.deserialise(rows["/status"][-1][0], "geometry_msgs/msg/TwistStamped", Encoding.ROS1)
    assert status.twist.linear.x == 0.5
    stop = ros_types.zero_message(type_name, encoding)
    assert stop is not None
    publisher.publish(stop, 2)
    await until(lambda: endpoint.state().speed_mps == 0.0)
    await endpoint.stop()
    received = endpoint.received("/cmd_vel")
    assert received is not None and received.count == 2 and received.size_bytes == len(stop) * 2


async def test_commands_may_time_out(events: Any, clock: Any, until: Until) -> None:
    endpoint = SyntheticEndpoint(SyntheticOptions(topics=1, command_timeout_s=0.5), clock=clock)
    await endpoint.start(events)
    rows = subscribe_all(endpoint, events)
    endpoint.advertise(topic_info("/cmd_vel", TWIST, Encoding.CDR)).publish(twist(0.5, 0.0, Encoding.CDR), 1)
    await until(lambda: endpoint.state().time_s > 3.0)
    await endpoint.stop()
    name = "nav_msgs/msg/Odometry"
    speeds = [
        ros_types.deserialise(body, name, Encoding.ROS1).twist.twist.linear.x for body, _ in rows["/odometry/filtered"]
    ]
    moving_s = sum(speed > 0.0 for speed in speeds) / 50.0
    assert 0.5 < moving_s < 1.0 and max(speeds) > 0.4 and speeds[-1] == 0.0


async def test_bad_commands_do_not_move_it(
    events: Any, clock: Any, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = SyntheticEndpoint(SyntheticOptions(topics=0), clock=clock)
    await endpoint.start(events)
    with pytest.raises(ConfigError, match="drives by"):
        endpoint.advertise(topic_info("/cmd_vel", "std_msgs/msg/String", Encoding.ROS1))
    publisher = endpoint.advertise(topic_info("/cmd_vel", TWIST, Encoding.ROS1))
    with caplog.at_level(logging.WARNING):
        publisher.publish(b"short", 1)
        publisher.publish(twist(float("nan"), 0.0, Encoding.ROS1), 1)
    assert len(caplog.records) == 1 and endpoint.counters.bad_commands == 2
    await until(lambda: endpoint.state().time_s > 1.0)
    assert endpoint.state().travelled_m == 0.0
    # A topic it has no use for is taken and counted.
    other = endpoint.advertise(topic_info("/plan", "nav_msgs/msg/Path", Encoding.CDR))
    other.publish(b"whatever", 7)
    other.close()
    other.publish(b"late", 8)
    received = endpoint.received("/plan")
    assert received is not None and (received.count, received.body, received.stamp_ns) == (1, b"whatever", 7)
    await endpoint.stop()


async def test_numbered_topics_lose_nothing_when_refused(events: Any, clock: Any, until: Until) -> None:
    """A refused number is offered again, in order; a refused pose is gone."""
    options = SyntheticOptions(topics=("/pose",), counter_topics=("/mission_log",))
    endpoint = SyntheticEndpoint(options, clock=clock)
    await endpoint.start(events)
    assert events.infos["/mission_log"].reliable is True
    log: list[str] = []
    closed_gate = True

    def gate(body: bytes, stamp_ns: int) -> bool:
        if not closed_gate:
            log.append(ros_types.deserialise(body, "std_msgs/msg/String", Encoding.ROS1).data)
        return not closed_gate

    endpoint.subscribe(TopicName("/mission_log"), gate)
    endpoint.subscribe(TopicName("/pose"), lambda body, stamp_ns: False)
    await until(lambda: endpoint.state().time_s > 3.0)
    closed_gate = False
    await until(lambda: len(log) >= 30)
    await endpoint.stop()
    assert log == [f"/mission_log {n}" for n in range(1, len(log) + 1)]
    assert endpoint.counters.dropped > 100


async def test_latched_topics_reach_late_subscribers(events: Any, clock: Any, until: Until) -> None:
    endpoint = SyntheticEndpoint(SyntheticOptions(topics=("/tf_static", "/map")), clock=clock)
    await endpoint.start(events)
    await until(lambda: endpoint.state().time_s > 1.0)
    refusals, bodies = [1, 1], list[bytes]()

    def third_time_lucky(body: bytes, stamp_ns: int) -> bool:
        if refusals:
            return bool(refusals.pop() is None)
        bodies.append(body)
        return True

    endpoint.subscribe(TopicName("/tf_static"), third_time_lucky)
    await until(lambda: bool(bodies))
    await endpoint.stop()
    message = ros_types.deserialise(bodies[0], "tf2_msgs/msg/TFMessage", Encoding.ROS1)
    assert [t.child_frame_id for t in message.transforms] == ["odom", "imu_link", "velodyne", "camera"]


async def test_operator_and_robot_meet(events: Any, clock: Any, until: Until) -> None:
    """The operator's commands drive the robot; the robot's pose is what the operator last saw."""
    robot = SyntheticEndpoint(SyntheticOptions(topics=("/pose",), encoding="cdr"), clock=clock)
    options = SyntheticOptions(role="operator", encoding="cdr", command_topic="/jackal1/cmd_vel", command_stamped=True)
    operator = SyntheticEndpoint(options, clock=clock)
    await robot.start(events)
    await operator.start(events)
    goal = events.infos["/goal"]
    assert goal.type_name == "geometry_msgs/msg/PoseStamped" and goal.reliable
    command = robot.advertise(topic_info("/cmd_vel", "geometry_msgs/msg/TwistStamped", Encoding.CDR))
    pose = operator.advertise(events.infos["/pose"])
    goals: list[bytes] = []
    assert operator.latest("/pose") is None

    def take_goal(body: bytes, stamp_ns: int) -> bool:
        goals.append(body)
        return True

    def forward(publish: Callable[[bytes, int], None]) -> Callable[[bytes, int], bool]:
        def sink(body: bytes, stamp_ns: int) -> bool:
            publish(body, stamp_ns)
            return True

        return sink

    operator.subscribe(TopicName("/jackal1/cmd_vel"), forward(command.publish))
    operator.subscribe(TopicName("/goal"), take_goal)
    robot.subscribe(TopicName("/pose"), forward(pose.publish))
    await until(lambda: robot.state().time_s > 6.0 and len(goals) >= 2)
    await robot.stop()
    await operator.stop()
    seen, truth = operator.latest("/pose").pose.position, robot.state().pose
    assert abs(seen.x - truth.x_m) < 0.05 and abs(seen.y - truth.y_m) < 0.05
    assert robot.state().travelled_m > 1.0
    received, commands = operator.received("/pose"), robot.received("/cmd_vel")
    assert received is not None and commands is not None
    assert 45 < received.rate_hz < 55 and 9 < commands.rate_hz < 11
    with pytest.raises(UsageError):
        operator.state()


async def test_the_operator_decodes_types_that_come_with_their_definition(events: Any) -> None:
    operator = SyntheticEndpoint(SyntheticOptions(role="operator"))
    info = TopicInfo(TopicName("/gait"), "synthetic_test_msgs/msg/Gait", Encoding.ROS1, "", "uint8 mode\n")
    operator.advertise(info).publish(b"\x07", 1)
    assert operator.latest("/gait").mode == 7
    assert operator.latest("/never") is None and operator.received("/never") is None


async def test_clouds_from_scans(tmp_path: Path, events: Any, clock: Any, until: Until) -> None:
    """Two files, played alternately at the cloud rate."""
    files = []
    for i in (1, 2):
        path = tmp_path / f"scan{i}.ply"
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex {i}\nproperty float x\nproperty float y\nproperty float z\n"
            "end_header\n" + "1 2 3\n" * i
        )
        files.append(path)
    options = SyntheticOptions(topics=("/points",), cloud_files=tuple(files), cloud_rate_hz=5.0)
    rows = await run(options, events, clock, until, 1.0)
    messages = [ros_types.deserialise(b, "sensor_msgs/msg/PointCloud2", Encoding.ROS1) for b, _ in rows["/points"]]
    assert [message.width for message in messages][:5] == [1, 2, 1, 2, 1]


@pytest.mark.parametrize(
    "options",
    [
        SyntheticOptions(topics=21),
        SyntheticOptions(topics=("/nothing",)),
        SyntheticOptions(load_factor=-1.0),
        SyntheticOptions(cloud_files=(Path("nowhere.ply"),)),
    ],
)
def test_bad_options(options: SyntheticOptions) -> None:
    with pytest.raises(ConfigError) as caught:
        SyntheticEndpoint(options)
    assert "\n" not in str(caught.value)


async def test_misuse(events: Any) -> None:
    endpoint = SyntheticEndpoint(SyntheticOptions(topics=1))
    await endpoint.start(events)
    with pytest.raises(UsageError):
        endpoint.subscribe(TopicName("/points"), lambda body, stamp_ns: True)
    assert not endpoint.exhausted
    await endpoint.stop()


def follower(noise_m: float = 0.01) -> JackalSource:
    return JackalSource(Random(4), Encoding.CDR, Sizes(), patrol=False, follow=True, localisation_noise_m=noise_m)


def read(source: JackalSource, plan: Plan, stamp_ns: int = 10**18) -> Any:
    return ros_types.deserialise(source.body(plan, stamp_ns), plan.type_name, Encoding.CDR)


def test_a_robot_that_follows_a_plan_is_where_the_plan_had_it() -> None:
    source = follower()
    source.advance(1.0)
    plan = read(source, PLAN)
    times_s = [pose.header.stamp.sec + pose.header.stamp.nanosec / 1e9 - 1e9 for pose in plan.poses]
    assert times_s[-1] > 60 and times_s == sorted(times_s)
    for number in (20, 60, 100):
        source.advance(1.0 + times_s[number])
        true, planned = source.robot.state.pose, plan.poses[number].pose.position
        assert math.dist((true.x_m, true.y_m), (planned.x, planned.y)) < 0.1


def test_its_odometry_is_where_it_thinks_it_is_and_its_pose_where_it_is() -> None:
    source = follower(0.05)
    odometry, pose = (next(plan for plan in JACKAL if plan.name == name) for name in ("/odometry/filtered", "/pose"))
    apart_m = []
    for step in range(200):
        source.advance(step * 0.2)
        said, true = read(source, odometry).pose.pose.position, read(source, pose).pose.position
        assert (true.x, true.y) == (source.robot.state.pose.x_m, source.robot.state.pose.y_m)
        apart_m.append(math.dist((said.x, said.y), (true.x, true.y)))
    assert 0.02 < sum(apart_m) / len(apart_m) < 0.2


def test_after_commands_it_makes_a_new_plan_from_where_it_is() -> None:
    source = follower()
    source.advance(5.0)
    before = read(source, PLAN)
    source.drive(0.5, 0.0)
    source.advance(7.0)
    assert source.release() and not source.release()
    after = read(source, PLAN)
    true, first = source.robot.state.pose, after.poses[0].pose.position
    assert math.dist((true.x_m, true.y_m), (first.x, first.y)) < 0.1
    assert [pose.pose.position.x for pose in after.poses[:20]] != [pose.pose.position.x for pose in before.poses[4:24]]
    source.advance(60.0)
    assert source.robot.state.travelled_m > 20
