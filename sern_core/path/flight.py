"""Sent and not yet acknowledged: the accounting of one lane in one direction.

The sender numbers every acknowledgement-eliciting datagram from 1. A packet is lost when one that is three numbers
later, and not more urgent, has been acknowledged (a network that heeds marks lets the urgent overtake), or when it is
older than max(100 ms, 2 srtt + 30 ms, RTO); on a stream lane (TCP) nothing is lost while
the connection lasts. Where packets came that were given up because later ones had come, the path changes their order,
and a packet has as long to come as those took, and a quarter more, up to a round trip (the reordering window of RACK,
RFC 8985, section 6.2). A round trip is measured from every acknowledgement that names a newer packet, whether or not
that packet was given up meanwhile: else a path slower than the first guess would never be measured.
The receiver's half says what to acknowledge and when: every second datagram (large ones of a stream lane
at most once in `ACK_SPACING_S`, small ones between relays every `SPARSE_ACK_DATAGRAMS`), at once on a gap or on class
control, else within `ACK_DELAY_S`.
"""

from collections import deque
from collections.abc import Callable
from math import inf
from typing import Any, Final, NamedTuple

from sern_core.path.clocksync import RttEstimator
from sern_core.vocabulary.types import CLASSES, PriorityClass

REORDER_THRESHOLD: Final = 3
MIN_LOSS_TIMEOUT_S: Final = 0.100
FIRST_LOSS_TIMEOUT_S: Final = 2.0
"""Before any round trip was measured: a path of 1 s and its first queue must not look like loss."""
REORDER_MARGIN: Final = 1.25
REORDER_MEMORY_S: Final = 10.0
"""A path that has kept the order for so long keeps it."""
STALL_MIN_S: Final = 0.5
STALL_RTTS: Final = 4.0
FIRST_STALL_S: Final = 3.0
"""No acknowledgement for so long: the path is gone; the last one before any round trip was measured."""
ACK_DELAY_S: Final = 0.010
ACK_SPACING_S: Final = 0.001
"""Least time between two acknowledgements of a stream, where nobody waits to learn what is lost. Below 1 Gbit/s two
full fragments take longer; above it each acknowledgement cost each end as much as half a message of 64 kB
(measured)."""
SPARSE_ACK_DATAGRAMS: Final = 8
"""Between relays each datagram is a put and a take of zenoh: of a robot's 500 messages/s the acknowledgements
were 260 datagrams of 700 (measured). `ACK_DELAY_S` bounds how long they wait, as it does for a lone datagram."""
SPACED_BYTES: Final = 16 * 1024
"""Smaller datagrams are those of a slow link, or of one whose rate its sender is about to find out."""
SACK_BITS: Final = 64
SACK_MASK: Final = (1 << SACK_BITS) - 1
MAX_WAITING_ACKS: Final = 32
"""Acknowledgements that wait to be sent because one alone does not name all that came at once: 2,000 datagrams."""

Items = list[Any]
"""What a packet carried, opaque here: handed back when the packet is acknowledged or lost."""


class Packet:
    """One packet in flight."""

    __slots__ = ("app_limited", "items", "nbytes", "number", "passed_s", "priority", "sent_s")

    def __init__(
        self, number: int, sent_s: float, nbytes: int, items: Items, app_limited: bool, priority: PriorityClass
    ) -> None:
        self.number = number
        self.sent_s = sent_s
        self.nbytes = nbytes
        self.items = items
        self.app_limited = app_limited
        self.priority = priority
        self.passed_s: float | None = None  # when it was first seen that later ones had come


