"""Announcements as data and as envelopes: round trips, bounds, and that what was accepted can be passed on."""

import hashlib
import unicodedata
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.names import NAME_MAX_CHARS
from sern_core.vocabulary.types import ClientName, Durability, Encoding, PriorityClass, Reliability, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import (
    MAX_ATTRIBUTE_BYTES,
    MAX_DEPTH,
    MAX_STRINGS,
    MAX_TIME_S,
    Announcement,
    announcement_parts,
    check_onwards,
    check_stream,
    decode_announcement,
    definition_hash,
    encode_announcement,
)
from tests.exploring import cases

STEADY = settings(max_examples=cases(100))
NAMES = st.from_regex(r"\A[a-z][a-z0-9_]{0,62}\Z")
TOPICS = st.from_regex(r"\A/[A-Za-z_][A-Za-z0-9_]{0,40}(/[a-z0-9_]{1,40}){0,4}\Z")
PRINTABLE = st.text(max_size=60).filter(str.isprintable)
TIMES = st.floats(0.0, MAX_TIME_S)


@st.composite
def announcements(draw: st.DrawFn) -> Announcement:
    reliable, latched = draw(st.booleans()), draw(st.booleans())
    priority = draw(st.sampled_from(PriorityClass))
    spec = TopicSpec(
        priority=priority,
        weight=draw(st.floats(1e-9, 1e9)),
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        depth=draw(st.integers(1, MAX_DEPTH)),
        lifespan_s=draw(st.none() | TIMES),
        deadline_s=draw(st.none() | TIMES),
        retention_s=draw(TIMES),
        many_writers=draw(st.booleans()),
        background=priority is PriorityClass.BULK and draw(st.booleans()),
    )
    topic = TopicName(draw(TOPICS))
    info = TopicInfo(
        topic,
        draw(PRINTABLE),
        draw(st.sampled_from(Encoding)),
        draw(PRINTABLE),
        latched=latched,
        reliable=reliable,
        depth=spec.depth,
        lifespan_s=spec.lifespan_s,
        deadline_s=spec.deadline_s,
    )
    identity = StreamId(ClientName(draw(NAMES)), draw(st.integers(0, 2**63 - 1)), topic)
    return Announcement(
        channel_id=draw(st.integers(1, 0xFFFF)),
        stream=StreamInfo(identity, info, spec, draw(st.dictionaries(PRINTABLE, PRINTABLE, max_size=3))),
        definition_hash=draw(st.just("") | st.from_regex(r"\A[0-9a-f]{32}\Z")),
        first=draw(st.integers(1, framing.MAX_SEQ)),
        required=tuple(draw(st.lists(NAMES, max_size=8))),
    )


@STEADY
@given(announcements())
def test_round_trip(announcement: Announcement) -> None:
    packed = framing.encode_envelope(encode_announcement(announcement))
    assert decode_announcement(framing.decode_envelope(packed)) == announcement


def plain(**changed: Any) -> dict[str, Any]:
    """A valid envelope with some keys changed; `...` takes a key out."""
    identity = StreamId(ClientName("robot"), 7, TopicName("/robot/odom"))
    stream = StreamInfo(identity, TopicInfo(identity.topic, "nav_msgs/msg/Odometry", Encoding.CDR), TopicSpec())
    envelope = encode_announcement(Announcement(1, stream, "", 1)) | changed
    return {key: value for key, value in envelope.items() if value is not ...}


OPTIONAL = {"t", "owed", "rel", "lat", "life", "dead", "mw", "attr", "more"}
"""Keys that a sender may leave out; `t` was read before."""


@pytest.mark.parametrize("key", sorted(plain()))
def test_without_a_key(key: str) -> None:
    if key in OPTIONAL:
        decode_announcement(plain(**{key: ...}))
    else:
        with pytest.raises(WireError):
            decode_announcement(plain(**{key: ...}))


def test_unknown_keys_are_ignored() -> None:
    assert decode_announcement(plain(zz=[1, {"a": None}])) == decode_announcement(plain())


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("ch", [1, 65_535], [0, 65_536, -1, True, "1", 1.0, None]),
        ("or", ["a", "x" * 64], ["x" * 65, 1, "a\n", None]),
        ("boot", [0, 2**63 - 1], [-1, 2**63, "1", None]),
        ("topic", ["/", "/a", "/" + "x" * 511], ["", "a", "/" + "x" * 512, "/a\x00", "/\x1b[0m", None]),
        ("type", ["", "a/b", "x" * NAME_MAX_CHARS], ["x" * (NAME_MAX_CHARS + 1), "a\nb", 1]),
        ("enc", ["ros1", "cdr", "raw"], ["", "json", "ROS1", 1, None, "x" * 9]),
        ("hash", ["", "RIHS01_" + "0" * 64, "x" * 128], ["x" * 129, None]),
        ("dh", ["", "0" * 32, "af" * 16], ["0" * 31, "0" * 33, "AF" * 16, "g" * 32, "0" * 32 + "\n", None]),
        ("first", [1, 2**62], [0, 2**62 + 1, -1, None, True]),
        ("owed", [[], ["a"], ["x" * 64] * 64], ["a", ["x" * 65], [1], None]),
        ("cls", [0, 1, 2], [-1, 3, "0", None]),
        ("w", [1e-9, 1, 1e9], [0, -1, 1e10, float("nan"), float("inf"), None, "1"]),
        ("rel", [True, False], [0, 1, "yes", None]),
        ("lat", [True, False], [0, 1, "yes", None]),
        ("mw", [True, False], [0, 1, "yes", None]),
        ("depth", [1, MAX_DEPTH], [0, MAX_DEPTH + 1, None, 1.0]),
        ("life", [None, 0, 0.5, 1e9], [-1, float("inf"), float("nan"), "1", True]),
        ("dead", [None, 0, 0.5, 1e9], [-1, float("inf"), float("nan"), "1", True]),
        ("ret", [0, 0.5, 1e9], [None, -1, float("inf"), float("nan"), "1"]),
        (
            "attr",
            [{}, {"a": "b"}, {str(i): "" for i in range(16)}, {"a": "x" * 256}, {str(i): "x" * 255 for i in range(4)}],
            [
                [],
                None,
                {"a": 1},
                {"a": None},
                {"a": "b\n"},
                {str(i): "" for i in range(17)},
                {"a": "x" * 257},
                {str(i): "x" * 256 for i in range(4)},
            ],
        ),
    ],
)
def test_bounds(key: str, good: list[object], bad: list[object]) -> None:
    for value in good:
        decode_announcement(plain(**{key: value}))
    for value in bad:
        with pytest.raises(WireError) as caught:
            decode_announcement(plain(**{key: value}))
        assert "\n" not in str(caught.value) and "\x1b" not in str(caught.value)


