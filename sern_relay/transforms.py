"""Transforms as cross-reality objects (paper, "Distribution of ROS Data", idea 2).

Of every stream of transforms (/tf, /tf_static, in any namespace) each pair of frames is an object of kind `transform`,
owned by the stream's client:

    id            tf:<parent>><child>@<client>
    type          geometry_msgs/msg/TransformStamped
    attributes    parent, child, static ("true" or "false"), topic
    value         JSON, {"translation": [x, y, z], "rotation": [x, y, z, w]}: metres, unit quaternion
    ros_stamp_ns  the transform's own stamp; wall_ns and seq those of the message

Messages only wait here; they are read at most `RATE_HZ` times a second for each stream, outside their way to the
subscribers. Of a faster stream the newest `MAX_WAITING` are read each time, up to `MAX_READ` transforms. They are read
in slices of `SLICE_COST` with a pause between them: whatever is sent, it holds the loop for some milliseconds at a time
and takes a fraction of it in all. What cannot be taken is counted by client and reason in `refused`, and the first of
each is logged. Streams of clients of another relay are read there, and their transforms come as that relay's objects.
"""

import json
import logging
import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

from sern_core.objects.registry import ObjectRegistry
from sern_core.summaries.transforms import Transform, read_transforms
from sern_core.vocabulary.errors import BodyError, RefusedError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind
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
MAX_READ: Final = 2_000
"""Transforms of one stream that are read each time, the newest; older ones are of no more interest."""
SLICE_COST: Final = 1_000
"""What is done in one turn of the loop, in transforms read (4 µs each); the message it ends in is read whole."""
PUT_COST: Final = 8
"""What it costs to write an object, in transforms read."""
PAUSE_S: Final = 0.02
"""Between two slices."""

_STREAMS: Final = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage"})  # the older one has the same layout
_log = logging.getLogger(__name__)


class _Stream:
    """A stream of transforms: what waits, and the objects it wrote last."""

    __slots__ = ("due_s", "ids", "info", "reading", "waiting")

    def __init__(self, info: StreamInfo) -> None:
        self.info = info
        self.waiting: deque[Message] = deque(maxlen=MAX_WAITING)
        self.ids: set[str] = set()
        self.due_s = -math.inf
        self.reading: Iterator[int] | None = None  # what is being read; yields what each step cost


class TransformObjects:
    """Keeps the registry's transforms up to date. `close` once."""

    def __init__(
        self,
        registry: ObjectRegistry,
        *,
        clock: Callable[[], float] = now,
        parts: OptionalParts | None = None,
        elsewhere: Callable[[StreamId], bool] = lambda _stream: False,
    ) -> None:
        """`elsewhere`: whether a stream comes from another relay."""
        self._elsewhere = elsewhere
        self._parts = parts or OptionalParts("objects")
        self.refused: dict[tuple[ClientName, str], int] = {}
        """Counts by client and reason: undecodable, too_large, not_finite, too_many_transforms, or the registry's."""
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
        return (
            plain_type(stream.info.type_name) in _STREAMS
            and stream.info.encoding is not Encoding.RAW
            and not self._elsewhere(stream.id)
        )

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """Any message of any stream."""
        known = self._streams.get(stream.id)
        if known is None:
            if not self.reads(stream):
                return
            known = self._streams[stream.id] = _Stream(stream)
        elif self._elsewhere(stream.id):
            return  # its client has gone to another relay
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
        cost = 0
        next_s = math.inf
        for known in list(self._streams.values()):
            if known.reading is None and known.waiting and known.due_s <= now and cost < SLICE_COST:
                known.due_s = now + 1.0 / RATE_HZ
                known.reading = self._read(known, list(known.waiting), now)
                known.waiting.clear()
            if known.reading is not None and cost < SLICE_COST:
                self._streams[known.info.id] = self._streams.pop(known.info.id)  # next time others go first
                while cost < SLICE_COST and known.reading is not None:
                    step: int | None = None  # as it stays when reading fails
                    with self._parts.survive("objects"):
                        step = next(known.reading, None)
                    if step is None:
                        known.reading = None
                    else:
                        cost += step
            if known.reading is not None:
                next_s = now + PAUSE_S
            elif known.waiting:
                next_s = min(next_s, max(known.due_s, now + PAUSE_S))
        if next_s < math.inf:
            self._timer.arm(next_s)

    def _read(self, known: _Stream, messages: list[Message], now: float) -> Iterator[int]:
        """Newest first, so that of each pair only the latest is written. Yields what each step cost."""
        stream = known.info
        seen: set[str] = set()
        left = MAX_READ
        for message in reversed(messages):
            try:
                transforms = read_transforms(message.body, stream.info.encoding)
            except BodyError as error:
                self._refuse(stream, "undecodable", str(error))
                yield 1
                continue
            left -= len(transforms)
            yield len(transforms)
            for transform in reversed(transforms):
                object_id = f"tf:{transform.header.frame_id}>{transform.child}@{stream.id.origin}"
                if object_id not in seen:
                    seen.add(object_id)
                    self._put(known, object_id, transform, message, now)
                    yield PUT_COST
            if left <= 0:
                return

    def _put(self, known: _Stream, object_id: str, transform: Transform, message: Message, now: float) -> None:
        stream = known.info
        owner = stream.id.origin
        parent, child = transform.header.frame_id, transform.child
        if not object_id.isascii() and not _is_text(object_id):
            self._refuse(stream, "undecodable", "a name of a frame is not UTF-8")
            return
        if not all(map(math.isfinite, (*transform.translation, *transform.rotation))):
            numbers = (*transform.translation, *transform.rotation)
            self._refuse(stream, "not_finite", f"{parent} to {child} is {numbers}")
            return
        new = object_id not in self._writers
        if new and self._pairs.get(owner, 0) >= MAX_PAIRS:
            self._refuse(stream, "too_many_transforms", f"{owner} has {MAX_PAIRS} pairs of frames, which is the limit")
            return
        value = {"translation": transform.translation, "rotation": transform.rotation}
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
                ros_stamp_ns=transform.header.stamp_ns,
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


def _is_text(name: str) -> bool:
    """Whether a name was UTF-8: `read_transforms` lets other bytes through."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
