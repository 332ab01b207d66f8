"""What rmw_zenoh calls ROS 2 things: keys of data, tokens of the graph, quality of service, attachments.

| thing | written as |
|---|---|
| data of a topic or service | `DOMAIN/NAME/TYPE/HASH` |
| graph | `@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NODE_NAME[/NAME/TYPE/HASH/QOS]` |
| quality of service | `RELIABILITY:DURABILITY:HISTORY,DEPTH:DEADLINE:LIFESPAN:LIVELINESS`, defaults left out |
| attachment of each message | sequence i64, source time i64 ns, 16, 16 bytes of publisher id; little endian |

In tokens `/` is written `%`. Types are as DDS has them: `nav_msgs::msg::dds_::Odometry_`.
"""

import re
import secrets
import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import TopicName

SPACE: Final = "@ros2_lv"
GID_BYTES: Final = 16
ENCLAVE: Final = "/sern"
"""The security enclave that our nodes say they are in: SERN endpoints know each other by it, also those of `rclpy`."""
GID_MARK: Final = b"sern"
"""How the ids of publishers of SERN endpoints begin."""
DEFAULT_DEPTH: Final = 10
"""The depth of ROS 2's default profile, which an empty one stands for."""
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_DDS_TYPE: Final = re.compile(r"([A-Za-z]\w*)::(msg|srv|action)::dds_::([A-Za-z]\w*)_", re.ASCII)
_RELIABLE, _BEST_EFFORT = "1", "2"
_TRANSIENT_LOCAL: Final = "1"


class Kind(StrEnum):
    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Qos:
    """What of a publisher's profile matters here."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH

    def encode(self) -> str:
        reliability = "" if self.reliable else _BEST_EFFORT
        durability = _TRANSIENT_LOCAL if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"

    @classmethod
    def decode(cls, text: str) -> "Qos":
        """WireError when it is not a profile; what is left out has its default."""
        parts = text.split(":")
        if len(parts) < 3:
            raise WireError(f"{text[:80]!r} is not a quality of service")
        kind, _, depth = parts[2].partition(",")
        try:
            number = int(depth) if depth and kind in {"", "0", "1"} else DEFAULT_DEPTH
        except ValueError:
            raise WireError(f"{text[:80]!r} is not a quality of service: depth {depth[:20]!r}") from None
        return cls(parts[0] != _BEST_EFFORT, parts[1] == _TRANSIENT_LOCAL, min(max(number, 1), 10_000))


class Entity(NamedTuple):
    """One token of the graph; `name` and what follows are empty for a node."""

    session: str
    key: str
    """Session, node and entity numbers: what tells entities apart."""
    kind: Kind
    node: str
    name: TopicName
    dds_type: str
    type_hash: str
    qos: str
    enclave: str = ""

    @property
    def bridged(self) -> bool:
        """Whether it is of a SERN endpoint, and so came over a link."""
        return self.enclave == ENCLAVE


def mangle(name: str) -> str:
    return name.replace("/", "%") if name else "%"


def demangle(name: str) -> str:
    return name.replace("%", "/")


def dds_type(type_name: str) -> str:
    """`nav_msgs/msg/Odometry` -> `nav_msgs::msg::dds_::Odometry_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(name: str) -> str:
    """`nav_msgs::msg::dds_::Odometry_` -> `nav_msgs/msg/Odometry`; WireError for anything else."""
    match = _DDS_TYPE.fullmatch(name)
    if match is None:
        raise WireError(f"{name[:80]!r} is not a ROS type as DDS writes it")
    return "/".join(match.groups())


def data_key(domain: int, name: TopicName, dds_name: str, type_hash: str) -> str:
    return f"{domain}/{name.lstrip('/')}/{dds_name}/{type_hash}"


def node_token(domain: int, session: str, node: str, enclave: str) -> str:
    return f"{SPACE}/{domain}/{session}/0/0/{Kind.NODE}/{mangle(enclave)}/%/{node}"


def entity_token(
    domain: int, session: str, entity: int, kind: Kind, node: str, enclave: str, *,
    name: TopicName, dds_name: str, type_hash: str, qos: Qos,
) -> str:  # fmt: skip
    place = f"{SPACE}/{domain}/{session}/0/{entity}/{kind}/{mangle(enclave)}/%/{node}"
    return f"{place}/{mangle(name)}/{dds_name}/{type_hash}/{qos.encode()}"


def parse_token(text: str) -> Entity:
    """WireError for what is no token of a graph: anybody on the network can declare one."""
    parts = text.split("/")
    if len(parts) not in {9, 13} or parts[0] != SPACE:
        raise WireError(f"{text[:120]!r} is not a token of the ROS graph")
    try:
        kind = Kind(parts[5])
    except ValueError:
        raise WireError(f"{text[:120]!r} names an unknown kind of entity") from None
    if (kind is Kind.NODE) != (len(parts) == 9):
        raise WireError(f"{text[:120]!r} has not the parts that a {kind} has")
    node = demangle(parts[7]).rstrip("/") + "/" + demangle(parts[8]).lstrip("/")
    key = "/".join(parts[2:5])
    enclave = demangle(parts[6])
    if kind is Kind.NODE:
        return Entity(parts[2], key, kind, node, TopicName(""), "", "", "", enclave)
    name = demangle(parts[9])
    problem = name_problem(name)
    if problem is not None:
        raise WireError(f"name {name[:80]!r} {problem}")
    return Entity(parts[2], key, kind, node, TopicName(name), parts[10], parts[11], parts[12], enclave)


def new_gid(enclave: str) -> bytes:
    """A new id for a publisher of ours."""
    return (GID_MARK if enclave == ENCLAVE else bytes(len(GID_MARK))) + secrets.token_bytes(GID_BYTES - len(GID_MARK))


def pack_attachment(seq: int, stamp_ns: int, gid: bytes) -> bytes:
    return _ATTACHMENT.pack(seq, stamp_ns, GID_BYTES, gid)


class Attachment(NamedTuple):
    seq: int
    stamp_ns: int
    gid: bytes


def unpack_attachment(data: bytes) -> Attachment:
    """WireError when it is not the attachment that rmw_zenoh puts beside a message."""
    if len(data) != _ATTACHMENT.size or data[16] != GID_BYTES:
        raise WireError(f"an attachment of {len(data)} bytes is not rmw_zenoh's")
    seq, stamp_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(seq, stamp_ns, gid)
