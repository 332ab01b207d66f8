"""A fuzzer that keeps what it has learned: an input that runs a line which none before it has run goes into the corpus,
and later inputs are made from it."""

import hashlib
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from random import Random
from types import CodeType, FrameType
from typing import Any, Final

MAX_BYTES: Final = 8192
"""No input is longer."""
INTERESTING: Final = (
    b"\0", b"\x01", b"\x7f", b"\x80", b"\xff", b"\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x80\0\0\0",
    b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc0", b"\xcb\x7f\xf0\0\0\0\0\0\0", b": ", b"\n", b"- ", b"&a ",
    b"*a", b"[", b"{", b'"', b"\\u", b"%", b"\xed\xa0\x80", b"1e400", b"-1",
)  # fmt: skip
Target = Callable[[bytes], Callable[[], object]]
"""`target(data)()` tries one input. What the first call does, such as making a session, is not watched, and is fast."""
Line = tuple[CodeType, int]


class Coverage:
    """The lines of some files that calls have run, in this thread."""

    def __init__(self, watched: Sequence[str]) -> None:
        self._watched = tuple(watched)
        self.lines: set[Line] = set()

    def _trace(self, frame: FrameType, event: str, _argument: object) -> Any:
        if event == "call" and not frame.f_code.co_filename.startswith(self._watched):
            return None
        if event == "line":
            self.lines.add((frame.f_code, frame.f_lineno))
        return self._trace

    def new(self, call: Callable[[], object]) -> bool:
        """Run `call`; whether it has run a line that was never run before. What it raises goes on."""
        before = len(self.lines)
        earlier = sys.gettrace()
        sys.settrace(self._trace)
        try:
            call()
        finally:
            sys.settrace(earlier)
        return len(self.lines) > before


class Corpus:
    """Inputs in a directory, each under the hash of its content; what made the target fail is under `failure-`."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        directory.mkdir(parents=True, exist_ok=True)
        self.inputs = [path.read_bytes() for path in sorted(directory.glob("input-*"))]

    def add(self, data: bytes) -> None:
        self.inputs.append(data)
        self._write("input", data)

    def failed(self, data: bytes) -> Path:
        """Keep an input that made the target fail; where it is."""
        return self._write("failure", data)

    def _write(self, kind: str, data: bytes) -> Path:
        path = self.directory / f"{kind}-{hashlib.sha256(data).hexdigest()[:16]}"
        path.write_bytes(data)
        return path


def mutated(data: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Another input made from `data`, and perhaps from one of the others."""
    result = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4, 8))):
        at = random.randint(0, len(result))
        match random.randrange(7):
            case 0 if at < len(result):
                result[at] ^= 1 << random.randrange(8)
            case 1 if at < len(result):
                result[at] = random.randrange(256)
            case 2:
                del result[at : at + random.randint(1, 16)]
            case 3:
                piece = random.choice(INTERESTING)
                result[at : at + random.choice((0, len(piece)))] = piece
            case 4:
                result[at:at] = result[at : at + random.randint(1, 64)]
            case 5:
                other = random.choice(others)
                start = random.randint(0, len(other))
                result[at:] = other[start:]
            case _:
                result[at:at] = random.randbytes(random.randint(1, 8))
    return bytes(result[:MAX_BYTES])


class FoundError(Exception):
    """The target failed at an input."""

    def __init__(self, path: Path, error: BaseException) -> None:
        super().__init__(f"{type(error).__name__}: {error} (kept as {path})")
        self.path = path


class Fuzzer:
    """Tries inputs on `target`: whatever it raises is a fault. Begins with `seeds` and the corpus.

    Raises FoundError at the first fault."""

    def __init__(
        self, target: Target, seeds: Iterable[bytes], corpus: Corpus, *, watched: Sequence[str], seed: int = 0
    ) -> None:
        self.tried = 0
        self.corpus = corpus
        self._target = target
        self._random = Random(seed)
        self._coverage = Coverage(watched)
        self._known = [*seeds, *corpus.inputs] or [b""]
        for data in self._known:
            self._try(data)

    @property
    def lines(self) -> int:
        """Lines that have been run."""
        return len(self._coverage.lines)

    def run(self, *, runs: int | None = None, seconds: float = 0.0) -> None:
        """Try so many inputs, or for so long."""
        end_s = time.monotonic() + seconds
        while self.tried < runs if runs is not None else time.monotonic() < end_s:
            data = mutated(self._random.choice(self._known), self._known, self._random)
            if self._try(data):
                self._known.append(data)
                self.corpus.add(data)

    def _try(self, data: bytes) -> bool:
        self.tried += 1
        try:
            return self._coverage.new(self._target(data))
        except Exception as error:
            raise FoundError(self.corpus.failed(data), error) from error
