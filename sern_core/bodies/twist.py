"""Velocity commands as bytes: what a Twist or TwistStamped says, and the same command slower. Pure.

Both layouts end with six float64: linear x, y, z in m/s, angular x, y, z in rad/s. A TwistStamped has a header before
them, whose length depends on its frame id. Anything else, and what is no finite velocity, is not read at all: who asks
then falls back to the stop command.
"""

import struct
from dataclasses import dataclass
from math import hypot, isfinite
from typing import Final

from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import Encoding

MAX_TWIST_BYTES: Final = 1024
"""A larger body is not read: a frame id has a few bytes."""
TWIST_BYTES: Final = 48
NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class TwistBody:
    """A command as it came: `twist_at` is where its velocities begin, `stamp_at` where its stamp does (-1: none)."""

    body: bytes
    order: str  # of bytes, as in `struct`
    twist_at: int
    stamp_at: int
    signed: bool  # the seconds of its stamp
    linear_mps: float
    angular_radps: float

    @classmethod
    def read(cls, type_name: str, encoding: Encoding, body: bytes) -> "TwistBody | None":
        """None: the body is no Twist or TwistStamped that holds finite velocities and nothing else."""
        kind = plain_type(type_name)
        if len(body) > MAX_TWIST_BYTES or kind not in ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"):
            return None
        order = _order(encoding, body)
        if not order:
            return None
        begins = 4 if encoding is Encoding.CDR else 0
        if kind == "geometry_msgs/Twist":
            twist_at, stamp_at = begins, -1
        else:
            # ROS 1 has a sequence number before the stamp, and no padding behind the frame id.
            stamp_at = begins if encoding is Encoding.CDR else 4
            if len(body) < stamp_at + 12:
                return None
            length = int(struct.unpack_from(order + "I", body, stamp_at + 8)[0])
            twist_at = stamp_at + 12 + length
            if encoding is Encoding.CDR:
                twist_at += -(twist_at - begins) % 8
        if len(body) != twist_at + TWIST_BYTES:
            return None
        values: tuple[float, ...] = struct.unpack_from(order + "6d", body, twist_at)
        if not all(isfinite(value) for value in values):
            return None
        linear_mps, angular_radps = hypot(*values[:3]), hypot(*values[3:])
        return cls(body, order, twist_at, stamp_at, encoding is Encoding.CDR, linear_mps, angular_radps)

    def scaled(self, factor: float, elapsed_s: float) -> bytes:
        """The command with all its velocities times `factor`, `elapsed_s` after this one.

        A stamp goes on by as much, as if its sender had said it now; one of zero stays, which is "now" for those who
        read it."""
        made = bytearray(self.body)
        values: tuple[float, ...] = struct.unpack_from(self.order + "6d", made, self.twist_at)
        # + 0.0: a robot that stands is told 0, not -0.
        struct.pack_into(self.order + "6d", made, self.twist_at, *(value * factor + 0.0 for value in values))
        if self.stamp_at >= 0:
            self._move_stamp(made, elapsed_s)
        return bytes(made)

    def _move_stamp(self, made: bytearray, elapsed_s: float) -> None:
        layout = self.order + ("iI" if self.signed else "II")
        seconds, nanoseconds = struct.unpack_from(layout, made, self.stamp_at)
        if seconds == 0 and nanoseconds == 0:
            return
        seconds, nanoseconds = divmod(seconds * NS_PER_S + nanoseconds + round(elapsed_s * NS_PER_S), NS_PER_S)
        if -(2**31) <= seconds < 2**31 or (not self.signed and 0 <= seconds < 2**32):
            struct.pack_into(layout, made, self.stamp_at, seconds, nanoseconds)


def _order(encoding: Encoding, body: bytes) -> str:
    """The order of bytes, as `struct` writes it; empty: not a body of plain CDR, nor of ROS 1."""
    if encoding is Encoding.ROS1:
        return "<"
    if encoding is Encoding.CDR and len(body) >= 4 and body[0] == 0 and body[1] in (0, 1):
        return "<" if body[1] else ">"
    return ""
