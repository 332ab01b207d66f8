"""The node: what its endpoint hears goes to the navigator, what the navigator says goes to the base, each cycle.

It is an ordinary node of the robot's ROS graph. A client of SERN beside it offers its topics and its action to other
sites as it offers those of any node, and brings it what the twin says. Nothing of the link is needed to drive: without
it the robot goes by its own sensors, as `on_link_loss` has it.
"""

import asyncio
import logging
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from sern_client.endpoints.base import Endpoint, Publisher, Subscription
from sern_client.endpoints.common.saying import SayOnce
from sern_client.navigation import hearing, writing
from sern_client.navigation.action import NavigateToPose
from sern_client.navigation.hearing import HeardCloud
from sern_client.navigation.localising import Localiser, inverse, placed
from sern_client.navigation.options import Localisation, NodeOptions, OnLinkLoss, Stamps
from sern_client.navigation.own_map import OwnMap
from sern_client.navigation.planning import Planner, PlannerProcess
from sern_client.navigation.twin_map import TwinMap
from sern_core.vocabulary.errors import BodyError, ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import Encoding, TopicName
from sern_navigation.collision_monitor import STOPPED, Speed
from sern_navigation.navigator import Code, Command, Goal, Navigator, State, Status
from sern_navigation.scan import Cloud, ObstacleScan, obstacle_scan
from sern_runtime import clock, ros_types
from sern_runtime.http_routes import Health
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose

TELL_S: Final = 0.5
"""How often state, feedback and local costmap are published."""
MAP_S: Final = 0.25
"""How often a scan is laid on the robot's own map at most."""
STANDS_S: Final = 0.5
"""How long the base is told to stand after a goal has ended; then others may drive it."""
_DRIVING: Final = (State.FOLLOWING, State.RECOVERING)

_log = logging.getLogger(__name__)


class Unused(StrEnum):
    """Why something that was heard counted nothing, before the navigator saw it."""

    UNREADABLE = "unreadable"
    SUPERSEDED = "superseded"
    """A cloud before the last one of a cycle."""
    OTHER_FRAME = "other_frame"
    NO_POSE = "no_pose"
    """The robot's place at a cloud is not known."""
    NO_PLACE = "no_place"
    """Odometry whose numbers are no place."""


@dataclass(frozen=True, slots=True)
class _Heard:
    info: TopicInfo
    body: bytes
    came_ns: int


