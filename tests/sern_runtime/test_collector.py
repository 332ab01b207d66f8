"""The collector's passes are counted, what is there at the start is left out, and the data path leaves it nothing."""

import gc
import weakref
from collections.abc import Iterator

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from sern_core.vocabulary.params import SchedulerParams
from sern_runtime.collector import THRESHOLDS, CollectorWatch
from sern_runtime.metrics import Metrics
from tests.world import Clock, World, spec


class Node:
    """An object that may be in a cycle."""

    other: "Node"


@pytest.fixture
def watch() -> Iterator[CollectorWatch]:
    times = iter(range(1000))
    watch = CollectorWatch(clock=lambda: float(next(times)))
    gc.disable()
    yield watch
    watch.close()
    gc.enable()


def test_passes_are_counted_with_their_time(watch: CollectorWatch) -> None:
    gc.collect()
    assert watch.passes == [0, 0, 0], "counted before it was asked to"
    watch.watch()
    watch.watch()
    gc.collect()
    gc.collect(0)
    gc.collect()
    assert watch.passes == [1, 0, 2]
    assert watch.seconds == [1.0, 0.0, 2.0] and watch.longest_s == [1.0, 0.0, 1.0]
    watch.close()
    gc.collect()
    assert watch.passes == [1, 0, 2]


def test_metrics_have_every_generation_from_the_start(watch: CollectorWatch) -> None:
    registry = CollectorRegistry()
    watch.register(Metrics(registry, process=False))
    watch.watch()
    gc.collect(1)
    text = generate_latest(registry).decode()
    assert 'sern_gc_passes_total{generation="0"} 0.0' in text
    assert 'sern_gc_passes_total{generation="1"} 1.0' in text
    assert 'sern_gc_pause_seconds_total{generation="1"} 1.0' in text
    assert 'sern_gc_pause_longest_seconds{generation="2"} 0.0' in text


def test_what_is_there_stays_and_what_comes_is_collected(watch: CollectorWatch) -> None:
    before = gc.get_threshold()
    gc.unfreeze()  # what this test run has frozen itself
    watch.watch()
    watch.settle()
    assert watch.passes == [0, 0, 0], "the pass at the start is counted"
    assert gc.get_threshold() == THRESHOLDS
    assert gc.get_freeze_count() > 10_000
    assert gc.isenabled(), "a program starts without it"
    node = Node()
    node.other = node
    gone = weakref.ref(node)
    del node
    gc.collect()
    assert gone() is None
    watch.settle()
    watch.close()
    watch.close()
    assert gc.get_threshold() == before and gc.get_freeze_count() == 0


@pytest.mark.parametrize("reliable", [False, True])
def test_a_message_on_its_way_makes_no_cycle(reliable: bool, watch: CollectorWatch) -> None:
    world = World()
    now = 0.0
    clients = [world._process(name, Clock(), SchedulerParams(), patterns)
               for name, patterns in (("robot", ()), ("site", (".*",)), ("desk", (".*",)))]  # fmt: skip
    ends = [(client.core.link, world.relay.port(client.name).inner) for client in clients]

    def turn() -> None:
        for link, port in ends:
            link.handle_timeout(now=now)
            port.handle_timeout(now=now)
        moved = True
        while moved:
            moved = False
            for link, port in ends:
                for one, other in ((link, port), (port, link)):
                    while (data := one.next_datagram(now=now)) is not None:
                        other.receive(data, now=now)
                        moved = True

    for link, _port in ends:
        link.connected(now=now)
    channel = clients[0].publish("/robot/a", spec(reliable=reliable))
    for _ in range(20):
        turn()
        now += 0.02
    gc.collect()
    for _ in range(200):
        assert clients[0].core.send(channel, bytes(200), 0, now=now)
        turn()
        now += 0.01
    assert all(len(client.got) == 200 for client in clients[1:])
    assert gc.collect() == 0
