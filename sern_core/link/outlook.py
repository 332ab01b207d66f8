"""Whether a large message that would begin now can still arrive within its lifespan, by what the link carries. Pure.

Of one that cannot, all that is sent is wasted, and what waits behind it waits for nothing. It is given up before its
first byte, and what is smaller or newer goes in its place. But what a link carries is only seen while there is enough
to send: while nothing else fills it, one of them is tried now and then, for as long as the window grows.
"""

from math import exp
from typing import Final

from sern_core.path.lanes import OVERHEAD_BYTES, Lane
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing

LARGE_FRAGMENTS: Final = 8
"""A message of fewer is sent before anything could be said of it."""
URGENT_S: Final = 1.0
"""Time over which the traffic of more urgent classes is averaged: so much of the link is not to be had."""
FADE_S: Final = 0.05
"""How often that average fades: more often would cost every datagram an exponential."""
SURE: Final = 0.9
"""The rate is known to a tenth: what would need so much more than the time it has may still arrive."""
TRY_S: Final = 0.25
"""A try lasts a round trip and so long, and again as long while the window grows so many times: the rate follows it."""
GROWS: Final = 1.2
FULL_S: Final = 0.25
"""A link for which something has waited so long is full."""
MIN_PAUSE_S, MAX_PAUSE_S = 0.5, 2.0
"""After the first try that was in vain, and after many: the pause doubles each time."""


class Outlook:
    """What one end of a hop knows of that, for all its channels."""

    __slots__ = (
        "_full_since_s",
        "_judged_s",
        "_pause_s",
        "_tried",
        "_try_s",
        "_urgent_at_s",
        "_urgent_bytes",
        "_vain_bytes",
        "_window_bytes",
    )

    def __init__(self, now: float) -> None:
        self._urgent_bytes = [0.0, 0.0]  # of class control, and of it and class state; fading
        self._urgent_at_s = now
        self._tried: tuple[int, int] | None = None  # channel and seq of the message that is sent to see
        self._window_bytes = 0.0  # when that was judged last, or larger: when one was in vain
        self._vain_bytes = 0.0
        self._judged_s = 0.0  # when it is judged again
        self._pause_s = MIN_PAUSE_S
        self._try_s = now  # no try before
        self._full_since_s: float | None = None

    def sent(self, priority: PriorityClass, nbytes: int, now: float) -> None:
        """Bytes of a class went on the wire."""
        if priority is PriorityClass.BULK:
            return
        if now > self._urgent_at_s + FADE_S:
            self._fade(now)
        self._urgent_bytes[1] += nbytes
        if priority is PriorityClass.CONTROL:
            self._urgent_bytes[0] += nbytes

    def waits(self, now: float) -> None:
        """There is more to send than the link takes now. Where that lasts the link is full, and what it carries is seen
        without a try; for a moment it is so behind every message of a few fragments."""
        if self._full_since_s is None:
            self._full_since_s = now
        elif now >= self._full_since_s + FULL_S:
            self._try_s = max(self._try_s, now + MIN_PAUSE_S)

    def nothing_waits(self) -> None:
        """All that there was to send has left."""
        self._full_since_s = None

    def _fade(self, now: float) -> None:
        elapsed_s, self._urgent_at_s = max(0.0, now - self._urgent_at_s), now
        kept = exp(-elapsed_s / URGENT_S)
        self._urgent_bytes[0] *= kept
        self._urgent_bytes[1] *= kept

    def in_time(self, channel: OutChannel, out: OutMessage, lane: Lane, now: float) -> bool:
        """Whether the message at the head of a channel may be begun, or goes on. Nothing is said of what is reliable,
        small, without a lifespan or begun already, nor while nobody knows what the link carries."""
        lifespan_s = channel.spec.lifespan_s
        if channel.reliable or lifespan_s is None or out.size <= LARGE_FRAGMENTS * lane.fragment_bytes:
            return True
        tried = self._tried == (channel.channel_id, out.seq)
        # One that is tried may have to wait for the next datagram: what was before it in this one is of another class.
        # And one that was begun to be encoded is not under way yet.
        if now < self._judged_s if tried else out.ranges is not None:
            return True
        rate_bps = lane.estimator.rate_bps
        if rate_bps is None or out.message.drop_marker:
            return True
        if self._needed_s(channel.spec.priority, out, lane, rate_bps, now) <= lifespan_s - _age_s(out, now):
            if tried:
                self._tried, self._pause_s = None, MIN_PAUSE_S
            return True
        if tried and lane.estimator.window_bytes > GROWS * self._window_bytes:
            self._judge_later(lane, now)
            return True
        if tried:
            self._tried, self._try_s, self._vain_bytes = None, now + self._pause_s, lane.estimator.window_bytes
            self._pause_s = min(2 * self._pause_s, MAX_PAUSE_S)
            return False
        probe = channel.probe_from_seq is not None and out.seq >= channel.probe_from_seq
        if now < self._try_s and not probe:
            return False
        if probe:
            channel.probe_from_seq = None
        self._tried, self._try_s = (channel.channel_id, out.seq), now + MIN_PAUSE_S
        self._judge_later(lane, now)
        return True

    def _judge_later(self, lane: Lane, now: float) -> None:
        self._window_bytes = max(lane.estimator.window_bytes, self._vain_bytes)
        self._judged_s = now + TRY_S + (lane.estimator.rtprop_s or 0.0)

    def _needed_s(self, priority: PriorityClass, out: OutMessage, lane: Lane, rate_bps: float, now: float) -> float:
        """How long the rest of the message takes at least, with what more urgent classes leave of the link."""
        self._fade(now)
        taken_bps = 0.0 if priority is PriorityClass.CONTROL else 8 * self._urgent_bytes[priority - 1] / URGENT_S
        free_bps = max(rate_bps - taken_bps, 1.0)
        datagram_bytes = lane.fragment_bytes + OVERHEAD_BYTES
        body_bytes = lane.fragment_bytes - framing.HEADER_BYTES - framing.DATA_BYTES
        wire_bytes = out.unsent_bytes * datagram_bytes / body_bytes
        return SURE * 8 * wire_bytes / free_bps + (lane.estimator.rtprop_s or 0.0) / 2


def _age_s(out: OutMessage, now: float) -> float:
    return now - out.message.born_s + out.message.error_s
