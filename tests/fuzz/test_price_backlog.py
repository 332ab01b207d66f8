"""What one event costs the relay while a lot is under way or waits: `price.py` says how it is measured."""

import pytest

from sern_core import wire
from sern_core.control.fixed import FixedWindow
from tests.fuzz.price import Input, Make, within_budget
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.fuzz.test_price_datagrams import control, said
from tests.world import World

WINDOW_BYTES = 640_000
IN_FLIGHT = 4_000


def origin_and_reader() -> tuple[Hostile, Hostile]:
    """A client that publishes the reliable topic /origin/log, and one that subscribes to whatever it publishes."""
    world = World()
    reader, origin = Hostile(world, "reader"), Hostile(world, "origin")
    origin.announce(1, "/origin/log", reliable=True)
    reader.control({"t": "subscribe", "patterns": ["/origin/.*"], "more": False})
    return origin, reader


def connection_that_ends() -> Input:
    """A connection that ends with as many small messages under way as its window allows."""
    origin, reader = origin_and_reader()
    link = reader.hub.links[reader.name]
    link.lane.estimator = link.lane.path.estimator = FixedWindow(WINDOW_BYTES)
    while reader.port.next_datagram(now=reader.now) is not None:
        pass
    reader.say(
        wire.encode_ack(0, link.lane.flight.next_number - 1, 0, 0, int(reader.now * 1e6), 100),
        control(reader, wire.encode_control({"t": "want", "ch": 1, "on": True})),
    )
    for first in range(1, 6_000, 400):
        said(origin, *(_whole(1, seq, b"x" * 100) for seq in range(first, first + 400)))
    reader.now += 0.001
    while reader.port.next_datagram(now=reader.now) is not None:
        pass
    (channel,) = link.channels.values()
    assert len(channel.flying) > IN_FLIGHT

    def take() -> None:
        reader.port.disconnected(now=reader.now)
        assert len(channel.active) == len(channel.flying) > IN_FLIGHT

    return Input(0, take)


EVENTS = (connection_that_ends,)


@pytest.mark.parametrize("make", EVENTS, ids=lambda make: make.__name__)
def test_an_event_holds_the_loop_for_a_bounded_time(make: Make) -> None:
    assert within_budget(make)
