"""A timer to a fraction of a millisecond, on a Linux timerfd: the event loop's own know whole milliseconds only.

At 4 Mbit/s a datagram takes 2.4 ms of the link. Half a millisecond that its sender is late on average is a fifth of it,
spent idle or as a queue; and what is to end when the next pose is due must not leave at the next whole millisecond.
"""

import asyncio
import ctypes
import math
import os
from collections.abc import Callable
from typing import Final

from sern_runtime import clock
from sern_runtime.loop import Timer

MIN_PERIOD_S: Final = 0.001
"""It wakes the loop at most this often: what is due in between leaves together, and costs less."""

_CLOEXEC_NONBLOCK: Final = os.O_CLOEXEC | os.O_NONBLOCK
_ABSOLUTE: Final = 1
_libc: Final = ctypes.CDLL(None, use_errno=True)
AVAILABLE: Final = hasattr(_libc, "timerfd_create")


class _Times(ctypes.Structure):
    """struct itimerspec"""

    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


class FineTimer:
    """One callback at an absolute deadline, in seconds of `clock.now`; like `Timer`, and never early either.

    Needs `close`. Raises OSError where the process has no descriptors left.
    """

    def __init__(self, callback: Callable[[], None]) -> None:
        self.deadline_s: float | None = None
        """When the callback is due; None while unarmed."""
        self._callback = callback
        self._loop = asyncio.get_running_loop()
        self._times = _Times()
        self._wake_s = math.inf  # when the descriptor wakes us
        self._woken_s = -math.inf
        self._fd = _libc.timerfd_create(clock.CLOCK, _CLOEXEC_NONBLOCK)
        if self._fd < 0:
            code = ctypes.get_errno()
            raise OSError(code, f"timerfd_create: {os.strerror(code)}")
        self._loop.add_reader(self._fd, self._wake)

    def arm(self, deadline_s: float | None) -> None:
        """Move the deadline; None disarms. Cheap when called again and again with later deadlines."""
        self.deadline_s = deadline_s
        if deadline_s is not None and deadline_s < self._wake_s and self._fd >= 0:
            self._set(deadline_s)

    def close(self) -> None:
        """Idempotent."""
        self.deadline_s = None
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _set(self, deadline_s: float) -> None:
        """Setting it also takes back a wake-up that was not heard yet: the descriptor needs no reading."""
        at_s = max(deadline_s, self._woken_s + MIN_PERIOD_S)
        times = self._times
        times.value_s = int(at_s)
        times.value_ns = min(int((at_s - int(at_s)) * 1e9) + 1, 999_999_999)  # of 0 the kernel would make never
        self._wake_s = at_s
        if _libc.timerfd_settime(self._fd, _ABSOLUTE, ctypes.byref(times), None):
            code = ctypes.get_errno()
            raise OSError(code, f"timerfd_settime: {os.strerror(code)}")

    def _wake(self) -> None:
        now = clock.now()
        self._woken_s = now
        deadline_s = self.deadline_s
        if deadline_s is not None and deadline_s <= now:
            self.deadline_s = None
            self._wake_s = math.inf
            self._callback()
            deadline_s = self.deadline_s
            if self._wake_s < math.inf or self._fd < 0:
                return  # armed again, or closed
        if deadline_s is not None:
            self._set(deadline_s)
        else:
            times = self._times
            times.value_s = times.value_ns = 0
            self._wake_s = math.inf
            _libc.timerfd_settime(self._fd, _ABSOLUTE, ctypes.byref(times), None)


def fine_timer(callback: Callable[[], None]) -> Timer | FineTimer:
    """The finest timer that this system has."""
    return FineTimer(callback) if AVAILABLE else Timer(callback)
