"""Who was refused: a table of a fixed size, in which one host with many keys hides nobody else."""

import logging

import pytest

from sern_relay.refusals import MAX_OF_ADDRESS, MAX_ROWS, Refusals
from sern_runtime.events import REFUSED, EventLog


def test_a_key_has_one_row_with_its_count_and_the_latest_reason(caplog: pytest.LogCaptureFixture) -> None:
    events = EventLog()
    refusals = Refusals(events, wall=lambda: 100.0)
    refusals.refuse("192.0.2.1", "K1", "unknown key K1")
    refusals.refuse("192.0.2.1", "K1", "the key of robot1 expired")
    told = refusals.to_json()
    assert [(row["address"], row["key"], row["count"], row["why"]) for row in told["refused"]] == [
        ("192.0.2.1", "K1", 2, "the key of robot1 expired")
    ]
    assert (told["refused_total"], told["refused_gone"]) == (2, 0)
    assert told["refused"][0]["last"].startswith("1970-01-01T00:01:")
    assert caplog.messages[0] == "refused a connection from 192.0.2.1: unknown key K1"
    assert [event["kind"] for event in events.after(0)] == [REFUSED, REFUSED]


def test_one_host_with_many_keys_hides_nobody_else() -> None:
    logging.disable(logging.WARNING)
    try:
        refusals = Refusals()
        refusals.note("192.0.2.1", "OURS", "the key of robot1 expired")
        for number in range(20_000):
            refusals.refuse("198.51.100.9", f"K{number}", "unknown key")
        told = refusals.to_json()
        assert len(refusals) == 1 + MAX_OF_ADDRESS
        assert told["refused"][-1]["key"] == "OURS"
        assert told["refused_total"] == 20_001
        assert told["refused_gone"] == 20_000 - MAX_OF_ADDRESS
    finally:
        logging.disable(logging.NOTSET)


def test_many_hosts_have_a_table_of_a_fixed_size_and_the_latest_are_in_it() -> None:
    refusals = Refusals()
    for number in range(10 * MAX_ROWS):
        refusals.note(f"192.0.2.{number}", "", "too many connections")
    told = refusals.to_json()
    assert len(told["refused"]) == MAX_ROWS == len(refusals)
    assert told["refused"][0]["address"] == f"192.0.2.{10 * MAX_ROWS - 1}"
    assert told["refused"][0]["key"] is None
    assert told["refused_gone"] == 9 * MAX_ROWS
