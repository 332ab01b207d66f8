"""Waiting by polling a condition, for tests with real sockets."""

import asyncio
import time
from collections.abc import Callable
from typing import Final

DEADLINE_S: Final = 20.0
"""Long enough for a busy machine; reached only when something is broken."""
_POLL_S: Final = 0.002


async def until(condition: Callable[[], object], what: str = "", *, deadline_s: float = DEADLINE_S) -> None:
    """Return once `condition()` is true; fail the test when it is not within `deadline_s`."""
    give_up_s = time.monotonic() + deadline_s
    while not condition():
        if time.monotonic() > give_up_s:
            raise AssertionError(f"not within {deadline_s:g} s: {what or condition}")
        await asyncio.sleep(_POLL_S)
