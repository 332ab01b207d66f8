"""The command lease: after_s, then 10 Hz for 1 s, then silence; or jitter, a ramp, and one zero."""

import struct
from random import Random
from typing import NamedTuple

import pytest

from sern_core.bodies.twist import TwistBody
from sern_core.site.lease import GRACE_S, MAX_RAMP_S, STEP_S, CommandLease, GuardLease
from sern_core.topics.rules import Ramp
from sern_core.vocabulary.types import Encoding


def fire_times(lease: CommandLease, from_s: float, to_s: float) -> list[float]:
    """When the stop message is published between two times, driven by the lease's own deadlines."""
    times = []
    while (deadline := lease.deadline()) is not None and deadline <= to_s:
        now = max(from_s, deadline)
        if lease.due(now=now):
            times.append(now)
    return times


def test_a_robot_never_commanded_is_left_alone() -> None:
    lease = CommandLease(0.5)
    assert lease.deadline() is None
    assert not lease.due(now=100.0)


def test_stop_is_repeated_for_one_second_and_then_ends() -> None:
    lease = CommandLease(0.5)
    lease.renew(born_s=10.0, now=10.0)
    assert not lease.due(now=10.49)
    times = fire_times(lease, 10.0, 20.0)
    assert times[0] == pytest.approx(10.5)
    assert len(times) == 11
    assert times[-1] == pytest.approx(11.5)
    assert lease.expired
    assert lease.fired == 1


def test_a_robot_that_is_commanded_steadily_is_never_stopped() -> None:
    lease = CommandLease(0.5)
    for number in range(200):
        born_s = 10.0 + number * 0.49
        assert lease.deadline() is None or fire_times(lease, born_s - 0.49, born_s) == []
        lease.renew(born_s=born_s, now=born_s)
        assert lease.deadline() == pytest.approx(born_s + 0.5) and not lease.due(now=born_s)
    assert lease.fired == 0 and not lease.expired


def test_a_fresh_command_ends_the_stop() -> None:
    lease = CommandLease(0.5)
    lease.renew(born_s=10.0, now=10.0)
    assert lease.due(now=10.5)
    lease.renew(born_s=10.55, now=10.55)
    assert not lease.expired
    assert lease.deadline() == pytest.approx(11.05)
    assert not lease.due(now=11.0)


def test_freshness_counts_from_birth_not_from_arrival() -> None:
    lease = CommandLease(0.5)
    lease.renew(born_s=9.6, now=10.0)  # it arrived late
    assert lease.due(now=10.1)


def test_a_guard_speaks_only_when_the_owner_is_silent_past_its_deadline() -> None:
    owner, guard = CommandLease(0.5), GuardLease()
    owner.renew(born_s=10.0, now=10.0)
    guard.told(owner.deadline())
    assert not guard.due(now=10.5), "the owner has its turn first"
    for at_s in fire_times(owner, 10.0, 12.0):  # it says what is to be said: nothing is left for the guard
        guard.told(owner.deadline())
        assert not guard.due(now=at_s + 0.04)
    assert owner.deadline() is None and guard.deadline() is None
    assert guard.fired == 0


def test_a_guard_says_the_stop_command_as_the_owner_would() -> None:
    guard = GuardLease()
    guard.told(10.5)
    times = fire_times(guard, 10.0, 20.0)
    assert times[0] == pytest.approx(10.5 + GRACE_S)
    assert len(times) == 11 and times[-1] == pytest.approx(times[0] + 1.0)
    assert guard.fired == 1 and guard.deadline() is None


def test_a_fresh_command_ends_what_the_guard_says() -> None:
    guard = GuardLease()
    guard.told(10.5)
    assert guard.due(now=10.6)
    guard.told(11.3)
    assert not guard.expired and not guard.due(now=11.3) and guard.due(now=11.36)


def test_a_guard_whose_owner_is_gone_speaks_at_once_if_a_command_stands() -> None:
    guard = GuardLease()
    guard.abandoned(now=5.0)
    assert guard.deadline() is None, "a robot that was never commanded is left alone"
    guard.told(10.5)
    guard.abandoned(now=10.1)
    assert guard.due(now=10.1)
    assert guard.deadline() == pytest.approx(10.2)
    guard.abandoned(now=10.15)
    assert guard.deadline() == pytest.approx(10.2), "what has begun goes on as it would"


# With a ramp ----------------------------------------------------------------------------------------------------------

RAMP = Ramp(hold_s=0.125, linear_mps2=2.0, angular_radps2=4.0)
PERIOD_S = 0.05


