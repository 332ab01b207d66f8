"""What the paper prints: its tables and the figures in its text, by the labels of its source."""

from collections.abc import Mapping
from typing import Final, NamedTuple

RUNS: Final = 20
"""Trials a mode, and runs a load level."""


class Mode(NamedTuple):
    """A row of tab:baselines: success in %, with what is printed behind it, seconds to the goal, interventions."""

    success_percent: float
    deviation_percent: float
    low_percent: float
    high_percent: float
    time_s: float
    time_deviation_s: float
    interventions: float


MODES: Final[Mapping[str, Mode]] = {
    "Real Only": Mode(85.0, 7.5, 80.9, 89.1, 124.2, 18.6, 1.3),
    "Sim Only": Mode(70.0, 10.3, 63.5, 76.5, 109.7, 15.2, 1.9),
    "SERN": Mode(95.0, 5.0, 92.2, 97.8, 98.5, 12.4, 0.4),
}


class Cost(NamedTuple):
    """A row of tab:mmcf_breakdown."""

    latency: float
    reliability: float
    compute: float
    bandwidth: float
    total: float


POLICIES: Final = {
    "Fixed Throughput": "fixed_throughput",
    "Fixed Reliability": "fixed_reliability",
    "MMCF": "mmcf",
}
"""The paper's names of policies, and ours."""

BREAKDOWN: Final[Mapping[str, Mapping[str, Cost]]] = {
    "teleoperation": {
        "Fixed Throughput": Cost(0.18, 0.78, 0.44, 0.68, 0.43),
        "Fixed Reliability": Cost(0.34, 0.95, 0.58, 0.82, 0.56),
        "MMCF": Cost(0.21, 0.91, 0.41, 0.52, 0.39),
    },
    "mapping": {
        "Fixed Throughput": Cost(0.24, 0.80, 0.36, 0.49, 0.38),
        "Fixed Reliability": Cost(0.42, 0.97, 0.63, 0.88, 0.63),
        "MMCF": Cost(0.27, 0.93, 0.33, 0.36, 0.32),
    },
}
"""tab:mmcf_breakdown, whose totals are tab:mmcf_eval."""


class Gap(NamedTuple):
    """A row of tab:sync_summary: setting, method, and what is printed."""

    setting: str
    method: str
    position: str
    rotation: str


GAPS: Final = (
    Gap("moderate delay and loss", "SERN", "< 5 cm", "< 2°"),
    Gap("blackout 30 s", "fixed-gain PD", "> 20 cm", "> 3°"),
    Gap("blackout 30 s", "SERN", "≈ 5 cm", "< 3°"),
)

BEGIN_S, END_S = 2.0, 8.0
"""fig:runtime_reconfig_demo: when the third stream comes and goes."""
DETECTED_S: Final = 1.2
FORWARDED_S: Final = 0.8
"""After it was detected."""
REMOVED_S: Final = 1.0
"""After it has ended."""

OFFSET_CM: Final = 2.3
PATCHES_HZ: Final = 10.0
LATENCY_SAVED_PERCENT: Final = (15.0, 25.0)
LOAD_SAVED_PERCENT: Final = 15.0
MOST_LATENCY: Final = 1.0 - LATENCY_SAVED_PERCENT[0] / 100
MOST_LOAD: Final = 1.0 - LOAD_SAVED_PERCENT / 100
"""The shares of what a standard ROS setup takes that SERN may take for the claim to hold."""
LEVELS: Final = (2, 3, 5)
"""fig:aurora_comparison_agents: robots, as replayed point clouds."""
