"""What each candidate would have done over the capacities of late, for a link that does not hold still.

Queueing formulas are of a steady state. Where the capacity goes up and down within a few seconds, what waits at the end
of a bad moment is sent in the next good one, a large message begun in one ends in the other, and queues have not yet
filled before the moment has passed; a mean of two steady states has none of it. So what is offered is played over the
last seconds as they were, step by step: per class in order of priority, with λ the messages a second after thinning, S
their bits on the wire, c_k what the more urgent classes leave of step k, and K the bits that have room,

    V_k = min(K, max(0, V_{k−1} + λ·S·Δ − c_k))        bits that wait (Lindley's recursion for a fluid)
    G(t) = Σ c up to t;  a message that comes at t is through at G⁻¹(G(t) + V(t) + S·(1 + ρ/2))

which gives latency, lateness and drops for arrivals spread evenly over the steps. ρ/2 is the message that is found
being sent. The seconds after the last are taken to be like the first of them again. What a good interval delivers
beyond what is needed does not make up for a bad one, so messages are counted interval by interval.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from statistics import fmean
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.adaptation.model import LinkState
from sern_core.adaptation.queueing import MIN_SHARE, Floats, Outcome, Service, arrives_whole
from sern_core.path.lanes import DATAGRAM_BYTES, OVERHEAD_BYTES

STEPS: Final = 30
"""The most points that are played; more are averaged."""
FRAGMENT_BITS: Final = 8.0 * (DATAGRAM_BYTES + OVERHEAD_BYTES)
MIN_BITS: Final = 1.0
"""That a step carries, so that time goes on."""


@dataclass(frozen=True, slots=True)
class CapacityPath:
    """Capacities of equal steps of `step_s` seconds, bits a second, the oldest first; `windows` intervals, over each of
    which latency and reliability are counted."""

    step_s: float
    capacities_bps: tuple[float, ...]
    windows: int

    @classmethod
    def of(cls, duration_s: float, capacities_bps: Sequence[float], windows: int) -> "CapacityPath":
        """Readings taken evenly over `duration_s`, averaged to at most STEPS."""
        count = len(capacities_bps)
        bounds = [count * i // min(count, STEPS) for i in range(min(count, STEPS) + 1)]
        means = [fmean(capacities_bps[low:high]) for low, high in pairwise(bounds)]
        return cls(duration_s / len(means), tuple(means), min(windows, len(means)))


def played(parts: Sequence[Service], link: LinkState, path: CapacityPath, latency_max_s: float) -> list[Outcome]:
    """What becomes of each class over the path; `parts` in the order of priority."""
    outcomes = []
    left = np.maximum(np.array([path.capacities_bps]) * path.step_s, MIN_BITS)  # bits a step, a row a variant
    variant: NDArray[np.int64] = np.zeros(len(parts[0].load) if parts else 0, dtype=np.int64)
    for number, part in enumerate(parts):
        # Candidates that treat this class and the more urgent ones alike are played once.
        keys = np.column_stack((variant, part.rate_hz, part.wire_bits, part.limit, part.encode_s, part.copies))
        first, same = _distinct(keys)
        left = left[variant[first]]
        lane = _Lane(left, part, first, path.step_s)
        found = _counted(lane, part.of(first), link, path, latency_max_s)
        whole = {field.name: getattr(found, field.name)[same] for field in fields(Outcome)}
        whole["latency_s"] = np.minimum(whole["latency_s"] + _blocked_s(parts[number + 1 :], path), latency_max_s)
        outcomes.append(Outcome(**whole))
        left = np.maximum(left - lane.served, MIN_SHARE * left)
        variant = same
    return outcomes


def _distinct(keys: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(the first row of each kind, the kind of each row) of a matrix; a third of what `np.unique` takes for rows."""
    text, width = keys.tobytes(), keys.itemsize * keys.shape[1]
    kinds: dict[bytes, int] = {}
    firsts: list[int] = []
    same = np.empty(len(keys), dtype=np.int64)
    for row in range(len(keys)):
        kind = kinds.setdefault(text[row * width : (row + 1) * width], len(kinds))
        if kind == len(firsts):
            firsts.append(row)
        same[row] = kind
    return np.array(firsts, dtype=np.int64), same


def _blocked_s(others: Sequence[Service], path: CapacityPath) -> Floats | float:
    """What the fragment of a less urgent class that is being sent adds to the wait, in the mean."""
    if not others:
        return 0.0
    capacity_bps = np.maximum(np.array([path.capacities_bps]), MIN_BITS / path.step_s)
    offered_bps = sum((part.rate_hz * part.wire_bits for part in others), np.zeros(len(others[0].load)))
    busy = np.minimum(offered_bps[:, None] / capacity_bps, 1.0)
    return np.asarray((0.5 * FRAGMENT_BITS * busy / capacity_bps).mean(axis=1))


