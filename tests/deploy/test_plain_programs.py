"""What the plain programs make of bytes: both types, both encodings, every alignment, and what is neither."""

import runpy
import struct
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from sern_core.vocabulary.types import Encoding, PriorityClass
from sern_runtime import ros_geometry, ros_types
from sern_runtime.feed import FeedHeader
from tests.plain_programs import CASES, PLAIN, STAND_IN, compiled

POSITION_M: Final = (1.5, -2.25, 1e6 / 3)
Position = tuple[float, float, float] | None
Decode = Callable[[Sequence[bytes]], list[Position]]


def pose_stamped(encoding: Encoding, frame_id: str, seq: int) -> bytes:
    name = "geometry_msgs/msg/PoseStamped"
    header = ros_types.header(1_700_000_000_123_456_789, frame_id, encoding, seq)
    message = ros_types.new(name, encoding, header=header, pose=ros_geometry.pose(encoding, *POSITION_M, yaw_rad=1.0))
    return ros_types.serialise(message, name, encoding)


def odometry(encoding: Encoding, frame_id: str, seq: int, child_frame_id: str) -> bytes:
    def new(kind: str, **fields: Any) -> Any:
        return ros_types.new(kind, encoding, **fields)

    vector = new("geometry_msgs/msg/Vector3", x=7.0, y=8.0, z=9.0)
    twist = new("geometry_msgs/msg/Twist", linear=vector, angular=vector)
    name = "nav_msgs/msg/Odometry"
    message = new(
        name,
        header=ros_types.header(1_700_000_000_123_456_789, frame_id, encoding, seq),
        child_frame_id=child_frame_id,
        pose=new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=ros_geometry.pose(encoding, *POSITION_M),
            covariance=np.full(36, 0.5),
        ),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.full(36, 0.25)),
    )
    return ros_types.serialise(message, name, encoding)


def right() -> list[bytes]:
    """Names of every length modulo eight; among the seqs, those that look like an encapsulation."""
    names = ["abcdefghi"[:length] for length in range(10)]
    bodies = []
    for encoding in Encoding.ROS1, Encoding.CDR:
        for seq in 0, 7, 256, 65536 + 256:
            bodies += [pose_stamped(encoding, frame, seq) for frame in names]
            bodies += [odometry(encoding, frame, seq, child) for frame in names for child in names]
    return bodies


def wrong() -> list[bytes]:
    """Neither type: cut or longer bodies, lengths that lead out of them, another type."""
    whole = [
        make
        for encoding in (Encoding.ROS1, Encoding.CDR)
        for make in (pose_stamped(encoding, "odom", 1), odometry(encoding, "odom", 1, "base_link"))
    ]
    bodies = [body[:length] for body in whole for length in {*range(25), len(body) // 2, len(body) - 1}]
    bodies += [body + b"\0" for body in whole]
    bodies += [body[:12] + b"\xff\xff\xff\xff" + body[16:] for body in whole]
    bodies.append(struct.pack("<6d", *[0.0] * 6))  # a Twist
    return bodies


def by_python(bodies: Sequence[bytes]) -> list[Position]:
    position_m = runpy.run_path(str(PLAIN / "feed.py"))["position_m"]

    def decoded(body: bytes) -> Position:
        try:
            x, y, z = position_m(body)
        except (ValueError, struct.error):
            return None
        return x, y, z

    return [decoded(body) for body in bodies]


def answers(directory: Path, kind: str, values: Sequence[bytes]) -> list[str]:
    """What Feed.cs makes of each value, in words."""
    command = compiled(directory, STAND_IN, CASES, "-main:Cases")
    asked = "".join(f"{kind} {value.hex()}\n" for value in values)
    ended = subprocess.run(command, input=asked, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    lines = ended.stdout.splitlines()
    assert len(lines) == len(values)
    return lines


@pytest.fixture(params=["python", "csharp"])
def decode(request: pytest.FixtureRequest, tmp_path: Path) -> Decode:
    def by_csharp(bodies: Sequence[bytes]) -> list[Position]:
        def parsed(line: str) -> Position:
            if line == "refused":
                return None
            x, y, z = map(float, line.split())
            return x, y, z

        return [parsed(line) for line in answers(tmp_path, "body", bodies)]

    return by_python if request.param == "python" else by_csharp


def test_a_position_is_found_whatever_the_names(decode: Decode) -> None:
    bodies = right()
    assert len(bodies) == 2 * 4 * (10 + 100)
    assert set(decode(bodies)) == {POSITION_M}


def test_what_is_neither_type_is_refused(decode: Decode) -> None:
    bodies = wrong()
    assert decode(bodies) == [None] * len(bodies)


def test_the_csharp_reads_headers(tmp_path: Path) -> None:
    headers = [
        FeedHeader(PriorityClass.CONTROL, 0, 0),
        FeedHeader(PriorityClass.STATE, 2**32 - 1, -(2**63), 2**64 - 1),
        FeedHeader(PriorityClass.BULK, 0x01020304, 2**63 - 1, 1_500),
    ]
    bad = [b"", headers[0].pack()[:-1], headers[0].pack() + b"\0", b"\2" + headers[0].pack()[1:]]
    lines = answers(tmp_path, "header", [*(header.pack() for header in headers), *bad])
    assert lines == [
        *(f"1 {int(each.priority)} {each.seq} {each.stamp_ns} {each.age_us}" for each in headers),
        *["refused"] * len(bad),
    ]


def test_feed_py_imports_nothing_of_sern() -> None:
    """Whoever copies it has pyzmq alone."""
    lines = (PLAIN / "feed.py").read_text().splitlines()
    imported = {line.split()[1] for line in lines if line.startswith(("import ", "from "))}
    assert imported == {"signal", "struct", "sys", "time", "zmq"}
