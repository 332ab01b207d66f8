"""What /api/objects adds to the registry."""

import asyncio
import hashlib
import json
from typing import Any

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_core.wire.announce import definition_hash
from sern_relay.objects_view import objects_view
from sern_runtime import http
from sern_runtime.http_routes import JsonParts
from tests.world import World, spec


def parts(world: World, **query: str) -> JsonParts:
    answer = objects_view(world.relay.hub).read(query)
    assert isinstance(answer, JsonParts)
    return answer


def whole(world: World, **query: str) -> Any:
    return json.loads("".join(parts(world, **query).pieces))


def objects(world: World, **query: str) -> dict[str, dict[str, Any]]:
    return {item["id"]: item for item in whole(world, **query)["objects"]}


def of_one_type(topics: int, text: str = "string data") -> World:
    world = World()
    robot = world.client("robot")
    for number in range(topics):
        robot.publish(f"/robot/t{number}", spec(), definition=text)
    world.run(2.0)
    assert len(world.relay.hub.relayed) == topics
    return world


def test_streams_have_the_key_of_the_text_of_their_definition() -> None:
    world = World()
    robot = world.client("robot")
    for name in ("/robot/a", "/robot/b"):
        robot.publish(name, spec(), definition="string data")
    robot.publish("/robot/c", spec())
    world.run(1.0)
    key = definition_hash("string data")
    for query in ({}, {"since": "0"}):
        answer = whole(world, **query)
        keys = {item["id"]: item["definition_key"] for item in answer["objects"]}
        assert keys == {"/robot/a@robot": key, "/robot/b@robot": key, "/robot/c@robot": ""}
        assert answer["definitions"] == {key: "string data"}
    assert "definitions" not in whole(world, definitions="no")
    assert whole(world, topic="/robot/c")["definitions"] == {}


def test_hashes_are_those_of_the_texts_and_empty_without_one() -> None:
    world = World()
    robot = world.client("robot")
    for name, definition in (("/robot/a", "string data"), ("/robot/c", "")):  # types that nobody gave a hash for
        info = TopicInfo(TopicName(name), "std_msgs/String", Encoding.ROS1, "", definition)
        robot.core.publish(info, spec(), now=robot.now)
    world.run(1.0)
    wanted = {"/robot/a@robot": hashlib.sha256(b"string data").hexdigest(), "/robot/c@robot": ""}
    for definitions in ("yes", "no"):
        hashes = {name: item["definition_hash"] for name, item in objects(world, definitions=definitions).items()}
        assert hashes == wanted


def test_one_topic_may_be_asked_for_and_values_left_out() -> None:
    world = of_one_type(3)
    assert list(objects(world, topic="/robot/t1")) == ["/robot/t1@robot"]
    assert list(objects(world, topic="/robot/t1", since="0")) == ["/robot/t1@robot"]
    assert objects(world, topic="/robot/t1", owner="nobody") == objects(world, topic="/robot/t1", kind="node") == {}
    assert all("value" in item for item in objects(world).values())
    assert not any("value" in item for item in objects(world, values="no").values())


def test_a_text_is_there_once_however_many_streams_have_it() -> None:
    text = "a" * 200_000
    world = of_one_type(50, text)
    answer = "".join(parts(world).pieces)
    assert answer.count(text) == 1
    assert len(answer) < len(text) + 50 * 1000


def test_what_ends_while_the_answer_is_made_is_left_out_and_told_later() -> None:
    world = of_one_type(4)
    answer = parts(world, since="0")
    pieces = iter(answer.pieces)
    made = [next(pieces), next(pieces)]
    world.relay.hub.objects.delete("/robot/t3@robot", owner=ClientName("robot"))
    found = json.loads("".join([*made, *pieces]))
    assert [item["id"] for item in found["objects"]] == [f"/robot/t{number}@robot" for number in range(3)]
    later = whole(world, since=str(found["version"]), epoch=str(found["epoch"]))
    assert later["deleted"] == ["/robot/t3@robot"] and not later["objects"]


async def test_an_answer_is_made_in_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "SLICE_PIECES", 10)
    world = of_one_type(95)
    turns = 0

    async def others() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(others())
    body = await http.joined(parts(world))
    task.cancel()
    assert len(json.loads(body)["objects"]) == 95
    assert turns >= 9


async def test_an_answer_that_is_too_large_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "MAX_ANSWER_BYTES", 5_000)
    world = of_one_type(40)
    answer = parts(world)
    with pytest.raises(UsageError, match="ask for one kind, owner or topic"):
        await http.joined(answer)
    assert len(list(answer.pieces)) > 20  # what came after was not made
    assert json.loads(await http.joined(parts(world, topic="/robot/t7")))["objects"]
