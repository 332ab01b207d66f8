"""Frame ids across sites: `client.frame_prefix` is put before them on the way out and taken off on the way in.

Two robots that both call their frames `odom` and `base_link` must not share them at the far side, so with the prefix
`jackal1/` everybody else sees `jackal1/odom`. What comes back in such a frame (a goal in `jackal1/map`) is in the
robot's own terms again before it is published; frames of others stay as they are.

A frame id is `frame_id` of a `std_msgs/Header` or any field called `child_frame_id`, wherever it is in a message, so
`tf2_msgs/TFMessage` is covered as well. Empty ids stay empty, ids that begin with the prefix keep it. A leading slash
means nothing to tf2 and is dropped where a prefix is added.
"""

import logging
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from sern_core.errors import ConfigError
from sern_core.message import TopicInfo
from sern_core.types import Encoding
from sern_runtime import ros_types

Rewrite = Callable[[bytes], bytes]
"""Body in, body out; the same object when nothing in it changed."""

_HEADER: Final = "std_msgs/msg/Header"
_log = logging.getLogger(__name__)


class FrameIds(NamedTuple):
    """Where the frame ids of a type are: its own fields, and fields that hold one or many messages with some."""

    own: tuple[str, ...] = ()
    one: tuple[tuple[str, "FrameIds"], ...] = ()
    many: tuple[tuple[str, "FrameIds"], ...] = ()


NO_FRAME_IDS: Final = FrameIds()


def find_frame_ids(type_name: str, store: Typestore) -> FrameIds:
    """The frame ids of a canonical type; KeyError when it, or a type it uses, is not in `store`."""
    return _find(type_name, store, {})


def _find(type_name: str, store: Typestore, known: dict[str, FrameIds]) -> FrameIds:
    if type_name in known:
        return known[type_name]
    known[type_name] = NO_FRAME_IDS  # also what a type that contains itself is taken for
    own: list[str] = []
    one: list[tuple[str, FrameIds]] = []
    many: list[tuple[str, FrameIds]] = []
    for name, description in store.fielddefs[type_name][1]:
        if description[0] == Nodetype.BASE:
            if description[1][0] == "string" and (
                name == "child_frame_id" or (name == "frame_id" and type_name == _HEADER)
            ):
                own.append(name)
            continue
        nested, fields = (description, one) if description[0] == Nodetype.NAME else (description[1][0], many)
        if nested[0] == Nodetype.NAME:
            below = _find(str(nested[1]), store, known)
            if below != NO_FRAME_IDS:
                fields.append((name, below))
    found = FrameIds(tuple(own), tuple(one), tuple(many))
    known[type_name] = found
    return found


class FramePrefixer:
    """Makes the rewriters of one client's topics. `unreadable` counts messages passed on with their ids unchanged
    because they could not be read; the first of each topic is logged."""

    def __init__(self, prefix: str | None) -> None:
        self.prefix = prefix or ""
        self.unreadable = 0

    def outgoing(self, info: TopicInfo) -> Rewrite | None:
        """For a topic that leaves this site; None: bodies go as they are."""
        return self._rewriter(info, self._add) if self.prefix else None

    def incoming(self, info: TopicInfo) -> Rewrite | None:
        """For a topic that comes to this site; None: bodies go as they are."""
        return self._rewriter(info, self._remove) if self.prefix else None

    def _add(self, frame_id: str) -> str:
        bare = frame_id.removeprefix("/")
        return frame_id if not bare or bare.startswith(self.prefix) else self.prefix + bare

    def _remove(self, frame_id: str) -> str:
        bare = frame_id.removeprefix("/")
        return bare[len(self.prefix) :] if bare.startswith(self.prefix) and bare != self.prefix else frame_id

    def _rewriter(self, info: TopicInfo, change: Callable[[str], str]) -> Rewrite | None:
        type_name = info.type_name
        try:
            type_name = ros_types.canonical(info.type_name)
            store = ros_types.typestore(info.encoding)
            if info.definition:
                ros_types.register(type_name, info.definition, info.encoding)
            frame_ids = find_frame_ids(type_name, store)
        except (ConfigError, KeyError) as error:
            if info.encoding is Encoding.RAW:
                return None  # no ROS message: there are no frame ids to speak of
            return self._unread(info, ros_types.one_line(error))
        return None if frame_ids == NO_FRAME_IDS else self._reader(info, type_name, frame_ids, change)

    def _unread(self, info: TopicInfo, why: str) -> Rewrite:
        _log.warning("%s: frame ids stay without %r: %s is not known here (%s)", info.name, self.prefix,
                     info.type_name, why)  # fmt: skip

        def rewrite(body: bytes) -> bytes:
            self.unreadable += 1
            return body

        return rewrite

    def _reader(self, info: TopicInfo, type_name: str, frame_ids: FrameIds, change: Callable[[str], str]) -> Rewrite:
        encoding = info.encoding
        warned = False

        def rewrite(body: bytes) -> bytes:
            nonlocal warned
            try:
                message = ros_types.deserialise(body, type_name, encoding)
            except ConfigError as error:
                self.unreadable += 1
                if not warned:
                    warned = True
                    _log.warning("%s: frame ids stay as they are: %s", info.name, error)
                return body
            if not _apply(message, frame_ids, change):
                return body
            return ros_types.serialise(message, type_name, encoding)

        return rewrite


def _apply(message: Any, frame_ids: FrameIds, change: Callable[[str], str]) -> bool:
    """Change the frame ids in a message object; says whether any is different now."""
    changed = False
    for name in frame_ids.own:
        before = getattr(message, name)
        after = change(before)
        if after != before:
            setattr(message, name, after)
            changed = True
    for name, below in frame_ids.one:
        changed |= _apply(getattr(message, name), below, change)
    for name, below in frame_ids.many:
        for item in getattr(message, name):
            changed |= _apply(item, below, change)
    return changed
