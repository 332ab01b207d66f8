"""Whatever definition or body a client sends has a bounded price for whoever converts it: `price.py` says which."""

import random
import struct
from contextlib import suppress
from functools import partial
from typing import Final

import pytest

from sern_client import actions
from sern_client.action_conversion import types
from sern_client.action_conversion.bodies import split_statuses
from sern_client.endpoints import conversion
from sern_client.frames import FramePrefixer
from sern_client.tf_latch import TfLatch
from sern_core.summaries import transforms
from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services, ros_text, ros_types
from tests.exploring import seeds
from tests.fuzz.price import Input, Make, within_budget, within_memory

INPUTS: Final[dict[str, Make]] = {}
ACTIONS: Final[dict[str, Make]] = {}
"""The definitions again, each as that of all parts of an action."""

SEP: Final = ros_text.SEPARATOR
_serial = iter(range(10**9))


def definition(label: str, text: str) -> None:
    """A definition, read for everything that is done with one. A name of its own each time: no cache knows it."""
    for encoding in (Encoding.ROS1, Encoding.CDR):
        other = Encoding.CDR if encoding is Encoding.ROS1 else Encoding.ROS1

        def make(encoding: Encoding = encoding, other: Encoding = other) -> Input:
            name = f"evil/msg/T{next(_serial)}"
            info = TopicInfo(TopicName("/evil"), name, encoding, "", text.replace("evil/msg/A", name))

            def take() -> object:
                for use in (
                    lambda: conversion.converted(info, other),
                    lambda: FramePrefixer("robot/").incoming(info),
                    lambda: ros_services.resolve(name.replace("/msg/", "/srv/"), info.definition, encoding),
                ):
                    try:
                        use()
                    except ConfigError:
                        continue
                return None

            return Input(len(text), take)

        INPUTS[f"definition: {label}, {encoding}"] = make
        ACTIONS[f"{label}, {encoding}"] = partial(parts, text, encoding)


def parts(text: str, encoding: Encoding) -> Input:
    """The definition as that of all parts of an action, whose types are made in steps."""
    name = f"T{next(_serial)}"
    same = dict.fromkeys(types.PARTS, text.replace("evil/msg/A", f"evil/msg/{name}Goal"))
    names = types.Names(f"evil/{name}", f"evil/action/{name}", None)
    steps = types.in_steps(names, same, same if encoding is Encoding.ROS1 else {})

    def step() -> bool:
        try:
            return next(steps, steps) is None
        except ConfigError:
            return False

    return Input(3 * len(text), step, rest=step)


definition("blank lines", "\n" * 2**18)
definition("few blank lines", "\n" * 7_900 + "int32 x\n")
definition("spaces", " " * 2**18)
definition("comments", ("#" * 30 + "\n") * 7_900)
definition("fields", "".join(f"float64[] x{n}\n" for n in range(ros_text.MAX_MEMBERS)))
definition("too many fields", "".join(f"float64[] x{n}\n" for n in range(7_000)))
definition("constants", "".join(f"string X{n}='{n}'\n" for n in range(ros_text.MAX_MEMBERS)))
definition(
    "types",
    "".join(f"B{n} x{n}\n" for n in range(255))
    + "".join(f"{SEP}\nMSG: evil/B{n}\nint32 x\nHeader y\n" for n in range(254)),
)
definition("arrays of texts", "string[4900] x\n")
definition("arrays of numbers", "float64[1048576] x\n" * 1)
definition("huge arrays", "uint8[4294967295] x\n")
definition("in each other", "B0 x\n" + "".join(f"{SEP}\nMSG: evil/B{n}\nB{n + 1} x\nB{n + 1} y\n" for n in range(30)))


def of_one_large_type(users: int, fields: tuple[str, str]) -> str:
    """Types that are nothing but sequences for who looks at the first, each with 4500 fields by way of others."""
    text = "".join(f"C{n}[] c{n}\n" for n in range(users))
    text += f"{SEP}\nMSG: evil/L0\n" + "".join(f"{fields[n % 2]} s{n}\n" for n in range(9))
    for level, times in enumerate((8, 8, 7)):
        text += f"{SEP}\nMSG: evil/L{level + 1}\n" + "".join(f"L{level} f{n}\n" for n in range(times))
    return text + "".join(f"{SEP}\nMSG: evil/C{n}\nL3 b\n" for n in range(users))


