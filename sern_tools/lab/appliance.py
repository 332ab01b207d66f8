"""The appliance: a tiny guest that bridges two taps and runs the real `tc netem` on its ports.

It is commanded over its serial console, a line at a time, while traffic runs through it. Without hardware
virtualisation it boots in about 3 s and carries several hundred Mbit/s.
"""

import os
import platform
import select
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sern_tools.lab.host import LabError, search_path
from sern_tools.lab.image import END, FAILED, READY, cached_image, find_kernel

QEMU: Final = "qemu-system-x86_64"
BOOT_S: Final = 90.0
"""On a machine that is very busy; three seconds on an idle one."""
ANSWER_S: Final = 30.0
MEMORY_MB: Final = 192
OFFLOADS_OFF: Final = ",".join(
    f"{name}=off"
    for name in (
        *("csum", "gso", "host_tso4", "host_tso6", "host_ufo", "host_ecn"),
        *("guest_csum", "guest_tso4", "guest_tso6", "guest_ufo", "guest_ecn", "mrg_rxbuf"),
    )
)
"""Or netem would act on 64 kB super-packets."""


def missing() -> list[str]:
    """What the appliance needs and this machine lacks, one short line each."""
    lacking = []
    if platform.machine() != "x86_64":
        lacking.append(f"an x86_64 machine (this is {platform.machine()})")
    if shutil.which(QEMU, path=search_path()) is None:
        lacking.append(f"{QEMU} (Debian package qemu-system-x86)")
    if not Path("/dev/net/tun").exists():
        lacking.append("/dev/net/tun (modprobe tun)")
    try:
        cached_image(find_kernel())
    except LabError as error:
        lacking.append(str(error))
    return lacking


class Appliance:
    """A running guest. Whoever starts it calls `stop`; the lab's keeper does when its owner is dead.

    `before` are the words that run a command in the namespace of the taps; what enters at `taps[0]` leaves at
    `taps[1]`, which is eth1 in the guest.
    """

    def __init__(self, before: Sequence[str], taps: tuple[str, str]) -> None:
        kernel = find_kernel()
        command = [*before, QEMU, "-accel", "tcg", "-m", str(MEMORY_MB), "-nodefaults", "-no-user-config"]
        command += ["-display", "none", "-monitor", "none", "-no-reboot"]
        command += ["-chardev", "stdio,id=console,signal=off", "-serial", "chardev:console"]
        command += ["-kernel", str(kernel.image), "-initrd", str(cached_image(kernel))]
        command += ["-append", "console=ttyS0 quiet loglevel=0 panic=-1"]
        for index, tap in enumerate(taps):
            command += ["-netdev", f"tap,id=net{index},ifname={tap},script=no,downscript=no"]
            device = f"virtio-net-pci,netdev=net{index},mac=02:53:45:52:4e:{index:02x},romfile=,{OFFLOADS_OFF}"
            command += ["-device", device]
        self._text = ""
        self._errors = os.memfd_create("sern-lab")
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        self._poll = select.poll()
        self._poll.register(self._stdout, select.POLLIN)

    @property
    def _stdout(self) -> int:
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait_ready(self) -> str:
        """Wait until it has booted; its kernel's version. LabError when it does not."""
        give_up_s = time.monotonic() + BOOT_S
        while True:
            line = self._line(give_up_s, "has not booted")
            if line.startswith(READY):
                return line.removeprefix(READY).strip()
            if line.startswith(FAILED):
                raise LabError(f"the lab's guest cannot be used: {line.removeprefix(FAILED).strip()}")

    def command(self, line: str) -> str:
        """Run a shell command in the guest and return its output. LabError when it fails."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise self._gone() from error
        output = []
        give_up_s = time.monotonic() + ANSWER_S
        while True:
            answer = self._line(give_up_s, f"does not answer to {line!r}")
            if answer.startswith(END):
                break
            output.append(answer)
        if answer.removeprefix(END).strip() != "0":
            raise LabError(f"{line}: {' '.join(' '.join(output).split()) or 'failed'}")
        return "\n".join(output)

    def _line(self, give_up_s: float, what: str) -> str:
        while "\n" not in self._text:
            left_s = give_up_s - time.monotonic()
            if left_s <= 0 or not self._poll.poll(1000.0 * left_s):
                raise LabError(f"the lab's guest {what}: is the machine overloaded?")
            data = os.read(self._stdout, 65536)
            if not data:
                raise self._gone()
            self._text += data.decode(errors="replace")
        line, _, self._text = self._text.partition("\n")
        return line.strip()

    def _gone(self) -> LabError:
        os.lseek(self._errors, 0, os.SEEK_SET)
        words = os.read(self._errors, 4096).decode(errors="replace").split()
        return LabError(f"the lab's guest has ended: {' '.join([*words, *self._text.split()]) or 'it said nothing'}")

    def stop(self) -> None:
        """Nothing in it is worth a shutdown."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            try:
                pipe.close()
            except BrokenPipeError:
                continue  # a command that it did not live to read
        os.close(self._errors)
