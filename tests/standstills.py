"""`python -m tests.standstills SEED PYTEST-ARGUMENTS...`: the tests, with processes that stand still for moments.

A loaded machine gives a process no time for a while, at any line. This does the same on purpose, and about eight times
a second: one or two of the processes that pytest has started are stopped for 20 to 200 ms. Whatever fails under it and
not without it is a fault of timing, in a test or in the product. SEED says which are chosen, and for how long; where
in their work they stand is up to the machine.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

LASTS_S: Final = (0.02, 0.05, 0.1, 0.2)
BETWEEN_S: Final = (0.01, 0.05, 0.1)
NOT_RUNNING: Final = "TtZ"  # stopped, by a test or a debugger, or dead


def children(pid: int) -> list[int]:
    """None of a process that has ended meanwhile."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        return [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except OSError:
        return []


def descendants(pid: int) -> Iterator[int]:
    for child in children(pid):
        yield child
        yield from descendants(child)


def runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in NOT_RUNNING
    except OSError:
        return False


def signal_all(pids: list[int], number: signal.Signals) -> None:
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            continue


def disturb(tests: "subprocess.Popen[bytes]", rng: random.Random) -> int:
    """Until the tests are over. Gives how many standstills there were."""
    standstills = 0
    while tests.poll() is None:
        pids = [pid for pid in descendants(tests.pid) if runs(pid)]
        chosen = rng.sample(pids, min(len(pids), rng.choice((1, 1, 2))))
        try:
            signal_all(chosen, signal.SIGSTOP)
            time.sleep(rng.choice(LASTS_S))
        finally:
            signal_all(chosen, signal.SIGCONT)
        standstills += bool(chosen)
        time.sleep(rng.choice(BETWEEN_S))
    return standstills


def main() -> int:
    seed, arguments = int(sys.argv[1]), sys.argv[2:]
    tests = subprocess.Popen([sys.executable, "-m", "pytest", *arguments])
    try:
        standstills = disturb(tests, random.Random(seed))
    except KeyboardInterrupt:  # the tests have had it too
        tests.wait()
        return 130
    print(f"{standstills} standstills, SEED={seed}")
    return tests.returncode


if __name__ == "__main__":
    sys.exit(main())
