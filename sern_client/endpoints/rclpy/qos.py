"""Quality of service: what ROS 2 publishers offer, what follows for ours, who does not match whom."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sern_core.vocabulary.message import TopicInfo

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

READER_DEPTH: Final = 100
"""The depth of our subscriptions: what may wait while the executor's thread is behind."""
WRITER_DEPTH: Final = 10
"""How many messages a publisher keeps where the stream names no depth, as ROS 2 does."""
_NEVER_NS: Final = 1 << 62
"""Durations from here on are none: middlewares say infinity in several ways, some of them 0."""


@dataclass(frozen=True, slots=True)
class Offer:
    """The policies of one publisher or subscriber as far as they matter here. `depth` None: the middleware does not
    tell others."""

    reliable: bool
    latched: bool
    depth: int | None = None
    lifespan_s: float | None = None
    deadline_s: float | None = None


def read(profile: "QoSProfile") -> Offer:
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy

    return Offer(
        reliable=profile.reliability is not ReliabilityPolicy.BEST_EFFORT,
        latched=profile.durability is DurabilityPolicy.TRANSIENT_LOCAL,
        depth=profile.depth if profile.history is HistoryPolicy.KEEP_LAST and profile.depth > 0 else None,
        lifespan_s=_seconds(profile.lifespan.nanoseconds),
        deadline_s=_seconds(profile.deadline.nanoseconds),
    )


def reader_for(offers: Collection[Offer]) -> Offer:
    """What to ask for so that each of these publishers matches: what the least of them offers."""
    return Offer(
        reliable=bool(offers) and all(offer.reliable for offer in offers),
        latched=bool(offers) and all(offer.latched for offer in offers),
        depth=max([READER_DEPTH, *(offer.depth or 0 for offer in offers)]),
    )


def writer_for(info: TopicInfo) -> Offer:
    """What a stream that comes in is offered with. Reliable always: that matches subscribers that ask for it, and those
    that do not get the same."""
    return Offer(reliable=True, latched=info.latched, depth=info.depth or WRITER_DEPTH, deadline_s=info.deadline_s)


def matches(offered: Offer, asked: Offer) -> bool:
    return (
        (offered.reliable or not asked.reliable)
        and (offered.latched or not asked.latched)
        and (asked.deadline_s is None or (offered.deadline_s is not None and offered.deadline_s <= asked.deadline_s))
    )


def profile(policies: Offer) -> "QoSProfile":
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    made = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=policies.depth or WRITER_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if policies.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if policies.latched else DurabilityPolicy.VOLATILE,
    )
    if policies.deadline_s is not None:
        made.deadline = Duration(nanoseconds=round(policies.deadline_s * 1e9))
    return made


def _seconds(duration_ns: int) -> float | None:
    return duration_ns / 1e9 if 0 < duration_ns < _NEVER_NS else None
