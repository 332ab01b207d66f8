"""Two lanes under one session: which carries data, what a lost lane costs, and how a session outlives its stream."""

from dataclasses import replace

import pytest

from sern_core.link.lane_port import LanePort
from sern_core.path.lanes import COPY_PACKETS, DATAGRAM_BYTES, LANE_UDP, LANE_ZMQ, Lane
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.params import LinkParams, Redundancy
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire import framing
from sern_sim.hop import Hop
from sern_sim.models import LinkModel, RateStep, Window
from tests.world import SimClient, World, spec

RATE_BPS = 2e6


def models(*blackouts: Window, loss: float = 0.0) -> tuple[LinkModel, LinkModel]:
    """The same path as a stream and as datagrams."""
    path = LinkModel(rate_bps=RATE_BPS, delay_s=0.025, blackouts=blackouts, loss=loss)
    return path.as_stream(), path


class TwoLanes:
    """A robot that reaches the relay over both lanes, and a site beside the relay."""

    def __init__(
        self,
        *,
        stream: LinkModel,
        datagrams: LinkModel,
        open_at_s: float = 1.0,
        link: LinkParams | None = None,
        cloud_bytes: int = 50_000,
    ) -> None:
        self.world = World(link=link)
        self.robot = self.world.client("robot", stream)
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.hop = self._join(self.robot, datagrams)
        self.pose = self.robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
        self.log = self.robot.publish("/robot/log", spec(reliable=True))
        self.cloud = self.robot.publish("/robot/points", spec(PriorityClass.BULK))
        self.logged = 0
        every = self.world.network.every
        every(0.02, lambda now: self.core.send(self.pose, b"p" * 100, 0, now=now), node=self.robot)
        every(0.1, lambda now: self.core.send(self.cloud, b"c" * cloud_bytes, 0, now=now), node=self.robot)
        every(0.1, self._log, node=self.robot)
        self.world.network.at(open_at_s, self._open)

    @property
    def core(self) -> ClientCore:
        return self.robot.core

    def _log(self, now: float) -> None:
        self.logged += 1
        assert self.core.send(self.log, b"%d" % self.logged, 0, now=now)

    def _join(self, robot: SimClient, datagrams: LinkModel) -> Hop:
        hub = self.world.relay.hub
        near = LanePort(robot.core.link, LANE_UDP)
        far = LanePort(hub.clients.link(ClientName("robot"), self.world.now), LANE_UDP)
        robot.more_ports.append(near)
        self.world.relay.more_ports.append(far)
        return self.world.network.join(near, robot, far, self.world.relay, datagrams, datagrams, name="udp")

    def _open(self, now: float) -> None:
        self.world.relay.hub.links[ClientName("robot")].open_lane(now=now)
        self.core.link.open_lane(now=now)

    def run(self, seconds: float) -> None:
        self.world.run(seconds)
        self.world.validate()

    def check_log(self) -> None:
        """Reliable, whatever the lanes did: once, in order, complete up to what is still under way."""
        bodies = [got.body for got in self.site.on("/robot/log")]
        assert bodies == [b"%d" % n for n in range(1, len(bodies) + 1)]
        assert self.logged - len(bodies) <= 3

    def first_pose_after(self, time_s: float) -> float:
        start_s = self.world.network.start_s
        return min(g.at_s - start_s for g in self.site.on("/robot/pose") if g.at_s - start_s > time_s) - time_s


def test_data_moves_to_the_datagram_lane_once_it_answers() -> None:
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    lanes.run(1.1)  # it is opened after a second
    assert lanes.core.link.lane.id == LANE_ZMQ
    lanes.run(0.3)
    assert lanes.core.link.lane.id == LANE_UDP
    lanes.run(8.6)
    assert lanes.core.link.lane.id == LANE_UDP
    assert lanes.hop.forward.stats.goodput_bps > 0.8 * RATE_BPS * 0.85
    lanes.check_log()


