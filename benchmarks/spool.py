"""What a fetch of kept messages costs what is live, and how much of the free link it uses.

The real core in virtual time (`tests.spool_link`): a pose at 50 Hz, clouds that take three tenths of the link, commands
the other way; with and without a fetch of 30 kB messages without end. Counted are 60 s, after the first 15. No time of
this machine is in it, so a commit has one result.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from benchmarks.common import Report, main, percentile
from tests.spool_link import CLOUD, COMMAND, POSE, Played, ThinPath, idle_share, play

PATHS: Final = {
    "256 kbit/s 200 ms": ThinPath(256e3, 0.1),
    "1 Mbit/s 100 ms": ThinPath(1e6, 0.05),
    "1 Mbit/s 100 ms, 1 % lost": ThinPath(1e6, 0.05, loss=0.01),
    "4 Mbit/s 50 ms": ThinPath(4e6, 0.025),
}
TOPICS: Final = {"pose": POSE, "command": COMMAND, "cloud": CLOUD}
LIVE: Final = {"poses, commands": False, "poses, commands, clouds": True}
IDLE_SHARE: Final = 0.8


def ages(found_s: Sequence[float], name: str) -> dict[str, float]:
    """The figures of a topic, from the ages of what arrived, youngest first."""
    if not found_s:
        return {}
    return {f"{name}_p50_ms": 1e3 * percentile(found_s, 0.5), f"{name}_p99_ms": 1e3 * percentile(found_s, 0.99)}


def figures(run: Played) -> dict[str, float]:
    """The row of a run."""
    row: dict[str, float] = {}
    for name, topic in TOPICS.items():
        row |= ages(run.ages_s(topic), name)
    return row


def bench(options: argparse.Namespace, report: Report) -> None:
    paths = dict(list(PATHS.items())[1:2]) if options.quick else PATHS
    for case, path in paths.items():
        for live, clouds in LIVE.items():
            alone, beside = (play(path, fetch=fetch, clouds=clouds) for fetch in (False, True))
            share = idle_share(alone, beside)
            report.row(case, f"{live} alone", **figures(alone))
            report.row(case, f"{live} beside a fetch", **figures(beside), idle_share_percent=100 * share)
            for name in ("pose", "command"):
                added_ms = figures(beside)[f"{name}_p99_ms"] - figures(alone)[f"{name}_p99_ms"]
                report.reach(f"{case}, {live}: p99 of a {name}, added [ms]", added_ms, 1e3 * path.datagram_s)
            report.reach(f"{case}, {live}: share of the free link for a fetch", share, IDLE_SHARE, at_least=True)
    report.note("virtual time; 60 s; what may be added is one full datagram's time on the link")
    report.note("without clouds a pose alone meets an empty link")


if __name__ == "__main__":
    sys.exit(main("spool", bench, description=__doc__))
