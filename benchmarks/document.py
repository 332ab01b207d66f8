"""Put the figures of benchmarks into the documents: `python -m benchmarks.document FILE...` (what --json wrote).

Replaces what stands between `<!-- NAME begin -->` and `<!-- NAME end -->` in the document of the benchmark NAME, and in
README.md what that shows of it. The rest of the documents is left alone. Of a benchmark that was run with a compiled
core as well, give both files: SERN's rows and figures with it stand beside the others.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from benchmarks.link.figures import NEVER_S
from sern_core.vocabulary.errors import ConfigError, SernError

ROOT: Final = Path(__file__).resolve().parent.parent
README: Final = ROOT / "README.md"
DOCUMENT: Final = ROOT / "docs" / "performance.md"
THEORY: Final = ROOT / "docs" / "adaptation-theory.md"
DOCUMENTS: Final = {
    **dict.fromkeys(
        ("link", "sensors", "robots", "relay", "footprint", "endpoints", "mmcf_lab", "thin_link", "cellular", "codecs"),
        DOCUMENT,
    ),
    **dict.fromkeys(("navigation", "perception", "viewers", "curve", "durable", "soak"), DOCUMENT),
    **dict.fromkeys(("mmcf", "mmcf_replay", "mmcf_recovery"), THEORY),
    "summaries": ROOT / "docs" / "summaries.md",
    "spool": ROOT / "docs" / "spool.md",
    "fabric": ROOT / "docs" / "fabric.md",
    "matrix": ROOT / "docs" / "lab.md",
    **dict.fromkeys(("sync", "sync_lab"), ROOT / "docs" / "twin.md"),
}
"""The document of each benchmark that has a place in one."""
IN_README: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "link": {
        "4 Mbit/s 50 ms, 2x": ("pose_p50_ms", "pose_p99_ms", "poses_percent", "goodput_Mbps"),
        "4 Mbit/s 50 ms, blackout 10 s": ("fresh_s",),
    },
    "endpoints": {"ros1 1 kHz + 20 MB/s": ("odom_p50_ms", "cloud_p50_ms", "cpu_percent")},
    "demo": {"control": ("delivered_messages", "latency_p50_s", "latency_p99_s")},
}
"""Cases and metrics that README.md shows, one table a benchmark. What the demo writes has the shape of a benchmark."""
README_TITLES: Final = {
    "pose_p50_ms": "a pose takes, ms",
    "pose_p99_ms": "one in a hundred takes over, ms",
    "poses_percent": "poses that arrive, %",
    "goodput_Mbps": "all that arrives, Mbit/s",
    "fresh_s": "blackout of 10 s: a fresh pose after, s",
    "odom_p50_ms": "odometry takes, ms",
    "cloud_p50_ms": "a cloud takes, ms",
    "cpu_percent": "CPU, % of a core",
    "latency_p50_s": "a pose or command takes, s",
    "latency_p99_s": "one in a hundred takes over, s",
    "delivered_messages": "delivered",
}
README_SYSTEMS: Final = {
    "sern-udp": "**SERN**",
    "sern-zmq": "SERN, TCP alone",
    "zmq": "plain ZMQ",
    "zenoh": "zenoh, as it comes",
    "zenoh-multilink": "zenoh, two connections",
    "zenoh-multilink-bbr": "zenoh, two connections, TCP with BBR",
    "tcpros": "ROS 1 (TCPROS)",
    "direct": "nothing between, one master",
    "sern-chain": "**SERN**: client, relay, client",
    "sern-in-process": "SERN's two endpoints alone",
    "topic_tools": "topic_tools, one master",
    "rospy": "rospy, one master",
    "rospy+zenoh": "rospy, zenoh, rospy",
}
"""Words for people in a hurry, in place of the names that the other documents explain."""
YARDSTICKS: Final = frozenset({"forwarder"})
"""Systems that figures are compared with and that nobody would use: not for people in a hurry."""
TOGETHER: Final = frozenset({"codecs", "footprint", "summaries", "thin_link", "mmcf_replay", "matrix", "sync_lab"})
"""Benchmarks whose cases are rows of one table, as far as they have a metric in common."""
BY_POLICY: Final = frozenset({"mmcf"})
"""Benchmarks whose cases are a mission profile and a trace: a table for each profile, a column for each policy."""
TITLES: Final = {
    "poses_percent": "poses, %",
    "wire_percent": "link used, %",
    "settled_down_s": "8→1 found, s",
    "settled_up_s": "1→4 found, s",
    "fresh_s": "first fresh pose, s",
    "messages_hz": "messages/s",
    "relay_cpu_us": "relay CPU a message, µs",
    "used_percent": "link used, %",
    "delivered_percent": "bulk that arrived whole, % of the link",
    "relay_rss_MB": "relay memory (RSS), MB",
    "ready_s": "ready after, s",
    "rss_MB": "resident, MB",
    "own_MB": "its own, MB",
    "datagrams_hz": "datagrams/s",
    "datagram_us": "CPU a datagram, µs",
    "cost_1": "cost J",
    "plusminus_1": "± (95 %)",
    "settled_down_plusminus_s": "± s (95 %)",
    "settled_up_plusminus_s": "± s (95 %)",
    "forward_1": "J, first to last",
    "backward_1": "J, last to first",
    "odom_lost": "odom lost",
    "cloud_lost": "clouds lost",
    "talk_lost": "talk lost",
    "talk_doubled": "talk doubled",
    "odom_received": "odom got",
    "cloud_received": "clouds got",
    "from_percent": "95 % from, %",
    "time_median_s": "time to the goal, median, s",
    "spl_share": "SPL",
    "interventions_run": "interventions a drive",
    "collisions_all": "collisions",
    "counted_drives": "drives",
    "paper_success_percent": "success in the paper, %",
    "paper_time_s": "time in the paper, s",
    "paper_interventions_run": "interventions in the paper",
    "counted_things": "things",
    "counted_topics": "topics that come",
    "bodies_kBps": "bodies, kB/s",
    "got_percent": "messages that the viewer gets, %",
    "counted_cleared": "real cells cleared",
    "counted_refused": "scans that did not fit",
    "flags_hour": "an hour",
    "driven_hours": "hours driven",
    "converged_s": "sessions of every two, s after the last was ready",
    "from_start_s": "s after the first was started",
    "crossing_percent": "cross, %",
    "crossing_p99_ms": "control that crosses, p99, ms",
}
"""Titles of columns whose metric's name does not say it well."""
PURE: Final = "1"
"""The unit of a number without one."""
COUNT: Final = "count"
UNITS: Final = {"percent": "%", "Mbps": "Mbit/s", "us": "µs", "hz": "Hz"}
FIXED: Final = ("case", "system")
OURS: Final = "mmcf"
OURS_PREFIX: Final = "sern"
COMPILED: Final = "compiled"