def _counted(lane: "_Lane", part: Service, link: LinkState, path: CapacityPath, latency_max_s: float) -> Outcome:
    """The messages of one class, counted in the interval in which they are through, as `cost.measure` does."""
    demand, (rows, steps) = part.demand, lane.latency_s.shape
    latency_s = lane.latency_s + (link.rtt_s / 2.0 + part.encode_s + demand.prepare_s)[:, None]
    slack_s = np.maximum(demand.deadline_s - latency_s.mean(axis=1), 0.0)
    arrives, repair_s = arrives_whole(part, link, slack_s)
    through = 1.0 - lane.drop
    in_time = through * (latency_s <= demand.deadline_s)
    duration_s = steps * path.step_s
    through_s = (np.arange(steps) + 0.5) * path.step_s + latency_s
    window = (through_s % duration_s * (path.windows / duration_s)).astype(np.int64) % path.windows
    place = (window + path.windows * np.arange(rows)[:, None]).ravel()

    def by_window(values: Floats) -> Floats:
        counted = np.bincount(place, values.ravel(), minlength=rows * path.windows)
        return np.asarray(counted.reshape(rows, path.windows))

    delivered = by_window(through)
    mean_s = by_window(through * np.minimum(latency_s, demand.deadline_s)) / np.maximum(delivered, 1e-9)
    mean_s = np.where(delivered > 1e-6, np.minimum(mean_s + repair_s[:, None], latency_max_s), latency_max_s)
    total = np.maximum(through.sum(axis=1), 1e-9)
    # Waits are cut short by fresher messages, so when something is through is told from what was sent.
    firsts = np.ceil(np.arange(path.windows) * steps / path.windows).astype(np.int64)
    sent = np.add.reduceat(lane.served, firsts, axis=1)
    offered = part.rate_hz / np.maximum(part.kept, 1e-9) * part.wire_bits * (duration_s / path.windows)
    punctual = np.where(delivered > 1e-6, by_window(in_time) / np.maximum(delivered, 1e-9), 1.0)
    on_time = arrives[:, None] * sent / np.maximum(offered, 1e-9)[:, None] * punctual
    return Outcome(
        drop=lane.drop.mean(axis=1),
        late=1.0 - in_time.sum(axis=1) / total,
        latency_s=mean_s.mean(axis=1),
        on_time=np.minimum(on_time.mean(axis=1), 1.0),
        short=np.maximum(0.0, 1.0 - on_time / demand.needed).mean(axis=1),
        bandwidth_bps=lane.served.sum(axis=1) / duration_s,
    )


class _Lane:
    """One class with what the more urgent ones leave of each step, `left` in bits: rows are variants, columns steps.

    `first` are the candidates that stand for the variants. For messages that come in the middle of each step:
    `latency_s` until they are through, `drop` the share that finds no room; `served` are bits a step.
    """

    def __init__(self, left: Floats, part: Service, first: NDArray[np.int64], step_s: float) -> None:
        steps = left.shape[1]
        self._step_s = step_s
        self._carried = np.concatenate(
            (np.zeros((len(left), 1)), np.cumsum(np.concatenate((left, left), axis=1), axis=1)), axis=1
        )
        size, rate_hz, limit = part.wire_bits[first], part.rate_hz[first], part.limit[first]
        come = rate_hz * size * step_s
        room = (limit * part.demand.topics + 1.0) * size
        change = come[:, None] - left
        steps_of_waits = np.zeros((steps + 1, len(left)))  # a row a step: each is written whole
        columns = np.ascontiguousarray(change.T)
        for _ in range(2):  # the first round tells what waits when the second begins
            steps_of_waits[0] = steps_of_waits[steps]
            for step in range(steps):
                now = np.add(steps_of_waits[step], columns[step], out=steps_of_waits[step + 1])
                np.minimum(np.maximum(now, 0.0, out=now), room, out=now)
        waits = steps_of_waits.T
        over = np.maximum(waits[:, :-1] + change - room[:, None], 0.0)
        self.drop = np.minimum(over / np.maximum(come, 1e-9)[:, None], 1.0)
        self.served = waits[:, :-1] - waits[:, 1:] + come[:, None] - over
        ahead = 0.5 * (waits[:, :-1] + waits[:, 1:] + self.served / left * size[:, None])
        come_s = (np.arange(steps) + 0.5) * step_s
        # A queue that keeps the newest lets nothing wait for longer than its messages take to be overrun.
        oldest_s = limit * part.demand.topics / np.maximum(rate_hz, 1e-9)
        middle = 0.5 * (self._carried[:, :steps] + self._carried[:, 1 : steps + 1])
        begins_s = np.minimum(self._when(middle + ahead), come_s + oldest_s[:, None])
        self.latency_s = self._when(self._carried_until(begins_s) + size[:, None]) - come_s

    def _when(self, bits: Floats) -> Floats:
        """When so many bits have been carried; the end of the second round for what is not by then."""
        carried = self._carried
        rows, width = carried.shape
        base = np.arange(rows)[:, None] * (float(carried[:, -1].max()) + 1.0)
        wanted = np.minimum(bits, carried[:, -1:])
        place = np.searchsorted((carried + base).ravel(), (wanted + base).ravel()).reshape(bits.shape)
        place = np.clip(place - np.arange(rows)[:, None] * width, 1, width - 1)
        low = np.take_along_axis(carried, place - 1, axis=1)
        high = np.take_along_axis(carried, place, axis=1)
        return np.asarray((place - 1 + (wanted - low) / np.maximum(high - low, 1e-9)) * self._step_s)

    def _carried_until(self, at_s: Floats) -> Floats:
        """Bits carried until then."""
        width = self._carried.shape[1]
        position = np.minimum(at_s / self._step_s, width - 1.0)
        low = np.minimum(position.astype(np.int64), width - 2)
        before = np.take_along_axis(self._carried, low, axis=1)
        after = np.take_along_axis(self._carried, low + 1, axis=1)
        return np.asarray(before + (position - low) * (after - before))
