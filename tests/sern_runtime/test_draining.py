"""When a daemon that drains gives up."""

from sern_runtime.draining import STEP_S, Progress


def test_time_counts_from_the_last_change() -> None:
    progress = Progress()
    assert progress.still_s((3, 100), now=50.0) == 0.0
    assert progress.still_s((3, 100), now=50.125) == 0.125
    assert progress.still_s((3, 100), now=50.25) == 0.25
    assert progress.still_s((3, 99), now=50.375) == 0.0
    assert progress.still_s((3, 99), now=50.5) == 0.125


def test_a_standstill_of_the_machine_is_not_taken_for_the_links() -> None:
    progress = Progress()
    progress.still_s((3,), now=50.0)
    assert progress.still_s((3,), now=80.0) == STEP_S
