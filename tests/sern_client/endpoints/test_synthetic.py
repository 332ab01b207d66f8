"""The simulated robot and operator as endpoints: true types, honest rates, obedience, and seeds."""

import asyncio
import logging
import math
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random
from typing import Any, Literal

import numpy as np
import pytest

from sern_client.endpoints.jackal import JACKAL, PLAN, TRUTH, JackalSource, Plan, Sizes
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


def follower_of(plant: str, noise_m: float = 0.01) -> JackalSource:
    if plant == "mujoco":
        pytest.importorskip("mujoco", reason="the extra sim is not installed")
    return JackalSource(
        Random(4), Encoding.CDR, Sizes(), patrol=False, follow=True, localisation_noise_m=noise_m, plant=plant
    )


@pytest.mark.parametrize("plant", ["unicycle", "mujoco"])
def test_it_stays_on_the_plan_it_told_and_says_how_far_its_localisation_is_off(plant: str) -> None:
    """Over a minute after the plan was told, as a twin would take it through a blackout."""
    source = follower_of(plant)
    source.advance(1.0)
    poses = read(source, PLAN, 10**18).poses
    filtered = next(plan for plan in JACKAL if plan.name == "/odometry/filtered")
    tracked_m, off_m = [], []
    for planned in poses:
        at_s = planned.header.stamp.sec + planned.header.stamp.nanosec / 1e9 - 1e9
        if not 0 < at_s <= 60:
            continue
        source.advance(1.0 + at_s)
        true = read(source, TRUTH).pose.pose.position
        thought = read(source, filtered).pose.pose.position
        tracked_m.append(math.dist((true.x, true.y), (planned.pose.position.x, planned.pose.position.y)))
        off_m.append(math.dist((true.x, true.y), (thought.x, thought.y)))
    assert len(tracked_m) > 110
    assert sorted(tracked_m)[round(0.95 * len(tracked_m))] < 0.1
    # In each axis one sigma is 1 cm, a share of it white; what a step moves it, 1.5 cm, is in it too.
    assert 0.005 < sum(off_m) / len(off_m) < 0.035
    assert (true.x, true.y) == (source.robot.state.pose.x_m, source.robot.state.pose.y_m)


def test_on_hills_its_messages_have_height_and_tilt_and_its_clouds_labels() -> None:
    source = follower_of("mujoco", 0.0)
    tilted = 0.0
    for step in range(40):
        source.advance(step * 0.5)
        state = source.robot.state
        pose = read(source, TRUTH).pose.pose
        transform = read(source, next(plan for plan in JACKAL if plan.name == "/tf")).transforms[0].transform
        imu = read(source, next(plan for plan in JACKAL if plan.name == "/imu/data"))
        assert pose.position.z == transform.translation.z == state.z_m != 0.0
        turned = imu.orientation
        up = 1 - 2 * (turned.x**2 + turned.y**2)
        assert up == pytest.approx(math.cos(state.roll_rad) * math.cos(state.pitch_rad))
        assert 2 * (turned.w * turned.y - turned.z * turned.x) == pytest.approx(math.sin(state.pitch_rad))
        assert (pose.orientation.x, pose.orientation.y) == (turned.x, turned.y)
        assert read(source, next(plan for plan in JACKAL if plan.name == "/pose")).pose == pose
        tilted = max(tilted, abs(state.pitch_rad))
    assert tilted > 0.01
    cloud = read(source, next(plan for plan in JACKAL if plan.name == "/points"))
    assert [(field.name, field.offset, field.datatype) for field in cloud.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("label", 16, 4),
    ]  # fmt: skip
    assert cloud.point_step == 18 and cloud.row_step == len(cloud.data) == 18 * cloud.width
    assert abs(len(cloud.data) - 100_000) <= 18
    labels = np.frombuffer(cloud.data.tobytes(), dtype=[("xyzi", "<f4", 4), ("label", "<u2")])["label"]
    assert {1, 5} <= set(labels.tolist()) <= {0, 1, 2, 3, 4, 5}


async def drive_until(endpoint: SyntheticEndpoint, time_s: float) -> None:
    """Turn by turn, so that virtual time goes no further than it has to."""
    while endpoint.state().time_s < time_s:  # noqa: ASYNC110  virtual time: every turn of the loop moves it
        await asyncio.sleep(0)


