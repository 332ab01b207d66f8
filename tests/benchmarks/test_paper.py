"""The report on the paper: its arithmetic, what it says of claims, and how it is run, interrupted and gone on with."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("scipy", reason="the extra twin is not installed")
pytest.importorskip("jinja2", reason="the extra report is not installed")
pytest.importorskip("matplotlib", reason="the extra report is not installed")

from benchmarks.paper import errata, report, running, steps
from benchmarks.paper.claims import RECONFIGURED, SYNC_BLACKOUT, SYNC_MODERATE, Figures, Holds, claims
from benchmarks.paper.published import BREAKDOWN, GAPS, MODES, POLICIES
from benchmarks.paper.running import Result, kept, run, run_all
from benchmarks.paper.steps import STEPS, Company, Step
from benchmarks.paper.steps import drives as kept_drives
from benchmarks.paper.tables import sections
from sern_core.vocabulary.errors import ConfigError, SernError
from sern_tools.checkout import ROOT

LIMITED_MPS = 0.5000000000000001
"""What arithmetic leaves of a limit of half a metre a second."""
BY_NAME = {step.name: step for step in reversed(STEPS)}


def result(name: str, *rows: dict[str, Any]) -> Result:
    return Result(BY_NAME[name], {"rows": list(rows), "notes": [f"{name} as it was run"]}, command=f"python -m {name}")


def row(case: str, system: str, **figures: float) -> dict[str, Any]:
    return {"case": case, "system": system, **figures}


def everything() -> dict[str, Result]:
    """Results that bear the paper out, but for what it says of a gap."""
    sync = result(
        "sync",
        row(SYNC_MODERATE, "shared trajectory", p95_cm=2.7, p95_deg=1.1),
        row(SYNC_BLACKOUT, "shared trajectory", median_cm=1.9, p95_deg=1.4, bound_m=24.0, within_bound_percent=100.0),
        row(SYNC_BLACKOUT, "last command", median_cm=1874.0, p95_deg=177.0, bound_m=120.0, within_bound_percent=100.0),
        row(SYNC_BLACKOUT, "fixed gains, no prediction", median_cm=1823.0, p95_deg=93.0),
        row(SYNC_BLACKOUT, "constant twist", median_cm=1839.0, p95_deg=82.0, bound_m=120.0, within_bound_percent=100.0),
        *(
            row(
                "stop in the gap",
                f"{before} s before its end",
                snapped_percent=0.0,
                back_s=2.0,
                correction_mps=LIMITED_MPS,
            )
            for before in ("0.5", "1", "2")
        ),
        row(
            "bound",
            "ā holds",
            tried_gaps=1000,
            violated_gaps=0,
            speed_violated_gaps=0,
            state_violated_gaps=0,
            state_over_position_bound=16.0,
        ),
        row("scene patches: a new obstacle of 1 m²", "site to robot", offset_median_cm=0.7, offset_p95_cm=2.4),
        row("scene patches: 256 kbit/s, 0 % loss, poses at 20 Hz", "robot to site", told_hz=10.0, moved_hz=10.0),
    )
    lab = result("sync_lab", row("the lab's link: wifi", "with the robot's plan", p95_cm=3.5, p95_deg=1.9))
    modes = result(
        "navigation",
        *(
            row("400 campuses, a twin", mode, success_percent=printed.success_percent, from_percent=printed.low_percent,
                to_percent=printed.high_percent, time_median_s=printed.time_s, interventions_run=printed.interventions)
            for mode, printed in MODES.items()
        ),
    )  # fmt: skip
    policies = [
        (f"{profile} step", POLICIES[policy], printed)
        for profile, each in BREAKDOWN.items()
        for policy, printed in each.items()
    ]
    mmcf = result(
        "mmcf",
        *(
            row(case, policy, cost_1=cost.total, latency_1=cost.latency, unreliability_1=1 - cost.reliability,
                compute_1=cost.compute, bandwidth_1=cost.bandwidth)
            for case, policy, cost in policies
        ),
    )  # fmt: skip
    lines = [
        row("load by time, two streams are 1", f"{at / 10:.2f} s", load_1=1.0 + (20 < at < 80)) for at in range(120)
    ]
    stream = row(
        RECONFIGURED, "SERN", detected_s=0.4, forwarded_s=0.1, removed_s=0.3, detected_half_s=0.05, longest_s=0.02,
        load_during_1=1.4, load_after_1=1.0, cpu_percent=20.0,
    )  # fmt: skip
    loads = [
        row(f"{robots} robots, small clouds, {link} link", system, latency_ms=latency_ms, latency_half_ms=0.2,
            p99_ms=20.0, came_percent=100.0, far_percent=cpu, far_MB=300.0, power_W=2.0)
        for robots in (2, 3, 5) for link in ("idle", "full")
        for system, latency_ms, cpu in
        (("tcpros", 10.0, 10.0), ("sern", 8.0, 8.0), ("zmq", 9.0, 5.0), ("zenoh", 9.0, 5.0))
    ]  # fmt: skip
    results = (result("scaling", *loads), sync, lab, modes, mmcf, result("reconfiguration", stream, *lines))
    return {each.step.name: each for each in results} | {
        "mmcf_lab": Result(BY_NAME["mmcf_lab"], why="the lab's link needs root: sudo make paper")
    }


# --- arithmetic ---------------------------------------------------------------------------------------------------


def test_the_printed_totals_need_compute_to_weigh_most() -> None:
    least = errata.least_weight("teleoperation", 2)
    assert least is None or least > 0.35, "the text gives most weight to latency"


@pytest.mark.parametrize("profile", list(BREAKDOWN))
def test_with_our_weights_the_printed_terms_keep_their_order(profile: str) -> None:
    assert sum(errata.WEIGHTS[profile]) == pytest.approx(1.0)
    totals = errata.totals(profile)
    assert min(totals, key=totals.__getitem__) == "MMCF"
    assert max(totals, key=totals.__getitem__) == "Fixed Reliability"


def test_twenty_trials_do_not_tell_the_modes_apart() -> None:
    assert errata.fisher("SERN", "Real Only") == pytest.approx(0.605, abs=0.01)
    assert errata.fisher("SERN", "Sim Only") == pytest.approx(0.0915, abs=0.002)
    low, high = errata.wilson_percent("Real Only")
    assert low < MODES["Real Only"].low_percent - 10 and high > MODES["Real Only"].high_percent + 5


def test_the_spherical_tangent_is_off_by_what_the_readings_say() -> None:
    north, east = errata.tangent_error_percent()
    assert north == pytest.approx(0.157, abs=0.002) and east == pytest.approx(-0.246, abs=0.002)


def test_equal_decay_of_the_gains_takes_the_damping_away() -> None:
    assert errata.damping(0.1, 0.1, 30.0) == pytest.approx(0.223, abs=0.001)
    assert errata.overshoot_percent(errata.damping(0.1, 0.1, 30.0)) == pytest.approx(49, abs=1)
    assert errata.damping(0.2, 0.1, 30.0) == pytest.approx(1.0)
    assert errata.overshoot_percent(1.0) == 0.0


def test_five_centimetres_after_half_a_minute_need_next_to_no_mismatch() -> None:
    assert errata.largest_mismatch(0.05, 30.0) == pytest.approx(1.1e-4, rel=0.02)


def test_each_erratum_says_where_and_what() -> None:
    found = list(errata.errata())
    assert len(found) == len(errata.ALL)
    assert all(text for each in found for text in each)


# --- what is said -------------------------------------------------------------------------------------------------


def test_claims_are_judged_by_figures() -> None:
    told = {claim.text: claim for claim in claims(Figures(list(everything().values())))}
    no = [text for text, claim in told.items() if claim.holds is Holds.NO]
    assert no == ["After 30 s without a link, going on with the last control inputs, it is about 5 cm off."]
    unknown = [claim for claim in told.values() if claim.holds is Holds.UNKNOWN]
    assert [claim.why for claim in unknown] == ["the lab's link needs root: sudo make paper"]


def test_a_load_that_grows_faster_is_no_gradual_one() -> None:
    results = everything()
    found = results["scaling"].found
    assert found is not None
    case = "5 robots, small clouds, idle link"
    next(each for each in found["rows"] if (each["case"], each["system"]) == (case, "sern"))["far_percent"] += 1.0
    told = {claim.text: claim for claim in claims(Figures(list(results.values())))}
    claim = told["CPU rises more gradually with the number of robots."]
    assert claim.holds is Holds.NO and "small clouds, idle link: +1 against +0 % of a core" in claim.why


def test_with_one_number_of_robots_nothing_can_be_told_of_growth() -> None:
    rows = [
        row("2 robots, small clouds, idle link", system, latency_ms=1.0, far_percent=1.0, far_MB=1.0)
        for system in ("sern", "tcpros")
    ]
    told = {claim.text: claim for claim in claims(Figures([result("scaling", *rows)]))}
    assert told["So does memory."].holds is Holds.UNKNOWN
    assert "one number of robots" in told["So does memory."].why


def drives_of(campuses: int, *, sern_from_percent: float) -> Figures:
    figures = {"success_percent": 80.0, "time_median_s": 60.0, "interventions_run": 0.0}
    return Figures(
        [
            result(
                "navigation",
                *(
                    row(f"{campuses} campuses", mode, **figures, from_percent=low, to_percent=low + 10.0)
                    for mode, low in zip(MODES, (75.0, 60.0, sern_from_percent), strict=True)
                ),
                row("where SERN and Sim Only both reach the goal", "SERN", time_median_s=59.0),
            )
        ]
    )


def test_of_few_campuses_nothing_can_be_told() -> None:
    told = [claim for claim in claims(drives_of(4, sern_from_percent=90.0)) if claim.where == "tab:baselines"]
    assert {claim.holds for claim in told} == {Holds.UNKNOWN}
    assert {claim.why for claim in told} == {"it was measured on 4 campuses: a full run has more"}


@pytest.mark.parametrize(("low", "holds"), [(86.0, Holds.YES), (80.0, Holds.UNKNOWN), (60.0, Holds.NO)])
def test_success_is_compared_by_its_intervals(low: float, holds: Holds) -> None:
    told = {claim.text: claim for claim in claims(drives_of(400, sern_from_percent=low))}
    assert told["SERN reaches the goal most often."].holds is holds
    assert told["SERN needs the least help."].holds is Holds.NO, "all need as much"
    assert "where SERN and Sim Only both reach the goal: SERN 59.0 s" in told["SERN is the fastest there."].why


def test_nothing_can_be_told_of_what_was_not_run() -> None:
    assert {claim.holds for claim in claims(Figures([]))} == {Holds.UNKNOWN}


def test_every_table_of_the_paper_has_its_section(tmp_path: Path) -> None:
    found = {section.label: section for section in sections(Figures(list(everything().values())), tmp_path)}
    assert {"tab:sync_summary", "tab:baselines", "tab:mmcf_eval", "tab:mmcf_breakdown"} <= found.keys()
    assert len(found["tab:sync_summary"].rows) == len(GAPS) + 2
    assert [cells[0] for cells in found["tab:baselines"].rows] == [mode for mode in MODES for _ in range(2)]
    assert found["tab:mmcf_eval"].rows[0] == ("teleoperation", "Fixed Throughput", "0.43", "–", "0.430")
    for section in found.values():
        assert section.why or all(len(cells) == len(section.headings) for cells in section.rows)


def test_steps_of_one_benchmark_are_one_table() -> None:
    parts = [each for each in STEPS if each.name == "scaling"]
    assert [each.key for each in parts] == ["scaling_small", "scaling_large"]
    small, large = (
        Result(each, {"rows": [row(f"2 robots, {each.part} clouds, idle link", "sern", latency_ms=1.0)], "notes": []})
        for each in parts
    )
    assert [each["case"] for each in Figures([small, large]).rows("scaling")] == [
        "2 robots, small clouds, idle link", "2 robots, large clouds, idle link"
    ]  # fmt: skip
    failed = Result(parts[1], why="exit status 1", failed=True)
    assert Figures([small, failed]).why("scaling") == "exit status 1"


def test_as_many_trials_as_the_paper_has_are_a_row_of_their_own(tmp_path: Path) -> None:
    drives = [
        {"seed": seed, "mode": mode, "accuracy": 0.9, "link": "wifi", "reached": seed < 17, "time_s": 60.0 + seed,
         "interventions": 1}
        for mode in MODES for seed in range(25)
    ]  # fmt: skip
    kept_drives(tmp_path).write_text("".join(json.dumps(each) + "\n" for each in drives))
    found = {section.label: section for section in sections(Figures(list(everything().values())), tmp_path)}[
        "tab:baselines"
    ]
    small = [cells for cells in found.rows if cells[1] == "the first 20 campuses"]
    assert [cells[0] for cells in small] == list(MODES)
    assert small[0][2:] == ("85.0 (64.0 to 94.8)", "68.0", "1.00")


def test_the_page_has_all_of_it_and_needs_nothing_else(tmp_path: Path) -> None:
    results = list(everything().values())
    results.append(Result(BY_NAME["sync_lab"], None, "exit status 1: <no> link", True, "python -m x", 1.0))
    page = report.html(results, tmp_path, quick=True)
    assert page.count("<h2>") == 1 + 6 + 2
    assert "does not hold" in page and "tab:baselines" in page and "Quick run of commit" in page
    assert "&lt;no&gt; link" in page, "what programs say is no markup"
    assert page.count("data:image/png;base64,") == 2, "both figures"
    assert 'src="http' not in page and "<link" not in page


def test_a_name_of_the_code_looks_like_one(tmp_path: Path) -> None:
    page = report.html([], tmp_path, quick=True)
    assert "(<code>plan_tracking</code>)" in page and "`" not in page


def test_without_what_draws_the_page_says_so_and_has_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = report.html(list(everything().values()), tmp_path, quick=True)
    assert "No pictures: the report needs matplotlib: pip install matplotlib" in page
    assert "<img" not in page and "fig:runtime_reconfig_demo" in page


def test_without_scipy_its_sums_are_left_out_and_the_others_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("scipy.optimize", "scipy.stats"):
        monkeypatch.setitem(sys.modules, name, None)
    found = list(errata.errata())
    assert [each.label for each in found] == list(errata.ALL)
    left_out = [each.label for each in found if "pip install 'sern[twin]'" in each.follows]
    assert left_out == ["tab:mmcf_eval, tab:mmcf_breakdown", "tab:baselines"]


def test_without_a_browser_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SernError, match="install the Debian package chromium"):
        report.print_pdf(tmp_path / "report.html", tmp_path / "report.pdf")


# --- how it is run ------------------------------------------------------------------------------------------------


def step(name: str, missing: str = "", company: Company = Company.NONE) -> Step:
    return Step(name, f"the step {name}", (), ("--quick",), (1, 1), lambda: missing, company=company)


def test_what_a_step_lacks_leaves_it_out(tmp_path: Path) -> None:
    found = run(step("scheduler", "it needs a harbour: build one"), tmp_path, quick=True)
    assert (found.found, found.failed, found.why) == (None, False, "it needs a harbour: build one")


def test_a_step_that_fails_is_told_with_its_last_words_and_the_rest_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = run_all([step("no_such_benchmark"), step("other", "it is left out")], tmp_path, quick=True)
    assert results[0].failed and "No module named benchmarks.no_such_benchmark" in results[0].why
    assert results[1].why == "it is left out"
    told = capsys.readouterr().err
    assert "[1/2]" in told and "failed: exit status 1" in told and "left out: it is left out" in told


def test_only_what_may_have_company_runs_beside_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report has them in its own order all the same."""
    began: list[str] = []
    background, other = threading.Event(), threading.Event()

    def played(step: Step, _folder: Path, *, quick: bool, ends: threading.Event | None = None) -> Result:
        began.append(step.name)
        assert quick and (ends is not None) == (step.company is Company.ANY)
        if step.name == "virtual":
            background.set()
            assert other.wait(30.0), "it does not hold up the others"
        if step.name == "lab":
            assert background.wait(30.0)
            other.set()
        return Result(step, why="it was played", failed=True)

    monkeypatch.setattr(running, "run", played)
    chosen = [
        step("virtual", company=Company.ANY),
        step("lab", company=Company.BACKGROUND),
        step("load"),
    ]
    assert [found.step.name for found in run_all(chosen, tmp_path, quick=True)] == ["virtual", "lab", "load"]
    assert began[0] == "load"


