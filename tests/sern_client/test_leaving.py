"""A node that publishes reliable messages and ends: they arrive all the same."""

from collections.abc import Callable

from sern_client.leaving import LEAVE_S, Leaving
from sern_core.queues import OutChannel
from sern_core.types import TopicName
from sern_sim.models import LinkModel, Window
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
