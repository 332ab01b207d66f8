"""The twin of one robot: what it takes, where it goes in silence, how it comes back, and what it says of itself."""

import math
from random import Random

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import STILL, Motion, Twist
from sern_twin.predictors import ConstantAcceleration, ConstantTwist, PlanTracking
from sern_twin.synchroniser import Gap, Outcome, Synchroniser, SynchroniserOptions
from sern_twin.trajectory import Trajectory, Waypoint
from tests.exploring import seeds

STEP_S = 0.02
AHEAD = Twist(1.0, 0.0, 0.0)


def ahead(time_s: float, *, y_m: float = 0.0) -> Motion:
    """A robot that goes east at 1 m/s."""
    return Motion(time_s, y_m, 0.0, AHEAD)


def heard(twin: Synchroniser, start_s: float, end_s: float) -> None:
    """It goes east, and is heard at 50 Hz without delay."""
    for step in range(round((end_s - start_s) / STEP_S) + 1):
        now = start_s + step * STEP_S
        assert twin.measured(now, ahead(now), now=now)[0] in (Outcome.TAKEN, Outcome.OLD)


def shown(twin: Synchroniser, now: float) -> Motion:
    found = twin.twin(now=now)
    assert found is not None
    return found.shown


def test_nothing_before_it_was_heard() -> None:
    twin = Synchroniser(ConstantTwist())
    assert twin.twin(now=5.0) is None


def test_what_is_late_is_brought_to_now() -> None:
    """100 ms under way: the twin is where the robot is, and not where it was."""
    twin = Synchroniser(ConstantTwist())
    for step in range(100):
        now = step * STEP_S
        twin.measured(now, ahead(now), now=now + 0.1)
        assert shown(twin, now + 0.1).x_m == pytest.approx(now + 0.1)
    found = twin.twin(now=now + 0.1)
    assert found is not None
    assert found.age_s == pytest.approx(0.1)
    assert found.error_m == pytest.approx(0.02 + 0.05 * 0.1 + 0.05 * 0.01 / 2)


def test_what_was_overtaken_changes_nothing() -> None:
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    before = twin.twin(now=1.0)
    assert twin.measured(0.9, Motion(9.0, 9.0, 1.0), now=1.0) == (Outcome.OLD, None)
    assert twin.measured(1.0, Motion(9.0, 9.0, 1.0), now=1.0) == (Outcome.OLD, None), "and what came twice"
    assert twin.twin(now=1.0) == before


@pytest.mark.parametrize(
    ("stamp_s", "found", "outcome"),
    [
        (math.nan, ahead(1.0), Outcome.NOT_FINITE),
        (1.1, Motion(math.nan, 0.0, 0.0), Outcome.NOT_FINITE),
        (1.1, Motion(1.0, 0.0, 0.0, Twist(math.inf)), Outcome.NOT_FINITE),
        (1.1, Motion(1.1, 0.0, 0.0, Twist(1e3)), Outcome.IMPLAUSIBLE),
        (1.1, Motion(1.1, 0.0, 0.0, Twist(1.0, 0.0, 1e300)), Outcome.IMPLAUSIBLE),
        (1.1, Motion(1.1, 0.0, 0.0, AHEAD, 1e300), Outcome.IMPLAUSIBLE),
        (1.1, Motion(1.1, 0.0, 0.0, AHEAD, 0.0, -1e300), Outcome.IMPLAUSIBLE),
        (1.1, Motion(1e300, 0.0, 0.0, AHEAD), Outcome.IMPLAUSIBLE),
        (1.26 + 0.1, ahead(1.0), Outcome.FUTURE),
        (1.1, ahead(1.1, y_m=40.0), Outcome.JUMP),
        (0.5, ahead(0.5), Outcome.OLD),
    ],
    ids=[
        "no stamp",
        "no place",
        "no speed",
        "absurd speed",
        "absurd turn",
        "absurd acceleration",
        "absurd turning",
        "no place on Earth",
        "future",
        "jump of GPS",
        "old",
    ],
)
def test_what_is_not_taken_moves_nothing_and_is_counted(stamp_s: float, found: Motion, outcome: Outcome) -> None:
    twin, beside = Synchroniser(ConstantTwist()), Synchroniser(ConstantTwist())
    for one in (twin, beside):
        heard(one, 0.0, 1.0)
    assert twin.measured(stamp_s, found, now=1.1) == (outcome, None)
    assert twin.counts[outcome] == 1
    assert twin.twin(now=1.5) == beside.twin(now=1.5)


def test_several_that_agree_are_where_the_robot_is() -> None:
    """It was carried away, or localised anew: taken at the third, and what is shown is set to it, counted."""
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    outcomes = [twin.measured(1.1 + n / 10, ahead(50.0 + n / 10), now=1.1 + n / 10)[0] for n in range(4)]
    assert outcomes == [Outcome.JUMP, Outcome.JUMP, Outcome.RELOCATED, Outcome.TAKEN]
    assert shown(twin, 1.4).x_m == pytest.approx(50.3)
    assert twin.snaps == 1


