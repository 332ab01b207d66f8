"""From threads to the event loop."""

import asyncio
from threading import Thread

from sern_client.endpoints.handover import Handover


async def test_items_of_a_thread_arrive_in_order() -> None:
    handover, got, done = Handover(asyncio.get_running_loop()), list[int](), asyncio.Event()

    def produce() -> None:
        for number in range(1000):
            handover.put(lambda number=number: got.append(number), 1)  # type: ignore[misc]
        handover.put(done.set)

    thread = Thread(target=produce)
    thread.start()
    await asyncio.wait_for(done.wait(), 20)
    thread.join()
    assert got == list(range(1000))
    assert handover.dropped == 0


async def test_a_loop_that_is_behind_gets_what_is_fresh_and_all_the_news() -> None:
    handover, got, done = Handover(asyncio.get_running_loop(), max_bytes=30), list[str](), asyncio.Event()
    for number in range(10):
        handover.put(lambda number=number: got.append(f"data {number}"), 10)  # type: ignore[misc]
        handover.put(lambda number=number: got.append(f"news {number}"))  # type: ignore[misc]
    handover.put(done.set)
    await asyncio.wait_for(done.wait(), 20)
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
