"""What one event costs the relay while a lot is under way or waits: `price.py` says how it is measured."""

from collections.abc import Callable
from functools import partial
from typing import Final

import pytest

from sern_core.path.congestion.fixed import FixedWindow
from sern_core.relay.access import DEFAULT_QUEUE_BYTES, AccessRule, AccessTable
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_core.wire import framing
from tests.fuzz.price import Input, Make, within_budget
from tests.fuzz.test_hostile_peer import Hostile, _piece, _whole
from tests.fuzz.test_price_datagrams import control, filled, one_more_slice, said
from tests.world import World

WINDOW_BYTES = 640_000
IN_FLIGHT = 16_000
"""One-byte messages: forty share a datagram."""
BOUND_BYTES = 13_800_000
STREAMS = 100
BACKLOG = DEFAULT_QUEUE_BYTES // (CLIENT_OVERHEAD_BYTES + 1) // 1_600 * 1_600
"""One-byte messages that may wait for a client by default."""
GAPS = 20_000
HALF_RECEIVED = 60_000


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
        framing.encode_ack(0, link.lane.flight.next_number - 1, 0, 0, int(reader.now * 1e6), 100),
        control(reader, framing.encode_control({"t": "want", "ch": 1, "on": True})),
    )
    for first in range(1, 24_000, 1_600):
        said(origin, *(_whole(1, seq) for seq in range(first, first + 1_600)))
    reader.now += 0.001
    while reader.port.next_datagram(now=reader.now) is not None:
        pass
    (channel,) = link.sender.channels.values()
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
    channels = hub.links[reader.name].sender.channels
    waits = BOUND_BYTES // (CLIENT_OVERHEAD_BYTES + 2)
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


def message_that_needs_much_room() -> Input:
    """The largest message that a relay takes is urgent, and the bound of its reader is full of small reliable ones."""
    origin, _reader, channel = filled_backlog(BACKLOG)
    origin.announce(2, "/origin/urgent", reliable=True)
    origin.hub.links[origin.name].reassembly.limit_bytes = 64 * 2**20
    total = LinkParams().max_message_bytes
    *begin, last_piece = (_piece(2, 1, at, total, bytes(min(60_000, total - at))) for at in range(0, total, 60_000))
    for piece in begin:
        origin.say(piece)

    def rest() -> bool:
        more = one_more_slice(origin)
        assert more or BACKLOG - channel.kept > 6_000
        return more

    return Input(total, lambda: origin.say(last_piece), rest=rest)


def plain(seq: int) -> bytes:
    return _whole(1, seq)


def every_second_dropped(seq: int) -> bytes:
    """Every second one is a drop marker."""
    return _whole(1, seq, b"\x01", flags=framing.FLAG_DROP_MARKER) if seq % 2 == 0 else _whole(1, seq)


def filled_backlog(count: int, frame: Callable[[int], bytes] = plain) -> tuple[Hostile, Hostile, OutChannel]:
    """Origin and reader, with so many messages that wait for the reader."""
    origin, reader = origin_and_reader()
    for first in range(1, count, 1_600):
        said(origin, *(frame(seq) for seq in range(first, first + 1_600)))
    (channel,) = reader.hub.links[reader.name].sender.channels.values()
    assert channel.kept == count
    return origin, reader, channel


def backlog_with_gaps(count: int) -> tuple[Hostile, Hostile, OutChannel]:
    """The origin leaves a message out behind each."""
    origin, reader = origin_and_reader()
    for start in range(0, count, 400):
        frames = []
        for index in range(start, start + 400):
            first = framing.encode_control({"t": "first", "ch": 1, "seq": 3 + 2 * index})
            frames += [_whole(1, 1 + 2 * index), control(origin, first)]
        said(origin, *frames)
    (channel,) = reader.hub.links[reader.name].sender.channels.values()
    assert channel.kept == count and len(channel.gaps) >= count - 1
    return origin, reader, channel


def in_order() -> tuple[Hostile, Hostile, OutChannel]:
    return filled_backlog(BACKLOG)


Fill = Callable[[], tuple[Hostile, Hostile, OutChannel]]
UNWANTED: Final[dict[str, object]] = {"t": "want", "ch": 1, "on": False}


