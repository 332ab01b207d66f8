"""Whatever a client says to a relay, what the relay says to the others is right: their sessions and traffic go on."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import DROP_CODES, ClientName, Encoding, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, definition_hash, encode_announcement
from tests.exploring import cases
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import Got, SimClient, World, spec

STEADY = settings(max_examples=cases(60))
PERIOD_S = 0.05
TEXT = "float64 x\n"
TOPICS = ("/robot/a", "/robot/b", "/tf", "/robot/" + "x" * 240, "/jackal/odom")


class Peer(Hostile):
    """A hostile client in a world. It reads what it is told, and comes back when it is cut off."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.cuts = 0

    def do(self, action: "Action") -> None:
        self.now = max(self.now, self.world.relay.now)
        try:
            action(self)
        except WireError:
            self.cut()
        self.read()

    def read(self) -> None:
        """Take what the relay says, and acknowledge it: a peer that never does is cut off for that."""
        newest = nbytes = 0
        while (data := self.port.next_datagram(now=self.now)) is not None:
            nbytes += len(data)
            header = framing.decode_header(data)
            if header.kind == framing.Kind.DATA and header.number:
                newest = header.number
        if newest:
            stamp_us = int(self.now * 1e6)
            self.say(framing.encode_ack(0, newest, 2**64 - 1, stamp_us, stamp_us, nbytes))

    def cut(self) -> None:
        """The relay closes the connection of whoever sends what no client sends."""
        self.cuts += 1
        self.port.disconnected(now=self.now)
        self.world.relay.sides[self.name].inner = HubPort(self.hub, self.name)
        self.number = self.control_seq = 0
        self.tag = self.tag % 255 + 1
        self.hello(tag=self.tag)


class Yard:
    """A relay, a robot and a site that are honest, and a hostile peer beside them."""

    def __init__(self) -> None:
        self.world = World()
        self.jackal = self.world.client("jackal", patterns=["/site/.*"])
        self.site = self.world.client("site", patterns=[".*"])
        channel = self.jackal.publish("/jackal/odom", spec(reliable=True), TEXT)
        self.jackal.every(PERIOD_S, channel, lambda seq: b"%d" % seq)
        self.world.run(0.5)
        self.peer = Peer(self.world)

    def do(self, *actions: "Action") -> None:
        for action in actions:
            self.peer.do(action)
            self.world.run(0.02)

    def check(self) -> None:
        """The honest ones go on as if nothing had happened, and whoever comes now gets what there is."""
        self.world.run(1.0)
        late = self.world.client("late", patterns=[".*"])
        self.world.run(1.0)
        for client in (self.jackal, self.site, late):
            assert (client.ups, client.downs) == ([False], []), f"{client.name} was cut off: {client.downs}"
            assert client.core.link.established
        for client in (self.site, late):
            got = odometry(client)
            assert len(got) > 10
            assert [each.seq for each in got] == list(range(got[0].seq, got[-1].seq + 1))
            assert all(each.body == b"%d" % each.seq for each in got)
            assert got[-1].at_s > self.world.now - 2.5 * PERIOD_S
        self.world.validate()


def odometry(client: SimClient) -> list[Got]:
    return [got for got in client.got if got.stream.origin == "jackal"]


Action = Callable[[Peer], None]


# What a hostile client may say ---------------------------------------------------------------------------------------

EDGES = [0, 1, 2, 255, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**61, 2**62 - 1, 2**62, 2**63 - 1, 2**64 - 1]
INTS = st.sampled_from([*EDGES, -1]) | st.integers(0, 5)
FLOATS = st.sampled_from([0.0, -0.0, 1e-9, 1e-300, 0.5, 1e9, 1e300, float("inf"), float("nan"), -1.0])
STRINGS = st.sampled_from(
    [
        "",
        "x" * 64,
        "x" * 255,
        "x" * 512,
        "\u00e9" * 255,
        "\U0001f916" * 255,
        "\u0378",  # not assigned: printable in no Python so far
        "a\nb",
        "a\0",
        "\u202e",
        "0" * 32,
        "/robot/a",
        "/robot/\u00e9",
        "/robot/a b",
        "site",
        "jackal",
        *map(str, Encoding),
    ]
)
GOOD_MAPS = [
    {"definition": "no hash of anything"},
    {"definition": "0" * 32},
    {f"k{number}": "v" for number in range(16)},
    {f"k{number:02}": "v" * 253 for number in range(4)},
    {"a": "\U0001f916" * 100},
]
MAPS = st.sampled_from([{}, {"a": "a\nb"}, {"": ""}, {"a": 1}, {"a": "x" * 257}, *GOOD_MAPS])
LISTS = st.sampled_from([[], ["site"], ["nobody"], ["\u00e9" * 64] * 48, ["x" * 64] * 40, ["site", "late"], [1]])
VALUES = INTS | FLOATS | STRINGS | MAPS | LISTS | st.booleans() | st.none()
CHANNELS = st.integers(1, 5)


