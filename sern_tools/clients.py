"""`sern clients`: who has to do with a relay, where from, since when, and who was refused and why.

At a client: the relay, and the robots or sites whose topics it takes, as far as the relay tells of them. Rates come
from two looks at the counters.
"""

import json
import time
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, NamedTuple

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sern_core.vocabulary.errors import SernError
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, local_api, say
from sern_tools.top_text import ago, plain
from sern_tools.topics import MIN_INTERVAL_S, PLAIN_WIDTH, si

PATH: Final = "/api/clients"
TOTALS: Final = ("received_bytes", "sent_bytes")
Json = Mapping[str, Any]


class ClientsWatcher:
    """Looks at one daemon again and again. `clock` in monotonic seconds."""

    def __init__(
        self, api: str, *, get: Callable[[str, str], Any] = get_json, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.api = api
        self._get = get
        self._clock = clock
        self._before = self._look()

    def _look(self) -> tuple[float, Json]:
        try:
            return self._clock(), self._get(self.api, PATH)
        except NotFoundError:
            raise SernError(
                f"{self.api}: the daemon is older than this program, or of another kind, and lists no clients"
            ) from None

    def answer(self) -> dict[str, Any]:
        """What the daemon says, with a rate beside each total: what changed since the call before."""
        at_s, now = self._look()
        before_s, before = self._before
        self._before = at_s, now
        past = {row["name"]: row for row in before["clients"]}
        interval_s = max(at_s - before_s, 1e-3)
        rows = [{**row, **rates(past.get(row["name"]), row, interval_s)} for row in now["clients"]]
        refused_per_s = max(0, now["refused_total"] - before["refused_total"]) / interval_s
        return {**now, "clients": rows, "refused_per_s": refused_per_s}


def rates(before: Json | None, now: Json, interval_s: float) -> dict[str, float | None]:
    """Bytes a second; what began anew counts from 0, what is not known has none."""
    found: dict[str, float | None] = {}
    for name in TOTALS:
        total, past = now[name], None if before is None else before[name]
        began = total is not None and (past is None or total < past)
        found[f"{name}_per_s"] = None if total is None else (total - (0 if began else past)) / interval_s
    return found


class Column(NamedTuple):
    """One column, shown on terminals of at least `width` characters."""

    label: str
    cell: Callable[[Json], str]
    width: int = 0
    number: bool = False


COLUMNS: Final = (
    Column("name", lambda row: row["name"]),
    Column("state", lambda row: row["state"]),
    Column("address", lambda row: row["address"] or ""),
    Column("lane", lambda row: row["lane"] or ""),
    Column("since", lambda row: ago(row["since_s"]), number=True),
    Column("heard", lambda row: ago(row["heard_s"]), number=True),
    Column("rtt ms", lambda row: "" if row["round_trip_s"] is None else f"{1e3 * row['round_trip_s']:.0f}", 80, True),
    Column("loss %", lambda row: "" if row["loss"] is None else f"{100 * row['loss']:.1f}", 110, True),
    Column("in B", lambda row: si(row["received_bytes"] or 0), 120, True),
    Column("in B/s", lambda row: si(row["received_bytes_per_s"] or 0), 100, True),
    Column("out B", lambda row: si(row["sent_bytes"] or 0), 120, True),
    Column("out B/s", lambda row: si(row["sent_bytes_per_s"] or 0), 100, True),
    Column("streams", lambda row: str(row["streams"] or ""), 130, True),
    Column("takeovers", lambda row: str(row["takeovers"] or ""), 130, True),
    Column("why", lambda row: row["why"], 110),
)
STYLES: Final = {"connected": "green", "silent": "yellow", "away": "red", "never": "dim", "forgotten": "dim"}


def clients_table(answer: Json, width: int) -> Table:
    """The clients, for a terminal of that many characters; a narrow one says why one is away in a line below it."""
    table = Table(box=None, pad_edge=False)
    columns = [column for column in COLUMNS if width >= column.width]
    for column in columns:
        table.add_column(column.label, no_wrap=True, justify="right" if column.number else "left")
    for row in answer["clients"]:
        cells = [Text(plain(column.cell(row))) for column in columns]
        cells[1].stylize(STYLES.get(row["state"], ""))
        table.add_row(*cells)
    return table


def notes(answer: Json, width: int) -> list[str]:
    """What has no room in the table: why somebody is away, and who was refused."""
    lines = []
    if width < 110:
        lines += [f"{row['name']}: {row['why']}" for row in answer["clients"] if row["why"]]
    refused = answer["refused"]
    if answer["refused_total"]:
        lines += [f"refused {answer['refused_total']}, {answer['refused_per_s']:.1f}/s; the latest first:"]
    for row in refused:
        times = f"{row['count']} times, last " if row["count"] > 1 else ""
        lines.append(f"  {row['address']}: {row['why']} ({times}{ago(row['last_s'])} ago)")
    if answer["refused_gone"]:
        lines.append(f"  and {answer['refused_gone']} more that have no line here any more")
    return [plain(line) for line in lines]


def _show(out: Console, answer: Json) -> None:
    if answer["clients"]:
        out.print(clients_table(answer, out.width))
    else:
        out.print("no clients")
    for line in notes(answer, out.width):
        out.print(Text(line))


def run_clients(
    api: str,
    *,
    watch: bool,
    as_json: bool,
    interval_s: float,
    out: Console | None = None,
    pause: Callable[[float], None] = time.sleep,
) -> None:
    """Print the table once, or until interrupted. Raises SernError."""
    out = out or Console(highlight=False)
    if not out.is_terminal:
        out.width = PLAIN_WIDTH
    watcher = ClientsWatcher(checked_api(api))
    live = watch and not as_json and out.is_terminal
    if live:
        with Live(console=out, auto_refresh=False, screen=True) as screen:
            while True:
                pause(interval_s)
                answer = watcher.answer()
                table = clients_table(answer, out.width)
                lines = notes(answer, out.width)
                table.caption, table.caption_justify = (Text("\n".join(lines)) if lines else None), "left"
                screen.update(table, refresh=True)
    while True:
        pause(interval_s)
        answer = watcher.answer()
        if as_json:
            out.file.write(json.dumps(answer, indent=None if watch else 1) + "\n")
            out.file.flush()
        else:
            _show(out, answer)
        if not watch:
            return


def clients(
    api: Annotated[
        str | None,
        typer.Option("--api", help="HTTP address of a relay or client (http.listen) [default: this machine's]."),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Again and again, until Ctrl-C.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON; with --watch one line a look.")] = False,
    interval_s: Annotated[
        float, typer.Option("--interval", min=MIN_INTERVAL_S, help="Seconds between two looks.")
    ] = 1.0,
) -> None:
    """List the clients of a relay: address, lane, since when, last heard; and who was refused, and why.

    Clients of other relays are listed with the relay that they are at.

    At a client: the relay, and whoever's topics it takes. `since` and `heard` are how long ago.

    Exit code 0 when listed (or ended by Ctrl-C), 1 when there is no daemon, 2 for wrong usage.
    """
    try:
        run_clients(api or local_api(), watch=watch, as_json=as_json, interval_s=interval_s)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern clients", error)) from None
