from enum import Enum

from rclpy.duration import Duration

class HistoryPolicy(Enum):
    KEEP_LAST = ...
    KEEP_ALL = ...

class ReliabilityPolicy(Enum):
    RELIABLE = ...
    BEST_EFFORT = ...

class DurabilityPolicy(Enum):
    TRANSIENT_LOCAL = ...
    VOLATILE = ...

class QoSProfile:
    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy
    lifespan: Duration
    deadline: Duration
    def __init__(
        self,
        *,
        history: HistoryPolicy = ...,
        depth: int = ...,
        reliability: ReliabilityPolicy = ...,
        durability: DurabilityPolicy = ...,
    ) -> None: ...
