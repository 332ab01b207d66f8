"""Which ports are whose, and when a timer event is made for one."""

from collections.abc import Sequence

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_sim.hosts import Hosts
from sern_sim.links import NEVER, NS
from sern_sim.ports import Port
from tests.sern_sim.toys import Wire


class Pair:
    """A node of two ports."""

    def __init__(self) -> None:
        self.one, self.two = Wire(), Wire()

    def ports(self) -> Sequence[Port]:
        return (self.one, self.two)


def test_ports_of_one_node_share_its_state_and_others_do_not() -> None:
    hosts, pair = Hosts(), Pair()
    one, two = (hosts.add(port, pair, name) for port, name in ((pair.one, "one"), (pair.two, "two")))
    alone = hosts.add(Wire(), None, "alone")
    assert one.node is two.node and one.node.slots == [one, two]
    assert hosts.states() == [one.node, alone.node]
    assert hosts.state_of(pair) is hosts.state_of(pair.two) is one.node


def test_a_port_has_one_place_and_is_of_its_node() -> None:
    hosts, pair = Hosts(), Pair()
    hosts.add(pair.one, pair, "one")
    with pytest.raises(UsageError, match="again: this port is joined already"):
        hosts.add(pair.one, pair, "again")
    with pytest.raises(UsageError, match="the node does not list this port"):
        hosts.add(Wire(), pair, "stranger")
    with pytest.raises(UsageError, match="this node has no port"):
        hosts.state_of(Pair())


def test_another_process_takes_the_places_of_the_first() -> None:
    hosts, old, new = Hosts(), Pair(), Pair()
    slots = [hosts.add(port, old, "port") for port in old.ports()]
    state = hosts.state_of(old)
    state.alive = False
    hosts.replace(state, new, hosts.replacements(old, new, None))
    assert [slot.port for slot in slots] == [new.one, new.two] and state.alive
    assert hosts.state_of(new) is state and hosts.slots[id(new.two)] is slots[1]
    with pytest.raises(UsageError):
        hosts.state_of(old)


def test_no_place_is_left_empty() -> None:
    hosts, old, new = Hosts(), Pair(), Pair()
    for port, name in ((old.one, "one"), (old.two, "two")):
        hosts.add(port, old, name)
    with pytest.raises(UsageError, match="no new port for two"):
        hosts.replacements(old, new, [(old.one, new.one)])


class Due(Wire):
    due_s: float | None = None

    def next_deadline(self) -> float | None:
        return self.due_s


def test_a_timer_event_is_made_only_for_a_deadline_before_those_that_have_one() -> None:
    port = Due()
    slot = Hosts().add(port, None, "port")
    start_ns = 100 * NS
    assert slot.arm(start_ns, 0) == NEVER and slot.due_ns == NEVER
    port.due_s = 105.0
    assert slot.arm(start_ns, 0) == 5 * NS
    assert slot.arm(start_ns, 0) == NEVER, "it has one"
    port.due_s = 107.0
    assert slot.arm(start_ns, 0) == NEVER and slot.due_ns == 7 * NS
    port.due_s = 102.0
    assert slot.arm(start_ns, 0) == 2 * NS and slot.pending == [5 * NS, 2 * NS]


def test_a_deadline_in_the_past_is_due_at_once() -> None:
    port = Due()
    port.due_s = 90.0
    assert Hosts().add(port, None, "port").arm(100 * NS, 3 * NS) == 3 * NS
