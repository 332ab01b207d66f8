"""What a link is like: plain data, shared by the virtual-time network, the shaping proxy and the lab.

A model describes one direction of a hop. Times inside a model (`RateStep.at_s`, `Window`) are scenario time: seconds
since the run began, never a clock reading. Packets pass the stages in this order:

    send -> queue (tail drop) -> rate -> loss -> delay, jitter -> reordering, duplication -> receive

so a packet that is lost on the path has already cost its share of the rate, as on a radio. (`tc netem` loses packets
before its rate stage; at 5 % loss that is the whole difference.)
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from math import ceil, floor, inf
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import UsageError

DEFAULT_QUEUE_PACKETS: Final = 100
"""Packets a bottleneck holds; small home and field routers are of this order."""
DEFAULT_STALL_S: Final = 0.2
"""Linux's smallest TCP retransmission timeout, on top of a round trip."""
DEFAULT_DISCONNECT_AFTER_S: Final = 5.0
"""A stream connection breaks when the path is gone for longer; ZMQ's heartbeat timeout as SERN sets it."""
DEFAULT_RECONNECT_S: Final = 0.5
"""Time from the return of the path to a working connection: ZMQ's longest reconnect interval as SERN sets it."""
SEGMENT_BYTES: Final = 1448
"""Payload of one TCP segment on a 1500-byte path; loss and overhead of a stream are counted per segment."""


class LinkMode(StrEnum):
    """`datagram`: UDP-like, everything can happen to a packet. `stream`: TCP-like, reliable and in order."""

    DATAGRAM = "datagram"
    STREAM = "stream"


class Jitter(StrEnum):
    """`uniform`: delay ± jitter_s. `normal`: jitter_s is the standard deviation, cut off at three of them."""

    UNIFORM = "uniform"
    NORMAL = "normal"


class RateStep(NamedTuple):
    """The rate is `rate_bps` from `at_s` on (None: unlimited)."""

    at_s: float
    rate_bps: float | None


class PathStep(NamedTuple):
    """Delay and loss are these from `at_s` on."""

    at_s: float
    delay_s: float
    loss: float


class Window(NamedTuple):
    """A blackout: the path is gone in [start_s, end_s)."""

    start_s: float
    end_s: float


class BurstLoss(NamedTuple):
    """Gilbert-Elliott loss, the parameters of netem's `loss gemodel`: probabilities per packet.

    `enter`: good to bad (p); `leave`: bad to good (r); `bad_loss`: loss in the bad state (1-h);
    `good_loss`: loss in the good state (1-k).
    """

    enter: float
    leave: float
    bad_loss: float = 1.0
    good_loss: float = 0.0

    @property
    def mean_loss(self) -> float:
        """The long-run share of packets lost."""
        bad = self.enter / (self.enter + self.leave) if self.enter else 0.0
        return bad * self.bad_loss + (1.0 - bad) * self.good_loss