class ShortPath(TwoLanes):
    """A path so short and so full that the stream is the cheaper; `slower` is its rate from 8 s on."""

    def __init__(self, *, stream_loss: float = 0.0, slower_bps: float | None = None) -> None:
        steps = () if slower_bps is None else (RateStep(8.0, slower_bps),)
        path = LinkModel(rate_bps=8e6, delay_s=0.002, rate_steps=steps)
        super().__init__(
            stream=replace(path, loss=stream_loss).as_stream(),
            datagrams=path,
            link=LinkParams(stream_from_bps=3e6),
            cloud_bytes=100_000,
        )
        self.used: list[int] = []
        self.sizes: list[int] = []
        self.robot.port.sent = lambda data, _now: self.sizes.append(len(data))
        self.world.network.every(0.01, self._look)

    def _look(self, _now: float) -> None:
        lane = self.core.link.lane.id
        if not self.used or self.used[-1] != lane:
            self.used.append(lane)
            self.sizes.clear()

    def check(self) -> None:
        """Nothing was lost or repeated at a change: poses and log are complete, no cloud came twice."""
        self.check_log()
        poses = [got.seq for got in self.site.on("/robot/pose")]
        assert poses == list(range(poses[0], poses[0] + len(poses)))
        clouds = [got.seq for got in self.site.on("/robot/points")]
        assert clouds == sorted(set(clouds))


def test_much_over_a_short_clean_path_takes_the_stream_in_large_pieces() -> None:
    lanes = ShortPath()
    lanes.run(12.0)
    assert lanes.used == [LANE_ZMQ, LANE_UDP, LANE_ZMQ]
    assert lanes.core.link.lanes.by_id[LANE_UDP].usable, "datagrams would get through"
    assert max(lanes.sizes) > 2 * DATAGRAM_BYTES
    lanes.check()


def test_the_stream_goes_on_from_what_datagrams_have_found() -> None:
    """Its own window is that of the session's begin."""
    lanes = ShortPath()
    windows: dict[int, float] = {}
    while lanes.used != [LANE_ZMQ, LANE_UDP, LANE_ZMQ]:
        lanes.run(0.01)
        windows[lanes.core.link.lane.id] = lanes.core.link.lane.estimator.window_bytes
    assert windows[LANE_ZMQ] >= 0.9 * windows[LANE_UDP] > 0.0
    rate_bps = lanes.core.link.lane.estimator.rate_bps
    assert rate_bps is not None and rate_bps > 0.8 * 8e6


def test_data_is_back_with_the_datagrams_when_the_path_gets_thin() -> None:
    lanes = ShortPath(slower_bps=0.5e6)
    lanes.run(7.9)
    assert lanes.used == [LANE_ZMQ, LANE_UDP, LANE_ZMQ]
    lanes.run(12.1)
    assert lanes.used == [LANE_ZMQ, LANE_UDP, LANE_ZMQ, LANE_UDP]
    lanes.check_log()


def test_a_stream_that_loses_segments_gives_the_data_back() -> None:
    lanes = ShortPath(stream_loss=0.2)
    lanes.run(10.0)
    assert lanes.used == [LANE_ZMQ, LANE_UDP, LANE_ZMQ, LANE_UDP]
    lanes.check_log()


def test_a_path_that_carries_no_datagrams_is_not_used() -> None:
    lanes = TwoLanes(stream=models()[0], datagrams=models(Window(0.0, 1000.0))[1])
    lanes.run(10.0)
    assert lanes.core.link.lane.id == LANE_ZMQ
    assert len(lanes.site.on("/robot/pose")) > 400
    lanes.check_log()


def test_it_falls_back_when_datagrams_cease_and_returns_by_itself() -> None:
    lanes = TwoLanes(stream=models()[0], datagrams=models(Window(5.0, 10.0))[1])
    lanes.run(8.0)
    assert lanes.core.link.lane.id == LANE_ZMQ
    assert lanes.first_pose_after(5.1) < 1.0
    lanes.run(7.0)
    assert lanes.core.link.lane.id == LANE_UDP
    lanes.check_log()


def test_a_session_outlives_the_stream_and_a_fresh_pose_is_there_at_once() -> None:
    stream, datagrams = models(Window(5.0, 19.0))  # the stream's connection breaks after 5 s of it
    lanes = TwoLanes(stream=stream, datagrams=datagrams)
    lanes.run(27.0)
    assert lanes.robot.ups == [False]  # one session all along
    assert lanes.first_pose_after(19.0) <= 0.3
    assert lanes.core.link.lanes.by_id[LANE_ZMQ].up
    lanes.check_log()


