"""`sern explain`: why the link carries what it carries.

Of a running daemon (its HTTP server), or of a recording over a scripted link, replayed in virtual time: what was
measured in each interval, which configurations were weighed, what each was predicted to cost, which was chosen and why,
and what it then came to; and of each topic what became of its last message, and why.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.trace import DecisionTrace, TraceEvent
from sern_core.vocabulary.types import TopicName
from sern_runtime.profiles import load_profile
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, say
from sern_tools.explain_replay import Clouds, Setup, replay

ROBOT_API: Final = "http://127.0.0.1:5581"
"""Where the robot of the examples answers."""
WIDTH: Final = 100
TERMS: Final = ("latency", "unreliability", "compute", "bandwidth")
OWN: Final = "/_sern/"
"""Streams of the link itself."""
DETAILS: Final = 4
"""Decisions that are shown with their candidates, of those that changed something."""


# --- text -------------------------------------------------------------------------------------------------------------


def _rate(value: float | None) -> str:
    if value is None:
        return "unknown"
    for unit, size in (("Mbit/s", 1e6), ("kbit/s", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.0f} bit/s"


def _cells(terms: Mapping[str, float] | None) -> str:
    return "    -     -     -     -" if terms is None else " ".join(f"{terms[name]:5.2f}" for name in TERMS)


def _cost(part: Mapping[str, Any] | None) -> str:
    return "     -" if part is None or part["cost"] is None else f"{part['cost']:6.3f}"


def overview(steps: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line an interval: the link, what it cost, what had been predicted for it, and what was in force."""
    lines = [
        "   time        link   cost (said) laten unrel compu bandw   in force; * changed at its end",
    ]
    foreseen: Mapping[str, Any] | None = None
    for step in steps:
        measured = step["measured"]
        mark = "*" if step["switched"] else " "
        terms = None if measured is None else measured["terms"]
        lines.append(
            f"{step['at_s']:7.1f} {_rate(step['link']['capacity_bps']):>11} {_cost(measured)} {_cost(foreseen)}"
            f" {_cells(terms)} {mark} {step['in_force']['text']}"
        )
        foreseen = step["predicted"]
    return [line[:WIDTH].rstrip() for line in lines]


def decision(step: Mapping[str, Any], after: Mapping[str, Any] | None) -> list[str]:
    """One decision: what was known, what was weighed, what was chosen and why, what it came to."""
    link = step["link"]
    offered = ", ".join(
        f"{part['class']} {part['rate_hz']:.3g} Hz of {part['mean_bytes']} B" for part in step["offered"]
    )
    lines = [
        f"at {step['at_s']:.1f} s",
        f"  link      {_rate(link['capacity_bps'])}, round trip {1e3 * link['rtt_s']:.0f} ms, "
        f"loss {100 * link['loss']:.1f} %",
        f"  offered   {offered or 'nothing'}",
    ]
    if step["candidates"]:
        lines.append(f"  weighed   {step['weighed']} configurations; the best, by what they are predicted to cost:")
        lines.append("                J   laten unrel compu bandw   configuration")
        for candidate in step["candidates"]:
            chosen = candidate["configuration"]["text"] == step["chosen"]["text"]
            lines.append(
                f"      {'->' if chosen else '  '}   {candidate['cost']:6.3f}  {_cells(candidate['terms'])}   "
                f"{candidate['configuration']['text']}"
                + (f"  ({candidate['obstacle']})" if candidate["obstacle"] else "")
            )
    predicted = step["predicted"]
    if predicted is not None:
        lines += [
            f"  {part['class']:8}  loads the link by {100 * part['load']:.0f} %, arrives after "
            f"{1e3 * part['latency_s']:.0f} ms, {100 * part['on_time']:.0f} % of it in time"
            for part in predicted["classes"]
        ]
    lines.append(f"  chosen    {step['reason']}")
    if after is not None and after["measured"] is not None:
        lines.append(f"  came to   {_cost(after['measured']).strip()} = {_named(after['measured']['terms'])}")
    return [line[:WIDTH] for line in lines]


