"""Parameters of the scheduler and of a hop, as frozen plain data: what the hot path sees of the configuration.

Every default of the configuration is written once, here or on `TopicSpec` (`message.py`), and the configuration models
take theirs from these dataclasses.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from math import inf

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import DEFAULT_RETENTION_S
from sern_core.vocabulary.types import Ordering


@dataclass(frozen=True, slots=True)
class SchedulerParams:
    """The paper's eq. (priority_score), P(m) = κ(t)[1 + η·a(m)] / (s(m) + ε), and the order built on it.

    Duty: all values finite, `eta` ≥ 0, `epsilon_bytes` > 0, `a_max_s` ≥ 0, `interval_s` > 0, `floor` in [0, 0.5),
    `class0_share` in (0, 1]; else UsageError.
    """

    ordering: Ordering = Ordering.CLASS
    """`class`: order by (class, −P) with fragments and floors; `paper`: Alg. prioritize as printed."""
    eta: float = 1.0
    """η, 1/s: one second of waiting doubles the score of a message. 0 is Smith's rule (no ageing)."""
    epsilon_bytes: float = 64.0
    """ε: keeps tiny messages from winning on size alone; about the overhead of one fragment on the wire."""
    a_max_s: float = 10.0
    """Age is clipped here, so that the ratio of two scores stays bounded."""
    interval_s: float = 0.05
    """Δt of the per-interval budget, min(B·Δt, W − in flight)."""
    floor: float = 0.10
    """Share of the link that each lower class keeps while more urgent classes are backlogged (0 = none)."""
    class0_share: float = 0.5
    """Token bucket of class 0: the share of the link it may take while others are backlogged."""

    def __post_init__(self) -> None:
        for name, ok in (
            ("eta", 0.0 <= self.eta < float("inf")),
            ("epsilon_bytes", 0.0 < self.epsilon_bytes < float("inf")),
            ("a_max_s", 0.0 <= self.a_max_s < float("inf")),
            ("interval_s", 0.0 < self.interval_s < float("inf")),
            ("floor", 0.0 <= self.floor < 0.5),
            ("class0_share", 0.0 < self.class0_share <= 1.0),
        ):
            if not ok:
                raise UsageError(f"SchedulerParams: {name} = {getattr(self, name)!r} is out of range")


class WindowAlgorithm(StrEnum):
    """Who decides how many bytes may be in flight."""

    HYBRID = "hybrid"  # by measured delay and rate: keeps the standing queue near a few milliseconds
    FIXED = "fixed"  # `fixed_bytes`, for experiments and for links whose capacity is known


@dataclass(frozen=True, slots=True)
class WindowParams:
    """The window of bytes in flight on one lane."""

    algorithm: WindowAlgorithm = WindowAlgorithm.HYBRID
    fixed_bytes: int = 25_000
    """W of algorithm `fixed`: 4 Mbit/s × 50 ms, the link of the measurements in the documentation."""
    variable_rate_queue_s: float | None = 0.01
    """The queue that algorithm `hybrid` keeps while the rate of the link swings; None: it follows no swings."""

    def __post_init__(self) -> None:
        if self.fixed_bytes < 1:
            raise UsageError(f"WindowParams: fixed_bytes = {self.fixed_bytes!r} must be at least 1")
        if self.variable_rate_queue_s is not None and not 0.0 < self.variable_rate_queue_s < inf:
            raise UsageError(f"WindowParams: variable_rate_queue_s = {self.variable_rate_queue_s!r} must be above 0")


class Redundancy(StrEnum):
    """h of the paper's eq. (config_vector): whether class control is sent twice over a lane that loses packets."""

    AUTO = "auto"  # while the lane loses more than one packet in 200
    ALWAYS = "always"
    OFF = "off"


@dataclass(frozen=True, slots=True)
class LinkParams:
    """What one hop needs besides the scheduler."""

    window: WindowParams = field(default_factory=WindowParams)
    fragment_bytes_max: int = 65_000
    """Fragments on the ZMQ lane are clamp(3 ms · B, 1200, this)."""
    stream_from_bps: float = 40e6
    """Data takes the ZMQ lane though datagrams pass while they carry so much over a short, clean path; inf: never."""
    heartbeat_timeout_s: float = 5.0
    """A peer that says nothing for so long is gone; its connection is closed and rebuilt."""
    retention_s: float = DEFAULT_RETENTION_S
    """How long a reliable message waits for delivery when its topic gives no `retention_s` of its own."""
    redundancy: Redundancy = Redundancy.AUTO
    """Second copies of class control, a few milliseconds behind the first; what arrives twice counts once."""
    max_message_bytes: int = 16 * 2**20
    """Larger messages are dropped with reason `too_large`; also the receiver's reassembly limit a message."""
    limits: PeerLimits = field(default_factory=PeerLimits)
    """What the peer may cost."""

    def __post_init__(self) -> None:
        for name, ok in (
            ("fragment_bytes_max", self.fragment_bytes_max >= 1200),
            ("stream_from_bps", self.stream_from_bps > 0.0),
            ("heartbeat_timeout_s", 0.0 < self.heartbeat_timeout_s < float("inf")),
            ("retention_s", 0.0 < self.retention_s < float("inf")),
            ("max_message_bytes", self.max_message_bytes >= 1),
        ):
            if not ok:
                raise UsageError(f"LinkParams: {name} = {getattr(self, name)!r} is out of range")
