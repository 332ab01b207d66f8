"""What the cells that were played amount to, as a benchmark writes it: `pytest tests/matrix --figures FILE`."""

from collections.abc import Sequence
from typing import NamedTuple

from benchmarks.common import Report, percentile
from tests.matrix.cells import CELLS, Cell
from tests.matrix.play import POSE, Play


class Played(NamedTuple):
    """One cell that is over. `ages_s`: true ages of the poses that arrived."""

    cell: Cell
    kept: bool
    ages_s: list[float]


def of(play: Play) -> Played:
    """What is told of a play; call it when that is over."""
    sent = play.robot.sent
    return Played(play.cell, not play.broken, [got.at_s - sent[POSE, got.seq][0] for got in play.site.on(POSE)])


def report(played: Sequence[Played]) -> Report:
    """A row for each profile and load: how many cells kept all promises, and how old poses were, faults included."""
    found = Report("matrix")
    for profile in dict.fromkeys(one.cell.profile for one in played):
        for load in dict.fromkeys(one.cell.load for one in played):
            mine = [one for one in played if (one.cell.profile, one.cell.load) == (profile, load)]
            if not mine:
                continue
            row = {"cells_count": len(mine), "kept_count": sum(one.kept for one in mine)}
            found.row(profile, str(load), **row, **_ages(sorted(age_s for one in mine for age_s in one.ages_s)))
    kept = sum(one.kept for one in played) / len(played)
    found.reach("cells that were played", len(played), len(CELLS), at_least=True)
    found.reach("share of them that kept all promises", kept, 1.0, at_least=True)
    found.note(
        "virtual time; each with no fault, a blackout, a flapping path and bursts of loss, on one lane and on two"
    )
    return found


def _ages(ages_s: Sequence[float]) -> dict[str, float]:
    if not ages_s:
        return {}
    return {"pose_p50_ms": 1e3 * percentile(ages_s, 0.5), "pose_p99_ms": 1e3 * percentile(ages_s, 0.99)}
