"""What costs more than its bytes is read in slices: in order, and nothing is acknowledged before it is read."""

from collections.abc import Callable
from typing import Any

import pytest

from sern_core.link.link import Link
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import Encoding, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, encode_announcement
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.world import World, limited, spec

STREAMS = 150


def robot_and_readers(count: int = 20, link: LinkParams | None = None) -> Hostile:
    world = World(link=link)
    peer = Hostile(world)
    for number in range(count):
        Hostile(world, f"reader{number}").control({"t": "subscribe", "patterns": [".*"], "more": False})
    return peer


def link_of(peer: Hostile) -> Link:
    return peer.hub.links[peer.name]


def announced(peer: Hostile, count: int = STREAMS, *, reliable: bool = False) -> bytes:
    """Announcements, each with the first message of its stream behind it."""
    frames = b""
    for channel_id in range(1, count + 1):
        info = TopicInfo(TopicName(f"/robot/t{channel_id}"), "a/b", Encoding.CDR)
        stream = StreamInfo(StreamId(peer.name, peer.boot, info.name), info, spec(reliable=reliable))
        peer.control_seq += 1
        body = framing.encode_control(encode_announcement(Announcement(channel_id, stream, "", 1, ())))
        frames += framing.encode_data_first(0, 0, peer.control_seq, len(body), len(body), 0, 0.0, 0) + body
        frames += _whole(channel_id, 1)
    return frames


def one_slice(peer: Hostile) -> None:
    due_s = link_of(peer).reading.due_s
    assert due_s is not None
    peer.now = max(peer.now, due_s)
    peer.port.handle_timeout(now=peer.now)


def read_all(peer: Hostile) -> int:
    slices = 0
    while link_of(peer).reading.due_s is not None:
        one_slice(peer)
        slices += 1
    return slices


