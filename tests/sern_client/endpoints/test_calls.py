"""The tables of service calls that the endpoint families share."""

import asyncio

import pytest

from sern_client.endpoints.common.calls import PendingCalls, Tasks, within
from sern_core.vocabulary.errors import ServiceError
from tests.support import until


async def test_the_first_word_about_a_call_holds() -> None:
    calls = PendingCalls()
    with calls.call(1) as one, calls.call(2) as two, calls.call(3) as three:
        calls.answer(1, b"yes")
        calls.fail(1, "too late")
        calls.fail(2, "no")
        calls.answer(2, b"too late")
        calls.answer(7, b"to nobody")
        calls.fail_all("it is gone")
        assert len(calls) == 3 and await one == b"yes"
        with pytest.raises(ServiceError, match=r"^no$"):
            await two
        with pytest.raises(ServiceError, match=r"^it is gone$"):
            await three
    calls.answer(1, b"after its end")
    assert len(calls) == 0


async def test_patience_that_ends_is_one_line() -> None:
    calls = PendingCalls()

    async def ask(timeout_s: float, problem: str = "") -> bytes:
        with calls.call(1) as answer:
            if problem:
                calls.fail(1, problem)
            async with within(timeout_s, "/lamp did not answer"):
                return await answer

    with pytest.raises(ServiceError, match=r"^/lamp did not answer$"):
        await ask(0.0)
    assert len(calls) == 0
    with pytest.raises(ServiceError, match=r"^no$"):
        await ask(60.0, "no")


async def test_so_many_at_a_time() -> None:
    tasks, gate = Tasks(2), asyncio.Event()
    done: list[int] = []

    async def work(number: int) -> None:
        await gate.wait()
        done.append(number)

    for number in range(2):
        assert not tasks.full
        tasks.begin(work(number))
    assert tasks.full
    gate.set()
    await tasks.ended()
    await until(lambda: not tasks.full)
    assert sorted(done) == [0, 1]
    gate.clear()
    tasks.begin(work(2))
    tasks.cancel()
    await tasks.ended()
    assert sorted(done) == [0, 1]
