"""Datagrams of a session are read in slices, in order, and each is read whole or its session ends. Pure.

What a peer says may cost much more than its bytes: one announcement, a channel for each of fifty subscribers. So
reading stops when that has cost a slice (`PeerLimits`), and goes on after as long a rest, at the very frame: what
follows depends on it. Nothing of a datagram that is half read is acknowledged, and nothing of those behind it, so that
a session that ends meanwhile loses nothing; a peer that waits for acknowledgements is slowed down by it.
"""

from collections import deque
from collections.abc import Callable
from typing import Final

from sern_core.link.end import End
from sern_core.link.lane_set import LaneSet
from sern_core.link.receiver import Receiver
from sern_core.path.lanes import Lane
from sern_core.stream.in_stream import Reassembly
from sern_core.vocabulary.errors import WireError
from sern_core.wire import framing

UNREAD_OVERHEAD_BYTES: Final = 256
"""What a datagram that waits to be read takes beside its own size."""


class Reading:
    """`go_on(now)` does more of what has to be done before the next frame is read; True: all of it is done."""

    def __init__(
        self,
        end: End,
        lanes: LaneSet,
        receiver: Receiver,
        reassembly: Reassembly,
        go_on: Callable[[float], bool],
    ) -> None:
        self._end = end
        self._lanes = lanes
        self._receiver = receiver
        self._reassembly = reassembly
        self._go_on = go_on
        self._unread: deque[tuple[int, int, int, bytes, int]] = deque()  # lane, number, stamp, datagram, where to go on
        self._unread_bytes = 0
        self.due_s: float | None = None
        """When to go on reading; None: nothing that has arrived waits to be read."""
        self.on_read: Callable[[], None] | None = None
        """Called after something was read by time, as its owner does itself after `receive`."""

    def leave(self) -> None:
        """The session is over."""
        self._unread.clear()
        self._unread_bytes = 0
        self._end.half_read = False

    def receive(self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, now: float) -> None:
        """A kind-16 datagram of the session. Raises WireError."""
        if self.due_s is None:
            self._reassembly.work_us = 0
            self._read(lane, number, stamp_us, data, now, 0)
        else:
            self._keep(lane, number, stamp_us, bytes(data))

    def _read(self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, now: float, position: int) -> None:
        """Read it from `position` on, as far as it goes."""
        position = self._receiver.receive(lane, number, stamp_us, data, now, position)
        if not position:
            return
        if self._end.established:
            self._end.half_read = True
            self._unread_bytes += len(data) + UNREAD_OVERHEAD_BYTES
            self._unread.appendleft((lane.id, number, stamp_us, bytes(data), position))
        self.due_s = now + self._reassembly.work_us * 1e-6
        self._end.dirty = True

    def _through(self) -> bool:
        """Nothing waits for its time. A method of its own: that `_read` may set `due_s` is nothing a compiler sees."""
        return self.due_s is None

    def _keep(self, lane: Lane, number: int, stamp_us: int, data: bytes) -> None:
        """Read it later."""
        self._unread_bytes += len(data) + UNREAD_OVERHEAD_BYTES
        if self._unread_bytes > self._end.params.limits.unread_bytes:
            text = f"{self._end.peer} goes on sending although {len(self._unread)} datagrams wait to be read"
            raise WireError(text)
        self._unread.append((lane.id, number, stamp_us, data, 0))

    def read_on(self, now: float) -> None:
        """`due_s` has come. Raises WireError."""
        self._end.now = now
        reassembly = self._reassembly
        reassembly.work_us = 0
        self.due_s = None
        done = self._go_on(now)
        while done and self._unread and reassembly.work_us <= reassembly.slice_us:
            lane_id, number, stamp_us, data, position = self._unread.popleft()
            self._unread_bytes -= len(data) + UNREAD_OVERHEAD_BYTES
            if position:
                self._end.half_read = False
                self._end.dirty = True
            lane = self._lanes.by_id.get(lane_id)
            if lane is not None:  # else it is closed, and what came over it comes again
                self._read(lane, number, stamp_us, data, now, position)
            done = self._through()
        if not done or self._unread:
            self.due_s = now + reassembly.work_us * 1e-6
        if self.on_read is not None:
            self.on_read()
