"""Names of topics, clients and namespaces: which are allowed, and how local and global ones belong together."""

import re
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName, TopicName

NAME_MAX_CHARS: Final = 255
"""Longest topic name; ROS 2 middleware allows no more."""
# ROS 1 lets a later part of a name start with a digit, ROS 2 does not; a name that either accepts is accepted.
_NAME: Final = re.compile(r"/[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z0-9_]+)*")
_CLIENT_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,62}")


def name_problem(name: str) -> str | None:
    """What is wrong with `name` as an absolute ROS topic name, as a phrase, or None."""
    if len(name) > NAME_MAX_CHARS:
        return f"is longer than {NAME_MAX_CHARS} characters"
    if not name.startswith("/"):
        return "must start with '/'"
    if not _NAME.fullmatch(name):
        return "is not a ROS name: letters, digits and '_' between single '/', no '/' at the end"
    return None


def topic_name(name: str) -> TopicName:
    """`name` as a checked TopicName; UsageError when it is not an absolute ROS name."""
    problem = name_problem(name)
    if problem is not None:
        raise UsageError(f"topic name {name[:80]!r} {problem}")
    return TopicName(name)


def is_client_name(name: str) -> bool:
    return _CLIENT_NAME.fullmatch(name) is not None


PEER_SIGN: Final = "@"
"""How the name of another relay begins where clients are called by their names; no client's does."""


def peer_name(relay: str) -> ClientName:
    """What another relay is called where clients are called by their names."""
    return ClientName(PEER_SIGN + relay)


def is_peer(name: str) -> bool:
    """Whether it is the name of another relay."""
    return name.startswith(PEER_SIGN)


def client_name(name: str) -> ClientName:
    """`name` as a checked ClientName; UsageError otherwise."""
    if not is_client_name(name):
        raise UsageError(f"client name {name[:80]!r} must be a lower-case letter, then up to 62 of a-z, 0-9, '_'")
    return ClientName(name)


def normal_namespace(namespace: str) -> str:
    """A namespace as `/` or `/part/part`; a missing leading slash is added. UsageError when it is no ROS name."""
    if namespace == "/":
        return namespace
    return topic_name(namespace if namespace.startswith("/") else "/" + namespace)


def to_global(local: TopicName, namespace: str) -> TopicName:
    """The name that other sites use for this site's `local` topic. `namespace` is normal (`normal_namespace`)."""
    return local if namespace == "/" else TopicName(namespace + local)


def in_namespace(name: TopicName, namespace: str) -> bool:
    """True when the global `name` lies in `namespace`; the namespace `/` holds every name."""
    return namespace == "/" or name.startswith(namespace + "/")


def to_local(name: TopicName, namespace: str) -> TopicName:
    """What this site calls the global `name`: without its own namespace; other sites' names stay as they are."""
    if namespace == "/" or not name.startswith(namespace + "/"):
        return name
    return TopicName(name[len(namespace) :])


def plain_type(type_name: str) -> str:
    """`geometry_msgs/msg/Twist` (ROS 2) as `geometry_msgs/Twist` (ROS 1): one spelling to compare types by."""
    return type_name.replace("/msg/", "/", 1)
