"""Commands over whole links in virtual time: jitter is ridden out, an outage slows the robot down, and brings no burst
back."""

import struct
from itertools import pairwise
from typing import Final, NamedTuple

import pytest

from sern_core.bodies.twist import TwistBody
from sern_core.link.link import Link
from sern_core.site.hold import Hold
from sern_core.site.lease import STEP_S, CommandLease
from sern_core.topics.rules import Ramp
from sern_core.vocabulary.message import Message, StreamInfo, TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, PriorityClass, TopicName
from sern_sim.models import Jitter, LinkModel, Window
from tests.world import World, spec

TOPIC: Final = "/robot/cmd_vel"
PERIOD_S: Final = 0.05
LIFESPAN_S: Final = 0.3
AFTER_S: Final = 0.5
TICK_S: Final = 0.005
FORWARD_MPS: Final = 1.5
RAMP: Final = Ramp(hold_s=0.125, linear_mps2=2.0, angular_radps2=4.0)


class Obeyed(NamedTuple):
    at_s: float
    forward_mps: float
    given: bool  # by the operator
    age_s: float


class HeldBack:
    """A port in front of a link: what arrives while it `holds` comes with the next that arrives."""

    def __init__(self, link: Link) -> None:
        self.holds = False
        self.most = 0
        self._held: list[bytes] = []
        self._link = link
        self.next_datagram = link.next_datagram
        self.next_deadline = link.next_deadline
        self.handle_timeout = link.handle_timeout
        self.connected = link.connected
        self.disconnected = link.disconnected

    def receive(self, data: bytes, *, now: float) -> None:
        self._held.append(data)
        self.most = max(self.most, len(self._held))
        if not self.holds:
            for each in self._held:
                self._link.receive(each, now=now)
            self._held.clear()


class Scene:
    """An operator drives at 20 Hz; at the robot the lease is kept as a site's bridge keeps it."""

    def __init__(self, down: LinkModel, *, lossless: bool) -> None:
        self.world = World(lossless=lossless).watch()
        self.operator = self.world.client("operator")
        self.robot = self.world.client("robot", None, down, patterns=[TOPIC])
        self.lease = CommandLease(AFTER_S, RAMP)
        self.obeyed: list[Obeyed] = []
        self.robot.message = self._command  # type: ignore[method-assign, assignment]
        info = TopicInfo(TopicName(TOPIC), "geometry_msgs/msg/Twist", Encoding.ROS1)
        kind = spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S)
        self.channel = self.operator.core.publish(info, kind, now=self.operator.now)
        self.body = struct.pack("<6d", FORWARD_MPS, 0, 0, 0, 0, 0.5)
        self.world.network.every(TICK_S, self._look)
        self.world.run(1.0)
        self.stop_driving = self.operator.every(PERIOD_S, self.channel, self.body)

    def _command(self, stream: StreamInfo, message: Message, *, now: float) -> DropReason | None:
        if self.lease.overtaken(born_s=message.born_s, now=now):
            return DropReason.SUPERSEDED
        read = TwistBody.read(stream.info.type_name, stream.info.encoding, message.body)
        assert read is not None
        self.lease.renew(born_s=message.born_s, now=now, command=read)
        self.obeyed.append(Obeyed(self.world.now, read.linear_mps, True, now - message.born_s))
        return None

    def _look(self, _now: float) -> None:
        now = self.robot.now
        if self.lease.due(now=now):
            slowed = self.lease.slowed(now=now)
            forward_mps = 0.0 if slowed is None else struct.unpack_from("<d", slowed)[0]
            self.obeyed.append(Obeyed(self.world.now, forward_mps, False, 0.0))

    def dropped(self, reason: DropReason) -> int:
        """Commands that were lost for a reason anywhere on their way."""
        here = self.robot.core.received.topics[TopicName(TOPIC)].by_reason[reason]
        return here + self.channel.counters.by_reason[reason]


@pytest.mark.parametrize("lossless", [True, False])
def test_jitter_of_a_tenth_of_a_second_moves_nothing(lossless: bool) -> None:
    down = LinkModel(rate_bps=1e6, delay_s=0.05, jitter_s=0.05, jitter=Jitter.UNIFORM)
    scene = Scene(down.as_stream() if lossless else down, lossless=lossless)
    scene.world.run(60.0)
    assert scene.lease.fired == 0 and len(scene.obeyed) > 1000
    assert {each.forward_mps for each in scene.obeyed} == {FORWARD_MPS}


