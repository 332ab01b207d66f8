"""What both daemons do around their main coroutine: logging, one-line errors, exit codes."""

import sys
from collections.abc import Callable, Coroutine
from typing import Any, Final

from sern_core.errors import ConfigError, SernError
from sern_runtime import logs
from sern_runtime.config.shared import LogSection
from sern_runtime.loop import Shutdown, run

EXIT_CONFIG: Final = 2
EXIT_FAILED: Final = 1


def run_daemon(
    program: str,
    read_log: Callable[[], LogSection],
    main: Callable[[Shutdown], Coroutine[Any, Any, int | None]],
) -> int:
    """Run a daemon and say in one line what went wrong: exit code 2 for configuration, 1 for anything else."""
    try:
        section = read_log()
        logs.configure(log_format=section.format.value, level=section.level.value.upper())
        return run(main)
    except ConfigError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_CONFIG
    except SernError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_FAILED
