"""One direction of a hop at work: when does a packet arrive, if at all?

`Link.send` decides at the moment of sending everything that happens to a packet, because nothing that happens later
can change it except a broken connection, which the network handles. So a lost packet costs no event at all and a
delivered one costs exactly one.

All times here are integer nanoseconds of scenario time (zero is the start of the run, not a clock reading).
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import isfinite
from random import Random
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import UsageError
from sern_sim.models import SEGMENT_BYTES, Jitter, LinkModel

NS: Final = 1_000_000_000
LOST: Final = -1
"""`Link.send` returns this for a packet that never arrives."""
NEVER: Final = 2**62
"""Later than any event (146 years)."""
LONGEST_STALL_NS: Final = 120 * NS
"""Linux's longest TCP retransmission timeout."""


def to_ns(time_s: float) -> int:
    return round(time_s * NS)


class LinkStats(NamedTuple):
    """Counters of one direction. Differences of two readings are meaningful: `later - earlier`.

    `sent` is what the port handed over, `carried` what crossed the bottleneck (overhead included, later losses too),
    `delivered` what the far port received (payload, duplicates included). For every packet
    sent + duplicate = delivered + lost + blackout + broken + queue_drops + under way.
    """

    elapsed_s: float
    sent_packets: int
    sent_bytes: int
    carried_bytes: int
    delivered_packets: int
    delivered_bytes: int
    lost_packets: int  # on the path, by loss or burst loss
    blackout_packets: int  # sent, queued or under way in a blackout (datagram mode)
    broken_packets: int  # under way when the connection broke, or sent to a node that is gone
    queue_drops: int
    duplicate_packets: int
    duplicate_bytes: int
    reordered_packets: int
    stalls: int  # losses as a stream sees them, retransmissions included
    capacity_bits: float  # what the link could have carried outside blackouts; inf when unlimited

    def minus(self, earlier: "LinkStats") -> "LinkStats":
        """What happened between two readings of the same link."""
        return LinkStats._make(mine - theirs for mine, theirs in zip(self, earlier, strict=True))

    @property
    def utilisation(self) -> float:
        """Share of the capacity that was used, 0 to 1, overhead counted as use; 0 when the rate is unlimited."""
        if not isfinite(self.capacity_bits) or self.capacity_bits <= 0.0:
            return 0.0
        return 8 * self.carried_bytes / self.capacity_bits

    @property
    def goodput_bps(self) -> float:
        """Payload that arrived, bits per second."""
        return 8 * self.delivered_bytes / self.elapsed_s if self.elapsed_s > 0.0 else 0.0


class Bottleneck:
    """When the link, or those that share it, have sent what was given to them."""

    __slots__ = ("busy_ns",)

    def __init__(self) -> None:
        self.busy_ns = 0


