"""How SERN behaved, by what its robot said: shares of the time, changes, and the words for them."""

from typing import Any

import pytest

from sern_tools.demo_behaviour import Behaviour, Look


def link(lane: str) -> dict[str, Any]:
    return {"lane": lane}


def adapting(switches: int, *, bulk: float = 1.0, summaries: dict[str, int] | None = None) -> dict[str, Any]:
    rates = {"control": 1.0, "state": 1.0, "bulk": bulk}
    return {"switches": switches, "configuration": {"rates": rates, "summaries": summaries}}


def test_what_a_look_says_holds_until_the_next_one() -> None:
    behaviour = Behaviour(
        [
            Look.of(0.0, link("zmq"), adapting(3)),
            Look.of(1.0, link("udp"), adapting(3)),
            Look.of(5.0, link("udp"), adapting(5, bulk=0.5)),
            Look.of(8.0, link("zmq"), adapting(5, bulk=0.5, summaries={"control": 0, "state": 0, "bulk": 1})),
            Look.of(10.0, link("udp"), adapting(6)),
        ]
    )
    assert behaviour.lane_shares() == {"udp": pytest.approx(0.7), "zmq": pytest.approx(0.3)}
    assert (behaviour.lane_changes, behaviour.switches) == (3, 3)
    assert behaviour.thinned_share == pytest.approx(0.5)
    assert behaviour.summarised_share == pytest.approx(0.2)
    assert behaviour.rows(0.42) == [
        ("lane", "datagrams (UDP) 70% of the time, stream (TCP) 30% of the time; changed 3 times"),
        ("adaptation", "chose anew 3 times; thinned 50% and summarised 20% of the time"),
        ("clouds", "42% of class bulk delivered"),
    ]
    assert behaviour.as_row() == {
        "lane_udp_share": pytest.approx(0.7),
        "lane_zmq_share": pytest.approx(0.3),
        "lane_changes": 3,
        "adaptation_switches": 3,
        "adaptation_thinned_share": pytest.approx(0.5),
        "adaptation_summarised_share": pytest.approx(0.2),
    }


def test_a_robot_that_did_not_answer_is_not_counted() -> None:
    behaviour = Behaviour([Look.of(0.0, link("udp"), None), Look.of(1.0, None, None), Look.of(4.0, link("udp"), None)])
    assert behaviour.lane_shares() == {"udp": 1.0}
    assert (behaviour.lane_changes, behaviour.switches) == (0, None)
    assert behaviour.as_row() == {"lane_udp_share": 1.0, "lane_zmq_share": 0.0, "lane_changes": 0}, (
        "no lane is left out"
    )
    assert Behaviour().as_row() == {}
    assert behaviour.rows(1.0) == [
        ("lane", "datagrams (UDP) 100% of the time; changed never"),
        ("clouds", "100% of class bulk delivered"),
    ]
    assert Behaviour().rows(1.0) == []
    assert Behaviour([Look.of(0.0, None, None)]).rows(0.5)[0] == ("lane", "not known; changed never")
