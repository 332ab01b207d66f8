"""Removes a directory when whoever started it has ended, however that was: `python -I -S sweeper.py DIRECTORY`.

Its standard input is a pipe that the starter holds open and writes nothing to. It ends when the directory is gone.
"""

import shutil
import signal
import sys
import time
from pathlib import Path

PATIENCE_S = 10.0
"""Processes that end at the same time may still be writing files there."""


def main(directory: Path) -> int:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    sys.stdin.buffer.read()
    until_s = time.monotonic() + PATIENCE_S
    while directory.exists() and time.monotonic() < until_s:
        shutil.rmtree(directory, ignore_errors=True)
        time.sleep(0.02)
    return int(directory.exists())


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
