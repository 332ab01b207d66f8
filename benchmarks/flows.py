"""Flows of one hop in virtual time, without what a hop carries: a window, its packets and its acknowledgements.

A `Site` is a port that any number of flows share, so that they meet in one bottleneck. A `Flow` sends bulk (as much as
its window allows, while it is switched on) and a pose every 20 ms that passes the window; its `Sink` acknowledges as a
hop does. The flight and the arrivals are those of `sern_core.path.flight`. `Cubic` and `BbrLike` are small models of
what TCP would do in the place of an estimator, for company in a bottleneck.
"""

from collections import deque
from math import inf
from struct import Struct
from typing import Final, Protocol

from sern_core.path.capacity import AckSample, CapacityEstimator, Pacer
from sern_core.path.flight import ACK_DELAY_S, Arrivals, Flight
from sern_sim.hop import Hop
from sern_sim.models import LinkModel
from sern_sim.network import Network

OVERHEAD_BYTES: Final = 60
"""What a datagram costs on the wire beside its own bytes."""
DATAGRAM_BYTES: Final = 1200
FRAGMENT_TIME_S: Final = 0.003
MAX_FRAGMENT_BYTES: Final = 65_000
HEADER_BYTES: Final = 56
"""Datagram and fragment header; the rest of a bulk datagram is payload."""
POSE_BYTES: Final = 100
POSE_PERIOD_S: Final = 0.020
PROBE_INTERVAL_S: Final = 0.1
THIN_DATAGRAMS: Final = 32
"""Half of what an acknowledgement's map covers."""

_DATA: Final = Struct("!BBIQi")  # flow, kind, number, send stamp us, chunk (bulk) or -1 (pose)
_ACK: Final = Struct("!BBIQQQQQ")  # flow, kind, highest, sack, echo us, received us, cumulative bytes, send stamp us
_POSE: Final = Struct("!d")
_KIND_DATA: Final = 0
_KIND_ACK: Final = 1
_PAD: Final = bytes(MAX_FRAGMENT_BYTES + 100)
ACK_BYTES: Final = 54 - _ACK.size


class Endpoint(Protocol):
    """A sender or a sink at a site."""

    id: int

    def on_data(self, data: bytes, now: float) -> None: ...
    def poll(self, now: float) -> bytes | None: ...
    def deadline(self) -> float: ...
    def timeout(self, now: float) -> None: ...


