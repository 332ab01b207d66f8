"""What is offered to viewers, and what is asked for because of them."""

from collections.abc import AsyncIterator, Iterable
from dataclasses import replace
from typing import Any

import pytest

from sern_client.action_conversion.endpoint import ActionEndpoint
from sern_client.endpoints.base import Viewed, viewers_of
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.on_demand import MAX_WANTED, OnDemand
from sern_client.site import Site
from sern_core.objects.xr_object import XrObject
from sern_core.topics.patterns import PatternSet, compile_pattern
from sern_core.topics.rules import Direction, RuleSet, TopicRule
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, TopicName
from tests.bridges import FakeEndpoint
from tests.support import until


class Viewer:
    """An endpoint at which people look, as far as it is asked here. `error` is raised when it is offered something."""

    def __init__(self) -> None:
        self.offered: dict[TopicName, TopicInfo] = {}
        self.viewed: Viewed | None = None
        self.error: Exception | None = None

    def use_viewed(self, viewed: Viewed) -> None:
        self.viewed = viewed

    def topic_offered(self, info: TopicInfo) -> None:
        if self.error is not None:
            raise self.error
        self.offered[info.name] = info

    def topic_withdrawn(self, name: TopicName) -> None:
        self.offered.pop(name, None)

    def want(self, name: str, *, wanted: bool = True) -> None:
        assert self.viewed is not None
        self.viewed.want(TopicName(name), wanted)


class Case:
    """A site whose own names are below /van, with two viewers."""

    def __init__(self) -> None:
        rules = RuleSet((TopicRule(compile_pattern("/secret"), direction=Direction.SEND),))
        self.viewers = [Viewer(), Viewer()]
        self.told: list[list[TopicName]] = []
        self.ledger = ReceiveLedger()
        site = Site(FakeEndpoint(), rules, "/van", kick=lambda: None)
        self.made = OnDemand(PatternSet(["/robot.*", "/van/.*"]), site, self.viewers, add=self._add, ledger=self.ledger)

    def _add(self, names: Iterable[TopicName]) -> None:
        self.told.append(list(names))

    def there(self, topic: str, **more: str) -> None:
        self.made.changed(thing(topic, **more))


def thing(topic: str, **more: str) -> XrObject:
    attributes = {"topic": topic, "encoding": "cdr", "durability": "volatile", "reliability": "reliable"}
    return XrObject(
        id=f"{topic}@robot", owner=ClientName("robot"), kind=ObjectKind.TOPIC, type_name="std_msgs/msg/String",
        definition="string data", definition_hash="RIHS01_0", attributes=attributes | more, value=None, value_bytes=-1,
        value_sha256=None, seq=0, ros_stamp_ns=None, wall_ns=0, created_s=0.0, updated_s=0.0, version=1,
    )  # fmt: skip


@pytest.fixture
async def case() -> AsyncIterator[Case]:
    made = Case()
    yield made
    made.made.close()


async def test_a_transform_is_no_topic(case: Case, caplog: pytest.LogCaptureFixture) -> None:
    """A relay tells of each as an object that names the topic it came by."""
    topic = replace(thing("/robot/tf"), kind=ObjectKind.TRANSFORM)
    attributes = {"parent": "odom", "child": "base_link", "static": "false", "topic": "/robot/tf"}
    case.made.changed(replace(topic, id="tf:odom>base_link@robot", attributes=attributes))
    assert not case.viewers[0].offered and not caplog.records
    case.made.changed(topic)
    assert case.viewers[0].offered.keys() == {"/robot/tf"}, "but the topic is"


async def test_all_viewers_are_offered_what_matches_by_its_name_here(case: Case) -> None:
    for topic in ("/robot/odom", "/van/map", "/other/odom", "/robot/set/_service", "/van/secret"):
        case.there(topic)
    for viewer in case.viewers:
        assert viewer.offered.keys() == {"/robot/odom", "/map"}
    info = case.viewers[0].offered[TopicName("/robot/odom")]
    assert (info.type_name, info.type_hash, info.definition) == ("std_msgs/msg/String", "RIHS01_0", "string data")
    assert info.reliable and not info.latched
    case.there("/robot/odom", durability="transient_local")
    assert case.viewers[1].offered[TopicName("/robot/odom")].latched
    case.made.deleted("/robot/odom@robot")
    case.made.deleted("/robot/odom@robot")
    assert case.viewers[0].offered.keys() == {"/map"}


