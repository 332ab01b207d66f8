"""The command lease: after_s, then 10 Hz for 1 s, then silence."""

import pytest

from sern_core.lease import CommandLease


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
