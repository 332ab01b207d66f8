"""How much of a cellular link bulk gets while poses stay fresh, on links that were recorded, in virtual time.

The recordings say what LTE, UMTS and EV-DO links could deliver to a car that drives (`--data`). They are played in
steps of 0.1 s, with 25 ms each way and a queue that holds what it must. Bulk without end goes beside a pose of 100
bytes every 20 ms. `sern` is the real core, robot to relay, with clouds; `sern, not following` has
`link.window.variable_rate_queue_s: null`, `poses alone` no clouds. `hybrid`, `bbr-like` and `cubic` are windows
alone, as `benchmarks.flows` models a flow: that of `sern`, and two others beside it.

`used` is the share of what the link could carry that went over it; bulk's share is that of `sern` less that of `poses
alone`. Ages are of poses that arrived; in a gap of the link they are as long as it, whoever sends. A sender learns of a
fade one round trip late, and what it had under way by then waits for the fade to pass. `informed` shows what that alone
costs: it knows the rate and the queue of the link as they were one round trip ago, sends bytes and no packets, and
keeps the same queue.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.common import Report, main, medians, percentile
from benchmarks.flows import DATAGRAM_BYTES, HEADER_BYTES, OVERHEAD_BYTES, POSE_BYTES, BbrLike, Cubic
from benchmarks.flows import World as Flows
from benchmarks.recorded_links import CELLULAR, DELAY_S, SLOT_PACKET_BYTES, SLOT_S, STEP_SLOTS, read, recorded
from sern_core.path.capacity import CapacityEstimator
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.params import LinkParams, WindowParams
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec

QUEUE_S: Final = 0.010
"""The default of `link.window.variable_rate_queue_s`."""
POSE_HZ: Final = 50.0
BULK_SHARE: Final = (DATAGRAM_BYTES - HEADER_BYTES) / (DATAGRAM_BYTES + OVERHEAD_BYTES)
"""What of a datagram on the wire is a message's."""
SETTLED_S: Final = 2.0
"""Poses of the first seconds are left out, and those of the last, which may not have arrived."""
POSE, CLOUD = "/robot/odom", "/robot/points"
CLOUD_HZ: Final = 20.0
OFFERED: Final = (4.0, 3.7, 3.85, 4.15, 4.3)
"""Times the mean of the link: it must not be the load that leaves it idle. A figure of the real core is the median over
them, for which packets meet a fade is luck."""
LIMITS: Final = {"lte": 0.80, "umts": 0.65, "evdo": 0.65}
AGE_LIMIT: Final = 2.0
BACK: Final = LinkModel(delay_s=DELAY_S)


class Played(NamedTuple):
    """What became of a link. `used`: share of its bytes; `delivered`: the same of bulk that arrived whole."""

    used: float
    delivered: float
    ages_s: list[float]

    def row(self) -> dict[str, float]:
        return {
            "used_percent": 100 * self.used,
            "delivered_percent": 100 * self.delivered,
            "pose_p50_ms": 1e3 * percentile(self.ages_s, 0.5),
            "pose_p95_ms": 1e3 * percentile(self.ages_s, 0.95),
            "pose_p99_ms": 1e3 * percentile(self.ages_s, 0.99),
        }


def play_core(model: LinkModel, duration_s: float, *, offered: float, queue_s: float | None = QUEUE_S) -> Played:
    """The real core over the link, from a robot to a site that sits beside the relay, with that queue on it. `offered`:
    bulk, times the mean of the link; 0: none."""
    world = World(lossless=False, link=LinkParams(window=WindowParams(variable_rate_queue_s=queue_s)))
    robot = world.client("robot", model, BACK)
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish(POSE, spec(PriorityClass.CONTROL))
    robot.every(1 / POSE_HZ, pose, bytes(POSE_BYTES))
    mean_bps = model.capacity_bits(0.0, duration_s) / duration_s
    if offered:
        cloud = robot.publish(CLOUD, spec(PriorityClass.BULK))
        robot.every(1 / CLOUD_HZ, cloud, bytes(int(offered * mean_bps / 8 / CLOUD_HZ)))
    world.run(duration_s)
    stats = world.hops["robot"].forward.stats
    start_s = world.network.start_s
    ages_s, clouds_bytes = [], 0
    for got in site.got:
        if got.topic == CLOUD:
            clouds_bytes += len(got.body)
        elif SETTLED_S <= (sent_s := robot.sent[POSE, got.seq][0]) - start_s < duration_s - SETTLED_S:
            ages_s.append(got.at_s - sent_s)
    return Played(stats.utilisation, 8 * clouds_bytes / stats.capacity_bits, sorted(ages_s))


