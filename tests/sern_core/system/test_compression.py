"""Compression through the core in virtual time: order, loss, restarts, changes of mode, and bodies that are none."""

from collections.abc import Callable
from itertools import count
from random import Random

import pytest

from sern_core.bodies import codecs
from sern_core.bodies.codecs import SIZE
from sern_core.stream.coding import Coding
from sern_core.stream.encoding import PROBE_EVERY
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.codec_names import Codec, Compression
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

THIN = LinkModel(rate_bps=1e6, delay_s=0.02).as_stream()
LOSSY = LinkModel(rate_bps=2e6, delay_s=0.02, loss=0.05)
SLOW = 2e6
"""Bytes a second of a codec that takes its time: 100 kB in 50 ms."""


def pair(world: World, robot: LinkModel | None = None, site: LinkModel | None = None) -> tuple[SimClient, SimClient]:
    return world.client("robot", robot), world.client("site", site, patterns=["/robot/.*"])


def text(seq: int, size: int) -> bytes:
    """About a quarter of it is noise."""
    noise = Random(seq).randbytes(max(1, size // 4))
    return (b"%09d" % seq + noise + b"the hall is empty " * (size // 18 + 1))[:size]


def check(site: SimClient, robot: SimClient, topic: str) -> None:
    """What arrived is what was sent, in order."""
    got = site.on(topic)
    seqs = [each.seq for each in got]
    assert seqs == sorted(set(seqs))
    assert all(each.body == robot.sent[topic, each.seq][1] for each in got)


def test_auto_compresses_where_the_link_is_slower_than_the_codec() -> None:
    fast = LinkModel(rate_bps=25e6, delay_s=0.005).as_stream()
    for model, packed in ((THIN, True), (fast, False)):
        world = World(compress=True).watch()
        robot, site = pair(world, robot=model)
        robot.core.coder.clock = (0.02 * i for i in count()).__next__  # encodes 1 MB/s
        filler = robot.publish("/robot/filler", spec(PriorityClass.BULK, compression=Compression.NONE))
        log = robot.publish("/robot/log", spec(reliable=True))
        world.run(2.0)
        robot.every(0.05, log, lambda seq: text(seq, 20_000))
        if not packed:
            robot.every(0.01, filler, bytes(35_000))  # keeps the link busy, so that its rate is known
        world.run(12.0 if packed else 5.0)
        check(site, robot, "/robot/log")
        assert log.codec is not None
        assert (log.codec.mode is not Compression.NONE) is packed
        latest = [message for message in world.relay.fed if message.stream.topic == "/robot/log"][-40:]
        assert {bool(message.codec) for message in latest} == {packed}
        if packed:  # 3.2 Mbit/s of text over 1 Mbit/s
            assert log.codec.ratio < 0.4
            assert len(site.got) >= 228, "compression made room for all of it"


@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("speed", [None, SLOW])
def test_reliable_streams_stay_whole_through_changes_of_mode(*, lossless: bool, speed: float | None) -> None:
    world = World(3, lossless=lossless, compress=True, encode_bytes_per_s=speed).watch()
    robot, site = pair(world, robot=THIN if lossless else LOSSY, site=None if lossless else LOSSY)
    channels = [robot.publish(f"/robot/{name}", spec(reliable=True)) for name in ("a", "b", "c")]
    sizes = Random(5)
    for channel in channels:
        robot.every(0.2, channel, lambda seq: text(seq, sizes.choice((20, 300, 5000, 9000, 40_000))))
    settings = [None, *codecs.LOSSLESS]

    def change(_now: float) -> None:
        for index, channel in enumerate(channels):
            robot.core.set_compression(channel, settings[(channel.next_seq + index) % len(settings)], now=robot.now)

    world.network.every(0.13, change, node=robot)
    world.run(5.0)
    world.hops["robot"].break_connection(reconnect_s=2.0)
    world.run(5.0)
    world.restart_relay()
    world.run(10.0)
    sent = [channel.next_seq - 1 for channel in channels]
    world.until(lambda: all(c.watermark >= n for c, n in zip(channels, sent, strict=True)), within_s=200.0)
    for channel, total in zip(channels, sent, strict=True):
        topic = channel.stream.id.topic
        check(site, robot, topic)
        assert site.seqs(topic)[:total] == list(range(1, total + 1))
        assert not channel.counters.dropped
    assert {message.codec for message in world.relay.fed} == {Codec.NONE, Codec.LZ4, Codec.ZSTD}


def test_retained_bodies_are_encoded_once_and_outlive_restarts() -> None:
    world = World(compress=True, encode_bytes_per_s=SLOW).watch()
    robot, site = pair(world, robot=THIN)
    log = robot.publish("/robot/log", spec(reliable=True, compression=Compression.ZSTD))
    world.run(2.0)
    world.network.crash_node(site)
    for seq in range(1, 11):
        robot.send(log, text(seq, 50_000))
    world.until(lambda: all(out.coding is Coding.DONE for out in log.retained))
    assert log.retained_bytes < 10 * 50_000 * 0.4, "kept as they are sent"
    assert robot.core.coder.encoded[Compression.ZSTD].messages == 10
    world.restart_relay()
    world.run(5.0)
    world.hops["robot"].break_connection(reconnect_s=1.0)
    world.run(5.0)
    site = world.restart_client("site")
    world.until(lambda: log.watermark == 10)
    check(site, robot, "/robot/log")
    assert site.seqs("/robot/log") == list(range(1, 11))
    assert robot.core.coder.encoded[Compression.ZSTD].messages == 10
    assert log.counters.delivered_bytes == log.counters.offered_bytes == 10 * 50_000


def test_latched_bodies_are_replayed_as_they_came() -> None:
    world = World(compress=True).watch()
    robot = world.client("robot", THIN)
    grid = robot.publish("/robot/map", spec(latched=True, compression=Compression.LZ4))
    world.run(1.0)
    body = text(1, 30_000)
    robot.send(grid, body)
    world.run(2.0)
    assert [message.codec for message in world.relay.fed] == [Codec.LZ4]
    held = world.relay.hub.objects.get("/robot/map@robot")
    assert held is not None and held.value_bytes == len(body)
    site = world.client("site", patterns=["/robot/.*"])
    world.run(1.0)
    assert [(got.body, got.replay) for got in site.got] == [(body, True)]


def test_a_topic_faster_than_its_codec_still_gets_through() -> None:
    """Each new sample would take the place of the one that is being encoded, for ever."""
    world = World(compress=True, encode_bytes_per_s=SLOW).watch()
    robot, site = pair(world, robot=THIN)
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK, compression=Compression.LZ4))
    world.run(1.0)
    robot.every(0.02, cloud, lambda seq: text(seq, 100_000))  # encoded in 50 ms each
    world.run(12.0)
    check(site, robot, "/robot/points")
    assert len(site.got) >= 24  # about 30 kB each over 125 kB/s
    assert cloud.counters.by_reason[DropReason.SUPERSEDED] > 60


def test_others_go_while_a_body_is_encoded() -> None:
    world = World(compress=True, encode_bytes_per_s=100_000.0).watch()
    robot, site = pair(world)
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK, compression=Compression.LZ4))
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    other = robot.publish("/robot/image", spec(PriorityClass.BULK, compression=Compression.NONE))
    world.run(1.0)
    robot.send(cloud, text(1, 100_000))  # a second of work
    world.run(0.1)
    assert cloud.active[0].coding is Coding.RUNNING
    robot.send(pose, text(1, 300))
    robot.send(other, text(1, 50_000))
    world.run(0.1)
    assert [got.topic for got in site.got] == ["/robot/pose", "/robot/image"]
    world.run(3.0)
    assert [got.topic for got in site.got] == ["/robot/pose", "/robot/image", "/robot/points"]


