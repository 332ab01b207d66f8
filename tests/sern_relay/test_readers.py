"""What reads at the relay itself: a fault of one is that one's alone."""

from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.bodies.codecs import Coder
from sern_core.vocabulary.message import Message, StreamInfo
from sern_relay.readers import Readers
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.optional import OptionalParts
from tests.world import World, spec

PARTS = ("metrics", "objects", "feed")


class Reader:
    """Feed and transforms in one; raises where a test wants it to."""

    def __init__(self, *, wants: bool = True, raises: bool = False) -> None:
        self.got: list[bytes] = []
        self.closed = False
        self.feed = SimpleNamespace(wants=lambda _topic: wants)
        self._wants = wants
        self._raises = raises

    def reads(self, _stream: StreamInfo) -> bool:
        return self._wants

    def message(self, _stream: StreamInfo, message: Message, *, now: float) -> None:
        if self._raises:
            raise RuntimeError("broken")
        self.got.append(message.body)

    publish = message

    def stream_removed(self, _stream: StreamInfo) -> None:
        self.owners_changed()

    def owners_changed(self) -> None:
        if self._raises:
            raise RuntimeError("broken")

    def close(self) -> None:
        self.closed = True
        if self._raises:
            raise RuntimeError("broken")


def reading(transforms: Any, feed: Any) -> tuple[Readers, OptionalParts, StreamInfo]:
    parts = OptionalParts(*PARTS)
    readers = Readers(Coder(max_bytes=1000), parts, InternalErrors())
    readers.transforms, readers.feed = transforms, feed
    return readers, parts, World().client("robot").publish("/robot/pose", spec()).stream


def message(stream: StreamInfo, seq: int) -> Message:
    return Message(stream.id, seq, b"body", 1, 0.0)


@pytest.mark.parametrize("broken", ["transforms", "feed"])
def test_what_fails_in_one_is_counted_and_the_other_has_its_message(broken: str) -> None:
    transforms, feed = Reader(raises=broken == "transforms"), Reader(raises=broken == "feed")
    readers, parts, stream = reading(transforms, feed)
    readers.message(stream, message(stream, 1), now=1.0)
    readers.owners_changed()
    readers.stream_removed(stream)
    whole, part = (feed, "objects") if broken == "transforms" else (transforms, "feed")
    assert whole.got == [b"body"] and parts.failures[part] >= 1
    with pytest.raises(RuntimeError):
        readers.close()
    assert transforms.closed and feed.closed, "both, whichever fails"


def test_without_any_of_them_a_message_costs_nothing_and_is_counted_in_its_age() -> None:
    readers, parts, stream = reading(None, None)
    readers.message(stream, message(stream, 1), now=1.0)
    readers.stream_removed(stream)
    readers.close()
    assert not any(parts.failures.values())
