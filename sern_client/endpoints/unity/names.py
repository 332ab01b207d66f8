"""How topics and types are called in a scene and here."""

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import TopicName
from sern_runtime import ros_types


def local_name(spelling: str) -> TopicName:
    """A name as a scene spells it, with the slash that many leave out. ConfigError for what is no name."""
    try:
        return topic_name(spelling if spelling.startswith("/") else "/" + spelling)
    except UsageError as error:
        raise ConfigError(str(error)) from None


def our_type(type_name: str, kind: str = "msg") -> str:
    """`std_msgs/String` -> `std_msgs/msg/String`, or of another kind. ConfigError for what is no type."""
    package, _, name = ros_types.canonical(type_name).split("/")
    return type_name if type_name.count("/") == 2 else f"{package}/{kind}/{name}"


def their_type(type_name: str) -> str:
    """`std_msgs/msg/String` -> `std_msgs/String`."""
    package, _, name = type_name.rpartition("/")
    return f"{package.partition('/')[0]}/{name}"


def same_type(one: str, other: str) -> bool:
    """Whether two names are of one type. A scene does not say of what kind it is."""
    return their_type(one) == their_type(other)
