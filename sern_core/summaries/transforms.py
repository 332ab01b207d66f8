"""tf2_msgs/TFMessage: many messages of many nodes as one.

A transform belongs to its pair of frames, (parent, child). Of /tf the newest transform of each pair since the last
message is sent, and nothing is sent twice: tf2 takes a repeated stamp for a fault. Of /tf_static every message holds
all there is, so that the last one alone is enough for whoever comes late, however many nodes publish it; there a
child has one parent, and a new one replaces the old, as in tf2's buffer.

    transforms[] {header | child_frame_id | translation (3 float64) | rotation (4 float64)}
"""

from dataclasses import dataclass
from typing import Final

from sern_core.summaries.bodies import BodyReader, BodyWriter, Header
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding

TF_TYPES: Final = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage"})  # the older one has the same layout
MAX_TRANSFORMS: Final = 4096
"""Transforms in one message, and frames that are kept, at most."""


def is_static(topic: str) -> bool:
    """Whether a topic holds transforms for ever by its name: /tf_static, in any namespace."""
    return topic.endswith("/tf_static")


@dataclass(frozen=True, slots=True)
class Transform:
    """geometry_msgs/TransformStamped: of `child` in the frame `header.frame_id`."""

    header: Header
    child: str
    translation: tuple[float, ...]
    rotation: tuple[float, ...]

    @property
    def pair(self) -> tuple[str, str]:
        """Parent and child; a leading slash means nothing to tf2."""
        return self.header.frame_id.removeprefix("/"), self.child.removeprefix("/")


def read_transforms(body: bytes, encoding: Encoding, *, at_most: int = MAX_TRANSFORMS) -> list[Transform]:
    """BodyError, also for more than `at_most`: before any of them is read."""
    reader = BodyReader(body, encoding)
    count = reader.u32()
    if count > at_most:
        raise BodyError(f"{count} transforms in one message; up to {at_most} are read")
    transforms = [Transform(reader.header(), reader.text(), reader.f64s(3), reader.f64s(4)) for _ in range(count)]
    reader.end()
    return transforms


def write_transforms(transforms: list[Transform], encoding: Encoding) -> bytes:
    writer = BodyWriter(encoding)
    writer.u32(len(transforms))
    for transform in transforms:
        writer.header(transform.header)
        writer.text(transform.child)
        writer.f64s(transform.translation)
        writer.f64s(transform.rotation)
    return writer.body()


class TransformMerger:
    """Transforms of one /tf that wait to be sent."""

    def __init__(self, encoding: Encoding) -> None:
        self.superseded = 0
        """Transforms that a newer one of the same pair replaced."""
        self._encoding = encoding
        self._newest: dict[tuple[str, str], tuple[Transform, float]] = {}

    def __len__(self) -> int:
        return len(self._newest)

    def add(self, body: bytes, *, now: float) -> None:
        """Take a message in; of each pair the later stamp stays, and of equal ones the later message. BodyError."""
        for transform in read_transforms(body, self._encoding):
            known = self._newest.get(transform.pair)
            if known is not None:
                self.superseded += 1
                if transform.header.stamp_ns < known[0].header.stamp_ns:
                    continue
            elif len(self._newest) >= MAX_TRANSFORMS:
                raise BodyError(f"more than {MAX_TRANSFORMS} pairs of frames")
            self._newest[transform.pair] = (transform, now)

    def take(self, *, now: float, lifespan_s: float | None = None) -> bytes | None:
        """One message of all that waits, which waits no more; what is older than its lifespan is left out. None: there
        is nothing."""
        fresh = [
            transform
            for transform, since_s in self._newest.values()
            if lifespan_s is None or now - since_s <= lifespan_s
        ]
        self.superseded += len(self._newest) - len(fresh)
        self._newest.clear()
        return write_transforms(fresh, self._encoding) if fresh else None


class StaticTransforms:
    """All transforms that were ever published on one /tf_static."""

    def __init__(self, encoding: Encoding) -> None:
        self._encoding = encoding
        self._by_child: dict[str, Transform] = {}

    def __len__(self) -> int:
        return len(self._by_child)

    def add(self, body: bytes) -> bytes | None:
        """A message of everything, once `body` is in; None when `body` said nothing new. BodyError."""
        transforms = read_transforms(body, self._encoding)
        merged = self._by_child | {transform.pair[1]: transform for transform in transforms}
        if len(merged) > MAX_TRANSFORMS:
            raise BodyError(f"more than {MAX_TRANSFORMS} frames")
        if all(_same(merged[child], self._by_child.get(child)) for child in merged):
            return None
        self._by_child = merged
        return self.body()

    def body(self) -> bytes:
        """A message of everything."""
        return write_transforms(list(self._by_child.values()), self._encoding)


def _same(one: Transform, other: Transform | None) -> bool:
    """Equal but for the stamp, which means nothing for a static transform."""
    return (
        other is not None
        and one.pair == other.pair
        and one.translation == other.translation
        and one.rotation == other.rotation
    )
