"""Interest is told when it changes: by difference, many streams at a time, and nothing that was undone meanwhile."""

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any

import pytest

from sern_core.link.interest import PAUSE_MAX_S, Interest
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS, decode_want
from tests.exploring import seeds
from tests.fuzz.test_hostile_peer import Hostile, subscriber_of
from tests.make_vectors import Frames
from tests.world import SimClient, World, limited, spec

ROBOT_BYTES = 2000
"""What a hundred plain subscribers may cost a robot."""


@dataclass
class ControlBytes:
    """Counts the control messages of one client's hop, in both directions, with the headers of their frames."""

    nbytes: int = 0
    kinds: dict[str, int] = field(default_factory=dict)

    def watch(self, world: World, client: SimClient) -> "ControlBytes":
        world.relay.port(client.name).sent = self.sent
        client.port.sent = self.sent
        return self

    def sent(self, data: bytes, _now: float) -> None:
        if data[2] != framing.Kind.DATA:
            return
        frames = Frames()
        framing.decode_frames(data, frames)
        for frame in frames.frames:
            if frame["type"] == "DATA" and frame["channel"] == 0:
                body = bytes.fromhex(frame["body"])
                self.nbytes += len(body) + (framing.DATA_FIRST_BYTES if frame["offset"] == 0 else 18)
                if len(body) == frame["total"]:
                    kind = framing.decode_control(body)[0]["t"]
                    self.kinds[kind] = self.kinds.get(kind, 0) + 1


def robot_with_topics(world: World) -> SimClient:
    robot = world.client("robot")
    for index in range(20):
        robot.publish(f"/robot/t{index}", spec())
    for index in range(10):
        robot.publish(f"/robot/log{index}", spec(reliable=True))
    world.run(2.0)
    return robot


@pytest.mark.parametrize(("every_s", "stays_s"), [(0.0, 1.0), (0.05, 0.04), (0.1, 1.0)])
def test_a_hundred_plain_subscribers_cost_a_robot_next_to_nothing(every_s: float, stays_s: float) -> None:
    world = World().watch(5.0)
    robot = robot_with_topics(world)
    operator = world.client("operator", patterns=[".*"])
    world.run(3.0)
    control = ControlBytes().watch(world, robot)
    for index in range(100):

        def come(_now: float, name: str = f"site{index}") -> None:
            site = world.client(name)
            world.network.after(0.01, lambda _now: site.subscribe("/robot/.*"), node=site)
            world.network.after(0.01 + stays_s, lambda _now: site.subscribe(), node=site)
            world.network.after(0.02 + stays_s, lambda now: site.core.link.close("bye", now=now), node=site)

        world.network.after(0.1 + index * every_s, come)
    world.run(100 * every_s + stays_s + 3.0)
    cores = [client.core for client in world.clients.values()]
    assert not any(core.subscription.patterns for core in cores if core.name.startswith("site"))
    assert control.nbytes < ROBOT_BYTES, control.kinds
    channels = robot.core.link.sender.channels.values()
    assert all(channel.wanted and channel.required in ((), ("operator",)) for channel in channels)
    assert len(operator.opened) == 30


def test_subscribers_that_come_and_go_alone_turn_the_streams_on_and_off_as_rarely_as_that() -> None:
    world = World()
    robot = world.client("robot")
    channels = [robot.publish(f"/robot/t{index}", spec()) for index in range(40)]
    world.run(2.0)
    control = ControlBytes().watch(world, robot)
    site = world.client("site")
    for _ in range(100):
        site.subscribe(".*")
        world.run(0.03)
        site.subscribe()
        world.run(0.03)
    assert control.nbytes < ROBOT_BYTES, control.kinds
    world.run(3.0)
    assert not any(channel.wanted for channel in channels)
    site.subscribe(".*")
    world.until(lambda: all(channel.wanted for channel in channels), within_s=1.0, what="wanted again")
    robot.send(channels[7], b"x")
    world.until(lambda: site.seqs("/robot/t7") == [1])


def test_the_feed_tells_only_what_changes() -> None:
    world = World()
    robot = world.client("robot")
    channels = [robot.publish(f"/robot/t{index}", spec()) for index in range(200)]
    world.run(2.0)
    hub = world.relay.hub
    control = ControlBytes().watch(world, robot)
    for _ in range(100):
        hub.streams.refresh_interest(now=world.relay.now)
        world.run(0.01)
    assert control.nbytes == 0
    wanted: set[str] = set()
    hub.streams.tap = lambda stream: stream.id.topic in wanted
    for index in range(100):
        wanted.add(f"/robot/t{index}")
        hub.streams.refresh_interest(now=world.relay.now)
    world.run(1.0)
    assert 0 < control.nbytes < 200
    assert [bool(channel.wanted) for channel in channels] == [True] * 100 + [False] * 100


