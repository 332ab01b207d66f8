"""What a demo leaves behind: the JSON of the benchmarks' shape, the summary on the terminal, and one HTML file."""

import base64
import html
import json
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sern_core.vocabulary.types import CLASS_LABELS
from sern_runtime.config.endpoints import installing
from sern_sim.profiles import LinkProfile
from sern_tools import demo_charts
from sern_tools.checkout import commit
from sern_tools.demo_behaviour import Behaviour
from sern_tools.demo_live import rate
from sern_tools.demo_scenario import Scenario
from sern_tools.summary import Result, Statistics, Verdict


@dataclass(frozen=True)
class Carried:
    """What a proxy carried from robot to site: bytes in each bucket since the start of the script."""

    bucket_s: float
    bytes_per_bucket: Sequence[int]


@dataclass(frozen=True)
class Report:
    """Everything there is to say about one run. `results`: SERN first, then the baseline if there was one."""

    command: str
    started: str
    scenario: Scenario
    results: Sequence[Result]
    verdicts: Sequence[Verdict]
    carried: Mapping[str, Carried] = field(default_factory=dict)
    comparison: Mapping[str, Verdict] = field(default_factory=dict)
    """What the baseline, which promises none of it, measured to: by the name of the verdict."""
    remarks: Sequence[str] = ()
    behaviour: Behaviour = field(default_factory=Behaviour)
    """What SERN did in its run."""

    @property
    def ok(self) -> bool:
        return all(verdict.ok for verdict in self.verdicts)


# JSON ----------------------------------------------------------------------------------------------------------------


def as_json(report: Report) -> str:
    """The benchmarks' shape; a number that does not exist (nothing delivered) is null."""
    rows: list[dict[str, object]] = []
    for result in report.results:
        for label in CLASS_LABELS:
            statistics = result.classes[label]
            row: dict[str, object] = {"case": label, "system": result.system}
            row |= {name: _number(value) for name, value in _metrics(statistics).items()}
            row |= {f"dropped_{reason}_messages": count for reason, count in sorted(statistics.dropped.items())}
            rows.append(row)
        link: dict[str, object] = {"case": "link", "system": result.system}
        link |= {f"idle_from_{origin}_s": _number(value) for origin, value in sorted(result.facts.floor_s.items())}
        for number, seconds in enumerate(result.first_fresh_pose_s, start=1):
            link[f"first_fresh_pose_{number}_s"] = _number(seconds)
        if result is report.results[0]:
            link |= report.behaviour.as_row()
        rows.append(link)
    document = {"benchmark": "demo", "commit": commit(), "rows": rows, "reach": reach(report.verdicts)}
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def reach(verdicts: Sequence[Verdict]) -> list[dict[str, object]]:
    """The promises, each with what was found."""
    return [{"name": v.name, "value": _number(v.value), "limit": _number(v.limit), "ok": v.ok} for v in verdicts]