definition("sequences of one large type", of_one_large_type(220, ("string", "string")))
definition("sequences of one large type of numbers", of_one_large_type(220, ("uint8", "float64")))
definition("a few of one large type", of_one_large_type(1, ("uint8", "float64")))
definition(
    "types that are known",
    "".join(f"C{n}[] c{n}\n" for n in range(50))
    + "".join(f"{SEP}\nMSG: evil/C{n}\n" + "".join(f"nav_msgs/Odometry x{k}\n" for k in range(18)) for n in range(50)),
)
definition("a long number", "int32 X=" + "9" * 100_000 + "\n")
definition("quotes", ("string X='" + "\\\\" * 1_900 + "\n") * 60)
definition("underscores", ("a_" * 2_000 + "\n") * 60)
definition("headings", f"{SEP}\nMSG: a/B\n" * 2_700)
IDL: Final = f"{SEP}\nIDL: evil/msg/A\nmodule evil {{ module msg {{ struct A {{ "
definition("IDL members", IDL + "".join(f"long x{n}; " for n in range(200)) + "}; }; };\n")
definition("IDL annotations", IDL + '@verbatim (language="comment", text="abc") ' * 60 + "long x; }; }; };\n")
definition("IDL open quotes", IDL + '@a("' * 60_000)
definition("IDL shifts", IDL + "long x[1<<1<<29]; }; }; };\n")
definition("IDL dimensions", IDL + "long x" + "[2]" * 300 + "; }; }; };\n")
definition("IDL parentheses", IDL + "long x[" + "(" * 400 + "; }; }; };\n")
definition("IDL names", IDL + "a::" * 900 + "b x; }; }; };\n")
definition("IDL comments", IDL + "/*" * 100_000)

# --- bodies ----------------------------------------------------------------------------------------------------------

HEAD: Final = struct.pack("<IIII", 0, 0, 0, 0)
HEADER_TEXT: Final = f"{SEP}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"


def body(label: str, type_name: str, text: str, data: bytes) -> None:
    """A body of ROS 1 that is converted, and whose frame ids change."""

    def make() -> Input:
        info = TopicInfo(TopicName("/evil"), type_name, Encoding.ROS1, "", text)
        _, convert = conversion.converted(info, Encoding.CDR)
        rewrite = FramePrefixer("robot/").incoming(info)
        assert rewrite is not None

        def take() -> object:
            try:
                return convert(data), rewrite(data)
            except ConfigError:
                return rewrite(data)

        return Input(len(data), take)

    INPUTS[f"body: {label}"] = make


EMPTY: Final = f"Header header\nEmpty[] x\n{SEP}\nMSG: evil/Empty\n{HEADER_TEXT}"
body("messages without fields", "evil/msg/A", EMPTY, HEAD + struct.pack("<I", 2**32 - 1))
body("many of them", "evil/msg/A", EMPTY, HEAD + struct.pack("<I", 20_000))
body(
    "texts",
    "evil/msg/A",
    "Header header\nstring[] x\n" + HEADER_TEXT,
    HEAD + struct.pack("<I", 40_000) + bytes(160_000),
)
body("numbers", "evil/msg/A", "Header header\nfloat64[] x\n" + HEADER_TEXT, HEAD + b"\xff\xff\xff\xff")
body("array", "evil/msg/A", "Header header\nfloat64[1048576] x\n" + HEADER_TEXT, HEAD)
body(
    "transforms",
    "tf2_msgs/msg/TFMessage",
    "",
    struct.pack("<I", 60_000) + (bytes(12) + struct.pack("<I", 0) * 2 + bytes(56)) * 60_000,
)
body(
    "poses",
    "nav_msgs/msg/Path",
    "",
    HEAD + struct.pack("<I", 4_700) + (HEAD + bytes(56)) * 4_700,
)


