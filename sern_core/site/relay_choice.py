"""The choice among a client's relays: when it goes to another one, and to which. Pure.

The order of the list is the order of preference. A relay that does not answer for a while is left for the next one in
the list, and the last is followed by the first. A relay before the one that the client is at is asked now and then, and
when it has answered for long enough without interruption the client goes back to it. So it does at once when one of its
peers has gone: they find it at different times, and have no use of each other at different relays.

Time counts in looks, each for so much at most: of a process that stood still no relay was silent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

MAX_LOOK_S: Final = 1.0
"""The most that the time between two looks counts for."""


class MoveReason(StrEnum):
    """Why a client goes to another relay."""

    SILENT = "silent"
    """The one it is at did not answer."""
    RETURN = "return"
    """One that it prefers answers again."""
    FOLLOW = "follow"
    """A peer has gone back, and a relay that is preferred answers here, too."""


@dataclass(frozen=True, slots=True)
class Move:
    """The client is to go to the relay with this place in the list."""

    to: int
    reason: MoveReason


class RelayChoice:
    """`patience_s` has, for each relay of the list, how long it may take to let a connection in that it has begun to
    let in. Call `look` some times a second, and do what it says; `moved` when that is done."""

    def __init__(self, patience_s: Sequence[float], *, failover_s: float, return_s: float, now: float) -> None:
        self._patience_s = tuple(patience_s)
        self._failover_s = failover_s
        self._return_s = return_s
        self.at = 0
        """The place of the relay at which the client is, or which it tries."""
        self._looked_s = now
        self._silent_s = 0.0
        self._since_s: dict[int, float] = {}  # since when a relay before that one has answered
        self._heard_s: dict[int, float] = {}  # when it did last

    @property
    def better(self) -> range:
        """The places of the relays that are to be asked, and told of with `answered`."""
        return range(self.at)

    @property
    def silent_s(self) -> float:
        """How long the relay at which the client is has not answered."""
        return self._silent_s

    def answering_s(self, place: int, now: float) -> float | None:
        """How long a relay that is asked has answered without interruption, until it did last; None: it does not."""
        if place not in self._since_s or now - self._heard_s[place] > self._failover_s:
            return None
        return self._heard_s[place] - self._since_s[place]

    def answered(self, place: int, now: float) -> None:
        """A relay that was asked has answered."""
        if self.answering_s(place, now) is None:
            self._since_s[place] = now
        self._heard_s[place] = now

    def look(self, now: float, *, answers: bool, letting_in: bool, left_behind: bool = False) -> Move | None:
        """What to do now. `answers`: the relay at which the client is, since the last look or lately enough.
        `letting_in`: it has begun to let the first connection in, and has not ended that. `left_behind`: a peer has
        gone from that relay to another one."""
        elapsed_s, self._looked_s = min(max(0.0, now - self._looked_s), MAX_LOOK_S), now
        self._silent_s = 0.0 if answers else self._silent_s + elapsed_s
        for place in self.better:
            answering_s = self.answering_s(place, now)
            if answering_s is not None and answering_s >= self._return_s:
                return Move(place, MoveReason.RETURN)
            if answering_s is not None and left_behind:
                return Move(place, MoveReason.FOLLOW)
        count = len(self._patience_s)
        patience_s = max(self._failover_s, self._patience_s[self.at]) if letting_in else self._failover_s
        if count > 1 and self._silent_s >= patience_s:
            return Move((self.at + 1) % count, MoveReason.SILENT)
        return None

    def moved(self, to: int, now: float) -> None:
        """The client has left the relay where it was for another one. Who answered before has to do so anew."""
        self.at = to
        self._looked_s = now
        self._silent_s = 0.0
        self._since_s.clear()
        self._heard_s.clear()
