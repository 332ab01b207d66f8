"""The end of much that waits is done in slices, and says at each of them no more than is so: what an origin is told to
be delivered further on was delivered there, or reported to it as dropped."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest

from sern_core import wire
from sern_core.fragments import InStream
from sern_core.hub import FORGOTTEN_MESSAGES
from sern_core.queues import GIVEN_UP_US, OutChannel
from sern_core.types import DropReason, PriorityClass
from tests.fuzz.test_hostile_peer import Hostile, _piece, _whole
from tests.fuzz.test_price_datagrams import control, one_more_slice, said
from tests.world import World

PER_DATAGRAM = 1_500
MANY = 13 * PER_DATAGRAM
RESUMED_S = 601.0
"""A little more than a client is waited for."""


class Backlog:
    """A reader for whom MANY messages of one reliable stream wait at its relay, and their origin."""

    def __init__(self, *, priority: PriorityClass = PriorityClass.BULK) -> None:
        world = World()
        self.origin, self.reader = Hostile(world, "origin"), Hostile(world, "reader")
        self.hub = self.origin.hub
        self.origin.announce(1, "/origin/log", reliable=True, priority=priority)
        self.reader.control({"t": "subscribe", "patterns": ["/origin/.*"], "more": False})
        for first in range(1, MANY + 1, PER_DATAGRAM):
            said(self.origin, *(_whole(1, seq) for seq in range(first, first + PER_DATAGRAM)))
        (self.channel,) = self.hub.links[self.reader.name].channels.values()
        (self.stream,) = self.hub.links[self.origin.name].streams.values()
        assert self.channel.kept == MANY

    @property
    def told(self) -> int:
        """How many messages the origin is told were dropped."""
        return sum(report.count for report in self.stream.reports)

    def slices(self, *frames: bytes) -> list[int]:
        """What the reader's frames do, slice by slice: how many messages are left after each."""
        self.reader.say(*frames)
        left = [self.left()]
        while one_more_slice(self.reader):
            left.append(self.left())
        return left

    def left(self) -> int:
        self.hub.validate()
        return self.channel.kept


def slowly(left: list[int], each: int) -> bool:
    """Whether no slice takes more than `each`, and the last one leaves nothing."""
    return left[-1] == 0 and MANY - left[0] <= each and all(a - b <= each for a, b in pairwise(left))


PER_SLICE = 6_000 // GIVEN_UP_US + 1


@pytest.mark.parametrize(
    ("envelope", "reason"),
    [
        ({"t": "want", "ch": 1, "on": False}, DropReason.UNWANTED),
        ({"t": "refuse", "ch": 1, "code": "forbidden", "why": ""}, DropReason.FORBIDDEN),
    ],
)
def test_what_is_not_wanted_any_more_is_dropped_in_slices_and_confirmed_when_it_is_told(
    envelope: dict[str, object], reason: DropReason
) -> None:
    backlog = Backlog()
    confirmed = []

    def left() -> int:
        assert backlog.stream.confirmed <= backlog.told == MANY - backlog.channel.kept
        confirmed.append(backlog.stream.confirmed)
        return Backlog.left(backlog)

    backlog.left = left  # type: ignore[method-assign]
    assert slowly(backlog.slices(control(backlog.reader, wire.encode_control(envelope))), PER_SLICE)
    assert confirmed[0] < MANY == confirmed[-1]
    assert backlog.channel.counters.by_reason[reason] == MANY


def test_wanted_again_before_all_is_dropped_it_goes_on_behind_what_was() -> None:
    backlog = Backlog()
    off = control(backlog.reader, wire.encode_control({"t": "want", "ch": 1, "on": False}))
    on = control(backlog.reader, wire.encode_control({"t": "want", "ch": 1, "on": True}))
    assert slowly(backlog.slices(off, on), PER_SLICE), "what is said behind it has its turn behind it"
    said(backlog.origin, *(_whole(1, seq) for seq in range(MANY + 1, MANY + 4)))
    assert [out.seq for out in backlog.channel.queue] == [MANY + 1, MANY + 2, MANY + 3]
    assert backlog.told == MANY == backlog.stream.confirmed


