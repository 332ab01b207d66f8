"""What is wrong now, in words, and each cause once."""

from typing import Any

import pytest

from sern_runtime.watching.alerts import Alert, alerts
from sern_runtime.watching.state import FlowTable, TopicPart, View, sample
from sern_runtime.watching.why import Comparison
from tests.sern_runtime.watching.fakes import client_row, received_row

Rows = dict[str, tuple[str, dict[str, Any]]]


def seen(clients: list[dict[str, Any]], before: Rows, now: Rows, *, role: str = "relay", refused: int = 0) -> View:
    def look(at_s: float, topics: Rows, total: int) -> Any:
        flows = FlowTable(relay=role == "relay")
        for name, (owner, row) in topics.items():
            if role == "relay":
                flows.add(TopicPart("received", "", name, row))
                about = {"class": row["class"], "taken": True, "owners": [owner], "latched": False}
                flows.add(TopicPart("announced", "", name, about))
            else:
                flows.add(TopicPart("client", "", name, row | {"owner": owner, "latched": False, "type": "t"}))
        head = {"name": "me", "role": role, "time": "2026-01-31T12:00:00.000Z", "refused_total": total}
        links = [{"peer": clients[0]["name"], "queue": {}}] if clients else []
        return sample(at_s, head, clients, links, flows, None, ())

    comparison = Comparison(look(0.0, before, 0), look(2.0, now, refused))
    return comparison.view(comparison.topics())


def test_where_all_is_well_nothing_is_said() -> None:
    flows = {"/robot/odom": ("robot", received_row(1))}, {"/robot/odom": ("robot", received_row(9))}
    assert alerts(seen([client_row("robot"), client_row("other", "never")], *flows)) == ()
    assert alerts(seen([], {}, {})) == ()


def test_a_robot_that_is_gone_is_one_alert_with_all_its_topics() -> None:
    rows: Rows = {f"/robot/t{number}": ("robot", received_row(5)) for number in range(7)}
    (found,) = alerts(seen([client_row("robot", "away", why="no answer for 6 s", lane=None)], rows, rows))
    topics = ("/robot/t0", "/robot/t1", "/robot/t2")
    assert found == Alert("bad", "link robot", "robot is gone for 12 s: no answer for 6 s", topics, 7)


def test_a_robot_that_is_silent_says_since_when() -> None:
    rows: Rows = {"/robot/odom": ("robot", received_row(5))}
    (found,) = alerts(seen([client_row("robot", "silent", heard_s=4.2)], rows, rows))
    assert (found.level, found.text, found.count) == ("bad", "robot does not answer, last heard 4 s ago", 1)


def test_topics_with_one_cause_are_one_alert_whatever_their_numbers() -> None:
    clients = [client_row("robot")]
    one: Rows = {"/robot/a": ("robot", received_row(10, dropped={}))}
    two: Rows = {"/robot/a": ("robot", received_row(20, dropped={"lost": 10}))}
    (alone,) = alerts(seen(clients, one, two))
    assert alone.text == "/robot/a: 5.0/s dropped (lost): parts of it were lost on the way"
    one["/robot/b"] = ("robot", received_row(10))
    two["/robot/b"] = ("robot", received_row(20, dropped={"lost": 6}))
    (both,) = alerts(seen(clients, one, two))
    assert (both.key, both.count, both.topics) == (alone.key, 2, ("/robot/a", "/robot/b"))
    assert both.text == "dropped (lost)"


def test_packets_that_are_lost_and_strangers_at_the_door_are_worth_a_word() -> None:
    found = alerts(seen([client_row("robot", loss=0.08), client_row("other", loss=0.01)], {}, {}, refused=3))
    assert [(alert.level, alert.text.partition(":")[0]) for alert in found] == [
        ("warn", "robot"),
        ("warn", "3 connections were refused just now"),
    ]
    assert found[0].text == "robot: 8% of the packets are lost"


@pytest.mark.parametrize(("state", "text"), [
    ("away", "there is no link to the relay for 12 s: connection refused"),
    ("never", "there is no link to the relay for 12 s: connection refused"),
    ("silent", "relay does not answer, last heard 0 s ago"),
])  # fmt: skip
def test_at_a_client_the_relay_is_what_is_missed(state: str, text: str) -> None:
    rows: Rows = {"/robot/odom": ("robot", received_row(5))}
    found = alerts(
        seen([client_row("relay", state, why="connection refused"), client_row("robot")], rows, rows, role="client")
    )
    assert [(alert.text, alert.count) for alert in found] == [(text, 1)]


def test_the_worst_comes_first() -> None:
    clients = [client_row("a", loss=0.5), client_row("b", "away")]
    assert [alert.key for alert in alerts(seen(clients, {}, {}))] == ["link b", "loss a"]
