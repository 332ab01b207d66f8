"""Counters that daemons leave behind."""

import json
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_tools.counters import Counters, read_counters

SENT = {
    "direction": "send", "class": "control", "offered": 9, "delivered": 6, "refused": 1,
    "dropped": {"lifespan": 1}, "in_queue": 1, "in_flight": 0, "bytes_offered": 900,
}  # fmt: skip
RECEIVED = {"direction": "receive", "class": "control", "delivered": 6, "dropped": {"duplicate": 2}, "age_s": 0.1}


def test_summaries_are_joined_by_topic(tmp_path: Path) -> None:
    robot, site = tmp_path / "robot.json", tmp_path / "site.json"
    robot.write_text(json.dumps({"client": "robot", "topics": {"/r/pose": SENT}}))
    site.write_text(json.dumps({"client": "site", "topics": {"/r/pose": RECEIVED, "/r/map": RECEIVED}}))
    found = read_counters([robot, site])
    sent = Counters("robot", "send", offered=9, delivered=6, refused=1, dropped={"lifespan": 1}, in_queue=1)
    received = Counters("site", "receive", delivered=6, dropped={"duplicate": 2})
    assert found == {"/r/pose": [sent, received], "/r/map": [received]}


def test_the_relay_counts_per_client_and_what_it_received(tmp_path: Path) -> None:
    path = tmp_path / "relay.json"
    links = {"site": {"/r/pose": SENT}, "other": {"/r/pose": SENT}}
    path.write_text(json.dumps({"relay": "hub", "links": links, "received": {"/r/pose": RECEIVED}}))
    entries = read_counters([path])["/r/pose"]
    assert [entry.direction for entry in entries] == ["onward", "onward", "inward"]
    assert [entry.offered for entry in entries] == [9, 9, 0]
    assert {entry.daemon for entry in entries} == {"hub"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"relay": "hub"}', '{"client": "x", "topics": {"/a": {}}}', '{"topics": []}']
)
def test_something_else_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "summary.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"summary\.json: not a summary"):
        read_counters([path])


def test_a_summary_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the summary"):
        read_counters([tmp_path / "none.json"])
