"""The command lease: a command topic that goes quiet is answered by slowing down or with the stop command. Pure.

Without a ramp: after `after_s` without a fresh command the stop message is due, repeated at 10 Hz for 1 s.

With a ramp a command holds for `hold_s` past the usual time between commands, counted from its arrival, so that jitter
of the link is ridden out; and for `after_s` from its birth at the longest, whatever the rest says. Then the robot is
slowed down along the arc that it is on: linear and angular velocity shrink by the same factor, so that neither
decelerates faster than its limit. At the end stands one stop command. A fresh command ends all that; those that the
link held back meanwhile are not obeyed one after the other (`overtaken`).

Either lease is armed by the first command: a robot that was never commanded is not spoken to.

The process that keeps the lease may be held up, stopped or killed. `GuardLease` is the same lease in another process,
which is told of every deadline: it speaks when the owner does not.
"""

from typing import Final

from sern_core.bodies.twist import TwistBody
from sern_core.topics.rules import Ramp

REPEAT_S: Final = 0.1
REPEAT_FOR_S: Final = 1.0
GRACE_S: Final = 0.05
"""What the owner of a lease may be late with its stop command before its guard publishes one."""
STEP_S: Final = 0.05
"""Time between two commands of a ramp."""
MAX_RAMP_S: Final = 3.0
"""The longest ramp, however fast the robot was told to go: a speed is what somebody else has said."""
INTERVALS: Final = 8
"""Times between commands that are remembered."""
FEW: Final = 3
"""Times between commands that are needed to know the usual one."""


class CommandLease:
    """Tell it of every command that is delivered (`renew`), ask it when to wake (`deadline`), then whether something is
    `due`, and what (`slowed`)."""

    __slots__ = (
        "_ages_s",
        "_born_s",
        "_command",
        "_expired_s",
        "_intervals_s",
        "_next_s",
        "_ramp",
        "_ramp_s",
        "_said_s",
        "_since_s",
        "after_s",
        "fired",
    )

    def __init__(self, after_s: float, ramp: Ramp | None = None) -> None:
        self.after_s = after_s
        """How long a command holds at the longest."""
        self.fired = 0
        """How often the lease ran out."""
        self._ramp = ramp
        self._born_s = 0.0
        self._intervals_s: list[float] = []
        self._ages_s: list[float] = []
        self._command: TwistBody | None = None
        self._said_s = 0.0  # when it was
        self._next_s: float | None = None
        self._expired_s: float | None = None
        self._since_s: float | None = None  # when slowing down began, and
        self._ramp_s = 0.0  # how long it takes

    def overtaken(self, *, born_s: float, now: float) -> bool:
        """Whether a command that comes now, after an outage, is not to be obeyed: by its age others were given after it
        and are right behind it. What a link held back would else come as a burst. Ask it of every command, once.

        That a link has become slower for good is known after a few commands."""
        age_s = now - born_s
        self._ages_s.append(age_s)
        del self._ages_s[:-INTERVALS]
        if self._ramp is None or not self.expired or len(self._intervals_s) < FEW:
            return False
        return age_s > min(self._ages_s) + self.period_s

    def renew(self, *, born_s: float, now: float, command: TwistBody | None = None) -> None:
        """A command was delivered that was born at `born_s`. `command`: what it says, where that could be read; without
        it the stop command follows without a ramp."""
        between_s, self._born_s = born_s - self._born_s, born_s
        if self._next_s is not None and not self.expired and between_s > 0.0:
            self._intervals_s.append(between_s)
            del self._intervals_s[:-INTERVALS]
        self._expired_s = self._since_s = None
        self._command, self._said_s = command, now
        until_s = born_s + self.after_s
        if self._ramp is not None and len(self._intervals_s) >= FEW:
            until_s = min(until_s, now + self.period_s + self._ramp.hold_s)
        self._next_s = until_s

    def halt(self, *, now: float) -> None:
        """The robot is told to stand now. That is said again once, in case it was lost, unless a command comes."""
        self._expired_s, self._since_s, self._ramp_s, self._command = now, None, 0.0, None
        self._next_s = now + REPEAT_S

    @property
    def period_s(self) -> float:
        """The usual time between commands, as they were born; 0: not known. It is the median: some are lost on their
        way, others are given at once."""
        known = len(self._intervals_s) >= FEW
        return sorted(self._intervals_s)[len(self._intervals_s) // 2] if known else 0.0

    @property
    def expired(self) -> bool:
        return self._expired_s is not None

    @property
    def slowing_since_s(self) -> float | None:
        """When slowing down began; None: it has not, or is over."""
        return self._since_s

    def deadline(self) -> float | None:
        """When something is due next; None: not armed, or said often enough."""
        return self._next_s

    def due(self, *, now: float) -> bool:
        """Whether to publish something now: what `slowed` says, or else the stop command."""
        if self._next_s is None or now < self._next_s:
            return False
        first = self._expired_s is None
        if self._expired_s is None:
            self._expired_s = now
            self.fired += 1
        if self._ramp is None:
            self._next_s = now + REPEAT_S if now - self._expired_s < REPEAT_FOR_S - REPEAT_S / 2 else None
            return True
        if first and self._since_s is None:
            self._begin(self._ramp, now)
        self._next_s = now + STEP_S if self._factor(now) > 0.0 else None
        return True

    def _begin(self, ramp: Ramp, since_s: float) -> None:
        command = self._command
        self._since_s, self._ramp_s = since_s, 0.0
        if command is not None:
            needed_s = max(command.linear_mps / ramp.linear_mps2, command.angular_radps / ramp.angular_radps2)
            self._ramp_s = min(needed_s, MAX_RAMP_S)

    def _factor(self, now: float) -> float:
        """What is left of the velocities one step from now: what is said now holds until then."""
        if self._since_s is None or self._ramp_s <= 0.0:
            return 0.0
        return max(0.0, 1.0 - (now + STEP_S - self._since_s) / self._ramp_s)

    def slowed(self, *, now: float) -> bytes | None:
        """What to publish now that something is due; None: the stop command."""
        factor = self._factor(now)
        if self._command is None or factor <= 0.0:
            return None
        return self._command.scaled(factor, now - self._said_s)


class GuardLease(CommandLease):
    """What a guard keeps: due `GRACE_S` after the deadline that the owner told last, or at once when it is gone."""

    __slots__ = ()

    def __init__(self, ramp: Ramp | None = None) -> None:
        super().__init__(GRACE_S, ramp)

    def told(self, next_s: float | None, *, since_s: float | None = None) -> None:
        """The owner's `deadline()` is this now: it has heard a command, or has said what was due itself. `since_s`: it
        is slowing the robot down since then."""
        self._expired_s = None
        self._next_s = None if next_s is None else next_s + GRACE_S
        self._since_s = None
        if since_s is not None and self._ramp is not None:
            self._begin(self._ramp, since_s)

    def commanded(self, command: TwistBody | None, *, said_s: float) -> None:
        """The command that the owner's deadline is about from now on."""
        self._command, self._said_s = command, said_s

    def abandoned(self, *, now: float) -> None:
        """The owner is gone. No more commands will come: the last one must not stand."""
        if self._next_s is not None and self._expired_s is None:
            self._next_s = min(self._next_s, now)
