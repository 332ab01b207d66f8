"""The priority lane: class control on connections of its own, beside the stream that carries the rest."""

import pytest

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_PRIORITY, LANE_ZMQ
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire import framing
from sern_sim.hop import Hop
from sern_sim.models import LinkModel, Window
from tests.world import World, spec

RATE_BPS = 2e6
ROBOT = ClientName("robot")


def stream(*blackouts: Window) -> LinkModel:
    return LinkModel(rate_bps=RATE_BPS, delay_s=0.025, blackouts=blackouts).as_stream()


def uses_priority_lane(link: Link) -> bool:
    return link.lanes.priority_lane is not None


class PriorityScene:
    """A robot with a second connection to the relay, and a site beside the relay."""

    def __init__(self, *, second: LinkModel, main: LinkModel | None = None, join_at_s: float = 1.0) -> None:
        self.world = World()
        self.robot = self.world.client("robot", main or stream())
        self.site = self.world.client("site", patterns=["/robot/.*"])
        near = LanePort(self.core.link, LANE_PRIORITY)
        far = LanePort(self.world.relay.hub.clients.link(ROBOT, self.world.now), LANE_PRIORITY)
        self.robot.more_ports.append(near)
        self.world.relay.more_ports.append(far)
        self.hop: Hop = self.world.network.join(
            near, self.robot, far, self.world.relay, second, second, name="priority"
        )
        self.pose = self.robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
        self.command = self.robot.publish("/robot/command", spec(PriorityClass.CONTROL, reliable=True))
        self.cloud = self.robot.publish("/robot/points", spec(PriorityClass.BULK))
        self.commands = 0
        every = self.world.network.every
        every(0.02, lambda now: self.core.send(self.pose, b"p" * 100, 0, now=now), node=self.robot)
        every(0.1, lambda now: self.core.send(self.cloud, b"c" * 50_000, 0, now=now), node=self.robot)
        every(0.1, self._command, node=self.robot)
        self.world.network.at(join_at_s, lambda _now: self.join())

    @property
    def core(self) -> ClientCore:
        return self.robot.core

    @property
    def far(self) -> Link:
        return self.world.relay.hub.links[ROBOT]

    def used(self) -> bool:
        """Whether the robot's class control goes there."""
        return uses_priority_lane(self.core.link)

    def _command(self, now: float) -> None:
        self.commands += 1
        assert self.core.send(self.command, b"%d" % self.commands, 0, now=now)

    def join(self) -> bool:
        now = self.robot.now
        said = self.core.link.handshake.join(now)
        if said is None or not self.world.relay.hub.join(ROBOT, said, now=self.world.relay.now):
            return False
        self.core.link.open_lane(now=now, lane_id=LANE_PRIORITY)
        return True

    def run(self, seconds: float) -> None:
        self.world.run(seconds)
        self.world.validate()

    def check(self, *, way_s: float = 0.1) -> None:
        """Commands once, in order and complete; poses at most once and in order."""
        bodies = [got.body for got in self.site.on("/robot/command")]
        assert bodies == [b"%d" % n for n in range(1, len(bodies) + 1)]
        assert self.commands - len(bodies) <= 2 + way_s / 0.1
        seqs = [got.seq for got in self.site.on("/robot/pose")]
        assert seqs == sorted(set(seqs))


def test_class_control_moves_there_and_the_rest_stays() -> None:
    scene = PriorityScene(second=stream())
    scene.run(0.9)
    assert not scene.used()
    scene.run(9.1)
    assert scene.core.link.lanes.priority_lane is scene.core.link.lanes.by_id[LANE_PRIORITY]
    assert scene.core.link.lane.id == LANE_ZMQ
    sent = scene.hop.forward.stats
    assert sent.delivered_bytes < 0.05 * 10 * RATE_BPS / 8  # poses, commands, acknowledgements: no cloud
    assert len(scene.site.on("/robot/pose")) > 450
    assert len(scene.site.on("/robot/points")) > 20
    scene.check()


@pytest.mark.parametrize("rtt_s", [0.005, 0.3, 1.0])
def test_it_takes_over_whatever_the_round_trip(rtt_s: float) -> None:
    path = LinkModel(rate_bps=RATE_BPS, delay_s=rtt_s / 2).as_stream()
    scene = PriorityScene(second=path, main=path, join_at_s=4.0)
    scene.run(12.0)
    assert scene.used()
    start_s = scene.world.network.start_s
    late = [got for got in scene.site.on("/robot/pose") if got.at_s - start_s > 9.0]
    assert len(late) > 120
    assert max(got.age_s for got in late) < rtt_s / 2 + 0.05
    scene.check(way_s=rtt_s / 2)


def test_it_does_not_wait_for_a_stalled_stream() -> None:
    scene = PriorityScene(second=stream(), main=stream(Window(5.0, 7.0)))
    scene.run(10.0)
    start_s = scene.world.network.start_s
    during = [got for got in scene.site.on("/robot/pose") if 5.1 < got.at_s - start_s < 6.9]
    assert len(during) > 85
    scene.check()


def test_a_connection_that_answers_nothing_is_not_used() -> None:
    scene = PriorityScene(second=stream(Window(0.0, 1000.0)))
    scene.run(5.0)
    assert not scene.used()
    assert len(scene.site.on("/robot/pose")) > 200
    scene.check()


def test_it_falls_back_when_its_connection_stalls_and_returns() -> None:
    scene = PriorityScene(second=stream(Window(5.0, 8.0)))
    scene.run(7.0)
    assert not scene.used()
    scene.run(6.0)
    assert scene.used()
    scene.check()