GREATEST: dict[str, list[object]] = {
    "attr": [*GOOD_MAPS],
    "first": [2**31, framing.MAX_SEQ - 1, framing.MAX_SEQ],
    "type": ["x" * 255, "\u00e9/b", "\U0001f916" * 255],
    "hash": ["", "x" * 128, "\U0001f916" * 128],
    "dh": ["", "0" * 32, definition_hash(TEXT), definition_hash("other")],
    "owed": [["site", "late"], ["\U0001f916" * 64] * 12, ["x" * 64] * 40],
    "life": [None, 0.0, 1e-300, 1e9],
    "dead": [None, 0.0, 1e9],
    "ret": [0.0, 1e9],
    "w": [1e-9, 1e9, 1],
    "depth": [1, 100_000],
    "more": [True],
}
"""What may be said and is at an edge."""


def _announcement(topic: str, channel_id: int, reliable: bool, latched: bool, digest: str) -> framing.Envelope:
    identity = StreamId(ClientName("robot"), 77, TopicName(topic))
    info = TopicInfo(identity.topic, "a/b", Encoding.CDR, "RIHS01_0")
    stream = StreamInfo(identity, info, spec(reliable=reliable, latched=latched, depth=3, many_writers=topic == "/tf"))
    return encode_announcement(Announcement(channel_id, stream, digest, 1))


def _control(envelope: framing.Envelope, attachment: bytes = b"") -> Action:
    def say(peer: Peer) -> None:
        peer.control(envelope, attachment)

    return say


@st.composite
def announcements(draw: st.DrawFn) -> Action:
    """One that is right, but for some fields."""
    topic = draw(st.sampled_from(TOPICS))
    envelope = _announcement(topic, TOPICS.index(topic) + 1, draw(st.booleans()), draw(st.booleans()), "")
    if draw(RARELY):
        envelope["ch"] = draw(INTS)
    for key in draw(st.lists(st.sampled_from(sorted(GREATEST)), max_size=4)):
        envelope[key] = draw(st.sampled_from(GREATEST[key]))
    if draw(RARELY):
        envelope[draw(st.sampled_from(sorted(envelope)))] = draw(VALUES)
    return _control(envelope)


@st.composite
def controls(draw: st.DrawFn) -> Action:
    """Any other message about a channel, a definition, or what is wanted."""
    envelope: dict[str, Any] = {
        "t": draw(
            st.sampled_from(["want", "refuse", "dropped", "first", "retract", "need", "define", "subscribe", "objects"])
        )
    }
    attachment = b""
    match envelope["t"]:
        case "define":
            text = draw(st.sampled_from(["other", "", "x" * 2000, "\u00e9"]))
            envelope["dh"], attachment = draw(st.sampled_from([definition_hash(text), "0" * 32])), text.encode()
        case "need":
            envelope["dh"] = draw(st.sampled_from(["0" * 32, definition_hash(TEXT), "no hash"]))
        case "subscribe":
            envelope |= {"patterns": draw(st.lists(STRINGS, max_size=3)), "more": draw(st.booleans())}
        case "objects":
            envelope |= {"kinds": draw(st.lists(STRINGS, max_size=3)), "match": draw(st.lists(STRINGS, max_size=3))}
            envelope |= {"since": draw(INTS), "epoch": draw(INTS)}
        case _:
            envelope |= {"ch": draw(CHANNELS), "seq": draw(INTS), "on": draw(st.booleans()), "to": draw(STRINGS)}
            envelope |= {"code": draw(INTS if envelope["t"] == "dropped" else STRINGS), "why": draw(STRINGS)}
    if draw(RARELY):
        envelope[draw(st.sampled_from(sorted(envelope)))] = draw(VALUES)
    return _control(envelope, attachment)


SEQS = st.sampled_from([1, 2, 3]) | st.sampled_from([0, 1, 4, 2**31, 2**32 - 1])
RARELY = st.sampled_from([False] * 19 + [True])