def test_an_interruption_ends_what_is_in_the_background(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began, ended = threading.Event(), threading.Event()

    def played(step: Step, _folder: Path, *, quick: bool, ends: threading.Event | None = None) -> Result:
        if ends is None:
            assert quick and began.wait(30.0)
            raise KeyboardInterrupt
        began.set()
        assert ends.wait(30.0)
        ended.set()
        return Result(step, why="it was ended", failed=True)

    monkeypatch.setattr(running, "run", played)
    chosen = [
        step("virtual", company=Company.ANY),
        step("next", company=Company.ANY),
        step("lab", company=Company.BACKGROUND),
    ]
    with pytest.raises(KeyboardInterrupt):
        run_all(chosen, tmp_path, quick=True)
    assert ended.is_set() and not list(tmp_path.glob("*.json")), "nothing of it is kept, and the next one never began"


def test_what_a_step_has_started_ends_with_it() -> None:
    command = ["sh", "-c", "sleep 1000 & echo on; wait"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None and process.stdout.readline() == b"on\n"
        running.end(process)
        assert process.stdout.read() == b"", "nobody has it open any more"


def test_what_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "code", lambda paths: "abc")
    typed = " ".join(running.command(BY_NAME["mmcf"], tmp_path, quick=True))
    done = Result(BY_NAME["mmcf"], {"rows": [row("a", "b", c_s=1.0)], "notes": []}, "", False, typed, 2.0, "1f", "here")
    running.keep(done, tmp_path)
    assert kept(BY_NAME["mmcf"], tmp_path, quick=True) == done
    assert kept(BY_NAME["mmcf"], tmp_path, quick=False) is None, "a quick run is no full one"
    assert run_all([BY_NAME["mmcf"]], tmp_path, quick=True) == [done]
    monkeypatch.setattr(running, "code", lambda paths: "def")
    assert kept(BY_NAME["mmcf"], tmp_path, quick=True) is None, "nor one of other code"


def test_drives_of_other_code_are_in_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = kept_drives(tmp_path)
    monkeypatch.setattr(steps, "code", lambda paths: "def")
    assert kept_drives(tmp_path) != now
    assert str(kept_drives(tmp_path)) in running.command(BY_NAME["navigation"], tmp_path, quick=False)


def test_results_of_drives_hold_as_long_as_all_that_a_drive_runs() -> None:
    print_files = (
        "import sys, benchmarks.navigation.campus, benchmarks.navigation.episode\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith(('sern_', 'benchmarks'))), sep='\\n')"
    )
    told = subprocess.run([sys.executable, "-c", print_files], capture_output=True, text=True, check=True, cwd=ROOT)
    files = {Path(line).relative_to(ROOT) for line in told.stdout.split()}
    assert Path("sern_navigation/mppi.py") in files
    assert [file for file in files if not any(file.is_relative_to(path) for path in steps.DRIVEN)] == []


def test_a_report_from_several_commits_says_so(tmp_path: Path) -> None:
    one, other = (Result(BY_NAME["mmcf"], why="left out", commit=of, machine="a desk") for of in ("1f", "2e"))
    assert "Full run of commit 1f, on a desk." in report.html([one, one], tmp_path, quick=False)
    assert "Full run of commits 1f, 2e, which differ in other code, on a desk." in report.html(
        [one, other], tmp_path, quick=False
    )


def test_a_file_that_is_no_result_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "mmcf.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"mmcf.json is no result of a step .*: remove it"):
        kept(BY_NAME["mmcf"], tmp_path, quick=True)


def test_it_is_told_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def played(step: Step, _folder: Path, *, quick: bool, ends: threading.Event | None = None) -> Result:
        raise AssertionError(f"{step.name} ran for hours first, quick {quick}, {ends}")

    monkeypatch.setattr(running, "run", played)
    (tmp_path / "virtual.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"virtual.json is no result of a step"):
        run_all([step("load"), step("virtual", company=Company.ANY)], tmp_path, quick=True)


def test_the_command_tells_what_it_knows() -> None:
    words = [sys.executable, "-m", "benchmarks.paper"]
    helped = subprocess.run([*words, "--help"], capture_output=True, text=True, check=True)
    assert all(each.key in helped.stdout for each in STEPS)
    wrong = subprocess.run([*words, "--only", "nothing"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2 and "invalid choice: 'nothing'" in wrong.stderr
