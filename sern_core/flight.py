"""Sent and not yet acknowledged: the accounting of one lane in one direction.

The sender numbers every acknowledgement-eliciting datagram from 1. A packet is lost when three later ones have been
acknowledged, or when it is older than max(100 ms, 2 srtt + 30 ms); on a stream lane (TCP) nothing is lost while the
connection lasts. The receiver's half says what to acknowledge and when: every second datagram, at once on a gap or
on class control, else within `ACK_DELAY_S`.
"""

from collections.abc import Callable
from typing import Any, Final

from sern_core.clocksync import RttEstimator

REORDER_THRESHOLD: Final = 3
MIN_LOSS_TIMEOUT_S: Final = 0.100
ACK_DELAY_S: Final = 0.010
SACK_BITS: Final = 64

Items = list[Any]
"""What a packet carried, opaque here: handed back when the packet is acknowledged or lost."""


class Packet:
    """One packet in flight."""

    __slots__ = ("app_limited", "items", "nbytes", "number", "sent_s")

    def __init__(self, number: int, sent_s: float, nbytes: int, items: Items, app_limited: bool) -> None:
        self.number = number
        self.sent_s = sent_s
        self.nbytes = nbytes
        self.items = items
        self.app_limited = app_limited


class Flight:
    """The sender's half. `lossless` is True on stream lanes."""

    def __init__(self, *, lossless: bool) -> None:
        self.lossless = lossless
        self.inflight_bytes = 0
        self.packets: dict[int, Packet] = {}  # in order of number, which dicts keep
        self.next_number = 1
        self.rtt = RttEstimator()
        self.last_progress_s: float | None = None  # last acknowledgement, or first send after idle

    def sent(self, *, now: float, nbytes: int, items: Items, app_limited: bool) -> None:
        number = self.next_number
        if not self.packets:
            self.last_progress_s = now
        self.packets[number] = Packet(number, now, nbytes, items, app_limited)
        self.inflight_bytes += nbytes
        self.next_number = number + 1

    def acked(self, highest: int, sack: int, *, now: float) -> list[Packet]:
        """Packets that this acknowledgement newly covers, oldest first. Unknown numbers are old news."""
        packets = self.packets
        if not packets:
            return []
        if self.lossless:
            # A stream delivers in order: everything up to `highest` has arrived.
            done = []
            for number in packets:
                if number > highest:
                    break
                done.append(number)
        else:
            done = [
                number
                for number in packets
                if number == highest or (0 <= highest - number - 1 < SACK_BITS and sack >> (highest - number - 1) & 1)
            ]
        result = []
        for number in done:
            packet = packets.pop(number)
            self.inflight_bytes -= packet.nbytes
            result.append(packet)
        if result:
            self.last_progress_s = now
        return result

    def loss_timeout_s(self) -> float:
        srtt_s = self.rtt.srtt_s
        return max(MIN_LOSS_TIMEOUT_S, 2 * srtt_s + 0.030) if srtt_s is not None else 1.0

    def lost(self, highest_acked: int, *, now: float) -> list[Packet]:
        """Packets to give up, oldest first; they leave the flight."""
        if self.lossless or not self.packets:
            return []
        timeout_s = self.loss_timeout_s()
        gone = []
        for packet in self.packets.values():
            if packet.number <= highest_acked - REORDER_THRESHOLD or packet.sent_s + timeout_s <= now:
                gone.append(packet)
            elif packet.number > highest_acked:
                break
        for packet in gone:
            del self.packets[packet.number]
            self.inflight_bytes -= packet.nbytes
        return gone

    def loss_deadline(self) -> float | None:
        if self.lossless or not self.packets:
            return None
        return next(iter(self.packets.values())).sent_s + self.loss_timeout_s()

    def abandon(self) -> list[Packet]:
        """The transport is gone: everything in flight comes back, oldest first. Numbers go on."""
        result = list(self.packets.values())
        self.packets.clear()
        self.inflight_bytes = 0
        return result

    def validate(self, check: Callable[[bool, str], None]) -> None:
        check(self.inflight_bytes == sum(p.nbytes for p in self.packets.values()), "in-flight bytes do not add up")
        check(self.inflight_bytes >= 0, "negative bytes in flight")


class Arrivals:
    """The receiver's half: which numbers have arrived, and when to say so."""

    __slots__ = ("cum_bytes", "due", "echo_us", "highest", "mask", "received_us", "since_s", "unacked")

    def __init__(self) -> None:
        self.highest = 0
        self.mask = 0  # bit i: highest-1-i has arrived
        self.echo_us = 0
        self.received_us = 0
        self.cum_bytes = 0
        self.unacked = 0
        self.due = False
        self.since_s = 0.0

    def arrived(self, number: int, stamp_us: int, nbytes: int, *, now: float) -> bool:
        """Note one numbered datagram. False: seen before (a duplicate on the network)."""
        ahead = number - self.highest
        if ahead > 0:
            self.mask = ((self.mask << ahead) | (1 << (ahead - 1) if self.highest else 0)) & 0xFFFFFFFFFFFFFFFF
            if ahead > 1:
                self.due = True  # a gap
            self.highest = number
            self.echo_us = stamp_us
            self.received_us = int(now * 1e6)
        else:
            bit = -ahead - 1
            if bit < 0 or (bit < SACK_BITS and self.mask >> bit & 1):
                self.due = True  # our acknowledgement was lost: say it again
                return False
            if bit < SACK_BITS:
                self.mask |= 1 << bit
            self.due = True  # it fills a gap
        self.cum_bytes += nbytes
        if not self.unacked:
            self.since_s = now
        self.unacked += 1
        if self.unacked >= 2:
            self.due = True
        return True

    def deadline(self) -> float | None:
        """When an acknowledgement must leave; None if nothing is owed."""
        if self.due:
            return self.since_s
        return self.since_s + ACK_DELAY_S if self.unacked else None

    def flushed(self) -> None:
        self.unacked = 0
        self.due = False
