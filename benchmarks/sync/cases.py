"""The cases of the synchroniser's benchmark, each into a report."""

import csv
import gzip
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from statistics import median
from typing import Any, Final

from benchmarks.common import Report, half_width_95, percentile
from benchmarks.sync.playing import Played, errors, play, ways
from benchmarks.sync.recording import Recording, record
from benchmarks.sync.robot import Said, plan
from sern_client.endpoints.twin.bodies import read_pose
from sern_core.vocabulary.types import Encoding
from sern_sim.models import LinkModel, Window
from sern_sim.robot import STEP_S
from sern_twin.acceleration import Accelerations
from sern_twin.correction import CorrectionOptions
from sern_twin.motion import Motion, Twist
from sern_twin.predictors import (
    Command,
    CommandStream,
    ConstantAcceleration,
    ConstantTwist,
    LastCommand,
    PlanTracking,
    Predictor,
)
from sern_twin.reckoning import Reckoner, ReckoningOptions
from sern_twin.slip import Slip
from sern_twin.synchroniser import Synchroniser, SynchroniserOptions
from sern_twin.trajectory import Trajectory

MODERATE: Final = LinkModel(delay_s=0.1, jitter_s=0.02, loss=0.05)
HEADLINE: Final = "shared trajectory"
WARM_S: Final = 20.0
GAP_S: Final = 30.0
AFTER_S: Final = 10.0
GONE: Final = LinkModel(delay_s=0.05, jitter_s=0.005, blackouts=(Window(WARM_S + 1.0, WARM_S + 1.0 + GAP_S),))
"""The link of the blackout; its times are of the network, a second ahead of those of the plan."""
FIXED: Final = SynchroniserOptions(
    correction=CorrectionOptions(proportional_decay_per_s=0.0, derivative_decay_per_s=0.0)
)
"""Gains that do not decay: the PD that the paper compares with."""


def shares(values: list[float]) -> tuple[float, float]:
    ordered = sorted(values)
    return percentile(ordered, 0.5), percentile(ordered, 0.95)


# --- a link that is there ---------------------------------------------------------------------------------------------


def moderate(seeds: int, report: Report) -> None:
    """A minute of driving over MODERATE; p95 of each run, and its mean over the runs with its interval."""
    p95_m: dict[str, list[float]] = {}
    p95_deg: dict[str, list[float]] = {}
    covered: dict[str, list[float]] = {}
    for seed in range(seeds):
        way = plan(Random(seed), 60.0)
        recording = record(seed, way, 60.0, MODERATE)
        for name, each in ways(recording).items():
            played = play(recording, each)
            off_m, off_deg = errors(recording, played, 5.0, 60.0)
            p95_m.setdefault(name, []).append(shares(off_m)[1])
            p95_deg.setdefault(name, []).append(shares(off_deg)[1])
            covered.setdefault(name, []).append(within(recording, played, 5.0))
    for name, values in p95_m.items():
        report.row(
            "100 ms, 5 % loss, jitter 20 ms", name,
            p95_cm=100 * sum(values) / seeds, p95_half_width_cm=100 * half_width_95(values),
            worst_p95_cm=100 * max(values), p95_deg=sum(p95_deg[name]) / seeds,
            within_bound_percent=100 * sum(covered[name]) / seeds,
        )  # fmt: skip
    report.reach("100 ms, 5 %: p95 of what is shown, cm", 100 * max(p95_m[HEADLINE]), 5.0)
    report.reach("100 ms, 5 %: the same without a plan, cm", 100 * max(p95_m["constant twist"]), 5.0)
    report.reach("100 ms, 5 %: rotation, degrees", max(p95_deg[HEADLINE]), 2.0)


def within(recording: Recording, played: Played, start_s: float) -> float:
    """The share of the time in which the robot was no further off than was said."""
    first = round(start_s / STEP_S)
    pairs = list(zip(recording.truth[first:], played.twins[first:], strict=True))
    return sum(twin is not None and truth.distance_m(twin.shown) <= twin.error_m for truth, twin in pairs) / len(pairs)


