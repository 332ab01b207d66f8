"""The process that removes a lab when its owner is done, or dead: `python -m sern_tools.lab.keeper LAB`.

Its standard input is a pipe whose other end only the owner holds, so it ends with the owner however that ended,
kill -9 included. It then removes everything that carries the lab's name, and says on standard error what it could not.
An owner that was killed may leave a command behind which makes a namespace; the keeper waits for it.
"""

import os
import signal
import subprocess
import sys
from typing import Final

from sern_tools.lab.host import LabError
from sern_tools.lab.removal import await_commands, remove

RELEASED: Final = b"released"
"""What an owner says that lives: nothing of it is under way any more."""
CLOSE_S: Final = 30.0
"""Removing a lab takes a fraction of a second; this is for a machine that is very busy."""


class Keeper:
    """The owner's end. `release` has everything removed; so does the end of this process."""

    def __init__(self, lab: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sern_tools.lab.keeper", lab],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in a terminal is for the owner, who then lets go
        )

    def release(self) -> None:
        """Have the lab removed and wait for it. LabError with what is left when that failed."""
        try:
            _, errors = self._process.communicate(RELEASED, timeout=CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            raise LabError(f"the lab was not removed within {CLOSE_S:g} s: sern lab down removes it") from None
        if self._process.returncode:
            raise LabError(" ".join(errors.decode(errors="replace").split()) or "the lab's keeper was killed")


def main() -> int:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    said = b""
    while word := os.read(0, 4096):
        said += word
    try:
        if said != RELEASED:
            await_commands(sys.argv[1])
        remove(sys.argv[1])
    except LabError as error:
        print(f"{error}: sern lab down removes it", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
