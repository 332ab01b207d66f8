"""Network namespaces of this machine: running commands, entering them, taking offloads away.

Nothing here or above it ever creates an interface outside a namespace of the lab, so deleting the namespaces is all
there is to clean up.
"""

import ctypes
import errno
import fcntl
import os
import platform
import shutil
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, TypeVar

from sern_core.vocabulary.errors import SernError

NETNS_DIR: Final = Path("/run/netns")
"""Where `ip netns` keeps the names."""
COMMAND_S: Final = 30.0
"""No `ip` or `tc` command takes longer unless something is broken."""
_CLONE_NEWNET: Final = 0x40000000
_SIOCETHTOOL: Final = 0x8946
_OFFLOADS: Final = {
    "tx checksum": 0x17,
    "scatter-gather": 0x19,
    "tso": 0x1F,
    "gso": 0x24,
    "gro": 0x2C,
}
"""ETHTOOL_S… commands of linux/ethtool.h. Without transmit checksums the kernel takes the segmentation of TCP and UDP
away too; each is named so that a driver which couples them differently obeys as well."""

T = TypeVar("T")


class LabError(SernError):
    """The lab cannot be made or changed; says what is missing or what refused."""


def run(command: Sequence[str], *, timeout_s: float = COMMAND_S, held: Sequence[int] = ()) -> str:
    """Run a command of the system and return its output. LabError with its last words when it fails.

    `held` are descriptors that it keeps open until it ends, whatever happens to this process.
    """
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False,
            pass_fds=held, env={**os.environ, "PATH": search_path(), "LC_ALL": "C"},
        )  # fmt: skip
    except FileNotFoundError as error:
        raise LabError(f"{command[0]} is not installed: apt-get install {package_of(command[0])}") from error
    except subprocess.TimeoutExpired as error:
        raise LabError(f"{' '.join(command)}: no answer within {timeout_s:g} s") from error
    if done.returncode:
        words = " ".join(done.stderr.split()) or f"exit status {done.returncode}"
        raise LabError(f"{' '.join(command)}: {words}")
    return done.stdout


def run_all(lines: Iterable[str]) -> None:
    """Run command lines one after the other; words hold no spaces."""
    for line in lines:
        run(line.split())


def package_of(command: str) -> str:
    """The Debian package that a command of the lab comes from."""
    name = Path(command).name
    if name in ("ip", "tc"):
        return "iproute2"
    if name.startswith("qemu-system"):
        return "qemu-system-x86"
    return "busybox-static" if name == "busybox" else name


def missing_rights() -> list[str]:
    """What every lab needs and this process lacks, one short line each."""
    lacking = []
    if platform.system() != "Linux":
        return ["Linux"]
    if os.geteuid() != 0:
        lacking.append("root (network namespaces need it: run it with sudo)")
    lacking += [
        f"{command} (Debian package {package_of(command)})"
        for command in ("ip", "tc")
        if shutil.which(command, path=search_path()) is None
    ]
    return lacking


def check_rights() -> None:
    """Raises LabError where `missing_rights` finds something: before anything that only root may even look at."""
    if rights := missing_rights():
        raise LabError(f"the lab needs {', '.join(rights)}")


def search_path() -> str:
    """PATH with the directories of system commands, which a user's own often leaves out."""
    return os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))


def inside(namespace: str, work: Callable[[], T]) -> T:
    """Do `work` in a thread that has entered a namespace; a socket made there stays there and works from anywhere.

    Raises what `work` raises; LabError when the namespace cannot be entered.
    """
    results: list[T] = []
    failures: list[BaseException] = []

    def enter() -> None:
        try:
            _set_namespace(namespace)
            results.append(work())
        except BaseException as error:  # noqa: BLE001 - carried over to the calling thread, whatever it is
            failures.append(error)

    thread = threading.Thread(target=enter, name=f"inside {namespace}")
    thread.start()
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def _set_namespace(namespace: str) -> None:
    libc = ctypes.CDLL(None, use_errno=True)  # os.setns only exists from Python 3.12 on
    try:
        descriptor = os.open(NETNS_DIR / namespace, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise LabError(f"there is no network namespace {namespace}: {error.strerror}") from error
    try:
        if libc.setns(descriptor, _CLONE_NEWNET):
            raise LabError(f"cannot enter {namespace}: {os.strerror(ctypes.get_errno())}")
    finally:
        os.close(descriptor)


def quiet(namespace: str) -> None:
    """Turn IPv6 off before any interface exists: its discovery traffic would be counted, lost and delayed as well."""

    def write() -> None:
        for scope in ("all", "default"):
            switch = Path(f"/proc/sys/net/ipv6/conf/{scope}/disable_ipv6")
            if switch.exists():
                switch.write_text("1")

    inside(namespace, write)


def no_offloads(namespace: str, devices: Sequence[str]) -> None:
    """Take segmentation and checksum offloads from devices, so that what is queued is what would be on a wire."""

    def change() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for device in devices:
                for number in _OFFLOADS.values():
                    _ethtool(sock, device, number)

    inside(namespace, change)


def _ethtool(sock: socket.socket, device: str, number: int) -> None:
    value = ctypes.create_string_buffer(struct.pack("II", number, 0), 8)
    request = struct.pack("16sP", device.encode(), ctypes.addressof(value))
    try:
        fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError as error:
        if error.errno != errno.EOPNOTSUPP:  # a device without the offload needs nothing taken away
            raise LabError(f"cannot take the offloads of {device}: {error.strerror}") from error