class NavigationNode:
    """`run` until cancelled, then `close`. `encoding`: of what it publishes."""

    def __init__(
        self,
        options: NodeOptions,
        grid: Grid,
        endpoint: Endpoint,
        encoding: Encoding,
        *,
        planner: Callable[[Navigator], Planner] = PlannerProcess,
        now: Callable[[], float] = clock.now,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.options: Final = options
        self.grid: Final = grid
        generator = np.random.default_rng(options.seed)
        self.navigator: Final = Navigator(grid, generator, options.navigator, plans_itself=False)
        self.planner: Final = planner(self.navigator)
        self.localiser: Final = Localiser(options.start if options.localisation is Localisation.SCANS else (0, 0, 0))
        self.twin: Final = TwinMap(grid)
        self.unused: Counter[Unused] = Counter()
        self.ended: Counter[State] = Counter()
        """Goals, by how they ended."""
        self.action: NavigateToPose | None = None
        self.hears_clouds: Callable[[bytes, Encoding], None] | None = None
        """Who else looks at clouds."""
        self.cycles = 0
        self.cycles_s: list[float] = []
        """How long the last cycles took."""
        self._endpoint = endpoint
        self._now = now
        self._wall_ns = wall_ns
        self._writer = writing.Writer(encoding, grid.frame_id, options.base_frame)
        self._cdr = writing.Writer(Encoding.CDR, grid.frame_id, options.base_frame)
        self._encoding = encoding
        self._own_map: OwnMap | None = None
        if options.localisation is Localisation.SCANS:
            self._own_map = OwnMap(grid, options.mapper, encoding, options.topics.own_map, self._publish_map)
        self._subscriptions: dict[TopicName, Subscription] = {}
        self._publishers: dict[str, Publisher] = {}
        self._said = SayOnce(_log)
        self._cloud: _Heard | None = None
        self._scan: tuple[int, Pose, ObstacleScan] | None = None
        """The scan that is still to be laid on the robot's own map: stamp, place and scan."""
        self._problems: dict[str, str] = {}
        """What is wrong with what is heard, in a line for each topic."""
        self._goal: Goal | None = None
        self._pursued = False
        self._waits = False
        self._connected: bool | None = None
        self._link_s = 0.0
        self._stands_until_s = -math.inf
        self._told_s = -math.inf
        self._path_told: object = None
        self._last = Status()

    # --- topics -------------------------------------------------------------------------------------------------------

    def topic_added(self, info: TopicInfo) -> None:
        topics = self.options.topics
        wanted: list[tuple[str | None, str, Callable[[TopicInfo, bytes], None]]] = [
            (topics.cloud, hearing.CLOUD, self._hear_cloud),
            (topics.odometry, hearing.ODOMETRY, self._hear_odometry),
            (topics.map, hearing.GRID, self._hear_map),
            (topics.twin, hearing.GRID, self._hear_twin),
            (topics.twin and f"{topics.twin}_updates", hearing.UPDATE, self._hear_update),
            (topics.goal, hearing.GOAL, self._hear_goal),
            (topics.link, hearing.STATUS, self._hear_link),
        ]
        for name, type_name, hear in wanted:
            if name != info.name or info.name in self._subscriptions:
                continue
            if plain_type(info.type_name) != plain_type(type_name) or info.encoding is Encoding.RAW:
                self._said(f"{info.name} is {info.type_name} here, and {type_name} is needed: name another topic")
                continue
            self._subscriptions[info.name] = self._endpoint.subscribe(info.name, self._sink(info, hear))

    def topic_removed(self, name: TopicName) -> None:
        subscription = self._subscriptions.pop(name, None)
        if subscription is not None:
            subscription.close()

    def _sink(self, info: TopicInfo, hear: Callable[[TopicInfo, bytes], None]) -> Callable[[bytes, int], bool]:
        def sink(body: bytes, _stamp_ns: int) -> bool:
            try:
                hear(info, body)
            except (BodyError, ConfigError) as error:
                self.unused[Unused.UNREADABLE] += 1
                self._complain(info.name, f"{info.name}: {error}")
            return True

        return sink

    def _hear_cloud(self, info: TopicInfo, body: bytes) -> None:
        if self._cloud is not None:
            self.unused[Unused.SUPERSEDED] += 1
        self._cloud = _Heard(info, body, self._wall_ns())
        if self.hears_clouds is not None:
            self.hears_clouds(body, info.encoding)

    def _hear_odometry(self, info: TopicInfo, body: bytes) -> None:
        said = hearing.read_odometry(body, info.encoding)
        if self.options.stamps is Stamps.ARRIVAL:
            said = said._replace(stamp_ns=self._wall_ns())
        fixed = self.options.localisation is Localisation.ODOMETRY
        if fixed and said.frame_id != self.grid.frame_id:
            self.unused[Unused.OTHER_FRAME] += 1
            self._complain(
                info.name,
                f"{info.name} is in frame {said.frame_id!r}, the grid in {self.grid.frame_id!r}: name the odometry of "
                "a localisation, or set localisation: scans",
            )
        elif self.localiser.heard(said):
            self._problems.pop(info.name, None)
        else:
            self.unused[Unused.NO_PLACE] += 1

    def _hear_map(self, info: TopicInfo, body: bytes) -> None:
        grid, cells = hearing.read_grid(body, info.encoding)
        self.navigator.set_map(grid, cells)

    def _hear_twin(self, info: TopicInfo, body: bytes) -> None:
        grid, cells = hearing.read_grid(body, info.encoding)
        self.twin.whole(grid, cells, now_s=self._now())
        if self.twin.problem:
            self._said(f"{info.name}: {self.twin.problem}")

    def _hear_update(self, info: TopicInfo, body: bytes) -> None:
        self.twin.update(hearing.read_update(body, info.encoding), now_s=self._now())

    def _hear_goal(self, info: TopicInfo, body: bytes) -> None:
        goal = hearing.read_goal(body, info.encoding)
        if self.action is not None:
            self.action.end(State.ABORTED, Code.CANCELLED, "another goal took its place")
        _log.info("%s: goal (%.2f, %.2f) in %s", info.name, goal.x_m, goal.y_m, goal.frame_id)
        self.go(goal)

    def _hear_link(self, info: TopicInfo, body: bytes) -> None:
        self._connected = hearing.read_connected(body, info.encoding)
        self._link_s = self._now()

    # --- goals --------------------------------------------------------------------------------------------------------

    def go(self, goal: Goal) -> None:
        """Pursue a goal, in place of the one before."""
        self._goal, self._pursued, self._waits = goal, True, False
        self.navigator.go(goal)

    def cancel(self) -> None:
        """Give the goal up that is pursued."""
        self.navigator.cancel()
        if self._waits:
            self._ended(Status(State.CANCELLED, Code.CANCELLED, "the goal was cancelled"))

    @property
    def linked(self) -> bool:
        """Whether the operator can be reached, as far as the robot's client says."""
        if self._connected is None:
            return True
        return self._connected and self._now() - self._link_s <= self.options.link_timeout_s

    def _heed_link(self) -> None:
        """Do as `on_link_loss` says."""
        if not self._pursued or self.options.on_link_loss is OnLinkLoss.CONTINUE:
            return
        if not self.linked and self.options.on_link_loss is OnLinkLoss.ABORT:
            self.navigator.cancel()
            self._ended(Status(State.ABORTED, Code.CANCELLED, "the link was lost, and on_link_loss is abort"))
        elif not self.linked and not self._waits:
            _log.warning("the link was lost: the robot stands until it is back")
            self._waits = True
            self.navigator.cancel()
        elif self.linked and self._waits and self._goal is not None:
            _log.info("the link is back: the goal is pursued again")
            self.go(self._goal)

    def _ended(self, status: Status) -> None:
        self._pursued = self._waits = False
        self._last = status
        self.ended[status.state] += 1
        self._stands_until_s = self._now() + STANDS_S
        if self.action is not None:
            self.action.end(status.state, status.code, status.message)

    # --- in time ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Cycles at the controller's frequency, from when plans can be made."""
        await self.planner.warm()
        period_s = 1.0 / self.options.navigator.controller.controller_frequency
        due_s = self._now()
        while True:
            begin_s = self._now()
            self.cycle()
            self.cycles_s.append(self._now() - begin_s)
            del self.cycles_s[:-1000]
            due_s = max(due_s + period_s, self._now() - period_s)  # what was missed is not made up for
            await asyncio.sleep(max(0.0, due_s - self._now()))

    @property
    def own_map_scans(self) -> int:
        """How many scans the robot's own map was made of."""
        return 0 if self._own_map is None else sum(self._own_map.mapper.counts.values())

    @property
    def makes_map(self) -> bool:
        """Whether `keep_map` has anything to do."""
        return self._own_map is not None

    async def keep_map(self) -> None:
        """Lay scans on the robot's own map, in a thread; what it says of the robot's place holds at once."""
        if self._own_map is None:
            raise UsageError("the node makes no map of its own: localisation is by odometry")
        while True:
            await asyncio.sleep(MAP_S)
            if self._scan is not None:
                (stamp_ns, pose, scan), self._scan = self._scan, None
                mapped = await asyncio.to_thread(self._own_map.add, pose, scan)
                if mapped.match is not None:
                    self.localiser.fits(mapped.pose, stamp_ns)
            self._own_map.tell(self._now(), self._wall_ns())

    def cycle(self) -> None:
        """One of them: see, decide, drive, tell."""
        self.cycles += 1
        now, wall_ns = self._now(), self._wall_ns()
        self._heed_link()
        pose = self.localiser.at(wall_ns)
        seen = self._seen(pose, wall_ns, now)
        command = self.navigator.step(now, pose, seen, self.twin.view())
        self.planner.look()
        if self._pursued and not self._waits and command.status.state not in _DRIVING:
            self._ended(command.status)
        self._drive(command, now, wall_ns)
        if self.navigator.path_m is not self._path_told:
            self._path_told = self.navigator.path_m
            if len(self.navigator.path_m):
                path = self._writer.path(self.navigator.path_m, stamp_ns=wall_ns)
                self._say(self.options.topics.plan, writing.PATH, path, wall_ns, latched=True)
        if now - self._told_s >= TELL_S:
            self._told_s = now
            self._tell(command, pose, now, wall_ns)

    def _seen(self, pose: Pose | None, wall_ns: int, now: float) -> Cloud | ObstacleScan | None:
        """The last cloud since the last cycle, as the robot has it around itself now."""
        heard, self._cloud = self._cloud, None
        if heard is None:
            return None
        try:
            cloud = hearing.read_points(heard.body, heard.info.encoding, self.options.lidar)
        except BodyError as error:
            self.unused[Unused.UNREADABLE] += 1
            self._complain(heard.info.name, f"{heard.info.name}: {error}")
            return None
        expected = self.options.lidar.frame_id
        if expected is not None and cloud.frame_id != expected:
            self.unused[Unused.OTHER_FRAME] += 1
            said = f"{heard.info.name} is in frame {cloud.frame_id!r}, and lidar.frame_id is {expected!r}"
            self._complain(heard.info.name, said)
            return None
        stamp_ns = cloud.stamp_ns if self.options.stamps is Stamps.HEADER else heard.came_ns
        return self._placed(cloud, pose, stamp_ns, wall_ns, now)

    def _placed(
        self, cloud: HeardCloud, pose: Pose | None, stamp_ns: int, wall_ns: int, now: float
    ) -> Cloud | ObstacleScan | None:
        then, here = self.localiser.odometry_at(stamp_ns), self.localiser.odometry_at(wall_ns)
        if pose is not None and (then is None or here is None):
            self.unused[Unused.NO_POSE] += 1
            return None
        points = cloud.points_m
        if then is not None and here is not None:
            x_m, y_m, yaw_rad = placed(inverse(here), then)
            cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
            points = points @ np.array([(cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)]) + (x_m, y_m, 0.0)
        last = self.localiser.last
        tilt = (last.roll_rad, last.pitch_rad) if last is not None else (0.0, 0.0)
        stamp_s = now - (wall_ns - stamp_ns) / 1e9
        base = self.options.navigator.scan.frame_id
        moved = Cloud(points, stamp_s, base, *(angle if math.isfinite(angle) else 0.0 for angle in tilt))
        found = obstacle_scan(moved, self.options.navigator.scan)
        if not isinstance(found, ObstacleScan):
            return moved  # the navigator counts why, and says so
        self._problems.pop(self.options.topics.cloud, None)
        self._say(self.options.topics.scan, writing.SCAN, self._writer.scan(found, stamp_ns=wall_ns), wall_ns)
        if self._own_map is not None and pose is not None:
            self._scan = wall_ns, pose, found
        return found

    def _drive(self, command: Command, now: float, wall_ns: int) -> None:
        """Tell the base, while a goal is pursued and for a moment after."""
        if self._pursued:
            self._stands_until_s = now + STANDS_S
        elif now > self._stands_until_s:
            return
        speed = command.speed if self._pursued and not self._waits else STOPPED
        self._command(speed, wall_ns)
        if len(command.trajectory):
            path = self._writer.path(command.trajectory, stamp_ns=wall_ns)
            self._say(self.options.topics.trajectory, writing.PATH, path, wall_ns)

    def _command(self, speed: Speed, wall_ns: int) -> None:
        options = self.options
        told = (speed[0], speed[1] / options.yaw_scale)
        body = self._writer.twist(told, stamp_ns=wall_ns, stamped=options.stamped)
        type_name = writing.TWIST_STAMPED if options.stamped else writing.TWIST
        self._say(options.topics.command, type_name, body, wall_ns)

    # --- what is told of it -------------------------------------------------------------------------------------------

    def _tell(self, command: Command, pose: Pose | None, now: float, wall_ns: int) -> None:
        topics = self.options.topics
        level, text = self.words()
        values = {
            key: "" if value is None else str(value)
            for key, value in self.to_json().items()
            if not isinstance(value, dict)
        }
        body = self._writer.status(level, text, values, stamp_ns=wall_ns)
        self._say(topics.status, writing.DIAGNOSTICS, body, wall_ns)
        if pose is None:
            return
        local = self.navigator.costmap.local(now, pose[0], pose[1], self.options.navigator.local_radius_m)
        if local is not None:
            self._say(topics.costmap, writing.GRID, self._writer.costmap(local, stamp_ns=wall_ns), wall_ns)
        last = self.localiser.last
        if self._own_map is not None and last is not None:
            body = self._writer.transform(self.localiser.frame, last.frame_id, stamp_ns=wall_ns)
            self._say("/tf", writing.TRANSFORMS, body, wall_ns)
        if self.action is not None and self._pursued:
            away_m = command.status.distance_remaining_m
            away_m = away_m if math.isfinite(away_m) else 0.0
            self.action.tell(
                self._cdr.stamped_pose(pose, stamp_ns=wall_ns),
                recoveries=command.status.recoveries,
                distance_m=away_m,
                eta_s=away_m / max(0.05, abs(command.speed[0])),
            )

    @property
    def status(self) -> Status:
        """The status of the goal that is pursued, or of the last one."""
        if self._waits:
            return Status(State.FOLLOWING, Code.NONE, "the link is lost: the robot stands until it is back")
        return self.navigator.status if self._pursued else self._last

    def words(self) -> tuple[int, str]:
        """Level of diagnostic_msgs and a line for people."""
        status = self.status
        level = 2 if status.state is State.ABORTED else 1 if status.code is not Code.NONE or self._waits else 0
        said = ": ".join(filter(None, (status.state.value, status.message)))
        problem = self.problem
        return (max(level, 1), f"{said}; {problem}") if problem else (level, said)

    @property
    def problem(self) -> str:
        """What is wrong with what is heard, in a line; empty: nothing."""
        return "; ".join(filter(None, (*self._problems.values(), self.twin.problem)))

    def _complain(self, topic: str, line: str) -> None:
        """Note a problem of a topic, until something of it is right."""
        self._problems[topic] = line
        self._said(line, topic)

    def to_json(self) -> dict[str, object]:
        """What `/api/navigation` says."""
        status, now = self.status, self._now()
        pose, goal = self.localiser.at(self._wall_ns()), self._goal
        return {
            "state": status.state.value,
            "code": status.code.value,
            "message": status.message,
            "behaviour": "" if status.behaviour is None else status.behaviour.value,
            "recoveries": status.recoveries,
            "distance_remaining_m": status.distance_remaining_m if math.isfinite(status.distance_remaining_m) else None,
            "goal": None if goal is None else [goal.x_m, goal.y_m, goal.yaw_rad],
            "pose": None if pose is None else list(pose),
            "linked": self.linked,
            "twin_age_s": None if self.twin.stamp_s is None else now - self.twin.stamp_s,
            "cycle_p99_ms": 1e3 * self.cycle_p99_s if self.cycles_s else None,
            "problem": self.problem,
            "unused": self.counts(),
            "twin": dict(self.twin.outcomes),
            "monitor": {action.value: count for action, count in self.navigator.monitor.counts.items()},
        }

    @property
    def cycle_p99_s(self) -> float:
        """How long the slowest in a hundred of the last 1,000 cycles took; NaN before the first."""
        took_s = sorted(self.cycles_s)
        return took_s[int(0.99 * (len(took_s) - 1))] if took_s else math.nan

    def readiness(self) -> Health:
        """Whether a goal would be driven to."""
        if not self.cycles:
            return Health(ok=False, reason="starting")
        if self.localiser.at(self._wall_ns()) is None:
            return Health(ok=False, reason=self.problem or f"no odometry on {self.options.topics.odometry}")
        if not self.navigator.sees(self._now()):
            return Health(ok=False, reason=self.problem or f"no fresh clouds on {self.options.topics.cloud}")
        return Health(ok=True, reason=self.words()[1])

    def counts(self) -> dict[str, int]:
        """What was heard and counted nothing, by reason."""
        found = {reason.value: count for reason, count in self.unused.items()}
        found |= {f"step_{reason.value}": count for reason, count in self.navigator.unused.items() if count}
        return found | {f"cloud_{reason}": count for reason, count in self.navigator.scan_refusals.items()}

    def say(self, name: str, type_name: str, body: bytes, stamp_ns: int) -> None:
        """Publish a message of whoever works beside the node."""
        self._say(name, type_name, body, stamp_ns)

    def _publish_map(self, name: str, type_name: str, body: bytes, stamp_ns: int) -> None:
        self._say(name, type_name, body, stamp_ns, latched=type_name == hearing.GRID)

    def _say(self, name: str, type_name: str, body: bytes, stamp_ns: int, *, latched: bool = False) -> None:
        publisher = self._publishers.get(name)
        if publisher is None:
            info = ros_types.topic_info(name, type_name, self._encoding, latched=latched, reliable=latched or None)
            try:
                publisher = self._publishers[name] = self._endpoint.advertise(info)
            except ConfigError as error:
                self._said(str(error), name)
                return
        publisher.publish(body, stamp_ns)

    async def close(self) -> None:
        """The robot is told to stand, and whoever waits for a result that the goal has ended."""
        if self._pursued:
            self._command(STOPPED, self._wall_ns())
            self._ended(Status(State.ABORTED, Code.CANCELLED, "the navigation stops"))
        if self.action is not None:
            self.action.close()
        for subscription in self._subscriptions.values():
            subscription.close()
        for publisher in self._publishers.values():
            publisher.close()
        await self.planner.close()
