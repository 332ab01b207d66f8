"""What one end of a hop lets go of by time, also while the link is down. Pure."""

from collections.abc import Callable
from typing import Final

from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn

SWEEP_INTERVAL_S: Final = 0.25
TIDY_S: Final = 60.0


class Housekeeping:
    """`sweep` is due every `SWEEP_INTERVAL_S`; counters of topics that nobody has any more go every `TIDY_S`."""

    def __init__(self, sender: Sender, taking: StreamsIn, *, now: float) -> None:
        self._sender = sender
        self._taking = taking
        self._tidy_due_s = now + TIDY_S
        self.due_s = now + SWEEP_INTERVAL_S
        """When to sweep."""
        self.on_tidy: Callable[[float], None] | None = None
        """Called now and then, with the time, for the owner to let go of what nobody needs any more."""

    def sweep(self, now: float) -> None:
        """Let go of what nobody needs any more."""
        self.due_s = now + SWEEP_INTERVAL_S
        done = self._sender.sweep(now)
        self._taking.sweep_acked()
        if now >= self._tidy_due_s:
            self._tidy(now)
        self._taking.sweep(now)
        if not done:
            self.due_s = now  # the rest in another turn of the loop

    def _tidy(self, now: float) -> None:
        self._tidy_due_s = now + TIDY_S
        sender = self._sender
        sender.ledger.tidy({channel.counters.topic for channel in sender.channels.values()}, now=now)
        if self.on_tidy is not None:
            self.on_tidy(now)
