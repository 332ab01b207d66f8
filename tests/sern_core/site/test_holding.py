"""A receiver that confirms a reliable message only when it has put it away: `ClientCore.hold` and `release`."""

from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason, PriorityClass
from tests.world import SimClient, World, spec

TOPIC = "/robot/chat"


class Keeper:
    """Holds every message of a client until it is told to let go."""

    def __init__(self, client: SimClient) -> None:
        self.client = client
        self.held: list[tuple[StreamInfo, int]] = []
        inner = client.message

        def message(stream: StreamInfo, message: Message, *, now: float) -> None:
            inner(stream, message, now=now)
            client.core.hold(stream.id, message.seq)
            self.held.append((stream, message.seq))

        client.message = message  # type: ignore[method-assign]

    def release(self, seq: int, lost: DropReason | None = None) -> None:
        stream = next(stream for stream, held in self.held if held == seq)
        self.client.core.release(stream.id, seq, lost=lost, now=self.client.now)


def held_world(count: int = 5) -> tuple[World, SimClient, SimClient, Keeper]:
    world = World().watch()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    keeper = Keeper(site)
    channel = robot.publish(TOPIC, spec(PriorityClass.STATE, reliable=True))
    world.run(1.0)
    for number in range(count):
        robot.send(channel, b"%d" % number)
    world.run(2.0)
    assert [seq for _, seq in keeper.held] == list(range(1, count + 1))
    return world, robot, site, keeper


def delivered(robot: SimClient) -> int:
    return next(iter(robot.core.link.sender.channels.values())).counters.delivered


def test_what_is_held_is_not_confirmed_and_what_is_below_it_is() -> None:
    world, robot, _site, keeper = held_world()
    assert delivered(robot) == 0
    keeper.release(2)  # the one before it is still held
    world.run(1.0)
    assert delivered(robot) == 0
    keeper.release(1)
    world.run(1.0)
    assert delivered(robot) == 2
    for seq in (3, 4, 5):
        keeper.release(seq)
    world.run(1.0)
    assert delivered(robot) == 5
    world.validate()


def test_what_was_lost_is_reported_to_its_origin_before_it_is_confirmed() -> None:
    world, robot, site, keeper = held_world()
    keeper.release(1)
    keeper.release(2, DropReason.STORAGE)
    for seq in (3, 4, 5):
        keeper.release(seq)
    world.run(1.0)
    assert [(d.seq, d.reason) for d in robot.dropped_out] == [(2, DropReason.STORAGE)]
    assert delivered(robot) == 4 and site.expired_seqs[TOPIC] == [2]
    world.validate()


def test_a_site_that_is_gone_gets_again_what_it_had_not_put_away() -> None:
    world, robot, site, keeper = held_world()
    keeper.release(1)
    keeper.release(2)
    world.run(1.0)
    again = world.restart_client(site.name, patterns=[".*"])
    world.run(5.0)
    assert again.seqs(TOPIC) == [3, 4, 5] and delivered(robot) == 5
    keeper.release(3)  # late word of the old process: nobody's any more
    world.validate()


def test_a_session_that_ends_confirms_nothing_by_itself() -> None:
    world, robot, site, keeper = held_world()
    site.core.link.disconnected(now=site.now)
    site.core.link.connected(now=site.now)
    world.run(5.0)
    assert len(site.ups) == 2
    assert delivered(robot) == 0 and site.core.link.established
    assert site.seqs(TOPIC) == [1, 2, 3, 4, 5]  # and nothing comes twice
    for seq in range(1, 6):
        keeper.release(seq)
    world.run(1.0)
    assert delivered(robot) == 5
    world.validate()


def test_a_release_after_the_end_of_the_stream_is_nothing() -> None:
    world, robot, site, keeper = held_world()
    robot.core.unpublish(next(iter(robot.core.link.sender.channels.values())), now=robot.now)
    world.run(5.0)
    keeper.release(1)
    world.run(1.0)
    assert site.core.link.established
    world.validate()
