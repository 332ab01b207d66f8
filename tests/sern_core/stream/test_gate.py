"""What a cap or a share holds back: the rate that is let in, and that the last of a series always passes."""

from math import inf
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.vocabulary.types import DropReason
from tests.sern_core.stream.sending import Sender
from tests.world import spec


def test_a_rate_cap_lets_the_right_number_pass_in_spite_of_jitter() -> None:
    sender = Sender(spec(depth=1000, max_rate_hz=10.0))
    random = Random(1)
    for index in range(1000):
        sender.submit(now=0.02 * index + random.uniform(-0.005, 0.005))
    passed = 1000 - sender.channel.counters.by_reason[DropReason.RATE_CAP]
    assert passed == pytest.approx(200, abs=3)
    sender.check()


def test_what_a_rate_cap_holds_back_goes_when_its_time_comes() -> None:
    sender = Sender(spec(depth=1, max_rate_hz=10.0))
    channel = sender.channel
    sender.submit(now=0.0)
    assert sender.take() is not None
    for now in (0.02, 0.04, 0.06):
        sender.submit(now=now)
        sender.check()
    assert sender.waiting == [] and channel.newest is not None and channel.newest.seq == 4
    assert channel.newest_due_s == pytest.approx(0.1) and channel.counters.by_reason[DropReason.RATE_CAP] == 2
    assert not channel.release(0.09) and channel.release(0.1) and sender.waiting == [4]
    sender.check()
    sender.submit(now=0.15)  # the one that was let in has used the turn
    assert channel.newest_due_s == pytest.approx(0.2)
    sender.submit(now=0.2)  # and a newer one at its time takes its place
    assert sender.waiting == [6] and channel.newest_due_s == inf
    sender.check()


def test_what_is_held_back_has_a_lifespan_and_an_end() -> None:
    for end, reason in (
        (lambda sender: sender.channel.sweep(0.35, up=True), DropReason.LIFESPAN),
        (lambda sender: sender.channel.release(1.0), DropReason.LIFESPAN),
        (lambda sender: sender.channel.clear(DropReason.SHUTDOWN), DropReason.SHUTDOWN),
        (lambda sender: sender.channel.set_wanted(False), DropReason.UNWANTED),
        (lambda sender: sender.channel.shed(1, DropReason.QUEUE_FULL), DropReason.QUEUE_FULL),
    ):
        sender = Sender(spec(depth=1, max_rate_hz=1.0, lifespan_s=0.3))
        sender.submit(now=0.0)
        assert sender.take() is not None
        sender.submit(now=0.01)
        end(sender)  # type: ignore[no-untyped-call]
        assert sender.channel.newest is None and (2, reason) in sender.drops
        sender.check()


def test_what_a_share_leaves_out_goes_when_nothing_newer_comes() -> None:
    sender = Sender(spec(depth=1))
    sender.channel.adapt(share=0.5, depth_max=10)
    for index in range(10):
        sender.submit(now=0.1 * index)
        sender.channel.release(0.1 * index)
        sender.check()
    assert sender.channel.thinned == 5 or sender.channel.newest is not None
    sender.channel.release(10.0)
    assert sender.channel.newest is None and sender.waiting == [10]
    assert sender.channel.thinned == sender.channel.counters.by_reason[DropReason.RATE_CAP]
    sender.check()


@given(
    gaps=st.lists(st.floats(0.0, 0.5), min_size=1, max_size=60),
    rate_hz=st.sampled_from([1.0, 7.0, 20.0]),
    share=st.sampled_from([1.0, 0.5, 0.1]),
)
def test_the_last_of_any_series_is_let_in_and_no_more_than_the_rate_allows(
    gaps: list[float], rate_hz: float, share: float
) -> None:
    sender = Sender(spec(depth=1, lifespan_s=None, max_rate_hz=rate_hz))
    channel = sender.channel
    channel.adapt(share=share, depth_max=10)
    let_in: list[tuple[float, int]] = []

    def look(now: float) -> None:
        taken = sender.take(now=now)
        if taken is not None:
            let_in.append((now, taken[0].seq))
            channel.fragment_acked(taken[0], taken[1])
        sender.check()

    now = 0.0
    for gap_s in gaps:
        while channel.newest_due_s <= now + gap_s:
            due_s = channel.newest_due_s
            channel.release(due_s)
            look(due_s)
        now += gap_s
        sender.submit(now=now)
        look(now)
    while channel.newest is not None:
        due_s = channel.newest_due_s
        channel.release(due_s)
        look(due_s)
    assert let_in[-1][1] == len(gaps)
    assert [seq for _, seq in let_in] == sorted({seq for _, seq in let_in})
    if share == 1.0:
        elapsed_s = let_in[-1][0] - let_in[0][0]
        assert len(let_in) <= elapsed_s * rate_hz + 2.0
