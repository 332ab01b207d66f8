"""The bodies of an action that are the same whatever its type, and what stands before the goal, feedback or result.

In ROS 1 that is a header and a GoalID (goal) or GoalStatus (feedback, result), without padding; in ROS 2 the UUID of
the goal (goal, feedback) or an int8, its status (result), as CDR.
"""

import struct
from collections.abc import Iterable
from typing import Final, NamedTuple

from sern_client.actions import MAX_STATUSES, GoalId, goal_id
from sern_core.vocabulary.errors import ConfigError

HEAD: Final = b"\0\1\0\0"
"""The encapsulation of CDR, little endian."""
UUID_BYTES: Final = 16
NO_UUID: Final = bytes(UUID_BYTES)
"""Whatever there is, in a request to cancel."""

NONE, REJECTED, UNKNOWN_GOAL, TERMINATED = range(4)
"""Return codes of action_msgs/CancelGoal."""

_HEADER: Final = struct.Struct("<III")  # std_msgs/Header up to its frame_id: seq, stamp
_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_GOAL_INFO: Final = struct.Struct("<16siI")
_FIRST: Final = struct.Struct("<16siIb")
_NEXT: Final = struct.Struct("<16s3xiIb")
"""A GoalStatus of ROS 2 in an array. The first one's stamp is aligned as it is, that of each other one is not."""