def _metrics(statistics: Statistics) -> dict[str, float]:
    return {
        "offered_messages": statistics.offered,
        "delivered_messages": statistics.delivered,
        "refused_messages": statistics.refused,
        "undelivered_messages": statistics.undelivered,
        "offered_bytes": statistics.offered_bytes,
        "delivered_bytes": statistics.delivered_bytes,
        "latency_p50_s": statistics.quantile_s(0.5),
        "latency_p99_s": statistics.quantile_s(0.99),
        "latency_max_s": statistics.quantile_s(1.0),
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


# Terminal ------------------------------------------------------------------------------------------------------------


def print_summary(report: Report, console: Console) -> None:
    """Two tables that fit 80 columns: what became of each class, and which promises were kept."""
    table = Table(title="What became of the messages", title_justify="left", box=None, padding=(0, 2, 0, 0))
    for heading in ("class", "system"):
        table.add_column(heading, no_wrap=True)
    for heading in ("offered", "delivered", "p50", "p99", "floor"):
        table.add_column(heading, justify="right", no_wrap=True)
    for label in CLASS_LABELS:
        for result in report.results:
            statistics = result.classes[label]
            table.add_row(
                label if result is report.results[0] else "",
                result.system,
                str(statistics.offered),
                f"{statistics.delivered} ({_percent(statistics.delivered_share)})",
                seconds(statistics.quantile_s(0.5)),
                seconds(statistics.quantile_s(0.99)),
                seconds(_floor_s(result, label)),
            )
    console.print(table)
    for result in report.results:
        for label in CLASS_LABELS:
            reasons = drop_words(result.classes[label])
            if reasons:
                console.print(f"{result.system}, {label}: {reasons}", highlight=False)
    behaved = Table.grid(padding=(0, 2, 0, 0))
    for name, words in _behaviour(report):
        behaved.add_row(f"{report.results[0].system}, {name}:", words)
    console.print(behaved)
    console.print()
    print_verdicts(report.verdicts, console)
    for remark in report.remarks:
        console.print(remark, highlight=False, style="yellow", markup=False)


def print_verdicts(verdicts: Sequence[Verdict], console: Console) -> None:
    """Which promises were kept."""
    promises = Table.grid(padding=(0, 2, 0, 0))
    for verdict in verdicts:
        word = Text("kept", "green") if verdict.ok else Text("BROKEN", "bold red")
        promises.add_row(word, Text(f"{verdict.promise}: {measured(verdict)}"))
    console.print(promises)


def _behaviour(report: Report) -> list[tuple[str, str]]:
    return report.behaviour.rows(report.results[0].classes["bulk"].delivered_share)


def measured(verdict: Verdict) -> str:
    """The value, the limit and the detail of a verdict, in words."""
    show = _unit(verdict)
    text = show(verdict.value)
    if verdict.limit:
        text += f" (limit {show(verdict.limit)})"
    return f"{text}; {verdict.detail}" if verdict.detail else text


def _without_limit(verdict: Verdict) -> str:
    return measured(replace(verdict, limit=0.0))


def _unit(verdict: Verdict) -> Callable[[float], str]:
    if verdict.noun:
        return lambda value: f"{value:.0f} {verdict.noun}" if value else f"none {verdict.noun}"
    return seconds if verdict.name.endswith("_s") else _share


def drop_words(statistics: Statistics) -> str:
    """Every message that was not delivered, by reason; empty when all were."""
    words = [f"{count} {reason}" for reason, count in statistics.dropped.most_common()]
    if statistics.refused:
        words.append(f"{statistics.refused} refused")
    if statistics.under_way:
        words.append(f"{statistics.under_way} under way at the end")
    if statistics.unseen:
        words.append(f"{statistics.unseen} never seen again")
    return ", ".join(words)


def seconds(value: float) -> str:
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never"
    return f"{value * 1e3:.1f} ms" if value < 1 else f"{value:.2f} s"


def _floor_s(result: Result, label: str) -> float:
    origins = {log.origin for log in result.logs.values() if log.priority == label}
    return max((result.facts.floor_s.get(origin, math.nan) for origin in origins), default=math.nan)


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f} %"


def _share(value: float) -> str:
    return f"{100 * value:.2f} %"


# HTML ----------------------------------------------------------------------------------------------------------------

