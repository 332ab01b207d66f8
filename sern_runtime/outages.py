"""Losses and recoveries in pairs: whoever was told of the one is told of the other, at the same level and as events."""

import logging
from dataclasses import dataclass
from typing import Final

from sern_runtime.events import EventLog

SILENT: Final = "silent"
ANSWERS: Final = "answers"
"""Events of an outage that was said, and of its end."""
SAY_AFTER_S: Final = 3.0
"""A path that is silent for less is no news: bad links do so all the time."""


@dataclass(slots=True)
class _Outage:
    since_s: float
    said: bool = False


class Outages:
    """Who is silent now, by name. Call `look` about once a second for each."""

    def __init__(
        self, log: logging.Logger, level: int, *, after_s: float = SAY_AFTER_S, events: EventLog | None = None
    ) -> None:
        self._log = log
        self._events = events or EventLog()
        self._level = level
        self._after_s = after_s
        self._outages: dict[str, _Outage] = {}

    def look(self, peer: str, *, lost: bool, gone: str, back: str, now: float) -> None:
        """`gone` and `back` are what is said; how long it was is put behind `back`."""
        outage = self._outages.get(peer)
        if not lost:
            if outage is not None:
                del self._outages[peer]
                if outage.said:
                    after_s = now - outage.since_s
                    self._events.say(
                        self._log, self._level, ANSWERS, peer, "%s, after %.0f s", back, after_s, after_s=after_s
                    )
        elif outage is None:
            self._outages[peer] = _Outage(now)
        elif not outage.said and now - outage.since_s >= self._after_s:
            outage.said = True
            self._events.say(self._log, self._level, SILENT, peer, "%s", gone)

    def since_s(self, peer: str) -> float | None:
        """The time since which a peer has been silent; None: it is not."""
        outage = self._outages.get(peer)
        return None if outage is None else outage.since_s

    def forget(self, peer: str) -> None:
        """Its silence ended with something else, of which was told."""
        self._outages.pop(peer, None)
