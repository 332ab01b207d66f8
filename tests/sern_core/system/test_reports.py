"""Reports of dropped reliable messages: every one is heard, few are said, and who hears none has no more kept."""

import pytest

from sern_core.link.streams_out import SEVERAL
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, PriorityClass, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, encode_announcement
from sern_sim.models import LinkModel
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.sern_core.link.test_interest import ControlBytes
from tests.world import OPEN_ACCESS, World, limited, spec

CAPPED = AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",), max_rate_hz=10.0)])


def said(peer: Hostile, *, acknowledge: bool = True) -> list[dict[str, object]]:
    """The control messages that wait for the peer, which it reads."""
    found: list[dict[str, object]] = []

    class Sink:
        def on_data(self, *args: object) -> None:
            assert isinstance(args[5], bytes)
            found.append(framing.decode_control(args[5])[0])

        def on_ack(self, *_args: object) -> None: ...

        def on_watermark(self, *_args: object) -> None: ...

        def on_ping(self) -> None: ...

    while (data := peer.port.next_datagram(now=peer.now)) is not None:
        header = framing.decode_header(data)
        if header.kind == framing.Kind.DATA:
            framing.decode_frames(data, Sink())
            if acknowledge and header.number:
                peer.say(framing.encode_ack(0, header.number, 2**64 - 1, header.stamp_us, int(peer.now * 1e6), 10**6))
    return found


@pytest.mark.parametrize("absent", [False, True], ids=["rate cap", "retention"])
def test_a_peer_that_never_reads_has_no_more_kept_for_it_in_any_session(absent: bool) -> None:
    world = World(link=limited(reports=500, kept_reports=800), access=OPEN_ACCESS if absent else CAPPED)
    peer = Hostile(world)
    site = Hostile(world, "site")
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    if absent:
        site.port.disconnected(now=0.0)
    identity = StreamId(peer.name, peer.boot, TopicName("/robot/a"))
    info = TopicInfo(identity.topic, "a/b", Encoding.CDR)
    stream = StreamInfo(identity, info, spec(reliable=True, retention_s=0.001))
    seq, cuts = 0, 0
    for _ in range(5):
        peer.control(encode_announcement(Announcement(1, stream, "", 1)))
        try:
            for _ in range(1500):
                seq += 1
                peer.say(_whole(1, seq, b"x"))
                peer.now += 0.0999 if seq % 2 else 0.0  # every second one is above the rate, so that no runs form
                peer.port.next_datagram(now=peer.now)
                if absent:
                    peer.hub.sweep(now=peer.now)
        except WireError:
            cuts += 1
            seq -= 1
        link = peer.hub.links[peer.name]
        assert sum(len(each.reports) for each in link.taking.streams.values()) <= 800
        assert len(link.control.out.retained) < 200
        peer.port.disconnected(now=peer.now)
        peer.port = world.relay.port(peer.name)
        peer.tag, peer.number, peer.control_seq = peer.tag + 1, 0, 0
        hello = {"name": peer.name, "boot": peer.boot, "vmin": 1, "vmax": 1}
        peer.port.receive(
            framing.encode_handshake(framing.Kind.HELLO, peer.tag, int(peer.now * 1e6), hello), now=peer.now
        )
    assert cuts == (0 if absent else 5)
    peer.hub.validate()


def test_a_peer_that_reads_now_and_then_is_not_cut() -> None:
    """The length of the table alone is no reason: it goes on sending for 75 s, and reads every 2.5 s."""
    peer = Hostile(World(link=limited(reports=10), access=CAPPED))
    peer.announce(1, "/robot/a", reliable=True)
    peer.control({"t": "synced", "batch": True})
    said(peer)
    unacked = peer.hub.links[peer.name].reassembly.unacked_reports
    crowded = 0
    for seq in range(1, 1501):
        peer.now += 0.0999 if seq % 2 else 0.0
        peer.say(_whole(1, seq, b"x"))
        crowded += unacked.crowded
        said(peer, acknowledge=seq % 50 == 0)
    assert crowded > 500
    peer.hub.validate()


