"""Waiting by polling a condition, and what an endpoint announces, for tests with real sockets."""

import asyncio
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from sern_client.endpoints.base import ServiceInfo
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName

DEADLINE_S: Final = 240.0
"""Long enough for a machine that is busy with much else; reached only when something is broken."""
LASTING: Final[set[str]] = set()
"""What a library keeps open until its process ends, by design: no test is to blame for it."""
_POLL_S: Final = 0.002
_STEP_S: Final = 0.5
"""The most that the time between two polls counts for."""


def open_sockets() -> set[str]:
    """The sockets and event descriptors that this process has open, as /proc names them."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if target.startswith("socket:"):
            found.add(f"fd {entry.name} -> {target}")
    return found


class Patience:
    """A deadline in time that this process could use: a machine that stood still for half a minute is no failure."""

    def __init__(self, deadline_s: float = DEADLINE_S) -> None:
        self.left_s = deadline_s
        self._at = time.monotonic()

    def over(self) -> bool:
        """Whether the deadline has passed; to be asked at every poll."""
        now = time.monotonic()
        self.left_s -= min(now - self._at, _STEP_S)
        self._at = now
        return self.left_s <= 0.0


async def until(condition: Callable[[], object], what: str = "", *, deadline_s: float = DEADLINE_S) -> None:
    """Return once `condition()` is true; fail the test when it is not within `deadline_s` (see `Patience`)."""
    patience = Patience(deadline_s)
    while not condition():
        if patience.over():
            raise AssertionError(f"not within {deadline_s:g} s: {what or condition}")
        await asyncio.sleep(_POLL_S)


@contextmanager
def child(command: Sequence[str], **options: Any) -> Iterator["subprocess.Popen[Any]"]:
    """A process that is killed at the end of the block, so that a test that fails there does not wait for it for ever.

    `options` are those of `subprocess.Popen`.
    """
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(pid: int) -> bool:
    """Gone, or dead and waiting for somebody to ask after it: orphans are left to whatever is process 1."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


class Events:
    """`TopicEvents` and `ServiceEvents` that keep what an endpoint announces."""

    def __init__(self) -> None:
        self.infos: dict[TopicName, TopicInfo] = {}
        self.services: dict[TopicName, ServiceInfo] = {}
        self.added: list[TopicName] = []
        self.removed: list[TopicName] = []

    def topic_added(self, info: TopicInfo) -> None:
        assert info.name not in self.infos, f"{info.name} is announced twice"
        self.infos[info.name] = info
        self.added.append(info.name)

    def topic_removed(self, name: TopicName) -> None:
        del self.infos[name]
        self.removed.append(name)

    def service_added(self, info: ServiceInfo) -> None:
        assert info.name not in self.services, f"{info.name} is announced twice"
        self.services[info.name] = info

    def wants_service(self, name: TopicName) -> bool:
        return True

    def service_removed(self, name: TopicName) -> None:
        del self.services[name]
