"""Parts of the queueing formulas: what one class asks of the link, what overruns a queue, what comes too late."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.adaptation.model import ClassDemand, LinkState
from sern_core.path.lanes import DATAGRAM_BYTES, OVERHEAD_BYTES

Floats = NDArray[np.float64]

REPAIR_S: Final = 0.02
"""What a lost fragment waits beyond a round trip until it is sent again."""
MIN_VARIABILITY: Final = 0.25
MIN_SHARE: Final = 1e-3


@dataclass(slots=True)
class Service:
    """What one class asks of the link, per candidate."""

    demand: ClassDemand
    kept: Floats
    rate_hz: Floats
    x_s: Floats
    load: Floats
    encode_s: Floats
    fragments: Floats
    copies: Floats
    limit: Floats
    """Messages that wait, a topic."""
    wire_bits: Floats

    def of(self, places: NDArray[np.int64]) -> "Service":
        """The same of some candidates."""
        arrays = {name: getattr(self, name)[places] for name in ARRAYS}
        return Service(self.demand, **arrays)


ARRAYS: Final = tuple(field.name for field in fields(Service) if field.name != "demand")


@dataclass(slots=True)
class Outcome:
    """What becomes of one class, per candidate, as in `predict`."""

    drop: Floats
    late: Floats
    latency_s: Floats
    on_time: Floats
    short: Floats
    """Share of what is needed that does not arrive in time."""
    bandwidth_bps: Floats


def overflow(u: Floats, k: Floats) -> Floats:
    """Share dropped by a queue of k places at load u, in a form that neither overflows nor divides by zero."""
    safe = np.where(np.abs(u - 1.0) < 1e-6, 1.0 + 1e-6, u)
    log_u = np.log(np.maximum(safe, 1e-12))
    # (1−u)·u^k/(1−u^{k+1}); above 1 both are divided by u^{k+1}.
    below = (1.0 - safe) * np.exp(np.minimum(k * log_u, 0.0)) / (1.0 - np.exp(np.minimum((k + 1.0) * log_u, -1e-12)))
    above = (1.0 - 1.0 / np.maximum(safe, 1.0)) / (1.0 - np.exp(np.minimum(-(k + 1.0) * log_u, -1e-12)))
    return np.asarray(np.clip(np.where(safe < 1.0, below, above), 0.0, 1.0))


def too_long(mean_s: Floats, limit_s: Floats, cv2: float) -> Floats:
    """Share of messages whose size alone takes longer than the limit, sizes log-normal about their mean."""
    if cv2 < 0.01:
        return np.asarray(np.where(mean_s > limit_s, 1.0, 0.0))
    sigma2 = np.log1p(cv2)
    ratio = np.log(np.maximum(limit_s, 1e-9) / np.maximum(mean_s, 1e-9)) + 0.5 * sigma2
    # The logistic curve is within 0.01 of the normal one.
    share = 1.0 / (1.0 + np.exp(np.clip(1.702 * ratio / np.sqrt(sigma2), -50.0, 50.0)))
    return np.asarray(np.where(limit_s <= 0.0, 1.0, share))


def arrives_whole(part: Service, link: LinkState, slack_s: Floats) -> tuple[Floats, Floats]:
    """Share of messages that arrive whole in time, and what repairs add to the mean latency."""
    if link.loss <= 0.0:
        return np.ones_like(slack_s), np.zeros_like(slack_s)
    demand = part.demand
    round_s = link.rtt_s + REPAIR_S
    # A lost message of one fragment is not repaired once its topic has a fresher one.
    period_s = demand.topics / np.maximum(part.rate_hz, 1e-9)
    repairable = demand.repaired & ((part.fragments > 1.0) | (period_s > round_s))
    sendings = np.where(repairable, 1.0 + np.floor(slack_s / round_s), 1.0)
    whole = (1.0 - link.loss ** (part.copies * sendings)) ** part.fragments
    first = (1.0 - link.loss**part.copies) ** part.fragments
    return whole, np.where(repairable, (1.0 - first) * round_s, 0.0)


def steady(parts: Sequence[Service], link: LinkState, capacity_bps: float, latency_max_s: float) -> list[Outcome]:
    """What becomes of each class on a link that stays as it is, by the formulas of `predict`."""
    fragment_s = 8.0 * (DATAGRAM_BYTES + OVERHEAD_BYTES) / capacity_bps
    shape = len(parts[0].load) if parts else 0
    sigma = np.zeros(shape)  # carried by the classes so far
    work = np.zeros(shape)  # Σ λ X² (c_a² + c_s²) of the classes so far
    longest_s = np.zeros(shape)
    outcomes = []
    for number, part in enumerate(parts):
        demand, x_s = part.demand, part.x_s
        left = np.maximum(1.0 - sigma, MIN_SHARE)
        places = part.limit * demand.topics
        variability = max(MIN_VARIABILITY, demand.arrival_cv2 + demand.cv2)
        # Topics that tick are out of step with each other: together they come almost at random.
        together = 1.0 + demand.cv2 if demand.topics > 1 else variability
        drop = overflow(part.load / left, (places + 1.0) * (2.0 / variability))
        carried = np.minimum(part.load * (1.0 - drop), np.maximum(1.0 - sigma, 0.0))
        drop = 1.0 - carried / np.maximum(part.load, 1e-12)
        before, sigma = sigma, np.minimum(sigma + carried, 1.0)
        work = work + part.rate_hz * (1.0 - drop) * x_s * x_s * together
        longest_s = np.maximum(longest_s, x_s)
        others = sum((later.load for later in parts[number + 1 :]), np.zeros(shape))
        w0_s = np.minimum(0.5 * work, longest_s) + 0.5 * fragment_s * np.minimum(others, 1.0 - sigma)
        service_s = x_s / left
        wait_s = w0_s / (np.maximum(1.0 - before, MIN_SHARE) * np.maximum(1.0 - sigma, MIN_SHARE))
        # A queue that keeps the newest is overrun: its oldest message is between q − 1 and q periods old.
        period_s = demand.topics / np.maximum(part.rate_hz, 1e-9)
        oldest_s = part.limit * period_s
        overrun_s = np.minimum(oldest_s - 0.5 * period_s, places * service_s) + fragment_s
        overrun = wait_s >= overrun_s
        wait_s = np.minimum(wait_s, overrun_s)
        fixed_s = link.rtt_s / 2.0 + part.encode_s + demand.prepare_s
        slack_s = demand.deadline_s - fixed_s - service_s
        tail = np.minimum(sigma, 1.0) * np.exp(-np.maximum(slack_s, 0.0) / np.maximum(wait_s, 1e-9))
        late = np.where(overrun, np.clip((oldest_s - slack_s) / period_s, 0.0, 1.0), tail)
        late = np.where(oldest_s + fragment_s <= slack_s, 0.0, late)
        late = np.maximum(late, too_long(service_s, demand.deadline_s - fixed_s, demand.cv2))
        arrives, repair_s = arrives_whole(part, link, np.maximum(slack_s - wait_s, 0.0))
        own_s = np.minimum(wait_s + service_s + fixed_s + repair_s, latency_max_s)
        on_time = part.kept * (1.0 - drop) * (1.0 - late) * arrives
        own_bps = carried * capacity_bps
        short = np.maximum(0.0, 1.0 - on_time / demand.needed)
        outcomes.append(Outcome(drop, late, own_s, on_time, short, own_bps))
    return outcomes