class Said(NamedTuple):
    at_s: float
    forward_mps: float
    left_radps: float


def command(forward_mps: float, left_radps: float = 0.0) -> TwistBody:
    read = TwistBody.read("geometry_msgs/Twist", Encoding.ROS1, struct.pack("<6d", forward_mps, 0, 0, 0, 0, left_radps))
    assert read is not None
    return read


def driven(lease: CommandLease, said: TwistBody, *, count: int = 10, period_s: float = PERIOD_S) -> float:
    """Command it `count` times, from 10 s on; returns when the last command came."""
    for number in range(count):
        at_s = 10.0 + number * period_s
        lease.renew(born_s=at_s, now=at_s, command=said)
    return at_s


def ramp(lease: CommandLease, *, late_s: float = 0.0) -> list[Said]:
    """What is said from now on, by the lease's own deadlines, each `late_s` late."""
    said = []
    while (deadline_s := lease.deadline()) is not None:
        now = deadline_s + late_s
        assert lease.due(now=now)
        body = lease.slowed(now=now)
        values = (0.0,) * 6 if body is None else struct.unpack("<6d", body)
        said.append(Said(now, values[0], values[5]))
    return said


@pytest.mark.parametrize(
    ("forward_mps", "left_radps", "takes_s"), [(2.0, 0.0, 1.0), (0.5, -4.0, 1.0), (1.0, 1.0, 0.5), (0.0, 0.4, 0.1)]
)
def test_a_robot_is_slowed_down_within_both_limits_and_told_zero_once(
    forward_mps: float, left_radps: float, takes_s: float
) -> None:
    lease = CommandLease(0.5, RAMP)
    last_s = driven(lease, command(forward_mps, left_radps))
    said = ramp(lease)
    assert said[0].at_s == pytest.approx(last_s + PERIOD_S + RAMP.hold_s)
    assert said[-1][1:] == (0.0, 0.0) and [each[1:] for each in said].count((0.0, 0.0)) == 1
    assert said[-1].at_s - said[0].at_s == pytest.approx(takes_s - STEP_S)
    before = Said(said[0].at_s - STEP_S, forward_mps, left_radps)
    for each in said:
        gone_s = each.at_s - before.at_s
        assert abs(before.forward_mps - each.forward_mps) <= RAMP.linear_mps2 * gone_s + 1e-9
        assert abs(before.left_radps - each.left_radps) <= RAMP.angular_radps2 * gone_s + 1e-9
        assert each.forward_mps * left_radps == pytest.approx(each.left_radps * forward_mps), "on its arc"
        before = each
    assert lease.fired == 1 and lease.expired


def test_jitter_up_to_the_hold_is_not_noticed() -> None:
    lease = CommandLease(0.5, RAMP)
    rng = Random(1)
    for number in range(400):
        born_s = 10.0 + number * PERIOD_S
        arrives_s = born_s + 0.04 + rng.uniform(0.0, RAMP.hold_s)
        assert lease.deadline() is None or not lease.due(now=arrives_s)
        lease.renew(born_s=born_s, now=arrives_s, command=command(1.0))
    assert lease.fired == 0 and lease.period_s == pytest.approx(PERIOD_S)


def test_lost_commands_and_pairs_do_not_change_the_usual_time_between_them() -> None:
    lease = CommandLease(0.5, RAMP)
    for number in range(40):
        if number % 3 != 1:
            born_s = 10.0 + number * PERIOD_S + (0.049 if number % 7 == 0 else 0.0)
            lease.renew(born_s=born_s, now=born_s, command=command(1.0))
    assert PERIOD_S * 0.9 < lease.period_s <= 2 * PERIOD_S


def test_no_command_holds_longer_than_its_age_allows_whatever_the_rest_says() -> None:
    slow = CommandLease(0.5, RAMP)
    last_s = driven(slow, command(1.0), period_s=0.45)
    assert slow.deadline() == pytest.approx(last_s + 0.5)
    slow.renew(born_s=last_s + 0.45, now=last_s + 0.9, command=command(1.0))  # it arrived late
    assert slow.deadline() == pytest.approx(last_s + 0.95)
    first = CommandLease(0.5, RAMP)
    first.renew(born_s=10.0, now=10.1, command=command(1.0))
    assert first.deadline() == pytest.approx(10.5), "nothing is known of its period"


