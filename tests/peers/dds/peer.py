"""The independent DDS peer: Fast DDS of Debian, compiled once, spoken to over pipes."""

import asyncio
import hashlib
import itertools
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import pytest

from sern_tools.ports import claim
from tests.support import DEADLINE_S

SOURCES: Final = Path(__file__).resolve().parent
BUILD_TIMEOUT_S: Final = 600
LEASE_S: Final = 600.0
"""Nobody is taken for dead: a busy machine may let a process stand still for some seconds."""
MAX_LINE_BYTES: Final = 64 * 2**20
HEADER: Final = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")


def missing_packages() -> list[str]:
    """The Debian packages that the peer cannot be built without."""
    missing = [program for program in ("fastddsgen", "g++") if shutil.which(program) is None]
    return missing if HEADER.exists() else [*missing, "libfastrtps-dev"]


def build_peer() -> Path:
    """The peer program, compiled unless that was done before. Skips the test and names what is missing."""
    if missing := missing_packages():
        pytest.skip(f"no independent DDS peer: apt-get install {' '.join(missing)}")
    sources = [SOURCES / "Peer.idl", SOURCES / "peer.cpp"]
    # A checkout may be shared by systems with other libraries, and by users who cannot write each other's folders.
    made_of = [
        Path("/etc/os-release").read_bytes(),
        str(os.getuid()).encode(),
        *(path.read_bytes() for path in sources),
    ]
    digest = hashlib.sha256(b"\0".join(made_of)).hexdigest()[:16]
    cache = SOURCES.parents[2] / "build" / f"dds-peer-{digest}"
    program = cache / "peer"
    if program.exists():
        return program
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for path in sources:
            shutil.copy(path, folder)
        # Without -t it writes /tmp/Peer.idl.cc, which may be another user's, or of a build at the same time.
        _run(["fastddsgen", "-replace", "-cs", "-t", str(folder), "Peer.idl"], folder)
        units = ["peer.cpp", "Peer.cxx", "PeerPubSubTypes.cxx"]
        _run(["g++", "-O1", "-std=c++17", "-o", "peer", *units, "-lfastrtps", "-lfastcdr", "-lpthread"], folder)
        cache.mkdir(parents=True, exist_ok=True)
        # Complete under its final name or not there at all: another session may build it too.
        shutil.copy2(folder / "peer", cache / f"peer.{os.getpid()}")
        (cache / f"peer.{os.getpid()}").replace(program)
    return program


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=BUILD_TIMEOUT_S, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout[-2000:]}{done.stderr[-2000:]}"


_domains: Final = itertools.cycle([(os.getpid() + number) % 80 + 20 for number in range(80)])
"""Those whose ports are below the ones that the system gives to anybody."""
DOMAINS_AT_ONCE: Final = 6
"""More than any test is in. Claims to those of earlier tests would leave none to another run on this host."""


def free_domain() -> int:
    """A DDS domain that nobody on this host is in: its first unicast port is free, and no other process of tests is
    given it meanwhile."""
    for domain in itertools.islice(_domains, 80):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            except OSError:
                continue
        if claim(f"dds-domain-{domain}", DOMAINS_AT_ONCE):
            return domain
    raise AssertionError("every DDS domain of this host is in use")


class PeerError(AssertionError):
    """The peer could not do what it was told, or has ended."""


class Peer:
    """A running peer. `said` keeps every line but the answers to commands; `deadline_s` is for whatever is awaited."""

    def __init__(self, program: Path, domain: int, *, lease_s: float = LEASE_S, deadline_s: float = DEADLINE_S) -> None:
        self._lease_s = lease_s
        self._deadline_s = deadline_s
        self._program = program
        self._domain = domain
        self._process: asyncio.subprocess.Process | None = None
        self._reading: asyncio.Task[None] | None = None
        self._done = 0
        self.said: list[str] = []
        self._news = asyncio.Event()

    async def __aenter__(self) -> Self:
        self._process = await asyncio.create_subprocess_exec(
            self._program,
            str(self._domain),
            str(round(self._lease_s)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=MAX_LINE_BYTES,
        )
        self._reading = asyncio.create_task(self._read())
        await self.line("guid ")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process is not None and self._process.stdin is not None and self._reading is not None
        self._process.stdin.close()
        try:
            await asyncio.wait_for(self._process.wait(), self._deadline_s)
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
            raise
        finally:
            await self._reading

    async def _read(self) -> None:
        assert self._process is not None and self._process.stdout is not None
        while line := await self._process.stdout.readline():
            text = line.decode().rstrip("\n")
            if text.startswith("done "):
                self._done += 1
            else:
                self.said.append(text)
            self._news.set()
        self._news.set()  # it has ended

    async def do(self, command: str) -> None:
        """Give a command and wait until it is done."""
        before = self._done
        self.send(command)
        await self.until(lambda: self._done > before)

    def send(self, command: str) -> None:
        assert self._process is not None and self._process.stdin is not None
        self._process.stdin.write(command.encode(errors="surrogateescape") + b"\n")

    async def crash(self) -> None:
        """It goes without a word to anybody."""
        assert self._process is not None
        self.send("crash")
        await asyncio.wait_for(self._process.wait(), self._deadline_s)

    async def until(self, condition: Callable[[], bool]) -> None:
        try:
            async with asyncio.timeout(self._deadline_s):
                while not condition():
                    if failed := self.lines("failed "):
                        raise PeerError(f"the peer: {' '.join(failed[-1])}")
                    if self._reading is None or self._reading.done():
                        raise PeerError("the peer has ended")
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise PeerError(f"the peer said nothing else in {self._deadline_s:.0f} s: {self.said[-20:]}") from None

    def lines(self, beginning: str) -> list[list[str]]:
        """The words of each line that begins so."""
        return [line.split(" ") for line in self.said if line.startswith(beginning)]

    async def line(self, beginning: str, number: int = 0) -> list[str]:
        """The words of the first (or a later) line that begins so, once it is said."""
        await self.until(lambda: len(self.lines(beginning)) > number)
        return self.lines(beginning)[number]

    def got(self, ident: str) -> list[bytes]:
        """What a reader of the peer received so far."""
        return [bytes.fromhex(words[2]) for words in self.lines(f"got {ident} ")]
