"""What /api/objects adds to the registry."""

import hashlib
from typing import Any

from sern_core.message import TopicInfo
from sern_core.types import Encoding, TopicName
from sern_relay.objects_view import objects_view
from tests.world import World, spec


def objects(world: World, **query: str) -> dict[str, dict[str, Any]]:
    answer: Any = objects_view(world.relay.hub).read(query)
    return {item["id"]: item for item in answer["objects"]}


def test_streams_have_the_text_of_their_definition_when_asked() -> None:
    world = World()
    robot = world.client("robot")
    for name in ("/robot/a", "/robot/b"):
        robot.publish(name, spec(), definition="string data")
    robot.publish("/robot/c", spec())
    world.run(1.0)
    texts = {name: item["definition"] for name, item in objects(world).items()}
    assert texts == {"/robot/a@robot": "string data", "/robot/b@robot": "string data", "/robot/c@robot": ""}
    assert objects(world, since="0")["/robot/a@robot"]["definition"] == "string data"
    assert not any("definition" in item for item in objects(world, definitions="no").values())


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
