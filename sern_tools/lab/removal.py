"""Finding and removing what labs have created, by name alone.

A lab is called `PID` or `PID.N` (the N-th further lab of that process). Its namespaces are `sern-LAB-NODE`; it holds
a lock on `/run/sern-lab/LAB.lock` for as long as its process lives, so that a leftover is known even when its process
id has been given to somebody else.
"""

import fcntl
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sern_tools.lab.host import COMMAND_S, NETNS_DIR, LabError, run

RUN_DIR: Final = Path("/run/sern-lab")
"""Locks and control sockets; for root alone."""
LAB_NAME: Final = r"(?P<lab>(?P<pid>[1-9][0-9]*)(?:\.[1-9][0-9]*)?)"
_NAMESPACE: Final = re.compile(rf"sern-{LAB_NAME}-[a-z0-9-]+")
_RUN_FILE: Final = re.compile(rf"{LAB_NAME}\.(?:lock|sock)")
GONE_S: Final = 10.0
"""A killed process is gone by then."""


def namespace_name(lab: str, node: str) -> str:
    return f"sern-{lab}-{node}"


def lock(lab: str) -> int:
    """Take the lock of a new lab; the descriptor is to be kept. LabError when `/run` is not ours to write."""
    path = RUN_DIR / f"{lab}.lock"
    while True:
        try:
            RUN_DIR.mkdir(mode=0o700, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise LabError(f"{RUN_DIR}: {error.strerror}: the lab needs root") from error
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        if _same_file(descriptor, path):
            return descriptor
        os.close(descriptor)  # a sweep found it before it was locked, and removed it


def _same_file(descriptor: int, path: Path) -> bool:
    """Whether the file that is open still has that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def labs() -> list[str]:
    """All labs of which anything is left, living or not, oldest process id first."""
    found = {match["lab"] for match in _matches(NETNS_DIR, _NAMESPACE)}
    found |= {match["lab"] for match in _matches(RUN_DIR, _RUN_FILE)}
    return sorted(found, key=lambda lab: [int(part) for part in lab.split(".")])


def namespaces(lab: str) -> list[str]:
    return sorted(match.string for match in _matches(NETNS_DIR, _NAMESPACE) if match["lab"] == lab)


def _matches(directory: Path, pattern: re.Pattern[str]) -> Iterator[re.Match[str]]:
    if directory.is_dir():
        for entry in directory.iterdir():
            match = pattern.fullmatch(entry.name)
            if match:
                yield match


def await_commands(lab: str) -> None:
    """Return when no command of a dead owner can make another namespace of this lab; after `COMMAND_S` anyway."""
    give_up_s = time.monotonic() + COMMAND_S
    while (RUN_DIR / f"{lab}.lock").exists() and alive(lab) and time.monotonic() < give_up_s:
        time.sleep(0.005)


def alive(lab: str) -> bool:
    """Whether the process that made a lab still runs, or a command with which it was making it."""
    try:
        descriptor = os.open(RUN_DIR / f"{lab}.lock", os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return Path(f"/proc/{lab.partition('.')[0]}").exists()
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(descriptor)


def sweep() -> list[str]:
    """Remove every lab whose process is dead; their names."""
    dead = [lab for lab in labs() if not alive(lab)]
    for lab in dead:
        remove(lab)
    return dead


def remove(lab: str) -> None:
    """End every process in the namespaces of a lab, and delete them with all that is in them; then its files.

    Interfaces, bridges and taps are in the namespaces and go with them. May run twice at once.
    """
    ours = namespaces(lab)
    kill_within(ours)
    for namespace in ours:
        try:
            run(["ip", "netns", "delete", namespace])
        except LabError:
            if (NETNS_DIR / namespace).exists():  # otherwise somebody else was quicker
                raise
    for suffix in ("sock", "lock"):
        (RUN_DIR / f"{lab}.{suffix}").unlink(missing_ok=True)


def kill_within(spaces: list[str]) -> None:
    """SIGKILL to every process in these namespaces, until there is none. LabError when one does not go."""
    give_up_s = time.monotonic() + GONE_S
    while pids := pids_within(spaces):
        for pid in pids:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        if time.monotonic() > give_up_s:
            raise LabError(f"processes {pids} in {', '.join(spaces)} do not end")
        time.sleep(0.005)


def pids_within(spaces: list[str]) -> list[int]:
    """The processes in these namespaces, zombies not counted."""
    wanted = {identity for space in spaces if (identity := _identity(NETNS_DIR / space)) is not None}
    # A name whose namespace was never mounted is an ordinary file, which no process is in.
    return [
        int(entry.name)
        for entry in Path("/proc").iterdir()
        if wanted and entry.name.isdigit() and _identity(entry / "ns/net") in wanted
    ]


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:  # the process has ended, or is a zombie
        return None
    return status.st_dev, status.st_ino