class Flight:
    """The sender's half. `lossless` is True on stream lanes."""

    def __init__(self, *, lossless: bool) -> None:
        self.lossless = lossless
        self.inflight_bytes = 0
        self.packets: dict[int, Packet] = {}  # in order of number, which dicts keep
        self.next_number = 1
        self.highest_acked = 0
        self._acked_by_class = [0] * len(CLASSES)
        """The highest number that was acknowledged of a packet of a class, or of a less urgent one, by class."""
        self.reorder_s = 0.0
        """How long a packet may yet come after later ones; 0: the path keeps the order."""
        self._reordered_s = -inf  # when one came so late last
        self._given_up: dict[int, float] = {}  # when later ones had come, by number, of those that may come yet
        self._passed_due_s = inf  # when the first of those that wait is lost
        self.rtt = RttEstimator()
        self.waiting_since_s: float | None = None  # last acknowledgement, or the first packet since all were acked

    def sent(
        self,
        *,
        now: float,
        nbytes: int,
        items: Items,
        app_limited: bool,
        priority: PriorityClass = PriorityClass.STATE,
    ) -> None:
        """`priority`: the class by which the network knows the packet."""
        number = self.next_number
        if self.waiting_since_s is None:
            self.waiting_since_s = now
        self.packets[number] = Packet(number, now, nbytes, items, app_limited, priority)
        self.inflight_bytes += nbytes
        self.next_number = number + 1

    def acked(self, highest: int, sack: int, *, now: float) -> list[Packet]:
        """Packets that this acknowledgement newly covers, oldest first. Unknown numbers are old news."""
        if highest > self.highest_acked:
            self.highest_acked = highest
            self.waiting_since_s = now
        packets = self.packets
        result: list[Packet] = []
        if self.lossless:
            # A stream delivers in order: everything up to `highest` has arrived.
            for number, packet in packets.items():
                if number > highest:
                    break
                result.append(packet)
        else:
            for number, packet in packets.items():
                if number >= highest:
                    if number == highest:
                        result.append(packet)
                    break
                behind = highest - number - 1
                if behind < SACK_BITS and sack >> behind & 1:
                    result.append(packet)
        by_class = self._acked_by_class
        for packet in result:
            del packets[packet.number]
            self.inflight_bytes -= packet.nbytes
            for priority in range(packet.priority + 1):
                if packet.number > by_class[priority]:
                    by_class[priority] = packet.number
        if not packets:
            self.waiting_since_s = None
            self._passed_due_s = inf
        if self._given_up:
            self._look_for_late(highest, sack, now)
        return result

    def _look_for_late(self, highest: int, sack: int, now: float) -> None:
        """See whether packets that were given up have come after all."""
        for number, passed_s in list(self._given_up.items()):
            behind = highest - number - 1
            if behind >= SACK_BITS:
                del self._given_up[number]  # nothing tells of it any more
            elif behind >= 0 and sack >> behind & 1:
                del self._given_up[number]
                self._reordered_s = now
                self.reorder_s = max(self.reorder_s, min(REORDER_MARGIN * (now - passed_s), self.rtt.srtt_s))

    def loss_timeout_s(self) -> float:
        rtt = self.rtt
        if not rtt.samples:
            return FIRST_LOSS_TIMEOUT_S
        timeout_s, rto_s = 2 * rtt.srtt_s + 0.030, rtt.rto_s
        if timeout_s < MIN_LOSS_TIMEOUT_S:
            timeout_s = MIN_LOSS_TIMEOUT_S
        return rto_s if rto_s > timeout_s else timeout_s

    @property
    def oldest_s(self) -> float:
        """When the oldest packet in flight left; inf: there is none."""
        return next(iter(self.packets.values())).sent_s if self.packets else inf

    @property
    def latest_sent_s(self) -> float:
        """When the latest packet in flight left; -inf: there is none."""
        return next(reversed(self.packets.values())).sent_s if self.packets else -inf

    def stall_timeout_s(self) -> float:
        rtt = self.rtt
        if not rtt.samples:
            return FIRST_STALL_S
        timeout_s = STALL_RTTS * rtt.srtt_s
        return timeout_s if timeout_s > STALL_MIN_S else STALL_MIN_S

    def lost(self, *, now: float) -> list[Packet]:
        """Packets to give up, oldest first; they leave the flight."""
        if self.lossless or not self.packets:
            return []
        sent_before_s = now - self.loss_timeout_s()
        by_class = self._acked_by_class
        last = self.highest_acked - REORDER_THRESHOLD
        if now > self._reordered_s + REORDER_MEMORY_S:
            self.reorder_s = 0.0
        self._passed_due_s = inf
        gone = []
        for packet in self.packets.values():
            if packet.sent_s <= sent_before_s:
                gone.append(packet)
            elif packet.number <= by_class[packet.priority] - REORDER_THRESHOLD:
                if packet.passed_s is None:
                    packet.passed_s = now
                due_s = packet.passed_s + self.reorder_s
                if now >= due_s:
                    if self.highest_acked - packet.number <= SACK_BITS:
                        self._given_up[packet.number] = packet.passed_s
                    gone.append(packet)
                elif due_s < self._passed_due_s:
                    self._passed_due_s = due_s
            elif packet.number > last:
                break
        for packet in gone:
            del self.packets[packet.number]
            self.inflight_bytes -= packet.nbytes
        return gone

    def loss_deadline(self) -> float | None:
        """When the oldest packet is lost by time alone; a hair late, so that `lost` agrees whatever the rounding."""
        if self.lossless or not self.packets:
            return None
        due_s, passed_due_s = self.oldest_s + self.loss_timeout_s(), self._passed_due_s
        return (passed_due_s if passed_due_s < due_s else due_s) + 1e-6

    def abandon(self) -> list[Packet]:
        """The transport is gone: everything in flight comes back, oldest first. Numbers go on."""
        result = list(self.packets.values())
        self.packets.clear()
        self._given_up.clear()
        self._passed_due_s = inf
        self.inflight_bytes = 0
        self.waiting_since_s = None
        return result

    def validate(self, check: Callable[[bool, str], None]) -> None:
        check(self.inflight_bytes == sum(p.nbytes for p in self.packets.values()), "in-flight bytes do not add up")
        numbers = list(self.packets)
        check(numbers == sorted(numbers), "packets in flight are out of order")
        check(len(self._given_up) <= SACK_BITS, "too much is kept of packets that were given up")
        check(not self.packets or self.waiting_since_s is not None, "nobody waits for what is in flight")


