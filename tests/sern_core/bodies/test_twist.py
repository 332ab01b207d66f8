"""Velocity commands as bytes, against those that rosbags makes."""

import struct
from math import inf, nan
from typing import Any

import pytest

from sern_core.bodies.twist import MAX_TWIST_BYTES, TwistBody
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
ENCODINGS = (Encoding.ROS1, Encoding.CDR)


def vector(encoding: Encoding, x: float, y: float = 0.0, z: float = 0.0) -> Any:
    return ros_types.new("geometry_msgs/msg/Vector3", encoding, x=x, y=y, z=z)


def twist(encoding: Encoding, linear: tuple[float, ...], angular: tuple[float, ...]) -> Any:
    return ros_types.new(TWIST, encoding, linear=vector(encoding, *linear), angular=vector(encoding, *angular))


def body(encoding: Encoding, frame: str | None, linear: tuple[float, ...], angular: tuple[float, ...]) -> bytes:
    said = twist(encoding, linear, angular)
    if frame is None:
        return ros_types.serialise(said, TWIST, encoding)
    header = ros_types.header(1_700_000_000_900_000_000, frame, encoding, 7)
    return ros_types.serialise(ros_types.new(STAMPED, encoding, header=header, twist=said), STAMPED, encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("frame", [None, "", "a", "base_link", "jackal1/base_link"])
def test_a_command_is_read_and_slowed_down(encoding: Encoding, frame: str | None) -> None:
    kind = TWIST if frame is None else STAMPED
    whole = body(encoding, frame, (3.0, -4.0, 0.0), (0.0, 0.0, -1.5))
    read = TwistBody.read(kind, encoding, whole)
    assert read is not None and read.linear_mps == 5.0 and read.angular_radps == 1.5
    slower = ros_types.deserialise(read.scaled(0.5, 0.25), kind, encoding)
    said = slower if frame is None else slower.twist
    assert (said.linear.x, said.linear.y, said.angular.z) == (1.5, -2.0, -0.75)
    if frame is not None:
        assert slower.header.frame_id == frame
        assert (slower.header.stamp.sec, slower.header.stamp.nanosec) == (1_700_000_001, 150_000_000)
    still = read.scaled(0.0, 0.0)
    assert struct.unpack("<6d", still[-48:]) == (0.0,) * 6 and b"\x80" not in still[-48:], "not even -0"
    assert read.scaled(1.0, 0.0) == whole


def test_a_stamp_of_zero_stays_and_one_at_its_end_too() -> None:
    for seconds, nanoseconds in ((0, 0), (2**31 - 1, 999_999_999)):
        whole = bytearray(body(Encoding.CDR, "b", (1.0,), (0.0,)))
        struct.pack_into("<iI", whole, 4, seconds, nanoseconds)
        read = TwistBody.read(STAMPED, Encoding.CDR, bytes(whole))
        assert read is not None and read.scaled(1.0, 5.0) == whole


def test_either_order_of_bytes_is_read() -> None:
    big = b"\0\0\0\0" + struct.pack(">6d", 1.0, 0, 0, 0, 0, 2.0)
    read = TwistBody.read(TWIST, Encoding.CDR, big)
    assert read is not None and (read.linear_mps, read.angular_radps) == (1.0, 2.0)
    assert read.scaled(0.5, 0.0) == b"\0\0\0\0" + struct.pack(">6d", 0.5, 0, 0, 0, 0, 1.0)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_what_is_no_velocity_is_not_read(bad: float) -> None:
    for place in range(6):
        values = [0.0] * 6
        values[place] = bad
        assert TwistBody.read(TWIST, Encoding.ROS1, struct.pack("<6d", *values)) is None


def test_whatever_bytes_come_are_read_or_not_and_raise_nothing() -> None:
    whole = {encoding: body(encoding, "base_link", (1.0,), (0.0,)) for encoding in ENCODINGS}
    for encoding, right in whole.items():
        for length in range(len(right)):
            assert TwistBody.read(STAMPED, encoding, right[:length]) is None
        assert TwistBody.read(STAMPED, encoding, right + b"\0") is None
        at = 12
        assert TwistBody.read(STAMPED, encoding, right[:at] + b"\xff\xff\xff\xff" + right[at + 4 :]) is None
        assert TwistBody.read(TWIST, encoding, right) is None
        assert TwistBody.read("std_msgs/msg/String", encoding, right) is None
        long = body(encoding, "f" * MAX_TWIST_BYTES, (1.0,), (0.0,))
        assert TwistBody.read(STAMPED, encoding, long) is None
    assert TwistBody.read(TWIST, Encoding.RAW, struct.pack("<6d", *[0.0] * 6)) is None
    assert TwistBody.read(TWIST, Encoding.CDR, b"\0\x07\0\0" + struct.pack("<6d", *[0.0] * 6)) is None