def test_a_session_that_ends_meanwhile_does_not_stop_it() -> None:
    backlog = Backlog()
    backlog.reader.say(control(backlog.reader, wire.encode_control({"t": "want", "ch": 1, "on": False})))
    assert 0 < backlog.channel.kept < MANY
    backlog.reader.port.disconnected(now=backlog.reader.now)
    backlog.hub.validate()
    for _ in range(MANY // PER_SLICE + 2):
        backlog.reader.now += 1.0
        backlog.hub.sweep(now=backlog.reader.now)
        backlog.hub.validate()
        assert backlog.stream.confirmed <= backlog.told
    assert backlog.channel.kept == 0 and backlog.told == MANY == backlog.stream.confirmed


def test_a_report_of_many_drops_is_taken_in_slices_before_the_watermark_behind_it() -> None:
    backlog = Backlog()
    dropped = {"t": "dropped", "ch": 1, "seq": 1, "code": 1, "to": "x", "n": 2**61}
    told = [0]

    def left() -> int:
        assert backlog.stream.confirmed <= backlog.told
        told.append(backlog.told)
        return Backlog.left(backlog)

    backlog.left = left  # type: ignore[method-assign]
    backlog.slices(control(backlog.reader, wire.encode_control(dropped)), wire.encode_watermark(1, MANY))
    assert told[-1] == MANY == backlog.stream.confirmed
    assert max(b - a for a, b in pairwise(told)) <= PER_SLICE
    assert backlog.channel.counters.delivered == 0 and backlog.channel.kept == 0


def test_a_watermark_that_moves_far_is_followed_in_slices() -> None:
    backlog = Backlog()
    left = backlog.slices(wire.encode_watermark(1, MANY))
    assert slowly(left, 12_002) and len(left) > 1
    assert backlog.channel.counters.delivered == MANY and backlog.told == 0
    assert backlog.stream.confirmed == MANY


def test_what_is_unsubscribed_goes_in_slices_and_nobody_is_told() -> None:
    backlog = Backlog()
    nothing = {"t": "subscribe", "patterns": [], "more": False}
    assert slowly(backlog.slices(control(backlog.reader, wire.encode_control(nothing))), PER_SLICE)
    assert backlog.channel.counters.by_reason[DropReason.UNWANTED] == MANY
    assert backlog.told == 0 and not backlog.hub.links[backlog.reader.name].channels


def test_what_waits_for_a_client_that_stays_away_goes_in_slices_and_confirmed_when_it_is_told() -> None:
    backlog = Backlog()
    hub, reader = backlog.hub, backlog.reader
    reader.port.disconnected(now=reader.now)
    hub.params = replace(hub.params, resume_s=1.0)  # sooner than the retention of what waits
    reader.now += 2.0
    before = 0
    for _ in range(MANY // FORGOTTEN_MESSAGES + 1):
        assert reader.name in hub.links
        hub.sweep(now=reader.now)
        hub.validate()
        assert 0 < backlog.told - before <= FORGOTTEN_MESSAGES and backlog.stream.confirmed <= backlog.told
        before = backlog.told
    assert before == MANY == backlog.stream.confirmed and reader.name not in hub.links
    assert backlog.channel.counters.by_reason[DropReason.DISCONNECTED] == MANY


def half_received() -> tuple[Hostile, InStream]:
    peer = Hostile()
    peer.hub.links[peer.name].reassembly.limit_bytes = 64 * 2**20
    peer.announce(1, "/robot/a", reliable=True)
    for first in range(2, MANY, PER_DATAGRAM):
        half = [_piece(1, seq, 0, 2) for seq in range(first, first + PER_DATAGRAM // 2)]
        said(peer, *half, *(_whole(1, first + PER_DATAGRAM // 2 + index) for index in range(PER_DATAGRAM // 2)))
    (stream,) = peer.hub.links[peer.name].streams.values()
    assert stream.holds_any and stream.delivered == 0
    return peer, stream


def _retract(peer: Hostile) -> None:
    peer.control({"t": "retract", "ch": 1})


def _announce_anew(peer: Hostile) -> None:
    peer.announce(1, "/robot/a", reliable=True, priority=PriorityClass.CONTROL)


@pytest.mark.parametrize("end", [_retract, _announce_anew])
def test_what_is_half_received_of_a_stream_that_ends_goes_in_slices(end: Callable[[Hostile], None]) -> None:
    peer, stream = half_received()
    link = peer.hub.links[peer.name]
    held = [link.reassembly.held_bytes]
    end(peer)
    held.append(link.reassembly.held_bytes)
    while one_more_slice(peer):
        peer.hub.validate()
        held.append(link.reassembly.held_bytes)
    assert held[-1] == 0 and not stream.holds_any
    each = max(a - b for a, b in pairwise(held))
    assert 0 < each <= 6_001 * 514 < held[0]
    by_reason = peer.hub.received.topics[stream.stream.id.topic].by_reason
    assert by_reason[DropReason.DISCONNECTED] == MANY // 2


def test_what_is_half_received_from_a_client_that_stays_away_goes_in_slices() -> None:
    peer, stream = half_received()
    hub, link = peer.hub, peer.hub.links[peer.name]
    peer.port.disconnected(now=peer.now)
    held = [link.reassembly.held_bytes]
    peer.now += RESUMED_S
    while stream.holds_any:
        hub.sweep(now=peer.now)
        hub.validate()
        assert peer.name not in hub.links
        assert link.reassembly.held_bytes < held[-1]
        held.append(link.reassembly.held_bytes)
        peer.now += 1.0
    assert len(held) > 3 and held[-1] == 0
    hub.sweep(now=peer.now)
    assert not hub._forgotten


def test_a_deep_queue_of_best_effort_goes_in_slices() -> None:
    world = World()
    origin, reader = Hostile(world, "origin"), Hostile(world, "reader")
    origin.announce(1, "/origin/scan", depth=MANY)
    reader.control({"t": "subscribe", "patterns": ["/origin/.*"], "more": False})
    for first in range(1, MANY + 1, PER_DATAGRAM):
        said(origin, *(_whole(1, seq) for seq in range(first, first + PER_DATAGRAM)))
    channel: OutChannel
    (channel,) = origin.hub.links[reader.name].channels.values()
    reader.say(control(reader, wire.encode_control({"t": "want", "ch": 1, "on": False})))
    left = [channel.kept]
    while one_more_slice(reader):
        origin.hub.validate()
        left.append(channel.kept)
    assert slowly(left, PER_SLICE)
    assert channel.counters.by_reason[DropReason.UNWANTED] == MANY


def goes_on(peer: Hostile) -> int:
    """Let time pass for a connection without a session; how often it had something to do for what its client left."""
    count = 0
    while (deadline_s := peer.port.next_deadline()) is not None:
        peer.now = max(peer.now, deadline_s)
        peer.port.handle_timeout(now=peer.now)
        peer.hub.validate()
        count += 1
    return count


def comes_back(peer: Hostile, *, boot: int) -> None:
    """A new process of the client says hello on a new connection."""
    peer.port = peer.world.relay.port(peer.name)
    peer.boot, peer.number, peer.control_seq = boot, 0, 0
    peer.hello(tag=2)


def test_who_leaves_much_behind_comes_back_when_that_is_gone() -> None:
    """Else each session would leave as much as a link may hold."""
    peer, stream = half_received()
    hub, link = peer.hub, peer.hub.links[peer.name]
    peer.control({"t": "retract", "ch": 1})
    peer.port.receive(wire.encode_handshake(wire.Kind.CLOSE, 1, int(peer.now * 1e6), {"why": "x"}), now=peer.now)
    peer.port.disconnected(now=peer.now)
    assert hub._forgotten == {peer.name: link} and stream.holds_any
    for boot in (78, 79):
        comes_back(peer, boot=boot)
        assert peer.name not in hub.links, "not yet"
    assert goes_on(peer) > 2
    assert not hub._forgotten and link.reassembly.held_bytes == 0
    peer.hello(tag=3)
    assert hub.links[peer.name].established


def test_a_new_process_is_not_given_what_the_one_before_confirmed() -> None:
    backlog = Backlog()
    reader, channel = backlog.reader, backlog.channel
    link = backlog.hub.links[reader.name]
    reader.say(wire.encode_watermark(1, MANY))
    assert 0 < channel.kept < MANY, "not all of it is through"
    reader.port.disconnected(now=reader.now)
    comes_back(reader, boot=78)
    assert not link.established
    assert goes_on(reader) and channel.kept == 0
    reader.hello(tag=3)
    assert backlog.hub.links[reader.name].established and channel.first_seq == MANY + 1
    said(backlog.origin, _whole(1, MANY + 1))
    assert [out.seq for out in channel.queue] == [MANY + 1]
    backlog.hub.validate()


def test_a_client_that_stays_away_is_forgotten_whatever_keeps_coming_for_it() -> None:
    backlog = Backlog()
    hub, reader = backlog.hub, backlog.reader
    reader.port.disconnected(now=reader.now)
    hub.params = replace(hub.params, resume_s=1.0)
    seq = MANY
    for _ in range(MANY // FORGOTTEN_MESSAGES + 1):
        assert reader.name in hub.links
        reader.now += 1.0
        hub.sweep(now=reader.now + 1.0)
        hub.validate()
        for first in range(seq + 1, seq + FORGOTTEN_MESSAGES + PER_DATAGRAM, PER_DATAGRAM):
            said(backlog.origin, *(_whole(1, each) for each in range(first, first + PER_DATAGRAM)))
            seq = first + PER_DATAGRAM - 1
    assert reader.name not in hub.links
    assert backlog.stream.confirmed == seq


def test_what_a_revoked_client_had_confirmed_is_not_told_as_dropped() -> None:
    backlog = Backlog()
    backlog.reader.say(wire.encode_watermark(1, MANY))
    assert 0 < backlog.channel.kept < MANY
    backlog.hub.forget(backlog.reader.name, "its key is revoked", now=backlog.reader.now)
    assert backlog.told == 0 and backlog.stream.confirmed == MANY
    assert backlog.channel.counters.delivered == MANY


def test_what_is_confirmed_does_not_expire_before_its_turn() -> None:
    backlog = Backlog()
    backlog.reader.say(wire.encode_watermark(1, MANY))
    kept = backlog.channel.kept
    backlog.hub.links[backlog.reader.name]._sweep(backlog.reader.now + 1e6)
    assert backlog.channel.kept == kept and backlog.told == 0


def test_a_step_that_fails_does_not_keep_the_others_from_their_turn() -> None:
    peer = Hostile()
    link = peer.hub.links[peer.name]
    done: list[bool] = []

    def fail() -> bool:
        raise RuntimeError("a fault of ours")

    def succeed() -> bool:
        done.append(True)
        return True

    link._in_slices(fail, later=True)
    link._in_slices(succeed, later=True)
    peer.port.handle_timeout(now=peer.now)
    assert not link.established and not done
    peer.port.handle_timeout(now=peer.now)
    assert done and not link.unfinished


def test_a_stream_that_nobody_wants_passes_what_comes_while_the_rest_is_dropped() -> None:
    backlog = Backlog()
    off = control(backlog.reader, wire.encode_control({"t": "want", "ch": 1, "on": False}))
    backlog.reader.say(off)
    kept, channel = backlog.channel.kept, backlog.channel
    assert kept
    said(backlog.origin, *(_whole(1, seq) for seq in range(MANY + 1, MANY + 4)))
    assert channel.kept == kept and channel.watermark < MANY
    assert slowly([MANY, *backlog.slices()], MANY)
    assert channel.watermark == MANY + 3 == backlog.stream.confirmed
    assert channel.counters.by_reason[DropReason.UNWANTED] == MANY + 3
