"""Becomes a program that ends with its parent, even by SIGKILL: `python -I -S launcher.py PARENT COMMAND ...`.

PARENT is the process id of who starts it. It is run by its path and imports nothing of the project, so that it costs
some milliseconds. Between fork and exec of a process with threads no Python may run: it could wait for ever for a lock
that another thread held. Hence a program of its own.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1
"""linux/prctl.h. It outlives exec, and is about the thread that started the process: let that be one that stays."""


def main(arguments: list[str]) -> None:
    """Does not return. Exit status 1: the parent has ended; 127: the command cannot be run."""
    parent, command = int(arguments[0]), arguments[1:]
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:  # it ended before
        sys.exit(1)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        sys.exit(127)


if __name__ == "__main__":
    main(sys.argv[1:])
