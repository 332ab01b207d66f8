"""Latest values at a client: what is kept, and how much at most."""

import base64
from typing import Any

import pytest

from sern_client import latest
from sern_client.latest import MAX_VALUE_BYTES, LatestValues
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, TopicName


def stream(topic: str) -> StreamInfo:
    info = TopicInfo(TopicName(topic), "std_msgs/msg/String", Encoding.ROS1, definition="string data")
    return StreamInfo(StreamId(ClientName("robot1"), 1, TopicName(topic)), info, TopicSpec())


def objects(values: LatestValues, topic: str = "/a") -> list[dict[str, Any]]:
    answer = values.view().read({"topic": topic})
    assert isinstance(answer, dict)
    found: list[dict[str, Any]] = answer["objects"]
    return found


def test_the_newest_is_kept_of_each_topic() -> None:
    values = LatestValues()
    values.passed(stream("/a"), 1, b"one")
    values.passed(stream("/b"), 1, b"other")
    values.passed(stream("/a"), 2, b"two")
    (found,) = objects(values)
    assert base64.b64decode(found["value"]["base64"]) == b"two"
    assert (found["owner"], found["seq"], found["type"]) == ("robot1", 2, "std_msgs/msg/String")
    assert found["attributes"] == {"topic": "/a", "encoding": "ros1"} and len(found["definition_key"]) == 32
    answer: Any = values.view().read({"topic": "/a"})
    assert answer["definitions"] == {found["definition_key"]: "string data"}
    assert [item["attributes"]["topic"] for item in objects(values, "/b")] == ["/b"]
    with pytest.raises(UsageError, match="topic is missing"):
        values.view().read({})
    values.forget(stream("/a").id)
    values.forget(stream("/a").id)
    assert objects(values) == []


def test_of_large_ones_the_size_alone() -> None:
    values = LatestValues()
    values.passed(stream("/a"), 1, bytes(MAX_VALUE_BYTES))
    assert "base64" in objects(values)[0]["value"]
    values.passed(stream("/a"), 2, bytes(MAX_VALUE_BYTES + 1))
    assert objects(values)[0]["value"] == {"bytes": MAX_VALUE_BYTES + 1}


def test_of_too_many_topics_the_oldest_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latest, "MAX_TOPICS", 3)
    values = LatestValues()
    for number in range(5):
        values.passed(stream(f"/t{number}"), 1, b"x")
    assert [bool(objects(values, f"/t{number}")) for number in range(5)] == [False, False, True, True, True]