_STYLE: Final = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2328; margin: 0 auto; max-width: 1000px; padding: 24px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 19px; margin: 36px 0 8px; }
p { margin: 8px 0; } .lead { color: #59636e; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 5px 10px 5px 0; border-bottom: 1px solid #d1d9e0; vertical-align: top; }
th { font-weight: 600; } th.wide { width: 38%; } td.n, th.n { text-align: right; white-space: nowrap; }
td.system { white-space: nowrap; } tr.first td { border-top: 2px solid #afb8c1; }
.kept { color: #1a7f37; font-weight: 600; } .broken { color: #cf222e; font-weight: 600; }
.banner { padding: 10px 14px; border-radius: 6px; font-weight: 600; margin: 16px 0; }
.banner.good { background: #dafbe1; } .banner.bad { background: #ffebe9; }
img { width: 100%; height: auto; display: block; }
code, pre { font: 13px/1.45 ui-monospace, monospace; background: #f6f8fa; border-radius: 6px; }
code { padding: 1px 5px; } pre { padding: 12px; overflow-x: auto; }
li { margin: 4px 0; }
@media print { body { max-width: none; } h2 { break-after: avoid; } img, tr { break-inside: avoid; } }
"""


def as_html(report: Report) -> str:
    """One self-contained file: no script, nothing loaded from anywhere."""
    scenario = report.scenario
    broken = [verdict for verdict in report.verdicts if not verdict.ok]
    banner = "Every promise was kept." if not broken else f"{len(broken)} of {len(report.verdicts)} promises broken."
    load = f"the recording {scenario.bag.name}" if scenario.bag else "a simulated robot"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><title>SERN demo</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>SERN over a bad link: {html.escape(scenario.profile.name)}</h1>",
        f'<p class="lead">{html.escape(scenario.profile.description)}. {scenario.duration_s:.0f} s of {load} '
        f"offering {scenario.overload:g} times what the link carries, {html.escape(report.started)}.</p>",
        f'<p class="banner {"bad" if broken else "good"}">{banner}</p>',
        "<h2>What was promised, and whether it held</h2>",
        _verdict_table(report),
        "<h2>What became of the messages</h2>",
        _class_table(report.results),
        *_behaviour_table(report),
        *_figures(report),
        "<h2>By topic</h2>",
        *(_topic_table(result) for result in report.results),
        "<h2>How to read this</h2>",
        "<ul>" + "".join(f"<li>{note}</li>" for note in _notes(report)) + "</ul>",
        "<h2>How it was made</h2>",
        f"<pre>{html.escape(report.command)}</pre>",
        f"<p>Commit {html.escape(commit())}, Python {platform.python_version()}, {html.escape(platform.platform())}, "
        f"{os.cpu_count()} CPUs.</p>",
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _behaviour_table(report: Report) -> list[str]:
    cells = [f"<tr><td>{name}</td><td>{html.escape(words)}</td></tr>" for name, words in _behaviour(report)]
    return [f"<h2>How {report.results[0].system} behaved</h2>", "<table>", *cells, "</table>"] if cells else []


def _verdict_table(report: Report) -> str:
    head = '<tr><th></th><th class="wide">promise</th><th>measured</th>'
    head += "<th>plain ZMQ, which promises none of it</th></tr>" if report.comparison else "</tr>"
    rows = []
    for verdict in report.verdicts:
        other = report.comparison.get(verdict.name)
        cells = [html.escape(verdict.promise), html.escape(measured(verdict))]
        if report.comparison:
            cells.append(html.escape(_without_limit(other)) if other else "")
        word, style = ("kept", "kept") if verdict.ok else ("BROKEN", "broken")
        rows.append(f'<tr><td class="{style}">{word}</td>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return "<table>" + head + "".join(rows) + "</table>"


def _class_table(results: Sequence[Result]) -> str:
    head = ("offered", "delivered", "p50", "p99", "idle link")
    rows = ["<tr><th>class</th><th>system</th>" + "".join(f'<th class="n">{h}</th>' for h in head)]
    rows[0] += "<th>not delivered</th></tr>"
    for label in CLASS_LABELS:
        for index, result in enumerate(results):
            statistics = result.classes[label]
            cells = (
                str(statistics.offered),
                f"{statistics.delivered} ({_percent(statistics.delivered_share)})",
                seconds(statistics.quantile_s(0.5)),
                seconds(statistics.quantile_s(0.99)),
                seconds(_floor_s(result, label)),
            )
            rows.append(
                f'<tr class="{"first" if index == 0 else ""}"><td>{label if index == 0 else ""}</td>'
                f'<td class="system">{html.escape(result.system)}</td>'
                + "".join(f'<td class="n">{cell}</td>' for cell in cells)
                + f"<td>{html.escape(drop_words(statistics)) or 'none'}</td></tr>"
            )
    fresh = [
        f"{html.escape(result.system)}: {', '.join(seconds(value) for value in result.first_fresh_pose_s)}"
        for result in results
        if result.first_fresh_pose_s
    ]
    after = f"<p>From the end of the blackout to the first fresh pose: {'; '.join(fresh)}.</p>" if fresh else ""
    return "<table>" + "".join(rows) + "</table>" + after


def _topic_table(result: Result) -> str:
    head = ("offered", "delivered", "kB delivered", "p50", "p99", "max")
    rows = ["<tr><th>topic</th><th>class</th>" + "".join(f'<th class="n">{h}</th>' for h in head) + "</tr>"]
    for name, statistics in sorted(
        result.topics.items(), key=lambda item: (CLASS_LABELS.index(result.logs[item[0]].priority), item[0])
    ):
        cells = (
            str(statistics.offered),
            str(statistics.delivered),
            f"{statistics.delivered_bytes / 1000:.0f}",
            seconds(statistics.quantile_s(0.5)),
            seconds(statistics.quantile_s(0.99)),
            seconds(statistics.quantile_s(1.0)),
        )
        rows.append(
            f"<tr><td><code>{html.escape(name)}</code></td><td>{result.logs[name].priority}</td>"
            + "".join(f'<td class="n">{cell}</td>' for cell in cells)
            + "</tr>"
        )
    return f"<h3>{html.escape(result.system)}</h3><table>{''.join(rows)}</table>"


def _figures(report: Report) -> list[str]:
    try:
        charts = [
            ("Latency of every message", demo_charts.latency(report.results)),
            ("Age of the newest pose at the site", demo_charts.pose_age(report.results)),
            ("What the link carried", _goodput(report)),
            ("Delivered and dropped, by class", demo_charts.drops(report.results)),
        ]
    except ImportError:
        command = html.escape(installing("matplotlib"))
        return [f"<p>No pictures: matplotlib is not installed (<code>{command}</code>).</p>"]
    return [
        f'<h2>{title}</h2><img alt="{title}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        for title, png in charts
    ]


def _goodput(report: Report) -> bytes:
    carried = {name: (c.bucket_s, c.bytes_per_bucket) for name, c in report.carried.items()}
    return demo_charts.goodput(report.results, carried, report.scenario.profile)


def _notes(report: Report) -> list[str]:
    profile: LinkProfile = report.scenario.profile
    notes = [
        "Relay, robot and site ran as processes of their own on one machine, so one clock stamped both ends. The robot "
        "reached the relay through a proxy that shapes TCP and UDP as one link: rate, delay, jitter, a queue of "
        f"{profile.queue_packets} packets, 64 kB of socket buffers, and blackouts that freeze bytes, datagrams and new "
        "connections alike. The site was beside the relay; commands went the other way through the same proxy.",
        "<b>The proxy does not represent TCP's own loss recovery.</b> Its bytes are a TCP stream, so packet loss is "
        "applied to datagrams only"
        + (f" (this profile has {100 * profile.up.mean_loss:.2g} %)" if profile.up.mean_loss else "")
        + ", and after a blackout bytes move again at once instead of after TCP's retransmission timer. Over TCP "
        "both systems are spared this alike; the lab (<code>tc netem</code>) is where it is measured.",
        "SERN may use its datagram lane and its adaptation, as it does in the field; datagrams share the link with "
        "TCP, and the profile's loss is theirs. How much it used them is told above.",
    ]
    if len(report.results) > 1:
        notes += [
            "The baseline is one ZMQ PUB socket and one SUB socket a direction with their defaults, with the same "
            "load, through a proxy of its own with the same profile and seed. Two favours are done to it: no "
            "encryption, and kernel buffers held to 64 kB. It ran after SERN, not beside it, because two loads on a "
            "small machine would disturb each other.",
            "ZMQ drops without a word what its queue cannot hold, and keeps no order of urgency. <i>Never seen "
            "again</i> counts what it dropped and what still waited in its queue three seconds after the end.",
        ]
    notes += [
        "<i>Unwanted</i> are messages that were offered before anybody had subscribed to them; <i>superseded</i> ones "
        "made way for a newer sample of the same topic.",
        "Every message is followed by its number through the logs of robot, relay and site, and has one fate: "
        "delivered, refused, dropped at one place for one reason, or waiting at the end. <i>Unconfirmed</i> are those "
        "that were sent whole and given up without an acknowledgement, and of which the next place has nothing to say: "
        "they were lost on the way. Those of which it has are counted as what became of them.",
        "<i>Idle link</i> is the one-way latency of a 100-byte message over plain ZMQ through the same proxy before "
        "any load: nothing can be faster.",
        "A message is <i>overtaken</i> when a less urgent one from the same origin, offered at least 10 ms later, "
        "arrives at least 10 ms earlier. The less urgent classes keep a floor of the link while others wait, so a "
        "small share is allowed.",
        "A pose is <i>fresh</i> when it is at most 0.5 s older than the idle link makes it.",
    ]
    notes += [html.escape(remark) for remark in report.remarks]
    return notes


def load_words(scenario: Scenario) -> str:
    """The load in one line, for the terminal."""
    offered = rate(scenario.overload * scenario.usual_bps)
    return f"{offered} offered to a link of {rate(scenario.usual_bps)}"
