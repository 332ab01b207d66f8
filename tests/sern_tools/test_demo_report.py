"""What a demo leaves behind: JSON in the benchmarks' shape, a summary, one self-contained HTML file."""

import io
import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from rich.console import Console

from sern_runtime.profiles import load_profile
from sern_tools import demo_charts, demo_report
from sern_tools.demo_behaviour import Behaviour, Look
from sern_tools.demo_report import Carried, Report
from sern_tools.demo_scenario import Scenario
from sern_tools.summary import judge
from tests.sern_tools.logs import POSE, Run, good_run

BEHAVIOUR = Behaviour(
    [Look(0.0, "udp", 2), Look(6.0, "zmq", 3, thinned=True), Look(9.0, "udp", 4, summarised=True), Look(10.0, "udp", 4)]
)
BEHAVED = {
    "lane": "datagrams (UDP) 70% of the time, stream (TCP) 30% of the time; changed 2 times",
    "adaptation": "chose anew 2 times; thinned 30% and summarised 10% of the time",
    "clouds": "80% of class bulk delivered",
}
LIMITS = {"control": 0.01, "state": 0.10}


def report_of(run: Run | None = None, *, baseline: bool = True) -> Report:
    results = [(run or good_run()).analyse("SERN")]
    other = good_run(latency_ms=2000)
    other.counters.clear()
    if baseline:
        results.append(other.analyse("plain ZMQ"))
    verdicts = judge(results[0], results[1] if baseline else None, overtaken_share_limits=LIMITS)
    comparison = judge(results[1], None, overtaken_share_limits=LIMITS) if baseline else []
    return Report(
        command="sern demo --profile demo",
        started="2026-01-31 12:00 UTC",
        scenario=Scenario(load_profile("demo"), 10),
        results=results,
        verdicts=verdicts,
        carried={"SERN": Carried(0.1, [50_000] * 100)},
        comparison={verdict.name: verdict for verdict in comparison},
        remarks=("a <remark>",),
        behaviour=BEHAVIOUR,
    )


def test_the_json_has_the_benchmarks_shape() -> None:
    document = json.loads(demo_report.as_json(report_of()))
    assert document.keys() == {"benchmark", "commit", "rows", "reach"}
    assert document["benchmark"] == "demo"
    assert [(row["case"], row["system"]) for row in document["rows"]][:4] == [
        ("control", "SERN"),
        ("state", "SERN"),
        ("bulk", "SERN"),
        ("link", "SERN"),
    ]
    control = document["rows"][0]
    assert (control["offered_messages"], control["delivered_messages"]) == (1000, 800)
    assert control["dropped_lifespan_messages"] == 200
    assert control["latency_p99_s"] == pytest.approx(0.030)
    for row in document["rows"]:
        units = {name.rpartition("_")[2] for name in row if name not in ("case", "system")}
        assert units <= {"messages", "bytes", "s", "share", "changes", "switches"}
    assert all(reach.keys() == {"name", "value", "limit", "ok"} for reach in document["reach"])
    assert all(reach["ok"] for reach in document["reach"])


def test_what_does_not_exist_is_null_in_json() -> None:
    run = good_run()
    run.logs[POSE].deliveries.clear()
    document = json.loads(demo_report.as_json(report_of(run)))
    reach = {entry["name"]: entry for entry in document["reach"]}
    assert reach["first_fresh_pose_s"] == {"name": "first_fresh_pose_s", "value": None, "limit": 3.0, "ok": False}


def test_the_json_says_how_lane_and_adaptation_behaved() -> None:
    rows = {(row["case"], row["system"]): row for row in json.loads(demo_report.as_json(report_of()))["rows"]}
    found = {name: value for name, value in rows["link", "SERN"].items() if name.startswith(("lane_", "adaptation_"))}
    assert found == {
        "lane_udp_share": pytest.approx(0.7),
        "lane_zmq_share": pytest.approx(0.3),
        "lane_changes": 2,
        "adaptation_switches": 2,
        "adaptation_thinned_share": pytest.approx(0.3),
        "adaptation_summarised_share": pytest.approx(0.1),
    }
    assert not any(name.startswith(("lane_", "adaptation_")) for name in rows["link", "plain ZMQ"])


