"""The bounded queue: whatever is put, its bounds hold, nothing is lost unseen, and the newest stays."""

from hypothesis import given, settings
from hypothesis import strategies as st

from sern_client.endpoints.common.queue import BoundedQueue
from tests.exploring import cases


@given(st.integers(1, 5), st.integers(1, 20), st.lists(st.one_of(st.none(), st.integers(0, 30))))
@settings(max_examples=cases(200))
def test_bounds_and_order(max_items: int, max_bytes: int, steps: list[int | None]) -> None:
    queue: BoundedQueue[int] = BoundedQueue(max_bytes=max_bytes, max_items=max_items)
    sizes: list[int] = []
    gone: list[int] = []
    for step in steps:
        if step is None:
            if queue:
                assert queue.first == len(gone)
                gone.append(queue.pop())
            continue
        dropped = queue.put(len(sizes), step)
        sizes.append(step)
        gone += dropped
        if dropped:
            last_bytes = sizes[dropped[-1]]
            assert len(queue) == max_items or queue.nbytes + last_bytes > max_bytes, "no more go than must"
        assert len(queue) <= max_items and (queue.nbytes <= max_bytes or len(queue) == 1)
        assert list(queue)[-1] == len(sizes) - 1, "the newest stays"
        kept = list(queue)
        assert [*gone, *kept] == list(range(len(sizes))), "each is there or told, in order"
        assert queue.nbytes == sum(sizes[number] for number in kept)
    queue.clear()
    assert (len(queue), queue.nbytes) == (0, 0)