def _named(terms: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {terms[name]:.3f}" for name in TERMS)


def topic_lines(trace: DecisionTrace, topics: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What became of each topic's last message, and of all of them."""
    lines = []
    for topic in trace.topics:
        if topic.startswith(OWN):
            continue
        verdict = trace.story(topic)[-1]
        counts = topics.get(topic)
        lines += [topic, f"    {verdict}"[:WIDTH]]
        if counts is not None:
            dropped = ", ".join(f"{count} {reason}" for reason, count in counts["dropped"].items())
            lines.append(
                f"    of {counts['offered']} offered {counts['delivered']} arrived"
                + (f"; dropped: {dropped}" if dropped else "")
            )
    return lines


def story(trace: DecisionTrace, topic: str) -> list[str]:
    """The last message of one topic, event by event. Raises UsageError for one that is not there."""
    if TopicName(topic) not in trace.topics:
        known = ", ".join(name for name in trace.topics if not name.startswith(OWN)) or "none"
        raise UsageError(f"{topic} is not in the log; topics: {known}")
    return trace.story(TopicName(topic))


def report(
    steps: Sequence[Mapping[str, Any]],
    weights: Mapping[str, float],
    trace: DecisionTrace,
    topics: Mapping[str, Mapping[str, Any]],
    *,
    topic: str | None,
    details: int,
    every: bool,
) -> Iterable[str]:
    """The whole text. `every`: all decisions in detail, not only those that changed something."""
    if topic is not None:
        yield from story(trace, topic)
        return
    if steps:
        yield "cost J = " + " + ".join(f"{weights[name]:g} {name}" for name in TERMS) + ", each 0 (good) to 1 (bad)"
        yield "r: share of the messages let in, q: queue limit (control/state/bulk), z: compression, h: sent twice"
        yield ""
        yield from overview(steps)
        pairs = list(zip(steps, [*steps[1:], None], strict=True))
        chosen = [pair for pair in pairs if every or pair[0]["switched"]] or pairs[-1:]
        yield ""
        yield f"{'Decisions' if every else 'Decisions that changed something'}, the last {min(details, len(chosen))}:"
        for step, after in chosen[-details:]:
            yield ""
            yield from decision(step, after)
        yield ""
    yield "Topics, and what became of the last message of each:"
    yield from topic_lines(trace, topics) or ["nothing was offered"]


# --- a running daemon -------------------------------------------------------------------------------------------------


def trace_of(records: Iterable[Mapping[str, Any]]) -> DecisionTrace:
    """A trace with the records that /api/trace told."""
    trace = DecisionTrace(capacity=100_000, max_topics=100_000)
    for record in sorted(records, key=lambda record: record["number"]):
        fields = {k: v for k, v in record.items() if k not in ("number", "now_s", "topic", "event", "seq")}
        trace.record(record["now_s"], TopicName(record["topic"]), TraceEvent(record["event"]), record["seq"], **fields)
    return trace


def live(api: str, peer: str | None) -> tuple[list[dict[str, Any]], dict[str, float], DecisionTrace, dict[str, Any]]:
    """(steps, weights, trace, topics) of a daemon. Times count from the first interval told. Raises SernError."""
    try:
        told = get_json(api, "/api/mmcf")
    except NotFoundError:
        told = {"links": [], "weights": dict.fromkeys(TERMS, 0.0)}
    links = told["links"]
    if peer is not None:
        links = [link for link in links if link["peer"] == peer]
        if not links:
            raise UsageError(f"--peer {peer}: {api} adapts no link to it")
    elif len(links) > 1:
        names = ", ".join(link["peer"] for link in links)
        raise UsageError(f"{api} adapts several links; choose one with --peer: {names}")
    steps = list(links[0]["history"]) if links else []
    for step in steps:
        step["at_s"] = step["now_s"] - steps[0]["now_s"]
    try:
        trace = trace_of(get_json(api, "/api/trace"))
    except NotFoundError:
        trace = DecisionTrace()
    answer = get_json(api, "/api/topics")
    table = answer.get("links", {}).get(peer, {}) if "links" in answer else answer
    topics = {
        name: {
            "offered": row["offered"],
            "delivered": row["delivered"],
            "dropped": {reason: count for reason, count in row["dropped"].items() if count},
        }
        for name, row in table.items()
        if row["direction"] == "send"
    }
    return steps, told["weights"], trace, topics


# --- the command ------------------------------------------------------------------------------------------------------


def explain(
    bag: Annotated[
        Path | None, typer.Argument(help="A recording to replay; without it a running daemon is asked.")
    ] = None,
    link: Annotated[
        str, typer.Option("--link", help="Link profile for the replay (sern_runtime/profiles.yaml).")
    ] = "step",
    config: Annotated[
        Path | None, typer.Option("--config", help="A client's file: its rules, link, scheduler and adaptation.")
    ] = None,
    duration_s: Annotated[float, typer.Option("--duration", min=1.0, max=3600.0, help="Seconds to replay.")] = 60.0,
    cloud: Annotated[list[Path] | None, typer.Option("--cloud", help="A .ply scan to send as /points as well.")] = None,
    cloud_hz: Annotated[float, typer.Option("--cloud-hz", min=0.1, max=100.0, help="How often.")] = 2.0,
    api: Annotated[str, typer.Option("--api", help="HTTP address of a daemon (http.listen in its file).")] = ROBOT_API,
    peer: Annotated[str | None, typer.Option("--peer", help="Of a relay: the link to this client.")] = None,
    topic: Annotated[str | None, typer.Option("--topic", help="Only the story of this topic's last message.")] = None,
    details: Annotated[
        int, typer.Option("--details", min=1, help="Decisions to show with their candidates.")
    ] = DETAILS,
    every: Annotated[bool, typer.Option("--every", help="Not only decisions that changed something.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Everything as JSON.")] = False,
) -> None:
    """Say why messages are sent, thinned, held or dropped, and why this configuration was chosen.

    Exit code 0 when said, 1 when there is no daemon, 2 for wrong usage or a file that cannot be used.
    """
    try:
        if bag is not None:
            clouds = Clouds(tuple(cloud), cloud_hz) if cloud else None
            done = replay(bag, load_profile(link), Setup.of(config), duration_s=duration_s, clouds=clouds)
            steps, weights, trace, topics = done.steps, done.weights, done.trace, done.topics
        else:
            steps, weights, trace, topics = live(checked_api(api), peer)
        if as_json:
            content = {"steps": steps, "weights": weights, "topics": topics, "trace": trace.to_json()}
            sys.stdout.write(json.dumps(content, indent=1) + "\n")
            return
        for line in report(steps, weights, trace, topics, topic=topic, details=details, every=every):
            print(line)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern explain", error)) from None
