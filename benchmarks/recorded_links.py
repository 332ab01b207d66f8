"""Recordings of cellular links: the packets of 1504 bytes that one could deliver in each 20 ms, a line each.

Looked for in `../shared/data/cellular`; those of the Sprout paper (Winstein et al., NSDI 2013) are not ours to ship.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

from benchmarks.flows import OVERHEAD_BYTES
from benchmarks.recordings import DATA
from sern_core.vocabulary.errors import ConfigError
from sern_sim.models import LinkModel, RateStep

CELLULAR: Final = DATA / "cellular"
DELAY_S: Final = 0.025
SLOT_S: Final = 0.020
SLOT_PACKET_BYTES: Final = 1504
STEP_SLOTS: Final = 5
"""The rate is that of so many slots."""
QUEUE_PACKETS: Final = 1000


def read(path: Path) -> list[int]:
    """Packets that the link could deliver in each slot. ConfigError of one line for a file that is none."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        return [int(line) for line in lines if line and not line.startswith("#")]
    except (OSError, ValueError) as error:
        raise ConfigError(f"is no recording of a link: {error}", file=str(path)) from None


def recorded(slots: Sequence[int], seconds: float | None = None) -> tuple[LinkModel, float]:
    """The link, and how long it lasts, at most `seconds`. Where it delivers nothing what was sent waits."""
    step_s = STEP_SLOTS * SLOT_S
    count = len(slots) // STEP_SLOTS
    if seconds is not None:
        count = min(count, round(seconds / step_s))
    rates_bps = [
        max(1.0, sum(slots[n * STEP_SLOTS : (n + 1) * STEP_SLOTS]) * SLOT_PACKET_BYTES * 8 / step_s)
        for n in range(count)
    ]
    steps = [RateStep(n * step_s, rate_bps) for n, rate_bps in enumerate(rates_bps)]
    changes = tuple(after for before, after in pairwise(steps) if after.rate_bps != before.rate_bps)
    model = LinkModel(
        rate_bps=rates_bps[0],
        delay_s=DELAY_S,
        overhead_bytes=OVERHEAD_BYTES,
        rate_steps=changes,
        queue_packets=QUEUE_PACKETS,
    )
    return model, count * step_s
