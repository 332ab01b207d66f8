"""The window estimator on links with jitter, in virtual time: what a link carries again is found again, and no queue is
built for it where there is little jitter."""

from dataclasses import replace
from statistics import median

import pytest

from benchmarks.flows import World
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.path.congestion.room import Room
from sern_sim.models import Jitter, LinkModel, RateStep, Window
from tests.exploring import also
from tests.sern_core.path.congestion.test_hybrid import at, carries_bps

DELAY_S = 0.030
BACK_S = 9.0
FIVE_S = 5.0


def link(rate_bps: float, jitter_s: float, *, thin_bps: float | None = None, gone: bool = False) -> LinkModel:
    """From 4 s to `BACK_S` it is thin, or gone."""
    return LinkModel(
        rate_bps=rate_bps,
        delay_s=DELAY_S,
        jitter_s=jitter_s,
        jitter=Jitter.UNIFORM,
        queue_packets=200,
        overhead_bytes=60,
        rate_steps=(RateStep(4.0, thin_bps), RateStep(BACK_S, rate_bps)) if thin_bps is not None else (),
        blackouts=(Window(4.0, BACK_S),) if gone else (),
    )


def run(model: LinkModel, until_s: float, seed: int) -> World:
    world = World(model, seed=seed)
    world.flow(HybridWindow())
    world.run(until_s)
    return world


@pytest.mark.parametrize(
    ("jitter_s", "seed"),
    [
        (0.0, 1), (0.002, 1), (0.005, 2), (0.005, 3), (0.010, 1),
        *also((0.0, 2), (0.0, 3), (0.002, 2), (0.002, 3), (0.005, 1), (0.010, 2), (0.010, 3)),
    ],
)  # fmt: skip
def test_a_link_that_was_thin_is_filled_again(jitter_s: float, seed: int) -> None:
    world = run(link(8e6, jitter_s, thin_bps=0.6e6), BACK_S + FIVE_S + 2.0, seed)
    assert world.goodput_bps(BACK_S + FIVE_S, BACK_S + FIVE_S + 2.0) > 0.9 * carries_bps(8e6)


@pytest.mark.parametrize("jitter_s", [0.0, 0.005, 0.020, *also(0.002, 0.010)])
def test_a_link_that_was_gone_is_filled_again(jitter_s: float) -> None:
    world = run(link(8e6, jitter_s, gone=True), BACK_S + FIVE_S + 2.0, 1)
    assert world.goodput_bps(BACK_S + FIVE_S, BACK_S + FIVE_S + 2.0) > 0.85 * carries_bps(8e6)


@pytest.mark.parametrize(("rate_bps", "thin_bps"), [(4e6, 0.6e6), (16e6, 0.6e6), *also((16e6, 2e6))])
def test_rates_of_all_kinds_are_found_again(rate_bps: float, thin_bps: float) -> None:
    world = run(link(rate_bps, 0.005, thin_bps=thin_bps), BACK_S + FIVE_S + 2.0, 1)
    assert world.goodput_bps(BACK_S + FIVE_S, BACK_S + FIVE_S + 2.0) > 0.85 * carries_bps(rate_bps)


@pytest.mark.parametrize(
    ("rate_bps", "jitter_s"),
    [(4e6, 0.001), (8e6, 0.0005), (8e6, 0.001), *also((4e6, 0.0), (4e6, 0.0005), (8e6, 0.0))],
)
def test_little_jitter_is_no_reason_for_a_queue(rate_bps: float, jitter_s: float) -> None:
    runs = [run(link(rate_bps, jitter_s), 14.0, seed).poses_ms(5.0) for seed in (1, 2, 3)]
    assert median(at(poses, 0.5) for poses in runs) < 1e3 * DELAY_S + 5.0
    assert median(at(poses, 0.99) for poses in runs) < 1e3 * DELAY_S + 10.0


@pytest.mark.parametrize("jitter_s", [0.005, 0.010])
def test_a_queue_is_no_longer_than_jitter_makes_it(jitter_s: float) -> None:
    world = run(link(8e6, jitter_s), 18.0, 1)
    assert at(world.poses_ms(5.0), 0.99) < 1e3 * (DELAY_S + 3 * jitter_s) + 5.0
    assert world.goodput_bps(5.0, 18.0) > 0.93 * carries_bps(8e6)


