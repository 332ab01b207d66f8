"""From threads to the event loop."""

import asyncio
from functools import partial
from threading import Thread

import pytest

from sern_client.endpoints.common.handover import ITEM_BYTES, TURN_S, Handover
from sern_runtime import clock
from tests.support import until


async def test_items_of_a_thread_arrive_in_order() -> None:
    handover, got, done = Handover(asyncio.get_running_loop()), list[int](), asyncio.Event()

    def produce() -> None:
        for number in range(1000):
            handover.put(lambda number=number: got.append(number), 1)  # type: ignore[misc]
        handover.news(done.set)

    thread = Thread(target=produce)
    thread.start()
    await until(done.is_set)
    thread.join()
    assert got == list(range(1000))
    assert handover.dropped == 0


async def test_a_loop_that_is_behind_gets_what_is_fresh_and_all_the_news() -> None:
    handover = Handover(asyncio.get_running_loop(), max_bytes=3 * (10 + ITEM_BYTES))
    got, done = list[str](), asyncio.Event()
    for number in range(10):
        handover.put(lambda number=number: got.append(f"data {number}"), 10)  # type: ignore[misc]
        handover.news(lambda number=number: got.append(f"news {number}"))  # type: ignore[misc]
    handover.news(done.set)
    await until(done.is_set)
    assert [item for item in got if item.startswith("news")] == [f"news {number}" for number in range(10)]
    assert [item for item in got if item.startswith("data")] == ["data 7", "data 8", "data 9"]
    assert handover.dropped == 7


async def test_the_thread_that_wakes_the_loop_rests_and_no_other_time() -> None:
    loop, rests = asyncio.get_running_loop(), list[str]()
    handover = Handover(loop, rest=lambda: rests.append("rest"))
    for _ in range(3):
        handover.put(lambda: None, 1)
        handover.news(lambda: None)
    assert rests == ["rest"]
    done = asyncio.Event()
    loop.call_soon(done.set)  # the loop has served them by then
    await done.wait()
    handover.put(lambda: None, 1)
    assert rests == ["rest", "rest"]


async def test_nothing_arrives_after_the_end() -> None:
    handover, got = Handover(asyncio.get_running_loop()), list[int]()
    handover.put(lambda: got.append(1), 1)
    handover.close()
    handover.put(lambda: got.append(2), 1)
    done = asyncio.Event()
    asyncio.get_running_loop().call_soon(done.set)
    await done.wait()
    assert got == []


async def test_an_item_that_fails_does_not_take_those_behind_it_with_it() -> None:
    loop = asyncio.get_running_loop()
    escaped: list[object] = []
    loop.set_exception_handler(lambda _loop, context: escaped.append(context["exception"]))
    handover = Handover(loop)
    seen: list[int] = []

    def fail() -> None:
        raise ValueError("of an item")

    try:
        for deliver in (partial(seen.append, 1), fail, partial(seen.append, 2)):
            handover.news(deliver)
        await until(lambda: len(seen) == 2)
    finally:
        loop.set_exception_handler(None)
    assert seen == [1, 2] and [type(error) for error in escaped] == [ValueError]


async def test_messages_without_a_body_are_counted_too() -> None:
    handover, got, done = Handover(asyncio.get_running_loop(), max_bytes=3 * ITEM_BYTES), list[int](), asyncio.Event()
    for number in range(10):
        handover.put(partial(got.append, number), 0)
    handover.news(done.set)
    await until(done.is_set)
    assert got == [7, 8, 9] and handover.dropped == 7


async def test_what_waits_behind_a_turn_counts_still() -> None:
    """An item puts more than may wait: those that were put before it was served are dropped first."""
    handover, got, done = Handover(asyncio.get_running_loop(), max_bytes=3 * ITEM_BYTES), list[str](), asyncio.Event()

    def more() -> None:
        for number in range(2):
            handover.put(partial(got.append, f"new {number}"), 0)

    handover.news(more)
    for number in range(3):
        handover.put(partial(got.append, f"old {number}"), 0)
    handover.news(done.set)
    await until(done.is_set)
    await until(lambda: len(got) == 3)
    assert got == ["old 2", "new 0", "new 1"] and handover.dropped == 2


async def test_who_is_dropped_is_told() -> None:
    handover, told, done = Handover(asyncio.get_running_loop(), max_bytes=2 * ITEM_BYTES), list[str](), asyncio.Event()
    for number in range(4):
        handover.put(partial(told.append, f"served {number}"), 0, partial(told.append, f"shed {number}"))
    assert told == ["shed 0", "shed 1"], "at once, not when the loop has time"
    handover.news(done.set)
    await until(done.is_set)
    assert told[2:] == ["served 2", "served 3"]


async def test_a_message_above_the_bound_is_delivered_alone() -> None:
    handover, got = Handover(asyncio.get_running_loop(), max_bytes=1000), list[int]()
    for number in range(3):
        handover.put(partial(got.append, number), 5000)
    await until(lambda: got)
    assert got == [2] and handover.dropped == 2


async def test_the_loop_has_turns_between_items(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time is what items take; each takes 0.4 of a turn."""
    loop, now = asyncio.get_running_loop(), 1000.0
    monkeypatch.setattr(clock, "now", lambda: now)
    handover, done, order = Handover(loop), asyncio.Event(), list[str]()

    def deliver() -> None:
        nonlocal now
        now += 0.4 * TURN_S
        order.append("item")

    def turn() -> None:
        order.append("turn")
        if not done.is_set():
            loop.call_soon(turn)

    for _ in range(10):
        handover.put(deliver, 1)
    handover.news(done.set)
    loop.call_soon(turn)
    await until(done.is_set)
    served = [part.count("i") for part in "".join(word[0] for word in order).split("t")]
    assert sum(served) == 10 and max(served) == 3
