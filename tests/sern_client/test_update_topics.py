"""What a site asks for beside its own patterns follows the grids of patches that are open."""

from collections.abc import AsyncIterator
from functools import partial
from typing import Any

import pytest

from sern_client import update_topics
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.subscribed import Subscribed
from sern_client.update_topics import MAX_TOPICS, UpdateTopics
from sern_core.summaries.grids import GRID_TYPE, UPDATE_TYPE
from sern_core.vocabulary.message import StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime import clock, ros_types
from tests.bridges import Shell, bridge_of
from tests.support import Events, until
from tests.world import spec

PATTERNS = ("/robot/.*", "/[a-z]+/map")


def stream(number: int) -> StreamId:
    return StreamId(ClientName("robot"), 1, TopicName(f"/evil/g{number}/map"))


def updates(number: int) -> TopicName:
    return TopicName(f"/evil/g{number}/map_updates")


class Site:
    def __init__(self) -> None:
        self.patterns: tuple[str, ...] = PATTERNS
        self.told: list[tuple[str, ...]] = []
        subscribed = Subscribed(self._subscribe)
        self.topics = UpdateTopics(subscribed.covers, partial(subscribed.add, "updates"))
        subscribed.begin(PATTERNS)
        self.told.clear()

    def _subscribe(self, patterns: tuple[str, ...]) -> None:
        self.patterns = patterns
        self.told.append(patterns)

    def open(self, *numbers: int) -> None:
        for number in numbers:
            self.topics.opened(stream(number), updates(number))


@pytest.fixture
async def site(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Site]:
    monkeypatch.setattr(update_topics, "PAUSE_S", 0.0)
    made = Site()
    yield made
    made.topics.close()


async def test_what_is_open_is_asked_for_and_what_has_ended_no_more(site: Site) -> None:
    site.open(2, 1)
    await until(lambda: site.told == [(*PATTERNS, updates(1), updates(2))], "both at once")
    site.topics.closed(stream(2))
    site.topics.closed(stream(7))
    await until(lambda: site.patterns == (*PATTERNS, updates(1)))
    site.topics.closed(stream(1))
    await until(lambda: site.patterns == PATTERNS)
    assert len(site.told) == 3


async def test_what_the_site_has_by_itself_is_not_asked_for(site: Site) -> None:
    site.topics.opened(stream(1), TopicName("/robot/map_updates"))
    site.open(2)
    await until(lambda: site.told)
    assert site.told == [(*PATTERNS, updates(2))]
    assert site.topics.of_site(TopicName("/robot/map_updates")) and not site.topics.of_site(updates(2))


async def test_one_that_begins_anew_changes_nothing(site: Site) -> None:
    site.open(1)
    await until(lambda: site.told)
    site.topics.closed(stream(1))
    site.open(1)
    await until(lambda: site.topics._timer.deadline_s is None)
    assert len(site.told) == 1


async def test_no_more_than_so_many_are_asked_for(site: Site, caplog: pytest.LogCaptureFixture) -> None:
    for turn in range(2):
        site.open(*range(MAX_TOPICS + 2))
        await until(lambda: len(site.patterns) == len(PATTERNS) + MAX_TOPICS)
        assert updates(MAX_TOPICS) not in site.patterns
        site.topics.closed(stream(0))
        await until(lambda: updates(MAX_TOPICS) in site.patterns, "the next has its place")
        assert len(site.patterns) == len(PATTERNS) + MAX_TOPICS and updates(0) not in site.patterns
        for number in range(MAX_TOPICS + 2):
            site.topics.closed(stream(number))
        await until(lambda: site.patterns == PATTERNS)
        assert caplog.text.count("258 grids of patches are open") == 1, turn


async def test_changes_that_follow_each_other_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(update_topics, "PAUSE_S", 3600.0)
    site = Site()
    site.open(1)
    await until(lambda: site.told)
    site.open(2)
    due_s = site.topics._timer.deadline_s
    assert due_s is not None and due_s > clock.now() + 3000.0 and len(site.told) == 1
    site.topics.close()


async def test_a_bridge_subscribes_as_grids_come_and_go(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(update_topics, "PAUSE_S", 0.0)
    endpoint = RecordEndpoint(RecordOptions(tmp_path / "all"))
    await endpoint.start(Events())
    shell = Shell()
    bridge = bridge_of(endpoint, shell=shell)
    core = bridge.core
    bridge.inbound.subscribed.begin(("/evil/.*/map",))

    def of(topic: TopicName, kind: str, number: int) -> StreamInfo:
        attributes = {"summary": "patches", "summary_of": stream(number).topic}
        ident = StreamId(ClientName("robot"), 1, topic)
        return StreamInfo(ident, ros_types.topic_info(topic, kind, Encoding.ROS1), spec(), attributes)

    wholes = [of(stream(number).topic, GRID_TYPE, number) for number in range(3)]
    for whole in wholes:
        bridge.stream_opened(whole)
    await until(lambda: core.subscription.patterns == ("/evil/.*/map", updates(0), updates(1), updates(2)))
    changes = of(updates(1), UPDATE_TYPE, 1)
    bridge.stream_opened(changes)
    assert +endpoint.publishers == {whole.info.name: 1 for whole in wholes}, "updates are for the grids alone"
    for each in (*wholes, changes):
        bridge.stream_closed(each)
    await until(lambda: core.subscription.patterns == ("/evil/.*/map",))
    assert shell.faults == []
    bridge.close()
    await endpoint.stop()
