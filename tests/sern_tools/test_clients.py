"""`sern clients`: a row each, a rate beside each total, and who was refused and why."""

import json
from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from sern_core.vocabulary.errors import SernError
from sern_tools.api import NotFoundError
from sern_tools.clients import ClientsWatcher, clients_table, notes, rates, run_clients

URL = "http://daemon"


def row(name: str, received: int | None, **fields: Any) -> dict[str, Any]:
    known: dict[str, Any] = {
        "name": name, "state": "connected", "why": "", "address": "192.0.2.7:4242", "lane": "udp", "since_s": 75.0,
        "heard_s": 0.2, "round_trip_s": 0.08, "loss": 0.01, "received_bytes": received, "sent_bytes": received,
        "streams": 3, "sessions": 1, "takeovers": 0,
    }  # fmt: skip
    return known | fields


def answer(*rows: dict[str, Any], refused: int = 0) -> dict[str, Any]:
    knock = {"address": "198.51.100.9", "key": "K", "why": "unknown key K", "count": refused, "last_s": 3.0}
    return {
        "name": "relay", "role": "relay", "clients": list(rows), "refused": [knock] if refused else [],
        "refused_total": refused, "refused_gone": max(0, refused - 8),
    }  # fmt: skip


def text(told: dict[str, Any], width: int) -> str:
    out = StringIO()
    console = Console(file=out, width=width, highlight=False)
    console.print(clients_table(told, width))
    for line in notes(told, width):
        console.print(line, markup=False)
    return out.getvalue()


def watched(*answers: dict[str, Any], apart_s: float = 2.0) -> dict[str, Any]:
    left, clock = list(answers), iter(range(100))
    watcher = ClientsWatcher(URL, get=lambda _api, _path: left.pop(0), clock=lambda: apart_s * next(clock))
    told = watcher.answer()
    while left:
        told = watcher.answer()
    return told


def test_each_total_has_its_rate() -> None:
    told = watched(answer(row("robot1", 1000), refused=2), answer(row("robot1", 5000), refused=6))
    assert told["clients"][0]["received_bytes_per_s"] == 2000.0
    assert told["clients"][0]["sent_bytes_per_s"] == 2000.0
    assert told["refused_per_s"] == 2.0


def test_what_began_anew_counts_from_nothing_and_what_is_not_known_has_none() -> None:
    assert rates(row("a", 1000), row("a", 500), 1.0)["received_bytes_per_s"] == 500.0
    assert rates(None, row("a", 500), 1.0)["received_bytes_per_s"] == 500.0
    assert rates(row("a", None), row("a", None), 1.0)["received_bytes_per_s"] is None


def test_at_80_columns_it_says_who_where_since_when_and_who_was_refused() -> None:
    away = row("robot2", 10, state="away", why="its connection is gone", lane=None, round_trip_s=None, loss=None)
    told = watched(answer(row("robot1", 1), away, refused=9), answer(row("robot1", 2), away, refused=12))
    lines = text(told, 80).splitlines()
    assert lines[0].split() == ["name", "state", "address", "lane", "since", "heard", "rtt", "ms"]
    assert lines[1].split() == ["robot1", "connected", "192.0.2.7:4242", "udp", "75s", "0.2s", "80"]
    assert "robot2: its connection is gone" in lines
    assert "refused 12, 1.5/s; the latest first:" in lines
    assert "  198.51.100.9: unknown key K (12 times, last 3.0s ago)" in lines
    assert "  and 4 more that have no line here any more" in lines
    assert max(map(len, lines)) <= 80


def test_a_wide_terminal_has_totals_too() -> None:
    told = watched(answer(row("robot1", 1000)), answer(row("robot1", 5000)))
    assert {"in B", "in B/s", "out B", "out B/s", "takeovers"} <= {
        str(column.header) for column in clients_table(told, 200).columns
    }


def test_nothing_from_outside_steers_the_terminal() -> None:
    hostile = row("robot1", 1, why="\x1b[2J\u202e", address="\x1b]0;x\x07")
    told = watched(answer(hostile), answer(hostile))
    for width in (80, 200):
        assert all(c.isprintable() or c == "\n" for c in text(told, width))


def test_json_is_the_daemons_answer_with_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [answer(row("robot1", 1)), answer(row("robot1", 3))]
    monkeypatch.setattr("sern_tools.clients.ClientsWatcher._look", lambda _self: (float(len(left)), left.pop(0)))
    out = StringIO()
    run_clients(URL, watch=False, as_json=True, interval_s=1.0, out=Console(file=out), pause=lambda _s: None)
    told = json.loads(out.getvalue())
    assert told["clients"][0]["name"] == "robot1"
    assert "received_bytes_per_s" in told["clients"][0]


def test_an_older_daemon_is_an_error_of_one_line() -> None:
    def get(_api: str, _path: str) -> Any:
        raise NotFoundError("no path")

    with pytest.raises(SernError, match="older than this program"):
        ClientsWatcher(URL, get=get)
