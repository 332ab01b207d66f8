"""The command lease: after_s, then 10 Hz for 1 s, then silence."""

import pytest

from sern_core.site.lease import GRACE_S, CommandLease, GuardLease


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
    lease.renew(born_s=10.0)
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
        lease.renew(born_s=born_s)
        assert lease.deadline() == pytest.approx(born_s + 0.5) and not lease.due(now=born_s)
    assert lease.fired == 0 and not lease.expired


def test_a_fresh_command_ends_the_stop() -> None:
    lease = CommandLease(0.5)
    lease.renew(born_s=10.0)
    assert lease.due(now=10.5)
    lease.renew(born_s=10.55)
    assert not lease.expired
    assert lease.deadline() == pytest.approx(11.05)
    assert not lease.due(now=11.0)


def test_freshness_counts_from_birth_not_from_arrival() -> None:
    lease = CommandLease(0.5)
    lease.renew(born_s=9.6)  # it arrived late
    assert lease.due(now=10.1)


def test_a_guard_speaks_only_when_the_owner_is_silent_past_its_deadline() -> None:
    owner, guard = CommandLease(0.5), GuardLease()
    owner.renew(born_s=10.0)
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