class Ack(NamedTuple):
    """What an acknowledgement says: the highest number, which of those before it have arrived, the send stamp of the
    highest and when it arrived, and bytes by then."""

    highest: int
    mask: int
    echo_us: int
    received_us: int
    cum_bytes: int


class Arrivals:
    """The receiver's half: which numbers have arrived, and when to say so."""

    __slots__ = (
        "_lossless",
        "_told",
        "_waiting",
        "cum_bytes",
        "due",
        "echo_us",
        "every",
        "flushed_s",
        "highest",
        "mask",
        "received_us",
        "since_s",
        "spaced",
        "spacing_s",
        "unacked",
    )

    def __init__(self, *, lossless: bool = False, sparse: bool = False) -> None:
        self.spacing_s = ACK_SPACING_S if lossless else 0.0
        self.every = SPARSE_ACK_DATAGRAMS if sparse else 2
        self.highest = 0
        self.mask = 0  # bit i: highest-1-i has arrived
        self._lossless = lossless
        self._told = 0  # the highest number that an acknowledgement was made for
        self._waiting: deque[Ack] = deque(maxlen=MAX_WAITING_ACKS)
        self.echo_us = 0
        self.received_us = 0
        self.cum_bytes = 0
        self.unacked = 0
        self.due = False
        self.spaced = False  # only the spacing keeps them from being due
        self.since_s = 0.0
        self.flushed_s = -inf  # when the last acknowledgement left

    def arrived(self, number: int, stamp_us: int, nbytes: int, *, now: float) -> bool:
        """Note one numbered datagram. False: seen before, a duplicate made by the network."""
        ahead = number - self.highest
        if self.unacked and number - self._told > SACK_BITS and not self._lossless and ahead > 0:
            # With this one as the highest an acknowledgement would not name the first of those that wait for theirs,
            # which would be sent again: a busy end reads more than it can name at once.
            self._waiting.append(self._ack())
            self._told = self.highest
        if ahead == 1:
            self.mask = (self.mask << 1 | (1 if self.highest else 0)) & SACK_MASK
        elif ahead > 0:
            self.mask = (
                (self.mask << ahead | 1 << (ahead - 1)) & SACK_MASK if self.highest and ahead <= SACK_BITS else 0
            )
            self.due = True  # a gap
        else:
            bit = -ahead - 1
            if bit < 0 or (bit < SACK_BITS and self.mask >> bit & 1):
                return False
            if bit < SACK_BITS:
                self.mask |= 1 << bit
            self.due = True  # it fills a gap
        if ahead > 0:
            self.highest = number
            self.echo_us = stamp_us
            self.received_us = int(now * 1e6)
        self.cum_bytes += nbytes
        if not self.unacked:
            self.since_s = now
        self.unacked += 1
        if nbytes < SPACED_BYTES:
            if self.unacked >= self.every:
                self.due = True
        elif self.unacked >= 2:
            self.spaced = True
            if now >= self.flushed_s + self.spacing_s:
                self.due = True
        return True

    def deadline_s(self) -> float:
        """When what has arrived is to be acknowledged by time alone; something must have arrived."""
        delayed_s = self.since_s + ACK_DELAY_S
        return min(delayed_s, self.flushed_s + self.spacing_s) if self.spaced and not self.due else delayed_s

    def _ack(self) -> Ack:
        return Ack(self.highest, self.mask, self.echo_us, self.received_us, self.cum_bytes)

    @property
    def acks(self) -> int:
        """How many acknowledgements it takes to name what has arrived."""
        return len(self._waiting) + (self.unacked > 0)

    def take(self, most: int, now: float) -> list[Ack]:
        """The next acknowledgements, oldest first, `most` at once. They are sent now; `due` stays while there are
        more."""
        waiting = self._waiting
        if len(waiting) < most:
            found = [*waiting, self._ack()]
            self.flushed(now)
            return found
        self.due = True
        return [waiting.popleft() for _ in range(most)]

    def flushed(self, now: float) -> None:
        """All are acknowledged now."""
        self._waiting.clear()
        self._told = self.highest
        self.unacked = 0
        self.due = self.spaced = False
        self.flushed_s = now
