"""What reports of drops cost a relay when it keeps all that it may for their origin: `price.py` has the measure."""

import pytest

from sern_core.stream.drop_reports import DropReports
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.types import DROP_CODES, DropReason, PriorityClass
from sern_core.wire import framing
from tests.fuzz.price import Input, Make, within_budget
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.fuzz.test_price_datagrams import control, filled, one_more_slice, said
from tests.world import World

BACKLOG = 3_200
FIRST = 2 * LIMITS.kept_reports
LOST = DROP_CODES[DropReason.LOST]


def crowded(*, first: int = FIRST) -> tuple[Hostile, Hostile, DropReports]:
    """An origin that is away, a reader that holds BACKLOG of its messages, and the reports of every second one of very
    many others. The messages begin at seq `first`."""
    world = World()
    reader, origin = Hostile(world, "reader"), Hostile(world, "origin")
    origin.announce(1, "/origin/log", first=first, reliable=True, priority=PriorityClass.BULK)
    reader.control({"t": "subscribe", "patterns": ["/origin/.*"], "more": False})
    for start in range(first, first + BACKLOG, 1_600):
        said(origin, *(_whole(1, seq) for seq in range(start, start + 1_600)))
    origin.port.disconnected(now=origin.now)
    link = origin.hub.links[origin.name]
    (stream,) = link.taking.streams.values()
    (channel,) = reader.hub.links[reader.name].sender.channels.values()
    assert channel.kept == BACKLOG
    for seq in range(2, FIRST, 2):
        stream.reports.add(seq, DropReason.LOST, "site")
    for seq in range(FIRST + BACKLOG, FIRST + BACKLOG + 10, 2):
        stream.reports.add(seq, DropReason.LOST, "site")
    assert link.reassembly.unacked_reports.reports == len(stream.reports) == LIMITS.kept_reports
    return reader, origin, stream.reports


def of_one_each() -> Input:
    """A datagram of reports of single messages, newest first, none next to another."""
    reader, _origin, reports = crowded()

    def dropped(index: int) -> bytes:
        seq = FIRST + BACKLOG - 2 - 2 * index
        return control(reader, framing.encode_control({"t": "dropped", "ch": 1, "seq": seq, "code": LOST, "to": "x"}))

    frames = filled(dropped)
    assert 500 < len(frames) < BACKLOG // 2
    (channel,) = reader.hub.links[reader.name].sender.channels.values()

    def rest() -> bool:
        more = one_more_slice(reader)
        assert more or sum(out.counted for out in channel.retained) == len(frames)
        assert len(reports) == LIMITS.kept_reports
        return more

    return Input(sum(map(len, frames)), lambda: reader.say(*frames), rest=rest)


def of_a_run_that_holds_many() -> Input:
    """A run of messages of which every second one is reported already, by somebody else."""
    reader, _origin, reports = crowded(first=FIRST - BACKLOG)
    frame = control(
        reader, framing.encode_control({"t": "dropped", "ch": 1, "seq": 1, "code": LOST, "to": "x", "n": 2**61})
    )

    def rest() -> bool:
        more = one_more_slice(reader)
        assert more or len(reports) == LIMITS.kept_reports - BACKLOG // 2 + 1
        return more

    return Input(len(frame), lambda: reader.say(frame), rest=rest)


def at_a_session() -> Input:
    """The origin comes back: it announces its stream, and is told the first reports."""
    _reader, origin, reports = crowded()

    def take() -> None:
        origin.tag, origin.number, origin.control_seq = 2, 0, 0
        origin.now += 5.0
        origin.hello(tag=2)
        origin.announce(1, "/origin/log", first=FIRST, reliable=True, priority=PriorityClass.BULK)
        origin.control({"t": "synced", "batch": True})
        while origin.port.next_datagram(now=origin.now) is not None:
            pass
        assert 60 < reports.said <= 64

    return Input(0, take, rest=lambda: one_more_slice(origin))


@pytest.mark.parametrize("make", [of_one_each, of_a_run_that_holds_many, at_a_session], ids=lambda make: make.__name__)
def test_reports_hold_the_loop_for_a_bounded_time(make: Make) -> None:
    assert within_budget(make)