def test_an_older_peer_is_told_each_stream_by_itself() -> None:
    world = World()
    robot = Hostile(world)
    for index in range(3):
        robot.announce(index + 1, f"/robot/t{index}", reliable=True)
    robot.control({"t": "synced"})
    told: list[dict[str, Any]] = []

    def read() -> None:
        while (data := robot.port.next_datagram(now=robot.now)) is not None:
            header, frames = framing.decode_header(data), Frames()
            if header.kind != framing.Kind.DATA:
                continue
            framing.decode_frames(data, frames)
            bodies = [bytes.fromhex(frame["body"]) for frame in frames.frames if frame["type"] == "DATA"]
            told.extend(framing.decode_control(body)[0] for body in bodies)
            now_us = int(robot.now * 1e6)
            robot.say(framing.encode_ack(0, header.number, 2**64 - 1, header.stamp_us, now_us, 10**6))

    read()
    for name in ("site1", "site2"):
        site = Hostile(world, name)
        site.now = robot.now = robot.now + 10.0
        site.control({"t": "subscribe", "patterns": [".*"], "more": False})
        read()
    wants = [envelope for envelope in told if envelope["t"] == "want"]
    assert wants[:3] == [{"t": "want", "ch": index + 1, "on": False} for index in range(3)]
    assert wants[3:6] == [{"t": "want", "ch": index + 1, "on": True, "owed": ["site1"]} for index in range(3)]
    assert wants[6:] == [{"t": "want", "ch": index + 1, "on": True, "owed": ["site1", "site2"]} for index in range(3)]


def test_a_peer_that_does_not_read_is_told_nothing_more() -> None:
    world = World()
    robot, site = Hostile(world), Hostile(world, "site")
    for index in range(20):
        robot.announce(index + 1, f"/robot/t{index}")
    for _ in range(100):
        site.now = robot.now = robot.now + 1.0
        site.control({"t": "subscribe", "patterns": [".*"], "more": False})
        robot.port.next_datagram(now=robot.now)
        site.control({"t": "subscribe", "patterns": [], "more": False})
        robot.port.next_datagram(now=robot.now)
        while (data := site.port.next_datagram(now=site.now)) is not None:
            site.say(framing.encode_ack(0, framing.decode_header(data).number, 2**64 - 1, 0, 0, 10**6))
    assert len(world.relay.hub.links[robot.name].control.out.retained) < 250


def test_what_an_answer_may_name_has_an_end() -> None:
    peer = Hostile()
    world = peer.world
    for index in range(100):
        robot = world.client("robot2") if index == 0 else world.clients["robot2"]
        robot.publish(f"/robot2/t{index}", spec())
    peer.control({"t": "subscribe", "patterns": [".*"], "more": False})
    world.run(1.0)
    envelope = {"t": "want", "ch": 1, "on": True, "chs": [2, 65_535]}
    peer.now = 1.0
    peer.control(envelope)
    link = peer.hub.links[peer.name]
    assert all(channel.wanted for channel in link.sender.channels.values()) and len(link.sender.channels) == 100

    def again_and_again() -> None:
        for _ in range(10):
            peer.now = 2.0  # as in one datagram
            peer.control(envelope)

    with pytest.raises(WireError, match="again and again"):
        again_and_again()


def test_a_relay_keeps_no_names_that_a_subscriber_says_it_owes() -> None:
    peer = subscriber_of(3)
    channels = peer.hub.links[peer.name].sender.channels.values()
    for _ in range(300):  # without end
        peer.control({"t": "want", "ch": 1, "on": True, "owed": ["x"] * 48, "more": True})
    peer.control({"t": "want", "ch": 1, "on": True, "owed": ["y"], "chs": [2, 3]})
    peer.control({"t": "want", "ch": 1, "on": True, "add": ["z"], "chs": [2, 3]})
    assert [(channel.wanted, channel.required) for channel in channels] == [(True, ())] * 3


def told_robot(topics: int, link: LinkParams | None = None) -> tuple[SimClient, Callable[[framing.Envelope], None]]:
    """A client with reliable topics, and what says a control message of the relay to it."""
    world = World(link=link)
    robot = world.client("robot")
    for index in range(topics):
        robot.publish(f"/robot/log{index}", spec(reliable=True))
    world.run(2.0)

    def tell(envelope: framing.Envelope) -> None:
        world.relay.hub.links[robot.name].control.send(envelope, now=world.now)
        world.run(2.0)

    return robot, tell


def test_channels_with_the_same_required_clients_share_one_list() -> None:
    robot, tell = told_robot(50)
    channels = list(robot.core.link.sender.channels.values())
    channel_ids = sorted(channel.channel_id for channel in channels)
    runs = [channel_ids[0] + 1, channel_ids[-1]]
    tell({"t": "want", "ch": channel_ids[0], "on": True, "chs": runs, "owed": ["site1", "site2"]})
    tell({"t": "want", "ch": channel_ids[0], "on": True, "chs": runs, "add": ["site3"], "drop": ["site1"]})
    assert {channel.required for channel in channels} == {("site2", "site3")}
    assert len({id(channel.required) for channel in channels}) == 1


