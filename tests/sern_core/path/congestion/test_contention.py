"""Whose a queue is that stays although the window made way."""

import pytest

from sern_core.path.congestion.contention import Contention, Verdict
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.path_model import Seen
from tests.sern_core.path.congestion.acknowledged import FRAGMENT_BYTES, RTT_S, Path

PARAMS = DEFAULT_HYBRID
LEAST = PARAMS.min_window_fragments * FRAGMENT_BYTES
WINDOW = 30_000.0
LONG_S = 0.05
"""A queue that is too long."""


class Shared:
    """A path, and what is known of who shares it."""

    def __init__(self) -> None:
        self.path = Path().settled()
        self.losses = Losses(PARAMS)
        self.it = Contention(PARAMS, self.path.model, self.losses)

    def queues(self, *queues_s: float) -> Seen:
        """Epochs with such queues, each of them too long or none."""
        for queue_s in queues_s:
            seen = self.path.epoch(queue_s)
            self.it.rival.note(queue_s)
            self.it.rival.above_epochs = self.it.rival.above_epochs + 1 if self.path.model.view.long else 0
        return seen

    def judge(self, inflight_bytes: int = 20_000) -> Verdict | None:
        return self.it.judge(self.path.now, WINDOW, inflight_bytes)

    def competing(self) -> "Shared":
        """A rival was found."""
        seen = self.queues(*(LONG_S + 0.01 * (n % 3) for n in range(6)))
        self.it.compete(self.path.now, WINDOW, seen)
        return self


def test_a_queue_that_moves_is_a_rivals() -> None:
    shared = Shared()
    shared.queues(*(LONG_S + 0.01 * (n % 3) for n in range(6)))
    assert shared.judge() is Verdict.RIVAL


def test_a_queue_that_is_always_the_same_is_a_longer_path() -> None:
    shared = Shared()
    shared.queues(*[LONG_S] * 6)
    assert shared.judge() is Verdict.LONGER_PATH


def test_where_something_was_lost_of_late_it_is_a_rivals_all_the_same() -> None:
    shared = Shared()
    shared.queues(*[LONG_S] * 6)
    shared.losses.lost(shared.path.now, FRAGMENT_BYTES)
    assert shared.judge() is Verdict.RIVAL


def test_a_queue_of_our_own_is_nobodys() -> None:
    shared = Shared()
    shared.queues(*(LONG_S + 0.01 * (n % 3) for n in range(6)))
    assert shared.judge(inflight_bytes=int(WINDOW) + 3 * FRAGMENT_BYTES) is None
    assert not shared.it.stuck(shared.path.now, WINDOW, int(WINDOW) + 3 * FRAGMENT_BYTES)
    assert shared.it.stuck(shared.path.now, WINDOW, 0)


def test_without_a_queue_there_is_nothing_to_judge() -> None:
    shared = Shared()
    shared.queues(0.0, 0.0)
    assert shared.judge() is None and not shared.it.stuck(shared.path.now, WINDOW, 0)


def test_a_rival_whose_queue_goes_is_remembered() -> None:
    shared = Shared().competing()
    shared.queues(0.0)
    assert shared.judge() is Verdict.GONE
    assert shared.it.rival.cubic is None and shared.it.rival.until_s > shared.path.now


def test_a_queue_that_goes_to_the_last_packet_again_and_again_is_no_rivals() -> None:
    shared = Shared()
    verdicts = []
    for _ in range(PARAMS.gone_times):
        shared.competing().queues(0.0)
        verdicts.append(shared.judge())
    assert verdicts == [Verdict.GONE] * (PARAMS.gone_times - 1) + [Verdict.FADED]
    assert shared.it.rival.until_s < shared.path.now, "there was none"


def test_a_rival_that_never_leaves_is_a_longer_path_in_the_end() -> None:
    shared = Shared().competing()
    shared.queues(LONG_S)
    assert shared.judge() is None
    shared.path.now += PARAMS.compete_max_s
    assert shared.judge() is Verdict.LONGER_PATH
    shared.it.longer_path(shared.path.now, LONG_S)
    assert shared.path.model.rtt_s == pytest.approx(RTT_S + LONG_S)


def test_to_make_way_is_to_leave_room_on_the_path_for_a_round_trip() -> None:
    shared = Shared()
    product = 500e3 * RTT_S
    window = shared.it.make_way(shared.path.now, 2 * product, LEAST, competing=False)
    assert window == pytest.approx(PARAMS.drain_gain * product, rel=0.02)
    assert shared.it.drain.saved_window == 2 * product
    assert shared.it.drain.until_s > shared.path.now + RTT_S
    assert shared.it.make_way(shared.path.now, LEAST, LEAST, competing=False) == LEAST


def test_nobody_makes_way_on_a_path_that_is_not_known() -> None:
    it = Contention(PARAMS, Path().model, Losses(PARAMS))
    assert it.make_way(100.0, WINDOW, LEAST, competing=False) is None


def test_beside_a_rival_the_window_grows_in_steps() -> None:
    shared = Shared().competing()
    cubic = shared.it.rival.cubic
    assert cubic is not None
    seen = shared.queues(LONG_S)
    later_s = shared.path.now + 60.0
    assert shared.it.competing_window(cubic, later_s, WINDOW, LEAST, seen) == 1.5 * WINDOW
    full = seen._replace(queue_s=PARAMS.compete_queue_s)
    assert shared.it.competing_window(cubic, later_s, WINDOW, LEAST, full) == WINDOW, "a queue without end"


def test_the_empty_path_is_remembered_for_as_long_as_nothing_can_show_it() -> None:
    shared = Shared()
    plain_s = shared.it.memory_s(1.0, varying=False)
    assert plain_s == PARAMS.base_window_s
    assert shared.it.memory_s(10.0, varying=False) > 2 * 10.0
    assert shared.it.memory_s(1.0, varying=True) >= 2 * PARAMS.variable_memory_s
    assert shared.competing().it.memory_s(1.0, varying=False) > PARAMS.compete_max_s
