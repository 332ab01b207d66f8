"""Packets that take less time than a link of the known rate needs to send them."""

from math import inf

from sern_core.path.congestion.parts import EASED_PACKETS, EASED_SPAN_S, EASED_SPANS, Eased

BYTES, RATE = 1200.0, 30e3  # 40 ms a packet
POSE_BYTES = 120.0
LINK_S = 0.005


class Noted:
    """Packets of a link that is known to carry `RATE`, every 0.1 s, and nothing queues."""

    def __init__(self) -> None:
        self.eased = Eased()
        self.now = 100.0

    def packet(self, took_s: float, nbytes: float = BYTES, rate: float = RATE) -> bool:
        """Whether one that took so long to send, and 5 ms each way, was the last that was needed."""
        self.now += 0.1
        self.eased.note(self.now, LINK_S + took_s, 2 * LINK_S + took_s, nbytes, rate, queued=False)
        return self.eased.at_s == self.now


def test_a_round_trip_shorter_than_the_packet_is_long_needs_nothing_to_be_compared_with() -> None:
    noted = Noted()
    assert [noted.packet(0.001) for _ in range(EASED_PACKETS)] == [False] * (EASED_PACKETS - 1) + [True]
    assert not noted.packet(0.001), "and is told once"


def test_small_packets_between_them_which_can_tell_nothing_do_not_matter() -> None:
    noted = Noted()
    for _ in range(EASED_PACKETS - 1):
        assert not noted.packet(0.001)
        assert not any(noted.packet(0.0, POSE_BYTES) for _ in range(20))
    assert noted.packet(0.001)


def test_of_another_rate_they_say_nothing() -> None:
    noted = Noted()
    assert not any(noted.packet(0.001) for _ in range(EASED_PACKETS - 1))
    assert not any(noted.packet(BYTES / (2 * RATE), rate=2 * RATE) for _ in range(100))
    assert noted.eased.at_s == -inf


def test_a_link_that_carries_what_it_is_known_to_never_eases() -> None:
    noted = Noted()
    assert not any(noted.packet(BYTES / RATE) for _ in range(1000))


def test_where_the_round_trip_is_long_the_least_delay_of_late_tells() -> None:
    noted = Noted()
    for _ in range(round(10 * EASED_SPAN_S * (EASED_SPANS + 2))):
        assert not noted.packet(POSE_BYTES / RATE, POSE_BYTES)
    assert [noted.packet(0.0, POSE_BYTES) for _ in range(EASED_PACKETS)][-1]