def test_several_that_do_not_agree_are_nowhere() -> None:
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    for number in range(9):
        found = ahead(50.0 * (-1) ** number)
        assert twin.measured(1.1 + number / 10, found, now=1.1 + number / 10)[0] is Outcome.JUMP
    assert shown(twin, 2.0).x_m == pytest.approx(2.0)


def test_a_clock_that_was_set_back_is_believed_after_a_while() -> None:
    """And what is only late, beside what is newer, never is."""
    twin = Synchroniser(ConstantTwist())
    heard(twin, 100.0, 101.0)
    late = Synchroniser(ConstantTwist())
    heard(late, 100.0, 101.0)
    for step in range(1, 200):
        now = 101.0 + step * STEP_S
        outcome, _ = twin.measured(3.0 + step * STEP_S, ahead(now), now=now)
        assert outcome is (Outcome.OLD if step < 101 else Outcome.RESTARTED if step == 101 else Outcome.TAKEN)
        late.measured(now, ahead(now), now=now)
        assert late.measured(3.0 + step * STEP_S, ahead(3.0), now=now)[0] is Outcome.OLD


def test_the_shown_twin_comes_back_within_its_limits() -> None:
    """A turn in the gap: no frame moves it faster than the robot may drive and the correction may add."""
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    before, worst_mps, back_s = shown(twin, 1.0), 0.0, 0.0
    for step in range(1, 400):
        now = 1.0 + step * STEP_S
        gap = None
        if now >= 3.0:
            _, gap = twin.measured(now, ahead(now, y_m=1.0), now=now)
        found = shown(twin, now)
        worst_mps = max(worst_mps, found.distance_m(before) / STEP_S)
        before = found
        if gap is not None:
            assert gap.report.error_m == pytest.approx(1.0)
            assert gap.report.violated and not gap.stopped
        if found.distance_m(ahead(now, y_m=1.0)) > 0.13:
            back_s = now - 3.0
    assert worst_mps < math.hypot(1.0, 0.5) + 1e-6
    assert 1.5 < back_s < 3.0
    assert twin.snaps == 0


def test_outside_is_said_until_it_is_back() -> None:
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    said = []
    for step in range(1, 500):
        now = 1.0 + step * STEP_S
        if now >= 3.0:
            twin.measured(now, ahead(now, y_m=1.0), now=now)
        found = twin.twin(now=now)
        assert found is not None
        said.append(found.outside)
    assert said.index(True) == 99
    assert 0 < sum(said) < 300 and not said[-1]


def straight(length_s: float) -> Trajectory:
    return Trajectory([Waypoint(float(time_s), float(time_s), 0.0) for time_s in range(round(length_s) + 1)])


def blackout(twin: Synchroniser, length_s: float, after: Motion) -> Gap:
    """Heard for a second, then not for so long: the gap as the first message after it ends it."""
    heard(twin, 0.0, 1.0)
    for step in range(1, round(length_s * 50)):
        twin.twin(now=1.0 + step * STEP_S)
    _, gap = twin.measured(1.0 + length_s, after, now=1.0 + length_s)
    assert gap is not None
    return gap


def test_thirty_seconds_on_a_shared_plan() -> None:
    gap = blackout(Synchroniser(PlanTracking(straight(60))), 30.0, ahead(31.0, y_m=0.03))
    assert gap.report.gap_s == pytest.approx(30.0)
    assert gap.report.error_m == pytest.approx(0.03)
    assert gap.report.shown_error_m == pytest.approx(0.03)
    assert not gap.report.violated and not gap.stopped


def test_a_stop_in_the_gap_is_said_with_the_first_message() -> None:
    twin = Synchroniser(PlanTracking(straight(60)))
    gap = blackout(twin, 30.0, Motion(6.0, 0.0, 0.0, STILL))
    assert gap.stopped
    assert gap.report.error_m == pytest.approx(25.0)
    assert gap.report.violated, "it did not do what was assumed of it"
    standing = blackout(Synchroniser(ConstantTwist()), 5.0, ahead(6.0))
    assert not standing.stopped


def test_a_gap_that_ends_with_an_old_message() -> None:
    """Compared with what was predicted for its stamp; what was shown then is forgotten."""
    gap = blackout(Synchroniser(ConstantTwist()), 5.0, ahead(6.0))
    assert gap.report.shown_error_m is not None
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    twin.twin(now=11.0)
    _, late = twin.measured(2.0, ahead(2.0, y_m=0.1), now=11.0)
    assert late is not None
    assert late.report.gap_s == pytest.approx(1.0)
    assert late.report.error_m == pytest.approx(0.1)
    assert late.report.shown_error_m is None


def test_another_predictor_does_not_move_it() -> None:
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    before = shown(twin, 1.5)
    twin.predict_with(
        PlanTracking(Trajectory([Waypoint(0.0, 0.0, 0.0), Waypoint(9.0, 0.0, 9.0)]), closes_s=100.0), now=1.5
    )
    assert shown(twin, 1.5) == before
    assert shown(twin, 1.52).distance_m(before) < 0.03


