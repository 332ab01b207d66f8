"""/api/trace of a relay and of a client: one topic's story, all records, and what is not there."""

import json
from typing import Any

import pytest

from sern_core.vocabulary.types import PriorityClass
from sern_relay.trace_source import of_hub
from sern_runtime.http_routes import JsonParts, JsonQuery, UnknownError
from sern_runtime.trace_view import of_client, trace_view
from sern_sim.models import LinkModel
from tests.world import World, spec


def views() -> tuple[JsonQuery, JsonQuery]:
    """What a client and its relay answer; the way from there to the site is thin."""
    world = World()
    robot = world.client("robot")
    world.client("site", LinkModel(rate_bps=300e3, delay_s=0.02).as_stream(), patterns=["/robot/.*"])
    pose, cloud = robot.publish("/robot/pose", spec()), robot.publish("/robot/points", spec(PriorityClass.BULK))
    world.run(1.0)
    robot.every(0.2, pose, b"pose")
    robot.every(0.2, cloud, bytes(30_000))
    world.run(2.0)
    return (
        trace_view(of_client(robot.core.link, robot.core.trace), lambda: robot.now),
        trace_view(of_hub(world.relay.hub), lambda: world.relay.now),
    )


def asked(view: JsonQuery, **query: str) -> Any:
    told = view.read(query)
    return json.loads("".join(told.pieces) if isinstance(told, JsonParts) else json.dumps(told))


def test_one_topic_all_of_them_and_what_is_not_there() -> None:
    client, relay = views()
    told = asked(client, topic="/robot/points")
    (stream,) = told["streams"]
    assert told["steps"] is True and stream["direction"] == "send" and stream["peer"] == "relay"
    assert stream["offered"] == 11 and stream["class"] == "bulk" and "waiting" in stream["standing"]
    assert {record["topic"] for record in told["records"]} == {"", "/robot/points"}
    everything = asked(client)
    assert {record["topic"] for record in everything} >= {"", "/robot/pose", "/robot/points"}

    told = asked(relay, topic="/robot/points")
    assert told["steps"] is False
    assert [(each["peer"], each["direction"]) for each in told["streams"]] == [("robot", "receive"), ("site", "send")]
    assert any(record["event"] == "held" and record["peer"] == "site" for record in told["records"])
    only = asked(relay, topic="/robot/points", peer="site")
    assert [each["peer"] for each in only["streams"]] == ["site"]
    assert {record["peer"] for record in asked(relay, peer="site")} == {"site"}

    with pytest.raises(
        UnknownError, match=r"^topic '/robot/pint' is not known here; known: /robot/points, /robot/pose$"
    ):
        asked(client, topic="/robot/pint")
    with pytest.raises(UnknownError, match=r"^no link to 'sight' is traced here; known: site, robot$"):
        asked(relay, peer="sight")
