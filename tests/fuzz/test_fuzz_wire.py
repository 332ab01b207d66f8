"""Any bytes, to the codec and to an established link: accepted, or WireError or VersionError, nothing else."""

from collections.abc import Callable
from typing import Any, Final

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import VersionError, WireError
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, decode_announcement, definition_hash, encode_announcement
from sern_sim.ports import Port
from tests.exploring import cases
from tests.make_vectors import Frames, decode, rejected, valid
from tests.world import World, spec

STEADY = settings(max_examples=cases(400))
GOOD: Final = {vector["name"]: (vector["layer"], bytes.fromhex(vector["hex"])) for vector in valid()}
BAD: Final = {
    vector["name"]: (vector["layer"], bytes.fromhex(vector["hex"])) for vector in rejected() if "hex" in vector
}
DATAGRAMS: Final = [data for layer, data in GOOD.values() if layer == "datagram"]
CONTROLS: Final = [data for layer, data in GOOD.values() if layer == "control"]


def tried(call: Callable[[], object]) -> bool:
    """Whether `call` accepted; anything but the two documented exceptions fails the test, and so does a long text."""
    try:
        call()
    except (WireError, VersionError) as error:
        text = str(error)
        assert text.isprintable() and 0 < len(text) < 1000
        return False
    return True


def meaning(call: Callable[[], object]) -> object:
    """What `call` makes of its bytes, None where it refuses them; asked twice, it must say the same."""
    said: list[object] = []
    accepted = [tried(lambda: said.append(call())) for _ in range(2)]
    assert accepted[0] == accepted[1]
    assert repr(said[:1]) == repr(said[1:])
    return said[0] if said else None


def mutated(originals: list[bytes]) -> st.SearchStrategy[bytes]:
    """A good one with some bytes changed, a piece taken out or doubled, or two joined."""

    @st.composite
    def build(draw: st.DrawFn) -> bytes:
        data = bytearray(draw(st.sampled_from(originals)))
        for _ in range(draw(st.integers(1, 4))):
            at = draw(st.integers(0, len(data)))
            match draw(st.integers(0, 4)):
                case 0 if at < len(data):
                    data[at] = draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]) | st.integers(0, 255))
                case 1:
                    del data[at : at + draw(st.integers(1, 8))]
                case 2:
                    data[at:at] = draw(st.binary(max_size=8))
                case 3:
                    data[at:at] = data[at : at + draw(st.integers(1, 32))]
                case _:
                    data += draw(st.sampled_from(originals))[framing.HEADER_BYTES :]
        return bytes(data)

    return build()


# --- the codec --------------------------------------------------------------------------------------------------------


@STEADY
@given(st.binary(max_size=200))
def test_any_bytes(data: bytes) -> None:
    for decode_part in (framing.decode_header, framing.decode_envelope, framing.decode_control):
        assert len(data) > 0 or meaning(lambda part=decode_part: part(data)) is None  # type: ignore[misc]
        meaning(lambda part=decode_part: part(data))  # type: ignore[misc]
    if len(data) >= framing.HEADER_BYTES:
        tried(lambda: framing.decode_frames(data, Frames()))
        meaning(lambda: framing.decode_handshake(data))


@STEADY
@given(mutated(DATAGRAMS))
def test_mutated_datagrams(data: bytes) -> None:
    assert meaning(lambda: decode("datagram", data)) is None or data[0] == framing.MAGIC


@STEADY
@given(mutated(CONTROLS))
def test_mutated_control_messages(body: bytes) -> None:
    said: list[tuple[framing.Envelope, bytes]] = []
    if tried(lambda: said.append(framing.decode_control(body))):
        again = framing.encode_control(*said[0])
        assert framing.encode_control(*framing.decode_control(again)) == again


VALUES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["/a", "cdr", "x" * 600, "0" * 32, 2**63 - 1, 65_536, 1e10])
    | st.lists(st.text(max_size=4) | st.integers(), max_size=4)
    | st.dictionaries(st.text(max_size=4), st.text(max_size=4) | st.none(), max_size=4)
)
ANNOUNCE: Final = framing.decode_control(GOOD["announce"][1])[0]


@STEADY
@given(
    st.dictionaries(st.sampled_from(sorted(ANNOUNCE)), VALUES, max_size=4), st.sets(st.sampled_from(sorted(ANNOUNCE)))
)
def test_any_values_in_an_announcement(changes: dict[str, Any], left_out: set[str]) -> None:
    envelope = {key: value for key, value in (ANNOUNCE | changes).items() if key not in left_out}
    result: list[Announcement] = []
    if tried(lambda: result.append(decode_announcement(envelope))):
        again = encode_announcement(result[0])
        assert decode_announcement(again) == result[0]
        assert framing.envelope_bytes(again) <= framing.MAX_ENVELOPE_BYTES


