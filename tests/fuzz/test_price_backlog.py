"""What one event costs the relay while a lot is under way or waits: `price.py` says how it is measured."""

import pytest

from sern_core import wire
from sern_core.access import AccessRule, AccessTable
from sern_core.control.fixed import FixedWindow
from sern_core.queues import MESSAGE_OVERHEAD_BYTES
from sern_core.types import PriorityClass
from tests.fuzz.price import Input, Make, within_budget
from tests.fuzz.test_hostile_peer import Hostile, _piece, _whole
from tests.fuzz.test_price_datagrams import control, filled, one_more_slice, said
from tests.world import World

WINDOW_BYTES = 640_000
IN_FLIGHT = 4_000
BOUND_BYTES = 5_200_000
STREAMS = 100
BACKLOG = 80_000
HALF_RECEIVED = 120_000


def origin_and_reader() -> tuple[Hostile, Hostile]:
    """A client that publishes the reliable topic /origin/log, and one that subscribes to whatever it publishes."""
    world = World()
    reader, origin = Hostile(world, "reader"), Hostile(world, "origin")
    origin.announce(1, "/origin/log", reliable=True, priority=PriorityClass.BULK)
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


def messages_that_need_room() -> Input:
    """A datagram of small messages for a client whose bound is full of small reliable ones of a lower class."""
    origin, reader = origin_and_reader()
    hub = origin.hub
    for channel in range(2, 2 + STREAMS):
        origin.announce(channel, f"/origin/t{channel}")
    reader.port.disconnected(now=reader.now)
    hub.revoke(
        AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",), max_queue_bytes=BOUND_BYTES)]),
        now=origin.now,
    )
    channels = hub.links[reader.name].channels
    waits = BOUND_BYTES // (MESSAGE_OVERHEAD_BYTES + 2)
    for first in range(1, waits, 1_000):
        said(origin, *(_whole(1, seq, b"yy") for seq in range(first, min(first + 1_000, waits + 1))))
    assert sum(len(channel.queue) for channel in channels.values()) == waits
    frames = b"".join(filled(lambda index: _whole(2 + index % STREAMS, 1 + index // STREAMS, b"y" * 8)))

    def rest() -> bool:
        more = one_more_slice(origin)
        if not more:
            assert 0 < waits - len(next(iter(channels.values())).queue) <= 1.05 * STREAMS
        return more

    return Input(len(frames), lambda: origin.say(frames), rest=rest)


def backlog_that_ends(name: str, *says: dict[str, object]) -> Make:
    """A reader says what ends BACKLOG messages that wait for it, or confirms them."""

    def make() -> Input:
        origin, reader = origin_and_reader()
        for first in range(1, BACKLOG, 1_600):
            said(origin, *(_whole(1, seq) for seq in range(first, first + 1_600)))
        (channel,) = reader.hub.links[reader.name].channels.values()
        assert channel.kept == BACKLOG
        frames = b"".join(control(reader, wire.encode_control(envelope)) for envelope in says)
        frames = frames or wire.encode_watermark(1, BACKLOG)

        def rest() -> bool:
            more = one_more_slice(reader)
            assert more or all(out.counted for out in channel.retained)
            return more

        return Input(len(frames), lambda: reader.say(frames), rest=rest)

    make.__name__ = name
    return make


def stream_that_ends_half_received() -> Input:
    """A peer retracts a stream of which HALF_RECEIVED messages have begun to arrive."""
    peer = Hostile()
    reassembly = peer.hub.links[peer.name].reassembly
    reassembly.limit_bytes = 64 * 2**20
    peer.announce(1, "/robot/a", reliable=True)
    for first in range(1, HALF_RECEIVED, 1_500):
        said(peer, *(_piece(1, seq, 0, 2) for seq in range(first, first + 1_500)))
    frame = control(peer, wire.encode_control({"t": "retract", "ch": 1}))
    assert reassembly.held_bytes > 512 * HALF_RECEIVED

    def rest() -> bool:
        more = one_more_slice(peer)
        assert more or reassembly.held_bytes == 0
        return more

    return Input(len(frame), lambda: peer.say(frame), rest=rest)


EVENTS = (
    connection_that_ends,
    messages_that_need_room,
    backlog_that_ends("backlog_not_wanted", {"t": "want", "ch": 1, "on": False}),
    backlog_that_ends("backlog_refused", {"t": "refuse", "ch": 1, "code": "forbidden", "why": ""}),
    backlog_that_ends("backlog_dropped", {"t": "dropped", "ch": 1, "seq": 1, "code": 1, "to": "x", "n": 2**61}),
    backlog_that_ends("backlog_unsubscribed", {"t": "subscribe", "patterns": [], "more": False}),
    backlog_that_ends("backlog_confirmed"),
    stream_that_ends_half_received,
)


@pytest.mark.parametrize("make", EVENTS, ids=lambda make: make.__name__)
def test_an_event_holds_the_loop_for_a_bounded_time(make: Make) -> None:
    assert within_budget(make)
