"""Whatever datagram a client sends has a bounded price for its relay: `price.py` says which, and how it is measured."""

import random
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

import pytest

from sern_core.bodies.codecs import encode
from sern_core.objects.changes import MAX_TEXT_BYTES, OBJECTS_TOPIC
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, definition_hash, encode_announcement
from tests.exploring import seeds
from tests.fuzz.price import Input, Make, within_budget, within_memory
from tests.fuzz.test_hostile_peer import Hostile, _piece, _whole
from tests.world import World, spec

INPUTS: Final[dict[str, Make]] = {}
FEWER: Final[dict[str, Make]] = {}
"""Those with fewer clients, for what grows with their number: counting memory is slow."""
FEW: Final = 8


def one_more_slice(peer: Hostile) -> bool:
    """What the relay goes on with for this client when its time comes."""
    due_s = peer.hub.links[peer.name].reading.due_s
    match_s = peer.hub.matching.due_s.get(peer.name)
    times = [at for at in (due_s, match_s) if at is not None]
    if not times:
        return False
    peer.now = max(peer.now, min(times))
    peer.port.handle_timeout(now=peer.now)
    return True


Prepare = Callable[[Hostile], list[bytes]]
ROOM: Final = 64_000


def datagram(
    prepare: Prepare, *, clients: int = 0, patterns: tuple[str, ...] = (".*",), sets_off: bool = False
) -> Prepare:
    """One datagram to a relay, made of frames; `prepare` may say more before, which costs nothing here. So many
    `clients` want what their `patterns` say. `sets_off`: it is what the peer has said before that has its turn now, and
    its size counts."""

    def make(clients: int) -> Input:
        world = World()
        peer = Hostile(world)
        for number in range(clients):
            reader = Hostile(world, f"reader{number}")
            reader.control({"t": "subscribe", "patterns": list(patterns), "more": False})
        peer.hub.links[peer.name].reassembly.limit_bytes = 64 * 2**20
        frames = b"".join(prepare(peer))
        before = peer.said_bytes if sets_off else 0
        assert len(frames) <= framing.MAX_DATAGRAM_BYTES - framing.HEADER_BYTES

        def take() -> object:
            with suppress(WireError):  # then its session ends
                peer.say(frames)
            return peer

        return Input(len(frames) + before, take, clients, lambda: one_more_slice(peer))

    to = f", for {clients} clients of {len(patterns[0])} characters" if clients else ""
    name = f"datagram: {prepare.__name__}{to}"
    INPUTS[name] = partial(make, clients)
    FEWER[name] = partial(make, min(clients, FEW))
    return prepare


def said(peer: Hostile, *frames: bytes) -> None:
    """Say it, and let all of it be read."""
    peer.say(*frames)
    while one_more_slice(peer):
        pass


def for_fifty(prepare: Prepare) -> Prepare:
    return datagram(prepare, clients=50)


def filled(piece: Callable[[int], bytes]) -> list[bytes]:
    """Fill a datagram with as many frames as it takes."""
    frames: list[bytes] = []
    size = index = 0
    while True:
        frame = piece(index)
        size += len(frame)
        if size > ROOM:
            return frames
        frames.append(frame)
        index += 1


