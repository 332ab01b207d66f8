"""Who commands a robot: of several operators on one command topic one holds it, kept at the robot. Pure.

Who commands first holds it, and holds it while its commands come: after `lapse_s` without one nobody does. Another
operator asks, and gets it when nobody holds it or the holder gives it; or takes it by force. Whoever's commands were
refused gets it in these two ways alone: a joystick that goes on saying something must not set a robot off because
another operator has paused.
"""

from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName

ASKED_S: Final = 30.0
"""How long somebody who has asked is remembered."""
MAX_ASKED: Final = 16
"""Who may wait at once; later ones ask again."""
MAX_REFUSED: Final = 64


class Hold:
    """One command topic's. Every call returns or leaves what holds then; `holder` None: nobody."""

    def __init__(self, lapse_s: float) -> None:
        self.lapse_s = lapse_s
        """How long a holder may be silent."""
        self.holder: ClientName | None = None
        self.changes = 0
        """How often that, or who asks, has changed."""
        self._heard_s = 0.0  # the holder
        self._asked: dict[ClientName, float] = {}  # who asks, and when
        self._refused: dict[ClientName, None] = {}

    @property
    def asked(self) -> tuple[ClientName, ...]:
        """Who has asked for it, the first first."""
        return tuple(self._asked)

    def command(self, who: ClientName, *, now: float) -> bool:
        """Whether a command of somebody is obeyed."""
        self.look(now=now)
        if self.holder is None and who not in self._refused:
            self._have(who, now)
        if who == self.holder:
            self._heard_s = now
            return True
        if len(self._refused) < MAX_REFUSED:
            self._refused[who] = None
        return False

    def ended(self, who: ClientName) -> None:
        """Somebody's commands have ended: who begins anew may hold it by commanding."""
        self._refused.pop(who, None)

    def ask(self, who: ClientName, *, now: float) -> None:
        """Somebody would like to hold it."""
        self.look(now=now)
        if self.holder is None or self.holder == who:
            self._have(who, now)
        elif who in self._asked or len(self._asked) < MAX_ASKED:
            self.changes += who not in self._asked
            self._asked[who] = now

    def force(self, who: ClientName, *, now: float) -> None:
        """Somebody takes it, whoever holds it."""
        self._have(who, now)

    def give(self, who: ClientName, *, now: float) -> None:
        """The holder gives it to who has asked first, or to nobody. Raises UsageError of anybody else."""
        self.look(now=now)
        if who != self.holder:
            raise UsageError(f"{who} does not hold it")
        if self._asked:
            self._have(next(iter(self._asked)), now)
        else:
            self.holder = None
            self.changes += 1

    def look(self, *, now: float) -> None:
        """Let go of what has lapsed. Call it about once a second."""
        for who in [who for who, at_s in self._asked.items() if now - at_s > ASKED_S]:
            del self._asked[who]
            self.changes += 1
        if self.holder is not None and now - self._heard_s > self.lapse_s:
            self.holder = None
            self.changes += 1
            if self._asked:
                self._have(next(iter(self._asked)), now)

    def _have(self, who: ClientName, now: float) -> None:
        before, self.holder, self._heard_s = self.holder, who, now
        self.changes += before != who
        if self._asked.pop(who, None) is not None:
            self.changes += 1
        self._refused.pop(who, None)
        if before is not None and before != who and len(self._refused) < MAX_REFUSED:
            self._refused[before] = None