async def test_what_any_viewer_wants_is_asked_for_by_its_name_elsewhere_and_together(case: Case) -> None:
    case.there("/robot/odom")
    case.there("/van/map")
    for viewer in case.viewers:
        viewer.want("/map")
    case.viewers[0].want("/robot/odom")
    case.viewers[0].want("/robot/later")
    await until(lambda: case.told == [["/van/map", "/robot/odom"]])
    case.viewers[0].want("/map", wanted=False)
    case.there("/robot/later")
    await until(lambda: len(case.told) == 2)
    assert case.told[-1] == ["/van/map", "/robot/odom", "/robot/later"]
    case.viewers[1].want("/map", wanted=False)
    case.viewers[1].want("/never/wanted", wanted=False)
    await until(lambda: case.told[-1] == ["/robot/odom", "/robot/later"])


async def test_what_is_gone_is_not_asked_for_and_is_when_it_comes_again(case: Case) -> None:
    case.there("/robot/odom")
    case.viewers[0].want("/robot/odom")
    await until(lambda: case.told == [["/robot/odom"]])
    case.made.deleted("/robot/odom@robot")
    await until(lambda: case.told[-1] == [])
    case.there("/robot/odom")
    await until(lambda: case.told[-1] == ["/robot/odom"])


async def test_no_more_than_so_many_are_asked_for(case: Case, caplog: pytest.LogCaptureFixture) -> None:
    for number in range(MAX_WANTED + 3):
        case.there(f"/robot/t{number}")
        case.viewers[0].want(f"/robot/t{number}")
    await until(lambda: case.told)
    assert len(case.told[-1]) == MAX_WANTED and caplog.text.count("viewers want 2051 topics") == 1


async def test_what_nobody_understands_is_not_offered_and_said(case: Case, caplog: pytest.LogCaptureFixture) -> None:
    case.there("/robot/odom", encoding="morse")
    case.made.changed(replace(thing("/robot/x"), attributes={}))
    assert not case.viewers[0].offered
    assert "/robot/odom of robot is not offered to viewers: 'morse' is not a valid Encoding" in caplog.text


@pytest.mark.parametrize(
    ("said", "capped_hz"), [("2.5", 2.5), ("fast", None), ("-1", None), ("inf", None), ("nan", None)]
)
async def test_how_often_a_topic_comes_at_most_is_what_its_origin_says(
    case: Case, said: str, capped_hz: float | None
) -> None:
    topic = TopicName("/robot/odom")
    stream = StreamInfo(StreamId(ClientName("robot"), 1, topic), TopicInfo(topic, "a/B", Encoding.CDR), TopicSpec())
    case.ledger.of(stream).arrived(10, 0.1, 1.0)
    case.there("/robot/odom", max_rate_hz=said)
    assert [news.capped_hz for news in case.made.topics()] == [capped_hz]
    case.made.deleted(thing("/robot/odom").id)
    assert [news.capped_hz for news in case.made.topics()] == [None]


async def test_a_viewer_that_fails_costs_the_others_nothing(case: Case) -> None:
    case.viewers[1].error = RuntimeError("no")
    with pytest.raises(RuntimeError, match="no"):
        case.there("/robot/odom")
    assert case.viewers[0].offered.keys() == {"/robot/odom"}


def test_people_look_at_members_of_a_composite_behind_actions_too() -> None:
    class Looking(FakeEndpoint):
        use_viewed = Viewer.use_viewed
        topic_offered = Viewer.topic_offered
        topic_withdrawn = Viewer.topic_withdrawn

    looking = Looking()
    both = CompositeEndpoint([FakeEndpoint(), looking])
    services: Any = both
    assert viewers_of(looking) == viewers_of(both) == [looking] and viewers_of(FakeEndpoint()) == []
    behind = ActionEndpoint(both, services, Encoding.CDR, [], namespace="/", files=[])
    assert viewers_of(behind) == [looking]
