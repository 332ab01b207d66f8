"""A stream that is let go of while it goes on behind what its sender left out."""

import pytest

from sern_core.link.link import Link
from sern_core.stream.in_stream import InStream
from sern_core.wire import framing
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.sern_core.system.test_reports import said
from tests.world import World, limited


@pytest.mark.interpreted
def test_a_stream_that_nobody_wants_is_not_told_of_again_as_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left out is told once it is done. A stream that is forgotten meanwhile has nothing left to be told of,
    also when it goes on in slices the next time."""
    peer = Hostile(World(link=limited(slice_us=5)))
    told: list[int] = []

    def on_skipped(_link: Link, _stream: InStream, count: int, *, now: float) -> None:
        told.append(count)

    monkeypatch.setattr(peer.hub.link_handler, "on_skipped", on_skipped)

    def read_on() -> None:
        while (due_s := end.reading.due_s) is not None:
            peer.now = max(peer.now, due_s)
            peer.port.handle_timeout(now=peer.now)

    peer.announce(1, "/robot/a", reliable=True)
    end = peer.hub.links[peer.name]
    (stream,) = end.taking.streams.values()
    peer.now = 5.0
    peer.port.handle_timeout(now=peer.now)  # the next sweep is some time away
    for seq in range(2, 60):
        peer.say(_whole(1, seq))
        read_on()
    said(peer, acknowledge=False)
    assert stream.pause_seq
    peer.say(framing.encode_ack(0, end.lane.flight.next_number - 1, 2**64 - 1, 0, int(peer.now * 1e6), 100))
    read_on()
    peer.control({"t": "first", "ch": 1, "seq": 100})
    assert stream in end.reassembly.behind
    peer.now += 1.0
    peer.port.handle_timeout(now=peer.now)
    assert stream not in end.reassembly.behind and stream.delivered == 99 and not told
    read_on()
    for seq in range(102, 160):
        peer.say(_whole(1, seq))
        read_on()
    peer.say(_whole(1, 100))
    peer.say(_whole(1, 101))
    read_on()
    assert stream.delivered == 159 and not told, "nothing was left out any more"
    peer.hub.validate()