class Flap(NamedTuple):
    """The path is up for `up_s`, down for `down_s`, and so on for ever, beginning (up) at `start_s`."""

    up_s: float
    down_s: float
    start_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LinkModel:
    """One direction of a hop. The default is a perfect wire.

    Jitter alone never reorders (a packet waits for the one before it, as in netem with a rate); reordering does:
    with probability `reorder` a packet is held back by `reorder_delay_s` and others overtake it; where that is 0 it
    overtakes those before it, as in netem, for it skips delay and jitter. `rate_after_jitter`: packets that waited for
    one that jitter held back come as fast as the rate allows, as in netem, and not together; so jitter costs capacity.

    `path_steps`: delay and loss change over time; in the virtual-time network only. A falling delay does not reorder.

    `stream` mode: queue limit, reordering and duplication do not apply; a lost segment instead stalls everything
    behind it for a round trip (2 · delay_s) plus `stall_s`, doubled when the retransmission is lost too. A blackout
    freezes bytes where they are; one longer than `disconnect_after_s` breaks the connection, which loses what was in
    flight and comes back `reconnect_s` after the path did.

    Raises UsageError naming the field when a value makes no sense.
    """

    rate_bps: float | None = None
    delay_s: float = 0.0
    jitter_s: float = 0.0
    jitter: Jitter = Jitter.NORMAL
    loss: float = 0.0
    burst_loss: BurstLoss | None = None
    rate_after_jitter: bool = False
    reorder: float = 0.0
    reorder_delay_s: float = 0.0
    duplicate: float = 0.0
    queue_packets: int = DEFAULT_QUEUE_PACKETS
    overhead_bytes: int = 0
    rate_steps: tuple[RateStep, ...] = ()
    path_steps: tuple[PathStep, ...] = ()
    blackouts: tuple[Window, ...] = ()
    flap: Flap | None = None
    mode: LinkMode = LinkMode.DATAGRAM
    stall_s: float = DEFAULT_STALL_S
    disconnect_after_s: float = DEFAULT_DISCONNECT_AFTER_S
    reconnect_s: float = DEFAULT_RECONNECT_S

    def __post_init__(self) -> None:
        for name in ("delay_s", "jitter_s", "reorder_delay_s", "stall_s", "disconnect_after_s", "reconnect_s"):
            if not 0.0 <= getattr(self, name) < inf:
                raise UsageError(f"{name} is {getattr(self, name)}: give a time of 0 s or more")
        for name in ("loss", "reorder", "duplicate"):
            _check_probability(name, getattr(self, name))
        if self.burst_loss is not None:
            for name, value in self.burst_loss._asdict().items():
                _check_probability(f"burst_loss.{name}", value)
            if self.burst_loss.enter and not self.burst_loss.leave:
                raise UsageError("burst_loss.leave is 0: a burst must end, give a probability above 0")
        if self.streaming and self.mean_loss >= 1.0:
            raise UsageError("loss is 1 in stream mode, so nothing would ever arrive: use a blackout")
        _check_rate("rate_bps", self.rate_bps)
        if self.queue_packets < 1:
            raise UsageError(f"queue_packets is {self.queue_packets}: give 1 or more")
        if self.overhead_bytes < 0:
            raise UsageError(f"overhead_bytes is {self.overhead_bytes}: give 0 or more")
        last_s = -inf
        for step in self.rate_steps:
            _check_rate("rate_steps", step.rate_bps)
            if not max(last_s, -0.0) <= step.at_s < inf or step.at_s == last_s:
                raise UsageError(f"rate_steps: the step at {step.at_s} s is out of order: list steps by rising time")
            last_s = step.at_s
        last_s = -inf
        for path in self.path_steps:
            _check_probability("path_steps.loss", path.loss)
            if self.streaming and path.loss >= 1.0:
                raise UsageError("path_steps: loss is 1 in stream mode, so nothing would ever arrive: use a blackout")
            if not 0.0 <= path.delay_s < inf:
                raise UsageError(f"path_steps: delay_s is {path.delay_s}: give a time of 0 s or more")
            if not max(last_s, -0.0) <= path.at_s < inf or path.at_s == last_s:
                raise UsageError(f"path_steps: the step at {path.at_s} s is out of order: list steps by rising time")
            last_s = path.at_s
        last_s = -inf
        for window in self.blackouts:
            if not max(last_s, -0.0) <= window.start_s < window.end_s < inf or window.start_s == last_s:
                raise UsageError(
                    f"blackouts: {window.start_s} to {window.end_s} s is empty, or meets the one before: list "
                    "blackouts by rising time with the path up in between"
                )
            last_s = window.end_s
        if self.flap is not None:
            if self.blackouts:
                raise UsageError("flap and blackouts exclude each other: give one of them")
            if not (0.0 < self.flap.up_s < inf and 0.0 < self.flap.down_s < inf and 0.0 <= self.flap.start_s < inf):
                raise UsageError("flap: give up_s and down_s above 0 s and start_s of 0 s or more")

    @property
    def streaming(self) -> bool:
        return self.mode is LinkMode.STREAM

    @property
    def mean_loss(self) -> float:
        """The long-run share of packets lost on the path, outside blackouts and without queue drops."""
        burst = self.burst_loss.mean_loss if self.burst_loss else 0.0
        return self.loss + burst - self.loss * burst

    def rate_bps_at(self, t_s: float) -> float | None:
        """The rate at scenario time `t_s`, whether or not the path is blacked out; None: unlimited."""
        rate_bps = self.rate_bps
        for step in self.rate_steps:
            if step.at_s > t_s:
                break
            rate_bps = step.rate_bps
        return rate_bps

    def next_blackout(self, t_s: float) -> Window | None:
        """The first blackout that ends after `t_s`: the one it is in, or the next one."""
        if self.flap is not None:
            up_s, down_s, start_s = self.flap
            period_s = up_s + down_s
            turn = max(0, floor((t_s - start_s) / period_s))
            if start_s + (turn + 1) * period_s <= t_s:
                turn += 1
            end_s = start_s + (turn + 1) * period_s
            return Window(end_s - down_s, end_s)
        for window in self.blackouts:
            if window.end_s > t_s:
                return window
        return None

    def blackout_at(self, t_s: float) -> bool:
        window = self.next_blackout(t_s)
        return window is not None and window.start_s <= t_s

    def next_change_s(self, t_s: float) -> float | None:
        """When the rate or the blackout state changes next, strictly after `t_s`; None: never again."""
        changes = [step.at_s for step in self.rate_steps if step.at_s > t_s]
        window = self.next_blackout(t_s)
        if window is not None:
            changes.append(window.start_s if window.start_s > t_s else window.end_s)
        return min(changes, default=None)

    def capacity_bits(self, from_s: float, to_s: float) -> float:
        """Bits (payload and overhead) that the link can carry in [from_s, to_s); inf when unlimited at any time."""
        total = 0.0
        while from_s < to_s:
            until_s = min(to_s, self.next_change_s(from_s) or inf)
            if not self.blackout_at(from_s):
                rate_bps = self.rate_bps_at(from_s)
                total += inf if rate_bps is None else rate_bps * (until_s - from_s)
            from_s = until_s
        return total

    def packets_in_delay(self, packet_bytes: int) -> int:
        """Packets of `packet_bytes` that are under way in `delay_s` at the highest rate of the schedule."""
        rates = [self.rate_bps, *(step.rate_bps for step in self.rate_steps)]
        highest_bps = max((rate for rate in rates if rate is not None), default=0.0)
        return ceil(highest_bps * (self.delay_s + self.jitter_s) / (8 * packet_bytes))

    def as_stream(self, *, disconnect_after_s: float | None = None, reconnect_s: float | None = None) -> "LinkModel":
        """The same path as a TCP-like connection sees it."""
        return replace(
            self,
            mode=LinkMode.STREAM,
            disconnect_after_s=self.disconnect_after_s if disconnect_after_s is None else disconnect_after_s,
            reconnect_s=self.reconnect_s if reconnect_s is None else reconnect_s,
        )


def _check_probability(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"{name} is {value}: give a probability from 0 to 1 (2 % is 0.02)")


def _check_rate(name: str, rate_bps: float | None) -> None:
    if rate_bps is not None and not 1.0 <= rate_bps < inf:
        raise UsageError(f"{name} is {rate_bps}: give bits per second, 1 or more; leave it out for no limit")


PERFECT: Final = LinkModel()
"""No rate, no delay, no loss."""
