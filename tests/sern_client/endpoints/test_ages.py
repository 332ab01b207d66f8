"""How old topics of other sites are, as topics of their own."""

from collections.abc import Sequence
from math import isnan

import pytest

from sern_client.endpoints.base import TopicNews
from sern_client.endpoints.common import ages
from sern_client.endpoints.common.ages import Ages, age_body, age_topic
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.support import until

CHAT = TopicName("/chat")


class Viewed:
    def __init__(self) -> None:
        self.news: list[TopicNews] = []

    def want(self, name: TopicName, wanted: bool) -> None:
        raise AssertionError("an age asks for nothing")

    def topics(self) -> Sequence[TopicNews]:
        return self.news


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_an_age_is_a_message_of_ros(encoding: Encoding) -> None:
    info = age_topic(TopicInfo(CHAT, "std_msgs/String", encoding))
    assert info is not None and (info.name, info.encoding) == ("/chat/sern/age", encoding)
    assert ros_types.deserialise(age_body(1.5, encoding), info.type_name, encoding).data == 1.5


def test_topics_without_an_age() -> None:
    assert age_topic(TopicInfo(TopicName("/chat/sern/age"), "std_msgs/Float32", Encoding.CDR)) is None
    assert age_topic(TopicInfo(TopicName("/" + "a" * 250), "std_msgs/String", Encoding.CDR)) is None
    raw = age_topic(TopicInfo(CHAT, "own/Type", Encoding.RAW))
    assert raw is not None and raw.encoding is Encoding.CDR


async def test_ages_are_told_while_somebody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ages, "PERIOD_S", 0.005)
    viewed, told = Viewed(), list[tuple[TopicName, float]]()
    telling = Ages(viewed.topics, lambda name, age_s: told.append((name, age_s)))
    telling.look(CHAT, looked=True)
    await until(lambda: told)
    assert told[0][0] == CHAT and isnan(told[0][1])
    viewed.news = [TopicNews(CHAT, 2.0, {}), TopicNews(TopicName("/other"), 3.0, {})]
    await until(lambda: told[-1][0] == CHAT and told[-1][1] == pytest.approx(2.0))
    viewed.news = []
    await until(lambda: told[-1][1] > 2.01, "it grows where nobody knows of the topic any more")
    viewed.news = [TopicNews(TopicName("/other"), 3.0, {})]
    telling.look(CHAT, looked=False)
    telling.look(TopicName("/other"), looked=True)
    await until(lambda: told[-1][0] == "/other" and told[-1][1] == pytest.approx(3.0))
    telling.close()
    count = len(told)
    telling.look(CHAT, looked=False)
    assert len(told) == count
