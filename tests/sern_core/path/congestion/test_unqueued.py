"""What nobody waits for: a little less is under way than the path holds, and more where that stays empty."""

from itertools import pairwise

from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.queue_view import QueueView
from sern_core.path.congestion.unqueued import FIRST_FRAGMENTS, LESS_FRAGMENTS, PATIENT_EPOCHS, Unqueued


def view(queue_s: float) -> QueueView:
    made = QueueView(DEFAULT_HYBRID)
    made.target_s, made.queue_s = 0.004, queue_s
    return made


def test_while_anything_queues_it_is_less_than_the_path_holds() -> None:
    unqueued = Unqueued()
    for _ in range(5):
        unqueued.close_epoch(view(0.002))
        assert unqueued.fragments == -LESS_FRAGMENTS


def test_where_the_path_stays_empty_it_grows_and_one_queue_ends_that() -> None:
    unqueued, found = Unqueued(), []
    for _ in range(40):
        unqueued.close_epoch(view(0.0))
        found.append(unqueued.fragments)
    assert found[:PATIENT_EPOCHS] == [FIRST_FRAGMENTS] * PATIENT_EPOCHS
    assert all(b == min(2 * a, found[-1]) for a, b in pairwise(found[PATIENT_EPOCHS - 1 :]))
    assert 1.0 < found[-1] < 5.0
    unqueued.close_epoch(view(0.002))
    assert unqueued.fragments == -LESS_FRAGMENTS
    unqueued.close_epoch(view(0.0))
    assert unqueued.fragments == FIRST_FRAGMENTS
