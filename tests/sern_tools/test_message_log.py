"""Message logs: written, read back, and refused with file and line when they are none."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_tools.message_log import HEADER, Delivery, Event, MessageLog, Offer, read_logs

HEAD = ",".join(HEADER) + "\n"


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    sent, received = MessageLog(tmp_path / "robot.csv"), MessageLog(tmp_path / "site.csv")
    offer = Offer(1_700_000_000_123_456_789, 1, 100, 4_294_967_295)
    delivery = Delivery(1_700_000_000_173_456_789, 1, 100, 4_294_967_295, offer.wall_ns, None)
    sent.offered("/pose", "control", offer)
    sent.flush()
    received.delivered("/pose", "control", delivery)
    sent.close()
    received.close()
    logs = read_logs([("robot", tmp_path / "robot.csv"), ("site", tmp_path / "site.csv")])
    assert logs.keys() == {"/pose"}
    log = logs["/pose"]
    assert (log.priority, log.origin, log.offers, log.deliveries) == ("control", "robot", {1: offer}, [delivery])
    assert delivery.latency_s == pytest.approx(0.05)


def test_refused_expired_and_an_unfinished_last_line(tmp_path: Path) -> None:
    path = tmp_path / "robot.csv"
    path.write_text(
        HEAD
        + "offered,10,/map,state,1,5,10,7,,,\n"
        + "offered,20,/map,state,2,5,20,7,,,\n"
        + "refused,30,/map,state,3,5,30,7,,refused,\n"
        + "expired,40,/map,state,2,5,20,7,1.5,retention,\n"
        + "delivered,50,/map,state,1,5,10,7,0.25,,\n"
        + "delivered,60,/map,sta"
    )
    log = read_logs([("robot", path)])["/map"]
    assert log.offered == 3
    assert log.refused == {3}
    assert log.drop_reasons() == {"retention": 1}
    assert [d.age_s for d in log.deliveries] == [0.25]


def test_what_places_say_of_a_message_is_kept_by_place_and_peer(tmp_path: Path) -> None:
    path = tmp_path / "relay.csv"
    path.write_text(
        HEAD
        + "received,10,/map,state,1,0,10,0,,,robot\n"
        + "dropped,20,/map,state,1,0,0,0,,superseded,site\n"
        + "discarded,30,/map,state,2,0,0,0,,lost,robot\n"
        + "held,40,/map,state,3,0,0,0,,unconfirmed,site\n"
    )
    log = read_logs([("relay", path)])["/map"]
    assert log.received == {"relay": {1}}
    assert log.dropped == {("relay", "site"): {1: "superseded"}}
    assert log.discarded == {("relay", "robot"): {2: "lost"}}
    assert log.held == {("relay", "site"): {3: "unconfirmed"}}
    assert log.lines[Event.DROPPED] == {("relay", "superseded"): 1}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", ":1"),
        ("event,wall_ns\n", ":1"),
        (HEAD + "offered,10,/map,state,1,5,10,7,,,\nlost,10,/map,state,1,5,10,7,,,\n", ":3"),
        (HEAD + "offered,10,/map\n", ":2"),
        (HEAD + "offered,ten,/map,state,1,5,10,7,,,\n", ":2"),
    ],
)
def test_something_else_is_refused_with_its_line(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"x.csv{line}"):
        read_logs([("robot", path)])


def test_a_log_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the message log"):
        read_logs([("robot", tmp_path / "none.csv")])