def test_what_was_accepted_can_be_passed_on() -> None:
    """Whatever channel and `first` it has at the next hop, and whoever is required."""
    topic = "/" + "t" * (NAME_MAX_CHARS - 1)
    greatest = plain(
        ch=0xFFFF,
        boot=2**63 - 1,
        topic=topic,
        type="x" * NAME_MAX_CHARS,
        hash="x" * 128,
        dh="0" * 32,
        first=2**62,
        depth=MAX_DEPTH,
        life=0.123456789,
        dead=0.123456789,
        attr={f"{i:02}": "\u00e9" * 31 for i in range(16)},
        **{"or": "o" * 63},
    )
    announcement = decode_announcement(framing.decode_envelope(framing.encode_envelope(greatest)))
    assert (
        sum(len(k.encode()) + len(v.encode()) for k, v in announcement.stream.attributes.items()) == MAX_ATTRIBUTE_BYTES
    )
    check_onwards(announcement.stream)
    passed_on = replace(announcement, required=("a" * 63,))
    assert len(framing.encode_envelope(encode_announcement(passed_on))) <= framing.MAX_ENVELOPE_BYTES


@pytest.mark.parametrize("name_chars", [1, 40, 63])
def test_required_names_are_cut_to_what_fits(name_chars: int) -> None:
    announcement = decode_announcement(plain(type="x" * NAME_MAX_CHARS, attr={"a": "b" * 256}))
    required = tuple(f"{i:02}".rjust(name_chars, "a") for i in range(60))
    envelope = encode_announcement(replace(announcement, required=required))
    assert len(framing.encode_envelope(envelope)) <= framing.MAX_ENVELOPE_BYTES
    assert tuple(envelope["owed"]) == required[: len(envelope["owed"])]
    assert len(envelope["owed"]) == MAX_STRINGS if name_chars <= 40 else len(envelope["owed"]) > 40


@pytest.mark.parametrize("count", [0, 1, 48, 49, 500])
def test_required_names_travel_in_as_many_parts_as_it_takes(count: int) -> None:
    announcement = decode_announcement(plain(type="x" * NAME_MAX_CHARS, attr={f"{i}": "b" * 200 for i in range(5)}))
    announcement = replace(announcement, required=tuple(f"{i:03}".rjust(63, "a") for i in range(count)))
    parts = [
        decode_announcement(framing.decode_envelope(framing.encode_envelope(e)))
        for e in announcement_parts(announcement)
    ]
    assert [part.more for part in parts] == [True] * (len(parts) - 1) + [False]
    assert tuple(name for part in parts for name in part.required) == announcement.required
    assert replace(parts[-1], required=announcement.required) == announcement
    assert len(parts) <= 1 + count // 20


@pytest.mark.parametrize("fields", [{"type": "std_msgs/Str\u00efng"}, {"hash": "\U0001f916"}])
def test_what_is_not_ascii_is_not_passed_on(fields: dict[str, object]) -> None:
    stream = decode_announcement(plain(**fields)).stream
    with pytest.raises(WireError, match="something else than ASCII"):
        check_onwards(stream)


def test_check_stream_says_what_no_peer_would_take() -> None:
    stream = decode_announcement(plain()).stream
    check_stream(stream)
    with pytest.raises(UsageError, match="/robot/odom cannot be announced: envelope key 'depth' must be an integer"):
        check_stream(StreamInfo(stream.id, stream.info, replace(stream.spec, depth=MAX_DEPTH + 1)))
    with pytest.raises(UsageError, match="cannot be announced"):
        check_stream(StreamInfo(stream.id, stream.info, stream.spec, {"a": "x" * 300}))


def test_definition_hash() -> None:
    text = "float64 x  # é\n"
    assert definition_hash("") == ""
    assert definition_hash(text) == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_text_is_the_same_for_every_receiver() -> None:
    """Newer versions of Python know more characters as printable. What any of them knows not to be is refused, and what
    none of them knows yet is taken."""
    for code in range(0x110000):
        character = chr(code)
        category = unicodedata.category(character)
        if category != "Cn":
            taken = framing._is_text(character, 1)
            assert taken == character.isprintable(), f"U+{code:04X} of category {category}"
    assert framing._is_text("\u0378", 1)
    assert not framing._is_text("a\nb", 10) and not framing._is_text("\ufffe", 1)
