"""A terminal that is drawn on and given back as it was, whatever ends the program."""

import os
import select
import shutil
import signal
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final, TextIO

ENTER: Final = "\x1b[?1049h\x1b[?25l"
"""Another screen than that of the shell, without a cursor (xterm's control sequences)."""
LEAVE: Final = "\x1b[?25h\x1b[?1049l"
HOME: Final = "\x1b[H"
TO_END_OF_LINE: Final = "\x1b[K"
TO_END: Final = "\x1b[J"
ENDING: Final = (signal.SIGTERM, signal.SIGHUP)


class EndedError(Exception):
    """A signal ends the program; `number` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(f"signal {number}")
        self.number = number


class Terminal:
    """Draws on `out` and hears keys from `keys`, where that is a terminal too. Use `drawing` around all of it."""

    def __init__(self, out: TextIO | None = None, keys: TextIO | None = None) -> None:
        self._out = out or sys.stdout
        keys = sys.stdin if keys is None else keys
        self._keys = keys.fileno() if keys is not None and not keys.closed and keys.isatty() else None
        self._mode: list[Any] | None = None

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Take the terminal, and give it back. Raises EndedError inside for SIGTERM and SIGHUP."""
        before = {number: signal.signal(number, _end) for number in ENDING}
        before[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._stop)
        try:
            self._enter()
            yield
        finally:
            self._leave()
            for number, handler in before.items():
                signal.signal(number, handler)

    def draw(self, lines: Sequence[str]) -> None:
        """Put these lines there, from the first on."""
        self._out.write(HOME + "\r\n".join(line + TO_END_OF_LINE for line in lines) + TO_END)
        self._out.flush()

    def size(self) -> tuple[int, int]:
        """Columns and lines."""
        return shutil.get_terminal_size()

    def key(self, within_s: float) -> str:
        """What is pressed within this time; empty: nothing. A change of the terminal's size ends the wait."""
        if self._keys is None:
            time.sleep(within_s)
            return ""
        ready, _, _ = select.select([self._keys], [], [], within_s)
        return os.read(self._keys, 1).decode("ascii", "replace") if ready else ""

    def _enter(self) -> None:
        if self._keys is not None:
            self._mode = termios.tcgetattr(self._keys)
            tty.setcbreak(self._keys)
        self._out.write(ENTER)
        self._out.flush()

    def _leave(self) -> None:
        if self._keys is not None and self._mode is not None:
            termios.tcsetattr(self._keys, termios.TCSADRAIN, self._mode)
        self._out.write(LEAVE)
        self._out.flush()

    def _stop(self, _number: int, _frame: FrameType | None) -> None:
        """Ctrl-Z: the shell gets its terminal, and we have it again when we go on."""
        self._leave()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._stop)
        self._enter()


def _end(number: int, _frame: FrameType | None) -> None:
    raise EndedError(number)
