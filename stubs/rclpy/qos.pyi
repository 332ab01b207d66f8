from enum import Enum

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
    def __init__(
        self,
        *,
        history: HistoryPolicy = ...,
        depth: int = ...,
        reliability: ReliabilityPolicy = ...,
        durability: DurabilityPolicy = ...,
    ) -> None: ...