@pytest.mark.parametrize("end", ["robot", "relay"])
def test_packet_numbers_of_the_datagram_lane_that_run_out_begin_another_session(end: str) -> None:
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    lanes.run(3.0)
    link = lanes.core.link if end == "robot" else lanes.world.relay.hub.links[ClientName("robot")]
    link.lanes.by_id[LANE_UDP].flight.next_number = framing.MAX_PACKET_NUMBER - 5
    lanes.run(3.0)
    assert lanes.robot.ups == [False, True]
    lanes._open(lanes.world.network.now)
    lanes.run(3.0)
    assert lanes.core.link.lane.id == LANE_UDP
    lanes.check_log()


def test_a_client_that_was_killed_is_away_after_the_heartbeat() -> None:
    """Its kernel ends the connection at once, and its datagrams cease with it: that is no blackout."""
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    lanes.run(5.0)
    link = lanes.world.relay.hub.links[ClientName("robot")]
    assert link.lane.id == LANE_UDP
    lanes.world.network.crash_node(lanes.robot)
    lanes.run(4.0)
    assert link.established, "its datagrams may yet come"
    lanes.run(3.0)
    assert not link.established


@pytest.mark.parametrize("silent_s", [0.001, 1.0])
def test_a_relay_that_stood_still_while_a_client_was_killed_takes_it_for_no_blackout(silent_s: float) -> None:
    """Its timers find the lane silent, and a moment later its socket says that the stream has ended."""
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    lanes.run(5.0)
    link, now = lanes.world.relay.hub.links[ClientName("robot")], lanes.world.relay.now + 1.0
    link.handle_timeout(now=now, lane=LANE_UDP)
    assert link.next_datagram(now=now, lane=LANE_UDP), "it asks"
    now += 10.0
    link.handle_timeout(now=now, lane=LANE_UDP)
    assert link.lanes.by_id[LANE_UDP].stalled
    link.disconnected(now=now + silent_s, reason="the connection ended")
    assert link.established
    assert link.handshake.cut_off is (silent_s == 1.0)


def test_a_client_in_a_blackout_is_waited_for() -> None:
    stream, datagrams = models(Window(5.0, 50.0))
    lanes = TwoLanes(stream=stream, datagrams=datagrams)
    link = lanes.world.relay.hub.clients.link(ClientName("robot"), 0.0)
    lanes.run(20.0)
    assert not link.lanes.by_id[LANE_ZMQ].up, "the connection did not survive it"
    lanes.run(29.0)
    assert link.established
    lanes.run(6.0)
    assert lanes.robot.ups == [False], "one session all along"
    assert lanes.first_pose_after(50.0) <= 0.3


def test_a_client_that_ends_in_a_blackout_is_away_in_the_end() -> None:
    stream, datagrams = models(Window(5.0, 500.0))
    lanes = TwoLanes(stream=stream, datagrams=datagrams)
    link = lanes.world.relay.hub.clients.link(ClientName("robot"), 0.0)
    lanes.run(60.0)
    assert link.established
    lanes.run(15.0)
    assert not link.established


def test_the_lane_closes_with_its_session() -> None:
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    lanes.run(3.0)
    lanes.world.restart_relay()
    lanes.run(10.0)
    assert LANE_UDP not in lanes.core.link.lanes.by_id
    assert lanes.robot.lanes_closed == 1
    lanes.check_log()


def _poses_lost(redundancy: Redundancy) -> float:
    """Share of poses that never arrived over a datagram lane that loses 5 % in each direction, without overload."""
    world = World(link=LinkParams(redundancy=redundancy), lossless=False)
    path = LinkModel(rate_bps=RATE_BPS, delay_s=0.025, loss=0.05)
    robot = world.client("robot", path)
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    offered: list[float] = []

    def offer(now: float) -> None:
        offered.append(now)
        robot.core.send(pose, b"p" * 100, 0, now=now)

    world.network.at(2.0, lambda _now: world.network.every(0.02, offer, node=robot, first_s=2.0))
    world.run(32.0)
    world.validate()
    assert len({got.seq for got in site.on("/robot/pose")}) == len(site.on("/robot/pose"))
    return 1 - len(site.on("/robot/pose")) / len(offered)


