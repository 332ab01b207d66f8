"""The programs of deploy/examples/plain: how to build them, start them, and read what they print."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import pytest
import zmq

from tests.support import child

ROOT: Final = Path(__file__).resolve().parents[1]
PLAIN: Final = ROOT / "deploy" / "examples" / "plain"
STAND_IN: Final = ROOT / "tests" / "plain" / "NetMQ.cs"
CASES: Final = ROOT / "tests" / "plain" / "Cases.cs"
NETMQ: Final = "SERN_NETMQ"
"""Names a folder with NetMQ.dll and what it needs (AsyncIO.dll, NaCl.dll, for .NET Framework)."""
_MESSAGE: Final = re.compile(r"(/\S+) (\d+): x (\S+) y (\S+) z (\S+) m, (\S+) s old")
_SILENCE: Final = re.compile(r"nothing for (\d+) s(?:: the last is (\S+) s old)?")


class Heard(NamedTuple):
    """A line about a message."""

    topic: str
    seq: int
    position_m: tuple[float, float, float]
    age_s: float


class Silence(NamedTuple):
    """A line about nothing; `age_s`: of the last message, None before the first."""

    for_s: int
    age_s: float | None


def read(line: str) -> Heard | Silence:
    """What a line says; fails the test for any other line."""
    if found := _MESSAGE.fullmatch(line):
        topic, seq, *numbers = found.groups()
        x, y, z, age_s = (float(number) for number in numbers)
        return Heard(topic, int(seq), (x, y, z), age_s)
    found = _SILENCE.fullmatch(line)
    assert found, f"a line of another kind: {line}"
    for_s, age = found.groups()
    return Silence(int(for_s), None if age is None else float(age))


def need_mono() -> None:
    """Skip the test where there is no Mono."""
    for name in ("mcs", "mono"):
        if shutil.which(name) is None:
            pytest.skip(f"no {name} here: Debian packages mono-mcs and mono-runtime")


def compiled(directory: Path, *more: str | Path) -> list[str]:
    """Compile Feed.cs as C# 7, without a warning; the command that starts it."""
    need_mono()
    target = directory / "Feed.exe"
    command = ["mcs", "-langversion:7", "-warnaserror", f"-out:{target}", str(PLAIN / "Feed.cs"), *map(str, more)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ["mono", str(target)]


class Prepared(NamedTuple):
    """How to start a program: its command, and what its environment has beside that of the tests."""

    command: list[str]
    environment: dict[str, str]


def over_python(_directory: Path) -> Prepared:
    """feed.py."""
    return Prepared([sys.executable, "-I", str(PLAIN / "feed.py")], {})


def over_libzmq(directory: Path) -> Prepared:
    """Feed.cs over the stand-in for NetMQ, which finds the libzmq of pyzmq."""
    need_mono()
    assert zmq.zmq_version()  # it is loaded
    mapped = (line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "/libzmq" in line)
    library = next((Path(name) for name in mapped), None)
    if library is None:
        pytest.skip("pyzmq has its libzmq built in, where no other program finds it")
    (directory / "libzmq.so").symlink_to(library)
    return Prepared(compiled(directory, STAND_IN), {"LD_LIBRARY_PATH": f"{directory}:{library.parent}"})


def over_netmq(directory: Path) -> Prepared:
    """Feed.cs over NetMQ itself."""
    need_mono()
    place = Path(os.environ.get(NETMQ, ""))
    if not (place / "NetMQ.dll").is_file():
        pytest.skip(f"no NetMQ: {NETMQ} names no folder with NetMQ.dll, AsyncIO.dll and NaCl.dll for .NET Framework")
    return Prepared(compiled(directory, f"-r:{place / 'NetMQ.dll'}"), {"MONO_PATH": str(place)})


PROGRAMS: Final[Mapping[str, Callable[[Path], Prepared]]] = {
    "python": over_python,
    "libzmq": over_libzmq,
    "netmq": over_netmq,
}
"""Each makes what it needs in a folder, and skips the test where that cannot be."""


class Program:
    """One of the programs while it runs."""

    def __init__(self, process: "subprocess.Popen[bytes]", output: Path) -> None:
        self.process = process
        self._output = output

    @property
    def said(self) -> list[Heard | Silence]:
        """Its whole lines so far. The program must be running."""
        text = self._output.read_text()
        assert self.process.poll() is None, f"it ended:\n{text}"
        return [read(line) for line in text[: text.rfind("\n") + 1].splitlines()]

    @property
    def heard(self) -> list[Heard]:
        return [line for line in self.said if isinstance(line, Heard)]


@contextmanager
def running(prepared: Prepared, directory: Path, address: str, topic: str) -> Iterator[Program]:
    """Start a program, and end it with the block. What it prints is in printed.txt."""
    output = directory / "printed.txt"
    with (
        output.open("wb") as stream,
        child(
            [*prepared.command, address, topic],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=os.environ | prepared.environment,
        ) as process,
    ):
        yield Program(process, output)
