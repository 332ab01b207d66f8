"""What one decision of the scheduler costs, beside rescoring every pending message, in one run.

A decision is everything the link asks of the scheduler for one fragment: `pick`, `charge`, and `offer` of what is
pending in the channel afterwards. All topics are of one class and always have a message, sizes are log-uniform between
60 B and 60 kB, and the winner's next message replaces it each time: the case that no cached choice can shorten.
Rescoring is bare: it knows no classes, floors or bucket, so that at few topics it has less to do than a decision here.
`single` is a lone topic whose message comes and goes: `offer`, `pick`, `charge`, `withdraw`. All is CPU time;
a decision is held against what a bare forwarder takes for the datagram that it is about (`benchmarks.reference`).
"""

import argparse
import math
import sys
from collections.abc import Callable
from random import Random
from time import process_time

from benchmarks.common import Report, interleaved, main, pin_cpu
from benchmarks.reference import reach_forwarding
from sern_core.stream.scheduler import Scheduler
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import PriorityClass

COUNTS = (10, 100, 1000)
STEP_S = 1e-3  # time between decisions: 1200 bytes at 9.6 Mbit/s
NBYTES = 1200
BULK = PriorityClass.BULK
DECISION_LIMIT = 0.5  # by forwarding one datagram


class Rescoring:
    """The peer: the paper's eq. (priority_score) over everything pending, at each choice."""

    def __init__(self, params: SchedulerParams) -> None:
        self._params = params
        self._pending: dict[int, tuple[float, float, float]] = {}

    def offer(self, channel_id: int, *, weight: float, size_bytes: float, since_s: float) -> None:
        self._pending[channel_id] = (weight, size_bytes, since_s)

    def pick(self, *, now: float) -> int:
        eta, epsilon_bytes, a_max_s = self._params.eta, self._params.epsilon_bytes, self._params.a_max_s
        best, highest = -1, -math.inf
        for channel_id, (weight, size_bytes, since_s) in self._pending.items():
            age_s = now - since_s
            score = weight * (1.0 + eta * (age_s if age_s < a_max_s else a_max_s)) / (size_bytes + epsilon_bytes)
            if score > highest:
                best, highest = channel_id, score
        return best


def sizes(count: int) -> list[float]:
    random = Random(count)
    return [float(round(math.exp(random.uniform(math.log(60), math.log(60_000))))) for _ in range(count)]


def full_scheduler(size_bytes: list[float]) -> Scheduler:
    scheduler = Scheduler(SchedulerParams(), now=0.0)
    scheduler.set_rate(NBYTES * 8.0 / STEP_S, now=0.0)
    for channel_id, size in enumerate(size_bytes):
        scheduler.offer(channel_id, priority=BULK, weight=1.0, size_bytes=size, since_s=0.0)
    return scheduler


def decisions(count: int, repeats: int) -> Callable[[], float]:
    size_bytes = sizes(count)
    scheduler = full_scheduler(size_bytes)
    now = 0.0

    def measure() -> float:
        nonlocal now
        pick, charge, offer = scheduler.pick, scheduler.charge, scheduler.offer
        started = process_time()
        for _ in range(repeats):
            now += STEP_S
            channel_id = pick(now=now)
            assert channel_id is not None
            charge(BULK, NBYTES, now=now)
            offer(channel_id, priority=BULK, weight=1.0, size_bytes=size_bytes[channel_id], since_s=now)
        return (process_time() - started) / repeats * 1e6

    return measure


def picks(count: int, repeats: int) -> Callable[[], float]:
    scheduler = full_scheduler(sizes(count))
    now = 0.0

    def measure() -> float:
        nonlocal now
        pick = scheduler.pick
        started = process_time()
        for _ in range(repeats):
            now += 1e-6  # ages stay below their limit
            pick(now=now)
        return (process_time() - started) / repeats * 1e6

    return measure


def rescored(count: int, repeats: int, *, whole_decision: bool) -> Callable[[], float]:
    size_bytes = sizes(count)
    peer = Rescoring(SchedulerParams())
    for channel_id, size in enumerate(size_bytes):
        peer.offer(channel_id, weight=1.0, size_bytes=size, since_s=0.0)
    now = 0.0

    def measure() -> float:
        nonlocal now
        started = process_time()
        for _ in range(repeats):
            now += STEP_S
            channel_id = peer.pick(now=now)
            if whole_decision:
                peer.offer(channel_id, weight=1.0, size_bytes=size_bytes[channel_id], since_s=now)
        return (process_time() - started) / repeats * 1e6

    return measure


def single(priority: PriorityClass, repeats: int) -> Callable[[], float]:
    scheduler = Scheduler(SchedulerParams(), now=0.0)
    scheduler.set_rate(NBYTES * 8.0 / STEP_S, now=0.0)
    now = 0.0

    def measure() -> float:
        nonlocal now
        offer, pick, charge, withdraw = scheduler.offer, scheduler.pick, scheduler.charge, scheduler.withdraw
        started = process_time()
        for _ in range(repeats):
            now += STEP_S
            offer(1, priority=priority, weight=1.0, size_bytes=100.0, since_s=now)
            pick(now=now)
            charge(priority, 160, now=now)
            withdraw(1)
        return (process_time() - started) / repeats * 1e6

    return measure


def run(options: argparse.Namespace, report: Report) -> None:
    report.note(pin_cpu())
    rounds = 5 if options.quick else 25
    report.note(f"best of {rounds} interleaved rounds; {STEP_S * 1e3:g} ms between decisions")
    for count in COUNTS:
        slow = max(20, 20_000 // count)
        best = {
            name: min(values)
            for name, values in interleaved(
                {
                    "decision": decisions(count, 4_000),
                    "pick": picks(count, 4_000),
                    "rescored decision": rescored(count, slow, whole_decision=True),
                    "rescored pick": rescored(count, slow, whole_decision=False),
                },
                rounds,
            ).items()
        }
        case = f"{count} topics"
        report.row(case, "sern", decision_us=best["decision"], pick_us=best["pick"])
        report.row(case, "rescoring", decision_us=best["rescored decision"], pick_us=best["rescored pick"])
    for label, values in interleaved(
        {priority.name.lower(): single(priority, 4_000) for priority in (PriorityClass.CONTROL, BULK)}, rounds
    ).items():
        report.row(f"single {label}", "sern", cycle_us=min(values))

    few, many = COUNTS[0], COUNTS[-1]
    at_many = report.value(f"{many} topics", "sern", "decision_us")
    reach_forwarding(report, f"CPU of a decision at {many} topics", at_many, DECISION_LIMIT)
    report.reach(
        f"growth of a decision from {few} to {many} topics (log n)",
        at_many / report.value(f"{few} topics", "sern", "decision_us"),
        math.log(many) / math.log(few),
    )


if __name__ == "__main__":
    sys.exit(main("scheduler", run, description=__doc__.splitlines()[0] if __doc__ else None))
