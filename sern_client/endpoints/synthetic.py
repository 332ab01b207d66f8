"""A simulated robot, or its operator, as an endpoint: everything seeded, nothing to install.

The robot gives the topics of `jackal.py` (names, types and default rates are tabled there) and drives by the velocity
commands it receives. The operator gives commands and goals, and keeps what it receives for `latest`, `received`.
"""

import asyncio
import heapq
import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any, Final, Literal

from sern_client.endpoints.base import Difference, Held, Sink, TopicEvents
from sern_client.endpoints.clock import Clock, SystemClock
from sern_client.endpoints.common.held import HeldSubscription
from sern_client.endpoints.common.saying import say_failure
from sern_client.endpoints.jackal import JACKAL, PLAN, TRUTH, JackalSource, OperatorSource, Plan, Sizes
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.entry import end_tasks
from sern_sim.pilot import OFF_M
from sern_sim.robot import STEP_S, Pose2, RobotState

COUNTER_RATE_HZ: Final = 5.0
HOLD_MESSAGES: Final = 10_000
"""How many refused messages of a numbered topic or a goal are kept to be offered again."""
RETRY_S: Final = 0.02
LATE_S: Final = 1.0
"""A source this far behind its schedule (a suspended machine) goes on from now instead of catching up."""
RUN_S: Final = 0.002
"""Longest run of the source without giving the event loop a turn."""
_RATE_WINDOW: Final = 50
_COMMAND_TYPES: Final = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"})

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SyntheticOptions:
    """`topics`: the first n of the table, or names from it. `load_factor` multiplies the rates of bulk topics.
    `commands` are the topics the robot drives by. `counter_topics` are extra reliable std_msgs/String topics at 5 Hz
    whose text is `<topic> <n>`, n = 1, 2, 3... without a gap. `command_timeout_s` stops the robot when commands cease;
    None leaves that to whoever guards the link. `follow`: it drives by a plan, which it publishes, in closed loop with
    a localisation that is off by `localisation_noise_m`; commands come first, and after their end there is a new plan.
    `plant`: what drives: a unicycle in a flat yard, or MuJoCo, four wheels that skid on hills (the extra `sim`).
    The fields from `command_topic` on are the operator's.
    """

    seed: int = 0
    encoding: Literal["ros1", "cdr"] = "ros1"
    role: Literal["robot", "operator"] = "robot"
    topics: int | tuple[str, ...] = 20
    plant: Literal["unicycle", "mujoco"] = "unicycle"
    patrol: bool = False
    cloud_bytes: int = 100_000
    cloud_rate_hz: float = 10.0
    cloud_files: tuple[Path, ...] = ()
    map_bytes: int = 40_000
    map_rate_hz: float = 0.2
    image_bytes: int = 9_216
    pose_rate_hz: float = 50.0
    load_factor: float = 1.0
    commands: tuple[str, ...] = ("/cmd_vel",)
    command_timeout_s: float | None = None
    follow: bool = False
    localisation_noise_m: float = OFF_M
    counter_topics: tuple[str, ...] = ()
    command_topic: str = "/cmd_vel"
    command_stamped: bool = False
    command_rate_hz: float = 10.0
    goal_topic: str = "/goal"
    goal_rate_hz: float = 0.2


@dataclass(slots=True)
class SyntheticCounters:
    accepted: int = 0
    refused: int = 0  # offers answered with no
    dropped: int = 0  # refused messages that are not offered again
    bad_commands: int = 0
    late: int = 0  # came to a publisher that was closed


@dataclass(slots=True)
class Received:
    """What arrived on one advertised topic."""

    info: TopicInfo
    count: int = 0
    size_bytes: int = 0
    body: bytes = b""
    stamp_ns: int = 0
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_WINDOW))

    @property
    def rate_hz(self) -> float:
        """Mean rate over the last 50 arrivals; 0 before the second."""
        if len(self.arrivals_s) < 2 or self.arrivals_s[-1] <= self.arrivals_s[0]:
            return 0.0
        return (len(self.arrivals_s) - 1) / (self.arrivals_s[-1] - self.arrivals_s[0])


@dataclass(slots=True, eq=False)
class _Topic:
    plan: Plan
    info: TopicInfo
    counter: bool = False
    hold: bool = False  # refused messages are offered again
    number: int = 0
    subscriptions: list["_Subscription"] = field(default_factory=list)