def _title(metric: str) -> str:
    quantity, _, unit = metric.rpartition("_")
    if unit in (PURE, COUNT):
        return TITLES.get(metric, quantity.replace("_", " "))
    return TITLES.get(metric) or f"{quantity.replace('_', ' ').replace('cpu', 'CPU')}, {UNITS.get(unit, unit)}"


def _cell(metric: str, value: float | None) -> str:
    if value is None:
        return "–"
    if metric.endswith("_s") and value >= NEVER_S:
        return "never"
    if abs(value) >= 1000 or isinstance(value, int):
        return f"{value:,.0f}"
    if metric.endswith(f"_{PURE}") or 0 < abs(value) < 0.1:
        return f"{value:.3f}"
    return f"{value:.2f}" if metric.endswith(("_s", "_Mbps")) else f"{value:.1f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def _figures(rows: Sequence[Mapping[str, Any]], first: Mapping[str, str]) -> list[str]:
    """One table; a column for each metric that any of its rows has. `first`: titles of those in front, by case or
    system."""
    metrics = list(dict.fromkeys(name for row in rows for name in row if name not in FIXED))
    body = [[*(str(row[name]) for name in first), *(_cell(name, row.get(name)) for name in metrics)] for row in rows]
    return _table([*first.values(), *map(_title, metrics)], body)


def _metrics(row: Mapping[str, Any]) -> set[str]:
    return set(row) - set(FIXED)


