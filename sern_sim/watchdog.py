"""Notices a simulated run in which time stands still."""

from typing import Final

from sern_sim.events import SimulationStuck

REPORTED_EVENTS: Final = 12


class Watchdog:
    """Counts what happens at one instant; more than `limit` is an endless loop, not traffic.

    The owner adds to `count`, sets it to 0 when time goes on, and `note`s what happens while it is above `quiet`: so
    only the last events before the limit cost anything.
    """

    __slots__ = ("_last", "_limit", "count", "quiet")

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._last: list[str] = []
        self.count = 0
        self.quiet = limit - REPORTED_EVENTS

    def note(self, elapsed_s: float, text: str) -> None:
        """Remember an event. Raises SimulationStuck with the last of them at the limit."""
        self._last.append(text)
        if self.count >= self._limit:
            raise SimulationStuck(elapsed_s, self._limit, self._last[-REPORTED_EVENTS:])

    def forget(self) -> None:
        """Time went on after all."""
        self._last.clear()