_Subscription = HeldSubscription[_Topic]


class _Publisher:
    """Open while it is in `publishers`, those of its endpoint."""

    def __init__(
        self,
        name: TopicName,
        receive: Callable[[bytes, int], None],
        counters: SyntheticCounters,
        publishers: "list[_Publisher]",
    ) -> None:
        self.name = name
        self._receive: Callable[[bytes, int], None] | None = receive
        self._counters = counters
        self._publishers = publishers
        publishers.append(self)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        if self._receive is None:
            self._counters.late += 1
        else:
            self._receive(body, stamp_ns)

    def close(self) -> None:
        if self._receive is not None:
            self._receive = None
            self._publishers.remove(self)


class SyntheticEndpoint:
    """An `Endpoint` that needs nothing outside this process."""

    def __init__(self, options: SyntheticOptions, *, clock: Clock | None = None) -> None:
        """ConfigError for an unknown topic, a negative rate, or cloud files that cannot be read."""
        self.options = options
        self.counters = SyntheticCounters()
        self._clock = clock or SystemClock()
        self._encoding = Encoding(options.encoding)
        random = Random(options.seed)
        self._robot: JackalSource | None = None
        self._source: JackalSource | OperatorSource
        if options.role == "robot":
            sizes = Sizes(options.cloud_bytes, options.map_bytes, options.image_bytes)
            self._source = self._robot = JackalSource(
                random,
                self._encoding,
                sizes,
                patrol=options.patrol,
                cloud_files=options.cloud_files,
                follow=options.follow,
                localisation_noise_m=options.localisation_noise_m,
                plant=options.plant,
            )
        else:
            self._source = OperatorSource(random, self._encoding)
        self._topics = {topic.info.name: topic for topic in self._plan_topics()}
        self._received: dict[TopicName, Received] = {}
        self._publishers: list[_Publisher] = []
        self._task: asyncio.Task[None] | None = None
        self._start_s = 0.0
        self._start_ns = 0
        self._commanded_s: float | None = None
        self._advanced_s = 0.0

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        self._start_s, self._start_ns = self._clock.monotonic_s(), self._clock.wall_ns()
        for topic in self._topics.values():
            events.topic_added(topic.info)
        self._task = asyncio.create_task(self._run(), name=f"synthetic {self.options.role}")
        self._task.add_done_callback(say_failure)

    async def stop(self) -> None:
        await end_tasks([] if self._task is None else [self._task])
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()

    def subscribe(self, name: TopicName, sink: Sink) -> _Subscription:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: this {self.options.role} announced no such topic")
        subscription = _Subscription(sink, topic, topic.subscriptions)
        topic.subscriptions.append(subscription)
        if topic.plan.latched:
            asyncio.get_running_loop().call_soon(self._give_latched, subscription)
        return subscription

    def advertise(self, info: TopicInfo) -> _Publisher:
        """The robot's command topics take Twist and TwistStamped in either encoding; anything else is counted."""
        commands = self._robot is not None and info.name in self.options.commands
        if commands and (info.type_name not in _COMMAND_TYPES or info.encoding is Encoding.RAW):
            raise ConfigError(
                f"{info.name}: the simulated robot drives by geometry_msgs/msg/Twist or TwistStamped, "
                f"not {info.type_name}"
            )
        received = self._received.setdefault(info.name, Received(info))
        received.info = info

        def receive(body: bytes, stamp_ns: int) -> None:
            received.count += 1
            received.size_bytes += len(body)
            received.body, received.stamp_ns = body, stamp_ns
            received.arrivals_s.append(self._clock.monotonic_s())
            if commands:
                self._obey(info, body)

        return _Publisher(info.name, receive, self.counters, self._publishers)

    def validate(self, held: Held) -> list[Difference]:
        return held.differences(
            Held(
                Counter(publisher.name for publisher in self._publishers),
                Counter(name for name, topic in self._topics.items() for _ in topic.subscriptions),
            )
        )

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Makes no difference here."""

    @property
    def encoding(self) -> None:
        """Reads commands in either encoding."""
        return None

    @property
    def exhausted(self) -> bool:
        """Never: the simulation goes on."""
        return False

    # What a test or a demo looks at

    def state(self) -> RobotState:
        """The robot's true state, as of the last simulated step. UsageError for an operator."""
        if self._robot is None:
            raise UsageError("an operator has no robot state")
        return self._robot.robot.state

    @property
    def json_routes(self) -> Mapping[str, Callable[[], object]]:
        """The place where a robot truly is, where it thinks it is, and when (`now_s`, this machine's clock)."""
        robot = self._robot
        if robot is None:
            return {}

        def truth() -> object:
            self._advance(self._clock.monotonic_s() - self._start_s)
            state = robot.robot.state
            return {
                "pose": list(_numbers(state.pose)),
                "thinks": list(_numbers(robot.thinks())),
                "speed_mps": state.speed_mps,
                "yaw_rate_radps": state.yaw_rate_radps,
                "now_s": clock.now() - (self._clock.monotonic_s() - self._start_s - state.time_s),
            }

        return {"/api/robot": truth}

    def received(self, name: str) -> Received | None:
        """Counts, rate and last body of an advertised topic; None when it was never advertised."""
        return self._received.get(TopicName(name))

    def latest(self, name: str) -> Any:
        """The last message of an advertised topic, decoded; None before the first. ConfigError if it cannot be."""
        received = self._received.get(TopicName(name))
        if received is None or received.count == 0:
            return None
        info = received.info
        if info.definition and ros_types.describe(info.type_name, info.encoding) is None:
            ros_types.register(info.type_name, info.definition, info.encoding)
        return ros_types.deserialise(received.body, info.type_name, info.encoding)

    # Topics

    def _plan_topics(self) -> list[_Topic]:
        options = self.options
        if min(options.pose_rate_hz, options.cloud_rate_hz, options.map_rate_hz, options.load_factor) < 0:
            raise ConfigError("rates and load_factor must not be negative")
        if options.role == "robot":
            topics = [self._topic(self._rated(plan)) for plan in _chosen(options.topics)]
            if options.follow:
                topics += [self._topic(PLAN), self._topic(self._rated(TRUTH))]
        else:
            twist = "geometry_msgs/msg/TwistStamped" if options.command_stamped else "geometry_msgs/msg/Twist"
            goal = Plan(options.goal_topic, "geometry_msgs/msg/PoseStamped", options.goal_rate_hz, reliable=True)
            topics = [
                self._topic(Plan(options.command_topic, twist, options.command_rate_hz, reliable=False)),
                self._topic(goal, hold=True),
            ]
        for name in options.counter_topics:
            plan = Plan(name, "std_msgs/msg/String", COUNTER_RATE_HZ, reliable=True)
            topics.append(self._topic(plan, hold=True, counter=True))
        return topics

    def _rated(self, plan: Plan) -> Plan:
        options = self.options
        rate_hz = {"/points": options.cloud_rate_hz, "/map": options.map_rate_hz}.get(plan.name, plan.rate_hz)
        if plan.pose:
            rate_hz = options.pose_rate_hz
        if plan.bulk:
            rate_hz *= options.load_factor
        return replace(plan, rate_hz=rate_hz)

    def _topic(self, plan: Plan, *, hold: bool = False, counter: bool = False) -> _Topic:
        # A ROS 1 publisher does not say whether it is reliable; numbered topics and goals say it all the same.
        reliable = plan.reliable if hold or self._encoding is Encoding.CDR else None
        info = ros_types.topic_info(
            plan.name, plan.type_name, self._encoding, latched=plan.latched, reliable=reliable
        )  # fmt: skip
        return _Topic(plan, info, counter, hold)

    # Running

    async def _run(self) -> None:
        topics = list(self._topics.values())
        # The last entry is the robot's own step, so that it moves at its pace even when nobody looks.
        periods = [1.0 / topic.plan.rate_hz if topic.plan.rate_hz > 0 else 0.0 for topic in topics] + [STEP_S]
        due = [(0.0, i) for i, period_s in enumerate(periods) if period_s > 0]
        heapq.heapify(due)
        yielded_s = self._clock.monotonic_s()
        while True:
            due_s, i = heapq.heappop(due)
            now_s = self._clock.monotonic_s() - self._start_s
            if due_s > now_s or now_s + self._start_s - yielded_s > RUN_S:
                await self._clock.sleep(max(due_s - now_s, 0.0))
                yielded_s = self._clock.monotonic_s()
                now_s = yielded_s - self._start_s
            if now_s - due_s > LATE_S:
                due_s = now_s
            self._advance(due_s)
            if i < len(topics):
                self._publish(topics[i], due_s)
            heapq.heappush(due, (due_s + periods[i], i))

    def _advance(self, to_s: float) -> None:
        timeout_s, replanned = self.options.command_timeout_s, False
        if timeout_s is not None and self._commanded_s is not None and to_s - self._commanded_s > timeout_s:
            self._commanded_s = None
            replanned = self._robot is not None and self._robot.release()
        self._source.advance(to_s)
        self._advanced_s = to_s
        if replanned:
            self._publish(self._topics[TopicName(PLAN.name)], to_s)

    def _publish(self, topic: _Topic, at_s: float) -> None:
        if not topic.subscriptions or not self._ready(topic):
            return
        body = self._body(topic, at_s)
        stamp_ns = self._clock.wall_ns()
        for subscription in list(topic.subscriptions):
            self._offer(subscription, body, stamp_ns)

    def _ready(self, topic: _Topic) -> bool:
        return self._robot is None or self._robot.ready(topic.plan)

    def _body(self, topic: _Topic, at_s: float) -> bytes:
        if topic.counter:
            topic.number += 1
            name = topic.plan.type_name
            text = ros_types.new(name, self._encoding, data=f"{topic.info.name} {topic.number}")
            return ros_types.serialise(text, name, self._encoding)
        return self._source.body(topic.plan, self._start_ns + round(at_s * 1e9))

    def _give_latched(self, subscription: _Subscription) -> None:
        """A late joiner of a latched topic gets it at once."""
        if not subscription.closed and self._ready(subscription.topic):
            body = self._body(subscription.topic, self._advanced_s)
            self._offer(subscription, body, self._clock.wall_ns())

    def _offer(self, subscription: _Subscription, body: bytes, stamp_ns: int) -> None:
        topic = subscription.topic
        if not subscription.held and self._hand_over(subscription, body, stamp_ns):
            return
        if not (topic.hold or topic.plan.latched) or len(subscription.held) >= HOLD_MESSAGES:
            self.counters.dropped += 1
            return
        if not topic.hold:
            subscription.held.clear()  # of latched state only the last matters
        subscription.held.append((body, stamp_ns))
        if len(subscription.held) == 1:
            asyncio.get_running_loop().call_later(RETRY_S, self._retry, subscription)

    def _retry(self, subscription: _Subscription) -> None:
        held = subscription.held
        while held and self._hand_over(subscription, *held[0]):
            held.popleft()
        if held and not subscription.closed:
            asyncio.get_running_loop().call_later(RETRY_S, self._retry, subscription)

    def _hand_over(self, subscription: _Subscription, body: bytes, stamp_ns: int) -> bool:
        accepted = subscription.sink(body, stamp_ns)
        if accepted:
            self.counters.accepted += 1
        else:
            self.counters.refused += 1
        return accepted

    def _obey(self, info: TopicInfo, body: bytes) -> None:
        assert self._robot is not None
        try:
            message = ros_types.deserialise(body, info.type_name, info.encoding)
            twist = message.twist if info.type_name.endswith("TwistStamped") else message
            self._robot.drive(float(twist.linear.x), float(twist.angular.z))
        except (ConfigError, ValueError) as error:
            self.counters.bad_commands += 1
            if self.counters.bad_commands == 1:
                _LOG.warning("%s: command ignored: %s", info.name, error)
            return
        self._commanded_s = self._clock.monotonic_s() - self._start_s


def _numbers(pose: Pose2) -> tuple[float, float, float]:
    return pose.x_m, pose.y_m, pose.yaw_rad


def _chosen(topics: int | tuple[str, ...]) -> list[Plan]:
    if isinstance(topics, int):
        if not 0 <= topics <= len(JACKAL):
            raise ConfigError(f"topics must be 0 to {len(JACKAL)}, or names")
        return list(JACKAL[:topics])
    known = {plan.name: plan for plan in JACKAL}
    if unknown := [name for name in topics if name not in known]:
        raise ConfigError(f"the simulated robot has no topic {unknown[0]}; it has {', '.join(known)}")
    return [known[name] for name in topics]
