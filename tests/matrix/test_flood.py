"""More class control than the link carries: its age stays within a few round trips on every lane.

A topic of class control is offered at 1.3 to 13 times the rate of the link, alone and beside clouds, with a heartbeat
of the same class next to it. What the link cannot carry gives way in the sender's queue, where a newer message takes
an older one's place, and not in TCP's or the network's.
"""

from dataclasses import dataclass
from enum import StrEnum
from itertools import product

import pytest

from sern_core.link.lane_port import LanePort
from sern_core.path.lanes import LANE_PRIORITY, LANE_UDP, OVERHEAD_BYTES
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire import framing
from sern_sim.models import LinkModel
from tests.world import Got, World, spec

ROBOT = ClientName("robot")
RATE_BPS = 2e6
DELAY_S = 0.025
FEW_ROUND_TRIPS_S = 4 * 2 * DELAY_S
PATH = LinkModel(rate_bps=RATE_BPS, delay_s=DELAY_S, queue_packets=100, overhead_bytes=OVERHEAD_BYTES)
SETTLE_S = 3.0
WARM_S = 1.0
"""Until the sender knows what the link carries; ages are asked for from the beginning."""
LOAD_S = 6.0
SIZE_BYTES = 1000
CARRIES = SIZE_BYTES / (SIZE_BYTES + framing.HEADER_BYTES + framing.DATA_FIRST_BYTES + OVERHEAD_BYTES)
"""Share of the rate that is left to bodies of that size, one in a datagram."""
FLOOD, BEAT, CLOUD = "/robot/flood", "/robot/beat", "/robot/points"


class Lanes(StrEnum):
    STREAM = "stream"
    PRIORITY = "priority"
    DATAGRAM = "datagram"


@dataclass(frozen=True)
class Cell:
    lanes: Lanes
    times: float
    clouds: bool

    def __str__(self) -> str:
        return f"{self.lanes}-{self.times:g}x{'-clouds' if self.clouds else ''}"

    @property
    def in_every_run(self) -> bool:
        return self.times == (2.0 if self.clouds else 1.3) or (self.times == 13.0 and self.lanes is Lanes.PRIORITY)


CELLS = [Cell(*axes) for axes in product(Lanes, (1.3, 2.0, 4.0, 13.0), (False, True))]


class Flood:
    """One run of one cell."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        world = self.world = World()
        stream = PATH.as_stream()
        self.robot = world.client("robot", stream)
        self.site = world.client("site", patterns=["/robot/.*"])
        self.far = world.relay.hub.clients.link(ROBOT, world.relay.now)
        if cell.lanes is not Lanes.STREAM:
            self._join(LANE_PRIORITY if cell.lanes is Lanes.PRIORITY else LANE_UDP)
        self.flood = self.robot.publish(FLOOD, spec(PriorityClass.CONTROL, lifespan_s=1.0))
        self.beat = self.robot.publish(BEAT, spec(PriorityClass.CONTROL, lifespan_s=1.0))
        self.cloud = self.robot.publish(CLOUD, spec(PriorityClass.BULK, lifespan_s=5.0))

    def _join(self, lane_id: int) -> None:
        """Over the same bottleneck as the stream."""
        world, link = self.world, self.robot.core.link
        near, beyond = LanePort(link, lane_id), LanePort(self.far, lane_id)
        self.robot.more_ports.append(near)
        world.relay.more_ports.append(beyond)
        path = PATH.as_stream() if lane_id == LANE_PRIORITY else PATH
        world.network.join(near, self.robot, beyond, world.relay, path, path, name="beside", beside=world.hops["robot"])
        world.network.at(SETTLE_S / 3, lambda _now: self._open(lane_id))

    def _open(self, lane_id: int) -> None:
        link, hub = self.robot.core.link, self.world.relay.hub
        if lane_id == LANE_PRIORITY:
            said = link.handshake.join(self.robot.now)
            assert said is not None
            assert hub.join(ROBOT, said, now=self.world.relay.now)
        else:
            self.far.open_lane(now=self.world.relay.now)
        link.open_lane(now=self.robot.now, lane_id=lane_id)

    def play(self) -> "Flood":
        world, link = self.world, self.robot.core.link
        world.run(SETTLE_S)
        assert (link.lanes.priority_lane is not None) is (self.cell.lanes is Lanes.PRIORITY)
        assert (link.lane.id == LANE_UDP) is (self.cell.lanes is Lanes.DATAGRAM)
        world.watch(0.5)
        stops = [
            self.robot.every(0.1, self.beat, bytes(50)),
            self.robot.every(8 * SIZE_BYTES / (self.cell.times * RATE_BPS), self.flood, bytes(SIZE_BYTES)),
        ]
        if self.cell.clouds:
            stops.append(self.robot.every(0.1, self.cloud, bytes(int(2 * RATE_BPS / 80)), first_s=0.007))
        world.run(LOAD_S)
        for stop in stops:
            stop()
        world.run(2.0)
        world.validate()
        return self

    def age_s(self, got: Got) -> float:
        return got.at_s - self.robot.sent[got.topic, got.seq][0]

    def goodput(self) -> float:
        """Share of what the link carries, after the warm-up; a cloud may have begun before it."""
        begin_s = self.world.network.start_s + SETTLE_S + WARM_S
        end_s = begin_s + LOAD_S - WARM_S
        nbytes = sum(len(got.body) for got in self.site.got if begin_s <= got.at_s < end_s)
        return 8 * nbytes / (end_s - begin_s) / (CARRIES * RATE_BPS)

    def check(self) -> None:
        ages_s = [self.age_s(got) for topic in (FLOOD, BEAT) for got in self.site.on(topic)]
        assert max(ages_s) < FEW_ROUND_TRIPS_S
        offered = int(LOAD_S * 10)
        assert len(self.site.on(BEAT)) >= offered - 1
        assert self.goodput() > 0.9


def _params(*, every_run: bool) -> list[object]:
    return [pytest.param(cell, id=str(cell)) for cell in CELLS if cell.in_every_run is every_run]


@pytest.mark.parametrize("cell", _params(every_run=True))
def test_class_control_stays_young(cell: Cell) -> None:
    Flood(cell).play().check()


@pytest.mark.lab_long
@pytest.mark.parametrize("cell", _params(every_run=False))
def test_class_control_stays_young_in_the_other_cells(cell: Cell) -> None:
    Flood(cell).play().check()
