"""How many files and connections a process may have open, and a reserve of them for when there are too many.

Where libzmq may open no more it cannot accept what waits at its port, and tries again and again. Nobody can be cut off
then: looking at a connection takes a file of its own. So a part of what the system allows is kept back until then.
"""

import logging
import resource
from typing import Final

from sern_core.vocabulary.errors import ConfigError

OPEN_FILES: Final = 16_384
"""How many files a daemon wants to be able to open, one for each connection; as in the systemd units."""
RESERVED_FILES: Final = 600
"""Enough for all the connections that may wait to be accepted (`zmq_setup.BACKLOG`), and to look at each."""
_LEAST_FILES: Final = 256
"""There is no reserve where less than this would be left beside it."""
_log = logging.getLogger(__name__)


class _Reserve:
    """Whether this process keeps a reserve, and whether it is in use."""

    kept = False
    used = False


def _limits() -> tuple[float, float]:
    soft, hard = (
        float("inf") if limit == resource.RLIM_INFINITY else float(limit)
        for limit in resource.getrlimit(resource.RLIMIT_NOFILE)
    )
    return soft, hard


def _set(soft: float) -> None:
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (int(soft), hard))


def raise_open_files() -> float:
    """Let this process open as many files as it may, up to what its systemd units allow, and keep the reserve back;
    the limit that holds now.

    A shell gives 1,024, of which half-open connections of strangers could take most.
    """
    soft, hard = _limits()
    if soft == float("inf"):
        return soft
    usual = min(max(soft, OPEN_FILES), hard)
    beside = min(usual, hard - RESERVED_FILES)
    _Reserve.kept = beside >= _LEAST_FILES
    if _Reserve.kept:
        usual = beside
    if usual != soft:
        _set(usual)
    return usual


def require_open_files(count: int) -> None:
    """Have so many files beside the reserve. Raises ConfigError where the system does not allow them."""
    soft, hard = _limits()
    needed = count + RESERVED_FILES
    if hard < needed:
        raise ConfigError(
            f"this process may open {hard:g} files and connections, and needs {needed} for so many; allow it more"
            " (LimitNOFILE= of its unit, ulimit -Hn), or let fewer connect"
        )
    if soft < count:
        _set(count)


def open_reserve() -> bool:
    """Let the process have its reserve. False: there is none, or it has it already."""
    if not _Reserve.kept or _Reserve.used:
        return False
    _Reserve.used = True
    soft, _hard = _limits()
    _set(soft + RESERVED_FILES)
    _log.warning("%g files and connections are open, as many as may be; those of the reserve are used now", soft)
    return True


def close_reserve() -> None:
    """Keep the reserve back again if it is in use. What is open stays open."""
    if _Reserve.used:
        _Reserve.used = False
        soft, _hard = _limits()
        _set(soft - RESERVED_FILES)