@pytest.mark.parametrize("plant", ["unicycle", "mujoco"])
async def test_commands_come_before_the_plan_and_a_new_one_after_them(
    plant: Literal["unicycle", "mujoco"], events: Any, clock: Any
) -> None:
    if plant == "mujoco":
        pytest.importorskip("mujoco", reason="the extra sim is not installed")
    options = SyntheticOptions(topics=("/odometry/filtered",), follow=True, command_timeout_s=0.5, plant=plant)
    start_ns = clock.wall_ns()
    endpoint = SyntheticEndpoint(options, clock=clock)
    await endpoint.start(events)
    assert set(events.infos) == {"/odometry/filtered", "/plan", "/ground_truth"}
    rows = subscribe_all(endpoint, events)
    await drive_until(endpoint, 5.0)
    assert endpoint.state().travelled_m > 1.5
    told = len(rows["/plan"])
    assert told >= 1
    publisher = endpoint.advertise(topic_info("/cmd_vel", TWIST, Encoding.ROS1))
    publisher.publish(twist(0.0, 0.0, Encoding.ROS1), 1)
    await drive_until(endpoint, 5.2)
    late: list[bytes] = []

    def joined_late(body: bytes, stamp_ns: int) -> bool:
        late.append(body)
        return True

    endpoint.subscribe(TopicName("/plan"), joined_late)
    await drive_until(endpoint, 5.4)
    assert late == [] and len(rows["/plan"]) == told, "a robot under command has no plan"
    await drive_until(endpoint, 10.0)
    await endpoint.stop()
    assert len(late) == 1 and len(rows["/plan"]) == told + 1
    plan = ros_types.deserialise(late[0], "nav_msgs/msg/Path", Encoding.ROS1)
    times_s = [pose.header.stamp.sec - start_ns // 10**9 + pose.header.stamp.nanosec / 1e9 for pose in plan.poses]
    assert 5.5 <= times_s[0] < 5.6 and times_s[-1] > times_s[0] + 60
    truth = [ros_types.deserialise(body, "nav_msgs/msg/Odometry", Encoding.ROS1) for body, _ in rows["/ground_truth"]]
    true = {
        round(each.header.stamp.sec - start_ns // 10**9 + each.header.stamp.nanosec / 1e9, 2): each for each in truth
    }
    stood = true[round(times_s[0], 2)]
    assert abs(stood.twist.twist.linear.x) < 0.1
    off_m = [
        math.dist((at.pose.pose.position.x, at.pose.pose.position.y), (pose.pose.position.x, pose.pose.position.y))
        for time_s, pose in zip(times_s, plan.poses, strict=True)
        if (at := true.get(round(time_s, 2)))
    ]
    assert len(off_m) >= 8 and max(off_m) < 0.15
    assert endpoint.state().travelled_m > 3.5


def test_only_one_who_follows_tells_the_plan_from_the_truth() -> None:
    names = set(SyntheticEndpoint(SyntheticOptions(topics=20))._topics)
    assert not {"/plan", "/ground_truth"} & names and len(names) == 20
    names = set(SyntheticEndpoint(SyntheticOptions(topics=20, follow=True))._topics)
    assert {"/plan", "/ground_truth"} < names and len(names) == 22


def test_without_mujoco_only_the_unicycle_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match="install sern\\[sim\\], or take plant unicycle") as caught:
        SyntheticEndpoint(SyntheticOptions(plant="mujoco"))
    assert "\n" not in str(caught.value)
    assert SyntheticEndpoint(SyntheticOptions(plant="unicycle", follow=True)).state().time_s == 0.0


def test_a_client_without_mujoco_ends_with_one_line(tmp_path: Path) -> None:
    config = tmp_path / "client.yaml"
    config.write_text(
        "client: {name: jackal1}\nrelay: {endpoint: 'tcp://127.0.0.1:5555', insecure: true}\n"
        "endpoint: {kind: synthetic, role: robot, plant: mujoco}\n"
    )
    script = "import sys; sys.modules['mujoco'] = None; from sern_client.cli import main; main()"
    command = [sys.executable, "-c", script, "--config", str(config)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    said = ended.stderr.splitlines()
    assert ended.returncode == 2 and len(said) == 1, ended.stderr
    assert said[0].startswith("sern-client: plant mujoco needs the package mujoco")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"plant": "tank"}, "plant 'tank' is not known"),
        ({"plant": "mujoco", "patrol": True}, "no patrol"),
        ({"follow": True, "localisation_noise_m": -0.1}, "localisation_noise_m"),
        ({"follow": True, "localisation_noise_m": math.nan}, "localisation_noise_m"),
    ],
)
def test_options_that_drive_nothing(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        SyntheticEndpoint(SyntheticOptions(**options))
