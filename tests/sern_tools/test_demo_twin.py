"""The demo of the twin: what it makes of what it saw, and that it runs."""

import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from sern_core.vocabulary.errors import SernError
from sern_tools.demo_twin_report import Sample, TwinReport, as_html, judged, percentile, show, write

GONE = ((2.0, 8.0),)


def samples(off_m: float = 0.01, *, gap_off_m: float = 0.02, bound_m: float = 0.1) -> list[Sample]:
    """A robot that goes east at 1 m/s for 12 s; its twin is off to the north."""
    made = []
    for step in range(120):
        at_s = step / 10
        gone = GONE[0][0] <= at_s < GONE[0][1]
        age_s = at_s - GONE[0][0] if gone else 0.1
        off = gap_off_m if gone else off_m
        place = (at_s, 0.0, 0.0)
        made.append(Sample(at_s, place, place, (at_s, off, 0.0), age_s, bound_m + age_s, 0, 0, "trajectory", "says"))
    return made


def verdicts(report: TwinReport) -> dict[str, bool]:
    return {verdict.name: verdict.kept for verdict in report.verdicts}


def test_a_twin_that_stays_with_its_robot_keeps_every_promise() -> None:
    report = judged(samples(), GONE, 12.0, "sern demo-twin")
    assert report.ok and len(report.verdicts) == 8
    assert max(report.unhelped_m) == pytest.approx(5.9, abs=0.05)
    assert min(report.unhelped_m) == pytest.approx(0.1, abs=0.11)


STEADY, MEDIAN, P95 = "while the link is there, p95", "after 6 s: off, median", "after 6 s: off, p95"
BACK, HEARD, SNAPS = "back within 5 cm after the return", "gone for 6 s: nothing was heard for", "snaps"
UNHEARD, BOUND = "unheard, further off than it said", "heard, further off than it said"


def last(*, snaps: int = 0, violated: int = 0) -> list[Sample]:
    """The same, with something else at the end."""
    return [*samples()[:-1], samples()[-1]._replace(snaps=snaps, violated=violated)]


@pytest.mark.parametrize(
    ("made", "broken"),
    [
        (samples(0.06), {STEADY, BACK}),
        (samples(gap_off_m=0.06), {MEDIAN}),
        (samples(gap_off_m=0.08), {MEDIAN, P95}),
        (samples(bound_m=-0.2), {BOUND}),
        (samples(bound_m=-6.5), {BOUND, UNHEARD}),
        ([each._replace(age_s=0.1) for each in samples()], {HEARD}),
        (last(snaps=1), {SNAPS}),
        (last(violated=1), {UNHEARD}),
        (samples()[:75], {BACK}),
    ],
)
def test_a_broken_promise_is_named(made: list[Sample], broken: set[str]) -> None:
    report = judged(made, GONE, 12.0, "sern demo-twin")
    assert {name for name, kept in verdicts(report).items() if not kept} == broken


def test_nothing_seen_is_an_error() -> None:
    with pytest.raises(SernError, match="neither robot nor twin said"):
        judged([], GONE, 12.0, "sern demo-twin")
    assert percentile([], 0.5) == math.inf


def test_the_report_is_a_table_a_page_and_figures(tmp_path: Path) -> None:
    report = judged(samples(0.06), GONE, 12.0, "sern demo-twin --seed <1>")
    console = Console(record=True, width=120)
    show(report, console)
    assert "BROKEN" in console.export_text()
    files = {path.name: path for path in write(report, tmp_path / "out")}
    told = json.loads(files["twin.json"].read_text())
    assert len(told["samples"]) == 120 and told["samples"][0]["off_m"] == pytest.approx(0.06)
    assert {promise["kept"] for promise in told["promises"]} == {True, False}
    page = files["twin.html"].read_text()
    assert "--seed &lt;1&gt;" in page and "class='broken'" in page
    assert "No plots: matplotlib is not installed" in as_html(report, None)
