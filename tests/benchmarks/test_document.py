"""Benchmarks write their figures into the documentation themselves."""

import json
import re
import sys
from pathlib import Path

import pytest

from benchmarks.common import Report
from benchmarks.document import (
    DOCUMENT,
    DOCUMENTS,
    IN_README,
    README,
    README_SYSTEMS,
    README_TITLES,
    beside,
    contents,
    headline,
    insert,
    main,
    render,
)
from benchmarks.link.figures import NEVER_S
from sern_core.vocabulary.errors import ConfigError


def report() -> Report:
    found = Report("link")
    found.row("4 Mbit/s, 2x", "sern-udp", pose_p50_ms=28.44, goodput_Mbps=3.612, relay_cpu_percent=5.0)
    found.row("4 Mbit/s, 2x", "tcpros", pose_p50_ms=9672.0, goodput_Mbps=3.7)
    found.row("blackout", "sern-udp", fresh_s=0.246)
    found.row("blackout", "tcpros", fresh_s=NEVER_S)
    found.reach("p50, times the floor", 1.13, 1.10)
    found.reach("goodput, share", 0.99, 0.97, at_least=True)
    found.note("lab: native")
    return found


def test_a_table_for_each_case_and_the_limits() -> None:
    written = json.loads(json.dumps(report().as_json()))
    text = render(written)
    assert "| system | pose p50, ms | goodput, Mbit/s | relay CPU, % |" in text
    assert "| tcpros | 9,672 | 3.70 | – |" in text
    assert "| sern-udp | 28.4 | 3.61 | 5.0 |" in text
    assert "| tcpros | never |" in text and "| sern-udp | 0.25 |" in text
    assert "| p50, times the floor | 1.13 | ≤ 1.1 | **missed** |" in text
    assert "| goodput, share | 0.99 | ≥ 0.97 | reached |" in text
    assert "lab: native" in text


def compiled(found: Report) -> dict[str, object]:
    return {**found.as_json(), "compiled": True}


def test_figures_with_a_compiled_core_stand_beside_the_others() -> None:
    other = Report("link")
    other.row("4 Mbit/s, 2x", "sern-udp", pose_p50_ms=27.0, goodput_Mbps=3.7, relay_cpu_percent=2.5)
    other.row("4 Mbit/s, 2x", "tcpros", pose_p50_ms=1.0, goodput_Mbps=9.0)
    other.reach("p50, times the floor", 1.05, 1.08)
    text = render(beside(report().as_json(), compiled(other)))
    assert "| sern-udp | 28.4 | 3.61 | 5.0 |\n| sern-udp, compiled | 27.0 | 3.70 | 2.5 |\n| tcpros | 9,672 |" in text
    assert "tcpros, compiled" not in text
    assert "| figure | wanted | plain |  | compiled |  |" in text
    assert "| p50, times the floor | ≤ 1.1, compiled ≤ 1.08 | 1.13 | **missed** | 1.05 | reached |" in text
    assert "| goodput, share | ≥ 0.97 | 0.99 | reached | – |  |" in text


def test_one_system_with_both_cores_gets_one_table() -> None:
    fleet = Report("robots")
    fleet.row("1 robots", "sern", relay_cpu_us=99.0)
    fleet.row("50 robots", "sern", relay_cpu_us=88.0)
    lines = render(beside(fleet.as_json(), compiled(fleet))).splitlines()
    assert lines[2] == "| case | system | relay CPU a message, µs |"
    assert lines[5] == "| 1 robots | sern, compiled | 99.0 |" and len(lines) == 8


