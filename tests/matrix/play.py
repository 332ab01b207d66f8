"""Play one cell, and list every promise that it broke.

The robot is behind the cell's link; the site, beside the relay, sees what it sends and commands it. A latecomer
subscribes in the middle of the load, another one, behind a link like the robot's, after all has drained. All clocks
differ.
"""

from collections.abc import Callable
from itertools import pairwise

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_UDP
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.scheduler import CREDIT_QUANTA, DEFAULT_QUANTUM_BYTES, Scheduler
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASS_LABELS, ClientName, PriorityClass
from sern_sim.events import SimulationTimeoutError
from sern_sim.models import LinkModel
from tests.matrix.cells import SETTLE_S, Cell, Lanes, path_of
from tests.world import Clock, ClockedPort, SimClient, World, spec

POSE, LOG, EVENT, MAP, GRID, COSTMAP, CLOUD = (
    f"/robot/{name}" for name in ("pose", "log", "event", "map", "grid", "costmap", "points")
)
COMMAND = "/site/cmd"
CLOCKS = {"relay": Clock(5e3, 50.0), "robot": Clock(-9e4, 100.0), "site": Clock(1e6, -100.0)}
DRIFT = 2.1e-4
"""A second of one of these clocks is within this of a second of another."""
POSE_HZ = 20.0
COMMAND_HZ = 10.0
STATE_HZ = 10.0
HEAVY_HZ = 5.0
"""Costmaps and clouds: as large as the link carries in a fifth of a second, and so many more as the load says."""
DRAIN_S = 240.0
"""Virtual seconds; what is reliable and waits is little, but a stream that loses packets may carry 100 kbit/s."""
STEP_S = 0.5


class Audited(Scheduler):
    """Counts what a class was given while a more urgent one waited: that must be its floor. Class 0 waits of its own
    accord while its token bucket is empty."""

    def __init__(self, *, now: float) -> None:
        super().__init__(SchedulerParams(), now=now)
        self.total_bytes = 0
        self.ahead_bytes = [0] * len(CLASS_LABELS)
        self.largest_bytes = 0

    def charge(self, priority: PriorityClass, nbytes: int, *, now: float, background: bool = False) -> None:
        self.total_bytes += nbytes
        self.largest_bytes = max(self.largest_bytes, nbytes)
        waits = bool(self.pending(PriorityClass.CONTROL)) and self.class0_tokens_bytes(now=now) >= 0.0
        waits |= priority is PriorityClass.BULK and bool(self.pending(PriorityClass.STATE))
        if waits and priority is not PriorityClass.CONTROL:
            self.ahead_bytes[priority] += nbytes
        super().charge(priority, nbytes, now=now, background=background)

    def broken(self, name: str) -> list[str]:
        """A floor is a share of all that is sent, saved up at most to the credit's limit, and one fragment over."""
        limit = self.params.floor * self.total_bytes + CREDIT_QUANTA * DEFAULT_QUANTUM_BYTES + self.largest_bytes
        return [
            f"{name}: class {label} got {ahead} bytes ahead of more urgent ones, its floor is {limit:.0f}"
            for label, ahead in zip(CLASS_LABELS, self.ahead_bytes, strict=True)
            if ahead > limit
        ]


