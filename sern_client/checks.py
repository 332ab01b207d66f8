"""Whether what the bridge holds open is what the endpoint has, and the middleware behind it: compared now and then."""

import logging
from dataclasses import dataclass
from typing import Final, Protocol

from sern_client.endpoints.base import Difference

CHECK_S: Final = 60.0
"""How often the tables are compared."""
CONFIRM_S: Final = 5.0
"""A difference counts when it is still there so long afterwards: until then something may be under way."""
REPAIR_S: Final = (5.0, 300.0)
"""First and longest pause before what a repair did not mend is repaired again; each is twice the one before."""

_log = logging.getLogger(__name__)


class Comparable(Protocol):
    """What is checked: `Tables`."""

    def validate(self) -> list[Difference]: ...

    def repair(self, differences: list[Difference]) -> None: ...


@dataclass(slots=True)
class _Repair:
    """The repairs of a difference: since when it is known, when the next one is, and the pause after that."""

    since_s: float
    due_s: float
    pause_s: float = REPAIR_S[0]


class TableCheck:
    """`tick` as often as you like. `found` is what differed when it was looked last, `total` what ever did."""

    def __init__(self, tables: Comparable, *, now: float) -> None:
        self.found: list[Difference] = []
        self.total = 0
        self.tables = tables
        self._suspected: list[Difference] = []
        self._due_s = now + CHECK_S
        self._repairs: dict[Difference, _Repair] = {}

    def tick(self, *, now: float) -> None:
        """Compare if it is time to. What differs is logged and counted once, and repaired until it is gone."""
        if now < self._due_s:
            return
        found = self._look()
        if found is None:  # nobody knows: what differed before is not taken to be right
            self._due_s = now + (CONFIRM_S if self._suspected else CHECK_S)
            return
        confirmed = [difference for difference in found if difference in self._suspected]
        new = [difference for difference in confirmed if difference not in self.found]
        self._suspected = found
        self.found = confirmed
        self._due_s = now + (CONFIRM_S if found else CHECK_S)
        for difference in new:
            _log.error("what is here is not what should be: %s", difference)
        self.total += len(new)
        for difference, repair in self._repairs.items():
            if difference not in confirmed:
                _log.error(
                    "what is here is what should be again: %s, after %.0f s", difference.name, now - repair.since_s
                )
        due = self._due_repairs(confirmed, now)
        if due:
            try:
                self.tables.repair(due)
            except Exception:  # noqa: BLE001  a repair must not end the client; it is tried again
                _log.exception("what is not what should be could not be opened anew")

    def _due_repairs(self, confirmed: list[Difference], now: float) -> list[Difference]:
        """What is to be repaired now, for the first time or again."""
        self._repairs = {difference: self._repairs.get(difference, _Repair(now, now)) for difference in confirmed}
        due = [difference for difference, repair in self._repairs.items() if repair.due_s <= now]
        for difference in due:
            repair = self._repairs[difference]
            repair.due_s = now + repair.pause_s
            repair.pause_s = min(2 * repair.pause_s, REPAIR_S[1])
        return due

    def _look(self) -> list[Difference] | None:
        """What differs now; None: it cannot be told."""
        try:
            return self.tables.validate()
        except Exception:  # noqa: BLE001  a look must not end the client
            _log.exception("the tables of bridge and endpoint could not be compared")
            return None