def _together(rows: Sequence[Mapping[str, Any]]) -> Iterator[list[str]]:
    """Tables of rows that follow each other and have a metric in common, with a column for case and system each."""
    tables: list[list[Mapping[str, Any]]] = []
    for row in rows:
        if not tables or not _metrics(row) & set().union(*map(_metrics, tables[-1])):
            tables.append([])
        tables[-1].append(row)
    for table in tables:
        yield _figures(table, {"case": "case", "system": "system"})


def _by_policy(rows: Sequence[Mapping[str, Any]]) -> Iterator[list[str]]:
    """A table for each profile, the first word of a case: costs by trace and policy, and how often MMCF switched."""
    policies = list(dict.fromkeys(row["system"] for row in rows))
    found = {(row["case"], row["system"]): row for row in rows}
    for profile, group in groupby(dict.fromkeys(row["case"] for row in rows), key=lambda case: case.split()[0]):
        body = []
        for case in group:
            ours = found[case, OURS]
            body.append(
                [
                    case.partition(" ")[2],
                    *(_cell("cost_1", found[case, policy]["cost_1"]) for policy in policies),
                    _cell("plusminus_1", ours.get("plusminus_1")),
                    f"{ours['switches_1']:.1f}",
                ]
            )
        yield _table([profile, *policies, f"± (95 %) of {OURS}", "switches a minute"], body)


def headline(document: Mapping[str, Any]) -> str:
    """What README.md shows of a benchmark in IN_README: its commit, and one table with a row for each system.

    Raises ConfigError when a case of it was not measured.
    """
    shown: dict[str, dict[str, Any]] = {}
    metrics: list[str] = []
    for case, wanted in IN_README[document["benchmark"]].items():
        rows = [
            row for row in document["rows"]
            if row["case"] == case and row["system"] not in YARDSTICKS and not row["system"].endswith(COMPILED)
        ]  # fmt: skip
        found = [name for name in wanted if any(name in row for row in rows)]
        if not found:
            raise ConfigError(
                f"{document['benchmark']} has no figures of {case!r}, which README.md shows: measure all of it"
            )
        metrics += found
        for row in rows:
            shown.setdefault(row["system"], {}).update((name, row[name]) for name in found if name in row)
    head = ["", *(README_TITLES[name] for name in metrics)]
    body = [
        [README_SYSTEMS.get(system, system), *(_cell(name, row.get(name)) for name in metrics)]
        for system, row in shown.items()
        if row
    ]
    return "\n".join([f"Commit {document['commit']}:", "", *_table(head, body)])


def beside(document: Mapping[str, Any], compiled: Mapping[str, Any]) -> dict[str, Any]:
    """The document of a benchmark with SERN's rows and figures of another run of it, with a compiled core.

    Raises ConfigError where the two are of different commits.
    """
    if document["commit"] != compiled["commit"]:
        raise ConfigError(
            f"{document['benchmark']}: {document['commit']} was measured, and {compiled['commit']} with a compiled "
            "core: measure one commit"
        )
    theirs = {(row["case"], row["system"]): row for row in compiled["rows"]}
    rows = []
    for row in document["rows"]:
        rows.append(row)
        other = theirs.get((row["case"], row["system"]))
        if other is not None and row["system"].startswith(OURS_PREFIX):
            rows.append({**other, "system": f"{row['system']}, {COMPILED}"})
    reaches = {reach["name"]: reach for reach in compiled["reach"]}
    return {
        **document,
        "rows": rows,
        "reach": [{**reach, COMPILED: reaches.get(reach["name"])} for reach in document["reach"]],
        "notes": [*document["notes"], f"`{COMPILED}`: another run, with the core compiled (`make compiled`)"],
    }


def _value(reach: Mapping[str, Any]) -> str:
    return "never" if reach["value"] >= NEVER_S else f"{reach['value']:.3g}"


def _wanted(reach: Mapping[str, Any]) -> str:
    return f"{'≥' if reach['at_least'] else '≤'} {reach['limit']:g}"


def _verdict(reach: Mapping[str, Any]) -> str:
    return "reached" if reach["ok"] else "**missed**"


