"""What a person has after `source setup.bash`: the environment of a ROS 2 installation, for processes of ours."""

import asyncio
import contextlib
import itertools
import json
import os
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

import pytest

from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Child, Children
from tests.support import Patience, until

HERE: Final = Path(__file__).parents[3]
PLACES: Final = Path(os.environ.get("SERN_ROS2_PEERS") or HERE / ".venv-ros2")
"""Where tests/peers/ros2/setup makes the environments: venvs, whose rclpy is for the Python that made them."""
DISTROS: Final = ("jazzy", "kilted")
PLACE: Final = PLACES / "jazzy"
PROGRAM: Final = Path(__file__).with_name("rclpy_node.py")
LOOPBACK: Final = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ""}


def sourced(distro: str = "jazzy") -> dict[str, str]:
    """The variables that its setup file would set. Skips the test where there is none for this Python."""
    try:
        return environment(distro)
    except LookupError as error:
        pytest.skip(str(error))


def environment(distro: str) -> dict[str, str]:
    """The same; LookupError, which says what to do, where there is none."""
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    place = PLACES / distro
    packages = place / "lib" / python / "site-packages"
    if not (packages / "rclpy").is_dir():
        raise LookupError(
            f"no ROS 2 {distro} with {python} in {PLACES}: PYTHON={python} tests/peers/ros2/setup {distro}"
        )
    libraries = [place / "lib", *sorted(packages.glob("ros_*.libs"))]
    return {
        "PYTHONPATH": os.pathsep.join([str(packages), str(HERE)]),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "AMENT_PREFIX_PATH": str(place),
        "ROS_DISTRO": distro,
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",  # else its start-up hook would run this Python once more
        **LOOPBACK,
    }


def before(distro: str = "jazzy") -> list[str]:
    """What to put before the command of a daemon that is to run sourced."""
    return ["env", *(f"{key}={value}" for key, value in sourced(distro).items())]


async def until_answered(ask: Callable[[], Awaitable[dict[str, Any]]], count: int) -> None:
    """Ask again until the answer has this count. Each answer comes from another process, which is the pause."""
    patience = Patience()
    while (answer := await ask())["count"] != count:
        assert not patience.over(), f"{answer} in place of {count}"


async def until_fed(node: "RosNode", what: str, **goal: Any) -> None:
    """Give goals until feedback of one comes. A goal is over so soon that its feedback may be earlier than whoever
    wants it at the far side is known to its server's node."""
    patience = Patience()
    for number in itertools.count():
        key = f"first {number}"
        await node.do(what, key=key, **goal)
        await node.event("result", key=key)
        if node.of("feedback"):
            return
        assert not patience.over(), "no feedback"


class RosNode:
    """A real node in a process of its own. `events` keeps what it says unasked."""

    def __init__(self, child: Child) -> None:
        self.events: list[dict[str, Any]] = []
        self._child = child
        self._ids = itertools.count(1)
        self._answers: dict[int, dict[str, Any]] = {}
        self._reading = asyncio.create_task(self._read())

    async def do(self, what: str, **details: Any) -> dict[str, Any]:
        """Tell it to do something; its answer."""
        number = next(self._ids)
        await self._child.say(json.dumps({"do": what, "id": number, **details}))
        await until(lambda: number in self._answers or self._reading.done(), f"{self._child.name} answers {what}")
        if self._reading.done():
            self._reading.result()
        answer = self._answers.pop(number)
        assert "error" not in answer, f"{what} {details}: {answer['error']}"
        return answer

    def of(self, event: str, **matching: Any) -> list[dict[str, Any]]:
        """Events of a kind, those with these values."""
        return [
            each
            for each in self.events
            if each["event"] == event and all(each.get(key) == value for key, value in matching.items())
        ]

    async def event(self, event: str, count: int = 1, **matching: Any) -> dict[str, Any]:
        """The `count`th event of a kind, once it has happened."""
        await until(lambda: len(self.of(event, **matching)) >= count, f"{self._child.name} says {event} {matching}")
        return self.of(event, **matching)[count - 1]

    def got(self, topic: str) -> list[str]:
        return [each["value"] for each in self.of("got", topic=topic)]

    async def end(self) -> None:
        self._reading.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._reading

    async def _read(self) -> None:
        while True:
            try:
                said = await self._child.read_object()
            except SernError:
                if self._child.stopping:
                    return
                raise
            if "id" in said:
                self._answers[said["id"]] = said
            else:
                self.events.append(said)


class RosNodes:
    """`async with RosNodes(directory) as nodes:` every node that is left at the end is stopped."""

    def __init__(self, directory: Path, distro: str = "jazzy") -> None:
        self._directory = directory
        self._distro = distro
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> "RosNodes":
        self._environment = sourced(self._distro)
        self._children = await self._stack.enter_async_context(Children(self._directory))
        return self

    async def __aexit__(self, *failure: Any) -> None:
        await self._stack.__aexit__(*failure)

    async def start(self, domain: int, name: str, *arguments: str) -> RosNode:
        program = [sys.executable, "-P", str(PROGRAM), str(domain), name, *arguments]
        child = await self._children.start(name, program, talks=True, environment=self._environment)
        node = RosNode(child)
        self._stack.push_async_callback(node.end)
        await node.event("ready")
        return node

    def kill(self, name: str) -> None:
        """Kill it, as a crash does: it says goodbye to nobody."""
        (child,) = [child for child in self._children.children if child.name == name]
        child.stopping = True
        child.signal(9)