class Link:
    """The state of one direction: queue, rate, loss and order. `random` is this link's own.

    `beside`: another connection over the same path; its packets and ours leave in the order in which they came. Both
    models must be of the same rates, and a datagram's queue limit counts those of its own link.
    """

    __slots__ = (
        "_bottleneck",
        "_burst",
        "_burst_bad",
        "_carried_bytes",
        "_delay_ns",
        "_departures",
        "_down_end_ns",
        "_down_start_ns",
        "_draw",
        "_flap",
        "_gauss",
        "_jitter_ns",
        "_last_arrival_ns",
        "_loss",
        "_mean_loss",
        "_normal",
        "_path_ns",
        "_paths",
        "_plain",
        "_queue_packets",
        "_rate",
        "_rate_end_ns",
        "_rate_index",
        "_rates",
        "_reorder_ns",
        "_shared",
        "_sizes",
        "_stall_ns",
        "_window_ends",
        "_window_starts",
        "blackout_packets",
        "broken_packets",
        "delivered_bytes",
        "delivered_packets",
        "duplicate_bytes",
        "duplicate_packets",
        "lost_packets",
        "model",
        "queue_drops",
        "reordered_packets",
        "send",
        "sent_bytes",
        "sent_packets",
        "stalls",
        "twice",
    )

    def __init__(self, model: LinkModel, random: Random, beside: "Link | None" = None) -> None:
        if beside is not None and _schedule(beside.model) != _schedule(model):
            raise UsageError("links that share a bottleneck need the same rates, blackouts and flaps")
        self.model: LinkModel = model
        self.send: Callable[[int, int], int] = self._send_stream if model.streaming else self._send_datagram
        """`send(size_bytes, t_ns) -> arrival_ns`, or LOST. Calls come in order of time."""
        self.twice = False  # the packet just sent arrives twice, at the same time
        self._draw = random.random
        self._gauss = random.gauss
        self._delay_ns = to_ns(model.delay_s)
        self._jitter_ns = to_ns(model.jitter_s)
        self._normal = model.jitter is Jitter.NORMAL
        self._reorder_ns = to_ns(model.reorder_delay_s)
        self._stall_ns = 2 * self._delay_ns + to_ns(model.stall_s)
        self._loss = model.loss
        self._mean_loss = model.mean_loss
        self._burst = model.burst_loss
        self._burst_bad = False
        self._queue_packets = model.queue_packets
        # The random stages are skipped as a whole on a link that has none.
        self._plain = not (
            model.loss or model.burst_loss or model.jitter_s or model.reorder or model.duplicate or model.path_steps
        )
        self._paths = deque((to_ns(step.at_s), step) for step in model.path_steps)
        self._path_ns = self._paths[0][0] if self._paths else NEVER  # when delay and loss are others next

        # (from_ns, bits per second or 0 for unlimited), and the segment in force at the time of the last departure
        steps = [(0, model.rate_bps), *((to_ns(step.at_s), step.rate_bps) for step in model.rate_steps)]
        self._rates = [(at_ns, 0 if rate is None else round(rate)) for at_ns, rate in steps]
        self._seek_rate(0)

        self._flap = model.flap and tuple(to_ns(time_s) for time_s in model.flap)
        self._window_starts = [to_ns(window.start_s) for window in model.blackouts]
        self._window_ends = [to_ns(window.end_s) for window in model.blackouts]
        self._down_start_ns, self._down_end_ns = self.blackout_after(0)

        self._departures: deque[int] = deque()  # when each packet in the queue leaves it
        self._sizes: deque[int] = deque()  # and its bytes on the wire
        self._shared = beside is not None
        self._bottleneck: Bottleneck = beside._bottleneck if beside is not None else Bottleneck()
        if beside is not None:
            beside._shared = True
        self._last_arrival_ns = 0
        self._carried_bytes = 0
        self.sent_packets = self.sent_bytes = 0
        self.delivered_packets = self.delivered_bytes = 0
        self.lost_packets = self.blackout_packets = self.broken_packets = self.queue_drops = 0
        self.duplicate_packets = self.duplicate_bytes = self.reordered_packets = self.stalls = 0

    # ------------------------------------------------------------------ the path

    def _send_datagram(self, size_bytes: int, t_ns: int) -> int:
        self.sent_packets += 1
        self.sent_bytes += size_bytes
        self.twice = False
        if t_ns >= self._path_ns:
            self._change_path(t_ns)
        if t_ns >= self._down_end_ns:
            self._pass_blackout(t_ns)
        if t_ns >= self._down_start_ns:
            self.blackout_packets += 1
            return LOST
        wire_bytes = size_bytes + self.model.overhead_bytes
        departures = self._departures
        while departures and departures[0] <= t_ns:
            departures.popleft()
            self._carried_bytes += self._sizes.popleft()
        if len(departures) >= self._queue_packets:
            self.queue_drops += 1
            return LOST
        bottleneck = self._bottleneck
        start_ns = bottleneck.busy_ns if bottleneck.busy_ns > t_ns else t_ns
        departure_ns = self._serialise(start_ns, wire_bytes)
        bottleneck.busy_ns = departure_ns
        if departure_ns > t_ns:
            departures.append(departure_ns)
            self._sizes.append(wire_bytes)
        else:
            self._carried_bytes += wire_bytes
        arrival_ns = departure_ns + self._delay_ns
        if self._plain:
            if arrival_ns >= self._down_start_ns:
                self.blackout_packets += 1
                return LOST
            return arrival_ns
        return self._disturb(size_bytes, departure_ns - start_ns, departure_ns)

    def _disturb(self, size_bytes: int, took_ns: int, departure_ns: int) -> int:
        """The random stages of a datagram that the rate took `took_ns` for, each drawing only when it is on."""
        model = self.model
        arrival_ns = departure_ns + self._delay_ns
        if self._lose():
            self.lost_packets += 1
            return LOST
        if self._jitter_ns:
            arrival_ns += self._jitter()
        if model.reorder and self._draw() < model.reorder:
            arrival_ns = arrival_ns + self._reorder_ns if self._reorder_ns else departure_ns
            self.reordered_packets += 1
        else:
            arrival_ns = max(arrival_ns, self._last_arrival_ns + (took_ns if model.rate_after_jitter else 0))
            self._last_arrival_ns = arrival_ns
        twice = model.duplicate > 0.0 and self._draw() < model.duplicate
        if arrival_ns >= self._down_start_ns:
            self.blackout_packets += 1
            return LOST
        if twice:
            self.twice = True
            self.duplicate_packets += 1
            self.duplicate_bytes += size_bytes
        return arrival_ns

    def _send_stream(self, size_bytes: int, t_ns: int) -> int:
        self.sent_packets += 1
        self.sent_bytes += size_bytes
        if t_ns >= self._path_ns:
            self._change_path(t_ns)
        segments = 1 if size_bytes <= SEGMENT_BYTES else -(-size_bytes // SEGMENT_BYTES)
        wire_bytes = size_bytes + segments * self.model.overhead_bytes
        self._settle_queue(t_ns)
        bottleneck = self._bottleneck
        start_ns = bottleneck.busy_ns if bottleneck.busy_ns > t_ns else t_ns
        departure_ns = self._serialise_frozen(start_ns, wire_bytes)
        bottleneck.busy_ns = departure_ns
        self._departures.append(departure_ns)
        self._sizes.append(wire_bytes)
        path_ns = self._delay_ns
        if not self._plain:
            if self._jitter_ns:
                path_ns = max(0, path_ns + self._jitter())
            for _ in range(segments):
                if self._lose():
                    path_ns += self._stall()
        arrival_ns = departure_ns + path_ns
        down_start_ns, down_end_ns = self.blackout_after(departure_ns)
        while down_start_ns < arrival_ns:
            arrival_ns += down_end_ns - down_start_ns
            down_start_ns, down_end_ns = self.blackout_after(down_end_ns)
        arrival_ns = max(arrival_ns, self._last_arrival_ns)
        self._last_arrival_ns = arrival_ns
        return arrival_ns

    def send_nowhere(self, size_bytes: int, _t_ns: int) -> int:
        """A packet to a node that is gone."""
        self.sent_packets += 1
        self.sent_bytes += size_bytes
        self.twice = False
        self.broken_packets += 1
        return LOST

    def _serialise(self, start_ns: int, wire_bytes: int) -> int:
        """When the last bit leaves if the first one may at `start_ns`. `start_ns` never falls between calls."""
        if start_ns >= self._rate_end_ns:
            self._seek_rate(start_ns)
        work = wire_bytes * (8 * NS)  # bit · ns/s
        while self._rate:
            room = (self._rate_end_ns - start_ns) * self._rate
            if work <= room:
                return start_ns - (-work // self._rate)
            work -= room
            start_ns = self._rate_end_ns
            self._seek_rate(start_ns)
        return start_ns

    def _serialise_frozen(self, start_ns: int, wire_bytes: int) -> int:
        """The same for a stream, whose bytes stand still in a blackout."""
        down_start_ns, down_end_ns = self.blackout_after(start_ns)
        if start_ns >= down_start_ns:
            start_ns = down_end_ns
            down_start_ns, down_end_ns = self.blackout_after(start_ns)
        if start_ns >= self._rate_end_ns:
            self._seek_rate(start_ns)
        work = wire_bytes * (8 * NS)
        while self._rate:
            end_ns = min(self._rate_end_ns, down_start_ns)
            room = (end_ns - start_ns) * self._rate
            if work <= room:
                return start_ns - (-work // self._rate)
            work -= room
            start_ns = end_ns
            if start_ns == down_start_ns:
                start_ns = down_end_ns
                down_start_ns, down_end_ns = self.blackout_after(start_ns)
            if start_ns >= self._rate_end_ns:
                self._seek_rate(start_ns)
        return start_ns

    def _lose(self) -> bool:
        lost = False
        if self._burst is not None:
            # As netem: the state changes first, then the packet meets the new state.
            enter, leave, bad_loss, good_loss = self._burst
            self._burst_bad = self._draw() >= leave if self._burst_bad else self._draw() < enter
            chance = bad_loss if self._burst_bad else good_loss
            lost = chance > 0.0 and self._draw() < chance
        if self._loss and self._draw() < self._loss:
            lost = True
        return lost

    def _stall(self) -> int:
        """How long a lost segment holds the stream up. Retransmissions are so late that a burst is over by then, so
        they meet the mean loss."""
        again = self._mean_loss
        stall_ns, step_ns = 0, self._stall_ns
        while True:
            self.stalls += 1
            stall_ns += step_ns
            if self._draw() >= again:
                return stall_ns
            step_ns = min(2 * step_ns, LONGEST_STALL_NS)

    def _jitter(self) -> int:
        """A deviation of the delay, never making it negative."""
        spread_ns = self._jitter_ns
        if self._normal:
            deviation_ns = max(-3 * spread_ns, min(3 * spread_ns, round(self._gauss(0.0, spread_ns))))
        else:
            deviation_ns = round((2.0 * self._draw() - 1.0) * spread_ns)
        return max(deviation_ns, -self._delay_ns)

    # ------------------------------------------------------------------ schedules

    def _change_path(self, t_ns: int) -> None:
        """Delay and loss of what is sent at `t_ns` are the latest step's."""
        while t_ns >= self._path_ns:
            step = self._paths.popleft()[1]
            self._path_ns = self._paths[0][0] if self._paths else NEVER
            model = replace(self.model, loss=step.loss)
            self._delay_ns = to_ns(step.delay_s)
            self._stall_ns = 2 * self._delay_ns + to_ns(model.stall_s)
            self._loss, self._mean_loss = step.loss, model.mean_loss

    def blackout_after(self, t_ns: int) -> tuple[int, int]:
        """(start, end) of the first blackout that ends after `t_ns`; (NEVER, NEVER) when there is none."""
        if self._flap is not None:
            up_ns, down_ns, start_ns = self._flap
            turn = max(0, (t_ns - start_ns) // (up_ns + down_ns))
            end_ns = start_ns + (turn + 1) * (up_ns + down_ns)
            return end_ns - down_ns, end_ns
        index = bisect_right(self._window_ends, t_ns)
        if index == len(self._window_ends):
            return NEVER, NEVER
        return self._window_starts[index], self._window_ends[index]

    def long_blackout_after(self, t_ns: int, longer_than_ns: int) -> int:
        """When the first blackout longer than that, ending after `t_ns`, begins; NEVER when there is none."""
        while True:
            start_ns, end_ns = self.blackout_after(t_ns)
            if start_ns == NEVER or end_ns - start_ns > longer_than_ns:
                return start_ns
            if self._flap is not None:
                return NEVER
            t_ns = end_ns

    def _pass_blackout(self, t_ns: int) -> None:
        """A blackout is over: what the queue held when it began is gone, and the bottleneck is free."""
        self._settle_queue(self._down_start_ns)
        self.reset(self._down_start_ns)
        self._down_start_ns, self._down_end_ns = self.blackout_after(t_ns)

    def _seek_rate(self, t_ns: int) -> None:
        index = bisect_right(self._rates, t_ns, key=_step_time) - 1
        self._rate = self._rates[index][1]
        self._rate_end_ns = self._rates[index + 1][0] if index + 1 < len(self._rates) else NEVER

    # ------------------------------------------------------------------ state

    def reset(self, t_ns: int) -> None:
        """Forget what is queued or under way: the connection broke. The network counts and discards it."""
        self._settle_queue(t_ns)
        self._departures.clear()
        self._sizes.clear()
        bottleneck = self._bottleneck
        if not self._shared:  # the others' packets, and ours between them, keep their places
            bottleneck.busy_ns = min(bottleneck.busy_ns, t_ns)
        self._last_arrival_ns = min(self._last_arrival_ns, t_ns)
        self._seek_rate(bottleneck.busy_ns)

    def backlog_packets(self, t_ns: int) -> int:
        """Packets waiting for the bottleneck or passing it."""
        if not self.model.streaming and t_ns >= self._down_start_ns:
            return 0
        self._settle_queue(t_ns)
        return len(self._departures)

    def _settle_queue(self, t_ns: int) -> None:
        departures = self._departures
        while departures and departures[0] <= t_ns:
            departures.popleft()
            self._carried_bytes += self._sizes.popleft()

    def stats(self, t_ns: int) -> LinkStats:
        if not self.model.streaming and t_ns >= self._down_end_ns:
            self._pass_blackout(t_ns)
        self._settle_queue(t_ns if self.model.streaming else min(t_ns, self._down_start_ns))
        return LinkStats(
            elapsed_s=t_ns / NS,
            sent_packets=self.sent_packets,
            sent_bytes=self.sent_bytes,
            carried_bytes=self._carried_bytes,
            delivered_packets=self.delivered_packets,
            delivered_bytes=self.delivered_bytes,
            lost_packets=self.lost_packets,
            blackout_packets=self.blackout_packets,
            broken_packets=self.broken_packets,
            queue_drops=self.queue_drops,
            duplicate_packets=self.duplicate_packets,
            duplicate_bytes=self.duplicate_bytes,
            reordered_packets=self.reordered_packets,
            stalls=self.stalls,
            capacity_bits=self.model.capacity_bits(0.0, t_ns / NS),
        )


def _schedule(model: LinkModel) -> tuple[object, ...]:
    return model.rate_bps, model.rate_steps, model.blackouts, model.flap


def _step_time(step: tuple[int, int]) -> int:
    return step[0]