# --- blackouts --------------------------------------------------------------------------------------------------------


def before_return(recording: Recording, played: Played) -> tuple[int, Motion, Any]:
    """The last step before the first message after the gap: where the robot was, and its twin."""
    back_s = next(heard.at_s for heard in recording.heard if heard.at_s > WARM_S + 0.5)
    step = int(back_s / STEP_S)
    return step, recording.truth[step], played.twins[step]


def blackout(seeds: int, report: Report) -> None:
    """What is shown when the link returns after 30 s."""
    off_m: dict[str, list[float]] = {}
    off_deg: dict[str, list[float]] = {}
    said_m: dict[str, list[float]] = {}
    kept: dict[str, int] = {}
    for seed in range(seeds):
        length_s = WARM_S + GAP_S + AFTER_S
        recording = record(seed, plan(Random(seed), length_s + 2.0), length_s, GONE)
        for name, each in ways(recording).items():
            played = play(recording, each, FIXED if name == "no prediction" else None)
            _, truth, twin = before_return(recording, played)
            off_m.setdefault(name, []).append(truth.distance_m(twin.shown))
            off_deg.setdefault(name, []).append(abs(math.degrees(truth.turn_rad(twin.shown))))
            said_m.setdefault(name, []).append(twin.error_m)
            kept[name] = kept.get(name, 0) + (not played.gaps[-1][1].report.violated)
    for name, values in off_m.items():
        middle_m, most_m = shares(values)
        report.row(
            "blackout 30 s", "fixed gains, no prediction" if name == "no prediction" else name,
            median_cm=100 * middle_m, p95_cm=100 * most_m, mean_half_width_cm=100 * half_width_95(values),
            p95_deg=shares(off_deg[name])[1], bound_m=median(said_m[name]),
            within_bound_percent=100 * kept[name] / seeds,
        )  # fmt: skip
    report.reach("blackout 30 s, shared trajectory: median, cm", 100 * shares(off_m[HEADLINE])[0], 5.0)
    report.reach("blackout 30 s, shared trajectory: p95, cm", 100 * shares(off_m[HEADLINE])[1], 7.0)
    report.reach("blackout 30 s, shared trajectory: rotation p95, degrees", shares(off_deg[HEADLINE])[1], 1.5)
    fixed_m = shares(off_m["no prediction"])[0]
    report.reach(
        "blackout 30 s, fixed gains without prediction: median, m (paper: over 0.2)", fixed_m, 0.2, at_least=True
    )


def stop(seeds: int, report: Report) -> None:
    """The robot stands still in the gap, so long before the link returns, and stays there."""
    for before_s in (0.5, 1.0, 2.0, 10.0):
        flagged, snapped, back_s, fastest_mps = 0, 0, [], []
        for seed in range(seeds):
            length_s = WARM_S + GAP_S + AFTER_S
            recording = record(
                seed, plan(Random(seed), length_s + 2.0), length_s, GONE, stops_s=WARM_S + GAP_S - before_s
            )
            played = play(recording, ways(recording)[HEADLINE])
            first, gap = played.gaps[-1]
            step, _, _ = before_return(recording, played)
            flagged += first <= (step + 1) * STEP_S and gap.stopped
            snapped += played.snaps > 0
            back_s.append(_until_back(recording, played, step) * STEP_S)
            fastest_mps.append(max(played.corrections_mps[step:]))
        report.row(
            "stop in the gap", f"{before_s:g} s before its end",
            flagged_percent=100 * flagged / seeds, snapped_percent=100 * snapped / seeds,
            back_s=max(back_s), correction_mps=max(fastest_mps),
        )  # fmt: skip
        if before_s == 1.0:
            report.reach(
                "stop 1 s before the end of the gap: flagged at once, %", 100 * flagged / seeds, 100, at_least=True
            )
            report.reach("stop 1 s before the end of the gap: back within 5 cm after, s", max(back_s), 3.0)
            report.reach("stop 1 s before the end of the gap: correction, m/s", max(fastest_mps), 0.5 + 1e-9)