class Stamp(NamedTuple):
    """A builtin_interfaces/Time."""

    secs: int
    nsecs: int

    @classmethod
    def of(cls, wall_ns: int) -> "Stamp":
        return cls(wall_ns // 10**9 & 0x7FFFFFFF, wall_ns % 10**9)


NO_STAMP: Final = Stamp(0, 0)


# ROS 1 ----------------------------------------------------------------------------------------------------------------


class StatusPart(NamedTuple):
    """What a feedback or a result says of its goal, and what is behind that. `status` may be any byte."""

    ident: GoalId
    status: int
    text: str
    own: bytes


def ros1_header(seq: int, stamp: Stamp) -> bytes:
    return _HEADER.pack(seq & 0xFFFFFFFF, *stamp) + _LENGTH.pack(0)


def ros1_goal(seq: int, ident: GoalId, own: bytes) -> bytes:
    """An action goal."""
    return ros1_header(seq, Stamp(ident.secs, ident.nsecs)) + ident.pack() + own


def ros1_status(ident: GoalId, status: int, text: str) -> bytes:
    """An actionlib_msgs/GoalStatus."""
    said = text.encode(errors="surrogateescape")
    return ident.pack() + bytes((status,)) + _LENGTH.pack(len(said)) + said


def ros1_statuses(seq: int, stamp: Stamp, statuses: Iterable[bytes]) -> bytes:
    """An actionlib_msgs/GoalStatusArray."""
    each = list(statuses)
    return ros1_header(seq, stamp) + _LENGTH.pack(len(each)) + b"".join(each)


def split_goal(body: bytes) -> tuple[GoalId, bytes]:
    """The id of an action goal, and the goal. ConfigError for bytes that are none."""
    ident = goal_id(body)
    return ident, body[_after_header(body) + len(ident.pack()) :]


def split_status(body: bytes) -> StatusPart:
    """Read a feedback or a result. ConfigError for bytes that are none."""
    ident = goal_id(body)
    at = _after_header(body) + len(ident.pack())
    try:
        status = body[at]
        (length,) = _LENGTH.unpack_from(body, at + 1)
    except (IndexError, struct.error):
        raise ConfigError(f"{len(body)} bytes are no feedback or result") from None
    at += 1 + _LENGTH.size
    if at + length > len(body):
        raise ConfigError(f"{len(body)} bytes are no feedback or result")
    text = body[at : at + length].decode(errors="surrogateescape")
    return StatusPart(ident, status, text, body[at + length :])


def split_cancel(body: bytes) -> GoalId:
    """Read an actionlib_msgs/GoalID. ConfigError for bytes that are none."""
    try:
        secs, nsecs = _TIME.unpack_from(body)
        (length,) = _LENGTH.unpack_from(body, _TIME.size)
    except struct.error:
        raise ConfigError(f"{len(body)} bytes are no goal id") from None
    at = _TIME.size + _LENGTH.size
    if at + length != len(body):
        raise ConfigError(f"{len(body)} bytes are no goal id")
    return GoalId(secs, nsecs, body[at:].decode(errors="surrogateescape"))


def _after_header(body: bytes) -> int:
    (length,) = _LENGTH.unpack_from(body, _HEADER.size)
    return int(_HEADER.size + _LENGTH.size + length)


# ROS 2 ----------------------------------------------------------------------------------------------------------------


class GoalInfo(NamedTuple):
    """An action_msgs/GoalInfo."""

    uuid: bytes
    stamp: Stamp


def goal_response(*, accepted: bool, stamp: Stamp) -> bytes:
    """What `send_goal` answers."""
    return HEAD + struct.pack("<?3xiI", accepted, *stamp)


def is_accepted(response: bytes) -> bool:
    """Read an answer of `send_goal`. ConfigError for bytes that are none."""
    _order(response, 5)
    return response[4] != 0


def cancel_request(goal: GoalInfo) -> bytes:
    return HEAD + _GOAL_INFO.pack(goal.uuid, *goal.stamp)


def split_cancel_request(request: bytes) -> GoalInfo:
    """ConfigError for bytes that are none."""
    uuid, secs, nsecs = struct.unpack_from(f"{_order(request, 28)}16siI", request, 4)
    return GoalInfo(uuid, Stamp(secs, nsecs))


def cancel_response(code: int, goals: Iterable[GoalInfo] = ()) -> bytes:
    each = [_GOAL_INFO.pack(goal.uuid, *goal.stamp) for goal in goals]
    return HEAD + struct.pack("<b3xI", code, len(each)) + b"".join(each)


def cancel_code(response: bytes) -> int:
    """The return code of an answer of `cancel_goal`. ConfigError for bytes that are none."""
    _order(response, 5)
    return int(struct.unpack_from("b", response, 4)[0])


def result_request(uuid: bytes) -> bytes:
    return HEAD + uuid


def request_uuid(request: bytes) -> bytes:
    """Whose result is asked for. ConfigError for bytes that are no such request."""
    _order(request, 4 + UUID_BYTES)
    return request[4 : 4 + UUID_BYTES]


def ros2_statuses(statuses: Iterable[tuple[GoalInfo, int]]) -> bytes:
    """An action_msgs/GoalStatusArray."""
    each = [
        (_NEXT if number else _FIRST).pack(goal.uuid, *goal.stamp, status)
        for number, (goal, status) in enumerate(statuses)
    ]
    return HEAD + _LENGTH.pack(len(each)) + b"".join(each)


def split_statuses(body: bytes) -> list[tuple[bytes, int]]:
    """UUID and status of each goal in an action_msgs/GoalStatusArray. ConfigError for bytes that are none, and for more
    than MAX_STATUSES of `sern_client.actions`."""
    (count,) = struct.unpack_from(f"{_order(body, 8)}I", body, 4)
    if count > MAX_STATUSES:
        raise ConfigError(f"it mentions {count} goals, more than {MAX_STATUSES}")
    end = 8 + count * _NEXT.size - (_NEXT.size - _FIRST.size) * bool(count)
    if len(body) < end:
        raise ConfigError(f"{len(body)} bytes are no action_msgs/msg/GoalStatusArray")
    starts = (8, *range(8 + _FIRST.size, end, _NEXT.size)) if count else ()
    ends = range(8 + _FIRST.size, end + 1, _NEXT.size)
    return [(body[at : at + UUID_BYTES], body[last - 1]) for at, last in zip(starts, ends, strict=True)]


def _order(body: bytes, least: int) -> str:
    """The byte order of a CDR body. ConfigError for what is none, or is shorter."""
    if len(body) < least or body[0] != 0 or body[1] > 1:
        raise ConfigError(f"{len(body)} bytes cannot be read")
    return "<" if body[1] else ">"
