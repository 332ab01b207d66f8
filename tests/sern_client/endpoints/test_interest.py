"""What an endpoint has open for the subscriptions of its bridge, as interest comes and goes."""

import logging

import pytest

from sern_client.endpoints.common import interest
from sern_client.endpoints.common.interest import Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import TopicName
from tests.support import until

CHAT, MAP = TopicName("/chat"), TopicName("/map")


class Toy:
    """A subscription at a middleware that refuses as often as it is told to."""

    def __init__(self, name: TopicName, owner: "Subscriptions[Toy]", refusals: int = 0) -> None:
        self.name = name
        self.wanted = True
        self.there = False
        self.refusals = refusals
        self._owner = owner

    def refresh(self) -> None:
        if self.wanted and not self.there and self.refusals:
            self.refusals -= 1
            raise ConfigError("not now")
        self.there = self.wanted

    @property
    def lacking(self) -> bool:
        return self.wanted and not self.there

    def close(self) -> None:
        self.there = False
        self._owner.remove(self)


@pytest.fixture
def opened() -> Subscriptions[Toy]:
    return Subscriptions(SayOnce(logging.getLogger(__name__)))


def test_interest_is_of_one_topic(opened: Subscriptions[Toy]) -> None:
    chats = [opened.add(Toy(CHAT, opened)) for _ in range(2)]
    other = opened.add(Toy(MAP, opened))
    opened.interest(CHAT, False)
    opened.interest(TopicName("/strange"), False)
    assert [each.there for each in (*chats, other)] == [False, False, True]
    assert opened.names == {CHAT: 2, MAP: 1} and opened.differences() == []
    opened.interest(CHAT, True)
    assert all(each.there for each in chats)
    chats[0].close()
    assert opened.names == {CHAT: 1, MAP: 1}
    opened.close()
    assert not opened.names and not other.there


async def test_what_is_refused_is_asked_for_again(
    opened: Subscriptions[Toy], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(interest, "RETRY_S", 0.0)
    refused, closed = (opened.add(Toy(name, opened, refusals=3)) for name in (CHAT, MAP))
    assert [difference.name for difference in opened.differences()] == [CHAT, MAP]
    closed.close()
    await until(lambda: refused.there)
    assert opened.differences() == [] and closed.refusals == 2, "who has left asks no more"
    assert [record.getMessage() for record in caplog.records] == [
        "/chat is not taken: not now", "/map is not taken: not now",
    ]  # fmt: skip
