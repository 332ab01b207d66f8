"""Talking to systemd: sd_notify(3) and its watchdog. Does nothing when no one listens."""

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Final

from sern_runtime import clock

_log = logging.getLogger(__name__)
_MAX_STATUS_CHARS: Final = 500


class Notifier:
    """Sends state to the service manager. `address` as in NOTIFY_SOCKET: a path, or `@name` for an abstract socket.

    `watchdog_s` is how often systemd wants to hear from us at the least, None when it does not.
    """

    def __init__(self, address: str | None, *, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = "\0" + address[1:] if address is not None and address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> "Notifier":
        """What systemd set up for this process. WATCHDOG_PID naming another means that the watchdog is not for us."""
        watchdog_s = None
        microseconds = environment.get("WATCHDOG_USEC", "")
        if microseconds.isdecimal() and environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid()):
            watchdog_s = int(microseconds) / 1e6 or None
        return cls(environment.get("NOTIFY_SOCKET") or None, watchdog_s=watchdog_s)

    @property
    def enabled(self) -> bool:
        return self._socket is not None

    def ready(self, status: str = "") -> None:
        """Start-up is over, or a reload is."""
        self._send("READY=1", status)

    def reloading(self) -> None:
        """A reload begins; `ready` ends it. The time lets systemd order it against its own request."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self, status: str = "") -> None:
        self._send("STOPPING=1", status)

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send("", text)

    def watchdog(self) -> None:
        """We are alive. Prefer `Watchdog`, which knows."""
        self._send("WATCHDOG=1")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, state: str, status: str = "") -> None:
        if self._socket is None or self._address is None:
            return
        if status:
            state += ("\n" if state else "") + "STATUS=" + " ".join(status.split())[:_MAX_STATUS_CHARS]
        try:
            self._socket.sendto(state.encode(), self._address)
        except OSError as error:
            _log.warning("systemd could not be told %r: %s", state.partition("\n")[0], error.strerror)


class Watchdog:
    """Pings systemd only while every named part makes progress.

    `progress` gives a number per part that grows while the part works: drains of a socket, answered ZAP pings,
    completed commits. Call `check` every `interval_s`, from the loop.
    """

    def __init__(self, notifier: Notifier, progress: Mapping[str, Callable[[], int]]) -> None:
        self.stuck: tuple[str, ...] = ()
        """The parts without progress at the last check."""
        self._notifier = notifier
        self._progress = dict(progress)
        self._seen = {name: read() for name, read in self._progress.items()}
        self._stuck_s = 0.0  # since when some part is

    @property
    def interval_s(self) -> float | None:
        """A third of what systemd allows, so that one late check is no death; None when it does not ask."""
        return None if self._notifier.watchdog_s is None else self._notifier.watchdog_s / 3

    def check(self) -> bool:
        """Compare with the check before; ping when all moved."""
        now = {name: read() for name, read in self._progress.items()}
        stuck = tuple(name for name, value in now.items() if value == self._seen[name])
        self._seen = now
        if stuck and not self.stuck:
            self._stuck_s = clock.now()
        if stuck and stuck != self.stuck:
            _log.error("no progress in %s: the watchdog is not pinged", ", ".join(stuck))
        elif self.stuck and not stuck:
            _log.error("progress again everywhere, after %.0f s: the watchdog is pinged", clock.now() - self._stuck_s)
        self.stuck = stuck
        if stuck:
            return False
        self._notifier.watchdog()
        return True