def backlog_that_ends(name: str, *says: dict[str, object], fill: Fill = in_order, confirmed: int = BACKLOG) -> Make:
    """A reader says what ends the messages that wait for it, or confirms them."""

    def make() -> Input:
        _origin, reader, channel = fill()
        last_seq = channel.next_seq - 1
        frames = b"".join(control(reader, framing.encode_control(envelope)) for envelope in says)
        frames = frames or framing.encode_watermark(1, confirmed)

        def rest() -> bool:
            more = one_more_slice(reader)
            if says:
                assert more or all(out.counted for out in channel.retained)
            else:
                assert more or (channel.watermark, channel.kept) == (confirmed, last_seq - confirmed)
            return more

        return Input(len(frames), lambda: reader.say(frames), rest=rest)

    make.__name__ = name
    return make


def backlog_that_lapses() -> Input:
    """The retention of all that waits for a connected client is over at once, as after a suspend."""
    _origin, reader, channel = filled_backlog(BACKLOG)
    link = reader.hub.links[reader.name]
    reader.now += channel.spec.retention_s + 1

    def sweep() -> None:
        reader.port.handle_timeout(now=reader.now)

    def rest() -> bool:
        more = link.housekeeping.due_s <= reader.now
        if more:
            sweep()
        else:
            assert channel.kept == BACKLOG and all(out.message.drop_marker for out in channel.retained)
        return more

    return Input(0, sweep, rest=rest)


def backlog_that_lapses_while_its_reader_is_away() -> Input:
    _origin, reader, channel = filled_backlog(BACKLOG)
    reader.port.disconnected(now=reader.now)
    reader.hub.clients.resume_s = 1e9

    now = reader.now + channel.spec.retention_s + 1

    def rest() -> bool:
        more = reader.hub.lapse(now=now)
        if not more:
            reasons = channel.counters.by_reason
            assert not channel.kept and reasons[DropReason.RETENTION] + reasons[DropReason.UNCONFIRMED] == BACKLOG
        return more

    return Input(0, lambda: reader.hub.sweep(now=now), rest=rest)


def client_that_is_forgotten() -> Input:
    """A client is revoked for which an origin has filled all there is room for, every second message a drop marker."""
    _origin, reader, channel = filled_backlog(BACKLOG, every_second_dropped)
    reader.port.disconnected(now=reader.now)

    def take() -> None:
        reader.hub.forget(reader.name, "it is revoked", now=reader.now)
        assert not channel.kept

    return Input(0, take)


def stream_that_ends_half_received() -> Input:
    """A peer retracts a stream of which HALF_RECEIVED messages have begun to arrive."""
    peer = Hostile()
    reassembly = peer.hub.links[peer.name].reassembly
    reassembly.limit_bytes = 64 * 2**20
    peer.announce(1, "/robot/a", reliable=True)
    for first in range(1, HALF_RECEIVED, 1_500):
        said(peer, *(_piece(1, seq, 0, 2) for seq in range(first, first + 1_500)))
    frame = control(peer, framing.encode_control({"t": "retract", "ch": 1}))
    assert reassembly.held_bytes > 0.9 * reassembly.limit_bytes

    def rest() -> bool:
        more = one_more_slice(peer)
        assert more or reassembly.held_bytes == 0
        return more

    return Input(len(frame), lambda: peer.say(frame), rest=rest)


EVENTS = (
    connection_that_ends,
    messages_that_need_room,
    message_that_needs_much_room,
    backlog_that_ends("backlog_not_wanted", UNWANTED),
    backlog_that_ends("backlog_refused", {"t": "refuse", "ch": 1, "code": "forbidden", "why": ""}),
    backlog_that_ends("backlog_dropped", {"t": "dropped", "ch": 1, "seq": 1, "code": 1, "to": "x", "n": 2**61}),
    backlog_that_ends("backlog_unsubscribed", {"t": "subscribe", "patterns": [], "more": False}),
    backlog_that_ends("backlog_confirmed"),
    backlog_that_ends("all_but_one_confirmed", confirmed=BACKLOG - 1),
    backlog_that_ends("backlog_of_drop_markers", UNWANTED, fill=partial(filled_backlog, BACKLOG, every_second_dropped)),
    backlog_that_ends("backlog_with_gaps", UNWANTED, fill=partial(backlog_with_gaps, GAPS)),
    backlog_that_lapses,
    backlog_that_lapses_while_its_reader_is_away,
    client_that_is_forgotten,
    stream_that_ends_half_received,
)


@pytest.mark.parametrize("make", EVENTS, ids=lambda make: make.__name__)
def test_an_event_holds_the_loop_for_a_bounded_time(make: Make) -> None:
    assert within_budget(make)