@pytest.mark.parametrize("name", GOOD)
def test_whole_truncated_and_with_trailing_data(name: str) -> None:
    """What decodes whole must not decode to the same meaning when something is missing or follows."""
    layer, data = GOOD[name]
    meaning = decode(layer, data)
    for length in range(len(data)):
        if tried(lambda length=length: decode(layer, data[:length])):  # type: ignore[misc]
            assert decode(layer, data[:length]) != meaning
    for more in (b"\x00", b"\x01", b"\xff", data, bytes(100)):
        if tried(lambda more=more: decode(layer, data + more)):  # type: ignore[misc]
            assert decode(layer, data + more) != meaning


@pytest.mark.parametrize("name", BAD)
def test_what_is_rejected_stays_so_with_more_behind_it(name: str) -> None:
    """A frame that is only cut short may be completed by what follows; everything else is wrong for ever."""
    layer, data = BAD[name]
    for more in (b"\x00", b"\xff", data, bytes(4096)):
        accepted = tried(lambda more=more: decode(layer, data + more))  # type: ignore[misc]
        assert not accepted or "cut" in name or "header-of" in name or "without" in name or "nested" in name


# --- an established link ----------------------------------------------------------------------------------------------


class Duet:
    """A relay core with a client core in a session, joined by hand; every datagram between them is kept."""

    def __init__(self, params: LinkParams | None = None) -> None:
        world = World(link=params)
        self.now = 0.0
        self.hub = world.relay.hub
        self.robot = world.client("robot", patterns=[".*"])
        self.site = world.client("site", patterns=[".*"])
        self.said: dict[str, list[bytes]] = {"relay": [], "robot": [], "site": []}
        self.port: Port = world.relay.port(self.robot.name)
        self.link = self.robot.core.link
        self._pairs = [
            (client.name, client.core.link, world.relay.port(client.name)) for client in (self.robot, self.site)
        ]
        channels = [
            client.publish(f"/{client.name}/{topic}", topic_spec, definition=f"uint8 {topic}")
            for client in (self.robot, self.site)
            for topic, topic_spec in (
                ("pose", spec(PriorityClass.CONTROL)),
                ("map", spec(reliable=True, latched=True, depth=2)),
                ("log", spec(PriorityClass.BULK, depth=5)),
            )
        ]
        for _, link, port in self._pairs:
            link.connected(now=self.now)
            port.connected(now=self.now)
        self.settle()
        for channel in channels:
            core = self.robot.core if channel.stream.id.origin == "robot" else self.site.core
            core.send(channel, bytes(3000), 1, now=self.now)
        self.settle()
        assert len(self.robot.got) == len(self.site.got) == 3

    def settle(self, seconds: float = 0.3) -> None:
        for _ in range(int(seconds / 0.01)):
            for name, link, port in self._pairs:
                for out, back, who in ((link, port, str(name)), (port, link, "relay")):
                    while (data := out.next_datagram(now=self.now)) is not None:
                        self.said[who].append(data)
                        back.receive(data, now=self.now)
                    out.handle_timeout(now=self.now)
            self.now += 0.01

    def validate(self) -> None:
        self.hub.validate()
        for _, link, _ in self._pairs:
            link.validate()


DUET: Final = Duet()
SAID: Final = DUET.said
TAG: Final = DUET.link.end.tag


def assert_in_order_after(datagrams: list[bytes], *, to_relay: bool, duet: Duet | None = None) -> None:
    """Feed one side of a fresh session, up to the first error, as its shell would; then both must be in order."""
    duet = duet or Duet()
    target = duet.port if to_relay else duet.link
    for data in datagrams:
        if not tried(lambda data=data: target.receive(data, now=duet.now)):  # type: ignore[misc]
            duet.validate()
            target.disconnected(now=duet.now)
            duet.validate()
            return
        while target.next_datagram(now=duet.now) is not None:
            pass
        duet.now += 0.02
        target.handle_timeout(now=duet.now)
    duet.validate()


# A header that passes, so that what follows it is looked at.
BEHIND_A_HEADER = st.builds(
    lambda number, stamp, rest: framing.encode_header(framing.Kind.DATA, TAG, number, stamp) + rest,
    st.sampled_from([0, 1, 5, 40, 2**31, 2**32 - 1]),
    st.sampled_from([0, 10**6, 2**63, 2**64 - 1]),
    st.lists(
        st.sampled_from([d[framing.HEADER_BYTES :] for d in DATAGRAMS if d[2] == framing.Kind.DATA]), max_size=5
    ).map(b"".join)
    | st.binary(max_size=60),
)
FEW = settings(STEADY, max_examples=cases(120))


@FEW
@given(st.lists(BEHIND_A_HEADER | st.binary(max_size=40) | mutated(SAID["robot"]), min_size=1, max_size=8))
def test_any_datagrams_to_a_relay(datagrams: list[bytes]) -> None:
    assert_in_order_after(datagrams, to_relay=True)


@FEW
@given(st.lists(BEHIND_A_HEADER | st.binary(max_size=40) | mutated(SAID["relay"]), min_size=1, max_size=8))
def test_any_datagrams_to_a_client(datagrams: list[bytes]) -> None:
    assert_in_order_after(datagrams, to_relay=False)


