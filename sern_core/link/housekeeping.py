"""What one end of a hop lets go of by time, also while the link is down. Pure."""

from collections.abc import Callable
from typing import Final

from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn

SWEEP_INTERVAL_S: Final = 0.25
QUIET_SWEEP_INTERVAL_S: Final = 5.0
"""The same on a leased lane, of which a relay may have many, while nothing is kept and nothing waits."""
QUIET_STREAMS: Final = 64
"""Whether anything is kept is looked at where there are no more streams either way: else looking costs more."""
TIDY_S: Final = 60.0


class Housekeeping:
    """`sweep` is due at `due_s`; counters of topics that nobody has any more go every `TIDY_S`."""

    def __init__(self, sender: Sender, taking: StreamsIn, *, leased: bool, now: float) -> None:
        self._sender = sender
        self._taking = taking
        self._leased = leased
        self._tidy_due_s = now + TIDY_S
        self._due_s = self._quiet_due_s = now + SWEEP_INTERVAL_S
        self._quiet = False  # nothing was kept at the last sweep
        self.on_tidy: Callable[[float], None] | None = None
        """Called now and then, with the time, for the owner to let go of what nobody needs any more."""

    @property
    def due_s(self) -> float:
        """When to sweep."""
        return self._quiet_due_s if self._quiet and not self._sender.scheduler.busy else self._due_s

    def sweep(self, now: float) -> None:
        """Let go of what nobody needs any more."""
        self._due_s, self._quiet_due_s = now + SWEEP_INTERVAL_S, now + QUIET_SWEEP_INTERVAL_S
        done = self._sender.sweep(now)
        self._taking.sweep_acked()
        if now >= self._tidy_due_s:
            self._tidy(now)
        self._taking.sweep(now)
        self._quiet = self._leased and self._keeps_nothing()
        if not done:
            self._due_s = self._quiet_due_s = now  # the rest in another turn of the loop

    def _keeps_nothing(self) -> bool:
        channels, taking = self._sender.channels, self._taking
        if len(channels) + len(taking.streams) > QUIET_STREAMS or any(channel.kept for channel in channels.values()):
            return False
        return not taking.held_bytes

    def _tidy(self, now: float) -> None:
        self._tidy_due_s = now + TIDY_S
        sender = self._sender
        sender.ledger.tidy({channel.counters.topic for channel in sender.channels.values()}, now=now)
        if self.on_tidy is not None:
            self.on_tidy(now)