def test_what_others_report_does_not_end_the_session_of_an_origin() -> None:
    """A subscriber gives up every second message of a robot that is away. It comes back with new messages in its first
    flight, before it can have heard of any, and both are had: every report, and all that it sends."""
    world = World(link=limited(reports=300))
    robot = world.client("robot", LinkModel(delay_s=0.025).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    other = world.client("other", patterns=["/robot/log"])
    other.core.link.taking.auto_confirm = False
    log = robot.publish("/robot/log", spec(reliable=True))
    pose = robot.publish("/robot/pose", spec())
    world.run(1.0)
    robot.every(0.05, log, b"x")
    robot.every(0.1, pose, b"p")
    world.run(70.0)
    last = log.next_seq - 1
    world.hops["robot"].break_connection(reconnect_s=20.0)
    world.run(1.0)
    (stream,) = other.core.link.taking.streams.values()
    given_up = set(range(last - 5, 0, -2))
    for seq in sorted(given_up, reverse=True):
        envelope = {"t": "dropped", "ch": stream.channel_id, "seq": seq, "code": 1, "to": "other"}
        other.core.link.control.send(envelope, now=other.now)
    world.run(15.0)
    unacked = world.relay.hub.links[robot.name].reassembly.unacked_reports
    assert unacked.reports == len(given_up) > 600
    world.until(lambda: len(robot.ups) == 2, within_s=10.0)
    first = pose.next_seq
    world.until(lambda: unacked.reports == 0, within_s=5.0)
    told = [drop for drop in robot.dropped_out if drop.topic == "/robot/log"]
    assert sorted(drop.seq for drop in told) == sorted(given_up)
    assert {drop.where for drop in told} == {"other"}
    world.run(5.0)
    assert set(range(first, pose.next_seq - 1)) <= set(site.seqs("/robot/pose"))
    assert set(range(1, log.next_seq - 1)) <= set(site.seqs("/robot/log"))
    assert len(robot.ups) == 2
    world.relay.hub.validate()


def test_what_makes_room_newest_first_is_one_run() -> None:
    reader = Hostile(World(), "reader")
    robot, urgent = Hostile(reader.world, "robot"), Hostile(reader.world, "urgent")
    robot.announce(1, "/robot/log", reliable=True, priority=PriorityClass.BULK)
    urgent.announce(1, "/urgent/state", reliable=True)
    reader.control({"t": "subscribe", "patterns": [".*"], "more": False})
    reader.port.disconnected(now=reader.now)
    hub = reader.hub
    rule = AccessRule(
        client=".*", publish=(".*",), subscribe=(".*",), max_queue_bytes=300 * (CLIENT_OVERHEAD_BYTES + 1)
    )
    hub.revoke(AccessTable([rule]), now=robot.now)
    for seq in range(1, 301):
        robot.say(_whole(1, seq))
    robot.port.disconnected(now=robot.now)
    urgent.now = robot.now
    for seq in range(1, 201):
        urgent.say(_whole(1, seq))
        urgent.now += 0.02
    (log,) = (each for each in hub.links[reader.name].sender.channels.values() if each.stream.id.topic == "/robot/log")
    assert log.kept == 100
    (stream,) = hub.links[robot.name].taking.streams.values()
    assert len(stream.reports) == 1
    report = stream.reports.first(runs=True)
    assert report is not None
    assert (report.seq, report.count, report.reason) == (101, 200, DropReason.QUEUE_FULL)
    hub.validate()


def test_what_several_will_not_get_is_reported_once_above_the_limit() -> None:
    world = World(link=limited(reports=10))
    robot = world.client("robot", LinkModel(delay_s=0.025).as_stream())
    sites = [world.client(f"site{number}", patterns=["/robot/log"]) for number in range(3)]
    for site in sites:
        site.core.link.taking.auto_confirm = False
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    for _ in range(200):
        robot.send(log, b"x")
    world.run(1.0)
    world.hops["robot"].break_connection(reconnect_s=20.0)
    world.run(1.0)
    for number, site in enumerate(sites):
        (stream,) = site.core.link.taking.streams.values()
        for seq in range(1 + number, 201, len(sites)):
            envelope = {"t": "dropped", "ch": stream.channel_id, "seq": seq, "code": 1, "to": site.name}
            site.core.link.control.send(envelope, now=site.now)
        world.run(1.0)
    unacked = world.relay.hub.links[robot.name].reassembly.unacked_reports
    assert unacked.reports < 10 + len(sites)
    world.until(lambda: bool(robot.dropped_out) and unacked.reports == 0, within_s=30.0)
    assert sorted(drop.seq for drop in robot.dropped_out) == list(range(1, 201))
    assert SEVERAL in {drop.where for drop in robot.dropped_out}


def test_every_drop_is_heard_and_runs_of_them_in_few_words() -> None:
    world = World(access=CAPPED).watch(1.0)
    thin = LinkModel(rate_bps=64e3, delay_s=0.1).as_stream()
    robot = world.client("robot", LinkModel(delay_s=0.1).as_stream(), thin)
    site = world.client("site", patterns=[".*"])
    other = world.client("other", patterns=[".*"])
    log = robot.publish("/robot/log", spec(PriorityClass.BULK, reliable=True))
    world.run(3.0)
    control = ControlBytes().watch(world, robot)
    stop = robot.every(0.002, log, b"x")
    world.run(10.0)
    stop()
    world.until(lambda: log.watermark == log.next_seq - 1, within_s=30.0)
    sent = set(range(1, log.next_seq))
    got = set(site.seqs("/robot/log"))
    assert got == set(other.seqs("/robot/log")) and 80 < len(got) < 150 and len(sent) > 4500
    assert sorted(drop.seq for drop in robot.dropped_out) == sorted(sent - got)
    assert {drop.reason for drop in robot.dropped_out} == {DropReason.RATE_CAP}
    assert control.nbytes < 40_000


def test_an_older_peer_hears_of_each_by_itself() -> None:
    peer = Hostile(World(access=CAPPED))
    peer.announce(1, "/robot/a", reliable=True)
    peer.control({"t": "synced"})
    said(peer)
    peer.say(*(_whole(1, seq) for seq in range(1, 501)))
    reports = [message for _ in range(20) for message in said(peer) if message["t"] == "dropped"]
    assert not any("n" in report for report in reports)
    assert [report["seq"] for report in reports] == list(range(11, 501))
    peer.control({"t": "synced", "batch": True})
    peer.say(*(_whole(1, seq) for seq in range(501, 1001)))
    (report,) = [message for message in said(peer) if message["t"] == "dropped"]
    assert (report["seq"], report["n"]) == (501, 500)
    peer.hub.validate()
