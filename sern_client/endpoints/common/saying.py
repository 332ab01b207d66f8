"""What is said of others' mistakes: once each, and no more of them than a log can do with."""

import asyncio
import logging
from collections.abc import Callable, Hashable
from typing import Final

from sern_runtime import clock

MAX_SAID: Final = 1000
"""Lines of one endpoint: anybody on its network can give reason for another one."""

_log = logging.getLogger(__name__)


class SayOnce:
    """Logs each line once, `most` lines at most."""

    def __init__(self, log: logging.Logger, level: int = logging.WARNING, *, most: int = MAX_SAID) -> None:
        self._log = log
        self._level = level
        self._most = most
        self._said: set[int] = set()  # hashes: others choose how long the lines are

    def __len__(self) -> int:
        return len(self._said)

    def __call__(self, line: str | Callable[[], str], *about: Hashable, error: Exception | None = None) -> None:
        """Say a line, once for each, or for what it is `about`. `error`: one that nobody expects, shown with its
        traceback."""
        said = hash(about or line)
        if said not in self._said and len(self._said) < self._most:
            self._said.add(said)
            level = self._level if error is None else logging.ERROR
            self._log.log(level, "%s", line if isinstance(line, str) else line(), exc_info=error)


class Trouble:
    """What is wrong with one peer: said once until it is something else, and its end too."""

    def __init__(self, log: logging.Logger, who: str) -> None:
        self._log = log
        self._who = who
        self._problem = ""
        self._lost_s: float | None = None

    def is_new(self, problem: str) -> bool:
        """Whether a problem is to be said; it is not the next time."""
        new, self._problem = problem != self._problem, problem
        return new

    def say(
        self, problem: str, level: int = logging.WARNING, error: Exception | None = None, *, lost: bool = False
    ) -> bool:
        """Log a problem if it is new. `lost`: the peer is of no use until `over`. `error`: shown with its traceback."""
        if not self.is_new(problem):
            return False
        if lost and self._lost_s is None:
            self._lost_s = clock.now()
        self._log.log(level, "%s: %s", self._who, problem, exc_info=error)
        return True

    def over(self) -> None:
        """The peer answers. Whoever was told that it was lost is told so."""
        lost_s, self._lost_s = self._lost_s, None
        if lost_s is not None:
            self._problem = ""
            self._log.warning("%s answers again, after %.0f s", self._who, clock.now() - lost_s)

    def forget(self) -> None:
        """All is well: the same problem would be news."""
        self._problem = ""


def say_failure(task: asyncio.Task[None]) -> None:
    """Log why a task ended that nobody waits for; for `add_done_callback`."""
    if not task.cancelled() and (error := task.exception()) is not None:
        _log.error("%s ended", task.get_name(), exc_info=error)
