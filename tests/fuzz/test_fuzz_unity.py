"""What a scene of Unity may send: any bytes are frames or WireError, any body of a command is one or WireError, and
frames are the same in whatever pieces they come."""

import json
import struct
import tracemalloc

from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_client.endpoints.unity import commands, names
from sern_client.endpoints.unity.commands import Command
from sern_client.endpoints.unity.frames import Frame, FrameReader, TooLarge
from sern_core.vocabulary.errors import ConfigError, WireError
from tests.exploring import cases

STEADY = settings(max_examples=cases(400))
LIMIT = 100

LENGTHS = st.one_of(
    st.integers(0, 20), st.sampled_from([LIMIT, LIMIT + 1, 1024, 1025, 16384, 2**31 - 1, 2**31, 2**32 - 1])
).map(struct.Struct("<I").pack)
WORDS = st.sampled_from([b"/chat", b"/chat\0", b"__subscribe", b"__", b"\0", b"\xff", b"{}", b"__request\0"])
BYTES = st.lists(st.one_of(LENGTHS, WORDS, st.binary(max_size=8)), max_size=12).map(b"".join)
NAMES = st.text(st.characters(min_codepoint=33, max_codepoint=0x2FF), max_size=40)
FRAMES = st.lists(st.tuples(NAMES, st.binary(max_size=2 * LIMIT)), max_size=6)


def one_line(error: Exception) -> None:
    text = str(error)
    assert text.isprintable() and len(text) < 1000, text


def read(data: bytes, pieces: list[int]) -> list[Frame | TooLarge | str]:
    """What comes out, and the error at the end, if there is one; `pieces`: after how many bytes each to cut."""
    reader, found, at = FrameReader(LIMIT), list[Frame | TooLarge | str](), 0
    for cut in [*pieces, len(data)]:
        part, at = data[at : at + cut], at + cut
        try:
            found.extend(reader.feed(part))
        except WireError as error:
            one_line(error)
            return [*found, str(error)]
        assert reader.kept_bytes <= 1024 + LIMIT + 16384
    return found


@STEADY
@given(BYTES, st.lists(st.integers(0, 5), max_size=60))
@example(b"\xff\xff\xff\xff", [])
@example(b"\0\0\0\0\0\0\0\0", [1] * 8)
def test_any_bytes_in_any_pieces(data: bytes, pieces: list[int]) -> None:
    whole = read(data, [])
    assert read(data, pieces) == whole
    assert read(data, [1] * len(data)) == whole


@STEADY
@given(FRAMES, st.lists(st.integers(1, 50), max_size=40))
def test_frames_come_out_as_they_went_in(frames: list[tuple[str, bytes]], pieces: list[int]) -> None:
    data = b"".join(
        struct.pack("<I", len(name.encode()) + 1) + name.encode() + b"\0" + struct.pack("<I", len(body)) + body
        for name, body in frames
    )
    expected = [
        Frame(name, body) if len(body) <= LIMIT else TooLarge(name, len(body))
        for name, body in frames
        if not (name.startswith("__") and len(body) > LIMIT)
    ]
    if all(not name.startswith("__") or len(body) <= LIMIT for name, body in frames):
        assert read(data, pieces) == expected


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(["topic", "message_name", "srv_id", "latch", "queue_size"]), inner, max_size=5),
    ),
    max_leaves=12,
)
KINDS = st.sampled_from(
    (
        *("__subscribe", "__publish", "__ros_service", "__unity_service", "__request", "__response", "__topic_list"),
        *("__remove_subscriber", "__remove_publisher", "__remove_ros_service", "__remove_unity_service"),
        *("__dance", "__"),
    )
)


@STEADY
@given(KINDS, st.one_of(st.binary(max_size=100), JSON.map(lambda value: json.dumps(value).encode() + b"\0")))
def test_any_body_of_a_command(kind: str, body: bytes) -> None:
    try:
        command = commands.parse(kind, body)
    except WireError as error:
        one_line(error)
        return
    assert isinstance(command, Command)
    assert isinstance(command.topic, str) and isinstance(command.type_name, str)
    assert type(command.srv_id) is int and type(command.latch) is bool


@STEADY
@given(st.one_of(st.text(max_size=300), st.from_regex(r"[a-z_/]{0,20}")))
def test_any_name(text: str) -> None:
    for check in (names.local_name, names.our_type, lambda name: names.our_type(name, "srv")):
        try:
            assert check(text)
        except ConfigError as error:
            one_line(error)
    assert isinstance(names.their_type(text), str)


def test_an_announced_length_costs_nothing() -> None:
    reader = FrameReader(2**30)
    tracemalloc.start()
    try:
        assert not list(reader.feed(struct.pack("<I", 5) + b"/chat" + struct.pack("<I", 2**30)))
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()