@datagram
def small_messages(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a")
    return filled(lambda index: _whole(1, index + 1))


@datagram
def pieces_that_repeat(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    for start in range(0, 1000, 50):
        peer.say(*(_piece(1, 1, 4 + 2 * (start + index), 10**6) for index in range(50)))
    return filled(lambda index: _piece(1, 1, 4 + 2 * (index % 1000), 10**6))


@datagram
def pieces_in_reverse(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    return filled(lambda index: _piece(1, 1, 10**6 - 1 - index, 10**6))


@datagram
def pieces_with_gaps(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    return filled(lambda index: _piece(1, 1, 2 + 2 * (index % 2000) + index // 2000, 10**6))


@datagram
def claims_of_large_messages(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a")
    return filled(lambda index: _piece(1, index + 1, 0, 30_000_000))


@datagram
def one_message_of_ever_another_size(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    return filled(lambda index: _piece(1, 1, 0, 20_000_000 + index))


@datagram
def many_streams_that_make_way(peer: Hostile) -> list[bytes]:
    for channel in range(1, 400):
        peer.announce(channel, f"/robot/t{channel}")
        peer.say(_piece(channel, 1, 0, 160_000))
    return filled(lambda index: _piece(1 + index % 399, 2 + index // 399, 0, 10**6))


@datagram
def messages_behind_half_received_ones(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a")
    for start in range(0, 256, 32):
        peer.say(*(_piece(1, 10**6 + start + index, 0, 1000) for index in range(32)))
    return filled(lambda index: _whole(1, index + 1))


@datagram
def messages_and_half_received_ones_in_turn(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a")
    for start in range(0, 256, 32):
        peer.say(*(_piece(1, 10**6 + start + index, 0, 1000) for index in range(32)))
    return filled(lambda index: _whole(1, index + 1) if index % 2 else _piece(1, index + 1, 0, 50))


@datagram
def messages_out_of_order(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    return filled(lambda index: _whole(1, 10_000 - index))


@datagram
def drop_markers(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    return filled(lambda index: _whole(1, index + 1, b"\x01", flags=framing.FLAG_DROP_MARKER))


@datagram
def messages_of_channels_that_do_not_exist(peer: Hostile) -> list[bytes]:
    return filled(lambda index: _whole(7 + index, index + 1))


@datagram
def pings(peer: Hostile) -> list[bytes]:
    return [framing.PING_FRAME] * 60_000


@datagram
def watermarks(peer: Hostile) -> list[bytes]:
    return filled(lambda index: framing.encode_watermark(1 + index % 100, index))


@datagram
def acknowledgements(peer: Hostile) -> list[bytes]:
    return [framing.encode_ack(0, 1, 2**64 - 1, 0, 0, 10**9)] * framing.MAX_ACK_FRAMES


def control(peer: Hostile, body: bytes) -> bytes:
    peer.control_seq += 1
    return framing.encode_data_first(0, 0, peer.control_seq, len(body), len(body), 0, 0.0, 0) + body


@datagram
def attachments_that_unpack_to_a_megabyte(peer: Hostile) -> list[bytes]:
    head = framing.encode_envelope({"t": "define", "hash": "00" * 16})
    body = struct.pack("!H", len(head)) + head + zlib.compress(bytes(framing.MAX_ATTACHMENT_BYTES), 9)
    return filled(lambda _: control(peer, body))


@datagram
def definitions_of_a_megabyte(peer: Hostile) -> list[bytes]:
    text = "#" * (framing.MAX_ATTACHMENT_BYTES - 8)
    return filled(lambda _: control(peer, framing.encode_control(
        {"t": "define", "dh": definition_hash(text)}, text.encode())))  # fmt: skip


@datagram
def attachments_where_none_belongs(peer: Hostile) -> list[bytes]:
    body = framing.encode_control({"t": "retract", "ch": 9}, bytes(framing.MAX_ATTACHMENT_BYTES))
    return filled(lambda _: control(peer, body))


@datagram
def attachments_that_unpack_to_more(peer: Hostile) -> list[bytes]:
    head = framing.encode_envelope({"t": "define", "hash": "00" * 16})
    body = struct.pack("!H", len(head)) + head + zlib.compress(bytes(40 * 2**20), 9)[:60_000]
    return [control(peer, body)]


@datagram
def envelopes_of_many_items(peer: Hostile) -> list[bytes]:
    inner = {f"k{index:02}": [index] * 12 for index in range(60)}
    return filled(lambda index: control(peer, framing.encode_control({"t": "nothing", "x": inner})))


@datagram
def envelopes_within_each_other(peer: Hostile) -> list[bytes]:
    nested = b"\x81\xa1t" + b"\x91" * 4000 + b"\xc0"
    return [control(peer, struct.pack("!H", len(nested)) + nested)]


@datagram
def announcements(peer: Hostile) -> list[bytes]:
    def announcement(index: int) -> bytes:
        info = TopicInfo(TopicName(f"/robot/t{index}"), "a/b", Encoding.CDR)
        stream = StreamInfo(StreamId(peer.name, peer.boot, info.name), info, spec())
        return control(peer, framing.encode_control(encode_announcement(Announcement(1 + index, stream, "", 1, ()))))

    return filled(announcement)


for_fifty(small_messages)
for_fifty(watermarks)
for_fifty(announcements)
HOSTILE_PATTERN: Final = "/.*(a|b)" + "[a-z]{0,60}" * 8 + "x"
datagram(announcements, clients=50, patterns=(HOSTILE_PATTERN,))


@datagram
def patterns_against_two_hundred_topics(peer: Hostile) -> list[bytes]:
    for index in range(200):
        peer.announce(1 + index, f"/robot/{'abcdefghij' * 8}{index}")
    return filled(lambda index: control(peer, framing.encode_control(
        {"t": "subscribe", "patterns": [HOSTILE_PATTERN[:-1] + chr(97 + index % 26)], "more": False})))  # fmt: skip


def with_channels(peer: Hostile, count: int) -> None:
    """The relay has so many streams for the peer, which wants them."""
    other = Hostile(peer.world, "other")
    for index in range(count):
        other.announce(1 + index, f"/other/t{index}", reliable=True)
    peer.control({"t": "subscribe", "patterns": ["/other/.*"], "more": False})
    while one_more_slice(peer):
        pass


@for_fifty
def answers_about_many_channels(peer: Hostile) -> list[bytes]:
    with_channels(peer, 8 * len(peer.hub.links))
    return filled(lambda index: control(peer, framing.encode_control(
        {"t": "want", "ch": 1, "on": bool(index % 2), "chs": [2, 0xFFFF]})))  # fmt: skip


def hello_after_long_lists() -> Input:
    """A subscriber that has said of all its streams that thousands of others require them greets anew."""
    peer = Hostile()
    with_channels(peer, 300)
    names = [f"{index:x}" for index in range(8190)]
    rows = [names[start : start + 48] for start in range(0, len(names), 48)]
    for row in rows[:-1]:
        said(peer, control(peer, framing.encode_control({"t": "want", "ch": 1, "on": True, "owed": row, "more": True})))
    runs = [2, len(peer.hub.links[peer.name].sender.channels)]
    said(peer, control(peer, framing.encode_control({"t": "want", "ch": 1, "on": True, "owed": rows[-1], "chs": runs})))
    said(peer, control(peer, framing.encode_control({"t": "want", "ch": 1, "on": True, "add": ["x"], "chs": runs})))
    return Input(peer.said_bytes, partial(peer.hello, 2))


INPUTS["datagram: HELLO after long lists"] = FEWER["datagram: HELLO after long lists"] = hello_after_long_lists


def streams_that_require_absent_clients() -> Input:
    """An origin says of each of its streams that it requires clients that have not come back yet."""
    peer = Hostile()
    peer.hub.absent.known = lambda _client: True
    peer.hub.links[peer.name].reassembly.limit_bytes = 64 * 2**20
    absent = tuple(f"site{number}" for number in range(48))

    def required(index: int) -> bytes:
        identity = StreamId(peer.name, peer.boot, TopicName(f"/robot/t{index}"))
        stream = StreamInfo(identity, TopicInfo(identity.topic, "a/b", Encoding.CDR), spec(reliable=True))
        return control(
            peer, framing.encode_control(encode_announcement(Announcement(1 + index, stream, "", 1, absent)))
        )

    for index in range(100):
        said(peer, required(index))
    frames = [required(index) for index in range(100, 160)]

    return Input(sum(map(len, frames)), lambda: peer.say(*frames), len(absent), lambda: one_more_slice(peer))


ABSENT: Final = "datagram: streams that require absent clients"
INPUTS[ABSENT] = FEWER[ABSENT] = streams_that_require_absent_clients


@for_fifty
def runs_of_dropped_messages(peer: Hostile) -> list[bytes]:
    other = Hostile(peer.world, "other")
    other.announce(1, "/other/log", reliable=True)
    peer.control({"t": "subscribe", "patterns": ["/other/.*"], "more": False})
    for start in range(1, 3000, 500):
        said(other, *(_whole(1, seq) for seq in range(start, start + 500)))
    return filled(lambda index: control(peer, framing.encode_control(
        {"t": "dropped", "ch": 1, "seq": 1 + index % 3000, "code": 1, "to": "x", "n": 3000})))  # fmt: skip


@for_fifty
def objects_as_large_as_they_may_be(peer: Hostile) -> list[bytes]:
    peer.announce(1, OBJECTS_TOPIC, reliable=True)
    return filled(lambda index: _whole(1, index + 1, framing.encode_control(
        {"op": "put", "id": f"robot/o{index}", "kind": "node", "val": True, "n": MAX_TEXT_BYTES}, bytes(MAX_TEXT_BYTES)
    )))  # fmt: skip


@for_fifty
def definitions_of_objects(peer: Hostile) -> list[bytes]:
    peer.announce(1, OBJECTS_TOPIC, reliable=True)
    texts = [f"{index}" + "#" * (MAX_TEXT_BYTES - 9) for index in range(4)]
    return filled(lambda index: _whole(1, index + 1, framing.encode_control(
        {"op": "define", "dh": definition_hash(texts[index % 4])}, texts[index % 4].encode())))  # fmt: skip


@for_fifty
def subscriptions_to_objects(peer: Hostile) -> list[bytes]:
    peer.announce(1, OBJECTS_TOPIC, reliable=True)
    for index in range(1000):
        said(peer, _whole(1, index + 1, framing.encode_control(
            {"op": "put", "id": f"robot/o{index}", "kind": "node", "n": -1})))  # fmt: skip
    patterns = [f"(a|b)*{number}" for number in range(24)]
    return filled(lambda index: control(peer, framing.encode_control(
        {"t": "objects", "kinds": [""] * 24, "match": [f"{each}_{index}" for each in patterns]})))  # fmt: skip


@for_fifty
def definitions_that_fifty_may_wait_for(peer: Hostile) -> list[bytes]:
    texts = [f"{index}" + "#" * (framing.MAX_ATTACHMENT_BYTES - 9) for index in range(4)]
    for index, text in enumerate(texts):
        peer.announce(1 + index, f"/robot/t{index}", digest=definition_hash(text))
    return filled(lambda index: control(peer, framing.encode_control(
        {"t": "define", "dh": definition_hash(texts[index % 4])}, texts[index % 4].encode())))  # fmt: skip


@for_fifty
def streams_that_are_gone(peer: Hostile) -> list[bytes]:
    for index in range(300):
        peer.announce(1 + index, f"/robot/t{index}")
    return filled(lambda index: control(peer, framing.encode_control({"t": "retract", "ch": 1 + index})))


def all_streams_at_once(peer: Hostile) -> list[bytes]:
    for index in range(300):
        peer.announce(1 + index, f"/robot/t{index}")
    peer.hello(2)
    peer.tag, peer.control_seq = 2, 0
    return [control(peer, framing.encode_control({"t": "synced", "batch": True}))]


def the_one_they_wait_for(peer: Hostile) -> list[bytes]:
    peer.announce(1, "/robot/a", reliable=True)
    for start in range(2, 8_000, 1000):
        said(peer, *(_whole(1, seq) for seq in range(start, start + 1000)))
    return [_whole(1, 1)]


def none_below(peer: Hostile) -> list[bytes]:
    the_one_they_wait_for(peer)
    return [control(peer, framing.encode_control({"t": "first", "ch": 1, "seq": 100_000}))]


WAITING: Final = 60_000


def full(peer: Hostile, frame: Callable[[int], bytes]) -> None:
    """Messages that wait for those before them fill the memory that a link may have."""
    peer.announce(1, "/robot/a", reliable=True)
    for start in range(1_000_000, 1_000_000 + WAITING, 1500):
        said(peer, *(frame(seq) for seq in range(start, start + 1500)))


def step_by_step(peer: Hostile) -> list[bytes]:
    return filled(lambda index: control(peer, framing.encode_control({"t": "first", "ch": 1, "seq": 2 + index})))


@datagram
def first_of_ever_one_more_before_many_that_wait(peer: Hostile) -> list[bytes]:
    full(peer, lambda seq: _whole(1, seq))
    return step_by_step(peer)


@datagram
def first_of_ever_one_more_before_many_half_received(peer: Hostile) -> list[bytes]:
    full(peer, lambda seq: _piece(1, seq, 0, 2))
    return step_by_step(peer)


def none_of_the_half_received(peer: Hostile) -> list[bytes]:
    full(peer, lambda seq: _piece(1, seq, 0, 2))
    return [control(peer, framing.encode_control({"t": "first", "ch": 1, "seq": 2_000_000}))]


datagram(none_of_the_half_received, sets_off=True)

for set_off in (all_streams_at_once, the_one_they_wait_for, none_below):
    datagram(set_off, sets_off=True)
    datagram(set_off, sets_off=True, clients=50)


@datagram
def noise(peer: Hostile) -> list[bytes]:
    return [random.Random(4).randbytes(ROOM)]


def encoded(mode: Compression, raw: bytes) -> Prepare:
    def prepare(peer: Hostile) -> list[bytes]:
        peer.announce(1, "/robot/a")
        codec, body = encode(mode, raw)
        size = len(body)
        return filled(lambda index: framing.encode_data_first(0, 1, index + 1, size, size, 0, 0.0, codec) + body)

    prepare.__name__ = f"{mode} of {len(raw)} zeros"
    return datagram(prepare)


encoded(Compression.LZ4, bytes(8192))
encoded(Compression.ZSTD, bytes(8192))


@pytest.mark.parametrize("name", list(INPUTS))
def test_an_input_holds_the_loop_for_a_bounded_time(name: str) -> None:
    assert within_budget(INPUTS[name])


@pytest.mark.parametrize("name", list(INPUTS))
def test_an_input_adds_a_bounded_multiple_of_its_size_to_memory(name: str) -> None:
    assert within_memory(FEWER[name])


def fuzzed_datagram(rng: random.Random) -> Make:
    seed = rng.random()

    def make() -> Input:
        peer = Hostile()
        rng = random.Random(seed)
        frames = b""
        for channel in range(1, 4):
            peer.announce(channel, f"/robot/t{channel}", reliable=channel == 1)
        for _ in range(rng.randrange(1, 6)):
            piece = fuzzed_frame(rng, peer)
            frames += piece * rng.choice((1, 1, 20, ROOM // len(piece)))
        frames = frames[:ROOM]
        if rng.random() < 0.3:
            frames = frames[: rng.randrange(len(frames) + 1)]

        def take() -> object:
            with suppress(WireError):
                peer.say(frames)
            return peer

        return Input(len(frames), take)

    return make


def fuzzed_frame(rng: random.Random, peer: Hostile) -> bytes:
    channel, seq = rng.randrange(5), rng.choice((1, 2, 3, 1000, 2**31))
    what = rng.randrange(6)
    if what == 0:
        return _whole(channel, seq, rng.randbytes(rng.randrange(1, 200)))
    if what == 1:
        total = rng.choice((10, 10**4, 30_000_000))
        offset = rng.randrange(total)
        return _piece(channel, seq, offset, total, rng.randbytes(1 + rng.randrange(min(50, total - offset))))
    if what == 2:
        fields = {"ch": rng.randrange(9), "dh": "0" * 32, "seq": 7, "id": "a", "op": "put", "on": True}
        envelope: framing.Envelope = {key: value for key, value in fields.items() if rng.random() < 0.5}
        kinds = ("announce", "subscribe", "objects", "define", "need", "want", "first", "synced")
        envelope["t"] = rng.choice(kinds)
        return control(peer, framing.encode_control(envelope, bytes(rng.choice((0, 100, 10**6)))))
    if what == 3:
        return framing.encode_watermark(channel, seq)
    if what == 4:
        return framing.encode_ack(
            0, rng.randrange(3), rng.getrandbits(64), rng.getrandbits(63), rng.getrandbits(63), seq
        )
    return bytes([rng.randrange(6)]) + rng.randbytes(rng.randrange(40))


@pytest.mark.parametrize("seed", seeds(120))
def test_any_datagram_has_a_bounded_price(seed: int) -> None:
    make = fuzzed_datagram(random.Random(seed))
    assert within_budget(make)
    if seed % 8 == 0:  # counting memory is slow
        assert within_memory(make)
