"""`sern explain`: why the link carries what it carries.

`sern explain TOPIC` asks a running daemon what became of the last messages of a topic, and why: what they waited for,
what was sent instead, what was dropped. Without a topic it tells of the whole link: what was measured in each interval,
which configurations were weighed, what each was predicted to cost, which was chosen and why, what it then came to, and
of each topic what became of its last message. `--bag` tells the same of a recording over a link of one's choice,
replayed in virtual time.
"""

import json
import sys
import textwrap
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final
from urllib.parse import quote

import typer

from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.names import name_problem
from sern_runtime.profiles import load_profile
from sern_tools.api import LOCAL_APIS, NotFoundError, checked_api, drop_output, get_json, local_api, say
from sern_tools.explain_replay import SETTLE_S, Clouds, Setup, replay
from sern_tools.explain_story import Record, advice, held_because, in_short, lines, rate, size, span, verdict
from sern_tools.recorded_link import is_recording, read_link

CLIENTS_FIRST: Final = (*LOCAL_APIS[1:], LOCAL_APIS[0])
"""A client knows each step of its messages, a relay what is out of the ordinary."""
RECORDINGS: Final = (".bag", ".mcap", ".db3")
WIDTH: Final = 100
HANGING: Final = 35
"""Where the text of a story's lines begins."""
RATES_S: Final = 1.0
"""Between the two looks of which rates are."""
LAST: Final = 12
"""Lines about messages, where neighbours that fared alike share one."""
TERMS: Final = ("latency", "unreliability", "compute", "bandwidth")
OWN: Final = "/_sern/"
"""Streams of the link itself."""
DETAILS: Final = 4
"""Decisions that are shown with their candidates, of those that changed something."""


# --- text -------------------------------------------------------------------------------------------------------------


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
            f"{step['at_s']:7.1f} {rate(step['link']['capacity_bps']):>11} {_cost(measured)} {_cost(foreseen)}"
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
        f"  link      {rate(link['capacity_bps'])}, round trip {1e3 * link['rtt_s']:.0f} ms, "
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


