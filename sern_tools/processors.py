"""How busy the processors of this machine were, with our own work and with that of others."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

STAT: Final = Path("/proc/stat")
FULL: Final = 0.9
"""Above this share of the processors' time a process that has something to do waits for its turn."""
_IDLE: Final = (3, 4)
"""Where `idle` and `iowait` stand in the first line of STAT."""
_COUNTED: Final = 8
"""`user` to `steal`; the guests that follow are in `user` already."""


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """Seconds since some time ago, of all processors together. `own_s`: of this process and its ended children."""

    total_s: float
    busy_s: float
    own_s: float

    @classmethod
    def parse(cls, stat: str, own_s: float, ticks_hz: float) -> Self:
        """Read the text of /proc/stat. Raises ValueError when it is none."""
        words = stat.partition("\n")[0].split()
        numbers = words[1:]
        if words[:1] != ["cpu"] or len(numbers) < _COUNTED:
            raise ValueError("no times of all processors")
        times_s = [int(number) / ticks_hz for number in numbers[:_COUNTED]]
        return cls(sum(times_s), sum(times_s) - sum(times_s[at] for at in _IDLE), own_s)

    @classmethod
    def now(cls) -> Self | None:
        """None where the system does not tell it: the file is Linux's."""
        own = os.times()
        own_s = own.user + own.system + own.children_user + own.children_system
        try:
            return cls.parse(STAT.read_text(), own_s, os.sysconf("SC_CLK_TCK"))
        except (OSError, ValueError):
            return None


def crowded(before: ProcessorTime | None, after: ProcessorTime | None) -> str | None:
    """What to say of figures that were taken in between, where the processors were full.

    None where they were not, or where nobody knows.
    """
    if before is None or after is None:
        return None
    total_s = after.total_s - before.total_s
    if total_s <= 0 or (busy := (after.busy_s - before.busy_s) / total_s) < FULL:
        return None
    others = max(0.0, busy - (after.own_s - before.own_s) / total_s)
    return (
        f"The processors of this machine were {busy:.0%} busy while SERN ran, {others:.0%} with other work: what came "
        "late or was dropped is the machine's doing as well as the link's. Try again when it has less to do."
    )
