"""The `Endpoint` of the twins: what robots say goes in where topics are advertised, twins come out as topics of here.

For each robot NAME, under the prefix:

    NAME/odom       nav_msgs/Odometry, the twin to be shown: it never jumps; x and y have its error bound as two sigmas
    NAME/estimate   the same of what is known, which may jump
    NAME/age        std_msgs/Float32, seconds since the last pose that was taken
    NAME/error      std_msgs/Float32, metres that the shown twin may be off
    NAME/path       nav_msgs/Path, where it is going to be
    NAME/unity      geometry_msgs/PoseStamped, the shown twin in Unity's axes, where the file asks for it
    NAME/status     diagnostic_msgs/DiagnosticArray, the same in words, with counts

What the client itself makes, such as the map of its scene, goes out beside them (`offered.py`).
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import (
    Difference,
    Held,
    Publisher,
    SceneShown,
    Sink,
    SiteObjects,
    Subscription,
    TopicEvents,
)
from sern_client.endpoints.common.held import HeldSubscription
from sern_client.endpoints.common.saying import SayOnce, say_failure
from sern_client.endpoints.twin import bodies
from sern_client.endpoints.twin.metrics import register_twins
from sern_client.endpoints.twin.offered import Offered
from sern_client.endpoints.twin.options import TwinOptions
from sern_client.endpoints.twin.robot import RobotTwin
from sern_client.endpoints.twin.view.frames import Snapshot, robot_frame
from sern_client.endpoints.twin.view.server import TwinView
from sern_core.vocabulary.errors import BodyError, ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import DropReason, Encoding, ObjectKind, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.entry import end_tasks
from sern_runtime.metrics import Metrics
from sern_twin.motion import Motion
from sern_twin.synchroniser import Twin

_log = logging.getLogger(__name__)

SLOW_HZ: Final = 2.0
"""How often path and status are published."""
AHEAD_STEP_S: Final = 0.25
TYPES: Final = {
    "odom": bodies.ODOMETRY,
    "estimate": bodies.ODOMETRY,
    "age": bodies.FLOAT,
    "error": bodies.FLOAT,
    "path": bodies.PATH,
    "status": bodies.DIAGNOSTICS,
    "unity": bodies.POSE,
}
LEVELS: Final = ("ok", "warn", "error", "stale")
"""The levels of diagnostic_msgs/DiagnosticStatus, in words."""
SLOW: Final = frozenset({"path", "status"})


@dataclass(slots=True, eq=False)
class _Topic:
    info: TopicInfo
    robot: RobotTwin
    part: str
    subscriptions: list["_Subscription"] = field(default_factory=list)


_Subscription = HeldSubscription[_Topic]


class _Hearer:
    """A `Publisher` of what a robot says. Open while it is in `hearers`. `tell_age`: how old the next message is."""

    def __init__(self, name: TopicName, hear: Callable[[bytes, int, float], None], hearers: "list[_Hearer]") -> None:
        self.name = name
        self._hear = hear
        self._hearers = hearers
        self._age_s = 0.0
        hearers.append(self)

    def tell_age(self, age_s: float) -> None:
        self._age_s = age_s

    def publish(self, body: bytes, stamp_ns: int) -> None:
        if self in self._hearers:
            self._hear(body, stamp_ns, max(0.0, self._age_s))

    def close(self) -> None:
        if self in self._hearers:
            self._hearers.remove(self)


class TwinEndpoint:
    def __init__(
        self,
        options: TwinOptions,
        *,
        now: Callable[[], float] = clock.now,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._options = options
        self._now = now
        self._wall_ns = wall_ns
        self._encoding = Encoding(options.encoding)
        self._writer = bodies.Writer(self._encoding)
        self.robots = {robot.name: RobotTwin(robot) for robot in options.robots}
        self._topics: dict[TopicName, _Topic] = {}
        for name, robot in self.robots.items():
            for part, type_name in TYPES.items():
                if part == "unity" and not options.unity:
                    continue
                info = ros_types.topic_info(f"{options.prefix}/{name}/{part}", type_name, self._encoding)
                self._topics[info.name] = _Topic(info, robot, part)
        self._hearers: list[_Hearer] = []
        self._offered = Offered(set(self._topics))
        self._said = SayOnce(_log)
        self._drops: Counter[DropReason] = Counter()
        self._objects: SiteObjects | None = None
        self._link_words: Callable[[], str] = str
        self.view: TwinView | None = None
        if options.view is not None:
            self.view = TwinView(options.view, tuple(self.robots), self.snapshot, now=now)
        self._task: asyncio.Task[None] | None = None

    def use_objects(self, objects: SiteObjects) -> None:
        self._objects = objects

    def show_link(self, words: Callable[[], str]) -> None:
        self._link_words = words

    def show_scene(self, scene: SceneShown) -> None:
        if self.view is not None:
            self.view.scene = scene

    async def start(self, events: TopicEvents) -> None:
        if self.view is not None:
            await self.view.start()
        for topic in self._topics.values():
            events.topic_added(topic.info)
        self._offered.announce(events)
        self._task = asyncio.create_task(self._run(), name="twins")
        self._task.add_done_callback(say_failure)

    async def stop(self) -> None:
        await end_tasks([] if self._task is None else [self._task])
        if self.view is not None:
            await self.view.stop()
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()
        self._offered.close()

    @property
    def prefix(self) -> str:
        return self._options.prefix

    def offer(self, info: TopicInfo) -> Publisher:
        return self._offered.offer(info)

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        if name in self._offered:
            return self._offered.subscribe(name, sink)
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: the twins have no such topic")
        subscription = _Subscription(sink, topic, topic.subscriptions)
        topic.subscriptions.append(subscription)
        return subscription

    def advertise(self, info: TopicInfo) -> _Hearer:
        """ConfigError: it is no pose or plan of a robot, or of a type that is not read."""
        for robot in self.robots.values():
            by_satellite = robot.options.datum is not None
            for topic, wanted, hear in (
                (
                    robot.options.pose,
                    *(((bodies.FIX,), self._fix) if by_satellite else ((bodies.ODOMETRY,), self._pose)),
                ),
                (robot.options.plan, (bodies.PATH, bodies.TRAJECTORY), self._plan),
            ):
                if topic != info.name:
                    continue
                if plain_type(info.type_name) not in map(plain_type, wanted) or info.encoding is Encoding.RAW:
                    reads = " or ".join(wanted)
                    if plain_type(info.type_name) == plain_type(bodies.FIX) and topic == robot.options.pose:
                        reads += f" (and {bodies.FIX} where the robot has `datum`, the site's origin on the Earth)"
                    raise ConfigError(
                        f"{info.name}: the twin of {robot.options.name} reads {reads}, not {info.type_name}"
                    )
                return self._hearer(info, robot, hear)
        raise ConfigError(f"{info.name}: no robot of the twins has it as its pose or plan")

    def _hearer(
        self, info: TopicInfo, robot: RobotTwin, hear: Callable[[RobotTwin, TopicInfo, bytes, int, float], None]
    ) -> _Hearer:
        def heard(body: bytes, stamp_ns: int, age_s: float) -> None:
            try:
                hear(robot, info, body, stamp_ns, age_s)
            except BodyError as error:
                self._drops[DropReason.UNDECODABLE] += 1
                self._said(f"{info.name}: {error}", str(info.name))

        return _Hearer(info.name, heard, self._hearers)

    def _pose(self, robot: RobotTwin, info: TopicInfo, body: bytes, stamp_ns: int, age_s: float) -> None:
        robot.pose(bodies.read_pose(body, info.encoding), taken_ns=stamp_ns, age_s=age_s, now=self._now())

    def _fix(self, robot: RobotTwin, info: TopicInfo, body: bytes, stamp_ns: int, age_s: float) -> None:
        robot.fix(bodies.read_fix(body, info.encoding), taken_ns=stamp_ns, age_s=age_s, now=self._now())

    def _plan(self, robot: RobotTwin, info: TopicInfo, body: bytes, stamp_ns: int, age_s: float) -> None:
        plan = bodies.read_plan(body, info.type_name, info.encoding, taken_ns=stamp_ns)
        robot.plan(plan, taken_ns=stamp_ns, age_s=age_s, now=self._now())

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Makes no difference: what nobody subscribes to is not made."""

    def validate(self, held: Held) -> list[Difference]:
        offered = self._offered.held
        hearers = Counter(hearer.name for hearer in self._hearers)
        taken = Counter(name for name, topic in self._topics.items() for _ in topic.subscriptions)
        return held.differences(Held(hearers + offered.publishers, taken + offered.subscriptions))

    @property
    def encoding(self) -> None:
        """Reads either encoding."""
        return None

    @property
    def exhausted(self) -> bool:
        """Never."""
        return False

    @property
    def drops(self) -> Mapping[DropReason, int]:
        return self._drops + self._offered.drops

    def register_metrics(self, metrics: Metrics) -> None:
        register_twins(metrics, self.robots, self._now)
        metrics.counter(
            "sern_twin_view_failures_total",
            "Times the view of the twins in a browser failed, and went on.",
            read=lambda: [((), 0.0 if self.view is None else float(self.view.failures))],
        )

    @property
    def json_routes(self) -> Mapping[str, Callable[[], object]]:
        return {"/api/twins": self.to_json}

    # Out

    async def _run(self) -> None:
        period_s = 1.0 / self._options.rate_hz
        slowly = max(1, round(self._options.rate_hz / SLOW_HZ))
        turn = 0
        due_s = self._now()
        while True:
            self.publish(slow=turn % slowly == 0)
            turn += 1
            now = self._now()
            due_s = max(due_s + period_s, now - period_s)  # what was missed is not made up for
            await asyncio.sleep(max(0.0, due_s - now))

    def publish(self, *, slow: bool) -> None:
        """Everything that somebody wants of the twins as they are now."""
        now, wall_ns = self._now(), self._wall_ns()
        twins = {name: robot.twin(now=now) for name, robot in self.robots.items()}
        if slow and self._objects is not None and self._options.objects:
            for name, twin in twins.items():
                self._put(self._objects, self.robots[name], twin, wall_ns)
        for topic in self._topics.values():
            if not topic.subscriptions or (topic.part in SLOW and not slow):
                continue
            twin = twins[topic.robot.options.name]
            body = self._body(topic.robot, topic.part, twin, now, wall_ns)
            if body is None:
                continue
            for subscription in list(topic.subscriptions):
                if not subscription.sink(body, wall_ns):
                    self._drops[DropReason.REFUSED] += 1

    def _put(self, objects: SiteObjects, robot: RobotTwin, twin: Twin | None, wall_ns: int) -> None:
        """The object of a robot; there is none before the robot was heard."""
        if twin is None:
            return
        name, shown = robot.options.name, twin.shown
        level, text, _values = _words(robot, twin)
        objects.put(
            f"{self._options.prefix}/{name}",
            ObjectKind.ROBOT,
            bodies.ODOMETRY,
            value=self._body(robot, "odom", twin, self._now(), wall_ns) or b"",
            attributes={
                "says": text,
                "level": LEVELS[level],
                "age_s": f"{twin.age_s:.2f}",
                "error_m": f"{twin.error_m:.3f}",
                "x_m": f"{shown.x_m:.3f}",
                "y_m": f"{shown.y_m:.3f}",
                "yaw_rad": f"{shown.yaw_rad:.4f}",
                "frame_id": robot.frame.frame_id,
                "encoding": self._encoding.value,
            },
            ros_stamp_ns=wall_ns,
        )

    def _body(self, robot: RobotTwin, part: str, twin: Twin | None, now: float, wall_ns: int) -> bytes | None:
        """None before the robot was heard, but for its status."""
        if part == "status":
            return self._writer.status(robot.options.name, *_words(robot, twin), stamp_ns=wall_ns)
        if twin is None:
            return None
        frame, child = robot.frame, f"twin/{robot.options.name}/{robot.frame.child_frame_id or 'base_link'}"
        if part == "age":
            return self._writer.number(twin.age_s)
        if part == "error":
            return self._writer.number(twin.error_m)
        if part == "path":
            motions = self._ahead(robot, twin, now)
            stamps_ns = [wall_ns + round(number * AHEAD_STEP_S * 1e9) for number in range(len(motions))]
            return self._writer.path(motions, z_m=frame.z_m, stamps_ns=stamps_ns, frame_id=frame.frame_id)
        if part == "unity":
            frame_id = f"unity/{frame.frame_id}"
            return self._writer.unity(twin.shown, z_m=frame.z_m, stamp_ns=wall_ns, frame_id=frame_id)
        motion = twin.shown if part == "odom" else twin.estimate
        return self._writer.odometry(
            motion, twin.error_m, z_m=frame.z_m, stamp_ns=wall_ns, frame_id=frame.frame_id, child_frame_id=child
        )

    def _ahead(self, robot: RobotTwin, twin: Twin, now: float) -> list[Motion]:
        return robot.ahead(twin.shown, max(1, round(self._options.ahead_s / AHEAD_STEP_S)), AHEAD_STEP_S, now=now)

    def snapshot(self) -> Snapshot:
        """What is to be seen of the twins now."""
        now = self._now()
        robots = []
        for robot in self.robots.values():
            twin = robot.twin(now=now)
            level, says, _values = _words(robot, twin)
            path = () if twin is None else self._ahead(robot, twin, now)
            robots.append(robot_frame(robot, twin, path, says, level))
        return Snapshot(now, tuple(robots), self._link_words())

    def to_json(self) -> dict[str, object]:
        """What `/api/twins` says."""
        now = self._now()
        found: dict[str, object] = {}
        for name, robot in self.robots.items():
            twin = robot.twin(now=now)
            shown = None if twin is None else twin.shown
            level, text, values = _words(robot, twin)
            found[name] = {
                "says": text,
                "level": level,
                "pose": None if shown is None else [shown.x_m, shown.y_m, shown.yaw_rad],
                "frame_id": robot.frame.frame_id,
                "now_s": now,
                "age_s": None if twin is None else twin.age_s,
                "error_m": None if twin is None else twin.error_m,
                **dict(values),
            }
        return found


def _words(robot: RobotTwin, twin: Twin | None) -> tuple[int, str, list[tuple[str, str]]]:
    """Level, text and values of a robot's status."""
    values = [
        ("goes_by", robot.goes_by),
        ("gaps", str(robot.gaps)),
        ("gaps_violated", str(robot.violated)),
        ("stops", str(robot.stops)),
        ("snaps", str(robot.snaps)),
        *((f"poses_{outcome}", str(count)) for outcome, count in robot.counts.items()),
        *((f"plans_refused_{why}", str(count)) for why, count in robot.refused.items()),
    ]
    if twin is None:
        return 3, f"not heard yet: {robot.options.pose}", values
    text = f"{twin.age_s:.2f} s old, error at most {twin.error_m:.2f} m"
    if twin.outside:
        return 2, f"{text}; outside of what was bounded", values
    return (1 if twin.age_s >= robot.options.gap_s else 0), text, values
