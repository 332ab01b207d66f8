"""The screen of `sern top`: a view as lines of text of a given width. Pure.

A line is made of pieces with a style each, so that its width is known before colour is. Whatever comes from outside (a
topic's name, a reason) is made printable ASCII first: nothing of it steers the terminal, and every character is one
column wide.
"""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from sern_runtime.watching.state import LinkLine, TopicLine, View, class_order
from sern_tools.explain_story import rate

MIN_WIDTH: Final = 20
"""What is laid out for less is cut."""
Piece = tuple[str, str]
"""Text, and its style: a key of `CODES`, or empty."""
Line = list[Piece]

CODES: Final[Mapping[str, str]] = {
    "bad": "1;31", "warn": "33", "note": "2", "ok": "", "good": "32", "head": "1", "dim": "2",
}  # fmt: skip
"""Of Select Graphic Rendition (ECMA-48)."""
UP: Final = {"connected": "good", "silent": "warn", "away": "bad", "never": "note", "forgotten": "note"}
PEERS: Final = 6
LINKS: Final = 6
EVENTS: Final = 3
WHY_LINES: Final = 2
NAME: Final = 14
MARK: Final = "~"
"""Stands where a text was cut."""


def plain(text: str) -> str:
    """Printable ASCII alone, of the same number of characters."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)


def fit(text: str, width: int) -> str:
    """The beginning of a text, if it is too long."""
    text = plain(text)
    return text if len(text) <= width else text[: max(0, width - 1)] + MARK[:width]


def fit_end(text: str, width: int) -> str:
    """The end of a text, if it is too long: of a topic's name that says more than the beginning."""
    text = plain(text)
    return text if len(text) <= width else MARK[:width] + text[len(text) - max(0, width - 1) :]


def ago(seconds: float | None) -> str:
    """A time span in at most five characters; empty for none."""
    if seconds is None:
        return ""
    if seconds < 9.95:
        return f"{max(0.0, seconds):.1f}s"
    for unit, size in (("s", 1), ("m", 60), ("h", 3600)):
        if seconds < 100 * size:
            return f"{seconds / size:.0f}{unit}"
    return f"{min(seconds / 86400, 9999):.0f}d"


def count(value: float) -> str:
    """A number in at most five characters, powers of 1000; empty for none."""
    if value < 0.05:
        return ""
    if value < 99.95:
        return f"{value:.1f}"
    for unit in ("", "k", "M", "G"):
        if value < 999.5 or unit == "G":
            return f"{min(value, 9999):.0f}{unit}" if value >= 9.95 or not unit else f"{value:.1f}{unit}"
        value /= 1000
    raise AssertionError("unreachable")


def whole(value: int) -> str:
    """A number of messages or bytes in at most five characters; empty for none."""
    return str(value) if 0 < value < 10_000 else count(float(value))


def clipped(line: Line, width: int) -> Line:
    """The first `width` columns of a line."""
    result: Line = []
    left = width
    for text, style in line:
        if left <= 0:
            break
        text = plain(text)
        result.append((text if len(text) <= left else fit(text, left), style))
        left -= len(result[-1][0])
    return result


def length(line: Line) -> int:
    return sum(len(text) for text, _style in line)


def in_colour(line: Line, *, colour: bool) -> str:
    """The line as a terminal takes it."""
    return "".join(f"\x1b[{CODES[s]}m{text}\x1b[0m" if colour and CODES.get(s) else text for text, s in line)


# --- the screen -------------------------------------------------------------------------------------------------------


def screen(view: View, width: int, height: int | None = None, *, api: str = "", problem: str = "") -> list[Line]:
    """All of it: at most `height` lines of at most `width` columns. `problem`: why it is not of now."""
    columns, width = width, max(width, MIN_WIDTH)
    top = [_title(view, width, api), *([[(problem, "bad")]] if problem else [])]
    top += _links(view) + _choices(view, width) + _peers(view, width)
    top += [[(f"{'! ' if level != 'note' else ''}{text}", level)] for level, text in view.notes]
    told = [event for event in view.events if event["kind"] != "denied"]  # those are beside their topics
    events = [_event(event) for event in told[-EVENTS:]]
    room = None if height is None else max(1, height - len(top) - len(events))
    lines = [*top, *_topics(view.topics, width, room), *events]
    if height is not None and len(lines) > height:
        lines = lines[:height]
    return [clipped(line, columns) for line in lines]