class Play:
    """One run of one cell. `broken` says what did not hold."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.path = path_of(cell)
        self.broken: list[str] = []
        self.world = World(cell.seed, relay_clock=CLOCKS["relay"]).watch(STEP_S)
        up, down = self.path.up.as_stream(), self.path.down.as_stream()
        self.robot = self.world.client("robot", up, down, clock=CLOCKS["robot"], patterns=["/site/.*"])
        self.site = self.world.client("site", clock=CLOCKS["site"], patterns=["/robot/.*"])
        self.far = self.world.relay.hub.clients.link(ClientName("robot"), self.world.relay.now)
        self.audits = [("robot", _audit(self.robot.core.link, self.robot.now))]
        self.audits.append(("relay", _audit(self.far, self.world.relay.now)))
        if cell.lanes is Lanes.BOTH:
            self._join_datagrams()
        small = min(1.0, self.path.lowest_bps / 1e6)
        self.map_bytes = int(8000 * small)
        self.heavy_bytes = int(min(self.path.highest_bps, 5e6) / 8 / HEAVY_HZ)
        self.command_lifespan_s = round(max(0.3, 0.15 + 2 * self.path.rtt_s), 2)
        self.channels = {
            POSE: self._publish(POSE, spec(PriorityClass.CONTROL)),
            LOG: self._publish(LOG, spec(reliable=True)),
            EVENT: self._publish(EVENT, spec(reliable=True, lifespan_s=1.0 + self.path.rtt_s)),
            MAP: self._publish(MAP, spec(reliable=True, latched=True, depth=3)),
            GRID: self._publish(GRID, spec(latched=True)),
            COSTMAP: self._publish(COSTMAP, spec(lifespan_s=3.0)),
            CLOUD: self._publish(CLOUD, spec(PriorityClass.BULK, lifespan_s=3.0)),
        }
        self.command = self.site.publish(COMMAND, spec(PriorityClass.CONTROL, lifespan_s=self.command_lifespan_s))
        self.latecomers: list[SimClient] = []

    def _publish(self, topic: str, topic_spec: TopicSpec) -> OutChannel:
        return self.robot.publish(topic, topic_spec)

    def _join_datagrams(self) -> None:
        world, core = self.world, self.robot.core
        near = ClockedPort(LanePort(core.link, LANE_UDP), CLOCKS["robot"])
        beyond = ClockedPort(LanePort(self.far, LANE_UDP), CLOCKS["relay"])
        self.robot.more_ports.append(near)
        world.relay.more_ports.append(beyond)
        world.network.join(near, self.robot, beyond, world.relay, self.path.up, self.path.down, name="udp")
        world.network.at(SETTLE_S - 2.0, self._open_lane)

    def _open_lane(self, _now: float) -> None:
        self.far.open_lane(now=self.world.relay.now)
        self.robot.core.link.open_lane(now=self.robot.now)

    # --- the run ----------------------------------------------------------------------------------------------------

    def play(self) -> "Play":
        world, path = self.world, self.path
        world.run(SETTLE_S - world.network.elapsed_s)
        if not self._reached(self._everything_is_open, 30.0, "all streams are open after the calm"):
            return self
        stops = self._load()
        world.network.after(1.0, lambda _now: self._latecomer("early", LinkModel().as_stream()))
        world.run(max(0.0, path.faults_end_s - world.network.elapsed_s))
        ended_s = world.now
        if not self._reached(lambda: self._fresh(ended_s), self._recovery_s, "a fresh pose after the last fault"):
            return self
        world.run(max(1.0, path.load_end_s - world.network.elapsed_s))
        for stop in stops:
            stop()
        world.run(1.0)
        if not self._drains():
            return self
        if self.cell.lanes is Lanes.BOTH:
            link = self.robot.core.link
            self._reached(lambda: link.lane.id == LANE_UDP, 10.0, "data is back on the datagram lane")
        self._latecomer("late", path.up.as_stream())
        late = self.latecomers[-1]
        newest = {topic: self.channels[topic].next_seq - 1 for topic in (MAP, GRID)}
        self._reached(
            lambda: all(late.seqs(topic)[-1:] == [seq] for topic, seq in newest.items()),
            60.0,
            "a late joiner has the latched state",
        )
        world.validate()
        self._check()
        return self

    def _reached(self, condition: Callable[[], object], within_s: float, what: str) -> bool:
        try:
            self.world.until(condition, within_s=within_s, what=what)
        except SimulationTimeoutError as error:
            self.broken.append(str(error))
            return False
        return True

    def _everything_is_open(self) -> bool:
        return len(self.site.opened) == len(self.channels) and len(self.robot.opened) == 1

    def _load(self) -> list[Callable[[], None]]:
        robot = self.robot
        every = [
            robot.every(1 / POSE_HZ, self.channels[POSE], _numbered(100)),
            robot.every(1 / STATE_HZ, self.channels[LOG], _numbered(60), first_s=0.011),
            robot.every(1 / STATE_HZ, self.channels[EVENT], _numbered(60), first_s=0.023),
            robot.every(1.0, self.channels[MAP], _numbered(self.map_bytes), first_s=0.037),
            robot.every(0.5, self.channels[GRID], _numbered(self.map_bytes // 4), first_s=0.041),
            self.site.every(1 / COMMAND_HZ, self.command, _numbered(80), first_s=0.007),
        ]
        for topic, factor in ((COSTMAP, self.cell.load.costmaps), (CLOUD, self.cell.load.clouds)):
            heavy = bytes(self.heavy_bytes if factor else 1000)
            every.append(robot.every(1 / (HEAVY_HZ * factor or 1.0), self.channels[topic], heavy, first_s=0.053))
        return every

    def _latecomer(self, name: str, model: LinkModel) -> None:
        self.latecomers.append(self.world.client(name, model, patterns=[MAP, GRID]))

    @property
    def _recovery_s(self) -> float:
        """Generous: some round trips, what the bottleneck's queue holds, and a stream that connects again and loses
        what it sends first."""
        path = self.path
        queue_s = path.up.queue_packets * 1500 * 8 / path.lowest_bps
        bound_s = 1.5 + 8 * path.rtt_s + 2 * queue_s
        return bound_s + (10 * (path.rtt_s + path.up.stall_s) if path.lossy else 0.0)

    def _fresh(self, since_s: float) -> bool:
        newest = next((got for got in reversed(self.site.got) if got.topic == POSE), None)
        return newest is not None and self.robot.sent[POSE, newest.seq][0] >= since_s

    def _drains(self) -> bool:
        network = self.world.network
        end_s = network.elapsed_s + DRAIN_S
        while network.elapsed_s < end_s:
            if self.world.quiet():
                return True
            self.world.run(STEP_S)
        waiting = [
            f"{link.end.name}>{link.peer} {channel.stream.id.topic}: {len(channel.retained) or len(channel.queue)}"
            for link in self.world.links()
            for channel in link.sender.channels.values()
            if channel.retained or channel.queue or channel.flying
        ]
        self.broken.append(f"not drained {DRAIN_S:g} s after the load: {waiting}")
        return False

    # --- the promises -----------------------------------------------------------------------------------------------

    def _check(self) -> None:
        for topic, channel in self.channels.items():
            self._check_deliveries(self.robot, self.site, channel, self.channels[topic].spec)
        self._check_deliveries(self.site, self.robot, self.command, self.command.spec)
        for topic in (LOG, EVENT, MAP):
            self._check_reliable(self.channels[topic], complete=topic != EVENT)
        for name, audit in self.audits:
            self.broken += audit.broken(name)
        for client, topics in ((self.robot, (COMMAND,)), (self.site, tuple(self.channels))):
            if silent := {topic for topic in topics if not client.on(topic)} - self.cell.impossible.keys():
                self.broken.append(f"nothing arrived at all of {sorted(silent)}")
        for late in self.latecomers:
            for topic, depth in ((MAP, 3), (GRID, 1)):
                last = self.channels[topic].next_seq - 1
                wanted = list(range(max(1, last - depth + 1), last + 1))
                if late.seqs(topic)[-depth:] != wanted:
                    self.broken.append(f"{late.name} has {late.seqs(topic)[-5:]} of {topic}, not {wanted}")
        for name in ("robot", "site"):
            if self.world.clients[name].rejections or self.world.clients[name].refused:
                self.broken.append(f"{name}: rejected or refused")

    def _check_deliveries(self, origin: SimClient, target: SimClient, channel: OutChannel, topic: TopicSpec) -> None:
        """Once, in order, whole, within its lifespan on the true clock; and the receiver knows how old it is."""
        name = channel.stream.id.topic
        turns = [seq for seq in target.turns[channel.stream.id] if seq > 0]
        if any(a >= b for a, b in pairwise(turns)):
            self.broken.append(f"{name}: twice or out of order: {[p for p in pairwise(turns) if p[0] >= p[1]][:3]}")
        altered = late = misjudged = 0
        for got in target.on(name):
            sent_s, body = origin.sent[name, got.seq]
            age_s = got.at_s - sent_s
            altered += got.body != body
            late += topic.lifespan_s is not None and age_s > topic.lifespan_s + DRIFT * age_s
            misjudged += abs(age_s - got.age_s) > got.error_s + DRIFT * age_s
        if altered or late or misjudged:
            self.broken.append(f"{name}: {altered} altered, {late} late, {misjudged} of another age than told")

    def _check_reliable(self, channel: OutChannel, *, complete: bool) -> None:
        """All that was accepted was delivered, or reported at both ends."""
        name = channel.stream.id.topic
        accepted = {seq for topic, seq in self.robot.sent if topic == name}
        delivered, expired = set(self.site.seqs(name)), set(self.site.expired_seqs[name])
        dropped = {drop.seq for drop in self.robot.dropped_out if drop.topic == name}
        if unknown := accepted - delivered - expired - dropped:
            self.broken.append(f"{name}: neither delivered nor reported: {sorted(unknown)[:9]}")
        if complete and accepted != delivered:
            self.broken.append(f"{name}: without a lifespan, but not delivered: {sorted(accepted - delivered)[:9]}")
        missing, skipped = len(accepted - delivered - expired), self.site.skipped_count[name]
        if missing != skipped:
            self.broken.append(f"{name}: {missing} missing, but the site was told of {skipped}")
        if untold := expired - dropped - delivered:
            self.broken.append(f"{name}: the sender was not told of {sorted(untold)[:9]}")


def _audit(link: Link, now: float) -> Audited:
    link.sender.scheduler = audited = Audited(now=now)
    return audited


def _numbered(size: int) -> Callable[[int], bytes]:
    return lambda seq: (b"%06d" % seq).ljust(size, b".")