def test_second_copies_save_poses_from_loss() -> None:
    without = _poses_lost(Redundancy.OFF)
    assert 0.02 < without < 0.08  # a fresher pose is there before a lost one could be sent again
    assert _poses_lost(Redundancy.ALWAYS) < without / 5
    assert _poses_lost(Redundancy.AUTO) < without / 3


def test_no_datagram_is_larger_than_the_lane_takes() -> None:
    """Announcements, watermarks and messages of all sizes share datagrams; none may grow by its last fragment."""
    world = World(lossless=False)
    path = LinkModel(rate_bps=RATE_BPS, delay_s=0.02)
    robot = world.client("robot", path)
    world.client("site", path, patterns=["/robot/.*"])
    sizes: list[int] = []
    for port in (robot.port, *world.relay.sides.values()):
        port.sent = lambda data, _now: sizes.append(len(data))
    for number in range(40):
        channel = robot.publish(f"/robot/{'name' * 8}{number}", spec(PriorityClass(number % 3)), definition="x" * 300)
        body = b"x" * (30 + 37 * number)

        def send(now: float, channel: OutChannel = channel, body: bytes = body) -> None:
            robot.core.send(channel, body, 0, now=now)

        world.network.every(0.02 + 0.001 * number, send, node=robot)
    world.run(4.0)
    assert DATAGRAM_BYTES - 60 < max(sizes) <= DATAGRAM_BYTES


def test_copies_go_on_through_lucky_moments_and_end_on_a_path_that_loses_nothing() -> None:
    lane = Lane(LANE_UDP, LinkParams(), lossless=False)
    seen = [lane.redundant]
    for acked, lost in ((99, 1), (COPY_PACKETS - 1, 0), (1, 0)):
        lane.resolved(acked=acked, lost=lost)
        seen.append(lane.redundant)
    assert seen == [False, True, True, False]
    assert lane.loss < 1e-6


class _Carried:
    """The channels with data in one datagram."""

    def __init__(self, datagram: bytes) -> None:
        self.channels: set[int] = set()
        framing.decode_frames(datagram, self)

    def on_data(self, _flags: int, channel_id: int, *_: object) -> None:
        self.channels.add(channel_id)

    def on_ack(self, *_: object) -> None: ...

    def on_watermark(self, *_: object) -> None: ...

    def on_ping(self) -> None: ...


def test_a_datagram_has_the_class_of_the_most_urgent_message_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Second copies too; what carries no message, or only control messages, is state."""
    seen: dict[frozenset[str], set[PriorityClass]] = {}
    channel_ids: dict[int, str] = {0: "control messages"}

    def noted(port: LanePort, *, now: float) -> bytes | None:
        datagram = port.link.next_datagram(now=now, lane=port.lane)
        if datagram is not None and port.link.end.name == "robot":
            channel_ids.update((c.channel_id, c.spec.priority.name) for c in port.link.sender.channels.values())
            carried = frozenset(channel_ids[channel_id] for channel_id in _Carried(datagram).channels)
            seen.setdefault(carried, set()).add(port.priority)
        return datagram

    monkeypatch.setattr(LanePort, "next_datagram", noted)
    lanes = TwoLanes(stream=models()[0], datagrams=models(loss=0.02)[1])
    lanes.run(5.0)
    for number in range(20):
        lanes.core.subscribe((f"/site/{number}",), now=lanes.world.now)
        lanes.run(0.1)
    assert lanes.core.link.lanes.by_id[LANE_UDP].redundant, "second copies were sent"
    for carried, priorities in seen.items():
        if "CONTROL" in carried:
            assert priorities == {PriorityClass.CONTROL}, carried
        elif carried == {"BULK"}:
            assert priorities == {PriorityClass.BULK}
        else:
            assert priorities == {PriorityClass.STATE}, carried
    assert seen.keys() >= {frozenset(), frozenset({"CONTROL"}), frozenset({"BULK"}), frozenset({"STATE"})}
    assert any("control messages" in carried for carried in seen)
