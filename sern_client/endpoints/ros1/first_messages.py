"""The first messages of a publication, for subscribers that the master knows but that have not connected yet.

In ROS 1 a subscriber connects to a new publisher some milliseconds after the master has told it, and what was published
before never reaches it. A node on its own can wait for its subscribers; a bridge makes its publication when the far
side has a message for it already: a goal, or the one message of `rostopic pub -1`. So the first ones are kept, beside
being sent to whoever is connected, and each of those subscribers gets them when it comes.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final

from sern_client.endpoints.common.queue import BoundedQueue
from sern_core.vocabulary.types import DropReason

FIRST_MESSAGES_S: Final = 2.0
"""How long a message is kept, and how long after our registration a subscriber is waited for. They connect within some
10 ms; what is registered and does not is a node that crashed."""

_log = logging.getLogger(__name__)


class FirstMessages:
    """The first-message buffer of a publication: it keeps what is published from the beginning until `over`.

    At most `max_messages` and `max_bytes` are kept, each for `FIRST_MESSAGES_S` and no longer than it has left. What a
    subscriber has missed for good is told to `dropped(reason, count)`, for what is above the limits `overflow`; `done`
    is called once, when nobody is waited for any more.
    """

    def __init__(
        self, topic: str, *, max_messages: int, max_bytes: int, overflow: DropReason,
        dropped: Callable[[DropReason, int], None], done: Callable[[], None],
    ) -> None:  # fmt: skip
        self.over = False
        self._topic = topic
        self._overflow = overflow
        self._lost: Counter[DropReason] = Counter()  # a loss for somebody, if the master knows a subscriber
        self._dropped = dropped
        self._done = done
        self._loop = asyncio.get_running_loop()
        self._kept: BoundedQueue[tuple[bytes, float, DropReason]] = BoundedQueue(
            max_bytes=max_bytes, max_items=max_messages
        )
        self._waited_for: set[str] | None = None  # None: the master has not told yet who subscribes
        self._served: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._kept)

    def registered(self, subscribers: Iterable[str]) -> None:
        """The master lists us as publisher, and these as subscribers; told again with every change there."""
        if self.over:
            return
        if self._waited_for is None:
            self._waited_for = set(subscribers) - self._served
            if self._waited_for:
                self._count_lost()
            self._lost.clear()
            self.hurry()
        else:
            self._waited_for &= set(subscribers)
        self._judge()

    def keep(self, body: bytes, left_s: float) -> None:
        """A message that is being published; it is of use for another `left_s`."""
        if self.over:
            return
        now = self._loop.time()
        self._forget_old(now)
        why = DropReason.LIFESPAN if left_s < FIRST_MESSAGES_S else DropReason.DISCONNECTED
        for _ in self._kept.put((body, now + min(FIRST_MESSAGES_S, left_s), why), len(body)):
            self._lose(self._overflow)

    def joined(self, caller: str) -> list[bytes]:
        """A subscriber has connected: what it gets of what was published before, oldest first."""
        if self.over or caller in self._served or not (self._waited_for is None or caller in self._waited_for):
            return []
        self._forget_old(self._loop.time())
        self._served.add(caller)
        self._count_lost()
        bodies = [body for body, _, _ in self._kept]
        if self._waited_for is not None:
            self._waited_for.discard(caller)
            # Its connection is being set up right now; who ends the publication then must not end it before.
            self._loop.call_soon(self._judge)
        return bodies

    def hurry(self) -> None:
        """It shall be over in `FIRST_MESSAGES_S` at the latest."""
        if self._timer is None and not self.over:
            self._timer = self._loop.call_later(FIRST_MESSAGES_S, self._timed_out)

    def close(self) -> None:
        """Nobody is waited for any more."""
        self.over = True
        self._kept.clear()
        self._lost.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _judge(self) -> None:
        if not self.over and self._waited_for is not None and not self._waited_for:
            self.close()
            self._done()

    def _count_lost(self) -> None:
        for why, count in self._lost.items():
            self._dropped(why, count)
        self._lost.clear()

    def _timed_out(self) -> None:
        count = len(self._kept)
        if count and self._waited_for:
            _log.warning(
                "%s: %s has not connected within %g s; it missed %d message%s",
                self._topic, ", ".join(sorted(self._waited_for)), FIRST_MESSAGES_S, count, "" if count == 1 else "s",
            )  # fmt: skip
        while self._kept:
            self._lose(self._kept.pop()[2])
        self.close()
        self._done()

    def _forget_old(self, now: float) -> None:
        while self._kept and self._kept.first[1] <= now:
            self._lose(self._kept.pop()[2])

    def _lose(self, why: DropReason) -> None:
        if self._waited_for is not None:
            self._dropped(why, 1)
        else:
            self._lost[why] += 1
