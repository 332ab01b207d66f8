"""Every named profile, idle and overloaded, with faults, over the stream lane and over both: the promises hold.

Idle, twice and thirteen times what the link carries; a blackout, a flapping path, bursts of loss, or none of them. No
times are asserted beyond generous bounds that follow from the link's round trip, rate and queue.

A quarter of the cells is in every run (`Cell.in_every_run`); `make lab` runs all of them.
"""

from collections.abc import Callable

import pytest

from sern_core.vocabulary.types import DropReason, PriorityClass
from tests.matrix.cells import CELLS, PROFILES, THINNED, Cell, Fault, Lanes, Load
from tests.matrix.play import Play
from tests.world import World, spec


def _params(*, every_run: bool) -> list[object]:
    return [pytest.param(cell, id=str(cell)) for cell in CELLS if cell.in_every_run is every_run]


@pytest.mark.parametrize("cell", _params(every_run=True))
def test_promises_hold(cell: Cell, told: Callable[[Play], Play]) -> None:
    assert told(Play(cell).play()).broken == []


@pytest.mark.lab_long
@pytest.mark.parametrize("cell", _params(every_run=False))
def test_promises_hold_in_the_other_cells(cell: Cell, told: Callable[[Play], Play]) -> None:
    assert told(Play(cell).play()).broken == []


def test_a_cell_is_the_same_every_time() -> None:
    cell = Cell("mesh-radio", Load.TWICE, Fault.BURST, Lanes.BOTH)
    first, second = Play(cell).play(), Play(cell).play()
    assert first.world.network.event_count == second.world.network.event_count
    assert [(got.topic, got.seq, got.at_s) for got in first.site.got] == [
        (got.topic, got.seq, got.at_s) for got in second.site.got
    ]


def test_every_run_meets_every_profile_load_lane_and_fault() -> None:
    chosen = [cell for cell in CELLS if cell.in_every_run]
    assert len(CELLS) == len(PROFILES) * 24 and len(chosen) >= 60
    assert {(c.profile, c.load, c.lanes) for c in chosen} == {(c.profile, c.load, c.lanes) for c in CELLS}
    assert {(c.load, c.lanes, c.fault) for c in chosen} == {(c.load, c.lanes, c.fault) for c in CELLS}
    assert THINNED.keys() <= PROFILES.keys()


@pytest.mark.parametrize("profile", ["satcom", "mesh-radio"])
def test_a_lifespan_below_the_floor_of_the_path_is_counted_not_silent(profile: str) -> None:
    """Nothing of it can be young enough: nothing arrives, and every message is accounted for as too old."""
    model = PROFILES[profile].up
    world = World(lossless=False).watch()
    robot = world.client("robot", model)
    site = world.client("site", patterns=["/robot/.*"])
    command = robot.publish("/robot/cmd", spec(PriorityClass.CONTROL, lifespan_s=0.8 * model.delay_s))
    world.run(5.0)
    stop = robot.every(0.1, command, b"go")
    world.run(5.0)
    stop()
    world.run(5.0)
    assert site.got == []
    hub = world.relay.hub
    onwards = hub.links[site.name].sender.ledger.topics.get(command.stream.id.topic)
    too_old = sum(
        counters.by_reason[DropReason.LIFESPAN]
        for counters in (
            command.counters,
            hub.received.of(command.stream),
            onwards,
            site.core.received.of(command.stream),
        )
        if counters is not None
    )
    given_up = (DropReason.UNCONFIRMED, DropReason.SUPERSEDED)
    lost = sum(command.counters.by_reason[reason] for reason in given_up)
    assert command.counters.offered == len(robot.sent) > 0
    assert too_old + lost >= len(robot.sent) and too_old > 0
    world.validate()
