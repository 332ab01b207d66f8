"""Names, units and closed vocabularies shared by every layer.

Units are in names throughout the project: `_s` seconds, `_ns` nanoseconds, `_bytes`, `_bps` bits per second.
Time inside the core is a float in seconds on a monotonic clock that the caller hands in as `now`.
"""

from enum import IntEnum, StrEnum
from typing import Final, NewType

TopicName = NewType("TopicName", str)
"""A ROS topic name with its leading slash, e.g. `/jackal1/odom`; global unless a docstring says local."""

ClientName = NewType("ClientName", str)
"""The name of a client daemon: `[a-z][a-z0-9_]{0,62}`; bound to a CURVE key at the relay."""


class PriorityClass(IntEnum):
    """The paper's three classes (section "Distribution of ROS Data", idea 1); lower is more urgent."""

    CONTROL = 0  # commands, pose, velocity, timing
    STATE = 1  # map corrections, obstacle summaries, selected perception outputs
    BULK = 2  # everything else: clouds, images, debug output


CLASSES: Final = tuple(PriorityClass)
CLASS_LABELS: Final = tuple(c.name.lower() for c in PriorityClass)


class Ordering(StrEnum):
    """How the scheduler orders classes: `class` is (class, -P); `paper` is Alg. prioritize as printed."""

    CLASS = "class"
    PAPER = "paper"


class Reliability(StrEnum):
    BEST_EFFORT = "best_effort"
    RELIABLE = "reliable"


class Durability(StrEnum):
    VOLATILE = "volatile"
    TRANSIENT_LOCAL = "transient_local"


class Encoding(StrEnum):
    """How a message body is serialised; bodies pass through unchanged."""

    ROS1 = "ros1"
    CDR = "cdr"
    RAW = "raw"


class ObjectKind(StrEnum):
    """The kinds of cross-reality object (paper, idea 2, "A common cross reality representation")."""

    TOPIC = "topic"
    TRANSFORM = "transform"
    NODE = "node"
    ROBOT = "robot"
    OBSTACLE = "obstacle"
    TERRAIN = "terrain"
    PATCH = "patch"
    DISCREPANCY = "discrepancy"
    COMMAND = "command"


class DropReason(StrEnum):
    """Why a message did not go on. Closed: it is a metric label, a log field and a wire value (`DROP_CODES`)."""

    LIFESPAN = "lifespan"  # older than the topic's lifespan, and not sent whole
    SUPERSEDED = "superseded"  # a newer sample of a keep-last topic took its place
    RATE_CAP = "rate_cap"  # the topic's max_rate_hz
    UNWANTED = "unwanted"  # nobody subscribes
    REFUSED = "refused"  # a reliable queue is full; the sender was told
    FORBIDDEN = "forbidden"  # access rules
    RETENTION = "retention"  # a reliable message was not delivered within its retention, nor sent whole
    STALE = "stale"  # ordering `paper`: stale in the lowest class (Alg. prioritize, line 9)
    LOST = (
        "lost"  # a receiver has fragments of a best-effort message whose others did not come; its sender counts it too
    )
    DUPLICATE = "duplicate"  # arrived more than once; not a loss
    TOO_LARGE = "too_large"  # above max_message_bytes
    UNKNOWN_CHANNEL = "unknown_channel"  # data for a stream that was never announced or was closed
    REASSEMBLY = "reassembly"  # the receiver's reassembly limit
    DISCONNECTED = "disconnected"  # the peer went away for good
    SHUTDOWN = "shutdown"  # the daemon stopped before it was sent
    QUEUE_FULL = "queue_full"  # more waits for this client at the relay than its access rule allows
    UNDECODABLE = "undecodable"  # its body cannot be decoded: damaged, above the limit, of another layout or codec
    UNCONFIRMED = "unconfirmed"  # sent whole, given up without an acknowledgement: it may have arrived
    FAULT = "fault"  # an error of the program where it was taken; it may have been acted on in part
    STORAGE = "storage"  # the recording could not take it: disk full or gone
    TOO_SLOW = "too_slow"  # the link is too slow for it to arrive whole within the topic's lifespan
    E_STOP = "e_stop"  # a command, while an e-stop is latched at the robot
    NOT_HOLDER = "not_holder"  # a command of an operator who does not hold its topic


_UNUSED_CODE: Final = 14  # a stream that comes back to its origin is not wanted there: no message is dropped for that
DROP_CODES: Final[dict[DropReason, int]] = {
    reason: code + (code >= _UNUSED_CODE) for code, reason in enumerate(DropReason, start=1)
}
DROP_REASONS: Final[dict[int, DropReason]] = {code: reason for reason, code in DROP_CODES.items()}
