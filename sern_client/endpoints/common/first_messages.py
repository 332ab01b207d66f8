"""The first messages of a publisher in ROS 2 wait until the subscribers that are known have found it.

Discovery takes a moment: what is published before it is done reaches nobody, and a bridge makes its publisher when the
far side has a message for it already. So the first ones are kept, in order, until every subscriber that the graph knows
is connected, and written then. Where the graph knows none, nothing waits; while it is being learned, shortly after our
own start, what comes first waits for that.
"""

import asyncio
import logging
from collections.abc import Callable
from typing import Final, NamedTuple

from sern_client.endpoints.common.queue import BoundedQueue
from sern_core.vocabulary.types import DropReason

FIRST_MESSAGES_S: Final = 1.0
"""How long subscribers are waited for, from the publisher's beginning or when the graph is learned. To connect takes
some 10 ms; a subscriber that is known and does not come is a node that crashed."""
MAX_FIRST_MESSAGES: Final = 10_000
"""How many are kept of a reliable publisher, at most: more than 2 kHz has before all subscribers are known. At 1 kHz a
hundred were too few by some, now and again (measured). Bytes are bounded as well."""
SETTLE_S: Final = 0.1
"""How long it may take the subscriber to see that we are connected, once we do. There is no sign of that here."""
LEARN_S: Final = 4.0
"""How long after its start an endpoint may not know all subscribers yet: DDS says who is there again and again, and
Fast DDS says after 3 s what was lost of that."""
_POLL_S: Final = 0.01

_log = logging.getLogger(__name__)


class Readers(NamedTuple):
    """How many subscribers of a topic are known, and how many of these we are connected with."""

    known: int
    connected: int


class _Kept(NamedTuple):
    body: bytes
    stamp_ns: int
    until_s: float


class FirstMessages:
    """The first-message buffer of a publisher, until `over`, when everything kept has been given to `write`.

    At most `max_messages` and `max_bytes` are kept, the newest; what is above is told to `dropped` as `overflow`, what
    is too old meanwhile as LIFESPAN, what `write` does not take as FAULT. `learning_s`: how much longer the graph may
    be incomplete.
    """

    def __init__(
        self, topic: str, *, readers: Callable[[], Readers], write: Callable[[bytes, int], None],
        dropped: Callable[[DropReason], None], max_messages: int, max_bytes: int, overflow: DropReason,
        learning_s: float,
    ) -> None:  # fmt: skip
        self.over = False
        self._topic = topic
        self._readers = readers
        self._write = write
        self._dropped = dropped
        self._overflow = overflow
        self._loop = asyncio.get_running_loop()
        self._since_s = self._loop.time()
        self._learned_s = self._since_s + learning_s
        self._give_up_s = max(self._since_s + FIRST_MESSAGES_S, self._learned_s) + SETTLE_S
        self._connected_s: float | None = None
        self._done: Callable[[], None] | None = None
        self._kept: BoundedQueue[_Kept] = BoundedQueue(max_bytes=max_bytes, max_items=max_messages)
        self._timer: asyncio.TimerHandle | None = None
        self._judge()

    def __len__(self) -> int:
        return len(self._kept)

    def publish(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        """Write a message, now or when its readers are there; never later than in `left_s`."""
        if not self.over:
            self._judge()
        if self.over:
            self._write(body, stamp_ns)
            return
        for _ in self._kept.put(_Kept(body, stamp_ns, self._loop.time() + left_s), len(body)):
            self._dropped(self._overflow)
        if self._timer is None:
            self._timer = self._loop.call_later(_POLL_S, self._look)

    def end(self, done: Callable[[], None]) -> None:
        """No more messages come; `done` is called when those that there are have been written."""
        if self.over or not self._kept:
            self.close()
            done()
        else:
            self._done = done

    def close(self) -> None:
        """Nobody is waited for any more: what is kept is written now."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._flush()

    def _look(self) -> None:
        self._timer = None
        self._judge()
        if not self.over:
            self._timer = self._loop.call_later(_POLL_S, self._look)

    def _judge(self) -> None:
        now = self._loop.time()
        known, connected = self._readers()
        if connected < known or not known:
            self._connected_s = None
        elif self._connected_s is None:
            self._connected_s = now
        if now >= self._give_up_s:
            if connected < known and self._kept:
                _log.warning(
                    "%s: %d of %d subscribers have not connected within %.1f s; they miss %d messages",
                    self._topic, known - connected, known, now - self._since_s, len(self._kept),
                )  # fmt: skip
            # Written all the same, for those that are there and for late joiners of a latched topic; so not dropped.
            self._flush()
        elif not known:
            if now >= self._learned_s:
                self._flush()
        elif self._connected_s is not None and now - self._connected_s >= SETTLE_S:
            self._flush()

    def _flush(self) -> None:
        if self.over:
            return
        self.over = True
        now = self._loop.time()
        try:
            self._write_kept(now)
        finally:
            done, self._done = self._done, None
            if done is not None:
                done()

    def _write_kept(self, now: float) -> None:
        complained = False
        while self._kept:
            body, stamp_ns, until_s = self._kept.pop()
            if until_s < now:
                self._dropped(DropReason.LIFESPAN)
                continue
            try:
                self._write(body, stamp_ns)
            except Exception:  # noqa: BLE001  (a fault of one message; those behind it are written all the same)
                self._dropped(DropReason.FAULT)
                if not complained:
                    complained = True
                    _log.exception("%s: a message could not be published here", self._topic)
