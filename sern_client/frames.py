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

from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_bodies, ros_types
from sern_runtime.ros_bodies import Plan

Rewrite = Callable[[bytes], bytes]
"""Body in, body out; the same object when nothing in it changed."""

_log = logging.getLogger(__name__)


class FramePrefixer:
    """Makes the rewriters of one client's topics. `unreadable` counts messages passed on with their ids unchanged
    because they could not be read; the first of each topic is logged."""

    def __init__(self, prefix: str | None) -> None:
        self.prefix = prefix or ""
        self.unreadable = 0

    def outgoing(self, info: TopicInfo) -> Rewrite | None:
        """Tell how bodies of a topic that leaves this site are changed; None: they go as they are."""
        return self._rewriter(info, self._add) if self.prefix else None

    def incoming(self, info: TopicInfo) -> Rewrite | None:
        """Tell how bodies of a topic that comes to this site are changed; None: they go as they are."""
        return self._rewriter(info, self._remove) if self.prefix else None

    def _add(self, frame_id: str) -> str:
        bare = frame_id.removeprefix("/")
        return frame_id if not bare or bare.startswith(self.prefix) else self.prefix + bare

    def _remove(self, frame_id: str) -> str:
        bare = frame_id.removeprefix("/")
        return bare[len(self.prefix) :] if bare.startswith(self.prefix) and bare != self.prefix else frame_id

    def _rewriter(self, info: TopicInfo, change: Callable[[str], str]) -> Rewrite | None:
        try:
            resolved = ros_types.resolve(info.type_name, info.definition, info.encoding)
            plan = ros_bodies.plan_of(resolved)
        except ConfigError as error:
            if info.encoding is Encoding.RAW:
                return None  # no ROS message: there are no frame ids to speak of
            return self._unread(info, ros_types.one_line(error))
        return self._reader(info, plan, change) if plan.has_frames else None

    def _unread(self, info: TopicInfo, why: str) -> Rewrite:
        _log.warning("%s: frame ids stay without %r: %s is not known here (%s)", info.name, self.prefix,
                     info.type_name, why)  # fmt: skip

        def rewrite(body: bytes) -> bytes:
            self.unreadable += 1
            return body

        return rewrite

    def _reader(self, info: TopicInfo, plan: Plan, change: Callable[[str], str]) -> Rewrite:
        encoding = info.encoding
        warned = False

        def rewrite(body: bytes) -> bytes:
            nonlocal warned
            try:
                return ros_bodies.rewrite(plan, body, encoding, change)
            except BodyError as error:
                self.unreadable += 1
                if not warned:
                    warned = True
                    _log.warning("%s: frame ids stay as they are: type %s: %d bytes do not decode: %s", info.name,
                                 plan.type_name, len(body), error)  # fmt: skip
                return body

        return rewrite
