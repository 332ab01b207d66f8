"""Transforms as cross-reality objects (paper, "Distribution of ROS Data", idea 2).

Of every stream of transforms (/tf, /tf_static, in any namespace) each pair of frames is an object of kind `transform`,
owned by the stream's client:

    id            tf:<parent>><child>@<client>
    type          geometry_msgs/msg/TransformStamped
    attributes    parent, child, static ("true" or "false"), topic
    value         JSON, {"translation": [x, y, z], "rotation": [x, y, z, w]}: metres, unit quaternion
    ros_stamp_ns  the transform's own stamp; wall_ns and seq those of the message

Messages only wait here; they are read at most `RATE_HZ` times a second for each stream, outside their way to the
subscribers. Of a faster stream the newest `MAX_WAITING` are read each time. What cannot be taken is counted by client
and reason in `refused`, and the first of each is logged.
"""

import json
import logging
import math
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from sern_core.errors import ConfigError, RefusedError
from sern_core.message import Message, StreamId, StreamInfo
from sern_core.objects import ObjectRegistry
from sern_core.rules import plain_type
from sern_core.types import ClientName, Encoding, ObjectKind
from sern_runtime import ros_types
from sern_runtime.clock import now
from sern_runtime.loop import Timer
from sern_runtime.optional import OptionalParts

RATE_HZ: Final = 5.0
MAX_WAITING: Final = 64
"""Messages of one stream that wait to be read: more publishers than a robot has on /tf_static."""
MAX_BODY_BYTES: Final = 64 * 2**10
"""About 500 transforms."""
MAX_PAIRS: Final = 1_000
"""Pairs of frames of one client."""
MAX_REFUSED: Final = 4_096
OTHER_CLIENT: Final = ClientName("other")
"""Clients and reasons that are counted apart; under which name the others are."""

_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
_STREAMS: Final = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage"})  # the older one has the same layout
_log = logging.getLogger(__name__)


class _Stream:
    """A stream of transforms: what waits, and the objects it wrote last."""

    __slots__ = ("due_s", "ids", "info", "waiting")

    def __init__(self, info: StreamInfo) -> None:
        self.info = info
        self.waiting: deque[Message] = deque(maxlen=MAX_WAITING)
        self.ids: set[str] = set()
        self.due_s = -math.inf


class TransformObjects:
    """Keeps the registry's transforms up to date. `close` once."""

    def __init__(
        self,
        registry: ObjectRegistry,
        *,
        clock: Callable[[], float] = now,
        parts: OptionalParts | None = None,
    ) -> None:
        self._parts = parts or OptionalParts("objects")
        self.refused: dict[tuple[ClientName, str], int] = {}
        """By client and reason: undecodable, too_large, not_finite, too_many_transforms, or what the registry says."""
        self._registry = registry
        self._clock = clock
        self._streams: dict[StreamId, _Stream] = {}
        self._writers: dict[str, StreamId] = {}  # object -> the stream that wrote it last
        self._pairs: dict[ClientName, int] = {}
        self._timer = Timer(self._read_due, clock=clock)

    @property
    def failures(self) -> int:
        """Readings that failed by a fault of ours."""
        return self._parts.failures["objects"]

    def close(self) -> None:
        self._timer.cancel()

    def reads(self, stream: StreamInfo) -> bool:
        """Whether it is a stream of transforms."""
        return plain_type(stream.info.type_name) in _STREAMS and stream.info.encoding is not Encoding.RAW

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """Any message of any stream."""
        known = self._streams.get(stream.id)
        if known is None:
            if not self.reads(stream):
                return
            known = self._streams[stream.id] = _Stream(stream)
        if len(message.body) > MAX_BODY_BYTES:
            self._refuse(stream, "too_large", f"{len(message.body)} bytes; up to {MAX_BODY_BYTES} are read")
            return
        known.waiting.append(message)
        if len(known.waiting) == 1:
            due_s = max(now, known.due_s)
            if self._timer.deadline_s is None or due_s < self._timer.deadline_s:
                self._timer.arm(due_s)

    def stream_removed(self, stream: StreamInfo) -> None:
        """Any stream has ended: its transforms are gone."""
        known = self._streams.pop(stream.id, None)
        for object_id in known.ids if known is not None else ():
            if self._writers.get(object_id) == stream.id:
                del self._writers[object_id]
                self._pairs[stream.id.origin] -= 1
                if not self._pairs[stream.id.origin]:
                    del self._pairs[stream.id.origin]
                self._registry.delete(object_id, owner=stream.id.origin)

    def _read_due(self) -> None:
        now = self._clock()
        next_s = math.inf
        for known in self._streams.values():
            if known.waiting and known.due_s <= now:
                known.due_s = now + 1.0 / RATE_HZ
                with self._parts.survive("objects"):
                    self._read(known, now)
                known.waiting.clear()
            elif known.waiting:
                next_s = min(next_s, known.due_s)
        if next_s < math.inf:
            self._timer.arm(next_s)

    def _read(self, known: _Stream, now: float) -> None:
        """Newest first, so that of each pair only the latest is written."""
        stream = known.info
        seen: set[str] = set()
        for message in reversed(known.waiting):
            try:
                transforms = ros_types.deserialise(message.body, _MESSAGE, stream.info.encoding).transforms
            except ConfigError as error:
                self._refuse(stream, "undecodable", str(error))
                continue
            for transform in reversed(transforms):
                parent, child = transform.header.frame_id, transform.child_frame_id
                object_id = f"tf:{parent}>{child}@{stream.id.origin}"
                if object_id not in seen:
                    seen.add(object_id)
                    self._put(known, object_id, parent, child, transform, message, now)

    def _put(
        self, known: _Stream, object_id: str, parent: str, child: str, transform: Any, message: Message, now: float
    ) -> None:
        stream = known.info
        owner = stream.id.origin
        move, turn = transform.transform.translation, transform.transform.rotation
        numbers = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
        if not all(map(math.isfinite, numbers)):
            self._refuse(stream, "not_finite", f"{parent} to {child} is {numbers}")
            return
        new = object_id not in self._writers
        if new and self._pairs.get(owner, 0) >= MAX_PAIRS:
            self._refuse(stream, "too_many_transforms", f"{owner} has {MAX_PAIRS} pairs of frames, which is the limit")
            return
        value = {"translation": numbers[:3], "rotation": numbers[3:]}
        stamp = transform.header.stamp
        static = stream.spec.latched or stream.id.topic.endswith("/tf_static")
        try:
            self._registry.put(
                object_id,
                owner=owner,
                kind=ObjectKind.TRANSFORM,
                type_name="geometry_msgs/msg/TransformStamped",
                attributes={
                    "parent": parent,
                    "child": child,
                    "static": "true" if static else "false",
                    "topic": stream.id.topic,
                },
                value=json.dumps(value, separators=(",", ":")).encode(),
                seq=message.seq,
                ros_stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
                wall_ns=message.stamp_ns,
                now=now,
            )
        except RefusedError as refusal:
            self._refuse(stream, refusal.code, str(refusal))
            return
        if new:
            self._pairs[owner] = self._pairs.get(owner, 0) + 1
        self._writers[object_id] = stream.id
        known.ids.add(object_id)

    def _refuse(self, stream: StreamInfo, code: str, text: str) -> None:
        key = (stream.id.origin, code)
        if key not in self.refused and len(self.refused) >= MAX_REFUSED:
            key = (OTHER_CLIENT, code)
        if key not in self.refused:
            _log.warning("%s of %s: a transform is not taken as an object: %s", stream.id.topic, stream.id.origin, text)
        self.refused[key] = self.refused.get(key, 0) + 1