def test_what_expires_while_it_is_encoded_is_dropped_and_counted() -> None:
    world = World(compress=True, encode_bytes_per_s=100_000.0).watch()
    robot, site = pair(world)
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK, lifespan_s=0.5, compression=Compression.LZ4))
    log = robot.publish("/robot/log", spec(reliable=True, lifespan_s=0.5, compression=Compression.LZ4))
    world.run(1.0)
    robot.send(cloud, text(1, 100_000))
    robot.send(log, text(1, 100_000))
    world.run(3.0)
    robot.send(cloud, text(2, 10_000))
    robot.send(log, text(2, 10_000))
    world.run(3.0)
    assert site.seqs("/robot/points") == site.seqs("/robot/log") == [2]
    assert site.expired_seqs["/robot/log"] == [1]
    for channel in (cloud, log):
        assert channel.counters.by_reason[DropReason.LIFESPAN] == 1
        assert channel.counters.delivered == 1
    encoder = robot.core.link.sender.encoder
    assert encoder is not None and encoder.running == 0


def test_a_channel_that_closes_while_it_is_encoded_leaves_nothing_behind() -> None:
    world = World(compress=True, encode_bytes_per_s=100_000.0).watch()
    robot, site = pair(world)
    clouds = [
        robot.publish(f"/robot/points{i}", spec(PriorityClass.BULK, compression=Compression.LZ4)) for i in range(4)
    ]
    world.run(1.0)
    for cloud in clouds:
        robot.send(cloud, text(1, 100_000))
    world.run(0.1)
    assert sorted(cloud.active[0].coding if cloud.active else cloud.queue[0].coding for cloud in clouds) == [
        Coding.HELD, Coding.HELD, Coding.RUNNING, Coding.RUNNING,
    ]  # fmt: skip
    for cloud in clouds[1:3]:
        robot.core.unpublish(cloud, now=robot.now)
    world.run(10.0)
    assert sorted(got.topic for got in site.got) == ["/robot/points0", "/robot/points3"]
    encoder = robot.core.link.sender.encoder
    assert encoder is not None and encoder.running == 0