def _title(view: View, width: int, api: str) -> Line:
    left = f"{view.role} {view.name}" + (f" at {api.removeprefix('http://')}" if api else "")
    clock = view.time[11:19] + "Z"
    gap = width - len(left) - len(clock)
    return [(left, "head"), (" " * max(1, gap) + clock, "dim")]


def _links(view: View) -> list[Line]:
    """The link of a client; those of a relay, what is wrong first, some of them."""
    if not view.links:
        return [[("link  no client is known", "note")]]
    order = {"silent": 0, "away": 1, "connected": 2}
    lines = sorted(view.links, key=lambda line: (order.get(line.state, 3), line.peer))
    names = min(NAME, max(len(line.peer) for line in lines[:LINKS]))
    shown = [_link(line, "link" if index == 0 else "", names) for index, line in enumerate(lines[:LINKS])]
    left = lines[LINKS:]
    if left:
        up = sum(line.state == "connected" for line in left)
        shown.append([(f"      and {len(left)} more, {up} of them connected", "dim")])
    return shown


def _link(line: LinkLine, head: str, names: int) -> Line:
    pieces: Line = [(f"{head:5} ", "head"), (f"{fit(line.peer, names):{names}} ", "")]
    pieces.append((f"{line.state:9} ", UP.get(line.state, "")))
    if line.state == "silent":
        pieces.append((f"last heard {ago(line.heard_s)} ago  {line.lane or ''}", ""))
    elif line.state == "connected":
        pieces.append((_load(line), ""))
        if line.round_trip_s is not None:
            pieces.append((f"  rtt {1e3 * line.round_trip_s:.0f}ms", ""))
        if line.loss is not None:
            pieces.append((f"  loss {100 * line.loss:.1f}%", "warn" if line.loss >= 0.05 else ""))
        pieces.append((f"  {line.lane or ''}", ""))
        if line.waiting_bytes:
            pieces.append((f"  {count(line.waiting_bytes)}B wait", "dim"))
    elif line.since_s is not None:
        pieces.append((f"for {ago(line.since_s)}", ""))
    if line.why:
        pieces.append((f"  {line.why}", "bad" if line.state in ("silent", "away") else "note"))
    return pieces


def _load(line: LinkLine) -> str:
    """What is sent of what the link carries."""
    sent = rate(8 * (line.sent_bytes_per_s or 0.0))
    if line.capacity_bps is None:
        return f"{sent}, never full"
    carries = rate(line.capacity_bps)
    number, _, unit = sent.partition(" ")
    return f"{number if carries.endswith(unit) else sent} of {carries}"


def _choices(view: View, width: int) -> list[Line]:
    """The configuration and why; of a relay with several links only those that leave something out."""
    chosen = view.choices
    if len(chosen) > 1:
        chosen = tuple(choice for choice in chosen if "let in: " in choice.text or "summaries" in choice.text)
        if not chosen:
            return [[("conf  ", "head"), (f"all {len(view.choices)} links: everything is let in", "")]]
    lines: list[Line] = []
    for choice in chosen[:3]:
        peer = f"{fit(choice.peer, NAME)}: " if len(view.choices) > 1 else ""
        thin = "let in: " in choice.text
        line: Line = [("conf  ", "head"), (f"{peer}{choice.text}", "warn" if thin else "")]
        why = f" ({choice.reason})" if choice.reason else ""
        if why and length(line) + len(why) > width:
            lines += [line, [(f"      {why.strip()}", "dim")]]
        else:
            lines.append([*line, (why, "dim")])
    return lines or [[("conf  ", "head"), ("no adaptation: as the rules of the topics say", "dim")]]


def _peers(view: View, width: int) -> list[Line]:
    """Whom a client knows beside its relay: one line while all are well, else a line each of those who are not."""
    if not view.peers:
        return []
    away = [line for line in view.peers if line.state != "connected"]
    well = [line for line in view.peers if line.state == "connected"]
    lines: list[Line] = []
    if well:
        names = ", ".join(
            line.peer + ("" if line.round_trip_s is None else f" {1e3 * line.round_trip_s:.0f} ms") for line in well
        )
        lines.append([("peers ", "head"), (fit(f"connected: {names}", max(0, width - 6)), "good")])
    for line in away[:PEERS]:
        since = f" for {ago(line.since_s)}" if line.since_s is not None else ""
        why = f": {line.why}" if line.why else ""
        state = "gone" if line.state in ("away", "forgotten") else line.state
        style = "warn" if line.state == "unknown" else "bad"
        lines.append([("peers " if not lines else "      ", "head"), (f"{line.peer} {state}{since}{why}", style)])
    return lines


