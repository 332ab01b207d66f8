"""Whether what the bridge holds open is what the endpoint has, and the middleware behind it: compared now and then."""

import logging
from typing import Final, Protocol

from sern_client.endpoints.base import Difference

CHECK_S: Final = 60.0
"""How often the tables are compared."""
CONFIRM_S: Final = 5.0
"""A difference counts when it is still there so long afterwards: until then something may be under way."""

_log = logging.getLogger(__name__)


class Comparable(Protocol):
    """What is checked: the bridge."""

    def validate(self) -> list[Difference]: ...

    def repair(self, differences: list[Difference]) -> None: ...


class TableCheck:
    """`tick` as often as you like. `found` is what differed when it was looked last, `total` what ever did."""

    def __init__(self, tables: Comparable, *, now: float) -> None:
        self.found: list[Difference] = []
        self.total = 0
        self._tables = tables
        self._suspected: list[Difference] = []
        self._due_s = now + CHECK_S

    def tick(self, *, now: float) -> None:
        """Compare if it is time to. What differs is logged, counted and repaired as far as that is possible."""
        if now < self._due_s:
            return
        found = self._look()
        confirmed = [difference for difference in found if difference in self._suspected]
        new = [difference for difference in confirmed if difference not in self.found]
        self._suspected = found
        self.found = confirmed
        self._due_s = now + (CONFIRM_S if found else CHECK_S)
        for difference in new:
            _log.error("what is here is not what should be: %s", difference)
        self.total += len(new)
        if new:
            self._tables.repair(new)

    def _look(self) -> list[Difference]:
        try:
            return self._tables.validate()
        except Exception:  # noqa: BLE001  a look must not end the client
            _log.exception("the tables of bridge and endpoint could not be compared")
            return []