def test_the_order_of_a_stream_is_kept_while_it_is_decoded_and_confirmed_only_then() -> None:
    world = World(compress=True, encode_bytes_per_s=400_000.0).watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True, compression=Compression.ZSTD))
    world.run(1.0)
    for seq in range(1, 9):
        robot.send(log, text(seq, 100_000 if seq % 2 else 300))
    world.until(lambda: len(site.got) >= 1)
    assert site.seqs("/robot/log") == [1, 2]
    assert log.watermark <= 2, "confirmed before it was decoded"
    world.network.crash_node(site)
    site = world.restart_client("site")
    world.until(lambda: log.watermark == 8)
    check(site, robot, "/robot/log")
    assert site.seqs("/robot/log")[-1] == 8 and site.seqs("/robot/log")[0] <= 3


def test_profiles_are_measured_for_every_mode() -> None:
    world = World(compress=True).watch()
    robot, _site = pair(world, robot=THIN)
    log = robot.publish("/robot/log", spec(compression=Compression.NONE))
    assert robot.core.codec_profiles(log) == {}
    world.run(1.0)
    robot.every(0.05, log, lambda seq: text(seq, 2000))
    world.run(1.0)
    profiles = robot.core.codec_profiles(log)
    assert set(profiles) == set(codecs.LOSSLESS[1:])
    assert all(0.2 < profile.ratio < 0.4 for profile in profiles.values())
    assert log.codec is not None and log.codec.messages_to_probe == PROBE_EVERY - log.counters.offered


# --- bodies that are none ---------------------------------------------------------------------------------------------


def forge(robot: SimClient, channel: OutChannel, codec: int, body: bytes) -> None:
    """Send a body as no honest client would."""
    message = Message(channel.stream.id, channel.next_seq, body, 0, robot.now, codec=codec)
    robot.core.link.sender.submit(channel, message, now=robot.now)


def bomb() -> bytes:
    zeros = bytes(64 << 20)
    return SIZE.pack(len(zeros)) + codecs.encode(Compression.ZSTD, zeros)[1][SIZE.size :]


BODIES: dict[str, Callable[[], tuple[int, bytes]]] = {
    "bomb": lambda: (Codec.ZSTD, bomb()),
    "noise": lambda: (Codec.LZ4, Random(1).randbytes(5000)),
    "short": lambda: (Codec.LZ4, b"\0"),
    "large noise": lambda: (Codec.ZSTD, SIZE.pack(100_000) + Random(1).randbytes(50_000)),
    "no such decoder": lambda: (Codec.DRACO, SIZE.pack(100) + bytes(50)),
}


@pytest.mark.parametrize("speed", [None, SLOW])
@pytest.mark.parametrize("name", BODIES)
def test_a_body_that_does_not_decode_is_dropped_counted_and_told_once(name: str, speed: float | None) -> None:
    world = World(compress=True, encode_bytes_per_s=speed).watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    pose = robot.publish("/robot/pose", spec())
    world.run(1.0)
    for channel in (log, pose):
        robot.send(channel, b"before")
        for _ in range(3):
            world.run(0.5)
            forge(robot, channel, *BODIES[name]())
        world.run(0.5)
        robot.send(channel, b"after")
    world.run(2.0)
    for topic in ("/robot/log", "/robot/pose"):
        assert [got.body for got in site.on(topic)] == [b"before", b"after"]
        assert site.core.received.topics[log.stream.id.topic].by_reason[DropReason.UNDECODABLE] == 3
    assert site.expired_seqs["/robot/log"] == [2, 3, 4]
    assert [(drop.topic, drop.seq, drop.reason) for drop in robot.dropped_out] == [
        ("/robot/log", seq, DropReason.UNDECODABLE) for seq in (2, 3, 4)
    ]
    assert [topic for topic, _ in site.undecodables] == ["/robot/log", "/robot/pose"]
    assert site.downs == [] and robot.downs == [], "nobody's session ended"
    assert log.watermark == 5
