"""A hop by itself: when it may connect, and which blackouts it does not survive."""

from random import Random
from typing import NamedTuple

import pytest

from sern_sim.hop import Hop
from sern_sim.links import NEVER, NS, Link
from sern_sim.models import LinkModel, Window
from sern_sim.ports import NodeState, Slot, SoloNode
from tests.sern_sim.toys import Wire

STREAM = LinkModel(rate_bps=1e6, disconnect_after_s=2.0, reconnect_s=0.5).as_stream()


class At(NamedTuple):
    """A clock that stands."""

    elapsed_ns: int


class Alone:
    """A hop without a network."""

    def __init__(self, forward: LinkModel = STREAM, backward: LinkModel = STREAM) -> None:
        self.nodes = [NodeState(SoloNode(Wire())) for _ in range(2)]
        a, b = (Slot(Wire(), node, name) for node, name in zip(self.nodes, "ab", strict=True))
        self.broken: list[float | None] = []
        links = [Link(model, Random(1)) for model in (forward, backward)]
        self.hop = Hop(
            At(0), "hop", a, b, links[0], links[1], lambda _hop, reconnect_s: self.broken.append(reconnect_s)
        )


def test_each_direction_ends_at_the_other_port() -> None:
    hop = Alone().hop
    a, b = hop.slots
    assert (a.out, b.out) == (hop.forward, hop.backward)
    assert (hop.forward.target, hop.backward.target) == (b, a)


def test_an_attempt_counts_while_both_nodes_live_and_nothing_has_happened_since() -> None:
    alone = Alone()
    hop = alone.hop
    assert hop.may_connect(hop.generation)
    hop.open(0)
    assert not hop.may_connect(hop.generation), "it is connected"
    hop.close(0)
    assert hop.may_connect(hop.generation) and not hop.may_connect(hop.generation - 1)
    alone.nodes[1].alive = False
    assert not hop.may_connect(hop.generation)


def test_what_was_under_way_when_it_closed_does_not_arrive() -> None:
    hop = Alone().hop
    directions = (hop.forward, hop.backward)
    hop.open(0)
    assert [direction.open for direction in directions] == [True, True]
    epochs = [direction.epoch for direction in directions]
    hop.close(NS)
    assert [direction.open for direction in directions] == [False, False]
    assert [direction.epoch for direction in directions] == [epoch + 1 for epoch in epochs]


def test_the_path_is_back_when_the_later_blackout_within_the_wait_is_over() -> None:
    dark = LinkModel(blackouts=(Window(1.0, 3.0),)).as_stream()
    later = LinkModel(blackouts=(Window(2.0, 4.0),)).as_stream()
    hop = Alone(dark, later).hop
    assert hop.path_back_ns(0) == 0
    assert hop.path_back_ns(round(2.5 * NS)) == 4 * NS
    assert hop.path_back_ns(5 * NS) == 0
    hop.wait_ns = 2 * NS
    assert hop.path_back_ns(5 * NS) == 4 * NS, "it was there for one second only"


def test_a_connection_breaks_of_a_blackout_that_is_longer_than_its_patience() -> None:
    short, long = Window(1.0, 2.5), Window(10.0, 13.0)
    model = LinkModel(disconnect_after_s=2.0, blackouts=(short, long)).as_stream()
    hop = Alone(STREAM, model).hop
    assert hop.fatal_blackout_ns(0) == 12 * NS
    assert hop.fatal_blackout_ns(20 * NS) >= NEVER


def test_it_stays_away_for_as_long_as_its_links_say_or_as_it_is_told() -> None:
    hop = Alone(STREAM, LinkModel(reconnect_s=0.8).as_stream()).hop
    assert hop.reconnect_ns(None) == round(0.8 * NS)
    assert hop.reconnect_ns(0.1) == round(0.1 * NS)


@pytest.mark.parametrize("reconnect_s", [None, 0.3])
def test_whoever_breaks_it_says_when_it_comes_back(reconnect_s: float | None) -> None:
    alone = Alone()
    alone.hop.break_connection(reconnect_s=reconnect_s)
    assert alone.broken == [reconnect_s]


def test_the_ends_of_a_node_are_found() -> None:
    alone = Alone()
    assert alone.hop.slots_of(alone.nodes[0]) == alone.hop.slots[:1]
    assert alone.hop.slots_of(NodeState(SoloNode(Wire()))) == ()