BACK_M: Final = 0.05
"""Tolerance, and what the localisation of the robot is off."""


def _until_back(recording: Recording, played: Played, step: int) -> int:
    """Steps from there until what is shown is at the robot for good."""
    last = step
    for number in range(step, len(recording.truth)):
        twin = played.twins[number]
        if twin is None or recording.truth[number].distance_m(twin.shown) > BACK_M:
            last = number + 1
    return last - step


# --- motion of real robots --------------------------------------------------------------------------------------------

GAPS_S: Final = (0.5, 1.0, 2.0, 5.0)
HUSKY_WHEEL_M: Final = 0.165
HUSKY_TRACK_M: Final = 0.555
DRIVE_HZ: Final = 20.0


def recorded(folder: Path, report: Report) -> None:
    """Two recordings of a Husky: odometry, predicted from each second on; and windows of 2 s with commands."""
    bag, drive = folder / "husky_gps_imu_odom.bag", folder / "husky_drive.csv.gz"
    if not bag.exists() or not drive.exists():
        report.note(f"no recordings of real motion in {folder.name}: {bag.name} and {drive.name} are missing")
        return
    motions = list(_odometry(bag))
    predictors: dict[str, Predictor | None] = {
        "no prediction": None,
        "constant twist": ConstantTwist(),
        "constant acceleration": ConstantAcceleration(),
    }
    for gap_s in GAPS_S:
        for name, predictor in predictors.items():
            off_m = sorted(_open_loop(motions, gap_s, predictor))
            report.row(
                f"husky odometry, {gap_s:g} s", name,
                median_cm=100 * percentile(off_m, 0.5), p95_cm=100 * percentile(off_m, 0.95), counted_gaps=len(off_m),
            )  # fmt: skip
    found = _drive(drive)
    for gap_s in next(iter(found.values())):
        for name, values in found.items():
            ordered = sorted(values[gap_s])
            report.row(
                f"husky drive, {gap_s:g} s", name,
                median_cm=100 * percentile(ordered, 0.5), p95_cm=100 * percentile(ordered, 0.95),
                counted_gaps=len(ordered),
            )  # fmt: skip
    longest = max(found["slip learned"])
    report.reach(
        f"husky drive, {longest:g} s: slip learned over the ideal model, median",
        median(found["slip learned"][longest]) / median(found["ideal model"][longest]), 1.0,
    )  # fmt: skip