def by_topic(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Records of messages by topic, those of the link itself left out."""
    found: dict[str, list[Record]] = defaultdict(list)
    for record in sorted(records, key=lambda record: record["number"]):
        if record["topic"] and not record["topic"].startswith(OWN):
            found[record["topic"]].append(record)
    return dict(sorted(found.items()))


def topic_lines(records: Iterable[Record], topics: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What became of each topic's last message, and of all of them."""
    lines = []
    told = by_topic(records)
    for topic in sorted(told.keys() | {name for name in topics if not name.startswith(OWN)}):
        lines += [topic, *_wrapped(f"    {verdict(told.get(topic, []))}", 4)]
        counts = topics.get(topic)
        if counts is not None:
            lines += _wrapped(f"    {_counted(counts)}", 4)
    return lines


def _wrapped(line: str, indent: int = HANGING) -> list[str]:
    return textwrap.wrap(line, WIDTH, subsequent_indent=" " * indent, break_long_words=False, drop_whitespace=True)


def _counted(counts: Mapping[str, Any]) -> str:
    dropped = ", ".join(f"{count} {reason}" for reason, count in counts["dropped"].items())
    return f"of {counts['offered']} offered {counts['delivered']} arrived" + (
        f"; dropped: {dropped}" if dropped else ""
    )


def report(
    steps: Sequence[Mapping[str, Any]],
    weights: Mapping[str, float],
    records: Sequence[Record],
    topics: Mapping[str, Mapping[str, Any]],
    *,
    details: int,
    every: bool,
) -> Iterable[str]:
    """The whole text. `every`: all decisions in detail, not only those that changed something."""
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
    yield "Topics, and what became of the last message of each (`sern explain TOPIC` tells more):"
    yield from topic_lines(records, topics) or ["nothing was offered"]


# --- one topic --------------------------------------------------------------------------------------------------------


def story(told: Mapping[str, Any], *, last: int, before: Mapping[str, Any] | None = None) -> Iterator[str]:
    """What /api/trace told of one topic, as text; with what it told `before`, rates beside the totals."""
    topic, records = told["topic"], told["records"]
    peers = dict.fromkeys(
        [*(stream["peer"] for stream in told["streams"]), *(r["peer"] for r in records if "peer" in r)]
    )
    for peer in peers:
        streams = [stream for stream in told["streams"] if stream["peer"] == peer]
        # What arrived names its origin alone: over the one link that a client has, or over none that we know better.
        mine = [record for record in records if record.get("peer", peer) == peer]
        for stream in streams:
            yield from _about(topic, stream, mine, told, _lately(stream, told, before))
        if not streams:
            yield f"{topic}, {peer}: the stream has ended"
        short = in_short(record for record in mine if record["topic"] == topic)
        if short and told["steps"]:
            yield from _wrapped(f"  lately    {short}", 12)
        shown = list(lines(mine, now_s=told["now_s"], last=last))
        if any(record["topic"] == topic for record in mine):
            yield f"  the last messages{'' if told['steps'] else ' that were out of the ordinary'}, and how long ago:"
            for line in shown:
                yield from _wrapped(line)
        elif told["steps"]:
            yield "  no message of it so far"
        else:
            yield "  nothing out of the ordinary is recorded: what came went its way"
        yield ""
    if told.get("streams_left_out"):
        yield f"{told['streams_left_out']} more streams; choose one link with --peer"


def _lately(stream: Mapping[str, Any], told: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    """The rates of a stream that goes out, between two looks; empty: they are not known."""
    if before is None or "offered" not in stream:
        return ""
    names = ("peer", "origin", "direction")
    for past in before["streams"]:
        if all(past[name] == stream[name] for name in names) and past.get("offered", 0) <= stream["offered"]:
            interval_s = max(told["now_s"] - before["now_s"], 1e-3)
            rates = [
                (total - earlier) / interval_s
                for total, earlier in (
                    (stream["offered"], past["offered"]),
                    (stream["delivered"], past["delivered"]),
                    (sum(stream["dropped"].values()), sum(past["dropped"].values())),
                )
            ]
            offered, arrived, dropped = (f"{value:.1f}/s" for value in rates)
            return f"; now {offered} offered, {arrived} arrive, {dropped} dropped"
    return ""


def _about(
    topic: str, stream: Mapping[str, Any], records: Sequence[Record], told: Mapping[str, Any], lately: str
) -> Iterator[str]:
    sends = stream["direction"] == "send"
    way = f"to {stream['peer']}" if sends else f"received from {stream['peer']}"
    kind = "reliable" if stream["reliable"] else f"best effort, the newest {stream['depth']} kept"
    limits = "".join(
        f", {text}"
        for text, given in (
            ("latched", stream["latched"]),
            (f"lifespan {stream['lifespan_s']:g} s" if stream["lifespan_s"] is not None else "", True),
            (f"at most {stream['max_rate_hz']:g} Hz" if stream["max_rate_hz"] is not None else "", True),
        )
        if given and text
    )
    yield f"{topic} of {stream['origin']}, {way}: class {stream['class']}, {kind}{limits}"
    if not sends:
        if not stream["up"]:
            yield "  now       there is no connection"
        yield "  what did not come is told where it is sent: ask that daemon, or the relay, with --api"
        return
    yield from _wrapped(f"  now       {_now(stream)}", 12)
    refused = f"; refused: {stream['refused']}" if stream["refused"] else ""
    yield from _wrapped(f"  so far    {_counted(stream)}{refused}{lately}", 12)
    todo = advice([record for record in records if record["topic"] == topic], _troubled(stream))
    if todo:
        yield from _wrapped(f"  to do     {todo}", 12)


def _troubled(stream: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """What is wrong now, as `advice` takes it; None: nothing is."""
    if not stream["up"]:
        return {"reason": "link_down"}
    if stream["wanted"] is False:
        return {"reason": "unwanted"}
    return stream["standing"] if "reason" in stream["standing"] else None


def _now(stream: Mapping[str, Any]) -> str:
    standing = stream["standing"]
    waiting, under_way = standing["waiting"], standing["under_way"]
    told = f"{waiting} wait" if waiting != 1 else "1 waits"
    if under_way:
        told += f", {under_way} under way"
    if not stream["up"]:
        return f"there is no connection to {stream['peer']}; {told}"
    if stream["wanted"] is False:
        return "nobody subscribes to it, so nothing of it is sent"
    if "seq" not in standing:
        return "nothing waits" + (f", {under_way} under way" if under_way else "")
    begun = f"is being sent, {size(standing['unsent_bytes'])} left, " if standing["begun"] else ""
    told += f"; message {standing['seq']}, {span(max(0.0, standing['age_s']))} old, {begun}"
    if standing.get("reason") == "encoding":
        return told + "is being compressed"
    if "reason" not in standing:
        return told + "goes next"
    told += f"waits: {held_because(standing)}"
    rank = standing.get("rank", 0)
    return told + (f" ({rank} {'topic goes' if rank == 1 else 'topics go'} before it)" if rank else "")


def replayed_story(
    records: Sequence[Record], topics: Mapping[str, Mapping[str, Any]], topic: str, last: int
) -> list[str]:
    """The same of a recording, at its end. Raises UsageError for a topic that is not there."""
    known = by_topic(records)
    if topic not in known:
        raise UsageError(f"{topic} is not in the recording; topics: {', '.join(known) or 'none'}")
    mine = [record for record in records if record["topic"] in ("", topic)]
    told = [topic]
    if topic in topics:
        told.append(f"  so far    {_counted(topics[topic])}")
    todo = advice(known[topic], None)
    if todo:
        told.append(f"  to do     {todo}")
    told += _wrapped(f"  lately    {in_short(known[topic])}", 12)
    told.append("  the last messages, and how long before the end:")
    end_s = max(record["now_s"] for record in records)
    return [*told, *(part for line in lines(mine, now_s=end_s, last=last) for part in _wrapped(line))]


# --- a running daemon -------------------------------------------------------------------------------------------------


def _query(**given: str | None) -> str:
    parts = [f"{name}={quote(value, safe='')}" for name, value in given.items() if value is not None]
    return f"?{'&'.join(parts)}" if parts else ""


def live_topic(api: str, topic: str, peer: str | None) -> dict[str, Any]:
    """What a daemon tells of one topic. Raises SernError."""
    try:
        told: dict[str, Any] = get_json(api, f"/api/trace{_query(topic=topic, peer=peer)}")
    except NotFoundError:
        raise SernError(f"{api}: the daemon is older than this program and tells no stories; update it") from None
    return told


def live(api: str, peer: str | None) -> tuple[list[dict[str, Any]], dict[str, float], list[Record], dict[str, Any]]:
    """(steps, weights, records, topics) of a daemon. Times count from the first interval told. Raises SernError."""
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
        records: list[Record] = get_json(api, f"/api/trace{_query(peer=peer)}")
    except NotFoundError:
        records = []
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
    return steps, told["weights"], records, topics


# --- the command ------------------------------------------------------------------------------------------------------


def explain(
    topic: Annotated[
        str | None,
        typer.Argument(
            help="Tell what became of this topic's last messages, such as /jackal1/odom; the whole link otherwise."
        ),
    ] = None,
    api: Annotated[
        str | None,
        typer.Option("--api", help="HTTP address of a daemon (http.listen in its file) [default: this machine's]."),
    ] = None,
    peer: Annotated[
        str | None, typer.Option("--peer", help="Of a relay, or of what one answered: the link to this client.")
    ] = None,
    last: Annotated[int, typer.Option("--last", "-n", min=1, help="Lines about messages of a topic.")] = LAST,
    bag: Annotated[
        Path | None, typer.Option("--bag", help="Replay a recording (.bag, .mcap, .db3) instead of asking a daemon.")
    ] = None,
    link: Annotated[
        str,
        typer.Option(
            "--link",
            help="Link for the replay: a profile (sern_runtime/profiles.yaml) or a recorded one: a .csv with time_s,"
            "rate_bps,delay_s,loss, answers of /api/link a line each (.jsonl), a lab's folder.",
        ),
    ] = "step",
    config: Annotated[
        Path | None, typer.Option("--config", help="A client's file: its rules, link, scheduler and adaptation.")
    ] = None,
    duration_s: Annotated[float, typer.Option("--duration", min=1.0, max=3600.0, help="Seconds to replay.")] = 60.0,
    cloud: Annotated[list[Path] | None, typer.Option("--cloud", help="A .ply scan to send as /points as well.")] = None,
    cloud_hz: Annotated[float, typer.Option("--cloud-hz", min=0.1, max=100.0, help="How often.")] = 2.0,
    details: Annotated[
        int, typer.Option("--details", min=1, help="Decisions to show with their candidates.")
    ] = DETAILS,
    every: Annotated[bool, typer.Option("--every", help="Not only decisions that changed something.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Everything as JSON.")] = False,
) -> None:
    """Say why messages are sent, thinned, held or dropped, and why this configuration was chosen.

    With TOPIC: what became of its last messages, what they waited for and what was sent instead, and what to do about
    it. Asks the daemon on this machine, a client before a relay; --api asks another. A client knows every step of its
    messages, a relay what is out of the ordinary.

    With --bag: a recording is replayed through the real scheduler, over a link of a profile or one that was recorded.

    Exit code 0 when said, 1 when there is no daemon or no such topic, 2 for wrong usage or a file that cannot be used.
    """
    records: Sequence[Record]
    try:
        _checked(topic, bag)
        if bag is not None:
            clouds = Clouds(tuple(cloud), cloud_hz) if cloud else None
            profile = read_link(Path(link), peer=peer, after_s=SETTLE_S) if is_recording(link) else load_profile(link)
            done = replay(bag, profile, Setup.of(config), duration_s=duration_s, clouds=clouds)
            steps, weights, records, topics = done.steps, done.weights, done.trace.to_json(), done.topics
        else:
            address = checked_api(api or local_api(CLIENTS_FIRST))
            if topic is not None:
                told = live_topic(address, topic, peer)
                if as_json:
                    sys.stdout.write(json.dumps(told, indent=1) + "\n")
                    return
                time.sleep(RATES_S)
                before, told = told, live_topic(address, topic, peer)
                print("\n".join(story(told, last=last, before=before)).rstrip())
                return
            steps, weights, records, topics = live(address, peer)
        if as_json:
            content = {"steps": steps, "weights": weights, "topics": topics, "trace": records}
            sys.stdout.write(json.dumps(content, indent=1) + "\n")
            return
        if topic is not None:
            text: Iterable[str] = replayed_story(records, topics, topic, last)
        else:
            text = report(steps, weights, records, topics, details=details, every=every)
        for line in text:
            print(line)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern explain", error)) from None


def _checked(topic: str | None, bag: Path | None) -> None:
    """Raises UsageError for what is no topic's name."""
    if topic is None:
        return
    if bag is None and topic.endswith(RECORDINGS):
        raise UsageError(f"{topic} is a recording; give it with --bag")
    problem = name_problem(topic)
    if problem is not None:
        raise UsageError(f"topic {topic!r} {problem}")
