"""A lane that carries datagrams of any size and loses some, as between relays: what is lost comes again."""

import pytest

from sern_core.path.lanes import DATAGRAM_BYTES, LANE_ZMQ, Lane
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import PriorityClass, Reliability
from tests.two_links import BareEnd, pair

RELIABLE = TopicSpec(PriorityClass.STATE, reliability=Reliability.RELIABLE, depth=10, lifespan_s=None)
DELAY_S = 0.01
STEP_S = 0.001
RUN_S = 60.0
LARGE_BYTES = 1000
"""Datagrams with a fragment; a seventh of them is dropped."""


@pytest.mark.parametrize(
    ("lossless", "any_size", "largest"),
    [(True, None, 65_000), (False, None, DATAGRAM_BYTES), (False, True, 65_000), (True, False, DATAGRAM_BYTES)],
)
def test_how_large_datagrams_become(lossless: bool, any_size: bool | None, largest: int) -> None:
    lane = Lane(LANE_ZMQ, LinkParams(), lossless=lossless, any_size=any_size)
    assert lane.fragment_bytes_max == largest
    assert lane.flight.lossless is lossless and lane.arrivals.spacing_s == (0.001 if lossless else 0.0)
    assert lane.fragment_bytes <= 1400


@pytest.mark.parametrize("lossless", [False, True])
def test_what_a_queue_on_the_way_drops_comes_again_where_the_link_expects_it(lossless: bool) -> None:
    """A fabric drops where a queue is full. A link that takes its lane for lossless never finds out."""
    now = 0.0
    first, second = pair(now=now, lossless=lossless, any_size=True)
    channel = first.open("/log", RELIABLE, now=now)
    bodies = [bytes([number]) * 3000 for number in range(100)]
    waiting: list[tuple[float, BareEnd, bytes]] = []
    sent = 0
    first.link.connected(now=now)
    while now < RUN_S:
        now += STEP_S
        if first.link.established and channel.ready and len(channel.retained) < 5 and bodies:
            first.submit(channel, bodies.pop(0), now=now)
        for end, other in ((first, second), (second, first)):
            end.port.handle_timeout(now=now)
            while (datagram := end.port.next_datagram(now=now)) is not None:
                sent += len(datagram) > LARGE_BYTES
                if not (len(datagram) > LARGE_BYTES and sent % 7 == 0):
                    waiting.append((now + DELAY_S, other, datagram))
        while waiting and waiting[0][0] <= now:
            _, end, datagram = waiting.pop(0)
            end.port.receive(datagram, now=now)
    assert not first.faults and not second.faults
    if lossless:
        assert len(second.got) < 7
    else:
        assert second.got == [bytes([number]) * 3000 for number in range(100)]
        first.link.validate()
        second.link.validate()
