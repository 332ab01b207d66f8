"""Ways to go on in silence, and what a robot makes of a command."""

import csv
import gzip
import math
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import STILL, Motion, Twist
from sern_twin.predictors import (
    Command,
    CommandStream,
    ConstantAcceleration,
    ConstantTwist,
    LastCommand,
    Limited,
    PlanTracking,
    Predictor,
)
from sern_twin.slip import Slip
from sern_twin.trajectory import Trajectory, Waypoint
from tests.daemons import recording

STEP_S = 0.02
START = Motion(0.0, 0.0, 0.0, Twist(1.0, 0.0, 0.0))


def after(predictor: Predictor, motion: Motion, duration_s: float, *, heard_s: float = 0.0) -> Motion:
    steps = round(duration_s / STEP_S)
    for step in range(steps):
        motion = predictor.advance(motion, heard_s + step * STEP_S, STEP_S, heard_s=heard_s)
    return motion


def test_constant_twist() -> None:
    there = after(ConstantTwist(), Motion(0.0, 0.0, 0.0, Twist(math.pi, 0.0, math.pi)), 1.0)
    assert [there.x_m, there.y_m, abs(there.yaw_rad)] == pytest.approx([0.0, 2.0, math.pi])


def test_constant_acceleration_is_believed_for_half_a_second() -> None:
    """Eq. (prediction_step) until then; a step over its end is cut there."""
    motion = Motion(0.0, 0.0, 0.0, Twist(1.0, 0.0, 0.0), forward_mps2=2.0)
    half = after(ConstantAcceleration(), motion, 0.5)
    assert [half.x_m, half.twist.forward_mps] == pytest.approx([0.5 + 0.5 * 2 * 0.25, 2.0])
    later = after(ConstantAcceleration(), motion, 10.0)
    assert [later.x_m, later.twist.forward_mps] == pytest.approx([half.x_m + 9.5 * 2.0, 2.0])
    at_once = ConstantAcceleration().advance(motion, 0.0, 10.0, heard_s=0.0)
    assert at_once.x_m == pytest.approx(later.x_m)
    turning = after(ConstantAcceleration(), Motion(0.0, 0.0, 0.0, yaw_radps2=1.0), 2.0)
    assert turning.twist.yaw_radps == pytest.approx(0.5)


def test_the_last_command_is_taken_up_and_goes_on() -> None:
    there = after(LastCommand(Command(0.0, Twist(0.5, 0.0, 0.0)), Slip(), response_s=0.1), START, 5.0)
    assert there.twist.forward_mps == pytest.approx(0.5)
    assert there.x_m == pytest.approx(0.5 * 5 + 0.5 * 0.1, rel=1e-6), "the way of a lag of the first order"
    ideal = after(LastCommand(Command(0.0, Twist(0.5, 0.0, 0.0)), Slip(), response_s=0.0), START, 5.0)
    assert ideal.x_m == pytest.approx(2.5)


def test_before_the_first_command_it_goes_on_as_it_goes() -> None:
    there = after(LastCommand(Command(99.0, STILL), Slip()), START, 1.0)
    assert there.x_m == pytest.approx(1.0)


def test_commands_are_done_at_their_time_and_end() -> None:
    commands = [Command(0.0, Twist(1.0)), Command(1.0, Twist(0.0, 0.0, 1.0)), Command(2.0, Twist(-1.0))]
    stream = CommandStream(commands, Slip(), holds_s=0.5, response_s=0.0)
    assert [stream.told(time_s) for time_s in (-0.1, 0.0, 0.4, 0.6, 1.0, 2.49, 2.5)] == [
        None, Twist(1.0), Twist(1.0), STILL, Twist(0.0, 0.0, 1.0), Twist(-1.0), STILL,
    ]  # fmt: skip
    there = after(stream, START, 4.0)
    assert there.yaw_rad == pytest.approx(0.5)
    assert [there.x_m, there.y_m] == pytest.approx([0.5 - 0.5 * math.cos(0.5), -0.5 * math.sin(0.5)])
    assert there.twist == STILL


