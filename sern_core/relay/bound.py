"""The bound of what may wait for one client at the relay (`access.max_queue_bytes`).

Counted is what the client's link holds: queued or under way, of reliable streams all that is not confirmed, and for
each message `CLIENT_OVERHEAD_BYTES` beside its body. When a message would exceed the bound, what waits makes room, the
lowest class first: best effort oldest first, then, only for a message of a more urgent class, reliable ones newest
first; never what has begun transmission, and nothing that is more urgent than the message. If that is not enough, the
message itself is dropped. Every loss is counted as `queue_full`, and of a reliable stream the origin is told. What made
way leaves nothing behind: its stream goes on behind it, and the client is told where.
"""

import math
from typing import Final

from sern_core.link.link import Link
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import CLEARED_PER_US, CLIENT_OVERHEAD_BYTES, GIVEN_UP_US
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import CLASSES, DropReason

UNKNOWN: Final = math.inf
FULL_S: Final = 0.01
"""A message that found no room speaks so long for those of its size and class that come after it: adding up what a link
holds is too dear to be done for each."""
DROP_MARKER_BYTES: Final = 1 + CLIENT_OVERHEAD_BYTES
ADDED_UP_PER_US: Final = 2
"""Channels of a link that are added up in a microsecond. That and what is given up are charged to whoever sent the
message that needs room (`Reassembly.work_us`)."""


class QueueBound:
    """Keeps one link below `max_bytes`. Hand every message that is for the link to `submit`."""

    __slots__ = ("_at_most_bytes", "_full_bytes", "_full_until_s", "_work_us", "max_bytes")

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._at_most_bytes = UNKNOWN  # an upper bound of what is held: adding up is only needed when that is too much
        self._full_until_s = [-UNKNOWN] * len(CLASSES)
        self._full_bytes = [0] * len(CLASSES)  # messages of this size found no room, by class
        self._work_us = 0  # of the message that is being submitted

    def recount(self) -> None:
        """Messages have come to the link in another way (replays)."""
        self._at_most_bytes = UNKNOWN

    def submit(self, link: Link, channel: OutChannel, message: Message, *, now: float) -> int:
        """Make room for `message` of `channel` and submit it; without room it is dropped as `queue_full`. A reliable
        one leaves a drop marker if there is room for it, else a gap. Returns what making room cost, in microseconds."""
        self._work_us = 0
        size = len(message.body) + CLIENT_OVERHEAD_BYTES
        if self._at_most_bytes + size <= self.max_bytes:
            self._at_most_bytes += size
            link.sender.submit(channel, message, now=now, forced=True)
        elif self._makes_room(link, channel, size, now, shed=not message.drop_marker):
            link.sender.submit(channel, message, now=now, forced=True)
        elif not channel.reliable or (
            not message.drop_marker and self._makes_room(link, channel, DROP_MARKER_BYTES, now, shed=False)
        ):
            link.sender.reject(channel, message, DropReason.QUEUE_FULL, now=now)
        else:
            link.outgoing.leave_out(channel, message, DropReason.QUEUE_FULL, now=now)
        return self._work_us

    def _makes_room(self, link: Link, channel: OutChannel, size: int, now: float, *, shed: bool) -> bool:
        priority = channel.spec.priority
        if now < self._full_until_s[priority] and size >= self._full_bytes[priority]:
            return False
        self._work_us += len(link.sender.channels) // ADDED_UP_PER_US
        excess_bytes = sum(other.kept_bytes for other in link.sender.channels.values()) + size - self.max_bytes
        if _takes_the_place(channel):
            excess_bytes -= channel.unbegun_bytes + channel.unbegun * CLIENT_OVERHEAD_BYTES
        if excess_bytes > 0 and shed:
            excess_bytes = self._shed(link, channel, excess_bytes, now)
        if excess_bytes <= 0:
            self._at_most_bytes = float(self.max_bytes + excess_bytes)
            return True
        self._at_most_bytes = UNKNOWN
        self._full_until_s[priority] = now + FULL_S
        self._full_bytes[priority] = size
        return False

    def _shed(self, link: Link, incoming: OutChannel, excess_bytes: int, now: float) -> int:
        """Drop what waits until the excess is gone; returns what is left of it."""
        priority = incoming.spec.priority
        waiting = [
            c for c in link.sender.channels.values() if c.unbegun and not (c is incoming and _takes_the_place(c))
        ]
        for lowest in reversed(CLASSES[priority:]):
            rows = [channel for channel in waiting if channel.spec.priority is lowest]
            for reliable in (False, True):
                if reliable and lowest is priority:
                    continue  # among equals, who came first stays
                # The largest queues first: fewest streams lose anything.
                chosen = sorted(
                    (c for c in rows if c.reliable is reliable), key=lambda c: (-c.unbegun_bytes, c.channel_id)
                )
                for channel in chosen:
                    if excess_bytes <= 0:
                        return excess_bytes
                    kept = channel.kept
                    excess_bytes -= link.sender.shed(channel, excess_bytes, DropReason.QUEUE_FULL, now=now)
                    self._work_us += GIVEN_UP_US + (kept - channel.kept) // CLEARED_PER_US
        return excess_bytes


def _takes_the_place(channel: OutChannel) -> bool:
    """Whether a message of `channel` takes the place of all that waits there. Where the adaptation leaves messages out
    it may be held back beside it."""
    return channel.coalesced and channel.share >= 1.0
