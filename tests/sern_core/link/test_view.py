"""The door of a link: what is seen through it is the link as it was, and what is set through it holds."""

from dataclasses import replace
from math import inf, isfinite
from typing import Any, NoReturn

import pytest

from sern_core.link.view import Held, LinkSettings
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ
from sern_core.stream.coding import preferred
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import CLASSES, ClientName, DropReason, PriorityClass
from sern_sim.models import LinkModel, Window
from tests.sern_core.link.test_lanes import TwoLanes, models
from tests.world import World, spec

CONTROL, STATE, BULK = PriorityClass


def test_a_link_in_use_is_seen_as_its_parts_are() -> None:
    two = TwoLanes(stream=models()[0], datagrams=models()[1])
    two.world.run(5.0)
    link, now = two.core.link, two.robot.now
    seen = link.observe(now=now)
    assert (seen.peer, seen.up, seen.established, seen.stalled) == (link.peer, True, True, False)
    assert (seen.lane_id, seen.lane, seen.lossless) == (LANE_UDP, "udp", False)
    assert seen.datagrams_pass and seen.stream_usable and not seen.priority_lane
    lane = link.lane
    assert (seen.rate_bps, seen.window_bytes) == (lane.estimator.rate_bps, lane.estimator.window_bytes)
    assert (seen.inflight_bytes, seen.srtt_s) == (lane.flight.inflight_bytes, lane.flight.rtt.srtt_s)
    assert seen.rate_bps is not None and seen.srtt_s > 0.05 and seen.wire_bytes > 1_000_000
    assert seen.rtprop_s == link.rtt_s == pytest.approx(0.05, rel=0.2)
    assert isfinite(seen.clock_error_s)


def test_a_silent_link_is_seen_to_wait_and_one_without_a_session_is_not_up() -> None:
    world = World()
    robot = world.client("robot", LinkModel(rate_bps=4e6, delay_s=0.025, blackouts=(Window(2.0, 12.0),)))
    before = robot.core.link.observe(now=robot.now)
    assert (before.up, before.waiting_s, before.rate_bps, before.clock_error_s) == (False, None, None, inf)
    assert before.to_json()["clock_error_s"] is None
    world.run(1.0)
    up = robot.core.link.observe(now=robot.now)
    assert up.up and up.lane_id == LANE_ZMQ
    world.run(5.0)
    silent = robot.core.link.observe(now=robot.now)
    assert silent.established and silent.stalled and not silent.up
    assert silent.waiting_s == pytest.approx(4.0, abs=0.6)
    assert up.up and not up.stalled  # what was seen stays what it was
    with pytest.raises(AttributeError):
        up.stalled = True  # type: ignore[misc]


class Untouchable(dict[Any, Any]):
    """Streams at which nobody may look."""

    def refuse(self, *_args: object) -> NoReturn:
        raise AssertionError("a stream was looked at")

    __iter__ = __getitem__ = __len__ = __contains__ = keys = values = items = get = refuse


def test_a_look_at_the_link_costs_the_same_however_many_streams_there_are() -> None:
    """Metrics look at a hundred links several times a scrape, and the adaptation at each of them ten times a second."""
    world = World()
    robot = world.client("robot")
    robot.publish("/robot/pose", spec(CONTROL))
    world.run(1.0)
    link = robot.core.link
    seen = link.observe(now=robot.now)
    channels, ledger, streams = link.sender.channels, link.sender.ledger.topics, link.taking.streams
    link.sender.channels = link.sender.ledger.topics = link.taking.streams = Untouchable()
    with pytest.raises(AssertionError):
        link.topics()
    assert link.observe(now=robot.now) == seen
    link.sender.channels, link.sender.ledger.topics, link.taking.streams = channels, ledger, streams


def test_what_waits_and_what_flies_adds_up_with_the_counters() -> None:
    world = World()
    robot = world.client("robot", LinkModel(rate_bps=200e3, delay_s=0.05))
    site = world.client("site", patterns=["/robot/.*"])
    world.run(1.0)
    log = robot.publish("/robot/log", spec(reliable=True))
    cloud = robot.publish("/robot/points", spec(BULK, depth=3))
    world.run(1.0)
    for _ in range(8):
        robot.send(log, bytes(5_000))
        robot.send(cloud, bytes(20_000))
    world.run(0.3)
    link = robot.core.link
    held = link.held()
    for channel in (log, cloud):
        counters, kept = link.counters[channel.stream.id.topic], held[channel.stream.id.topic]
        assert counters.offered == 8 == counters.delivered + counters.dropped + kept.queued + kept.in_flight
        assert kept != Held(0, 0)
        seqs = [message.seq for message in link.undelivered() if message.stream is channel.stream]
        assert len(seqs) == kept.queued + kept.in_flight
    assert link.queued() == link.sender.queued()
    (downlink,) = [at for at in world.links() if at.peer == site.name]
    assert {view.stream.id for view in downlink.topics()} == {log.stream.id, cloud.stream.id}
    arriving = world.relay.hub.links[ClientName("robot")].arriving()
    assert {stream.id for stream in arriving} == {log.stream.id, cloud.stream.id}