def _against(reaches: Sequence[Mapping[str, Any]]) -> list[str]:
    """The table of what was set out; with a column more where there are figures with a compiled core."""
    if not any(reach.get(COMPILED) for reach in reaches):
        body = [[reach["name"], _value(reach), _wanted(reach), _verdict(reach)] for reach in reaches]
        return _table(["figure", "value", "wanted", ""], body)
    body = []
    for reach in reaches:
        other = reach.get(COMPILED)
        cells = ["–", ""] if other is None else [_value(other), _verdict(other)]
        limits = _wanted(reach)
        if other is not None and other["limit"] != reach["limit"]:
            limits += f", {COMPILED} {_wanted(other)}"
        body.append([reach["name"], limits, _value(reach), _verdict(reach), *cells])
    return _table(["figure", "wanted", "plain", "", COMPILED, ""], body)


def render(document: Mapping[str, Any]) -> str:
    """The figures of one benchmark as Markdown: the conditions, a table a case, and what was set out."""
    rows, reaches = document["rows"], document["reach"]
    lines = [f"Commit {document['commit']}; {'; '.join(document['notes'])}."]
    if document["benchmark"] in TOGETHER or (
        len(systems := {row["system"] for row in rows}) == 2 and any(name.endswith(COMPILED) for name in systems)
    ):
        for table in _together(rows):
            lines += ["", *table]
    elif document["benchmark"] in BY_POLICY:
        for table in _by_policy(rows):
            lines += ["", *table]
    elif len({row["system"] for row in rows}) == 1:
        lines += ["", *_figures(rows, {"case": "case"})]
    else:
        for case, group in groupby(rows, key=lambda row: row["case"]):
            lines += ["", f"### {case}", "", *_figures(list(group), {"system": "system"})]
    if reaches:
        lines += ["", f"### Against what was set out: {document['benchmark']}", "", *_against(reaches)]
    return "\n".join(lines)


def insert(text: str, name: str, content: str) -> str:
    """`text` with `content` between the marks of `name`. Raises ConfigError when they are not there, once each."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ConfigError(f"has no place for the figures of {name}: it needs {begin} and {end}, once each")
    before, _, rest = text.partition(begin)
    return f"{before}{begin}\n{content}\n{end}{rest.partition(end)[2]}"


def contents(document: Mapping[str, Any], into: Path | None = None) -> Iterator[tuple[Path, str]]:
    """What is written of a benchmark, and where; `into` alone if it is given.

    Raises ConfigError when no document has a place for it.
    """
    name = document["benchmark"]
    if into is not None:
        yield into, render(document)
        return
    if name not in DOCUMENTS and name not in IN_README:
        raise ConfigError(f"{name} is in no document; those that are: {', '.join(sorted({*DOCUMENTS, *IN_README}))}")
    if name in DOCUMENTS:
        yield DOCUMENTS[name], render(document)
    if name in IN_README:
        yield README, headline(document)


def _unlike(path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"not what a benchmark writes with --json ({error!r})", file=str(path))


def _read(paths: Sequence[Path]) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """The documents in the order of the files; those with a compiled core are in the ones without."""
    plain: dict[str, tuple[Path, Mapping[str, Any]]] = {}
    compiled: dict[str, tuple[Path, Mapping[str, Any]]] = {}
    for path in paths:
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            (compiled if document.get(COMPILED) else plain)[document["benchmark"]] = path, document
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise _unlike(path, error) from error
    for name, (path, _) in compiled.items():
        if name not in plain:
            raise ConfigError(
                f"was measured with a compiled core: give the file of {name} without one, too", file=str(path)
            )
    for name, (path, document) in plain.items():
        try:
            yield path, beside(document, compiled[name][1]) if name in compiled else document
        except (KeyError, TypeError) as error:
            raise _unlike(path, error) from error


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.document", description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="what --json of a benchmark wrote")
    parser.add_argument("--into", type=Path, metavar="FILE", help="default: the document of each benchmark")
    options = parser.parse_args()
    texts: dict[Path, str] = {}
    try:
        for path, document in _read(options.files):
            try:
                for into, content in contents(document, options.into):
                    if into not in texts:
                        texts[into] = into.read_text(encoding="utf-8")
                    texts[into] = insert(texts[into], document["benchmark"], content)
            except (ValueError, KeyError, TypeError) as error:
                raise _unlike(path, error) from error
        for into, text in texts.items():
            into.write_text(text, encoding="utf-8")
    except (SernError, OSError) as error:
        print(f"benchmarks.document: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
