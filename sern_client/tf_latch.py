"""Static transforms for late joiners: what several publishers said on /tf_static, as one message.

A static transform is published once and holds for ever, and every publisher keeps only its own last message for those
who join later. Where one publisher speaks for several (a bridge), it must keep all of them. A transform is known by its
pair of frames; the newest of a pair counts, and is last in the message, because a listener believes the last parent it
heard of.
"""

from collections.abc import Hashable
from typing import Any, Final

from sern_core.types import Encoding
from sern_runtime import ros_types

TF_STATIC: Final = "/tf_static"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
MAX_TRANSFORMS: Final = 10_000
"""Static transforms kept at most, the newest; robots have tens to hundreds."""


def is_static_tf(name: str, type_name: str) -> bool:
    """Whether a topic carries static transforms: /tf_static, in any namespace, of the type that belongs to it."""
    return name.endswith(TF_STATIC) and ros_types.canonical(type_name) == TF_TYPE


class TfLatch:
    """All transforms of all sources. A source is whatever tells publishers apart."""

    def __init__(self, encoding: Encoding) -> None:
        self._encoding = encoding
        self._kept: dict[tuple[str, str], tuple[Hashable, Any]] = {}
        self._last: tuple[Hashable, bytes] | None = None  # while there is only one message, it goes as it came

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, source: Hashable, body: bytes) -> bytes:
        """Take a message; all that is known now, as one message: the very same bytes when it says everything.

        ConfigError when the bytes are no TFMessage; nothing has changed then.
        """
        transforms = ros_types.deserialise(body, TF_TYPE, self._encoding).transforms
        for transform in transforms:
            pair = (_bare(transform.header.frame_id), _bare(transform.child_frame_id))
            self._kept.pop(pair, None)
            self._kept[pair] = (source, transform)
        while len(self._kept) > MAX_TRANSFORMS:
            del self._kept[next(iter(self._kept))]
        self._last = (source, body) if len(self._kept) == len(transforms) else None
        return self.merged() or body

    def drop(self, source: Hashable) -> None:
        """Forget what a source said that nobody has said since."""
        self._kept = {pair: kept for pair, kept in self._kept.items() if kept[0] != source}
        if self._last is not None and self._last[0] == source:
            self._last = None

    def merged(self) -> bytes | None:
        """All that is known, as one message; None while nothing is."""
        if not self._kept:
            return None
        if self._last is not None:
            return self._last[1]
        message = ros_types.new(TF_TYPE, self._encoding, transforms=[transform for _, transform in self._kept.values()])
        return ros_types.serialise(message, TF_TYPE, self._encoding)


def _bare(frame_id: str) -> str:
    return frame_id.removeprefix("/")
