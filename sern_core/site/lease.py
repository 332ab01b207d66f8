"""The command lease: a command topic that goes quiet is answered with the stop command, whatever the cause. Pure.

After `after_s` without a fresh command the stop message is due, repeated at 10 Hz for 1 s, then nothing until commands
come again. The lease is armed by the first command: a robot that was never commanded is not spoken to.

The process that keeps the lease may be held up, stopped or killed. `GuardLease` is the same lease in another process,
which is told of every deadline: it speaks when the owner does not.
"""

from typing import Final

REPEAT_S: Final = 0.1
REPEAT_FOR_S: Final = 1.0
GRACE_S: Final = 0.05
"""What the owner of a lease may be late with its stop command before its guard publishes one."""


class CommandLease:
    """Tell it of every command that is delivered (`renew`), ask it when to wake (`deadline`) and then `due`."""

    __slots__ = ("_expired_s", "_next_s", "after_s", "fired")

    def __init__(self, after_s: float) -> None:
        self.after_s = after_s
        """How long a command holds."""
        self._next_s: float | None = None
        self._expired_s: float | None = None
        self.fired = 0
        """How often the lease ran out."""

    def renew(self, *, born_s: float) -> None:
        """A command was delivered that was born at `born_s` (monotonic): freshness counts from its birth."""
        self._expired_s = None
        self._next_s = born_s + self.after_s

    @property
    def expired(self) -> bool:
        return self._expired_s is not None

    def deadline(self) -> float | None:
        """When the stop message is due next; None: not armed, or said often enough."""
        return self._next_s

    def due(self, *, now: float) -> bool:
        """Whether to publish the stop message now."""
        if self._next_s is None or now < self._next_s:
            return False
        if self._expired_s is None:
            self._expired_s = now
            self.fired += 1
        self._next_s = now + REPEAT_S if now - self._expired_s < REPEAT_FOR_S - REPEAT_S / 2 else None
        return True


class GuardLease(CommandLease):
    """What a guard keeps: due `GRACE_S` after the deadline that the owner told last, or at once when it is gone."""

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__(GRACE_S)

    def told(self, next_s: float | None) -> None:
        """The owner's `deadline()` is this now: it has heard a command, or has said the stop command itself."""
        self._expired_s = None
        self._next_s = None if next_s is None else next_s + GRACE_S

    def abandoned(self, *, now: float) -> None:
        """The owner is gone. No more commands will come: the last one must not stand."""
        if self._next_s is not None and self._expired_s is None:
            self._next_s = min(self._next_s, now)
