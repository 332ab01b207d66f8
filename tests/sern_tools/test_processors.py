"""Whether the machine had time for what was measured on it."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from sern_tools import demo, demo_report, processors
from sern_tools.demo_scenario import Scenario
from sern_tools.processors import ProcessorTime, crowded
from tests.sern_tools.test_demo_report import report_of

STAT = """cpu  1000 200 300 4000 500 60 40 900 11 22
cpu0 1000 200 300 4000 500 60 40 900 11 22
intr 7
"""


def test_times_are_of_all_processors_and_what_a_host_took_counts_as_busy() -> None:
    found = ProcessorTime.parse(STAT, 2.5, 100)
    assert (found.total_s, found.busy_s, found.own_s) == pytest.approx((70.0, 25.0, 2.5))


@pytest.mark.parametrize("stat", ["", "cpu 1 2 3\n", "cpu0 1 2 3 4 5 6 7 8\n"])
def test_what_is_no_such_file(stat: str) -> None:
    with pytest.raises(ValueError, match="processors"):
        ProcessorTime.parse(stat, 0.0, 100)


def test_a_machine_that_is_full_is_said_with_what_others_took() -> None:
    said = crowded(ProcessorTime(100.0, 50.0, 5.0), ProcessorTime(200.0, 148.0, 25.0))
    assert said is not None and "98% busy while SERN ran, 78% with other work" in said


@pytest.mark.parametrize("busy_s", [0.0, 60.0, 89.0])
def test_a_machine_with_time_to_spare_is_not(busy_s: float) -> None:
    assert crowded(ProcessorTime(100.0, 50.0, 5.0), ProcessorTime(200.0, 50.0 + busy_s, 25.0)) is None


def test_no_time_at_all_is_not() -> None:
    assert crowded(ProcessorTime(100.0, 50.0, 5.0), ProcessorTime(100.0, 50.0, 5.0)) is None


def test_a_system_that_does_not_tell_is_asked_in_vain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processors, "STAT", tmp_path / "stat")
    assert ProcessorTime.now() is None
    assert crowded(None, ProcessorTime(1.0, 1.0, 0.0)) is None


def test_this_machine_tells_its_times() -> None:
    before, after = ProcessorTime.now(), ProcessorTime.now()
    assert before is not None and after is not None
    assert 0 < before.busy_s <= before.total_s <= after.total_s
    assert before.own_s <= after.own_s


@pytest.mark.parametrize(("busy_s", "said"), [(98.0, "98% busy"), (50.0, None)])
async def test_the_demo_says_it_of_the_run_of_sern_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, busy_s: float, said: str | None
) -> None:
    total_s, now_s = 0.0, 0.0

    def part(busy_share: float, result: object) -> object:
        async def runs(_demo: object) -> object:
            nonlocal total_s, now_s
            total_s, now_s = total_s + 100.0, now_s + 100.0 * busy_share
            return result

        return runs

    monkeypatch.setattr(demo, "ProcessorTime", type("Clock", (), {"now": lambda: ProcessorTime(total_s, now_s, 0.0)}))
    monkeypatch.setattr(demo.Demo, "idle_latency", part(1.0, {"robot": 0.025}))
    monkeypatch.setattr(demo.Demo, "run_sern", part(busy_s / 100, demo.Run()))
    monkeypatch.setattr(demo.Demo, "run_baseline", part(1.0, demo.Run()))
    monkeypatch.setattr(demo.Demo, "judge", lambda *_arguments: report_of())
    file = tmp_path / "file"
    scenario = Scenario(report_of().scenario.profile, 10)
    options = demo.Options(scenario=scenario, out=tmp_path, json_file=file, html_file=file, picture_file=None)
    report = await demo.Demo(options, tmp_path, Console(file=StringIO())).run()
    assert len(report.remarks) == (said is not None)
    if said is not None:
        out = StringIO()
        demo_report.print_summary(report, Console(file=out, width=300))
        assert said in out.getvalue() and said in demo_report.as_html(report)