@pytest.mark.parametrize("away_s", [0.4, 2.0, 8.0])
@pytest.mark.parametrize("lossless", [True, False])
def test_an_outage_slows_the_robot_down_and_brings_no_burst_back(lossless: bool, away_s: float) -> None:
    begins_s, ends_s = 5.0, 5.0 + away_s
    down = LinkModel(rate_bps=1e6, delay_s=0.03, blackouts=(Window(begins_s, ends_s),))
    scene = Scene(down.as_stream() if lossless else down, lossless=lossless)
    scene.world.run(15.0 + away_s)
    said = [each for each in scene.obeyed if not each.given]
    assert scene.lease.fired == 1 and said
    # It begins when the hold is over, and no earlier.
    last = max(each.at_s for each in scene.obeyed if each.given and each.at_s < said[0].at_s)
    assert PERIOD_S + RAMP.hold_s <= said[0].at_s - last <= PERIOD_S + RAMP.hold_s + 2 * TICK_S
    # Within the limits: what a step takes off is what its time allows.
    speeds = [FORWARD_MPS, *(each.forward_mps for each in said)]
    for before, after in pairwise(speeds):
        assert 0.0 <= before - after <= RAMP.linear_mps2 * (STEP_S + 2 * TICK_S)
    zeros = [each for each in said if each.forward_mps == 0.0]
    assert len(zeros) <= 1 and (away_s < 1.0 or zeros), "one zero, once it stands"
    # Whatever had waited, the robot hears the newest alone, and nothing that is too old.
    given = [each.at_s for each in scene.obeyed if each.given and each.at_s > said[0].at_s]
    assert len(given) > 100, "the operator drives again"
    assert sum(each < given[0] + PERIOD_S for each in given) <= 2
    assert max(each.age_s for each in scene.obeyed) <= LIFESPAN_S
    told = [each for each in scene.obeyed if each.at_s >= given[0]]
    assert all(each.given for each in told), "no zero after the operator is back"
    scene.stop_driving()
    scene.world.run(2.0)
    if lossless:  # what no lane keeps is lost at the relay
        assert scene.dropped(DropReason.SUPERSEDED) + scene.dropped(DropReason.LIFESPAN) > 0, (
            "counted, not lost silently"
        )
    scene.world.validate()


def test_of_commands_that_come_together_the_newest_is_obeyed_and_the_others_are_counted() -> None:
    """All that TCP held back arrives at one moment."""
    scene = Scene(LinkModel(delay_s=0.01).as_stream(), lossless=True)
    scene.world.run(2.0)
    scene.stop_driving()
    scene.world.run(3.0)
    counted = scene.robot.core.received.topics[TopicName(TOPIC)]
    before, delivered, superseded = len(scene.obeyed), counted.delivered, counted.by_reason[DropReason.SUPERSEDED]
    behind = HeldBack(scene.robot.core.link)
    scene.robot.port.inner = behind
    for forward_mps in (1.0, 2.0, 3.0, 4.0):
        behind.holds = forward_mps < 4.0
        scene.operator.send(scene.channel, struct.pack("<6d", forward_mps, 0, 0, 0, 0, 0))
        scene.world.run(0.04)
    assert behind.most >= 3
    given = [each.forward_mps for each in scene.obeyed[before:] if each.given]
    assert given == [4.0]
    assert counted.delivered == delivered + 1
    assert counted.by_reason[DropReason.SUPERSEDED] == superseded + 3
    scene.world.run(1.0)
    scene.world.validate()


def test_the_hold_of_an_operator_whose_link_is_gone_lapses_and_whoever_was_refused_asks_for_it() -> None:
    """Two operators; the robot keeps who holds it, as a site's bridge does. Anna's link is gone from 10 s on."""
    world, topic = World().watch(), TopicName(TOPIC)
    away = LinkModel(delay_s=0.05, blackouts=(Window(10.0, 1000.0),)).as_stream()
    anna, bert = world.client("anna", away), world.client("bert")
    robot = world.client("robot", patterns=[TOPIC])
    hold, obeyed, began_s = Hold(5.0), list[tuple[float, str]](), world.now
    holders: list[str | None] = []

    def command(stream: StreamInfo, _message: Message, *, now: float) -> DropReason | None:
        if not hold.command(stream.id.origin, now=now):
            return DropReason.NOT_HOLDER
        obeyed.append((world.now - began_s, stream.id.origin))
        return None

    robot.message = command  # type: ignore[method-assign, assignment]
    kind = spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S, many_writers=True)
    for operator in (anna, bert):
        channel = operator.core.publish(TopicInfo(topic, "a/b", Encoding.CDR), kind, now=operator.now)
        operator.every(PERIOD_S, channel, b"go", first_s=1.0 if operator is anna else 2.0)
    world.run(30.0)
    last = max(at_s for at_s, _who in obeyed)
    assert {who for _at_s, who in obeyed} == {"anna"} and 9.5 < last < 10.5
    holders.append(hold.holder)  # it has lapsed, and he goes on saying something
    counted = robot.core.received.topics[topic]
    assert counted.by_reason[DropReason.NOT_HOLDER] > 500 and counted.delivered == len(obeyed)
    hold.ask(bert.name, now=robot.now)
    world.run(1.0)
    holders.append(hold.holder)
    assert holders == [None, "bert"] and obeyed[-1][1] == "bert"
    world.validate()


def test_what_is_refused_while_an_e_stop_is_latched_is_counted_and_delivered_to_nobody() -> None:
    """Latched from 2 s to 4 s, as a site's bridge says of each message."""
    world, topic = World().watch(), TopicName(TOPIC)
    anna, robot = world.client("anna"), world.client("robot", patterns=[TOPIC])
    obeyed, began_s = list[float](), world.now

    def command(_stream: StreamInfo, _message: Message, *, now: float) -> DropReason | None:
        at_s = world.now - began_s
        if 2.0 <= at_s < 4.0:
            return DropReason.E_STOP
        obeyed.append(at_s)
        return None

    robot.message = command  # type: ignore[method-assign, assignment]
    kind = spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S)
    channel = anna.core.publish(TopicInfo(topic, "a/b", Encoding.CDR), kind, now=anna.now)
    anna.every(PERIOD_S, channel, b"go", first_s=1.0)
    world.run(6.0)
    counted = robot.core.received.topics[topic]
    assert counted.by_reason[DropReason.E_STOP] == pytest.approx(2.0 / PERIOD_S, abs=2)
    assert counted.delivered == len(obeyed) and not [at_s for at_s in obeyed if 2.0 <= at_s < 4.0]
    assert obeyed[0] < 2.0 and obeyed[-1] > 4.0
    world.validate()
