"""The processes of a run: they find this checkout whatever the environment, and what ended says why in one line."""

import os
import signal
import subprocess
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from benchmarks import child
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import last_words

STOP_S: Final = 20.0
"""Time for a process to end when it is told to."""


def environment() -> dict[str, str]:
    """All variables of a child of this interpreter."""
    return {**os.environ, **child.environment()}


@dataclass
class Running:
    """Processes of one run by role. What each says on standard error is in `directory`, in ROLE.log."""

    directory: Path
    what: str = ""
    """Whose they are, for errors: a system's name."""
    ends: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)

    def cpu_s(self) -> dict[str, float]:
        return {role: child.cpu_s(process.pid) for role, process in self.ends.items()}

    def words(self, role: str) -> str:
        return last_words(self.directory / f"{role}.log")

    def said(self) -> str:
        """What all of them have said, as an addition to an error."""
        told = [f"{role} said: {words}" for role in self.ends if (words := self.words(role))]
        return f" ({'; '.join(told)})" if told else ""

    def name(self, role: str) -> str:
        return f"{self.what}, {role}" if self.what else role

    def check(self) -> None:
        """Raises SernError when one has ended, whatever its status: none does before it is told to."""
        for role, process in self.ends.items():
            if process.poll() is not None:
                raise SernError(self.ending(role))

    def ending(self, role: str) -> str:
        """One line about a process that has ended: which, how, and its last words."""
        code = self.ends[role].wait(STOP_S)
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit status {code}"
        return f"{self.name(role)} {how}: {self.words(role) or 'it said nothing'}"

    def await_end(self, role: str, *, any_status: bool = False) -> None:
        """Raises SernError when it does not end, or with a status other than 0 unless `any_status`."""
        try:
            code = self.ends[role].wait(STOP_S)
        except subprocess.TimeoutExpired as error:
            words = self.words(role)
            raise SernError(
                f"{self.name(role)} does not end within {STOP_S:g} s{': ' if words else ''}{words}"
            ) from error
        if code and not any_status:
            raise SernError(self.ending(role))

    def stop(self) -> None:
        """End what still runs, whatever state it is in."""
        for process in self.ends.values():
            if process.poll() is None:
                process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with suppress(BrokenPipeError):
                        pipe.close()
