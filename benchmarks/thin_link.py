"""How old what arrives over 64 kbit/s is, beside clouds that alone are five times what the link carries.

The real core in virtual time (`tests.thin_link`): 0.1 s one way, over datagrams of which 1 % are lost, and over a
stream; nothing adapts. Counted are 100 s, after the first 20; with losses a figure is the median of seven runs. No time
of this machine is in it, so a commit has one result.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from benchmarks.common import Report, main, medians, percentile
from benchmarks.link.figures import NEVER_S
from tests.thin_link import (
    CLOUD,
    COMMAND,
    COUNTED_S,
    DATAGRAM_S,
    DELAY_S,
    POSE,
    RATES_HZ,
    SEEDS,
    SIZES_BYTES,
    STATUS,
    play,
)

ROWS: Final = {
    f"{what}, {SIZES_BYTES[topic]:,} B, {RATES_HZ[topic]:g} Hz": topic
    for what, topic in (
        ("pose", POSE),
        ("command the other way", COMMAND),
        ("reliable status", STATUS),
        ("clouds", CLOUD),
    )
}
LIMITS_S: Final = {POSE: DELAY_S + 3 * DATAGRAM_S, COMMAND: DELAY_S + DATAGRAM_S, STATUS: DELAY_S + 6 * DATAGRAM_S}
"""p99 of the age: what is before it in the datagrams that have begun, at both ends, and what is sent again."""


def ages(found_s: Sequence[float], rate_hz: float) -> dict[str, float]:
    """The row of a topic, from the ages of what arrived, youngest first, and its rate."""
    row: dict[str, float] = {"offered_count": round(rate_hz * COUNTED_S), "arrived_count": len(found_s)}
    if found_s:
        row |= {
            "age_p50_s": percentile(found_s, 0.5),
            "age_p99_s": percentile(found_s, 0.99),
            "age_most_s": found_s[-1],
        }
    return row


def bench(options: argparse.Namespace, report: Report) -> None:
    lanes = {"datagrams, 1 % lost": False} if options.quick else {"datagrams, 1 % lost": False, "stream": True}
    for case, lossless in lanes.items():
        runs = [play(lossless=lossless, seed=seed) for seed in (SEEDS[:1] if lossless else SEEDS)]
        for name, topic in ROWS.items():
            row = medians([ages(run.ages_s(topic), RATES_HZ[topic]) for run in runs])
            report.row(case, name, **row)
            if topic in LIMITS_S:
                report.reach(f"{case}: p99 of {name} [s]", row.get("age_p99_s", NEVER_S), LIMITS_S[topic])
                share = row["arrived_count"] / row["offered_count"]
                report.reach(f"{case}: share of {name} that arrives", share, 0.98, at_least=True)
    idle = play(lossless=False, clouds=False)
    report.row("datagrams, without clouds", next(iter(ROWS)), **ages(idle.ages_s(POSE), RATES_HZ[POSE]))
    runs_note = f"{COUNTED_S:g} s; medians of {len(SEEDS)} runs with losses"
    report.note(f"virtual time; {runs_note}; a full datagram takes {DATAGRAM_S:.2f} s of the link")


if __name__ == "__main__":
    sys.exit(main("thin_link", bench, description=__doc__))
