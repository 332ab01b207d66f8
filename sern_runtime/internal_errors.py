"""Errors of the program itself: each is logged with its traceback and counted, and the daemon goes on.

There is one rule. The core ends what such an error was about (a message, a stream, or a session) and tells its shell;
what escapes any other callback of the event loop comes to the loop's handler. Both come here.
"""

import asyncio
import logging
from typing import Any, Final

from sern_runtime.metrics import Metrics

PLACES: Final = ("core", "callback")
"""Where an error was raised: in a core or in what it called, or in any other callback of the event loop."""

_log = logging.getLogger(__name__)


class InternalErrors:
    """Counts by place. `watch` from the loop's thread."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = dict.fromkeys(PLACES, 0)

    def core(self, error: Exception, about: str = "") -> None:
        """The core tells of an error; `about`: whose link it met, empty for none."""
        self.counts["core"] += 1
        where = f" about {about}" if about else ""
        _log.error("an internal error%s; please report it", where, exc_info=error)

    def watch(self, loop: asyncio.AbstractEventLoop) -> None:
        """Count what escapes the loop's callbacks and tasks; it is logged as before."""
        loop.set_exception_handler(self._escaped)

    def unwatch(self, loop: asyncio.AbstractEventLoop) -> None:
        """The loop handles them by itself again."""
        loop.set_exception_handler(None)

    def _escaped(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if context.get("exception") is not None:
            self.counts["callback"] += 1
        loop.default_exception_handler(context)

    def register(self, metrics: Metrics) -> None:
        metrics.counter(
            "sern_internal_errors_total",
            "Errors of the program itself, each with a traceback in the log; what they were about was given up.",
            ("where",),
            lambda: [((where,), float(count)) for where, count in self.counts.items()],
        )
