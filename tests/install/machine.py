"""A small Debian 12 on this machine: a root file system that is kept between runs, and a real systemd that boots in it.

What a test changes is in a layer above the kept one, and goes with the test. It needs root, debootstrap and
systemd-nspawn; the network only when the root file system is made.
"""

import hashlib
import json
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from tests.support import DEADLINE_S, Patience

ROOT: Final = Path(__file__).resolve().parents[2]
KEPT: Final = ROOT / ".rootfs"
SUITE: Final = "bookworm"
PACKAGES: Final = ("dbus", "iproute2", "libstdc++6", "procps", "python3.11", "systemd", "systemd-sysv", "zlib1g")
"""Of a minimal Debian, and what the packages of SERN depend on: the tests install them without a network."""
NEEDS: Final = {"debootstrap": "debootstrap", "systemd-nspawn": "systemd-container", "nsenter": "util-linux"}
BOOTSTRAP_S: Final = 1800.0
_POLL_S: Final = 0.2

Done = subprocess.CompletedProcess[str]


def missing(*programs: str) -> str:
    """What has to be installed for these programs; empty: nothing."""
    lacking = sorted({NEEDS[name] for name in programs if shutil.which(name) is None})
    return f"apt-get install {' '.join(lacking)}" if lacking else ""


def run(command: Sequence[str | Path], *, check: bool = True, timeout_s: float = DEADLINE_S) -> Done:
    """Run a command to its end; AssertionError with what it said when it fails and `check` is set."""
    done = subprocess.run(
        list(map(str, command)),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0 or not check, f"{' '.join(map(str, command))}: {done.stdout}{done.stderr}"
    return done


def wait_until(condition: Callable[[], bool], what: Callable[[], str] | str) -> None:
    """Poll from outside of the machine; the tests here have no event loop."""
    patience = Patience()
    while not condition():
        assert not patience.over(), f"not within {DEADLINE_S:g} s: {what if isinstance(what, str) else what()}"
        threading.Event().wait(_POLL_S)


def base() -> Path:
    """The kept root file system, made at the first time (five minutes on a slow network, 300 MB)."""
    name = hashlib.sha256(" ".join((SUITE, *PACKAGES)).encode()).hexdigest()[:12]
    made = KEPT / f"{SUITE}-{name}"
    if not made.exists():
        KEPT.mkdir(exist_ok=True)
        unfinished = KEPT / f"{SUITE}-unfinished"
        shutil.rmtree(unfinished, ignore_errors=True)
        run(
            ["debootstrap", "--variant=minbase", f"--include={','.join(PACKAGES)}", SUITE, unfinished],
            timeout_s=BOOTSTRAP_S,
        )
        for archive in (unfinished / "var/cache/apt/archives").glob("*.deb"):
            archive.unlink()
        unfinished.rename(made)
    return made


@contextmanager
def layered(lower: Path, directory: Path) -> Iterator[Path]:
    """A root file system to change: `lower` stays as it is. Raises OSError where this kernel has no overlays."""
    upper, work, merged = (directory / name for name in ("upper", "work", "merged"))
    for path in (upper, work, merged):
        path.mkdir(parents=True)
    options = f"lowerdir={lower},upperdir={upper},workdir={work}"
    done = run(["mount", "-t", "overlay", "overlay", "-o", options, merged], check=False)
    if done.returncode:
        raise OSError(done.stderr.strip())
    try:
        yield merged
    finally:
        run(["umount", merged])
        shutil.rmtree(directory, ignore_errors=True)


def in_root(root: Path, *command: str, check: bool = True) -> Done:
    """Run a command in a root file system in which nothing runs."""
    environment = ["env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "HOME=/root", "LC_ALL=C.UTF-8"]
    return run(["chroot", root, *environment, "DEBIAN_FRONTEND=noninteractive", *command], check=check)


class Machine:
    """Boots the root file system with systemd as its process 1, with a network of its own that leads nowhere."""

    def __init__(self, root: Path, console: Path) -> None:
        self.root = root
        self._console = console
        self._leader = 0

    def __enter__(self) -> Self:
        command = ["systemd-nspawn", "--quiet", f"--directory={self.root}", "--boot", "--register=no", "--keep-unit",
                   "--private-network", "--console=pipe", "--machine=sern-test"]  # fmt: skip
        with self._console.open("wb") as console:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        try:
            wait_until(self._booted, lambda: f"booted: {self._console.read_text(errors='replace')[-2000:]}")
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.run("systemctl", "poweroff", check=False)
        self._end()

    def _end(self) -> None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(DEADLINE_S / 4)
            return
        self._process.kill()
        self._process.wait()

    def _booted(self) -> bool:
        assert self._process.poll() is None, f"it does not boot: {self._console.read_text(errors='replace')[-2000:]}"
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        if not children:
            return False
        self._leader = int(children[0])
        return self.run("systemctl", "is-system-running", check=False).stdout.strip() in {"running", "degraded"}

    def run(self, *command: str, check: bool = True) -> Done:
        """Run a command beside systemd, as root."""
        inside = ["nsenter", f"--target={self._leader}", "--all", "--wdns=/", "env", "-i"]
        return run([*inside, "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL=C.UTF-8", *command], check=check)

    def show(self, unit: str, key: str) -> str:
        """A property of a unit, as `systemctl show` has it."""
        return self.run("systemctl", "show", "--property", key, "--value", unit).stdout.strip()

    def journal(self, unit: str) -> list[str]:
        """What a unit has logged so far, and systemd about it."""
        done = self.run("journalctl", "--no-pager", "--output=json", f"--unit={unit}")
        return [str(json.loads(line).get("MESSAGE")) for line in done.stdout.splitlines()]

    def until_shown(self, unit: str, key: str, wanted: Callable[[str], bool]) -> None:
        """Wait until a property of a unit is as it is wanted."""

        def state() -> str:
            return f"{unit}: {key}={self.show(unit, key)}\n" + "\n".join(self.journal(unit)[-20:])

        wait_until(lambda: wanted(self.show(unit, key)), state)
