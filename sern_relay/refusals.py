"""Who was refused at the door, and why: a table of a fixed size, whoever knocks how often.

A row is one key at one address. An address has `MAX_OF_ADDRESS` rows and all have `MAX_ROWS`: then the one that came
longest ago gives way, so that one host with a million keys hides nobody else. What has no row is counted.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from sern_runtime import clock
from sern_runtime.events import REFUSED, EventLog, wall_text

MAX_ROWS: Final = 128
MAX_OF_ADDRESS: Final = 8
_log: Final = logging.getLogger(__name__)


@dataclass(slots=True)
class Refused:
    """One key at one address. Without keys, and where none was given, `key` is empty."""

    address: str
    key: str
    why: str
    first_s: float
    last_s: float
    count: int = 0


class Refusals:
    """Told of every connection that was refused. `wall` in seconds since 1970."""

    def __init__(self, events: EventLog | None = None, *, wall: Callable[[], float] = time.time) -> None:
        self.total = 0
        """All that were refused so far."""
        self.gone = 0
        """Of these, refusals whose row has given way to others."""
        self._events = events or EventLog()
        self._wall = wall
        self._rows: dict[tuple[str, str], Refused] = {}  # the one that came longest ago first
        self._of_address: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._rows)

    def refuse(self, address: str, key: str, why: str) -> None:
        """Take a refusal into table, log and events."""
        _log.warning("refused a connection from %s: %s", address, why, extra={"event": REFUSED, "about": address})
        self.note(address, key, why)

    def note(self, address: str, key: str, why: str) -> None:
        """The same of one that is in the log already."""
        now = clock.now()
        self.total += 1
        row = self._rows.pop((address, key), None)
        if row is None:
            self._make_room(address)
            row = Refused(address, key, why, now, now)
            self._of_address[address] += 1
        row.why, row.last_s = why, now
        row.count += 1
        self._rows[address, key] = row
        self._events.add(REFUSED, address, f"refused a connection from {address}: {why}", key=key, reason=why)

    def _make_room(self, address: str) -> None:
        if self._of_address[address] >= MAX_OF_ADDRESS:
            self._forget(next(place for place in self._rows if place[0] == address))
        elif len(self._rows) >= MAX_ROWS:
            self._forget(next(iter(self._rows)))

    def _forget(self, place: tuple[str, str]) -> None:
        self.gone += self._rows.pop(place).count
        self._of_address[place[0]] -= 1
        if not self._of_address[place[0]]:
            del self._of_address[place[0]]

    def to_json(self) -> dict[str, Any]:
        """The latest first, with the time by the wall clock and how long ago it was."""
        now, wall_s = clock.now(), self._wall()
        return {
            "refused": [
                {
                    "address": row.address,
                    "key": row.key or None,
                    "why": row.why,
                    "count": row.count,
                    "first": wall_text(wall_s - (now - row.first_s)),
                    "first_s": now - row.first_s,
                    "last": wall_text(wall_s - (now - row.last_s)),
                    "last_s": now - row.last_s,
                }
                for row in reversed(self._rows.values())
            ],
            "refused_total": self.total,
            "refused_gone": self.gone,
        }
