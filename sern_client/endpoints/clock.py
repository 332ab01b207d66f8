"""The clock that paced endpoints (bag, synthetic) run on; a test hands in its own and needs no waiting."""

import asyncio
import time
from typing import Protocol


class Clock(Protocol):
    def monotonic_s(self) -> float: ...

    def wall_ns(self) -> int: ...

    async def sleep(self, delay_s: float) -> None: ...


class SystemClock:
    """The machine's clocks. `sleep(0)` lets every ready task of the loop run once."""

    def monotonic_s(self) -> float:
        return time.monotonic()

    def wall_ns(self) -> int:
        return time.time_ns()

    async def sleep(self, delay_s: float) -> None:
        await asyncio.sleep(delay_s)