def line(speed_mps: float) -> Trajectory:
    return Trajectory([Waypoint(float(time_s), speed_mps * time_s, 0.0) for time_s in range(41)])


def test_a_shared_plan_is_followed() -> None:
    """What it is off by shrinks as the robot's own controller shrinks it, to each side and ahead."""
    off = Motion(5.0 + 0.2, 0.1, 0.05, Twist(1.0))
    there = after(PlanTracking(line(1.0)), off, 2.0, heard_s=5.0)
    left = math.exp(-2.0)
    assert [there.x_m, there.y_m, there.yaw_rad] == pytest.approx([7 + 0.2 * left, 0.1 * left, 0.05 * left])
    assert there.twist.forward_mps == pytest.approx(1.0)
    assert after(PlanTracking(line(1.0)), off, 30.0, heard_s=5.0).x_m == pytest.approx(35.0)


def test_a_robot_that_is_behind_its_plan_stays_behind() -> None:
    there = after(PlanTracking(line(1.0), delay_s=0.4), Motion(4.6, 0.0, 0.0), 10.0, heard_s=5.0)
    assert there.x_m == pytest.approx(14.6)


def test_a_plan_that_is_over_is_stood_at() -> None:
    there = after(PlanTracking(line(1.0)), Motion(39.0, 0.0, 0.0), 30.0, heard_s=39.0)
    assert there.x_m == pytest.approx(40.0)
    assert there.twist == STILL


def test_slip_is_that_of_the_robot() -> None:
    """Found from driving: a third of the turn, nine tenths of the way, and a pull to the left."""
    slip = Slip()
    for number in range(600):
        command = Twist(1.0 if number % 3 else -0.5, 0.0, math.sin(number))
        slip.learn(command, Twist(0.9 * command.forward_mps, 0.0, 0.34 * command.yaw_radps + 0.05), 0.1)
    assert slip.speed_scale == pytest.approx(0.9, abs=0.01)
    assert slip.yaw_scale == pytest.approx(0.34, abs=0.03)
    assert slip.yaw_bias_radps == pytest.approx(0.05, abs=0.005)
    assert slip.twist(Twist(1.0, 0.0, 1.0)).yaw_radps == pytest.approx(slip.yaw_scale + slip.yaw_bias_radps)
    assert slip.twist(STILL) == STILL, "who stands is not pulled"


def test_slip_follows_the_ground() -> None:
    """After two minutes on other ground what was learned before weighs a third, after ten nothing."""
    slip = Slip()
    for scale, duration_s in ((0.5, 600), (0.25, 600)):
        for number in range(duration_s):
            slip.learn(Twist(1.0, 0.0, math.cos(number)), Twist(scale, 0.0, scale * math.cos(number)), 1.0)
            if scale == 0.25 and number == 119:
                assert 0.3 < slip.speed_scale < 0.4
    assert [slip.speed_scale, slip.yaw_scale] == pytest.approx([0.25, 0.25], abs=0.02)


def test_slip_is_the_ideal_model_at_first_and_within_its_limits() -> None:
    slip = Slip()
    assert slip.twist(Twist(1.0, 0.0, 1.0)) == Twist(1.0, 0.0, 1.0)
    slip.learn(STILL, Twist(5.0, 0.0, 5.0), 100.0)
    assert slip.twist(Twist(1.0, 0.0, 1.0)) == Twist(1.0, 0.0, 1.0), "who stands teaches nothing"
    for _ in range(1000):
        slip.learn(Twist(1.0, 0.0, 1.0), Twist(-5.0, 0.0, 9.0), 1.0)
    assert slip.speed_scale == 0.1
    assert slip.yaw_scale <= 2.0 and abs(slip.yaw_bias_radps) <= 0.2