def _odometry(bag: Path) -> Iterator[tuple[float, Motion]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        connections = [each for each in reader.connections if each.topic.endswith("/odom")]
        accelerations = Accelerations()
        for _, _, body in reader.messages(connections):
            pose = read_pose(body, Encoding.ROS1)
            stamp_s = pose.stamp_ns / 1e9
            motion = accelerations.of(stamp_s, pose.motion)
            accelerations.took(stamp_s, motion)
            yield stamp_s, motion


def _open_loop(motions: list[tuple[float, Motion]], gap_s: float, predictor: Predictor | None) -> Iterator[float]:
    """How far off a prediction is so much later, from each measurement of a robot that moves."""
    later = 0
    for start_s, start in motions:
        while later < len(motions) and motions[later][0] < start_s + gap_s - 1e-3:
            later += 1
        if later == len(motions):
            return
        end_s, end = motions[later]
        if start.speed_mps < 0.1 or end_s - start_s > gap_s + 0.15:
            continue
        there = start if predictor is None else predictor.reach(start, start_s, end_s, 0.02, heard_s=start_s)
        yield there.distance_m(end)


def _drive(path: Path) -> dict[str, dict[float, list[float]]]:
    """Windows of 2 s that follow each other: what was learned in those before predicts the next."""
    found: dict[str, dict[float, list[float]]] = {}
    slip = Slip()
    with gzip.open(path, "rt", newline="") as file:
        for row in csv.DictReader(file):
            values = {key: float(value) for key, value in row.items()}
            count = round(2 * DRIVE_HZ)
            told = [
                Command(number / DRIVE_HZ, _wheels(values[f"cmd_left_{number}"], values[f"cmd_right_{number}"]))
                for number in range(count)
            ]
            places = [
                Motion(values[f"icp_x_{number}"], values[f"icp_y_{number}"], values[f"icp_yaw_{number}"])
                for number in range(count)
            ]
            start = Motion(
                places[0].x_m, places[0].y_m, places[0].yaw_rad,
                _wheels(values["left_wheel_vel_0"], values["right_wheel_vel_0"]),
            )  # fmt: skip
            start = Motion(start.x_m, start.y_m, start.yaw_rad, slip.twist(start.twist))
            predictors: dict[str, Predictor | None] = {
                "no prediction": None,
                "constant twist": ConstantTwist(),
                "last command": LastCommand(told[0], slip),
                "ideal model": CommandStream(told, Slip()),
                "slip learned": CommandStream(told, slip),
            }
            for gap_s in (0.5, 1.0, (count - 1) / DRIVE_HZ):
                end = places[round(gap_s * DRIVE_HZ)]
                for name, predictor in predictors.items():
                    there = start if predictor is None else predictor.reach(start, 0.0, gap_s, 0.02, heard_s=0.0)
                    found.setdefault(name, {}).setdefault(gap_s, []).append(there.distance_m(end))
            _learn(slip, told, places)
    return found


def _wheels(left_radps: float, right_radps: float) -> Twist:
    """What an ideal differential drive makes of its wheels."""
    return Twist(
        HUSKY_WHEEL_M * (left_radps + right_radps) / 2, 0.0, HUSKY_WHEEL_M * (right_radps - left_radps) / HUSKY_TRACK_M
    )


def _learn(slip: Slip, told: list[Command], places: list[Motion]) -> None:
    """The second half of a window, where what was told has been reached, is one sample."""
    half, last = len(places) // 2, len(places) - 1
    length_s = (last - half) / DRIVE_HZ
    turn = places[half].turn_rad(places[last])
    way_m = places[half].distance_m(places[last])
    if abs(turn) > 1e-6:  # of the chord the arc
        way_m *= turn / 2 / math.sin(turn / 2)
    heading = math.atan2(places[last].y_m - places[half].y_m, places[last].x_m - places[half].x_m)
    if math.cos(heading - places[half].yaw_rad - turn / 2) < 0:
        way_m = -way_m
    mean = told[(half + last) // 2].twist
    slip.learn(mean, Twist(way_m / length_s, 0.0, turn / length_s), length_s)


# --- dead reckoning and cost ------------------------------------------------------------------------------------------

RECKONED: Final = ReckoningOptions(error_m=0.015, silence_s=0.12)


def reckoning(seeds: int, report: Report) -> None:
    """Poses of a robot that sends when its twin would be wrong, over MODERATE, beside 50 a second."""
    rows: dict[str, tuple[list[float], list[float], list[float]]] = {}
    for seed in range(seeds):
        way = plan(Random(seed), 60.0)
        streamed = record(seed, way, 60.0, MODERATE)
        predictors: dict[str, Predictor] = {HEADLINE: PlanTracking(way), "constant twist": ConstantTwist()}
        for name, predictor in predictors.items():
            alike = shares(errors(streamed, play(streamed, ways(streamed)[name]), 5.0, 60.0)[0])[1]
            for options in (RECKONED, ReckoningOptions()):
                sparse = record(seed, way, 60.0, MODERATE, due=partial(_due, Reckoner(predictor, options)))
                p95_m = shares(errors(sparse, play(sparse, ways(sparse)[name]), 5.0, 60.0)[0])[1]
                fewer, p95s, other = rows.setdefault(
                    f"{name}, {100 * options.error_m:g} cm or {options.silence_s:g} s", ([], [], [])
                )
                fewer.append(streamed.sent_bytes / sparse.sent_bytes)
                p95s.append(p95_m)
                other.append(alike)
        client, streamed = _as_the_client_does(seed, way, streamed)
        fewer, p95s, other = rows.setdefault(CLIENTS, ([], [], []))
        fewer.append(streamed.sent_bytes / client.sent_bytes)
        for recording, found in ((client, p95s), (streamed, other)):
            played = play(recording, ways(recording)["constant acceleration"])
            found.append(shares(errors(recording, played, 5.0, 60.0)[0])[1])
    for name, (fewer, p95s, other) in rows.items():
        report.row(
            "dead reckoning", name, times_fewer_bytes=sum(fewer) / seeds, p95_cm=100 * sum(p95s) / seeds,
            streamed_p95_cm=100 * sum(other) / seeds,
        )  # fmt: skip
    name = f"{HEADLINE}, {100 * RECKONED.error_m:g} cm or {RECKONED.silence_s:g} s"
    fewer, p95s, other = rows[name]
    report.reach("dead reckoning: times fewer bytes than 50 Hz", sum(fewer) / seeds, 5.0, at_least=True)
    report.reach("dead reckoning: p95 over that of 50 Hz", sum(p95s) / sum(other), 1.05)


CLIENTS: Final = "dead_reckoning: true"
"""What a topic's rule gives: accelerations are those of the speeds that were sent."""


def _as_the_client_does(seed: int, way: Trajectory, streamed: Recording) -> tuple[Recording, Recording]:
    """What is heard of a robot whose rule has `dead_reckoning`, and of one that streams."""
    reckoner, accelerations = Reckoner(ConstantAcceleration()), Accelerations()

    def due(said: Said) -> bool:
        motion = accelerations.of(said.time_s, replace(said.found, forward_mps2=0.0))
        if not reckoner.due(motion, now=said.time_s):
            return False
        accelerations.took(said.time_s, motion)
        return True

    return _accelerating(record(seed, way, 60.0, MODERATE, due=due)), _accelerating(streamed)


def _accelerating(recording: Recording) -> Recording:
    """The same with accelerations of the speeds that were heard, as odometry has none."""
    accelerations = Accelerations()
    heard = []
    for each in recording.heard:
        found = accelerations.of(each.stamp_s, replace(each.found, forward_mps2=0.0))
        accelerations.took(each.stamp_s, found)
        heard.append(each._replace(found=found))
    return replace(recording, heard=heard)


def _due(reckoner: Reckoner, said: Said) -> bool:
    return reckoner.due(said.found, now=said.time_s)


def cost(report: Report) -> None:
    """CPU of one twin that hears a pose 50 times a second and is asked as often."""
    way = plan(Random(1), 60.0)
    makes: dict[str, Callable[[], Predictor]] = {HEADLINE: lambda: PlanTracking(way), "constant twist": ConstantTwist}
    for name, make in makes.items():
        best_s = math.inf
        for _ in range(5):
            twin = Synchroniser(make())
            start_s = time.process_time()
            for step in range(3000):
                now = step * STEP_S
                twin.measured(now - 0.1, way.at(now - 0.1), now=now)
                twin.twin(now=now)
            best_s = min(best_s, time.process_time() - start_s)
        percent = 100 * best_s / 60.0
        report.row("cost at 50 Hz", name, core_percent=percent, twins_on_a_core=100 / percent)
        if name == HEADLINE:
            report.reach("a twin at 50 Hz, % of a core", percent, 5.0)
            report.reach("twins on a core", 100 / percent, 100, at_least=True)