def test_a_lost_connection_loses_no_command() -> None:
    scene = PriorityScene(second=stream())
    scene.run(5.0)
    for link, now in ((scene.core.link, scene.robot.now), (scene.far, scene.world.relay.now)):
        link.close_lane(now=now, lane_id=LANE_PRIORITY)
    assert not scene.used()
    assert not uses_priority_lane(scene.far)
    scene.run(5.0)
    scene.check()
    assert scene.join()
    scene.run(5.0)
    assert scene.used()
    scene.check()


def test_both_lanes_of_the_path_share_one_window() -> None:
    scene = PriorityScene(second=stream())
    scene.run(5.0)
    link = scene.core.link
    zmq, fast = link.lanes.by_id[LANE_ZMQ], link.lanes.by_id[LANE_PRIORITY]
    assert fast.estimator is zmq.estimator
    assert fast.pacer is zmq.pacer
    assert zmq.under_way_bytes == fast.under_way_bytes == zmq.flight.inflight_bytes + fast.flight.inflight_bytes > 0
    window_bytes = zmq.estimator.window_bytes
    link.close_lane(now=scene.robot.now, lane_id=LANE_PRIORITY)
    assert zmq.beside is None
    assert zmq.under_way_bytes == zmq.flight.inflight_bytes
    assert zmq.estimator.window_bytes == window_bytes  # the path is the same
    scene.far.close_lane(now=scene.world.relay.now, lane_id=LANE_PRIORITY)
    scene.run(2.0)
    scene.check()


def test_a_stalled_stream_neither_fills_the_window_nor_makes_the_path_unknown() -> None:
    scene = PriorityScene(second=stream(), main=stream(Window(5.0, 7.0)))
    scene.run(6.8)
    zmq = scene.core.link.lanes.by_id[LANE_ZMQ]
    fast = scene.core.link.lanes.by_id[LANE_PRIORITY]
    assert zmq.stalled
    assert not fast.stalled
    assert zmq.flight.inflight_bytes > 0
    assert fast.under_way_bytes == fast.flight.inflight_bytes
    assert fast.window_open
    assert fast.estimator.bound_bps is not None
    scene.run(3.0)
    scene.check()


def test_copies_are_sent_only_where_they_keep_nobody_waiting() -> None:
    scene = PriorityScene(second=stream())
    scene.run(5.0)
    link = scene.core.link
    assert link.plane.may_copy(200)  # poses and commands are within their share
    flood = scene.robot.publish("/robot/flood", spec(PriorityClass.CONTROL))
    scene.run(1.0)
    answers: list[bool] = []
    every = scene.world.network.every
    every(0.001, lambda now: scene.core.send(flood, b"f" * 1000, 0, now=now), node=scene.robot)
    every(0.001, lambda _now: answers.append(link.lanes.priority_lane is not None and link.lanes.priority_lane.spare))
    scene.run(3.0)
    assert sum(answers[1000:]) < 0.7 * len(answers[1000:])
    before_bytes = link.sender.scheduler.class0_tokens_bytes(now=scene.robot.now)
    if link.plane.may_copy(200):  # and then they count
        assert link.sender.scheduler.class0_tokens_bytes(now=scene.robot.now) < before_bytes
    scene.check()


def test_a_new_session_must_be_joined_anew() -> None:
    scene = PriorityScene(second=stream())
    scene.run(5.0)
    old = scene.core.link.handshake.join(scene.robot.now)
    scene.world.restart_relay()
    scene.run(5.0)
    assert LANE_PRIORITY not in scene.core.link.lanes.by_id
    hub = scene.world.relay.hub
    assert old is not None
    assert not hub.join(ROBOT, old, now=scene.world.relay.now)  # of the relay before
    scene.check()


def test_only_its_own_client_joins_a_session() -> None:
    scene = PriorityScene(second=stream())
    scene.run(5.0)
    hub, now = scene.world.relay.hub, scene.world.relay.now
    said = scene.core.link.handshake.join(scene.robot.now)
    assert said is not None
    assert not hub.join(ClientName("site"), said, now=now)  # another's key, whatever it has overheard
    assert not hub.join(ClientName("nobody"), said, now=now)
    header = framing.decode_header(said)
    envelope = framing.decode_handshake(said)
    for key in ("boot", "relay"):
        changed = framing.encode_handshake(framing.Kind.JOIN, header.tag, 0, {**envelope, key: envelope[key] ^ 1})
        assert not hub.join(ROBOT, changed, now=now)
    assert not hub.join(ROBOT, framing.encode_handshake(framing.Kind.JOIN, header.tag % 255 + 1, 0, envelope), now=now)
    with pytest.raises(WireError):
        hub.join(ROBOT, framing.encode_handshake(framing.Kind.JOIN, header.tag, 0, {"name": "robot"}), now=now)
    assert hub.join(ROBOT, said, now=now)


def test_thirteen_times_as_much_class_control_as_the_path_carries_leaves_a_way_for_what_must_be_said() -> None:
    scene = PriorityScene(second=stream())
    flood = scene.robot.publish("/robot/flood", spec(PriorityClass.CONTROL, depth=10))
    scene.robot.every(1000 * 8 / (13 * RATE_BPS), flood, b"f" * 1000, first_s=2.0)
    scene.world.until(scene.used)
    scene.run(6.0)
    assert scene.used()
    opened = len(scene.site.opened)
    scene.robot.publish("/robot/chat", spec(reliable=True), definition="string data")
    scene.world.until(lambda: len(scene.site.opened) > opened, within_s=2.0, what="the site hears of a new stream")
    assert scene.used()
    scene.world.validate()