def play_window(model: LinkModel, duration_s: float, make: Callable[[], CapacityEstimator]) -> Played:
    """A window alone over the link."""
    flows = Flows(model, BACK)
    flows.flow(make())
    flows.run(duration_s)
    capacity_bits = model.capacity_bits(0.0, duration_s)
    payload_bits = flows.goodput_bps(0.0, duration_s) * duration_s
    ages_ms = flows.poses_ms(SETTLED_S, duration_s - 2 * SETTLED_S)
    return Played(
        flows.hop.forward.stats.utilisation, payload_bits / capacity_bits, [age_ms / 1e3 for age_ms in ages_ms]
    )


def play_informed(slots: Sequence[int], duration_s: float, queue_s: float) -> Played:
    """A sender that knows queue and rate as they were a round trip ago, in steps of a millisecond."""
    step_s, lag = 1e-3, round(2 * DELAY_S / 1e-3)
    count = round(duration_s / step_s)
    per_step = STEP_SLOTS * SLOT_S / step_s
    steps = np.array(slots[: round(duration_s / SLOT_S)]).reshape(-1, STEP_SLOTS).sum(axis=1)
    carries = np.repeat(steps * SLOT_PACKET_BYTES / per_step, round(per_step))[:count]
    queue, queues, sent, used = 0.0, np.zeros(count), np.zeros(count), 0.0
    under_way = 0.0  # what was sent in the last round trip
    for now in range(count):
        before = now - lag
        rate, known = (carries[before], queues[before]) if before >= 0 else (0.0, 0.0)
        expected = max(0.0, known + under_way - rate * lag)
        sent[now] = max(0.0, rate * queue_s / step_s - expected)
        if not rate and not expected:
            sent[now] = carries.mean() / 10  # or it would never learn that the link is back
        under_way += sent[now] - (sent[before] if before >= 0 else 0.0)
        queue += sent[now]
        carried = min(queue, carries[now])
        queue, used = queue - carried, used + carried
        queues[now] = queue
    total = np.cumsum(carries)
    poses = np.arange(round(SETTLED_S / step_s), count - round(SETTLED_S / step_s), round(1 / POSE_HZ / step_s))
    gone = np.searchsorted(total, total[poses] + queues[poses])
    ages_s = sorted(((gone - poses) * step_s + DELAY_S)[gone < count].tolist())
    return Played(used / total[-1], used / total[-1] * BULK_SHARE, ages_s)


def kind(name: str) -> str | None:
    """Which of LIMITS a recording is of, by its name."""
    return next((each for each in LIMITS if each in name), None)


def bench(options: argparse.Namespace, report: Report) -> None:
    files = sorted(options.data.glob("*.csv"))
    if not files:
        raise ConfigError("holds no recordings of links (*.csv): name a folder with --data", file=str(options.data))
    seconds = options.seconds or (30.0 if options.quick else None)
    used: dict[str, list[float]] = {}
    older: dict[str, list[float]] = {}
    for path in files:
        slots = read(path)
        model, duration_s = recorded(slots, seconds)
        play = partial(play_core, model, duration_s)
        alone = play(offered=0.0).row()
        sern = medians([play(offered=offered).row() for offered in OFFERED])
        rows = {
            "poses alone": alone,
            "sern": sern,
            "sern, not following": medians([play(offered=offered, queue_s=None).row() for offered in OFFERED]),
            "hybrid": play_window(model, duration_s, HybridWindow).row(),
            "bbr-like": play_window(model, duration_s, BbrLike).row(),
            "cubic": play_window(model, duration_s, Cubic).row(),
            "informed": play_informed(slots, duration_s, QUEUE_S).row(),
        }
        for system, row in rows.items():
            report.row(path.stem.replace("_", " "), system, **row)
        of = kind(path.stem)
        if of is not None:
            used.setdefault(of, []).append((sern["used_percent"] - alone["used_percent"]) / 100)
            older.setdefault(of, []).append(sern["pose_p95_ms"] / alone["pose_p95_ms"])
    for of, shares in used.items():
        report.reach(f"{of}: share of the link that bulk uses", sum(shares) / len(shares), LIMITS[of], at_least=True)
        report.reach(f"{of}: p95 of poses, times that of poses alone", sum(older[of]) / len(older[of]), AGE_LIMIT)
    path_note = f"steps of {STEP_SLOTS * SLOT_S:g} s, {1e3 * DELAY_S:g} ms each way"
    report.note(f"virtual time; {path_note}; sern: medians of {len(OFFERED)} loads")
    if seconds is not None:
        report.note(f"the first {seconds:g} s of each")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, default=CELLULAR, metavar="DIR", help="where the recordings are")
    parser.add_argument("--seconds", type=float, metavar="S", help="play only the first seconds of each")


if __name__ == "__main__":
    sys.exit(main("cellular", bench, description=__doc__, arguments=arguments))