def transforms_of(count: int) -> None:
    def make() -> Input:
        data = struct.pack("<I", count) + (bytes(12) + struct.pack("<I", 0) * 2 + bytes(56)) * count

        def take() -> object:
            latch, merger = TfLatch(Encoding.ROS1), transforms.TransformMerger(Encoding.ROS1)
            for use in (lambda: latch.add("a", data), lambda: merger.add(data, now=0.0)):
                try:
                    use()
                except (BodyError, ConfigError):
                    continue
            return latch, merger

        return Input(len(data), take)

    INPUTS[f"body: {count} transforms to merge"] = make


transforms_of(1_900)
transforms_of(10**5)


def statuses_of(count: int) -> None:
    def make() -> Input:
        data = HEAD + struct.pack("<I", count) + bytes(17) * count

        def take() -> object:
            try:
                return actions.mentioned_goals(data)
            except ConfigError:
                return None

        return Input(len(data), take)

    def make_ros2() -> Input:
        data = b"\0\1\0\0" + struct.pack("<I", count) + bytes(28) * count

        def take() -> object:
            try:
                return split_statuses(data)
            except ConfigError:
                return None

        return Input(len(data), take)

    INPUTS[f"body: {count} goals in a status"] = make
    INPUTS[f"body: {count} goals in a status of ROS 2"] = make_ros2


statuses_of(actions.MAX_STATUSES)
statuses_of(240_000)


@pytest.fixture(scope="module", autouse=True)
def warm() -> None:
    """What is loaded once in a process is no input's price."""
    for encoding in (Encoding.ROS1, Encoding.CDR):
        ros_types.typestore(encoding)
    INPUTS["definition: fields, ros1"]().take()


@pytest.mark.parametrize("name", list(INPUTS))
def test_an_input_holds_the_loop_for_a_bounded_time(name: str) -> None:
    assert within_budget(INPUTS[name])


@pytest.mark.parametrize("name", list(INPUTS))
def test_an_input_adds_a_bounded_multiple_of_its_size_to_memory(name: str) -> None:
    assert within_memory(INPUTS[name])


@pytest.mark.parametrize("name", list(ACTIONS))
def test_types_of_an_action_have_the_price_of_their_parts(name: str) -> None:
    assert within_budget(ACTIONS[name])
    assert within_memory(ACTIONS[name])


WORDS: Final = (
    "int32 x\n", "string[] y\n", "B[3] z\n", "Header h\n", "float64 X=1e9\n", "\n", " ", "=" * 80 + "\n",
    "MSG: evil/B\n", "IDL: evil/msg/A\n", "module evil { module msg { struct A { long x; }; }; };", "[", "]", "<=", "#",
    "'", '"', "\\", "a/", "time t\n", "string<=9[<=9] s\n", "uint8[1000000] b\n", "@", "\t", "\r\n", "\0", "9" * 50,
    "B b\n",
)  # fmt: skip


def fuzzed_definition(rng: random.Random) -> Make:
    text = "".join(rng.choice(WORDS) * rng.choice((1, 1, 1, 2, 50, 900)) for _ in range(rng.randrange(40)))
    encoding = rng.choice((Encoding.ROS1, Encoding.CDR))
    data = rng.randbytes(rng.randrange(64)) + bytes(rng.randrange(2000))

    def take() -> object:
        """All that is done with a definition and a body of its type; nothing but the documented error comes of it."""
        info = TopicInfo(TopicName("/evil"), "evil/msg/A", encoding, "", text)
        rewrite = FramePrefixer("robot/").incoming(info)
        if rewrite is not None:
            rewrite(data)
        with suppress(ConfigError):
            _, convert = conversion.converted(info, Encoding.CDR if encoding is Encoding.ROS1 else Encoding.ROS1)
            convert(data)
        return None

    return lambda: Input(len(text), take)


@pytest.mark.parametrize("seed", seeds(120))
def test_any_definition_has_a_bounded_price(seed: int) -> None:
    make = fuzzed_definition(random.Random(seed))
    assert within_budget(make)
    if seed % 8 == 0:  # counting memory is slow
        assert within_memory(make)
