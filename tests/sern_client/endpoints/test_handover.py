"""From threads to the event loop."""

import asyncio
from functools import partial
from threading import Thread

from sern_client.endpoints.handover import Handover
from tests.support import until


async def test_items_of_a_thread_arrive_in_order() -> None:
    handover, got, done = Handover(asyncio.get_running_loop()), list[int](), asyncio.Event()

    def produce() -> None:
        for number in range(1000):
            handover.put(lambda number=number: got.append(number), 1)  # type: ignore[misc]
        handover.put(done.set)

    thread = Thread(target=produce)
    thread.start()
    await until(done.is_set)
    thread.join()
    assert got == list(range(1000))
    assert handover.dropped == 0


async def test_a_loop_that_is_behind_gets_what_is_fresh_and_all_the_news() -> None:
    handover, got, done = Handover(asyncio.get_running_loop(), max_bytes=30), list[str](), asyncio.Event()
    for number in range(10):
        handover.put(lambda number=number: got.append(f"data {number}"), 10)  # type: ignore[misc]
        handover.put(lambda number=number: got.append(f"news {number}"))  # type: ignore[misc]
    handover.put(done.set)
    await until(done.is_set)
    assert [item for item in got if item.startswith("news")] == [f"news {number}" for number in range(10)]
    assert [item for item in got if item.startswith("data")] == ["data 7", "data 8", "data 9"]
    assert handover.dropped == 7


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
            handover.put(deliver)
        await until(lambda: len(seen) == 2)
    finally:
        loop.set_exception_handler(None)
    assert seen == [1, 2] and [type(error) for error in escaped] == [ValueError]