FRAMES = st.one_of(
    st.builds(
        lambda flags, channel, seq, offset, more, body: (
            framing.encode_data_next(flags, channel, seq, offset, offset + len(body) + more, len(body)) + body
            if offset
            else framing.encode_data_first(flags, channel, seq, len(body) + more, len(body), 1, 0.01, 0) + body
        ),
        st.sampled_from([0, framing.FLAG_URGENT, framing.FLAG_REPLAY]),
        st.integers(0, 4) | st.just(65_535),
        st.integers(0, 6) | st.sampled_from([2**31 - 1, 2**31 + 1, 2**32 - 1]),
        st.sampled_from([0, 1, 5, 2**31]),
        st.sampled_from([0, 1, 100, 2**24, 2**31 - 100]),
        st.binary(min_size=1, max_size=10),
    ),
    st.builds(
        lambda channel, seq, code: framing.encode_data_first(1, channel, seq, 1, 1, 0, 0.0, 0) + bytes([code]),
        st.integers(0, 4),
        st.integers(0, 6),
        st.integers(0, 255),
    ),
    st.builds(
        framing.encode_ack,
        st.sampled_from([0, 0, 0, 1]),
        st.integers(0, 8) | st.just(2**32 - 1),
        st.sampled_from([0, 7, 2**64 - 1]),
        st.sampled_from([0, 10**5, 2**64 - 1]),
        st.sampled_from([0, 10**5, 2**64 - 1]),
        st.sampled_from([0, 10**5, 2**64 - 1]),
    ),
    st.builds(
        framing.encode_watermark, st.integers(0, 4) | st.just(65_535), st.sampled_from([0, 1, 2, 2**31, 2**32 - 1])
    ),
    st.just(framing.PING_FRAME),
)


@FEW
@given(st.lists(st.lists(FRAMES, min_size=1, max_size=4), min_size=1, max_size=12), st.booleans())
def test_valid_frames_in_any_order(rounds: list[list[bytes]], to_relay: bool) -> None:
    numbers = range(50, 50 + len(rounds))
    assert_in_order_after(
        [
            framing.encode_header(framing.Kind.DATA, TAG, number, number * 20_000) + b"".join(frames)
            for number, frames in zip(numbers, rounds, strict=True)
        ],
        to_relay=to_relay,
    )


CONTROL_VALUES: Final[dict[str, st.SearchStrategy[Any]]] = {
    "t": st.sampled_from(sorted({framing.decode_control(body)[0]["t"] for body in CONTROLS} | {"nonsense"})),
    "ch": st.integers(0, 5),
    "seq": st.integers(0, 6) | st.sampled_from([2**31, 2**62, 2**63 - 1]),
    "first": st.integers(0, 6) | st.sampled_from([2**31, 2**62]),
    "on": st.booleans(),
    "owed": st.sampled_from([[], ["site"], ["nobody"], ["robot", "site"]]),
    "dh": st.sampled_from(["", definition_hash("uint8 pose"), definition_hash("x"), "0" * 32]),
    "code": st.integers(0, 20) | st.sampled_from(["forbidden", "x"]),
    "why": st.just("because"),
    "to": st.just("site"),
    "or": st.sampled_from(["robot", "site"]),
    "boot": st.sampled_from([1, DUET.robot.core.boot, DUET.site.core.boot]),
    "topic": st.sampled_from(["/robot/pose", "/robot/map", "/robot/log", "/x", "/not a name"]),
    "rel": st.booleans(),
    "lat": st.booleans(),
    "patterns": st.sampled_from([[], [".*"], ["/site/.*"], ["("], ["(a+)+"]]),
    "more": st.booleans(),
    "op": st.sampled_from(["put", "delete"]),
    "id": st.sampled_from(["a", "a@robot", "a@site"]),
    "kind": st.sampled_from(["node", "patch", "nonsense"]),
}


@FEW
@given(
    st.lists(
        st.tuples(
            st.sampled_from(CONTROLS).map(lambda body: framing.decode_control(body)[0]),
            st.fixed_dictionaries({}, optional=CONTROL_VALUES),
            st.sampled_from([b"", b"uint8 pose", b"\xff"]),
        ),
        min_size=1,
        max_size=10,
    ),
    st.booleans(),
)
@example([({"t": "announce"}, {}, b"")], True)
def test_control_messages_with_any_values(said: list[tuple[Any, Any, bytes]], to_relay: bool) -> None:
    duet = DUET
    mine = duet.link if to_relay else duet.hub.links[duet.robot.name]
    first = mine.control.out.next_seq
    datagrams = []
    for index, (envelope, changes, attachment) in enumerate(said):
        body = framing.encode_control({key: changes.get(key, value) for key, value in envelope.items()}, attachment)
        head = framing.encode_data_first(0, 0, first + index, len(body), len(body), 0, 0.0, 0)
        number = mine.lane.flight.next_number + index
        datagrams.append(framing.encode_header(framing.Kind.DATA, TAG, number, 10**6) + head + body)
    assert_in_order_after(datagrams, to_relay=to_relay)
