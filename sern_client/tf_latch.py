"""Static transforms for late joiners: what several publishers said on /tf_static, as one message.

A static transform is published once and holds for ever, and every publisher keeps only its own last message for those
who join later. Where one publisher speaks for several (a bridge), it must keep all of them. A transform is known by its
pair of frames; the newest of a pair counts, and is last in the message, because a listener believes the last parent it
heard of.
"""

from collections.abc import Hashable
from typing import Final

from sern_core.summaries.transforms import Transform, read_transforms, write_transforms
from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

TF_STATIC: Final = "/tf_static"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
MAX_TRANSFORMS: Final = 2_000
"""Static transforms kept at most, the newest, and read of one message (8 ms); robots have tens to hundreds."""


def is_static_tf(name: str, type_name: str) -> bool:
    """Whether a topic carries static transforms: /tf_static, in any namespace, of the type that belongs to it."""
    return name.endswith(TF_STATIC) and ros_types.canonical(type_name) == TF_TYPE


class TfLatch:
    """All transforms of all sources. A source is whatever tells publishers apart."""

    def __init__(self, encoding: Encoding) -> None:
        self._encoding = encoding
        self._kept: dict[tuple[str, str], tuple[Hashable, Transform]] = {}
        self._last: tuple[Hashable, bytes] | None = None  # while there is only one message, it goes as it came
        self._merged: bytes | None = None  # what `merged` made last; None: not made since something changed

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, source: Hashable, body: bytes) -> bytes:
        """Take a message; all that is known now, as one message: the very same bytes when it says everything.

        ConfigError when the bytes are no TFMessage of at most MAX_TRANSFORMS; nothing has changed then.
        """
        self.keep(source, body)
        return self.merged() or body

    def keep(self, source: Hashable, body: bytes) -> None:
        """Take a message as `add` does, without the answer, for whoever asks for the whole later."""
        try:
            transforms = read_transforms(body, self._encoding, at_most=MAX_TRANSFORMS)
        except BodyError as error:
            raise ConfigError(f"type {TF_TYPE}: {error}") from None
        for transform in transforms:
            self._kept.pop(transform.pair, None)
            self._kept[transform.pair] = (source, transform)
        while len(self._kept) > MAX_TRANSFORMS:
            del self._kept[next(iter(self._kept))]
        self._last = (source, body) if len(self._kept) == len(transforms) else None
        self._merged = None

    def drop(self, source: Hashable) -> None:
        """Forget what a source said that nobody has said since."""
        self._kept = {pair: kept for pair, kept in self._kept.items() if kept[0] != source}
        self._merged = None
        if self._last is not None and self._last[0] == source:
            self._last = None

    def merged(self) -> bytes | None:
        """All that is known, as one message; None while nothing is."""
        if not self._kept:
            return None
        if self._last is not None:
            return self._last[1]
        if self._merged is None:
            self._merged = write_transforms([transform for _, transform in self._kept.values()], self._encoding)
        return self._merged