def test_lists_that_are_finished_leave_room_for_others() -> None:
    robot, tell = told_robot(1, limited(required=10))
    channel = next(iter(robot.core.link.sender.channels.values()))
    for row in range(5):
        names = [f"site{row}{index}" for index in range(6)]
        tell({"t": "want", "ch": channel.channel_id, "on": True, "owed": names[:5], "more": True})
        tell({"t": "want", "ch": channel.channel_id, "on": True, "owed": names[5:]})
        assert channel.required == tuple(names)
    for channel_id in (1, 2):
        tell({"t": "want", "ch": channel_id, "on": True, "owed": ["a"] * 5, "more": True})
    with pytest.raises(WireError, match="unfinished"):
        tell({"t": "want", "ch": 3, "on": True, "owed": ["a"], "more": True})


def test_a_stream_requires_no_more_names_than_fit() -> None:
    robot, tell = told_robot(1)
    channel = next(iter(robot.core.link.sender.channels.values()))
    names = [f"site{index}" for index in range(LIMITS.required)]
    for start in range(0, len(names), MAX_STRINGS):
        tell({"t": "want", "ch": channel.channel_id, "on": True, "add": names[start : start + MAX_STRINGS]})
    assert len(channel.required) == LIMITS.required
    with pytest.raises(WireError, match="owes a stream to more than"):
        tell({"t": "want", "ch": channel.channel_id, "on": True, "add": ["one_more"]})


@pytest.mark.parametrize("bad", [[1], [3, 2], [1, 1], [5, 6, 6, 7], [2, 70_000], ["2", "3"], [True, True], 7, None])
def test_channels_of_an_answer_rise(bad: object) -> None:
    with pytest.raises(WireError):
        decode_want({"t": "want", "ch": 1, "on": True, "chs": bad})


def in_stream(index: int) -> InStream:
    identity = StreamId(ClientName("robot"), 1, TopicName(f"/t{index}"))
    stream = StreamInfo(identity, TopicInfo(identity.topic, "a/b", Encoding.CDR), spec(reliable=True))
    return InStream(stream, Reassembly(0), lambda *_: None, lambda *_: None, first=1)


@pytest.mark.parametrize("batches", [True, False])
@pytest.mark.parametrize("seed", seeds(10))
def test_whatever_changes_the_peer_ends_up_with_what_is(seed: int, batches: bool) -> None:
    random = Random(seed)
    interest = Interest()
    interest.begin()
    interest.batches = batches
    streams = {channel_id: in_stream(channel_id) for channel_id in random.sample(range(1, 400), 60)}
    names = [f"site{index}" for index in range(120)]
    now, seq, acked_seq = 0.0, 0, 0
    truth: dict[int, tuple[bool, frozenset[str]]] = {}
    peer: dict[int, tuple[bool, frozenset[str]]] = {}
    parts: dict[int, tuple[str, ...]] = {}

    def send(envelope: framing.Envelope) -> int:
        nonlocal seq
        seq += 1
        want = decode_want(framing.decode_envelope(framing.encode_envelope(envelope)))  # which refuses what is too long
        assert batches or (want.required is not None and len(want.runs) == 1)
        first = want.runs[0][0]
        if want.more:
            parts[first] = parts.get(first, ()) + (want.required or ())
            return seq
        required = None if want.required is None else frozenset(parts.pop(first, ()) + want.required)
        for low, high in want.runs:
            for channel_id in range(low, high + 1):
                had = peer.get(channel_id, (False, frozenset()))[1]
                peer[channel_id] = (want.on, (had | set(want.add)) - set(want.drop) if required is None else required)
        return seq

    for _ in range(100):
        now += random.choice([0.0, 0.01, 0.3])
        for channel_id in random.sample(sorted(streams), random.choice([1, 5, 60])):
            required = tuple(random.sample(names, random.choice([0, 1, 3, 100])))
            on = bool(required) or random.random() < 0.3
            interest.answer(channel_id, streams[channel_id], on, required, now=now)
            truth[channel_id] = (on, frozenset(required))
        if random.random() < 0.7:
            acked_seq = seq
        interest.tell(send, acked_seq=acked_seq, unacked=seq - acked_seq, now=now)
    for _ in range(3):
        now += PAUSE_MAX_S
        interest.tell(send, acked_seq=seq, unacked=0, now=now)
    assert not interest and peer == truth
    assert all(stream.wanted == truth[channel_id][0] for channel_id, stream in streams.items() if channel_id in truth)
