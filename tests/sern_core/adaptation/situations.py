"""What a link offers and is asked for, and controllers that choose for it."""

from sern_core.adaptation.cost import Ranges, Weights, profile
from sern_core.adaptation.model import (
    ClassDemand,
    Configuration,
    LinkState,
    Measurement,
    Prediction,
    Situation,
)
from sern_core.adaptation.policy import (
    Decision,
    Mmcf,
)
from sern_core.adaptation.predict import Grid
from sern_core.bodies.codecs import CodecProfile
from sern_core.vocabulary.types import PriorityClass

CONTROL, STATE, BULK = PriorityClass
RANGES = Ranges()
CODECS = {"lz4": CodecProfile(0.8, 300e6), "zstd": CodecProfile(0.6, 60e6)}
GRID = Grid.of(
    rates=[(1.0,), (1.0, 0.5), (1.0, 0.6, 0.4, 0.25, 0.1)],
    queues=[(1,), (1,), (1, 3)],
    codecs=("none", "lz4", "zstd"),
    redundancy=(0, 1),
)


def situation(capacity_bps: float | None = 4e6, *, loss: float = 0.0, rtt_s: float = 0.05) -> Situation:
    return Situation(
        (
            ClassDemand(CONTROL, 70.0, 140.0, 0.4, arrival_cv2=0.0, topics=2, protected=True),
            ClassDemand(STATE, 12.0, 3400.0, 0.5, cv2=1.0, arrival_cv2=0.0, topics=2, codecs=CODECS),
            ClassDemand(BULK, 10.0, 42000.0, 1.0, arrival_cv2=0.0, topics=2, needed=0.4, codecs=CODECS),
        ),
        LinkState(capacity_bps, rtt_s, loss),
    )


def as_measured(prediction: Prediction, *, ratios: dict[PriorityClass, float] | None = None) -> Measurement:
    """An interval that came out exactly as predicted."""
    return Measurement(
        prediction.latency_s,
        prediction.unreliability,
        prediction.compute,
        prediction.bandwidth_bps,
        saturated=False,
        ratios=ratios or {},
    )


def controller(
    weights: Weights | None = None,
    *,
    grid: Grid = GRID,
    ranges: Ranges = RANGES,
    floors: tuple[float, ...] = (0.0, 0.0, 0.0),
    initial: Configuration | None = None,
) -> Mmcf:
    weights = weights or profile("teleoperation")
    return Mmcf(grid, weights=weights, ranges=ranges, floors=floors, initial=initial)


def predicted(decision: Decision) -> Prediction:
    assert decision.prediction is not None
    return decision.prediction
