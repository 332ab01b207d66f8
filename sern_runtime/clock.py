"""The clock of the daemons: the `now` that the core is given, in seconds.

CLOCK_BOOTTIME goes on while the machine is suspended, CLOCK_MONOTONIC stands still: by the latter a command would be as
young after an hour's sleep as before it. Neither is ever stepped; the wall clock is, and nothing is judged by it. The
event loop's own timers run on CLOCK_MONOTONIC, so only delays are given to them; `FineTimer` runs on this clock.

A machine that is stopped from outside (a paused virtual machine) has no clock that goes on. What its peers' clocks tell
then is told in sern_core/path/clocksync.py.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Final

CLOCK: Final = time.CLOCK_BOOTTIME if hasattr(time, "CLOCK_BOOTTIME") else time.CLOCK_MONOTONIC


now: Final[Callable[[], float]] = partial(time.clock_gettime, CLOCK)
"""Seconds since the machine was started, suspended or not. The same in all its processes. It is asked for every
message: a function of ours around the call would take twice as long as the call."""
