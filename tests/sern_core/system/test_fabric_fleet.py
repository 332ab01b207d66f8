"""A fleet at many relays, whose relays die, whose hops break and whose robots go over, at random.

With `make explore` it is of 20 relays, 500 robots and 10,000 streams, five minutes of a core for each seed; in every
other run of a tenth of that.
"""

from dataclasses import dataclass
from random import Random
from typing import Final

import pytest

from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.exploring import SEED, seeds
from tests.fabric_world import FabricWorld
from tests.world import SimClient, spec

RELAYS, ROBOTS, STREAMS = (20, 500, 20) if SEED else (6, 24, 8)
"""`STREAMS` of each robot."""
PLACES: Final = 3
"""Relays that a client may go to."""
LIFESPAN_S: Final = 0.3
CLOCK_ERROR_S: Final = 0.02
"""What a receiver may take a message for younger than it is."""
WIRE: Final = LinkModel(delay_s=0.005, reconnect_s=0.5).as_stream()


@dataclass
class Member:
    """A robot, and the site that drives it from another relay."""

    robot: SimClient
    site: SimClient

    @property
    def log(self) -> str:
        return f"/{self.robot.name}/log"

    @property
    def command(self) -> str:
        return f"/{self.robot.name}/cmd_vel"


def fleet(world: FabricWorld, rng: Random) -> list[Member]:
    members = []
    for number in range(ROBOTS):
        here, there, *_others = places = rng.sample(sorted(world.relays), PLACES)
        robot = world.client_at(here, f"r{number}", WIRE, patterns=[f"/r{number}/cmd_vel"], among=places)
        site = world.client_at(there, f"s{number}", WIRE, patterns=[f"/r{number}/(log|pose)"], among=places)
        members.append(Member(robot, site))
    return members


def publish(member: Member) -> None:
    """One reliable stream, poses, commands the other way, and what nobody takes."""
    robot, name = member.robot, member.robot.name
    robot.every(1.0, robot.publish(member.log, spec(reliable=True, depth=1000)), bytes(40))
    robot.every(0.5, robot.publish(f"/{name}/pose", spec(PriorityClass.STATE)), bytes(40))
    command = spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S)
    member.site.every(0.5, member.site.publish(member.command, command), bytes(20))
    for number in range(STREAMS - 3):
        robot.publish(f"/{name}/other{number}", spec(PriorityClass.BULK))


@pytest.mark.parametrize("seed", seeds(1)[:2])
def test_whatever_happens_to_a_fleet_it_is_whole_in_the_end(seed: int) -> None:
    world = FabricWorld([f"h{number:02}" for number in range(RELAYS)], seed)
    rng = Random(seed)
    members = fleet(world, rng)
    world.run(5.0)
    for member in members:
        publish(member)
    world.run(3.0)
    between = [name for name in world.hops if name.startswith("h")]
    movable = sorted(world.at)

    def restart() -> None:
        world.restart(rng.choice(sorted(world.relays)))

    def part() -> None:
        for hop in rng.sample(between, len(between) // 4):
            world.hops[hop].break_connection(reconnect_s=rng.choice((0.5, 5.0)))

    def move() -> None:
        for name in rng.sample(movable, len(movable) // 10):
            world.move(name, rng.choice([relay for client, relay in world.roaming if client == name]))

    for _ in range(6):
        rng.choice((restart, part, move))()
        world.run(rng.choice((0.2, 1.0, 3.0)))
    world.until(world.peers_up, within_s=60.0, what="all relays reach each other")
    world.run(20.0)

    for relay in world.relays.values():
        relay.hub.validate()
    assert {name: world.homes(name) for name in world.at} == {name: [relay] for name, relay in world.at.items()}
    for member in members:
        whole(member)
        assert member.site.on(f"/{member.robot.name}/pose")[-1].at_s > world.now - 2.0, "poses go on"
        old = [got for got in member.robot.on(member.command) if late(member, got.seq, got.at_s)]
        assert not old, "a command is past its lifespan"


def whole(member: Member) -> None:
    """The reliable stream: once, in order, and what is missing is reported or on its way."""
    seqs = [got.seq for got in member.site.on(member.log)]
    assert seqs == sorted(set(seqs)), f"{member.log}: twice, or out of order"
    reported = {dropped.seq for dropped in member.robot.dropped_out if dropped.topic == member.log}
    told = {seq for topic, seq in member.robot.sent if topic == member.log and seq <= seqs[-1]}
    assert told - set(seqs) <= reported, f"{member.log}: {sorted(told - set(seqs) - reported)} are missing"
    newest = max(seq for topic, seq in member.robot.sent if topic == member.log)
    assert newest - seqs[-1] <= 2, f"{member.log}: it stands still at {seqs[-1]} of {newest}"


def late(member: Member, seq: int, at_s: float) -> bool:
    sent_s, _body = member.site.sent[member.command, seq]
    return at_s - sent_s > LIFESPAN_S + CLOCK_ERROR_S
