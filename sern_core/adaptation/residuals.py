"""What experience says about the predictions.

The active configuration is predicted for what the last interval turned out to be, and compared with what was measured.
Per metric, g ← 0.7·g + 0.3·clip(ln(measured/predicted), ±0.5); predictions are multiplied by exp(g). Intervals that
filled the link and others err differently and are kept apart; computing cost is also kept apart by codec mode.

A compression ratio is seen directly when its mode is active: what the profile promised is corrected for that class and
mode before the queueing formulas are asked, since a wrong size is wrong in all of them.
"""

from collections.abc import Iterable
from math import exp, log
from typing import Final

import numpy as np

from sern_core.adaptation.model import ClassDemand, Measurement, Prediction
from sern_core.adaptation.predict import Factors
from sern_core.vocabulary.types import PriorityClass

KEEP: Final = 0.7
CLIP: Final = 0.5
RATIO_KEEP: Final = 0.4
"""Ratios are measured, not inferred: they are believed sooner."""
FLOORS: Final = {"latency": 1e-3, "unreliability": 0.02, "compute": 1e-3, "bandwidth": 1e3}
"""Added on both sides: nobody cares whether 0.1 % was predicted where 0.2 % came."""


class Residuals:
    """State of the corrections. Reset when the set of classes changes: they are another queue then."""

    def __init__(self) -> None:
        self._logs: dict[tuple[str, str, bool], float] = {}
        self._ratio_logs: dict[tuple[PriorityClass, str], float] = {}

    def reset(self) -> None:
        self._logs.clear()

    def learn_ratios(self, mode: str, demands: Iterable[ClassDemand], measurement: Measurement) -> None:
        """Compare the profiles' ratios with what the codec did to what was offered."""
        for demand in demands:
            measured = measurement.ratios.get(demand.priority)
            if measured is None or mode not in demand.codecs:
                continue
            key = (demand.priority, mode)
            error = log(measured / demand.codec(mode).ratio)
            self._ratio_logs[key] = RATIO_KEEP * self._ratio_logs.get(key, 0.0) + (1.0 - RATIO_KEEP) * error

    def learn(self, mode: str, predicted: Prediction, measurement: Measurement) -> None:
        """`predicted` is the bare prediction of the active configuration for the measured interval."""
        pairs = {
            "latency": (measurement.latency_s, predicted.latency_s),
            "unreliability": (measurement.unreliability, predicted.unreliability),
            "compute": (measurement.compute, predicted.compute),
            "bandwidth": (measurement.bandwidth_bps, predicted.bandwidth_bps),
        }
        for metric, (measured, expected) in pairs.items():
            floor = FLOORS[metric]
            error = log((measured + floor) / (expected + floor))
            key = (metric, mode if metric == "compute" else "", measurement.saturated)
            self._logs[key] = KEEP * self._logs.get(key, 0.0) + (1.0 - KEEP) * min(CLIP, max(-CLIP, error))

    def factor(self, metric: str, mode: str, *, saturated: bool) -> float:
        key = (metric, mode if metric == "compute" else "", saturated)
        return exp(self._logs.get(key, 0.0))

    def factors(self, modes: tuple[str, ...], *, saturated: bool) -> Factors:
        return Factors(
            latency=self.factor("latency", "", saturated=saturated),
            unreliability=self.factor("unreliability", "", saturated=saturated),
            compute=np.array([self.factor("compute", mode, saturated=saturated) for mode in modes]),
            bandwidth=self.factor("bandwidth", "", saturated=saturated),
        )

    @property
    def ratios(self) -> dict[tuple[PriorityClass, str], float]:
        """Factors of the compression ratios, by (class, mode)."""
        return {key: exp(value) for key, value in self._ratio_logs.items()}

    def snapshot(self) -> dict[str, float]:
        """The factors by name, as /api/mmcf tells them."""
        named = {
            f"{metric}{f'/{mode}' if mode else ''}/{'saturated' if saturated else 'unsaturated'}": exp(value)
            for (metric, mode, saturated), value in sorted(self._logs.items())
        }
        return named | {
            f"ratio/{priority.name.lower()}/{mode}": factor for (priority, mode), factor in sorted(self.ratios.items())
        }