class Site:
    """One side of the hop; a port of `sern_sim`."""

    def __init__(self, *, tick_s: float = 0.0) -> None:
        self.endpoints: list[Endpoint] = []
        self.by_key: dict[tuple[int, int], Endpoint] = {}
        self.tick_s = tick_s  # granularity of its timers
        self._turn = 0

    def add(self, endpoint: Endpoint, kind: int) -> None:
        self.endpoints.append(endpoint)
        self.by_key[endpoint.id, kind] = endpoint

    def receive(self, data: bytes, *, now: float) -> None:
        endpoint = self.by_key.get((data[0], data[1]))
        if endpoint is not None:
            endpoint.on_data(data, now)

    def next_datagram(self, *, now: float) -> bytes | None:
        count = len(self.endpoints)
        if count == 1:
            return self.endpoints[0].poll(now)
        for step in range(count):
            index = (self._turn + step) % count
            data = self.endpoints[index].poll(now)
            if data is not None:
                self._turn = index + 1  # the next one has its turn: flows share their sender's interface fairly
                return data
        return None

    def next_deadline(self) -> float | None:
        endpoints = self.endpoints
        deadline_s = endpoints[0].deadline() if len(endpoints) == 1 else inf
        if len(endpoints) > 1:
            deadline_s = min([endpoint.deadline() for endpoint in endpoints])
        if self.tick_s and deadline_s < inf:
            ticks = -(-deadline_s // self.tick_s)
            deadline_s = ticks * self.tick_s
        return deadline_s if deadline_s < inf else None

    def handle_timeout(self, *, now: float) -> None:
        for endpoint in self.endpoints:
            endpoint.timeout(now)

    def connected(self, *, now: float) -> None:
        """Flows begin by their own clock."""

    def disconnected(self, *, now: float) -> None:
        """A stream's connection broke; flows notice by silence."""


class Flow:
    """The sending end. Bulk flows in [start_s, stop_s) of the network's clock, and only then unless `on` changes."""

    def __init__(
        self,
        id_: int,
        estimator: CapacityEstimator,
        *,
        now: float,
        stream: bool = False,
        poses: bool = True,
        start_s: float = 0.0,
        stop_s: float = inf,
        max_fragment_bytes: int = MAX_FRAGMENT_BYTES,
    ) -> None:
        self.id = id_
        self.estimator = estimator
        self.flight = Flight(lossless=stream)
        self.pacer = Pacer()
        self.stream = stream
        self.start_s = start_s
        self.stop_s = stop_s
        self.max_fragment_bytes = max_fragment_bytes
        self.fragment_bytes = DATAGRAM_BYTES
        self.pose_due_s = now if poses else inf
        self._pose_s: float | None = None
        self._ping = False
        self._ping_due_s = now
        self._now = now
        self._chunk = 0
        self._again: deque[int] = deque()
        self.stalled = False
        self.probe_due_s = 0.0
        self.lost_packets = 0
        self.sent_packets = 0
        self.rate_trace: list[tuple[float, float]] = []
        self.window_trace: list[tuple[float, float]] = []

    def _bulk(self, now: float) -> bool:
        return self.start_s <= now < self.stop_s

    def poll(self, now: float) -> bytes | None:
        self._now = now
        if self.stalled and now < self.probe_due_s:
            return None
        if self.pose_due_s <= now:
            self._pose_s = self.pose_due_s
            self.pose_due_s += POSE_PERIOD_S * (int((now - self.pose_due_s) / POSE_PERIOD_S) + 1)
        if self._pose_s is not None:
            born_s, self._pose_s = self._pose_s, None
            return self._send(now, -1, HEADER_BYTES + POSE_BYTES, _POSE.pack(born_s))
        if self._ping:
            self._ping = False
            return self._send(now, -2, HEADER_BYTES, b"")
        flight = self.flight
        if (
            self.stalled
            or not self._bulk(now)
            or flight.inflight_bytes >= self.estimator.window_bytes
            or not self.pacer.ready(now)
        ):
            return None
        if self._again:
            chunk = self._again.popleft()
        else:
            chunk = self._chunk
            self._chunk += 1
        return self._send(now, chunk, self.fragment_bytes, b"")

    def _send(self, now: float, chunk: int, size: int, body: bytes) -> bytes:
        flight = self.flight
        nbytes = size + OVERHEAD_BYTES
        head = _DATA.pack(self.id, _KIND_DATA, flight.next_number, int(now * 1e6), chunk)
        inflight_bytes = flight.inflight_bytes + nbytes
        limited = self._bulk(now)
        flight.sent(now=now, nbytes=nbytes, items=[chunk], app_limited=not limited)
        self.estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
        waits = limited and inflight_bytes < self.estimator.window_bytes
        self.pacer.sent(now=now, nbytes=nbytes, pacing_bps=self.estimator.pacing_bps, waits=waits)
        self._ping_due_s = now + 0.5
        self.sent_packets += 1
        if self.stalled:
            self.probe_due_s = now + PROBE_INTERVAL_S
        return head + body + _PAD[: size - len(head) - len(body)]

    def on_data(self, data: bytes, now: float) -> None:
        _, _, highest, sack, echo_us, received_us, cum_bytes, stamp_us = _ACK.unpack_from(data)
        flight = self.flight
        newer = highest > flight.highest_acked
        packets = flight.acked(highest, sack, now=now)
        if newer:
            sent_s, received_s = echo_us * 1e-6, received_us * 1e-6
            rtt_s = max(1e-6, now - sent_s - (stamp_us * 1e-6 - received_s))
            flight.rtt.sample(rtt_s, now=now)
            newest = packets[-1] if packets and packets[-1].number == highest else None
            estimator = self.estimator
            estimator.on_ack(
                AckSample(
                    now,
                    rtt_s,
                    sum([packet.nbytes for packet in packets]),
                    flight.inflight_bytes,
                    received_s,
                    cum_bytes,
                    bool(packets) and packets[-1].app_limited,
                    sent_s,
                    newest.nbytes if newest is not None else 0,
                )
            )
            rate_bps = estimator.rate_bps
            if self.stream and rate_bps is not None:
                wanted = FRAGMENT_TIME_S * rate_bps / 8
                self.fragment_bytes = int(min(max(wanted, DATAGRAM_BYTES), self.max_fragment_bytes))
        if newer or packets:
            self.stalled = False
        self._find_losses(now)

    def _find_losses(self, now: float) -> None:
        for packet in self.flight.lost(now=now):
            self.estimator.on_loss(now=now, nbytes=packet.nbytes)
            self.lost_packets += 1
            if packet.items[0] >= 0:
                self._again.append(packet.items[0])

    def deadline(self) -> float:
        flight = self.flight
        deadline_s = min(self.pose_due_s, self._ping_due_s)
        if self.stalled:
            deadline_s = max(deadline_s, self.probe_due_s)
        else:
            loss_s = flight.loss_deadline()
            if loss_s is not None and loss_s < deadline_s:
                deadline_s = loss_s
            if flight.waiting_since_s is not None:
                deadline_s = min(deadline_s, flight.waiting_since_s + flight.stall_timeout_s())
            if self._now < self.stop_s and flight.inflight_bytes < self.estimator.window_bytes:
                bulk_s = max(self.pacer.due_s, self.start_s)
                if bulk_s < min(deadline_s, self.stop_s):
                    deadline_s = bulk_s
        return deadline_s

    def timeout(self, now: float) -> None:
        flight = self.flight
        self._find_losses(now)
        waiting_s = flight.waiting_since_s
        if not self.stalled and waiting_s is not None and now >= waiting_s + flight.stall_timeout_s():
            self.stalled = True
            self.probe_due_s = now
            self.estimator.on_stall(now=now)
        if now >= self._ping_due_s:
            self._ping = True
            self._ping_due_s = now + 0.5
        self.note(now)

    def note(self, now: float) -> None:
        """Remember what the estimator says, for the figures."""
        if not self.window_trace or now >= self.window_trace[-1][0] + 0.01:
            self.window_trace.append((now, self.estimator.window_bytes))
            self.rate_trace.append((now, self.estimator.rate_bps or 0.0))


class Sink:
    """The receiving end: acknowledges as a hop does, and keeps count of what is new."""

    def __init__(self, id_: int, *, clock_offset_s: float = 1000.0, thin: bool = False) -> None:
        self.id = id_
        self.thin = thin  # acknowledge by time, not every second datagram
        self.offset_s = clock_offset_s
        self.arrivals = Arrivals()
        self.poses: list[tuple[float, float]] = []
        """(born, delay), in the order of arrival."""
        self.payload: list[tuple[float, int]] = []
        """(arrival, payload bytes that are new)."""
        self._seen: set[int] = set()

    def on_data(self, data: bytes, now: float) -> None:
        _, _, number, stamp_us, chunk = _DATA.unpack_from(data)
        arrivals = self.arrivals
        if not arrivals.arrived(number, stamp_us, len(data) + OVERHEAD_BYTES, now=now + self.offset_s):
            return
        if self.thin:
            arrivals.due = arrivals.unacked >= THIN_DATAGRAMS
        if chunk >= 0:
            if chunk not in self._seen:
                self._seen.add(chunk)
                self.payload.append((now, len(data) - HEADER_BYTES))
        else:
            arrivals.due = not self.thin
            if chunk == -1:
                born_s = _POSE.unpack_from(data, _DATA.size)[0]
                self.poses.append((born_s, now - born_s))

    def poll(self, now: float) -> bytes | None:
        arrivals = self.arrivals
        local_s = now + self.offset_s
        if not arrivals.unacked or not (arrivals.due or local_s >= arrivals.since_s + ACK_DELAY_S - 1e-9):
            return None
        arrivals.flushed(now)
        stamp_us = int(local_s * 1e6)
        ack = _ACK.pack(
            self.id,
            _KIND_ACK,
            arrivals.highest,
            arrivals.mask,
            arrivals.echo_us,
            arrivals.received_us,
            arrivals.cum_bytes,
            stamp_us,
        )
        return ack + _PAD[:ACK_BYTES]

    def deadline(self) -> float:
        arrivals = self.arrivals
        return arrivals.since_s + ACK_DELAY_S - self.offset_s if arrivals.unacked else inf

    def timeout(self, now: float) -> None:
        """`poll` sees to it."""


class World:
    """Two sites, one hop; flows go from `a` to `b` unless they are `reverse`."""

    def __init__(self, forward: LinkModel, backward: LinkModel | None = None, *, seed: int = 1, tick_s: float = 0.0):
        self.network = Network(seed)
        self.a, self.b = Site(tick_s=tick_s), Site(tick_s=tick_s)
        self.forward = forward
        self.hop: Hop = self.network.join(self.a, None, self.b, None, forward, backward or forward)
        self.flows: list[Flow] = []
        self.sinks: list[Sink] = []

    def flow(
        self,
        estimator: CapacityEstimator,
        *,
        poses: bool = True,
        start_s: float = 0.0,
        stop_s: float = inf,
        reverse: bool = False,
        thin: bool = False,
    ) -> int:
        """Add a flow whose bulk runs in [start_s, stop_s) of the run; returns its index."""
        network = self.network
        index = len(self.flows)
        flow = Flow(
            index,
            estimator,
            now=network.now,
            stream=self.forward.streaming,
            poses=poses,
            start_s=network.start_s + start_s,
            stop_s=network.start_s + stop_s,
        )
        sink = Sink(index, thin=thin)
        near, far = (self.b, self.a) if reverse else (self.a, self.b)
        near.add(flow, _KIND_ACK)
        far.add(sink, _KIND_DATA)
        self.flows.append(flow)
        self.sinks.append(sink)
        return index

    def run(self, until_s: float) -> None:
        self.network.run_until(until_s)

    def poses_ms(self, from_s: float, to_s: float = inf, index: int = 0) -> list[float]:
        """Delays of the poses born in that part of the run, sorted, in ms."""
        start = self.network.start_s
        return sorted(1e3 * d for born, d in self.sinks[index].poses if start + from_s <= born < start + to_s)

    def goodput_bps(self, from_s: float, to_s: float, index: int = 0) -> float:
        """New bulk payload that arrived in that part of the run."""
        start = self.network.start_s
        return 8 * sum(n for t, n in self.sinks[index].payload if start + from_s <= t < start + to_s) / (to_s - from_s)

    def rates(self, index: int = 0) -> list[tuple[float, float]]:
        """(time of the run, estimated capacity in bit/s)."""
        return [(t - self.network.start_s, r) for t, r in self.flows[index].rate_trace]

    def windows(self, index: int = 0) -> list[tuple[float, float]]:
        return [(t - self.network.start_s, w) for t, w in self.flows[index].window_trace]


class Cubic(CapacityEstimator):
    """What a TCP with CUBIC (RFC 9438) would have in flight: slow start, cubic growth, 0.7 on a loss a round trip."""

    def __init__(self, *, segment_bytes: int = DATAGRAM_BYTES + OVERHEAD_BYTES) -> None:
        self._segment = segment_bytes
        self._window = 10.0 * segment_bytes
        self._threshold = inf
        self._w_max = 0.0
        self._epoch_s: float | None = None
        self._cut_s = -inf
        self._srtt_s = 0.1
        self._least_s = inf

    @property
    def window_bytes(self) -> float:
        return self._window

    @property
    def rate_bps(self) -> float | None:
        return None

    @property
    def rtprop_s(self) -> float | None:
        return self._least_s if self._least_s < inf else None

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        """Sending changes nothing."""

    def on_ack(self, sample: AckSample) -> None:
        self._srtt_s += (sample.rtt_s - self._srtt_s) / 8
        self._least_s = min(self._least_s, sample.rtt_s)
        if self._window < self._threshold:
            self._window += sample.acked_bytes
            return
        if self._epoch_s is None:
            self._epoch_s = sample.now
            self._w_max = max(self._w_max, self._window)
        segment = self._segment
        k = (max(0.0, self._w_max - self._window_at_cut) / segment / 0.4) ** (1 / 3)
        t = sample.now - self._epoch_s + self._srtt_s
        target = (0.4 * (t - k) ** 3) * segment + self._w_max
        reno = self._window_at_cut + 0.53 * segment * (sample.now - self._epoch_s) / self._srtt_s
        target = min(max(target, reno), 1.5 * self._window)
        if target > self._window:
            self._window += (target - self._window) * sample.acked_bytes / self._window

    _window_at_cut = 0.0

    def on_loss(self, *, now: float, nbytes: int) -> None:
        if now < self._cut_s + self._srtt_s:
            return
        self._cut_s = now
        self._w_max = self._window if self._window >= self._w_max else 0.85 * self._window
        self._window = max(2.0 * self._segment, 0.7 * self._window)
        self._window_at_cut = self._window
        self._threshold = self._window
        self._epoch_s = now

    def on_reset(self, *, now: float) -> None:
        """The models live on one connection."""

    def on_stall(self, *, now: float) -> None:
        self._threshold = max(2.0 * self._segment, self._window / 2)
        self._window = float(self._segment)


class BbrLike(CapacityEstimator):
    """BBR v1 in short: the greatest rate of ten rounds, and twice its product with the least RTT in flight."""

    CYCLE: Final = (1.25, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)

    def __init__(self, *, segment_bytes: int = DATAGRAM_BYTES + OVERHEAD_BYTES) -> None:
        self._segment = segment_bytes
        self._rates: deque[tuple[int, float]] = deque()
        self._round = 0
        self._round_end_s = 0.0
        self._mark: tuple[float, int] | None = None
        self._least_s = inf
        self._least_at_s = 0.0
        self._startup = True
        self._full = 0.0
        self._full_rounds = 0
        self._drain = False
        self._phase = 2
        self._phase_s = 0.0
        self._probe_until_s = 0.0

    def _rate(self) -> float:
        return max((rate for _, rate in self._rates), default=0.0)

    @property
    def _bdp(self) -> float:
        return self._rate() / 8 * (self._least_s if self._least_s < inf else 0.1)

    @property
    def window_bytes(self) -> float:
        if self._probe_until_s:
            return 4.0 * self._segment
        if not self._rates:
            return 10.0 * self._segment
        gain = 2.89 if self._startup else 2.0
        return max(4.0 * self._segment, gain * self._bdp)

    @property
    def pacing_bps(self) -> float | None:
        if not self._rates:
            return None
        gain = 2.89 if self._startup else 0.35 if self._drain else self.CYCLE[self._phase]
        return max(gain * self._rate(), 8e3)

    @property
    def rate_bps(self) -> float | None:
        return self._rate() or None

    @property
    def rtprop_s(self) -> float | None:
        return self._least_s if self._least_s < inf else None

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        """Sending changes nothing."""

    def on_ack(self, sample: AckSample) -> None:
        now = sample.now
        if sample.rtt_s <= self._least_s:
            self._least_s, self._least_at_s = sample.rtt_s, now
        elif now > self._least_at_s + 10.0 and not self._probe_until_s:
            self._probe_until_s = now + 0.2 + sample.rtt_s
            self._probe_least_s = inf
        if self._probe_until_s:
            self._probe_least_s = min(self._probe_least_s, sample.rtt_s)
            if now > self._probe_until_s:
                self._least_s, self._least_at_s = self._probe_least_s, now
                self._probe_until_s = 0.0
        sent_s = sample.sent_s if sample.sent_s is not None else now - sample.rtt_s
        if self._mark is None:
            self._mark = (sample.receiver_s, sample.cum_bytes)
            self._round_end_s = now
        elif sent_s >= self._round_end_s and sample.receiver_s > self._mark[0]:
            rate = 8 * (sample.cum_bytes - self._mark[1]) / (sample.receiver_s - self._mark[0])
            self._mark = (sample.receiver_s, sample.cum_bytes)
            self._round_end_s = now
            self._round += 1
            if not sample.app_limited or rate > self._rate():
                self._rates.append((self._round, rate))
            while len(self._rates) > 1 and self._rates[0][0] < self._round - 10:
                self._rates.popleft()
            if self._startup:
                if self._rate() > 1.25 * self._full:
                    self._full, self._full_rounds = self._rate(), 0
                else:
                    self._full_rounds += 1
                    if self._full_rounds >= 3:
                        self._startup, self._drain = False, True
        if self._drain and sample.inflight_bytes <= self._bdp:
            self._drain = False
            self._phase_s = now
        if not self._startup and not self._drain and now > self._phase_s + self._least_s:
            self._phase = (self._phase + 1) % len(self.CYCLE)
            self._phase_s = now

    def on_loss(self, *, now: float, nbytes: int) -> None:
        """BBR v1 does not mind."""

    def on_reset(self, *, now: float) -> None:
        """The models live on one connection."""

    def on_stall(self, *, now: float) -> None:
        self._mark = None
