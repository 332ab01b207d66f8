"""Parts that a daemon can do without: when one fails it is counted, said once with its traceback, and restarted or left
off; forwarding goes on. What a daemon cannot do without ends it (`entry.serve`), so that its supervisor restarts it."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Final

from sern_runtime.metrics import Metrics

BACKOFF_S: Final = (1.0, 60.0)
"""First and longest pause before a part is started again; it doubles with each failure."""
MAX_SAID: Final = 256

_log = logging.getLogger(__name__)


class OptionalParts:
    """The optional parts of one daemon, by name, and how often each has failed."""

    def __init__(self, *parts: str) -> None:
        self.failures: dict[str, int] = dict.fromkeys(parts, 0)
        self._said: set[tuple[str, str]] = set()

    def failed(self, part: str, error: BaseException) -> None:
        """Count a failure. The same error of the same part is said with its traceback once."""
        self.failures[part] = self.failures.get(part, 0) + 1
        key = (part, f"{type(error).__name__}: {error}"[:200])
        if key not in self._said and len(self._said) < MAX_SAID:
            self._said.add(key)
            _log.error("%s failed, the rest goes on", part, exc_info=error)
        else:
            _log.warning("%s failed again: %s", part, key[1])

    def ended(self, part: str, problem: str) -> None:
        """Count the end of a part for want of something that is not ours to give, such as room on a disk, and say the
        problem in one line."""
        self.failures[part] = self.failures.get(part, 0) + 1
        _log.error("%s", problem)

    @contextmanager
    def survive(self, part: str) -> Iterator[None]:
        """Whatever goes wrong inside is this part's alone."""
        try:
            yield
        except Exception as error:  # noqa: BLE001  (counted and said)
            self.failed(part, error)

    async def keep(self, part: str, run: Callable[[], Awaitable[None]], *, reset: Callable[[], None]) -> None:
        """Run a part until cancelled; when it fails, `reset` it and start it again after a pause."""
        pause_s, longest_s = BACKOFF_S
        while True:
            try:
                await run()
                return
            except Exception as error:  # noqa: BLE001  (counted and said)
                self.failed(part, error)
            with self.survive(part):
                reset()
            await asyncio.sleep(pause_s)
            _log.error("%s is started again, after %g s", part, pause_s)
            pause_s = min(2.0 * pause_s, longest_s)

    def register(self, metrics: Metrics) -> None:
        metrics.counter(
            "sern_optional_failures_total",
            "Failures of parts that the daemon can do without; it went on.",
            ("part",),
            lambda: [((part,), float(count)) for part, count in self.failures.items()],
        )