def printed(report: Report) -> str:
    console = Console(file=io.StringIO(), width=80, color_system=None)
    demo_report.print_summary(report, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_summary_fits_the_terminal_and_names_every_drop() -> None:
    text = printed(report_of())
    assert max(len(line) for line in text.splitlines()) <= 80
    assert re.search(r"control +SERN +1000 +800 \(80\.0 %\) +30\.0 ms +30\.0 ms +25\.0 ms", text)
    assert "SERN, control: 200 lifespan" in text
    assert "plain ZMQ, bulk: 10 never seen again" in text
    assert text.count("kept") == 8
    assert "BROKEN" not in text
    assert "a <remark>" in text


def test_the_summary_says_how_lane_and_adaptation_behaved() -> None:
    words = " ".join(printed(report_of()).split())
    for name, said in BEHAVED.items():
        assert f"SERN, {name}: {said}" in words
    assert "plain ZMQ, lane" not in words
    unknown = printed(replace(report_of(), behaviour=Behaviour()))
    assert "SERN, lane" not in unknown and "SERN, adaptation" not in unknown


def test_a_broken_promise_is_shown() -> None:
    run = good_run()
    run.logs[POSE].deliveries.clear()
    report = report_of(run)
    assert not report.ok
    assert re.search(r"BROKEN +a fresh pose within 3 s of the end of a blackout: never", printed(report))
    assert '<p class="banner bad">' in demo_report.as_html(report)


class _Page(HTMLParser):
    """Collects what a page would load, and checks that its elements are closed."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link")
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def page_of(report: Report) -> _Page:
    page = _Page()
    page.feed(demo_report.as_html(report))
    page.close()
    assert page.open == []
    return page


def test_the_page_is_one_file_with_its_pictures_and_its_honest_notes() -> None:
    page = page_of(report_of())
    assert len(page.sources) == 4
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    text = " ".join(page.words)
    for words in (
        "The proxy does not represent TCP's own loss recovery.",
        "sern demo --profile demo",
        "Every promise was kept.",
        "a <remark>",
        "10 never seen again",
    ):
        assert words in text


def test_the_page_says_how_lane_and_adaptation_behaved() -> None:
    page = demo_report.as_html(report_of())
    table = page.partition("<h2>How SERN behaved</h2>")[2].partition("</table>")[0]
    assert re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td></tr>", table) == list(BEHAVED.items())
    assert "How SERN behaved" not in demo_report.as_html(replace(report_of(), behaviour=Behaviour()))


def test_the_page_without_a_baseline() -> None:
    text = " ".join(page_of(report_of(baseline=False)).words)
    assert "plain ZMQ, which" not in text
    assert "The baseline is" not in text


def test_the_page_says_what_loss_was_left_out() -> None:
    report = report_of()
    lossy = replace(report, scenario=Scenario(load_profile("field-wifi"), 10))
    assert "this profile has 2 %" in " ".join(page_of(lossy).words)


def test_without_matplotlib_the_page_has_no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    page = page_of(report_of())
    assert page.sources == []
    assert f"{sys.executable} -m pip install matplotlib" in " ".join(page.words)


def test_what_became_of_a_class_adds_up() -> None:
    results = report_of().results
    assert demo_charts.fates(results[0], "control") == {"delivered": 0.8, "lifespan": 0.2}
    assert sum(demo_charts.fates(results[1], "bulk").values()) == pytest.approx(1.0)


def test_pictures_of_a_run_in_which_nothing_arrived() -> None:
    run = good_run()
    for log in run.logs.values():
        log.deliveries.clear()
    page = page_of(replace(report_of(run), carried={}))
    assert len(page.sources) == 4
