"""`sern spool`: what robots have kept, what of it is missing here, and how to get it."""

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from sern_client.spool.orders import Order, place
from sern_core.site.spool import EVER, Window
from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.types import TopicName
from sern_tools.api import NotFoundError, checked_api, get_json, local_api, say
from sern_tools.spool_merge import Selection, merge

PATH: Final = "/api/spool"
LOOK_S: Final = 1.0

app = typer.Typer(help="See what robots have kept, and fetch what is missing here.", no_args_is_help=True)

_Api = Annotated[
    str | None, typer.Option("--api", help="HTTP address of the client; default: the one on this machine.")
]
_From = Annotated[
    str | None, typer.Option("--from", help="From this time on: 2026-11-28T02:40:00Z, or seconds since 1970.")
]
_To = Annotated[str | None, typer.Option("--to", help="Up to this time.")]


def stamp_ns(text: str) -> int:
    """A time as people write it: ISO 8601 (without a zone: UTC), or seconds since 1970. Raises UsageError."""
    try:
        return int(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(f"{text!r} is no time; write it like 2026-11-28T02:40:00Z, or as seconds since 1970") from None
    at = at if at.tzinfo is not None else at.replace(tzinfo=UTC)
    return int(at.timestamp() * 1e9)


def stamp_text(stamp: int | None) -> str:
    """A stamp as people read it, in UTC."""
    if stamp is None:
        return "-"
    try:
        return datetime.fromtimestamp(stamp / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError, OSError):
        return f"{stamp} ns"


def window(begin: str | None, end: str | None) -> Window:
    """Raises UsageError."""
    least, most = EVER
    found = Window(least if begin is None else stamp_ns(begin), most if end is None else stamp_ns(end))
    if not least <= found.from_ns <= found.to_ns <= most:
        raise UsageError(f"--from {begin} is after --to {end}, or beyond all times")
    return found


def size_text(nbytes: int) -> str:
    """Bytes as people read them."""
    value, units = float(nbytes), ("B", "kB", "MB", "GB", "TB")
    for unit in units:
        if value < 1000.0 or unit == units[-1]:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000.0
    raise AssertionError("the last unit takes everything")


def _answer(api: str | None) -> tuple[str, dict[str, Any]]:
    """The client that is asked, and what it says. Raises SernError."""
    where = checked_api(api) if api is not None else local_api()
    try:
        return where, get_json(where, PATH)
    except NotFoundError:
        raise SernError(f"{where}: keeps nothing and fetches nothing; `spool` in a client's file does that") from None


def listing(answer: dict[str, Any]) -> list[str]:
    """The lines of `sern spool ls`, 80 columns wide where names allow it."""
    lines: list[str] = []
    if answer["problem"]:
        lines.append(f"nothing is written there now: {answer['problem']}")
    if answer["keeps"]:
        used, most = size_text(answer["kept_bytes"]), size_text(answer["max_bytes"])
        lines.append(f"kept here, {used} of {most} in {answer['directory']}")
        lines += [
            f"  {row['topic']:30} {row['messages']:>9,} {size_text(row['bytes']):>9}  "
            f"{stamp_text(row['first_ns'])} to {stamp_text(row['last_ns'])}"
            for row in answer["kept"]
        ] or ["  nothing yet"]
    if answer["fetches"]:
        used, how = size_text(answer["filled_bytes"]), "by itself" if answer["automatic"] else "when asked"
        lines.append(f"fetched here {how}, {used} in {answer['directory']}")
        lines.append(f"  {'':30} {'kept':>9} {'missing':>9} {'':>9} {'fetched':>9} {'gone':>7}")
        for row in answer["fetch"]:
            away = "" if row["there"] else f"  {row['origin'] or 'its robot'} is away"
            lines.append(
                f"  {row['topic']:30} {row['kept_messages']:>9,} {row['missing_messages']:>9,} "
                f"{size_text(row['missing_bytes']):>9} {row['fetched_messages']:>9,} {row['gone_messages']:>7,}{away}"
            )
        if not answer["fetch"]:
            lines.append("  no robot keeps any of it")
        lines += [
            f"  asked for: {order['topic']}, {_span(order['from_ns'], order['to_ns'])}" for order in answer["orders"]
        ]
    return lines


def _span(from_ns: int, to_ns: int) -> str:
    begin = "the beginning" if from_ns == EVER[0] else stamp_text(from_ns)
    return f"{begin} to {'now' if to_ns == EVER[1] else stamp_text(to_ns)}"


@app.command("ls")
def spool_ls(api: _Api = None) -> None:
    """What a robot keeps, or what a site has fetched and what it still lacks."""
    try:
        _where, answer = _answer(api)
    except SernError as error:
        raise typer.Exit(say("sern spool ls", error)) from None
    for line in listing(answer):
        typer.echo(line)


def check_order(answer: dict[str, Any], topic: str, wanted: Window) -> str:
    """A warning where it cannot be done at once, else nothing. Raises SernError where it cannot be done at all."""
    if not answer["fetches"]:
        raise SernError(
            "this client fetches nothing; ask the site's (--api), or on a robot take the files themselves: "
            f"sern spool merge {answer['directory']} --out FILE"
        )
    row = next((row for row in answer["fetch"] if row["topic"] == topic), None)
    if row is None:
        known = ", ".join(row["topic"] for row in answer["fetch"][:20]) or "nothing yet"
        raise SernError(f"no robot that is known here keeps {topic}, as far as spool.fetch names it; kept are: {known}")
    first, last = row["first_ns"], row["last_ns"]
    if first is not None and (wanted.to_ns < first or wanted.from_ns > last):
        raise SernError(f"of {topic} nothing is kept from then; there is {stamp_text(first)} to {stamp_text(last)}")
    if not row["there"]:
        return f"{row['origin'] or 'its robot'} is away; {topic} is fetched when it is back"
    return ""


@app.command("fetch")
def spool_fetch(
    topic: Annotated[str, typer.Option("--topic", help="Global name of the topic.")],
    begin: _From = None,
    end: _To = None,
    api: _Api = None,
    wait: Annotated[bool, typer.Option(help="Stay until it is there.")] = True,
) -> None:
    """Fetch what is missing of a topic, run at the site. It goes on by itself, also when this command is ended."""
    try:
        wanted = window(begin, end)
        where, answer = _answer(api)
        warning = check_order(answer, topic, wanted)
        try:
            order = place(Path(answer["directory"]), Order(TopicName(topic), wanted))
        except OSError as error:
            raise SernError(
                f"{answer['directory']}: cannot be written ({error.strerror}); run this on the client's machine, as "
                "its user"
            ) from None
        if warning:
            typer.echo(f"sern spool fetch: {warning}", err=True)
        elif wait:
            _wait(where, topic, order)
    except SernError as error:
        raise typer.Exit(say("sern spool fetch", error)) from None


def _wait(where: str, topic: str, order: Path) -> None:
    """Wait until the client has taken the order away. Raises SernError."""
    said = ""
    while order.exists():
        row = next((row for row in get_json(where, PATH)["fetch"] if row["topic"] == topic), None)
        if row is not None:
            text = f"{topic}: {row['fetched_messages']:,} fetched, {row['missing_messages']:,} missing in all"
            if not row["there"]:
                typer.echo(f"sern spool fetch: {row['origin']} has gone; it goes on when it is back", err=True)
                return
            if text != said:
                typer.echo(text)
                said = text
        time.sleep(LOOK_S)
    typer.echo("done")


@app.command("merge")
def spool_merge(
    inputs: Annotated[list[Path], typer.Argument(help="Recordings, and folders or files of a spool.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The recording to write: .bag (ROS 1) or .mcap (ROS 2).")],
    topic: Annotated[str | None, typer.Option("--topic", help="Only this topic.")] = None,
    begin: _From = None,
    end: _To = None,
) -> None:
    """Make one recording of several, by stamp, with every message once."""
    try:
        wanted = window(begin, end)
        chosen = Selection(None if topic is None else TopicName(topic), wanted.from_ns, wanted.to_ns)
        done = merge(inputs, out, chosen)
    except SernError as error:
        raise typer.Exit(say("sern spool merge", error)) from None
    for path in done.cut_off or ():
        typer.echo(f"sern spool merge: {path} was cut off; what is whole of it is there", err=True)
    if done.damaged:
        typer.echo(f"sern spool merge: damaged on the disk and left out: {done.damaged:,}", err=True)
    twice = f", {done.twice:,} that were there twice are left out" if done.twice else ""
    typer.echo(f"{out}: {done.messages:,} messages{twice}")
