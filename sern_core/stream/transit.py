"""Where the messages of one channel are on their way out: those that wait, and those that have begun."""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from sern_core.stream.coding import Coding
from sern_core.stream.out_message import BY_SEQ, OutMessage

NOTHING: Final[Any] = ()
"""Where nothing waits: an empty deque takes 760 bytes, and most channels of most subscribers are quiet."""


class Transit:
    """The queue of one channel, and what is in flight. `coded`: other threads may encode its bodies."""

    __slots__ = ("_coded", "active", "begun_seq", "flying", "queue", "queued_bytes")

    def __init__(self, *, coded: bool) -> None:
        self._coded = coded
        self.queue: deque[OutMessage] = NOTHING
        """What has not begun, the oldest first."""
        self.queued_bytes = 0
        self.active: list[OutMessage] = []
        """What has begun and has bytes still to send, the oldest first."""
        self.flying: dict[int, OutMessage] = {}
        """What has begun, by seq, until it is acknowledged or given up."""
        self.begun_seq = 0
        """The latest that has begun."""

    # --- what waits -----------------------------------------------------------------------------------------------

    def append(self, out: OutMessage) -> None:
        if self.queue is NOTHING:
            self.queue = deque()
        self.queue.append(out)
        self.queued_bytes += out.size

    def put_first(self, outs: list[OutMessage]) -> None:
        """Put messages, oldest first, ahead of all that waits."""
        self.queued_bytes += sum([out.size for out in outs])
        self.queue = deque((*outs, *self.queue))

    def pop(self) -> OutMessage:
        """Take the oldest that waits."""
        out = self.queue.popleft()
        self.queued_bytes -= out.size
        return out

    def pop_newest(self) -> OutMessage:
        out = self.queue.pop()
        self.queued_bytes -= out.size
        return out

    # --- what has begun -------------------------------------------------------------------------------------------

    def begin(self, out: OutMessage) -> None:
        """The oldest that waits has begun."""
        out.started = True
        popped = self.queue.popleft()
        assert popped is out
        self.queued_bytes -= out.size
        self.flying[out.seq] = out
        if out.ranges is None or out.ranges:
            self.activate(out)
        self.begun_seq = out.seq

    def activate(self, out: OutMessage) -> None:
        """A begun message has bytes to send (again): put it back in its place."""
        self.flying[out.seq] = out
        if not out.active:
            out.active = True
            insort(self.active, out, key=BY_SEQ)

    def activate_all(self, outs: Iterable[OutMessage]) -> None:
        """The same of many, each once."""
        fresh = []
        for out in outs:
            self.flying[out.seq] = out
            if not out.active:
                out.active = True
                fresh.append(out)
        if len(fresh) == 1:
            insort(self.active, fresh[0], key=BY_SEQ)
        elif fresh:
            fresh.sort(key=BY_SEQ)
            behind = not self.active or self.active[-1].seq < fresh[0].seq
            self.active += fresh
            if not behind:
                self.active.sort(key=BY_SEQ)  # two runs in order, which are merged in one go

    def deactivate(self, out: OutMessage) -> None:
        """It has no more bytes to send, or is given up."""
        if out.active:
            out.active = False
            del self.active[bisect_left(self.active, out.seq, key=BY_SEQ)]

    # --- what is no more ------------------------------------------------------------------------------------------

    def forget(self, out: OutMessage) -> None:
        """Take one message out of wherever it still is."""
        out.coding = Coding.DONE
        if not out.started:
            self.queue.remove(out)
            self.queued_bytes -= out.size
        else:
            if self.flying.get(out.seq) is out:
                del self.flying[out.seq]
            self.deactivate(out)

    def take_out(self, done: Iterable[OutMessage], watermark: int) -> None:
        """Take `done`, which are all that are here up to seq `watermark`, out of wherever they are, at once."""
        for out in done:
            self.flying.pop(out.seq, None)  # not by a look at all: a peer may confirm them by twenty
        begun = bisect_right(self.active, watermark, key=BY_SEQ)
        for out in self.active[:begun]:
            out.active = False
        del self.active[:begun]
        queue = self.queue
        if queue and queue[0].seq <= watermark:
            waited = [queue.popleft() for _ in range(bisect_right(queue, watermark, key=BY_SEQ))]
            self.queued_bytes -= sum([out.size for out in waited])

    def let_go(self) -> None:
        """Nothing is left."""
        self.flying.clear()
        self._deactivate_all()
        self.queue = NOTHING
        self.queued_bytes = 0

    def restart(self, again: Iterable[OutMessage]) -> None:
        """These alone are left, oldest first, and nothing of them has been sent."""
        self.queue = deque(again) or NOTHING
        for out in self.queue:
            out.restart()
            out.started = False
        self.queued_bytes = sum(out.size for out in self.queue)
        self.flying.clear()
        self._deactivate_all()
        self.begun_seq = 0

    def uncode(self, outs: Iterable[OutMessage]) -> None:
        """Whatever another thread makes of these bodies, nobody needs it any more."""
        if self._coded:
            for out in outs:
                out.coding = Coding.DONE

    def _deactivate_all(self) -> None:
        for out in self.active:
            out.active = False
        self.active.clear()

    def validate(self, check: Callable[[bool, str], None], name: str, begun: Sequence[OutMessage]) -> None:
        """Internal consistency; `begun`: what has begun and is not done with, in its order."""
        check(self.queued_bytes == sum(out.size for out in self.queue), f"{name}: queued bytes do not add up")
        check(all(not out.started for out in self.queue), f"{name}: a begun message is in the queue")
        check(
            all(
                out.started and out.active and out.has_unsent and self.flying.get(out.seq) is out for out in self.active
            ),
            f"{name}: an active message was not begun, has nothing to send, or is not in flight",
        )
        check([out for out in begun if out.has_unsent] == self.active, f"{name}: bytes to send are forgotten")