def test_streams_are_seen_one_by_one_and_as_they_were() -> None:
    world = World(compress=True)
    robot = world.client("robot")
    world.client("site", patterns=["/robot/points"])
    cloud = robot.publish("/robot/points", spec(BULK))
    robot.publish("/robot/pose", spec(CONTROL, reliable=True))
    world.run(1.0)
    link = robot.core.link
    first = {view.topic: view for view in link.topics()}
    assert {topic: (view.wanted, view.ready, view.thinnable) for topic, view in first.items()} == {
        "/robot/points": (True, True, True),
        "/robot/pose": (False, True, False),
    }
    seen = first[cloud.stream.id.topic]
    assert seen.spec is cloud.spec and seen.codec is not None and seen.codec.profiles == {}
    link.apply(LinkSettings(shares=(1.0, 1.0, 0.5)), now=robot.now)
    for _ in range(50):
        robot.send(cloud, b"abc" * 500)
        world.run(0.05)
    assert seen.thinned == 0 and seen.codec.profiles == {} and seen.codec.raw_bytes == 0
    later = {view.topic: view for view in link.topics()}[cloud.stream.id.topic]
    assert later.codec is not None
    assert later.thinned == link.counters[later.topic].by_reason[DropReason.RATE_CAP] == pytest.approx(25, abs=2)
    assert later.codec.raw_bytes > 0 and later.codec.profiles


def test_settings_reach_every_stream_and_lane_and_go_again() -> None:
    two = TwoLanes(stream=models()[0], datagrams=models()[1])
    two.world.run(3.0)
    link, now = two.core.link, two.robot.now
    asked = LinkSettings(shares=(0.9, 0.5, 0.25), depths=(5, 4, 1), copies=True)
    for _ in range(2):
        link.apply(asked, now=now)
        assert (two.pose.share, two.cloud.share, two.cloud.depth) == (0.9, 0.25, 1)
        assert (two.log.share, two.log.depth) == (1.0, two.log.spec.depth)  # reliable: nothing of it is left out
        assert link.lane.redundant
    link.apply(LinkSettings(), now=now)
    for channel in (two.pose, two.cloud, two.log):
        assert (channel.share, channel.depth) == (1.0, channel.spec.depth)
    assert not link.lane.redundant
    assert len(asked.shares) == len(asked.depths) == len(CLASSES)


def test_each_topic_takes_the_first_mode_that_it_allows_unless_its_rule_names_one() -> None:
    """A rule for several types may name a lossy mode that is for one of them alone."""
    world = World(compress=True)
    robot = world.client("robot")
    world.run(0.5)
    draco, cloud_type = (Compression.VOXEL_DRACO,), "sensor_msgs/msg/PointCloud2"
    lossy = robot.publish("/robot/points", replace(spec(BULK), lossy=draco), type_name=cloud_type)
    plain = robot.publish("/robot/grid", spec(BULK))
    ruled = robot.publish("/robot/raw", spec(BULK, compression=Compression.NONE))
    other = robot.publish("/robot/scan", replace(spec(BULK, compression=draco[0]), lossy=draco))
    assert other.codec is not None and other.codec.setting is None

    def settings() -> list[Compression | None]:
        return [channel.codec.setting for channel in (lossy, plain, ruled, other) if channel.codec is not None]

    link = robot.core.link
    link.apply(LinkSettings(codecs=(*draco, Compression.ZSTD)), now=robot.now)
    assert settings() == [Compression.VOXEL_DRACO, Compression.ZSTD, Compression.NONE, None]
    link.apply(LinkSettings(), now=robot.now)
    assert settings() == [Compression.VOXEL_DRACO, Compression.ZSTD, Compression.NONE, None]  # nothing said of them
    link.apply(LinkSettings(codecs=(Compression.NONE,)), now=robot.now)
    assert settings() == [Compression.NONE, Compression.NONE, Compression.NONE, None]


def test_no_mode_that_is_allowed_means_none() -> None:
    assert preferred((Compression.JPEG, Compression.LZ4), (Compression.LZ4,)) is Compression.LZ4
    assert preferred((Compression.JPEG,), (Compression.LZ4,)) is Compression.NONE
    assert preferred((), (Compression.LZ4,)) is Compression.NONE


def test_whoever_watches_is_told_of_each_message_that_arrived_whole() -> None:
    world = World()
    robot = world.client("robot")
    world.client("site", patterns=[".*"])
    pose = robot.publish("/robot/pose", spec(CONTROL))
    world.run(1.0)
    told: list[tuple[TopicSpec, int]] = []

    def arrived(of: TopicSpec, message: Message, now: float) -> None:
        assert message.born_s <= now
        told.append((of, message.seq))

    robot.core.link.watch_arrivals(arrived)
    for _ in range(3):
        robot.send(pose, b"p")
        world.run(0.2)
    robot.core.link.watch_arrivals(None)
    robot.send(pose, b"p")
    world.run(0.5)
    assert told == [(pose.spec, seq) for seq in (1, 2, 3)]