def taken(peer: Hostile, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What the relay hands on of this peer, in its order."""
    got: list[tuple[str, int]] = []
    forward = peer.hub.forwarding.forward

    def watched(relayed: object, message: object, now: float) -> bool:
        got.append((message.stream.topic, message.seq))  # type: ignore[attr-defined]
        return forward(relayed, message, now)  # type: ignore[arg-type]

    monkeypatch.setattr(peer.hub.forwarding, "forward", watched)
    return got


def acknowledges(peer: Hostile) -> bool:
    """Whether anything that the relay says now is an acknowledgement."""
    acks: list[int] = []

    class Sink:
        def on_data(self, *_: object) -> None: ...

        def on_ack(self, _lane: int, highest: int, *_: int) -> None:
            acks.append(highest)

        def on_watermark(self, _channel_id: int, _delivered: int) -> None: ...

        def on_ping(self) -> None: ...

    while (datagram := peer.port.next_datagram(now=peer.now)) is not None:
        if datagram[2] == framing.Kind.DATA:
            framing.decode_frames(datagram, Sink())
    return bool(acks)


@pytest.mark.interpreted
def test_a_datagram_that_costs_much_is_read_in_slices_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = robot_and_readers()
    got = taken(peer, monkeypatch)
    peer.say(announced(peer))
    assert 0 < len(got) < STREAMS
    peer.say(_whole(1, 2))  # it came later: its turn is later, too
    assert read_all(peer) > 3
    assert got == [*((f"/robot/t{channel_id}", 1) for channel_id in range(1, STREAMS + 1)), ("/robot/t1", 2)]
    assert link_of(peer).receiver.strays == 0
    peer.hub.validate()


@pytest.mark.interpreted
def test_others_have_their_turn_in_between(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = robot_and_readers()
    other = Hostile(peer.world, "other")
    got = taken(peer, monkeypatch)
    other.announce(1, "/other/a")
    peer.say(announced(peer))
    other.say(_whole(1, 1))
    assert got[-1] == ("/other/a", 1)
    assert link_of(peer).reading.due_s is not None


def test_nothing_of_it_is_acknowledged_before_it_is_read() -> None:
    peer = robot_and_readers()
    assert not acknowledges(peer)
    peer.say(announced(peer))
    peer.say(_whole(1, 2))
    peer.now += 1e-3
    while link_of(peer).end.half_read:
        assert not acknowledges(peer)
        one_slice(peer)
    read_all(peer)
    peer.now += 1.0
    assert acknowledges(peer)


@pytest.mark.interpreted
def test_a_session_that_ends_meanwhile_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = robot_and_readers()
    got = taken(peer, monkeypatch)
    peer.say(announced(peer, reliable=True))
    before = len(got)
    assert before < STREAMS
    peer.hello(2)
    assert not link_of(peer).reading._unread
    peer.tag, peer.control_seq, peer.number = 2, 0, 0
    peer.say(announced(peer, reliable=True))
    read_all(peer)
    assert got == [(f"/robot/t{channel_id}", 1) for channel_id in range(1, STREAMS + 1)]
    peer.hub.validate()


def test_bytes_of_no_honest_peer_that_are_read_later_end_the_session() -> None:
    peer = robot_and_readers()
    peer.say(announced(peer), b"\xff")
    read_all(peer)
    assert not link_of(peer).established
    with pytest.raises(WireError, match="unknown frame"):  # so that its connection is closed
        peer.say(framing.PING_FRAME)


def test_what_waits_to_be_read_has_a_bound() -> None:
    peer = robot_and_readers(link=limited(unread_bytes=500_000))
    peer.say(announced(peer))

    def send_on() -> None:
        for _ in range(100):
            peer.say(framing.PING_FRAME * 10_000)

    with pytest.raises(WireError, match="wait to be read"):
        send_on()
    assert not link_of(peer).established
    assert link_of(peer).reading._unread_bytes == 0


WAITING = 4000


def out_of_order(peer: Hostile, *, step: int = 1) -> None:
    peer.hub.links[peer.name].reassembly.limit_bytes = 64 * 2**20
    peer.announce(1, "/robot/log", reliable=True)
    for start in range(2, 2 + WAITING * step, 1000 * step):
        peer.say(*(_whole(1, seq) for seq in range(start, start + 1000 * step, step)))
        read_all(peer)


def first_one(peer: Hostile) -> None:
    peer.say(_whole(1, 1))


def none_below(peer: Hostile) -> None:
    peer.control({"t": "first", "ch": 1, "seq": 2 + 2 * WAITING})


@pytest.mark.interpreted
@pytest.mark.parametrize(("release", "step"), [(first_one, 1), (none_below, 2)])
def test_what_waited_is_released_in_slices_and_in_order(
    release: Callable[[Hostile], None], step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = robot_and_readers(2)
    out_of_order(peer, step=step)
    got = taken(peer, monkeypatch)
    last = 2 + WAITING * step
    expected = [*([1] if step == 1 else []), *range(2, last, step), last]
    release(peer)
    assert 0 < len(got) < WAITING // 2
    peer.say(_whole(1, last), _whole(1, 3))  # the next, and one whose turn is over
    assert read_all(peer) > 3
    assert [seq for _, seq in got] == expected
    assert link_of(peer).reassembly.held_bytes == 0
    peer.hub.validate()


@pytest.mark.interpreted
@pytest.mark.parametrize(("release", "step"), [(first_one, 1), (none_below, 2)])
def test_what_is_released_goes_on_when_the_session_has_ended(
    release: Callable[[Hostile], None], step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = robot_and_readers(2)
    out_of_order(peer, step=step)
    got = taken(peer, monkeypatch)
    release(peer)
    peer.hello(2)
    peer.tag, peer.control_seq, peer.number = 2, 0, 0
    peer.announce(1, "/robot/log", reliable=True)
    peer.say(*(_whole(1, seq) for seq in range(1, 500)))
    read_all(peer)
    assert [seq for _, seq in got] == sorted({seq for _, seq in got})
    assert len(got) == WAITING + (step == 1)
    stream = link_of(peer).taking.incoming[1]
    assert stream.delivered == (1 + WAITING if step == 1 else 1 + 2 * WAITING)
    peer.hub.validate()


def test_streams_that_were_left_out_are_retracted_in_slices() -> None:
    peer = robot_and_readers()
    for channel_id in range(1, STREAMS + 1):
        peer.announce(channel_id, f"/robot/t{channel_id}")
        read_all(peer)
    peer.hello(2)
    peer.tag, peer.control_seq, peer.number = 2, 0, 0
    peer.control({"t": "synced", "batch": True})
    assert 0 < len(peer.hub.relayed) < STREAMS
    peer.announce(1, "/robot/t1")
    read_all(peer)
    assert [identity.topic for identity in peer.hub.relayed] == ["/robot/t1"]
    peer.hub.validate()


KEPT = 4_000


@pytest.mark.parametrize(
    ("what", "each_us"),
    [("want", 0.5), ("dropped", 0.5), ("refuse", 0.5), ("watermark", 0.5)],
)
def test_what_ends_many_messages_at_once_is_charged_with_them(what: str, each_us: float) -> None:
    count = KEPT * 4
    world = World()
    reader, origin = Hostile(world, "reader"), Hostile(world, "origin")
    origin.announce(1, "/origin/log", reliable=True)
    reader.control({"t": "subscribe", "patterns": ["/origin/.*"], "more": False})
    read_all(origin)
    for first in range(1, count, 1_000):
        origin.say(*(_whole(1, seq) for seq in range(first, first + 1_000)))
        read_all(origin)
    (channel,) = link_of(reader).sender.channels.values()
    assert channel.kept == count
    control: dict[str, Any] = {
        "want": {"t": "want", "ch": 1, "on": False},
        "dropped": {"t": "dropped", "ch": 1, "seq": 1, "code": 1, "to": "reader", "n": count},
        "refuse": {"t": "refuse", "ch": 1, "code": "forbidden", "why": "no"},
    }
    said_s = reader.now
    if what == "watermark":
        reader.say(framing.encode_watermark(1, count))
    else:
        reader.control(control[what])
    assert sum(not out.counted for out in channel.retained) == 0
    charged_us = link_of(reader).reassembly.work_us
    assert each_us * count <= charged_us <= 2 * each_us * count
    assert link_of(reader).reading.due_s == pytest.approx(said_s + 1e-6 * charged_us)
    reader.hub.validate()