COLUMNS: Final = (
    ("Hz", 5, 0), ("msgs", 5, 100), ("B/s", 5, 0), ("bytes", 5, 100), ("age", 5, 50), ("drop/s", 6, 0),
    ("drops", 5, 70),
)  # fmt: skip
"""Label, width, and the narrowest terminal that has it."""
CLASS: Final = 8


def _cells(line: TopicLine) -> Mapping[str, str]:
    return {
        "Hz": count(line.hz),
        "msgs": whole(line.messages),
        "B/s": count(line.bytes_per_s),
        "bytes": whole(line.bytes),
        "age": ago(line.age_s),
        "drop/s": count(line.drops_hz),
        "drops": whole(line.drops),
    }


def _topics(topics: Sequence[TopicLine], width: int, room: int | None) -> list[Line]:
    columns = [column for column in COLUMNS if width >= column[2]]
    name_width = max(8, width - CLASS - sum(size + 1 for _label, size, _from in columns))
    head: Line = [(f"{'class':{CLASS}}{fit('topic', name_width):{name_width}}", "head")]
    head.append(("".join(f" {label:>{size}}" for label, size, _from in columns), "head"))
    if not topics:
        return [[("no topics", "note")]]
    blocks = [_block(line, columns, name_width, width) for line in topics]
    shown = _choose(topics, blocks, None if room is None else room - 1)
    lines: list[Line] = [head]
    last = ""
    for index in shown:
        label = topics[index].priority
        first, *rest = blocks[index]
        lines.append([(f"{label if label != last else '':{CLASS}}", "dim"), *first])
        lines += rest
        last = label
    if len(shown) < len(topics):
        left = [line for index, line in enumerate(topics) if index not in set(shown)]
        wrong = sum(line.level in ("bad", "warn") for line in left)
        words = f"{'':{CLASS}}and {len(left)} more topics" + (f", {wrong} of them in trouble" if wrong else "")
        lines.append([(words, "warn" if wrong else "dim")])
    return lines


def _block(line: TopicLine, columns: Iterable[tuple[str, int, int]], name_width: int, width: int) -> list[Line]:
    """A topic's line without its class, and where something is to be said that does not fit, another one."""
    style = "" if line.level in ("ok", "note") else line.level
    name = f"{fit_end(line.topic, name_width):{name_width}}"
    room = width - CLASS - name_width - 1
    if line.level in ("note", "bad") and line.why and not line.hz and len(line.why) <= room:
        return [[(name, line.level), (f" {line.why}", line.level)]]
    cells = _cells(line)
    numbers = "".join(f" {cells[label]:>{size}}" for label, size, _from in columns)
    first: Line = [(name, style), (numbers, style)]
    if not line.why:
        if not line.hz and line.messages and len(cells["age"]) == 0:
            return [[(name, ""), (f" {whole(line.messages)} so far", "dim")]]
        return [first]
    return [first, *([(words, line.level)] for words in _why(line, width))]


def _why(line: TopicLine, width: int) -> list[str]:
    """What there is to say of a topic, in two lines at most."""
    head = f"{'':{CLASS}}  {'! ' if line.level in ('bad', 'warn') else ''}"
    text = plain(line.why)
    words = textwrap.wrap(text, max(8, width - len(head)), break_long_words=True) or [""]
    if len(words) > WHY_LINES:
        words[WHY_LINES - 1] = fit(words[WHY_LINES - 1] + " " + words[WHY_LINES], max(8, width - len(head)))
    return [(head if not index else " " * len(head)) + each for index, each in enumerate(words[:WHY_LINES])]


def _choose(topics: Sequence[TopicLine], blocks: Sequence[Sequence[Line]], room: int | None) -> list[int]:
    """Which topics have room: what is wrong before what is well, and that before what nobody wants; in their order."""
    every = list(range(len(topics)))
    if room is None or sum(len(block) for block in blocks) <= room:
        return every
    rank = {"bad": 0, "warn": 1, "ok": 2, "note": 3}
    left = room - 1  # for the line that says how many there are more
    chosen = []
    for index in sorted(every, key=lambda i: (rank[topics[i].level], class_order(topics[i].priority), i)):
        if len(blocks[index]) <= left:
            chosen.append(index)
            left -= len(blocks[index])
    return sorted(chosen)


def _event(event: Mapping[str, Any]) -> Line:
    style = "note" if event["kind"] in ("connected", "started", "peer_there", "peer_back", "answers") else "warn"
    return [(f"{str(event['time'])[11:19]}Z ", "dim"), (str(event["text"]), style)]