@pytest.mark.parametrize("given", ["alone", "another commit"])
def test_figures_with_a_compiled_core_need_those_without(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, other, into = tmp_path / "plain.json", tmp_path / "compiled.json", tmp_path / "page.md"
    into.write_text("<!-- link begin -->\n<!-- link end -->\n")
    plain.write_text(json.dumps(report().as_json()))
    written = compiled(report())
    if given == "another commit":
        written["commit"] = "0123456789ab"
    other.write_text(json.dumps(written))
    files = [str(other)] if given == "alone" else [str(plain), str(other)]
    monkeypatch.setattr(sys, "argv", ["document", *files, "--into", str(into)])
    assert main() == 1 and into.read_text().count("\n") == 2
    said = capsys.readouterr().err
    assert ("give the file of link without one, too" if given == "alone" else "measure one commit") in said


def test_one_system_gets_one_table() -> None:
    fleet = Report("robots")
    fleet.row("1 robots", "sern", control_p99_ms=2.0, relay_cpu_us=99.0)
    fleet.row("50 robots", "sern", control_p99_ms=3.0, relay_cpu_us=88.0)
    lines = render(fleet.as_json()).splitlines()
    assert lines[2:] == [
        "| case | control p99, ms | relay CPU a message, µs |",
        "| --- | --- | --- |",
        "| 1 robots | 2.0 | 99.0 |",
        "| 50 robots | 3.0 | 88.0 |",
    ]


def test_numbers_without_a_unit_have_three_places() -> None:
    tables = Report("mmcf_lab")
    tables.row("mapping", "mmcf", cost_1=0.07851, latency_1=0.1)
    tables.row("mapping", "fixed_throughput", cost_1=0.18, latency_1=0.2)
    text = render(tables.as_json())
    assert "| system | cost J | latency |" in text
    assert "| mmcf | 0.079 | 0.100 |" in text


def test_counts_have_no_places_and_small_times_enough() -> None:
    found = Report("endpoints")
    found.row("3 kHz", "direct", odom_p50_ms=0.0057, odom_lost=0, odom_received=160, cpu_percent=0.0)
    found.row("3 kHz", "sern", odom_p50_ms=0.25, odom_lost=3, odom_received=24_000, cpu_percent=0.21)
    text = render(json.loads(json.dumps(found.as_json())))
    assert "| direct | 0.006 | 0 | 160 | 0.0 |" in text
    assert "| sern | 0.2 | 3 | 24,000 | 0.2 |" in text


def test_cases_that_have_a_metric_in_common_are_rows_of_one_table() -> None:
    found = Report("thin_link")
    found.row("datagrams", "pose", arrived_count=998, age_p50_s=0.282)
    found.row("stream", "clouds", arrived_count=0)
    found.row("a third robot", "mmcf", gap_s=0.056)
    assert render(found.as_json()).splitlines()[2:] == [
        "| case | system | arrived | age p50, s |",
        "| --- | --- | --- | --- |",
        "| datagrams | pose | 998 | 0.28 |",
        "| stream | clouds | 0 | – |",
        "",
        "| case | system | gap, s |",
        "| --- | --- | --- |",
        "| a third robot | mmcf | 0.056 |",
    ]


def test_policies_are_columns_where_a_case_is_a_profile_and_a_trace() -> None:
    found = Report("mmcf")
    for number, case in enumerate(("mapping step", "mapping wave", "balanced step")):
        found.row(case, "fixed", cost_1=0.2 + number / 10, switches_1=0.0)
        found.row(case, "mmcf", cost_1=0.1 + number / 10, switches_1=2.04, plusminus_1=0.01)
    found.detail("mapping step: the best fixed one is x")
    text = render(found.as_json())
    assert "best fixed" not in text
    assert text.splitlines()[2:] == [
        "| mapping | fixed | mmcf | ± (95 %) of mmcf | switches a minute |",
        "| --- | --- | --- | --- | --- |",
        "| step | 0.200 | 0.100 | 0.010 | 2.0 |",
        "| wave | 0.300 | 0.200 | 0.010 | 2.0 |",
        "",
        "| balanced | fixed | mmcf | ± (95 %) of mmcf | switches a minute |",
        "| --- | --- | --- | --- | --- |",
        "| step | 0.400 | 0.300 | 0.010 | 2.0 |",
    ]


def test_the_readme_gets_what_it_shows_of_a_case() -> None:
    found = Report("link")
    found.row("4 Mbit/s 50 ms, idle", "sern-udp", pose_p50_ms=1.0)
    found.row("4 Mbit/s 50 ms, 2x", "sern-udp", pose_p50_ms=28.44, goodput_Mbps=3.612, relay_cpu_percent=5.0)
    found.row("4 Mbit/s 50 ms, 2x", "tcpros", pose_p50_ms=239.0, goodput_Mbps=3.77)
    found.row("4 Mbit/s 50 ms, 2x", "forwarder", pose_p50_ms=27.0)
    found.row("4 Mbit/s 50 ms, blackout 10 s", "sern-udp", fresh_s=0.2)
    found.row("4 Mbit/s 50 ms, blackout 30 s", "zenoh", fresh_s=0.3)
    assert headline({**found.as_json(), "commit": "abc"}).splitlines() == [
        "Commit abc:",
        "",
        "|  | a pose takes, ms | all that arrives, Mbit/s | blackout of 10 s: a fresh pose after, s |",
        "| --- | --- | --- | --- |",
        "| **SERN** | 28.4 | 3.61 | 0.20 |",
        "| ROS 1 (TCPROS) | 239.0 | 3.77 | – |",
    ]


def test_a_person_in_a_hurry_can_read_the_readme() -> None:
    """Words for every figure and system that it shows, and one number a cell."""
    assert {name for cases in IN_README.values() for names in cases.values() for name in names} == set(README_TITLES)
    text = README.read_text(encoding="utf-8")
    assert text.count("![") == 3
    for name in ("link", "endpoints"):
        table = text.partition(f"<!-- {name} begin -->")[2].partition(f"<!-- {name} end -->")[0]
        rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
        assert len(rows) > 3
        for system, *cells in rows[2:]:  # below the head and its line
            assert system in README_SYSTEMS.values()
            assert all(re.fullmatch(r"[\d,.]+|never|–", cell) for cell in cells), cells


def test_a_part_of_a_benchmark_does_not_empty_the_readme() -> None:
    found = Report("link")
    found.row("4 Mbit/s 50 ms, 2x", "sern-udp", pose_p50_ms=28.44)
    with pytest.raises(ConfigError, match="link has no figures of '4 Mbit/s 50 ms, blackout 10 s'"):
        headline(found.as_json())


def test_what_the_demo_writes_goes_into_the_readme_alone() -> None:
    result = {"case": "control", "system": "SERN", "delivered_messages": 800, "latency_p99_s": 0.05, "offered_bytes": 9}
    document = {"benchmark": "demo", "commit": "abc", "rows": [result], "reach": []}
    ((into, text),) = contents(document)
    assert into == README
    assert text.splitlines()[2:] == [
        "|  | delivered | one in a hundred takes over, s |",
        "| --- | --- | --- |",
        "| SERN | 800 | 0.050 |",
    ]


def test_a_benchmark_that_is_in_no_document_is_refused() -> None:
    with pytest.raises(ConfigError, match="scheduler is in no document"):
        list(contents(Report("scheduler").as_json()))


def test_all_documents_are_written_at_once_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    into = tmp_path / "here.md"
    into.write_text("a <!-- link begin --> old <!-- link end --> b")
    good, bad = tmp_path / "link.json", tmp_path / "robots.json"
    good.write_text(json.dumps(report().as_json()))
    bad.write_text(json.dumps({**report().as_json(), "benchmark": "robots"}))
    monkeypatch.setattr(sys, "argv", ["document", str(good), str(bad), "--into", str(into)])
    assert main() == 1
    assert "old" in into.read_text()
    monkeypatch.setattr(sys, "argv", ["document", str(good), "--into", str(into)])
    assert main() == 0
    assert "old" not in into.read_text() and "| tcpros | 9,672 | 3.70 | – |" in into.read_text()


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_document_has_a_place_for_them_and_keeps_the_rest(name: str) -> None:
    text = DOCUMENTS[name].read_text(encoding="utf-8")
    once = insert(text, name, "figures")
    assert insert(once, name, "figures") == once
    assert f"<!-- {name} begin -->\nfigures\n<!-- {name} end -->" in once
    before, _, rest = text.partition(f"<!-- {name} begin -->")
    assert once.startswith(before) and once.endswith(rest.partition(f"<!-- {name} end -->")[2])


@pytest.mark.parametrize("name", IN_README)
def test_the_readme_has_a_place_for_what_it_shows(name: str) -> None:
    text = README.read_text(encoding="utf-8")
    assert f"<!-- {name} begin -->\nfigures\n<!-- {name} end -->" in insert(text, name, "figures")


def test_pictures_of_the_document_are_there() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    pictures = [part.partition(")")[0] for part in text.split("](images/")[1:]]
    assert pictures
    assert [name for name in pictures if not (DOCUMENT.parent / "images" / name).exists()] == []


@pytest.mark.parametrize("text", ["", "<!-- x begin -->", "<!-- x end --><!-- x begin -->"])
def test_a_document_without_the_marks_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="no place for the figures of x"):
        insert(text, "x", "y")
