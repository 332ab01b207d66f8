"""A node that publishes reliable messages and ends: they arrive all the same."""

from collections.abc import Callable

from sern_client.endpoints.base import Sink
from sern_client.leaving import LEAVE_S, Leaving
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.patches import PatchParams
from sern_core.summaries.spec import SummarySpec
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import TopicRule
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_sim.models import LinkModel, Window
from tests.bridges import bridge_of
from tests.world import SimClient, World, spec

TOPIC = "/robot/odom"
NAME = TopicName("/odom")
COUNT = 200


class Case:
    """A robot whose node publishes at once what takes its link some seconds."""

    def __init__(self, model: LinkModel, *, reliable: bool = True) -> None:
        self.world = World(lossless=False)
        self.robot: SimClient = self.world.client("robot", model)
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.channel: OutChannel = self.robot.publish(TOPIC, spec(reliable=reliable, depth=1000))
        self.withdrawn: list[OutChannel] = []
        self.leaving = Leaving(self._withdraw)
        self.world.until(lambda: self.channel.ready and self.channel.wanted)

    def _withdraw(self, channel: OutChannel) -> None:
        self.withdrawn.append(channel)
        self.robot.core.unpublish(channel, now=self.robot.now)

    def publish(self) -> None:
        for _ in range(COUNT):
            self.robot.send(self.channel, bytes(500))

    def arrived(self) -> int:
        return len(self.site.on(TOPIC))

    def until(self, condition: Callable[[], object], within_s: float) -> None:
        def holds() -> object:
            self.leaving.look(now=self.robot.now)
            return condition()

        self.world.until(holds, within_s=within_s)


THIN = LinkModel(rate_bps=500e3, delay_s=0.02, loss=0.02)


def test_all_that_was_published_arrives_and_then_the_stream_ends() -> None:
    case = Case(THIN)
    case.publish()
    case.leaving.leave(NAME, case.channel, now=case.robot.now)
    assert case.withdrawn == []
    case.until(lambda: case.withdrawn, LEAVE_S)
    case.until(lambda: case.arrived() == COUNT, LEAVE_S)
    case.world.validate()


def test_what_owes_nothing_ends_at_once() -> None:
    for reliable in (True, False):
        case = Case(THIN, reliable=reliable)
        if not reliable:
            case.publish()
        case.leaving.leave(NAME, case.channel, now=case.robot.now)
        assert case.withdrawn == [case.channel]


def test_where_nothing_gets_through_it_ends_in_time_and_is_reported() -> None:
    case = Case(LinkModel(rate_bps=500e3, delay_s=0.02, blackouts=(Window(5.0, 60.0),)))
    case.world.run(6.0 - case.world.network.elapsed_s)
    case.publish()
    began_s = case.robot.now
    case.leaving.leave(NAME, case.channel, now=began_s)
    case.until(lambda: case.withdrawn, LEAVE_S + 1.0)
    assert case.robot.now >= began_s + LEAVE_S
    assert case.channel.counters.dropped == COUNT


def test_a_topic_that_comes_back_is_another_stream() -> None:
    case = Case(THIN)
    case.publish()
    case.leaving.leave(NAME, case.channel, now=case.robot.now)
    case.leaving.come_back(NAME)
    assert case.withdrawn == [case.channel]
    case.leaving.come_back(NAME)
    assert case.withdrawn == [case.channel]


def test_the_streams_of_one_topic_end_together() -> None:
    """Changes of a grid are worth nothing without the whole one, at any place between here and there."""
    case = Case(THIN)
    whole = case.robot.publish(TOPIC + "/whole", spec(reliable=True, depth=1000))
    case.publish()
    case.leaving.leave(NAME, whole, case.channel, now=case.robot.now)
    case.leaving.look(now=case.robot.now)
    assert case.withdrawn == []
    case.until(lambda: case.withdrawn, LEAVE_S)
    assert case.withdrawn == [whole, case.channel] and not case.channel.queue and not case.channel.flying
    again = Case(THIN)
    again.publish()
    again.leaving.leave(NAME, again.channel, again.channel, now=again.robot.now)
    again.leaving.come_back(NAME)
    assert again.withdrawn == [again.channel] * 2
    again.leaving.look(now=again.robot.now + LEAVE_S)
    assert again.withdrawn == [again.channel] * 2


class Grids:
    """The local side of a robot with a map, which takes what is offered."""

    def subscribe(self, name: TopicName, sink: Sink) -> "Grids":
        assert name == MAP
        self.sink = sink
        return self

    def close(self) -> None:
        self.closed = True


MAP = TopicName("/map")


async def test_changes_of_a_grid_have_the_same_patience_as_the_grid() -> None:
    """Its node has ended while changes were on their way; the link is down."""
    rule = TopicRule(compile_pattern("/map"), summaries=(SummarySpec(PatchParams()),))
    bridge = bridge_of(Grids(), (rule,), name="robot", namespace="/robot")
    core, outbound = bridge.core, bridge.outbound

    def channels() -> dict[str, OutChannel]:
        return {channel.stream.id.topic: channel for channel in core.link.sender.channels.values()}

    names = {"/robot/map", "/robot/map_updates"}
    info = ros_types.topic_info(MAP, "nav_msgs/msg/OccupancyGrid", Encoding.CDR)
    for owing in ("/robot/map", "/robot/map_updates"):
        outbound.topic_added(info)
        assert channels().keys() == names
        core.send(channels()[owing], b"change", 1, now=clock.now())
        outbound.topic_removed(MAP)
        outbound.leaving.look(now=clock.now() + LEAVE_S / 2)
        assert channels().keys() == names, owing
        outbound.leaving.look(now=clock.now() + LEAVE_S)
        assert channels() == {}
    outbound.topic_added(info)
    outbound.topic_removed(MAP)  # it owes nothing
    assert channels() == {}
    outbound.topic_added(info)
    core.send(channels()["/robot/map_updates"], b"change", 1, now=clock.now())
    before = channels()
    outbound.topic_removed(MAP)
    outbound.topic_added(info)  # its node is back
    assert channels().keys() == names and not set(channels().values()) & set(before.values())
    bridge.close()