def test_the_bound_holds_where_its_assumption_does() -> None:
    """Gaps of robots that do anything within ā of the prediction: never further off than was said before."""
    random = Random(7)
    for _ in range(200):
        allowed_mps2 = random.uniform(0.05, 1.0)
        options = SynchroniserOptions(
            least_mismatch_mps2=allowed_mps2, max_speed_mps=50.0, error_m=0.001, error_mps=0.001
        )
        twin = Synchroniser(ConstantTwist(), options)
        heard(twin, 0.0, 0.1)
        x_m, y_m, x_mps, y_mps, heading = 0.1, 0.0, 1.0, 0.0, 0.0
        steps = random.randrange(30, 500)
        for step in range(steps):
            if step % 25 == 0:
                heading = random.uniform(0, 2 * math.pi)
            x_mps2, y_mps2 = allowed_mps2 * math.cos(heading), allowed_mps2 * math.sin(heading)
            x_m += x_mps * STEP_S + x_mps2 * STEP_S**2 / 2
            y_m += y_mps * STEP_S + y_mps2 * STEP_S**2 / 2
            x_mps += x_mps2 * STEP_S
            y_mps += y_mps2 * STEP_S
        now = 0.1 + steps * STEP_S
        said = twin.twin(now=now)
        assert said is not None
        found = Motion(x_m, y_m, math.atan2(y_mps, x_mps), Twist(math.hypot(x_mps, y_mps)))
        assert said.shown.distance_m(found) <= said.error_m
        _, gap = twin.measured(now, found, now=now)
        assert gap is not None and not gap.report.violated


@pytest.mark.parametrize("seed", seeds(30))
def test_whatever_is_said_of_a_robot_what_is_shown_keeps_its_limits(seed: int) -> None:
    """Whoever plays with stamps, places and speeds moves what is shown no faster than a robot goes and a correction
    leads; only a snap, which is counted, is further."""
    random = Random(seed)
    options = SynchroniserOptions()
    limit_mps = 1.5 * options.max_speed_mps + options.correction.max_speed_mps
    wild = (math.nan, math.inf, -1e308, 1e308, 1e300, 1e12, 1e4, -3.0, 0.0, 1.0)
    twin = Synchroniser(random.choice((ConstantTwist(), ConstantAcceleration())), options)
    now, before, snaps = 0.0, None, 0

    def near(value: float, spread: float) -> float:
        return random.choice(wild) if random.random() < 0.1 else value + random.gauss(0.0, spread)

    for _ in range(600):
        now += random.choice((0.02, 0.02, 0.02, 0.3))
        stamp_s = near(now - random.choice((0.0, 0.1, 1.0)), 0.1)
        speeds = Twist(near(1.0, 1.0), near(0.0, 0.3), near(0.0, 2.0))
        x_m = near(now, random.choice((0.1, 1.0, 10.0)))
        twin.measured(stamp_s, Motion(x_m, near(0.0, 1.0), near(0.0, 1.0), speeds, near(0.0, 5.0)), now=now)
        said = twin.twin(now=now)
        if said is None:
            continue
        assert said.shown.finite and math.isfinite(said.error_m)
        if before is not None and twin.snaps == snaps:
            assert said.shown.distance_m(before[1]) <= limit_mps * (now - before[0]) + 1e-9
        before, snaps = (now, said.shown), twin.snaps


def test_how_wrong_the_predictor_gets_is_learned() -> None:
    """A robot on a circle of 1 m/s² and a twin that thinks it goes straight: ā comes near it."""

    class Straight(ConstantTwist):
        def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
            return super().advance(
                Motion(motion.x_m, motion.y_m, motion.yaw_rad, Twist(motion.twist.forward_mps)), start_s, step_s,
                heard_s=heard_s,
            )  # fmt: skip

    twin = Synchroniser(Straight())
    for step in range(1000):
        now = step * STEP_S
        twin.measured(now, Motion(math.sin(now), 1 - math.cos(now), now, Twist(1.0, 0.0, 1.0)), now=now)
    one_s = twin.twin(now=now + 1.0)
    assert one_s is not None
    assert 0.3 < one_s.error_m < 0.8


def test_a_long_time_is_not_long_to_predict() -> None:
    """A machine that slept for a year, or a stamp of 1970."""
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    assert shown(twin, 3e7).x_m == pytest.approx(3e7)
    first = Synchroniser(ConstantTwist())
    assert first.measured(0.0, ahead(0.0), now=1.7e9)[0] is Outcome.TAKEN
    found = first.twin(now=1.7e9)
    assert found is not None
    assert found.age_s == 1.7e9


def test_a_clock_of_ours_that_goes_back() -> None:
    twin = Synchroniser(ConstantTwist())
    heard(twin, 0.0, 1.0)
    assert shown(twin, 0.5) == shown(twin, 1.0)


@pytest.mark.parametrize(
    "wrong", [{"max_speed_mps": 0.0}, {"gap_s": -1.0}, {"jump_m": math.nan}, {"future_s": math.inf}]
)
def test_options_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="synchroniser: "):
        SynchroniserOptions(**wrong)  # type: ignore[arg-type]