@pytest.mark.parametrize(("found_mps", "duration_s"), [(math.nan, 1.0), (1.0, 0.0), (1.0, math.inf), (1.0, -1.0)])
def test_slip_is_not_learned_from_nonsense(found_mps: float, duration_s: float) -> None:
    slip = Slip()
    with pytest.raises(UsageError, match="slip cannot be learned"):
        slip.learn(Twist(1.0), Twist(found_mps), duration_s)
    assert slip.speed_scale == 1.0


def windows(drive: Path) -> Iterator[list[tuple[Twist, Motion]]]:
    """Windows of 2 s of a real Husky: what it was told, and where LiDAR odometry saw it, at 20 Hz."""
    radius_m, track_m = 0.1651, 0.5708
    with gzip.open(drive, "rt") as file:
        for row in csv.DictReader(file):
            window = []
            for number in range(40):
                left, right = (float(row[f"cmd_{side}_{number}"]) * radius_m for side in ("left", "right"))
                x_m, y_m, yaw_rad = (float(row[f"icp_{name}_{number}"]) for name in ("x", "y", "yaw"))
                window.append((Twist((left + right) / 2, 0.0, (right - left) / track_m), Motion(x_m, y_m, yaw_rad)))
            yield window


def test_learned_slip_beats_the_ideal_model_on_a_real_husky() -> None:
    """Two seconds ahead, learned on what came before: median of the error at the end of each window."""
    slip = Slip()
    errors: dict[str, list[float]] = {"ideal": [], "learned": []}
    for window in windows(recording("husky_drive.csv.gz")):
        commands = [Command(0.05 * number, command) for number, (command, _) in enumerate(window)]
        start, end = window[0][1], window[-1][1]
        for name, model in (("ideal", Slip()), ("learned", slip)):
            there = start
            for number in range(39):
                there = CommandStream(commands, model).advance(there, 0.05 * number, 0.05, heard_s=0.0)
            errors[name].append(there.distance_m(end))
        middle = window[20][1]
        command = window[30][0]
        turned, gone = middle.turn_rad(end), middle.distance_m(end)
        ahead = math.cos(middle.yaw_rad) * (end.x_m - middle.x_m) + math.sin(middle.yaw_rad) * (end.y_m - middle.y_m)
        slip.learn(command, Twist(math.copysign(gone, ahead) / 0.95, 0.0, turned / 0.95), 0.95)
    assert len(errors["ideal"]) > 500
    assert median(errors["learned"][60:]) < 0.8 * median(errors["ideal"][60:])
    assert slip.yaw_scale < 0.7, "it turns less than an ideal drive"


@pytest.mark.parametrize(
    "wild",
    [
        Motion(1e9, 0.0, 0.0, Twist(1e9)),
        Motion(0.0, -1e300, 3.0, Twist(0.0, 0.0, 1e300)),
        Motion(math.nan, 0.0, 0.0),
        Motion(math.inf, 0.0, 0.0),
    ],
)
def test_what_a_robot_cannot_do_is_not_predicted(wild: Motion) -> None:
    class Wild(Predictor):
        def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
            return wild

    start = Motion(1.0, 1.0, 0.5, Twist(1.0))
    then = Limited(Wild(), 3.0, 6.0).advance(start, 0.0, 0.02, heard_s=0.0)
    assert then.finite and start.distance_m(then) <= 0.06 + 1e-9 and abs(start.turn_rad(then)) <= 0.12 + 1e-9
    assert then.speed_mps <= 3.0 + 1e-9 and abs(then.twist.yaw_radps) <= 6.0


def test_what_a_robot_can_do_is_predicted_as_it_is() -> None:
    start = Motion(1.0, 1.0, 0.5, Twist(1.0, 0.0, 0.7))
    limited = Limited(ConstantTwist(), 3.0, 6.0)
    assert limited.reach(start, 0.0, 2.0, 0.02, heard_s=0.0) == ConstantTwist().reach(
        start, 0.0, 2.0, 0.02, heard_s=0.0
    )
