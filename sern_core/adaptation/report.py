"""What the adaptation did, as plain values: for /api/mmcf, for `sern explain`, and for tests."""

from typing import Any, Final

from sern_core.adaptation.adapter import HopAdapter, Step
from sern_core.adaptation.model import Candidate, Configuration, Prediction, Terms
from sern_core.adaptation.policy import Decision
from sern_core.vocabulary.types import CLASS_LABELS

CANDIDATES: Final = 6
"""How many of the best candidates are told, the chosen one among them; one of each group with the same prediction."""


def configuration_json(configuration: Configuration) -> dict[str, Any]:
    return {
        "rates": dict(zip(CLASS_LABELS, configuration.rates, strict=True)),
        "queues": dict(zip(CLASS_LABELS, configuration.queues, strict=True)),
        "codec": configuration.codec,
        "redundancy": configuration.redundancy,
        "summaries": None
        if configuration.summaries is None
        else dict(zip(CLASS_LABELS, configuration.summaries, strict=True)),
        "text": str(configuration),
    }


def terms_json(terms: Terms | None) -> dict[str, float] | None:
    return None if terms is None else {name: round(value, 4) for name, value in terms._asdict().items()}


def prediction_json(prediction: Prediction | None) -> dict[str, Any] | None:
    if prediction is None:
        return None
    return {
        "cost": round(prediction.cost, 4),
        "terms": terms_json(prediction.terms),
        "latency_s": round(prediction.latency_s, 5),
        "unreliability": round(prediction.unreliability, 4),
        "compute": round(prediction.compute, 5),
        "bandwidth_bps": round(prediction.bandwidth_bps),
        "classes": [
            {
                "class": part.label,
                "load": round(part.load, 4),
                "drop": round(part.drop, 4),
                "late": round(part.late, 4),
                "latency_s": round(part.latency_s, 5),
                "on_time": round(part.on_time, 4),
                "bandwidth_bps": round(part.bandwidth_bps),
            }
            for part in prediction.classes
        ],
    }


def candidate_json(candidate: Candidate) -> dict[str, Any]:
    return {
        "configuration": configuration_json(candidate.configuration),
        "cost": round(candidate.prediction.cost, 4),
        "terms": terms_json(candidate.prediction.terms),
        "obstacle": candidate.obstacle,
    }


def _distinct(decision: Decision, count: int) -> list[Candidate]:
    """The cheapest candidates that differ in what they come to, and the chosen one, cheapest first."""
    predictions = decision.predictions
    if predictions is None or decision.index is None:
        return []
    chosen = predictions.candidate(decision.index)
    shown = [chosen]
    seen = {_key(chosen)}
    for index in predictions.ranked():
        if len(shown) >= count:
            break
        candidate = predictions.candidate(index)
        if _key(candidate) not in seen:
            seen.add(_key(candidate))
            shown.append(candidate)
    return sorted(shown, key=lambda candidate: (bool(candidate.obstacle), candidate.prediction.cost))


def _key(candidate: Candidate) -> tuple[float, ...]:
    return tuple(round(term, 3) for term in candidate.prediction.terms)


def step_json(step: Step, *, candidates: int = CANDIDATES) -> dict[str, Any]:
    """One interval: what was measured in it, and what was decided at its end for the next one."""
    decision, link, measurement = step.decision, step.situation.link, step.measurement
    shown = _distinct(decision, candidates)
    return {
        "now_s": step.now,
        "link": {
            "capacity_bps": None if link.capacity_bps is None else round(link.capacity_bps),
            "rtt_s": round(link.rtt_s, 5),
            "loss": round(link.loss, 4),
        },
        "offered": [
            {
                "class": CLASS_LABELS[demand.priority],
                "rate_hz": round(demand.rate_hz, 3),
                "mean_bytes": round(demand.mean_bytes),
                "topics": demand.topics,
            }
            for demand in step.situation.classes
        ],
        "in_force": configuration_json(step.in_force),
        "measured": None
        if measurement is None
        else {
            "cost": None if step.cost is None else round(step.cost, 4),
            "terms": terms_json(step.terms),
            "bandwidth_full_bps": round(step.bandwidth_full_bps),
            "latency_s": round(measurement.latency_s, 5),
            "unreliability": round(measurement.unreliability, 4),
            "compute": round(measurement.compute, 5),
            "bandwidth_bps": round(measurement.bandwidth_bps),
            "saturated": measurement.saturated,
            "classes": [
                {
                    "class": CLASS_LABELS[part.priority],
                    "offered": part.offered,
                    "admitted": part.admitted,
                    "delivered": part.delivered,
                    "on_time": part.on_time,
                }
                for part in measurement.classes
                if part.offered
            ],
        },
        "chosen": configuration_json(decision.chosen),
        "predicted": prediction_json(decision.prediction),
        "switched": decision.switched,
        "reason": decision.reason,
        "weighed": 0 if decision.predictions is None else len(decision.predictions.configurations),
        "candidates": [candidate_json(candidate) for candidate in shown],
    }


def adapter_json(adapter: HopAdapter) -> dict[str, Any]:
    """The state of one hop's adaptation now."""
    return {
        "peer": adapter.link.peer,
        "policy": adapter.policy.name,
        "configuration": configuration_json(adapter.policy.active),
        "switches": adapter.switches,
        "corrections": {name: round(value, 4) for name, value in adapter.policy.corrections.items()},
    }
