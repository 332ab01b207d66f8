"""The bound of what may wait for one client at the relay (`access.max_queue_bytes`).

Counted is what the client's link holds: queued or under way, of reliable streams all that is not confirmed. When a
message would exceed the bound, what waits makes room, the lowest class first: best effort oldest first, then, only for
a message of a more urgent class, reliable ones newest first; never what has begun transmission, and nothing that is
more urgent than the message. If that is not enough, the message itself is dropped. Every loss is counted as
`queue_full`, and of a reliable stream the origin is told.
"""

import math
from typing import Final

from sern_core.link import Link
from sern_core.message import Message
from sern_core.queues import OutChannel
from sern_core.types import CLASSES, DropReason

UNKNOWN: Final = math.inf


class QueueBound:
    """Keeps one link below `max_bytes`. Ask `admit` before every message that is submitted to the link."""

    __slots__ = ("_at_most_bytes", "max_bytes")

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._at_most_bytes = UNKNOWN  # an upper bound of what is held: adding up is only needed when that is too much

    def recount(self) -> None:
        """Messages have come to the link in another way (replays)."""
        self._at_most_bytes = UNKNOWN

    def admit(self, link: Link, channel: OutChannel, message: Message, *, now: float) -> bool:
        """Make room for `message` of `channel`. False: there is none, and the caller drops it as `queue_full`."""
        size = len(message.body)
        if self._at_most_bytes + size <= self.max_bytes:
            self._at_most_bytes += size
            return True
        excess_bytes = sum(other.held_bytes for other in link.channels.values()) + size - self.max_bytes
        if channel.coalesced and channel.queue:
            excess_bytes -= channel.queue[0].size  # the message takes its place
        if excess_bytes > 0:
            excess_bytes = _shed(link, channel, excess_bytes, now)
        self._at_most_bytes = UNKNOWN if excess_bytes > 0 else self.max_bytes + excess_bytes
        return excess_bytes <= 0


def _shed(link: Link, incoming: OutChannel, excess_bytes: int, now: float) -> int:
    """Drop what waits until the excess is gone; returns what is left of it."""
    priority = incoming.spec.priority
    waiting = [c for c in link.channels.values() if c.queue and not (c is incoming and c.coalesced)]
    for lowest in reversed(CLASSES[priority:]):
        rows = [channel for channel in waiting if channel.spec.priority is lowest]
        for reliable in (False, True):
            if reliable and lowest is priority:
                continue  # among equals, who came first stays
            # The largest queues first: fewest streams lose anything.
            chosen = sorted((c for c in rows if c.reliable is reliable), key=lambda c: (-c.queued_bytes, c.slot))
            for channel in chosen:
                while excess_bytes > 0 and (freed_bytes := link.shed(channel, DropReason.QUEUE_FULL, now=now)):
                    excess_bytes -= freed_bytes
    return excess_bytes
