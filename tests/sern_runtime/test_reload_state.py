"""A failed reload stays beside the state until what it could not put in force is in force."""

from sern_runtime.reload_state import ReloadState


def test_a_failure_stays_until_a_file_is_read_and_tells_once_how_long_it_lasted() -> None:
    state = ReloadState()
    failing = [state.failing]
    assert state.beside("listening") == "listening"
    state.failed("relay.yaml:3: no such key", now=10.0)
    state.failed("relay.yaml:4: no such key", now=12.0)
    failing.append(state.failing)
    assert state.failures == 2
    assert state.beside("listening") == (
        "listening; reload failed, the old configuration stays: relay.yaml:4: no such key"
    )
    assert state.take_recovery_s(now=13.0) is None
    state.read()
    failing.append(state.failing)
    assert failing == [False, True, False] and state.take_recovery_s(now=15.0) == 5.0
    assert state.take_recovery_s(now=16.0) is None
    assert state.failures == 2


def test_a_part_that_comes_later_ends_its_own_failure_alone() -> None:
    state = ReloadState()
    state.read()
    state.failed_in_part("feed.roles", "the address is in use", now=1.0)
    assert "not all of feed.roles are in force: the address is in use" in state.beside("listening")
    state.failed("relay.yaml:3: no such key", now=2.0)
    state.part_in_force()
    assert "relay.yaml:3" in state.beside("listening")
    state.read()
    state.failed_in_part("feed.roles", "the address is in use", now=3.0)
    state.part_in_force()
    assert not state.failing and state.take_recovery_s(now=4.0) == 3.0
