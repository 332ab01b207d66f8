"""Messages, topics and streams: the plain data that moves through a hop."""

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Codec, Compression, LossyParams
from sern_core.vocabulary.types import (
    DROP_REASONS,
    ClientName,
    DropReason,
    Durability,
    Encoding,
    PriorityClass,
    Reliability,
    TopicName,
)

DEFAULT_LIFESPAN_S: Final = 1.0
"""Lifespan of a best-effort topic that no rule names; long enough for a slow link, short enough to stay useful."""
DEFAULT_COMMAND_LIFESPAN_S: Final = 0.3
"""Lifespan of class control when the rule gives none and the topic is a command (paper-independent safety choice)."""
DEFAULT_RETENTION_S: Final = 600.0
"""How long a reliable message waits for delivery before it is reported as dropped (reason `retention`)."""
DURABLE_RETENTION_S: Final = 7 * 86_400.0
"""The same of a durable topic: what outlives the machine's power may outlast a weekend."""
DEFAULT_RELIABLE_QUEUE_BYTES: Final = 32 * 2**20
"""Bytes of undelivered reliable messages a topic may hold; above it new ones are refused to the sender."""
COMMAND_TYPES: Final = frozenset({"geometry_msgs/Twist", "geometry_msgs/TwistStamped"})
"""Types whose all-zero message means "stand still": the only ones that `on_link_loss` may publish."""
KAPPA: Final = (10.0, 3.0, 1.0)
"""κ of the paper's eq. (priority_score), per class, when a rule gives no weight."""


@dataclass(frozen=True, slots=True)
class TopicSpec:
    """How one topic is treated on the link. Built from configuration at the composition root.

    `lifespan_s` None means for ever (only sensible for reliable or latched state). `max_rate_hz` None means no cap.
    """

    priority: PriorityClass = PriorityClass.BULK
    weight: float = KAPPA[PriorityClass.BULK]  # κ(t)
    reliability: Reliability = Reliability.BEST_EFFORT
    durability: Durability = Durability.VOLATILE
    depth: int = 1
    lifespan_s: float | None = DEFAULT_LIFESPAN_S
    deadline_s: float | None = None
    max_rate_hz: float | None = None
    retention_s: float = DEFAULT_RETENTION_S
    max_queue_bytes: int = DEFAULT_RELIABLE_QUEUE_BYTES
    many_writers: bool = False  # several clients may own this global name, e.g. /tf
    durable: bool = False  # reliable, and kept on disk until it is delivered
    background: bool = False  # of class bulk, and sent only while nothing else waits
    compression: Compression | None = None  # None: whatever is quickest; for the origin alone, never on the wire
    lossy: tuple[Compression, ...] = ()  # modes that may lose something; for the origin alone
    lossy_params: LossyParams = DEFAULT_LOSSY

    @property
    def reliable(self) -> bool:
        return self.reliability is Reliability.RELIABLE

    @property
    def latched(self) -> bool:
        return self.durability is Durability.TRANSIENT_LOCAL


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """What an endpoint knows about a topic: enough to advertise it, byte for byte, somewhere else.

    `type_hash` is the ROS 1 md5sum or the ROS 2 RIHS01 hash, empty when unknown; `definition` the full message
    definition text (ROS 1 concatenated .msg, or ros2msg), empty when unknown.
    """

    name: TopicName
    type_name: str
    encoding: Encoding
    type_hash: str = ""
    definition: str = ""
    latched: bool = False
    reliable: bool | None = None  # what the publisher offers; None where the middleware does not say, as below
    depth: int | None = None
    lifespan_s: float | None = None
    deadline_s: float | None = None


class StreamId(NamedTuple):
    """One publisher's sequence of messages: the unit of order, acknowledgement and replay.

    `boot` is a random 63-bit number that the origin draws once a process; a restarted origin is a new stream. Where the
    origin keeps the stream on disk (`TopicSpec.durable`) it is the store's number: the next process goes on with it.
    """

    origin: ClientName
    boot: int
    topic: TopicName


@dataclass(slots=True, eq=False)
class Message:
    """One message of a stream on its way through a hop.

    `seq` counts from 1 per stream without gaps as assigned by the origin. `stamp_ns` is the wall time at which the
    origin's endpoint took it (never used for expiry). `born_s` is its birth on *this* process's monotonic clock:
    arrival time minus the age it had gathered, so that age needs no common clock.
    A `drop_marker` has a body of one byte and stands for a reliable message that was dropped for `reason` upstream.
    `body` is encoded as `codec` says, from the origin to whoever publishes it; relays pass it on as it is.
    """

    stream: StreamId
    seq: int
    body: bytes
    stamp_ns: int
    born_s: float
    drop_marker: int = 0  # 0, or a DROP_CODES value
    replay: bool = False  # a transient_local message sent again to a late joiner
    error_s: float = 0.0  # the message may be older than `born_s` says by as much: clock offsets of the hops so far
    codec: int = Codec.NONE

    def age_s(self, now: float) -> float:
        return now - self.born_s

    @property
    def drop_reason(self) -> DropReason:
        """Why the message that this drop marker stands for was dropped."""
        return DROP_REASONS.get(self.drop_marker, DropReason.LOST)


@dataclass(slots=True)
class StreamInfo:
    """A stream as both ends of a hop know it."""

    id: StreamId
    info: TopicInfo
    spec: TopicSpec
    attributes: dict[str, str] = field(default_factory=dict)
    definition_hash: str = ""
    """The hash of its definition, as a peer announced it; empty: it has none."""
