"""Whatever a peer sends has a bounded price: in processor time of the event loop, and in memory beside its own size.

Times are processor time of this thread, the best of some tries, against a budget of 20 ms on the machine the limits
were measured on; a slower machine has the time that it needs more for a reference loop beside each try, and noise has
MARGIN.
"""

import gc
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

BUDGET_S: Final = 0.020
REFERENCE_S: Final = 0.0020
"""What `_reference` takes where the limits were measured."""
TRIES: Final = 10
"""Enough for one that others on the machine, which share its caches and its clock rate, leave alone."""
MARGIN: Final = 3.0
MULTIPLE: Final = 24
"""Bytes of memory that an input may hold for each of its own, and..."""
MULTIPLE_EACH: Final = 12
"""... and for each client that gets what is announced in it: a channel with its queue and counters takes 2 kB."""
BASE_BYTES: Final = 2 * 2**20
"""... what it may hold whatever its size: caches that fill, what one attachment unpacks to."""


def _reference() -> float:
    start_s = time.thread_time()
    table: dict[int, bytes] = {}
    for number in range(20_000):
        table[number & 1023] = b"%d" % number
    return time.thread_time() - start_s


@dataclass
class Input:
    """What is sent, and its size. Made anew for every try: what is known already costs nothing."""

    nbytes: int
    take: Callable[[], object]
    clients: int = 0
    rest: Callable[[], bool] = lambda: False
    """Does one more slice of it, in another turn of the loop; False: there was none."""


Make = Callable[[], Input]


def price_s(make: Make) -> float:
    """The processor time of the longest slice of one input."""
    given = make()
    gc.disable()  # a collection costs what there is in the process, and not what came
    try:
        start_s = time.thread_time()
        given.take()
        longest_s = time.thread_time() - start_s
        more = True
        while more:
            start_s = time.thread_time()
            more = given.rest()
            longest_s = max(longest_s, time.thread_time() - start_s)
    finally:
        gc.enable()
    return longest_s


def within_budget(make: Make) -> bool:
    """Whether one of the tries is, by the lesser of the reference loops before and after it."""
    before_s = _reference()
    for _ in range(TRIES):
        spent_s = price_s(make)
        after_s = _reference()
        slowness = max(1.0, min(before_s, after_s) / REFERENCE_S)
        if spent_s <= MARGIN * BUDGET_S * slowness:
            return True
        before_s = after_s
    return False


def held_bytes(make: Make) -> tuple[int, int]:
    """What an input adds to memory at most, and what its size allows."""
    given = make()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        kept = given.take()
        while given.rest():
            pass
        peak = tracemalloc.get_traced_memory()[1] - before
        del kept
    finally:
        tracemalloc.stop()
    return peak, given.nbytes * (MULTIPLE + MULTIPLE_EACH * given.clients)


def within_memory(make: Make) -> bool:
    """Whether one of two inputs is. The interpreter's table of names doubles at one of them: all names of the process
    are in it, so that it adds megabytes to whatever comes at that moment, and not to what comes after it.
    """
    return any(peak <= BASE_BYTES + allowed_bytes for peak, allowed_bytes in (held_bytes(make) for _ in range(2)))