def test_a_speed_of_any_size_ends_within_three_seconds() -> None:
    for forward_mps in (1e3, 1e308):
        lease = CommandLease(0.5, RAMP)
        driven(lease, command(forward_mps))
        said = ramp(lease)
        assert said[-1].forward_mps == 0.0 and said[-1].at_s - said[0].at_s <= MAX_RAMP_S


def test_a_late_loop_makes_up_for_it() -> None:
    lease = CommandLease(0.5, RAMP)
    driven(lease, command(2.0))
    said = ramp(lease, late_s=0.4)
    assert said[-1].forward_mps == 0.0 and said[-1].at_s - said[0].at_s <= 1.0 + 0.4


def test_a_robot_that_stands_is_told_zero_once() -> None:
    lease = CommandLease(0.5, RAMP)
    driven(lease, command(0.0))
    assert [each[1:] for each in ramp(lease)] == [(0.0, 0.0)]


def test_a_fresh_command_ends_the_ramp_at_once_and_the_next_ramp_begins_anew() -> None:
    lease = CommandLease(0.5, RAMP)
    last_s = driven(lease, command(2.0))
    assert lease.due(now=last_s + 0.2)
    lease.renew(born_s=last_s + 0.3, now=last_s + 0.3, command=command(1.0))
    assert not lease.expired and lease.slowing_since_s is None
    assert lease.period_s == pytest.approx(PERIOD_S), "the gap is no time between commands"
    said = ramp(lease)
    assert said[0].forward_mps == pytest.approx(1.0 - RAMP.linear_mps2 * STEP_S)


def test_a_guard_goes_on_slowing_down_where_the_owner_was() -> None:
    owner, guard = CommandLease(0.5, RAMP), GuardLease(RAMP)
    last_s = driven(owner, command(2.0))
    guard.commanded(command(2.0), said_s=last_s)
    guard.told(owner.deadline())
    begun_s = owner.deadline()
    assert begun_s is not None and not guard.due(now=begun_s), "the owner has its turn first"
    for _ in range(10):
        at_s = owner.deadline() or 0.0
        assert owner.due(now=at_s)
        guard.told(owner.deadline(), since_s=owner.slowing_since_s)
    guard.abandoned(now=at_s + 0.01)
    said = ramp(guard)
    assert said[0].at_s == at_s + 0.01 and said[0].forward_mps == pytest.approx(
        2.0 - 2.0 * (at_s + 0.01 + STEP_S - begun_s)
    )
    assert said[-1].at_s <= begun_s + 1.0 + STEP_S and said[-1].forward_mps == 0.0


def test_a_guard_slows_down_by_itself_too() -> None:
    guard = GuardLease(RAMP)
    guard.commanded(command(2.0), said_s=10.0)
    guard.told(10.3)
    said = ramp(guard)
    assert said[0].at_s == pytest.approx(10.3 + GRACE_S) and said[0].forward_mps == pytest.approx(1.9)
    assert said[-1].at_s == pytest.approx(said[0].at_s + 1.0 - STEP_S)
    guard.commanded(None, said_s=20.0)
    guard.told(20.3)
    assert [each[1:] for each in ramp(guard)] == [(0.0, 0.0)], "of this one nothing is known"


def test_after_an_outage_what_was_held_back_is_not_obeyed_one_after_the_other() -> None:
    lease = CommandLease(0.5, RAMP)
    for number in range(10):
        born_s = 10.0 + number * PERIOD_S
        assert not lease.overtaken(born_s=born_s, now=born_s + 0.03)
        lease.renew(born_s=born_s, now=born_s + 0.03, command=command(1.0))
    assert not lease.overtaken(born_s=born_s + PERIOD_S, now=born_s + 0.2), "late, and no outage yet"
    assert lease.due(now=12.0)
    ages_s = (0.28, 0.23, 0.18, 0.13, 0.079)
    assert [lease.overtaken(born_s=13.0 - age_s, now=13.0) for age_s in ages_s] == [True] * 4 + [False]


def test_a_link_that_has_become_slower_for_good_is_obeyed_after_a_few_commands() -> None:
    lease = CommandLease(1.0, RAMP)
    for number in range(10):
        born_s = 10.0 + number * PERIOD_S
        assert not lease.overtaken(born_s=born_s, now=born_s + 0.03)
        lease.renew(born_s=born_s, now=born_s + 0.03, command=command(1.0))
    assert lease.due(now=13.0)
    refused = 0
    while lease.overtaken(born_s=13.0 + refused * PERIOD_S, now=13.3 + refused * PERIOD_S):
        refused += 1
    assert 0 < refused < 8