@pytest.mark.parametrize(
    ("queue_packets", "loss", "lost_at_most"), [(12, 0.0, 0.02), (8, 0.02, 0.1), (6, 0.0, 0.1)], ids=["12", "8", "6"]
)
def test_a_path_that_drops_what_it_cannot_keep_is_full(queue_packets: int, loss: float, lost_at_most: float) -> None:
    """Its queue is shorter than jitter, so it does not answer: what is lost does."""
    model = replace(link(8e6, 0.005), queue_packets=queue_packets, loss=loss)
    world = run(model, 14.0, 1)
    flow = world.flows[0]
    assert flow.lost_packets <= lost_at_most * flow.sent_packets
    assert world.goodput_bps(5.0, 14.0) > 0.85 * carries_bps(8e6) * (1.0 - loss)


@pytest.mark.parametrize("seed", [2, 4])
def test_two_that_share_a_link_with_jitter_do_not_take_each_other_for_rivals(seed: int) -> None:
    """What the one takes for jitter is a queue to the other, which would fill what there is of it."""
    world = World(link(8e6, 0.005), seed=seed)
    for start_s in (0.0, 5.0):
        world.flow(HybridWindow(), start_s=start_s)
    world.run(22.0)
    for index in range(2):
        assert at(world.poses_ms(12.0, index=index), 0.99) < 1e3 * DELAY_S + 50.0
    assert world.goodput_bps(12.0, 22.0, 0) + world.goodput_bps(12.0, 22.0, 1) > 0.93 * carries_bps(8e6)


RATE = 1e6


def note(room: Room, epoch: int, window: float, queue_s: float, *, lost: float = 0.0, **more: bool) -> bool:
    flags = {"binds": True, "tries": True, "patient": False, **more}
    return room.note(0.06 * epoch, window, queue_s, rate=RATE, spread_s=0.005, lost=lost, **flags)


@pytest.mark.parametrize(("full", "steps"), [(False, 4), (True, 0)])
def test_a_queue_that_follows_the_window_is_ours(full: bool, steps: int) -> None:
    """The window grows by 2 ms of the path an epoch; what queues is seen one epoch later, and swings by 1 ms."""
    room = Room()
    for epoch in range(16):
        queue_s = 0.002 * max(0, epoch - 1) if full else 0.0
        note(room, epoch, 60_000 + 2000 * epoch, queue_s + 0.001 * (epoch % 2))
    assert room.steps >= steps if steps else room.steps == 0
    assert room.trying is (not full)


@pytest.mark.parametrize(("full", "room_left"), [(False, True), (True, False)])
def test_a_window_that_stands_still_is_made_larger_to_tell(full: bool, room_left: bool) -> None:
    room, window = Room(), 60_000.0
    tried = told = False
    for epoch in range(80):
        queue_s = max(0.0, window - 60_000) / RATE if full else 0.0
        told = note(room, epoch, window, queue_s) or told
        if room.trying:
            tried = True
            window += max(0.0, room.step(window))
        if room.steps or (tried and not room.trying):
            break
    assert tried and told is room_left
    assert window < 60_000 + 4 * 0.005 * RATE


def test_nothing_is_tried_where_it_may_not_be_and_no_window_tells_that_does_not_limit() -> None:
    room = Room()
    for epoch in range(2000):
        note(room, epoch, 60_000, 0.001, tries=False)
    assert not room.trying
    for epoch in range(2000, 2030):
        assert not note(room, epoch, 60_000 + 2000 * epoch, 0.001, binds=False, tries=False)
    room.hurry()
    for epoch in range(2030, 2033):
        note(room, epoch, 60_000, 0.001, tries=False)
    assert room.trying


def test_what_is_lost_of_a_larger_window_is_an_answer_and_the_window_goes_back() -> None:
    room, window = Room(), 60_000.0
    for epoch in range(80):
        over = max(0.0, window - 60_000) / window
        assert not note(room, epoch, window, 0.002, lost=over)
        if room.back_bytes is not None:
            break
        if room.trying:
            window += max(0.0, room.step(window))
    assert window > 60_000 and room.back_bytes == 60_000 and not room.trying


def test_loss_of_one_epoch_is_no_answer() -> None:
    room, window = Room(), 60_000.0
    for epoch in range(80):
        has_room = note(room, epoch, window, 0.002, lost=0.2 * (epoch % 3 == 0))
        assert room.back_bytes is None
        if has_room:
            return
        if room.trying:
            window += max(0.0, room.step(window))
    pytest.fail("the path has room")


def test_a_window_that_cannot_be_made_larger_is_tried_less_and_less() -> None:
    """Four minutes: as long as there is no answer each try waits longer."""
    room = Room()
    tried = 0
    for epoch in range(4000):
        note(room, epoch, 60_000, 0.002)
        tried += room.trying
    assert 0 < tried < 0.15 * 4000
