"""ROS 2 names as DDS carries them: topics get a prefix, types a `dds_` module, hashes go into USER_DATA.

/odom                    rt/odom
/set_bool (a service)    rq/set_boolRequest, rr/set_boolReply
nav_msgs/msg/Odometry    nav_msgs::msg::dds_::Odometry_
RIHS01_…                 typehash=RIHS01_…;     (REP 2016)
"""

from enum import StrEnum
from typing import Final, NamedTuple

from sern_client.endpoints.zenoh.names import dds_type as type_to_dds
from sern_client.endpoints.zenoh.names import ros_type
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import TopicName

__all__ = ["DISCOVERY_TOPIC", "SERN_ENCLAVE", "SERN_KEY", "Role", "RosName", "cut", "from_dds", "read_user_data"]
__all__ += ["to_dds", "type_from_dds", "type_to_dds", "user_data"]

DISCOVERY_TOPIC: Final = "ros_discovery_info"
"""Which nodes a participant has: rmw_dds_common/msg/ParticipantEntitiesInfo."""
SERN_KEY: Final = "sern"
"""This key stands in the USER_DATA of our participants: other SERN endpoints know by it what came over a link
already."""
SERN_ENCLAVE: Final = "/sern"
"""The enclave of our nodes, which stands there too: endpoints of kind `rclpy` can say and see no more than that."""


class Role(StrEnum):
    """What a DDS topic is to ROS 2."""

    TOPIC = "rt"
    REQUEST = "rq"
    REPLY = "rr"


_SUFFIX: Final = {Role.TOPIC: "", Role.REQUEST: "Request", Role.REPLY: "Reply"}


class RosName(NamedTuple):
    """A ROS name and what its DDS topic is for; of a service, the name is the service's."""

    role: Role
    name: TopicName


def to_dds(name: str, role: Role = Role.TOPIC) -> str:
    return role + name + _SUFFIX[role]


def from_dds(topic: str) -> RosName | None:
    """None for a topic that is not of ROS 2, or has a name that ROS does not allow."""
    prefix, slash, rest = topic.partition("/")
    if not slash or prefix not in set(Role):
        return None
    role = Role(prefix)
    suffix = _SUFFIX[role]
    if not rest.endswith(suffix) or len(rest) == len(suffix):
        return None
    name = TopicName("/" + rest.removesuffix(suffix))
    return None if name_problem(name) else RosName(role, name)


def type_from_dds(type_name: str) -> str | None:
    """The way back from `type_to_dds`; None for a type that ROS 2 did not name."""
    try:
        return ros_type(type_name)
    except WireError:
        return None


def cut(text: str, most_chars: int = 200) -> str:
    """A peer's text as it is said and kept: of one that is longer than `most_chars`, beginning and end."""
    if len(text) <= most_chars:
        return text
    end = most_chars // 3
    return f"{text[: most_chars - end - 3]}...{text[-end:]}"


def user_data(**values: str) -> bytes:
    """`key=value;` pairs as ROS 2 writes them into USER_DATA."""
    return "".join(f"{key}={value};" for key, value in values.items()).encode()


def read_user_data(data: bytes) -> dict[str, str]:
    """The pairs in USER_DATA; what does not read as one is left out."""
    pairs = (part.partition("=") for part in data.decode("utf-8", "replace").split(";"))
    return {key: value for key, sign, value in pairs if sign}
