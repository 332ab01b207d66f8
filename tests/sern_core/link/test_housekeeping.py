"""What a link lets go of by time, whether it is up or not."""

from itertools import pairwise

from sern_core.link.housekeeping import SWEEP_INTERVAL_S, TIDY_S
from sern_core.vocabulary.types import ClientName, PriorityClass, TopicName
from sern_sim.models import LinkModel
from tests.fabric_world import FabricWorld
from tests.world import SimClient, World, spec

TOPIC = TopicName("/robot/log")


def alone(**rule: float) -> tuple[World, SimClient]:
    """A robot whose relay is never there, with a message that waits."""
    world = World()
    robot = world.client("robot", LinkModel(loss=1.0, delay_s=1e6))
    channel = robot.publish(TOPIC, spec(reliable=True, **rule))  # type: ignore[arg-type]
    assert robot.send(channel, b"one")
    return world, robot


def test_it_is_swept_every_so_often() -> None:
    _, robot = alone()
    keeping, now = robot.core.link.housekeeping, robot.now
    assert now < keeping.due_s <= now + SWEEP_INTERVAL_S
    keeping.sweep(now)
    assert keeping.due_s == now + SWEEP_INTERVAL_S


def test_without_a_session_what_waits_lapses_all_the_same() -> None:
    world, robot = alone(retention_s=2.0)
    world.run(1.9)
    assert not robot.core.link.established and robot.core.link.held()[TOPIC].queued == 1
    world.run(0.2 + 2 * SWEEP_INTERVAL_S)
    assert robot.core.link.held()[TOPIC].queued == 0
    assert robot.core.link.counters[TOPIC].dropped == 1


def test_its_owner_is_asked_to_tidy_now_and_then() -> None:
    world, robot = alone()
    keeping = robot.core.link.housekeeping
    tidied: list[float] = []
    theirs = keeping.on_tidy
    assert theirs is not None, "the core of a client does"
    keeping.on_tidy = tidied.append
    world.run(3 * TIDY_S + 1.0)
    assert len(tidied) == 3
    assert min(after - before for before, after in pairwise(tidied)) >= TIDY_S


def test_a_hop_between_relays_that_has_nothing_to_say_is_left_alone() -> None:
    """A relay may have many: each question costs a thread's wake-up, a timer and a wake-up there."""
    world = FabricWorld(["a", "b"])
    world.run(60.0)
    link = world.relays["a"].hub.links[ClientName("@b")]
    flight = link.lanes.stream.flight
    asked, swept = flight.next_number, link.housekeeping.due_s
    world.run(32.0)
    assert flight.next_number - asked <= 3
    assert link.housekeeping.due_s - swept >= 30.0
    robot, _site = world.client_at("a", "robot"), world.client_at("b", "site", patterns=["/.*"])
    world.run(1.0)
    log = robot.publish("/log", spec(PriorityClass.STATE, reliable=True))
    world.run(1.0)
    robot.send(log, b"line")
    world.run(0.3)
    asked = flight.next_number
    world.run(0.7)
    assert flight.next_number > asked, "what has just had something to say is asked again soon"
    world.validate()
