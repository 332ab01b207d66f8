"""Errors that nobody expects: whatever raises and whenever, reliable messages arrive once and in order or are reported,
and everything goes on."""

from contextlib import suppress
from functools import cache, partial
from itertools import pairwise

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sern_core.bodies.codecs import Coder
from sern_core.link.link import Link
from sern_core.link.sender import Sender
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ
from sern_core.stream.in_stream import Partial
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import CodecError, RemoteError, UsageError
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason, PriorityClass
from sern_core.wire import framing
from sern_core.wire.announce import definition_hash
from tests.exploring import cases
from tests.faults import HANDLERS, INSIDE, RECORDS, Faults, Injected, Place
from tests.fuzz.test_hostile_peer import Hostile
from tests.sern_core.link.test_lanes import TwoLanes, models
from tests.world import SimClient, World, spec

GAVE_UP = {DropReason.UNCONFIRMED, DropReason.FAULT}
"""Reasons of messages that may have been delivered all the same."""


class Story:
    """A robot and a site: load, a broken connection, a new subscriber, a topic that ends, a relay that starts anew."""

    def __init__(self, seed: int, *, lossless: bool) -> None:
        self.world = World(seed, lossless=lossless)
        self.world.expected_faults = (Injected,)
        self.robot = self.world.client("robot")
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.other = self.world.client("other", patterns=["/robot/.*"])
        self.channels: list[OutChannel] = []

    def play(self, faults: Faults) -> "Story":
        world, robot = self.world, self.robot
        self.channels = [
            robot.publish("/robot/pose", spec(PriorityClass.CONTROL, lifespan_s=1.0)),
            robot.publish("/robot/log", spec(reliable=True), "int32 x\n"),
            robot.publish("/robot/map", spec(PriorityClass.BULK, reliable=True, latched=True, depth=2), "int32 y\n"),
            robot.publish("/robot/soon", spec(reliable=True, lifespan_s=0.4)),
        ]
        sizes = (100, 100, 5_000, 100)
        world.run(1.5)
        stops = [
            world.network.every(period_s, partial(self._send, channel, size), node=robot).cancel
            for period_s, channel, size in zip((0.1, 0.2, 0.5, 0.3), self.channels, sizes, strict=True)
        ]
        world.run(2.0)
        world.hops["site"].break_connection(reconnect_s=1.0)
        gone = robot.publish("/robot/gone", spec(reliable=True))
        world.run(0.5)
        with suppress(Injected):
            robot.send(gone, b"last words")
        world.run(1.5)
        world.clients["other"].subscribe("/robot/log")
        robot.core.unpublish(gone, now=robot.now)
        world.run(1.0)
        world.restart_relay()
        world.run(3.0)
        for stop in stops:
            stop()
        world.run(4.0)
        faults.armed = False
        return self

    def _send(self, channel: OutChannel, size: int, _now: float) -> None:
        with suppress(Injected):  # an error on the way in is the caller's to handle
            self.robot.send(channel, (b"%08d" % channel.next_seq * (size // 8 + 1))[:size])

    def go_on(self) -> None:
        """What comes after all of it works."""
        world, robot, site = self.world, self.robot, self.site
        world.run(2.0)
        fresh = robot.publish("/robot/fresh", spec(reliable=True), "int32 z\n")
        world.run(2.0)
        for channel in (*self.channels, fresh):
            robot.send(channel, b"after it all")
        world.run(2.0)
        for channel in (*self.channels, fresh):
            topic = channel.stream.id.topic
            assert [got.body for got in site.on(topic)][-1:] == [b"after it all"], f"{topic} has come to a halt"
        assert [got.body for got in self.other.on("/robot/log")][-1:] == [b"after it all"]
        world.until(world.quiet, within_s=60.0, what="everything has drained")
        world.validate()

    def check(self) -> None:
        for channel in self.channels:
            for client in (self.site, self.other):
                turns = [seq for seq in client.turns[channel.stream.id] if seq > 0]
                # What raised after it was delivered has its turn again, as one that was given up.
                assert all(a <= b for a, b in pairwise(turns)), f"{client.name} {channel.stream.id.topic}: {turns}"
                seqs = client.seqs(channel.stream.id.topic)
                assert len(seqs) == len(set(seqs)), f"{client.name} {channel.stream.id.topic}: twice in {seqs}"
            if channel.reliable:
                self._check_reliable(channel, self.site)
        self._check_reliable(self.channels[1], self.other)

    def _check_reliable(self, channel: OutChannel, client: SimClient) -> None:
        topic = channel.stream.id.topic
        accepted = {seq for sent_topic, seq in self.robot.sent if sent_topic == topic}
        delivered, expired = set(client.seqs(topic)), set(client.expired_seqs[topic])
        dropped = {drop.seq: drop.reason for drop in self.robot.dropped_out if drop.topic == topic}
        missing = accepted - delivered - expired - dropped.keys()
        assert not missing, f"{client.name} {topic}: neither delivered nor reported: {sorted(missing)}"
        if channel.spec.lifespan_s is None:
            reasons = set(dropped.values())
            assert reasons <= GAVE_UP, f"{topic}: {reasons}"
            assert len(accepted - delivered) <= 2, f"{topic}: one error cost {sorted(accepted - delivered)}"


@cache
def _calls(seed: int, lossless: bool) -> dict[Place, int]:
    """How often each place is called when nothing fails."""
    with Faults()(HANDLERS + INSIDE) as faults:
        story = Story(seed, lossless=lossless).play(faults)
        story.go_on()
        story.check()
    calls = {place: count for place, count in faults.calls.items() if count}
    assert calls.keys() >= set(INSIDE), "an error at a place that is never reached tests nothing"
    return calls


@pytest.mark.interpreted
@settings(max_examples=cases(16), phases=[Phase.explicit, Phase.generate])
@given(data=st.data(), lossless=st.booleans(), after=st.booleans())
def test_an_error_at_any_call_costs_at_most_what_it_was_about(data: st.DataObject, lossless: bool, after: bool) -> None:
    calls = _calls(1, lossless)
    place = data.draw(st.sampled_from(sorted(calls, key=str)))
    number = data.draw(st.integers(1, calls[place]))
    after = place in RECORDS or (after and place in HANDLERS)
    with Faults((place, number), after=after)(HANDLERS + INSIDE) as faults:
        story = Story(1, lossless=lossless).play(faults)
    assert faults.raised == 1
    assert story.world.faults, "nobody was told"
    story.go_on()
    story.check()


class Poisoned:
    """A robot and a site whose shell raises at some bodies."""

    def __init__(self, bodies: dict[bytes, int]) -> None:
        self.world = World()
        self.world.expected_faults = (Injected,)
        self.robot = self.world.client("robot")
        self.site = self.world.client("site", patterns=[".*"])
        self.pose = self.robot.publish("/robot/pose", spec())
        self.plan = self.robot.publish("/robot/plan", spec(reliable=True))
        plain = self.site.message

        def message(stream: StreamInfo, message: Message, *, now: float) -> None:
            if bodies.get(message.body, 0) > 0:
                bodies[message.body] -= 1
                raise Injected(message.body)
            plain(stream, message, now=now)

        self.site.message = message  # type: ignore[method-assign]
        self.world.run(1.0)

    def got(self, topic: str) -> list[bytes]:
        return [got.body for got in self.site.on(topic)]


def test_a_message_that_a_site_fails_at_takes_nothing_with_it() -> None:
    """Small messages of one class share a datagram."""
    case = Poisoned({b"boom": 1000})
    case.robot.send(case.pose, b"boom")
    case.robot.send(case.plan, b"plan 1")
    case.world.run(5.0)
    case.robot.send(case.pose, b"fine")
    case.robot.send(case.plan, b"plan 2")
    case.world.run(5.0)
    assert case.got("/robot/plan") == [b"plan 1", b"plan 2"] and case.got("/robot/pose") == [b"fine"]
    assert case.site.ups == [False], "one body cost the session"
    counters = case.site.core.received.of(case.pose.stream)
    assert counters.by_reason[DropReason.FAULT] == 1 and counters.delivered == 1
    case.world.validate()


def test_a_reliable_message_that_a_site_fails_at_is_reported_and_the_stream_goes_on() -> None:
    case = Poisoned({b"plan 2": 1000})
    for number in range(1, 5):
        case.robot.send(case.plan, b"plan %d" % number)
    case.world.until(case.world.quiet, what="all is confirmed")
    assert case.got("/robot/plan") == [b"plan 1", b"plan 3", b"plan 4"]
    assert case.site.expired_seqs["/robot/plan"] == [2]
    assert [(drop.seq, drop.reason) for drop in case.robot.dropped_out] == [(2, DropReason.FAULT)]
    case.world.hops["site"].break_connection(reconnect_s=1.0)
    case.world.run(5.0)
    assert case.got("/robot/plan") == [b"plan 1", b"plan 3", b"plan 4"]
    case.world.validate()


def test_a_definition_that_a_site_fails_at_costs_its_own_stream_only() -> None:
    world = World()
    world.expected_faults = (ValueError,)
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    plain = site.stream_opened

    def stream_opened(stream: StreamInfo) -> None:
        if stream.info.definition.startswith("evil"):
            raise ValueError(stream.info.definition)
        plain(stream)

    site.stream_opened = stream_opened  # type: ignore[method-assign]
    first = robot.publish("/robot/a", spec(reliable=True), "int32 x\n")
    world.run(2.0)
    mallory = Hostile(world, "mallory")
    mallory.now = world.now
    mallory.announce(1, "/mallory/x", digest=definition_hash("evil"))
    world.run(0.5)
    mallory.now = world.now
    mallory.control({"t": "define", "dh": definition_hash("evil")}, b"evil")
    mallory.announce(2, "/mallory/y")
    world.run(2.0)
    second = robot.publish("/robot/b", spec(reliable=True), "int32 x\n")
    world.run(2.0)
    robot.send(first, b"1")
    robot.send(second, b"2")
    world.run(2.0)
    assert [got.body for got in site.got] == [b"1", b"2"]
    assert [stream.id.topic for stream in site.opened] == ["/robot/a", "/mallory/y", "/robot/b"]
    assert site.ups == [False]
    world.validate()


@pytest.mark.interpreted
@pytest.mark.parametrize("reliable", [False, True])
@pytest.mark.parametrize("offload", [False, True])
def test_a_library_that_fails_at_a_body_does_not_stop_its_stream(
    monkeypatch: pytest.MonkeyPatch, offload: bool, reliable: bool
) -> None:
    world = World(compress=True, encode_bytes_per_s=1e9)
    world.expected_faults = (Injected,)
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    if not offload:
        robot.core.coder.offload = site.core.coder.offload = None
    channel = robot.publish("/robot/log", spec(reliable=reliable, depth=9, compression=Compression.LZ4))
    world.run(1.0)
    plain = Coder.decode

    def decode(coder: Coder, codec: int, body: bytes) -> tuple[bytes, float]:
        raw, elapsed_s = plain(coder, codec, body)
        if raw.startswith(b"2"):
            if offload:
                raise CodecError("of a thread")
            raise Injected
        return raw, elapsed_s

    monkeypatch.setattr(Coder, "decode", decode)
    for number in range(1, 4):
        robot.send(channel, b"%d" % number * 50_000)
        world.run(1.0)
    world.run(5.0)
    assert site.seqs("/robot/log") == [1, 3]
    assert site.expired_seqs["/robot/log"] == ([2] if reliable else [])
    world.until(world.quiet, what="all is confirmed")
    world.validate()


@pytest.mark.interpreted
def test_a_body_that_cannot_be_encoded_goes_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(compress=True)
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    channel = robot.publish("/robot/log", spec(reliable=True, compression=Compression.LZ4))
    world.run(1.0)

    def encode(*_args: object) -> None:
        raise Injected

    monkeypatch.setattr("sern_core.bodies.codecs.encode", encode)
    robot.send(channel, b"x" * 5000)
    world.run(1.0)
    assert [got.body for got in site.got] == [b"x" * 5000]
    assert robot.core.coder.unencodable


@pytest.mark.interpreted
def test_what_fails_towards_one_client_costs_that_one_its_session_and_nobody_a_message() -> None:
    world = World()
    world.expected_faults = (Injected,)
    robot = world.client("robot")
    near, far = world.client("near", patterns=[".*"]), world.client("far", patterns=[".*"])
    channel = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    robot.send(channel, b"1")
    world.run(1.0)
    link = world.relay.hub.links[far.name]
    with Faults(((Sender, "submit"), 1))([(Sender, "submit")]) as faults:
        plain = Sender.submit

        def submit(self: Sender, *args: object, **kwargs: object) -> bool:
            faults.armed = self is link.sender
            return plain(self, *args, **kwargs)  # type: ignore[arg-type]

        for sender in (link.sender, world.relay.hub.links[near.name].sender):
            sender.submit = submit.__get__(sender)  # type: ignore[method-assign]
        faults.armed = False
        robot.send(channel, b"2")
        world.run(1.0)
    assert faults.raised == 1
    robot.send(channel, b"3")
    world.run(3.0)
    assert [got.body for got in near.got] == [b"1", b"2", b"3"]
    assert [got.body for got in far.got] == [b"1", b"3"] and far.expired_seqs["/robot/log"] == [2]
    assert [(drop.seq, drop.reason) for drop in robot.dropped_out] == [(2, DropReason.FAULT)]
    assert (robot.ups, near.ups, far.ups) == ([False], [False], [False, True])
    world.until(world.quiet, what="all is confirmed")
    world.validate()


@pytest.mark.interpreted
def test_a_full_table_of_channels_refuses_one_subscriber_and_not_the_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    robot = world.client("robot")
    near, far = world.client("near", patterns=[".*"]), world.client("far", patterns=[".*"])
    world.run(1.0)
    link = world.relay.hub.links[far.name]

    def open_channel(*_args: object, **_kwargs: object) -> OutChannel:
        raise UsageError("all 65535 channels towards far are in use")

    monkeypatch.setattr(link.outgoing, "open", open_channel)
    channel = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    robot.send(channel, b"1")
    world.run(1.0)
    world.validate()
    assert [got.body for got in near.got] == [b"1"] and not far.got
    assert [code for code, _text in far.denials] == ["too_many_streams"]
    assert not robot.refusals and robot.ups == [False]
    monkeypatch.undo()
    far.subscribe()
    world.run(1.0)
    far.subscribe(".*")
    world.run(1.0)
    robot.send(channel, b"2")
    world.run(1.0)
    assert [got.body for got in far.got] == [b"2"]
    world.validate()


@pytest.mark.interpreted
@pytest.mark.parametrize("lane", [LANE_ZMQ, LANE_UDP])
@pytest.mark.parametrize("front", [False, True])
def test_nothing_that_a_bad_datagram_carried_is_lost_on_any_lane(lane: int, front: bool) -> None:
    """The relay's shell closes the lane that it came over; the session must not go on as if it had been read."""
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    link = lanes.world.relay.hub.clients.link(ClientName("robot"), lanes.world.now)
    bad: list[int] = []

    def receive(self: Link, data: framing.Datagram, *, now: float, lane: int = LANE_ZMQ) -> None:
        if now - lanes.world.network.start_s > 2.5 and len(bad) < 3 and lane == wanted and len(data) > 100:
            bad.append(lane)
            head, frames = bytes(data[: framing.HEADER_BYTES]), bytes(data[framing.HEADER_BYTES :])
            data = head + b"\xff" + frames if front else head + frames + b"\xff"
        try:
            Link.receive(self, data, now=now, lane=lane)
        except RemoteError:
            if lane == LANE_UDP:
                self.close_lane(now=now)

    wanted = lane
    link.receive = receive.__get__(link)  # type: ignore[method-assign]
    if lane == LANE_ZMQ:
        lanes.world.network.at(2.0, lambda now: lanes.core.link.close_lane(now=now))
    lanes.run(5.0)
    assert len(bad) == 3
    fresh = lanes.robot.publish("/robot/fresh", spec(reliable=True), "int32 x\n")
    lanes.run(1.0)
    lanes.robot.send(fresh, b"it goes on")
    lanes.run(1.0)
    assert [got.body for got in lanes.site.on("/robot/fresh")] == [b"it goes on"]
    lanes.check_log()


@pytest.mark.interpreted
def test_a_control_message_that_nobody_knows_does_not_hold_up_what_came_before_it() -> None:
    """Datagrams overtake each other: what waits behind such a message was acknowledged before."""
    lanes = TwoLanes(stream=models()[0], datagrams=models()[1])
    link = lanes.world.relay.hub.clients.link(ClientName("robot"), lanes.world.now)
    late: list[bytes] = []

    def receive(self: Link, data: bytes, *, now: float, lane: int = LANE_ZMQ) -> None:
        if b"nonsense" in data and not late:
            late.append(data)
            return
        try:
            Link.receive(self, data, now=now, lane=lane)
            if b"fresh" in data and len(late) == 1:
                late.append(data)
                Link.receive(self, late[0], now=now, lane=lane)
        except RemoteError:
            self.close_lane(now=now)

    link.receive = receive.__get__(link)  # type: ignore[method-assign]
    lanes.run(3.0)
    assert lanes.core.link.lane.id == LANE_UDP
    lanes.core.link.control.send({"t": "nonsense"}, now=lanes.robot.now)
    lanes.run(0.02)
    fresh = lanes.robot.publish("/robot/fresh", spec(reliable=True), "int32 x\n")
    lanes.run(5.0)
    assert len(late) == 2
    lanes.robot.send(fresh, b"it goes on")
    lanes.run(3.0)
    assert [got.body for got in lanes.site.on("/robot/fresh")] == [b"it goes on"]
    lanes.check_log()


@pytest.mark.interpreted
def test_memory_that_cannot_be_had_costs_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    channel = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)

    def refuse(self: Partial, offset: int, data: bytes) -> bool:
        raise MemoryError

    monkeypatch.setattr(Partial, "add", refuse)
    robot.send(channel, b"x" * 100_000)
    world.run(1.0)
    monkeypatch.undo()
    robot.send(channel, b"y" * 100_000)
    world.until(world.quiet, what="all is confirmed")
    assert site.seqs("/robot/log") == [2]
    assert [(drop.seq, drop.reason) for drop in robot.dropped_out] == [(1, DropReason.REASSEMBLY)]
    world.validate()
