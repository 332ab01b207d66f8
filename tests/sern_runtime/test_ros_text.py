"""Definitions from peers: the same types as the parser of rosbags makes, in linear time, and nothing out of bounds."""

import sys
from collections.abc import Callable
from types import FrameType

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sern_client.endpoints import conversion
from sern_client.frames import FramePrefixer
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_text, ros_types

SEP = ros_text.SEPARATOR
HEADER = f"{SEP}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
STORES = [Stores.ROS1_NOETIC, Stores.ROS2_JAZZY]


@pytest.mark.parametrize("store", STORES)
def test_shipped_types_are_read_as_rosbags_reads_them(store: Stores) -> None:
    types = get_typestore(store)
    for name in list(types.fielddefs)[::4]:
        text = types.generate_msgdef(name, ros_version=1 if store is Stores.ROS1_NOETIC else 2)[0]
        parsed = ros_text.parse(name, text)
        assert parsed == get_types_from_msg(text, name)
        ros_text.check_size(name, parsed)


@pytest.mark.parametrize(
    "text",
    [
        "int32 x # a comment\n\n# another\n  float64[] y\n",
        "int32 A=1\nint32 B = -0x1F # sixteen\nint32 C=010\nuint8 D=0b101\nfloat32 E=1.5e3\nbool F=true\nfloat64 G=3\n",
        "string A=hello # world\nstring B='quo\\'ted'\nstring C=\"\"\n",
        "string<=5 a\nstring<=5[<=3] b\nint32[<=7] c\nfloat64[36] d\nint32 e 5\nstring f 'x'\nint32[] g [1, 2]\n",
        "Header header\ntime t\nduration[] d\nOther other\nother_msgs/Thing[2] things\na/msg/B c\n",
        f"A a\n{SEP}\nMSG: my_msgs/A\nB b\n{SEP}\nMSG: my_msgs/B\nint32 x\n{SEP}\nMSG: other_msgs/msg/C\n",
        "", "\n", "@verbatim\nint32 class\n",
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["my_msgs/msg/T", "my_msgs/action/T_Goal"])
def test_texts_are_read_as_rosbags_reads_them(text: str, name: str) -> None:
    assert ros_text.parse(name, text) == get_types_from_msg(text, name)


DEEP = (
    "B0 x\n" + "".join(f"{SEP}\nMSG: evil/B{i}\nB{i + 1} x\n" for i in range(60)) + f"{SEP}\nMSG: evil/B60\nint32 x\n"
)
WIDE = "B0[10] x\n" + "".join(f"{SEP}\nMSG: evil/B{i}\nB{i + 1}[10] x\n" for i in range(9)) + f"{SEP}\nMSG: evil/B9\n"
TWICE = "B0 x\nB0 y\n" + "".join(f"{SEP}\nMSG: evil/B{i}\nB{i + 1} x\nB{i + 1} y\n" for i in range(25))
TOO_LARGE = {
    "blank lines": "\n" * 10_000 + "int32 x\n",
    "characters": "#" * 300_000,
    "a line": "int32 " + " " * 5_000 + "x\n",
    "fields": "".join(f"int32 x{number}\n" for number in range(ros_text.MAX_MEMBERS + 1)),
    "types": "".join(f"{SEP}\nMSG: evil/B{number}\nint32 x\n" for number in range(300)),
    "an array of strings": "string[50000] x\n",
    "an array of numbers": "uint8[4294967295] x\n",
    "arrays in arrays": WIDE,
    "twice as many in each": TWICE + f"{SEP}\nMSG: evil/B25\nint32 x\n",
    "deep": DEEP,
    "a long name": "int32 " + "a" * 200 + "\n",
    "digits": "int32 A=" + "9" * 3_000 + "\n",
}
IDL = f"{SEP}\nIDL: evil/msg/A\nmodule evil {{ module msg {{"
UNREADABLE = {
    "digit type name": f"std_msgs/Header header\nevil/2bad x\n{SEP}\nMSG: evil/2bad\nint32 y\n",
    "digit package": f"2evil/Bad x\n{SEP}\nMSG: 2evil/Bad\nint32 y\n",
    "inf constant": "float64 BIG=1e999\nint32 x\n",
    "nan constant": "float64 BIG=nan\nint32 x\n",
    "5000 digit array": "int32[" + "9" * 4000 + "] x\n",
    "negative array": "int32[-1] x\n",
    "huge array": "int32[99999999999999999999] x\n",
    "no slash in MSG": f"int32 x\n{SEP}\nMSG: bad\nint32 y\n",
    "slashes": f"int32 x\n{SEP}\nMSG: ////\nint32 y\n",
    "no name": f"int32 x\n{SEP}\n",
    "fields of one name": "int32 class\nint32 class_\n",
    "self reference": "A x\n",
    "mutual": f"B x\n{SEP}\nMSG: evil/B\nA y\n",
    "junk": "not { a definition",
    "nul": "int32 x\0\n",
    "no bound": "int32[<=] x\n",
    "a constant array": "int32[2] A=5\n",
    "two values": "int32 A=5 6\n",
    "wstring": "wstring{ x\n",
    "idl empty": f"{SEP}\nIDL: evil/msg/A\n",
    "idl junk": f"{SEP}\nIDL: evil/msg/A\nmodule evil {{",
    "idl other": f"{SEP}\nIDL: evil/msg/A\nmodule evil {{ module msg {{ struct B {{ long x; }}; }}; }};\n",
    "idl shifts": f"{IDL} struct A {{ long x[1<<1<<29]; }}; }}; }};\n",
    "idl arrays": f"{IDL} struct A {{ long x{'[2]' * 300}; }}; }}; }};\n",
}
ACCEPTED = {
    "crlf": "int32 x\r\n",
    "surrogate": "# \udcff\nint32 x\n",
    "keyword": "int32 class\nint32 lambda\n",
    "dunder field": "int32 x__init__\nint32 mro\n",
    "idl": (
        f'{SEP}\nIDL: evil/msg/A\n// a comment\n#include "x.idl"\nmodule evil {{ module msg {{ module A_Constants {{\n'
        '@verbatim (language="comment", text="a;)" "b") const long X = 5; const double Y = 1e999; };\n'
        '@verbatim (language="comment", text="a }") struct A {\n'
        '@unit (value="m") long x; sequence<double, 3> y; }; }; };\n'
    ),
}
USES: dict[str, Callable[[str, Encoding], object]] = {
    "hash": lambda text, encoding: ros_types.hash_of("evil/msg/A", text, encoding),
    "resolve": lambda text, encoding: ros_types.resolve("evil/msg/A", text, encoding),
    "convert": lambda text, encoding: conversion.converted(
        TopicInfo(TopicName("/evil"), "evil/msg/A", encoding, "", text),
        Encoding.CDR if encoding is Encoding.ROS1 else Encoding.ROS1,
    ),
}


def calls_of(action: Callable[[], object]) -> int:
    """How many functions are called and lines entered: what a definition costs, whatever the machine is doing."""
    count = 0

    def trace(frame: FrameType, event: str, arg: object) -> None:
        nonlocal count
        count += 1

    before = sys.getprofile()
    sys.setprofile(trace)
    try:
        action()
    except ConfigError:
        pass
    finally:
        sys.setprofile(before)
    return count


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("use", list(USES))
@pytest.mark.parametrize("name", [*TOO_LARGE, *UNREADABLE])
def test_what_is_out_of_bounds_is_the_documented_error_and_cheap(name: str, use: str, encoding: Encoding) -> None:
    text = (TOO_LARGE | UNREADABLE)[name]
    ros_types.typestore(Encoding.ROS1), ros_types.typestore(Encoding.CDR)
    with pytest.raises(ConfigError) as caught:
        USES[use](text, encoding)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    if name in TOO_LARGE:
        assert "too large" in str(caught.value)
    assert calls_of(lambda: USES[use](text, encoding)) < 150_000  # 10 ms
    # A prefixer of frames leaves such a topic's bodies as they are, and counts them.
    prefixer = FramePrefixer("robot/")
    rewrite = prefixer.incoming(TopicInfo(TopicName("/evil"), "evil/msg/A", encoding, "", text))
    assert rewrite is not None
    assert rewrite(b"body") == b"body"
    assert prefixer.unreadable == 1


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("name", list(ACCEPTED))
def test_odd_but_right(name: str, encoding: Encoding) -> None:
    if name == "idl" and encoding is Encoding.ROS1:
        return  # ROS 1 has none
    resolved = ros_types.resolve("evil/msg/A", ACCEPTED[name], encoding)
    message = ros_types.new_in(resolved.store, resolved.name)
    assert resolved.store.deserialize_cdr(resolved.store.serialize_cdr(message, resolved.name), resolved.name)


def test_the_largest_that_is_accepted_costs_little() -> None:
    fields = "".join(f"geometry_msgs/Pose2D[] some_name_{number}\n" for number in range(ros_text.MAX_MEMBERS - 3))
    text = fields + "#" * 60_000 + "\n" * 5_000 + f"{SEP}\nMSG: geometry_msgs/Pose2D\nfloat64 x\nfloat64 y\nfloat64 z\n"
    for encoding in (Encoding.ROS1, Encoding.CDR):
        ros_types.typestore(encoding)
        assert calls_of(lambda: ros_types.resolve("evil/msg/A", text, encoding)) < 400_000  # noqa: B023


def test_code_is_generated_only_for_what_is_read_and_not_for_much() -> None:
    text = "".join(f"int32 x{number}\n" for number in range(ros_types.MAX_GENERATED_FIELDS + 1))
    resolved = ros_types.resolve("evil/msg/Many", text, Encoding.ROS1)
    assert not list(resolved.store.types)
    below = "".join(f"{SEP}\nMSG: evil/B{number}\nint32 x\n" for number in range(ros_types.MAX_GENERATED_TYPES))
    types = ros_types.resolve(
        "evil/msg/Types", "".join(f"B{n} x{n}\n" for n in range(ros_types.MAX_GENERATED_TYPES)) + below, Encoding.ROS1
    )
    with pytest.raises(ConfigError, match="9 types in all"):
        ros_types.new_in(types.store, types.name)
    with pytest.raises(ConfigError, match="up to 300 are read"):
        ros_types.new_in(resolved.store, resolved.name)


def test_a_type_of_its_own_keeps_only_what_it_uses() -> None:
    resolved = ros_types.resolve("evil/msg/Own", "std_msgs/Header header\nint32 x\n" + HEADER, Encoding.ROS1)
    assert set(resolved.store.fielddefs) == {
        "evil/msg/Own", "std_msgs/msg/Header", "builtin_interfaces/msg/Time",
    }  # fmt: skip
