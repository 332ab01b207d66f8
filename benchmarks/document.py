"""Put the figures of benchmarks into docs/performance.md: `python -m benchmarks.document FILE...` (what --json wrote).

Replaces what stands between `<!-- NAME begin -->` and `<!-- NAME end -->` there, NAME being the benchmark's; the rest
of the document is left alone.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from benchmarks.link.figures import NEVER_S
from sern_core.errors import ConfigError, SernError

DOCUMENT: Final = Path(__file__).resolve().parent.parent / "docs" / "performance.md"
TITLES: Final = {
    "poses_percent": "poses, %",
    "wire_percent": "link used, %",
    "settled_down_s": "8→1 found, s",
    "settled_up_s": "1→4 found, s",
    "fresh_s": "first fresh pose, s",
    "messages_hz": "messages/s",
    "relay_cpu_us": "relay CPU a message, µs",
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
    "odom_received": "odom got",
    "cloud_received": "clouds got",
}
"""Titles of columns whose metric's name does not say it well."""
PURE: Final = "1"
"""The unit of a number without one."""
UNITS: Final = {"percent": "%", "Mbps": "Mbit/s", "us": "µs"}
FIXED: Final = ("case", "system")


def _title(metric: str) -> str:
    quantity, _, unit = metric.rpartition("_")
    if unit == PURE:
        return TITLES.get(metric, quantity)
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


def _figures(rows: Sequence[Mapping[str, Any]], first: str) -> list[str]:
    """One table; a column for each metric that any of its rows has. `first`: case or system."""
    metrics = list(dict.fromkeys(name for row in rows for name in row if name not in FIXED))
    body = [[str(row[first]), *(_cell(name, row.get(name)) for name in metrics)] for row in rows]
    return _table([first, *map(_title, metrics)], body)


def render(document: Mapping[str, Any]) -> str:
    """The figures of one benchmark as Markdown: the conditions, a table a case, and what was set out."""
    rows, reaches = document["rows"], document["reach"]
    lines = [f"Commit {document['commit']}; {'; '.join(document['notes'])}."]
    if len({row["system"] for row in rows}) == 1:
        lines += ["", *_figures(rows, "case")]
    else:
        for case, group in groupby(rows, key=lambda row: row["case"]):
            lines += ["", f"### {case}", "", *_figures(list(group), "system")]
    if reaches:
        body = [
            [
                reach["name"],
                "never" if reach["value"] >= NEVER_S else f"{reach['value']:.3g}",
                f"{'≥' if reach['at_least'] else '≤'} {reach['limit']:g}",
                "reached" if reach["ok"] else "**missed**",
            ]
            for reach in reaches
        ]
        lines += ["", f"### Against what was set out: {document['benchmark']}", ""]
        lines += _table(["figure", "value", "wanted", ""], body)
    return "\n".join(lines)


def insert(text: str, name: str, content: str) -> str:
    """`text` with `content` between the marks of `name`. Raises ConfigError when they are not there, once each."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ConfigError(f"has no place for the figures of {name}: it needs {begin} and {end}, once each")
    before, _, rest = text.partition(begin)
    return f"{before}{begin}\n{content}\n{end}{rest.partition(end)[2]}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.document", description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="what --json of a benchmark wrote")
    parser.add_argument("--into", type=Path, default=DOCUMENT, metavar="FILE", help="default: docs/performance.md")
    options = parser.parse_args()
    try:
        text = options.into.read_text(encoding="utf-8")
        for path in options.files:
            try:
                document = json.loads(path.read_text(encoding="utf-8"))
                text = insert(text, document["benchmark"], render(document))
            except (ValueError, KeyError, TypeError) as error:
                raise ConfigError(f"not what a benchmark writes with --json ({error!r})", file=str(path)) from error
        options.into.write_text(text, encoding="utf-8")
    except (SernError, OSError) as error:
        print(f"benchmarks.document: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
