"""What lets the messages of a best-effort topic in at a lower rate than they come, and keeps the newest one back."""

from math import inf
from typing import Final

from sern_core.stream.out_message import OutMessage
from sern_core.stream.rate_cap import RateCap
from sern_core.vocabulary.message import Message

SHARE_HOLD_S: Final = 1.0
"""The longest that the newest message is held back by a `share`."""

_NEVER: Final = -inf


class Gate:
    """A rate cap and a share of the messages. What is held back is kept while it is the newest, and goes when its time
    comes, so that the last of a series always passes."""

    __slots__ = (
        "_arrived_s",
        "_cap",
        "_owed_share",
        "left_out",
        "newest",
        "newest_due_s",
        "newest_thinned",
        "share",
        "thinned",
    )

    def __init__(self, max_rate_hz: float | None) -> None:
        self._cap = None if max_rate_hz is None else RateCap(max_rate_hz)
        self._owed_share = 0.0
        self._arrived_s = _NEVER
        self.share = 1.0
        """Share of the messages that are let in."""
        self.thinned = 0
        """Messages that `share` left out."""
        self.newest: OutMessage | None = None
        """The newest message, held back until `newest_due_s`."""
        self.newest_due_s = inf
        self.newest_thinned = False
        """Whether `share` holds it back, not the cap."""
        self.left_out = 0
        """Seq of the message that the last call left out for a newer one; 0: none."""

    def leave_out(self) -> OutMessage | None:
        """A newer message has come before the one that was held back could go: returns that one."""
        out = self.take_newest()
        if out is not None:
            self.thinned += self.newest_thinned
            self.left_out = out.seq
        return out

    def holds_back(self, message: Message, now: float, *, forced: bool) -> bool:
        """Whether a message has to wait here. `forced` skips the cap."""
        cap = self._cap
        if cap is not None and not forced and not cap.allows(now):
            self._hold_back(message, cap.next_s, thinned=False)
            return True
        if self.share < 1.0:
            gap_s, self._arrived_s = now - self._arrived_s, now
            if not self._share_allows():
                due_s = now + min(SHARE_HOLD_S, max(2.0, 1.0 / max(self.share, 1e-3)) * gap_s)
                self._hold_back(message, due_s, thinned=True)
                return True
        return False

    def release(self, now: float) -> OutMessage | None:
        """The message that was held back, if its time has come."""
        return None if now < self.newest_due_s else self.take_newest()

    def passed(self, now: float) -> None:
        """What was held back goes on now: it takes the place of one that the cap would have let in."""
        if self._cap is not None and not self.newest_thinned:
            self._cap.allows(now)

    def take_newest(self) -> OutMessage | None:
        """Hold nothing back any more: returns what was."""
        out = self.newest
        self.newest, self.newest_due_s = None, inf
        return out

    def _hold_back(self, message: Message, due_s: float, *, thinned: bool) -> None:
        self.newest = OutMessage(message)
        self.newest_due_s = due_s
        self.newest_thinned = thinned

    def _share_allows(self) -> bool:
        """Let `share` of the messages through, evenly spread."""
        self._owed_share += self.share
        if self._owed_share < 1.0:
            return False
        self._owed_share -= 1.0
        return True