@st.composite
def frames(draw: st.DrawFn) -> bytes:
    """A message or a part of one, with whatever its header can say; rarely something that no client sends."""
    channel_id, seq = draw(CHANNELS), draw(SEQS)
    stamp_ns = draw(st.sampled_from([0, 1, -1, 2**63 - 1, -(2**63)]))
    age, error = draw(st.sampled_from([0, 1, 10_000, 2**32 - 1])), draw(st.sampled_from([0, 1, 254, 255]))
    flags, codec, offset = draw(st.sampled_from([0, 0, framing.FLAG_REPLAY, framing.FLAG_URGENT])), 0, 0
    match draw(st.sampled_from(["whole", "whole", "codec", "drop marker", "piece", "watermark"])):
        case "watermark":
            return framing.encode_watermark(channel_id, seq)
        case "drop marker":
            flags |= framing.FLAG_DROP_MARKER
            body = bytes([draw(st.sampled_from([0, 1, 255, *DROP_CODES.values()]))])
            total = 1
        case "piece":
            body = bytes(draw(st.sampled_from([1, 300])))
            offset, total = draw(st.sampled_from([(0, 301), (1, 301), (0, 2**24), (0, 2**32 - 1), (300, 600)]))
        case kind:
            body = draw(st.sampled_from([b"", b"x", b"\xff" * 4, bytes(300)]))
            codec, total = draw(st.integers(1, 4)) if kind == "codec" else 0, len(body)
    if draw(RARELY):
        flags, codec = draw(st.integers(0, 255)), draw(st.integers(0, 255))
        total = draw(st.sampled_from([0, 1, 2**32 - 1]))
    if offset:
        return framing.DATA_FIXED.pack(framing.FRAME_DATA, flags, channel_id, seq, offset, total, len(body)) + body
    head = (framing.FRAME_DATA, flags, channel_id, seq, 0, total, len(body), stamp_ns, age, codec, error)
    return framing.DATA_FIRST.pack(*head) + body


@st.composite
def data(draw: st.DrawFn) -> Action:
    said = draw(st.lists(frames(), min_size=1, max_size=4))

    def say(peer: Peer) -> None:
        peer.say(*said)

    return say


@STEADY
@given(
    st.lists(announcements(), min_size=1, max_size=4),
    st.lists(announcements() | data() | data() | controls(), max_size=12),
)
def test_nothing_that_a_client_says_cuts_off_another(first: list[Action], then: list[Action]) -> None:
    yard = Yard()
    yard.do(*first, *then)
    yard.check()


# The ones that have done it ------------------------------------------------------------------------------------------


def _poison(**changes: object) -> framing.Envelope:
    return {**_announcement("/robot/p", 1, True, False, ""), **changes}


@pytest.mark.parametrize(
    ("envelope", "opened"),
    [
        (_poison(), True),
        (_poison(attr={"definition": "zzzz no hash"}), True),
        (_poison(attr={f"k{number}": "v" for number in range(16)}, dh="0" * 32), False),  # its definition never comes
        (_poison(attr={f"k{number:02}": "v" * 253 for number in range(4)}, dh=definition_hash(TEXT)), True),
        (_poison(first=framing.MAX_SEQ), True),
        (_poison(type="\u00e9/b"), False),
        (_poison(hash="\U0001f916" * 128), False),
    ],
)
def test_announcements_at_the_edge(envelope: framing.Envelope, opened: bool) -> None:
    yard = Yard()
    yard.do(_control(envelope))
    yard.check()
    assert yard.peer.cuts == 0
    for client in (yard.site, yard.world.clients["late"]):
        assert ("/robot/p" in [stream.id.topic for stream in client.opened]) is opened


def test_what_nobody_would_take_is_refused_to_its_origin() -> None:
    yard = Yard()
    yard.do(_control(_poison(type="\u00e9/b")))
    assert [(code, client) for client, code in refusals(yard)] == [("bad_announcement", "robot")]
    assert "type '\u00e9/b'" in yard.world.relay.refusals[0][1]


def refusals(yard: Yard) -> list[tuple[str, str]]:
    return [("robot", code) for code, _text in yard.world.relay.refusals]


@pytest.mark.parametrize("reliable", [False, True])
def test_a_stream_cannot_count_beyond_what_can_be_announced(reliable: bool) -> None:
    """The last seq of all; one more, and whoever subscribes later could not be told where the stream is."""
    yard = Yard()
    announcement = _announcement("/robot/p", 1, reliable, False, "") | {"first": framing.MAX_SEQ - 1}
    last = framing.encode_data_first(0, 1, framing.MAX_SEQ - 1, 1, 1, 0, 0.0, 0) + b"x"
    beyond = framing.encode_data_first(0, 1, framing.MAX_SEQ, 1, 1, 0, 0.0, 0) + b"x"
    yard.do(_control(announcement), lambda peer: peer.say(last))
    yard.world.run(0.5)
    assert [got.seq for got in yard.site.on("/robot/p")] == [framing.MAX_SEQ - 1]
    assert yard.peer.cuts == 0
    yard.do(lambda peer: peer.say(beyond))
    assert yard.peer.cuts == 1
    yard.do(_control(announcement))
    yard.check()
    assert "/robot/p" in [stream.id.topic for stream in yard.world.clients["late"].opened]


def test_names_that_no_client_has_are_not_waited_for() -> None:
    """All names that a stream requires are said to its origin in one message: they must fit."""
    yard = Yard()
    for number in range(3):
        owed = [f"{number}{index:02}".ljust(64, "\U0001f916") for index in range(12)]
        yard.do(_control(_announcement("/robot/a", 1, True, False, "") | {"owed": owed}))
    yard.check()
    assert set(yard.world.relay.hub.links) == {"robot", "jackal", "site", "late"}
