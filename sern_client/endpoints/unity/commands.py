"""What scenes ask for and what they are told: frames whose destination begins with `__` and whose body is JSON."""

import json
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from sern_client.endpoints.unity.frames import frame
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import Encoding

VERSION: Final = "v0.7.0"
"""The version of the protocol. Unity takes what begins with `v0.7.`."""
MAX_SRV_ID: Final = 2**31 - 1
"""Numbers of calls are signed in Unity."""

SUBSCRIBE: Final = "__subscribe"
REMOVE_SUBSCRIBER: Final = "__remove_subscriber"
PUBLISH: Final = "__publish"
REMOVE_PUBLISHER: Final = "__remove_publisher"
ROS_SERVICE: Final = "__ros_service"
REMOVE_ROS_SERVICE: Final = "__remove_ros_service"
UNITY_SERVICE: Final = "__unity_service"
REMOVE_UNITY_SERVICE: Final = "__remove_unity_service"
REQUEST: Final = "__request"
RESPONSE: Final = "__response"
TOPIC_LIST: Final = "__topic_list"
HANDSHAKE: Final = "__handshake"
WARN: Final = "__warn"
ERROR: Final = "__error"
LOG: Final = "__log"

_WITH_TYPE: Final = (SUBSCRIBE, PUBLISH, ROS_SERVICE, UNITY_SERVICE)
_WITH_TOPIC: Final = (REMOVE_SUBSCRIBER, REMOVE_PUBLISHER, REMOVE_ROS_SERVICE, REMOVE_UNITY_SERVICE)
_WITH_NUMBER: Final = (REQUEST, RESPONSE)
_KNOWN: Final = frozenset((*_WITH_TYPE, *_WITH_TOPIC, *_WITH_NUMBER, TOPIC_LIST))
_MAX_SHOWN: Final = 80


class UnknownCommandError(WireError):
    """A command that nobody knows here; whoever said it may go on."""


class Command(NamedTuple):
    """What a scene asks for; what a command has not is empty. `topic` is a topic or service as the scene spells it,
    `type_name` is `package/Name`."""

    kind: str
    topic: str = ""
    type_name: str = ""
    srv_id: int = 0
    latch: bool = False


def parse(kind: str, body: bytes) -> Command:
    """WireError when the body does not belong to the command, UnknownCommandError when there is none of that name. Keys
    that nobody needs here are not looked at: releases of the connector differ in them."""
    if kind not in _KNOWN:
        raise UnknownCommandError(f"{shown(kind)} is no command that is known here")
    try:
        given = json.loads(body.rstrip(b"\0").decode() or "{}")
    except (ValueError, RecursionError):
        raise WireError(f"{kind}: its body is not JSON") from None
    if not isinstance(given, dict):
        raise WireError(f"{kind}: its body is no JSON object")
    if kind in _WITH_NUMBER:
        return Command(kind, srv_id=_number(kind, given))
    if kind == TOPIC_LIST:
        return Command(kind)
    topic = _text(kind, given, "topic")
    if kind in _WITH_TOPIC:
        return Command(kind, topic)
    latch = given.get("latch", False)
    if not isinstance(latch, bool):
        raise WireError(f"{kind}: latch is neither true nor false")
    return Command(kind, topic, _text(kind, given, "message_name"), latch=latch)


def _text(kind: str, given: dict[str, Any], key: str) -> str:
    value = given.get(key)
    if not isinstance(value, str):
        raise WireError(f"{kind}: {key} is no text")
    return value


def _number(kind: str, given: dict[str, Any]) -> int:
    value = given.get("srv_id")
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) > MAX_SRV_ID:
        raise WireError(f"{kind}: srv_id is no number of 32 bits")
    return value


def shown(text: str) -> str:
    """Text of a scene as a log line or a console may show it: short, and nothing that moves a cursor."""
    return repr(text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "...")


def command(kind: str, **given: object) -> bytes:
    """A command for Unity as one piece."""
    return b"".join(frame(kind, json.dumps(given, separators=(",", ":")).encode()))


def handshake(encoding: Encoding) -> bytes:
    """What Unity must hear first: who we are, and whose bodies these are."""
    metadata = json.dumps({"protocol": "ROS1" if encoding is Encoding.ROS1 else "ROS2"})
    return command(HANDSHAKE, version=VERSION, metadata=metadata)


def topic_list(topics: Sequence[str], types: Sequence[str]) -> bytes:
    """Names, and the type of each as `package/Name`."""
    return command(TOPIC_LIST, topics=topics, types=types)
