"""The client's end of its guard: started beside it, told of every command lease, started again when it ends.

What the guard is for, and what is said over the pipes, is told in sern_client/guard_process.py. Only endpoints that
drive a robot have one: a recording or the simulated robot of this process has nothing that another could publish to.
"""

import asyncio
import base64
import json
import logging
import os
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Self

from sern_client.endpoints.base import GUARD_SUFFIX
from sern_client.factory import named_sections
from sern_core.topics.rules import Ramp
from sern_core.vocabulary.message import TopicInfo
from sern_runtime import clock
from sern_runtime.config import endpoints as sections
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import Loaded
from sern_runtime.config.shared import LogSection
from sern_runtime.entry import end_tasks

PING_S: Final = 1.0
SILENT_S: Final = 15.0
"""A guard that answers no ping for so long is killed and started again: longer than it needs to start on a busy
machine. Pings are counted, not time: while this process stands still, time goes on and the guard is not asked."""
AGAIN_S: Final = (1.0, 30.0)
"""First and longest pause before it is started again."""
END_S: Final = 3.0
"""How long it may take to leave its masters and domains."""
ANSWERS: Final = frozenset(("ready", "stopped", "pong"))
READ_BYTES: Final = 64 * 1024
SHOWN_CHARS: Final = 100
"""How much of a line that is no answer is shown."""

DrivesRobots = sections.Ros1Endpoint | sections.DdsEndpoint | sections.ZenohEndpoint | sections.RclpyEndpoint

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Topic:
    info: TopicInfo
    stop: bytes
    ramp: Ramp | None
    due_s: float | None = None
    command: bytes | None = None  # the last one, where it can be slowed down
    said_s: float = 0.0
    since_s: float | None = None


class Guard:
    """`start`, then any calls, then `stop`. Counts what it had to do, for metrics."""

    def __init__(self, joins: Sequence[DrivesRobots], folder: Path, log: LogSection) -> None:
        self.ready = False
        """Whether it runs and has joined what it is to join."""
        self.restarts = 0
        self.stopped = 0
        """Leases that ran out there because this process did not answer."""
        self._hello: dict[str, object] = {
            "endpoints": [section.model_dump(mode="json") for section in joins],
            "folder": str(folder),
            "log": {"format": log.format.value, "level": log.level.value},
        }
        self._topics: dict[int, _Topic] = {}
        self._next_key = 1
        self._process: Process | None = None
        self._ended_s: float | None = None  # since when none runs, after one had ended
        self._unanswered = 0  # pings since something was heard
        self._noticed = False  # a line that was no answer
        self._task: asyncio.Task[None] | None = None
        self._spawning: asyncio.Task[Process] | None = None

    @classmethod
    def of(cls, loaded: Loaded[ClientFile]) -> Self | None:
        """The guard that a client with this file needs; None: nothing there that it could stop."""
        model = loaded.model
        if all(section.on_link_loss is None for section in model.topics):
            return None
        joins = [
            section.model_copy(update={"node_name": f"{section.node_name}{GUARD_SUFFIX}"})
            for section in named_sections(model)
            if isinstance(section, DrivesRobots) and not _services_only(section)
        ]
        return cls(joins, loaded.path.parent.resolve(), model.log) if joins else None

    def start(self) -> None:
        self._task = asyncio.create_task(self._keep(), name="guard")

    async def stop(self) -> None:
        """What is armed still is due now: let the leases say their last word before."""
        if self._task is None:
            return
        await end_tasks([self._task])
        self._process = None
        if self._spawning is not None:
            with suppress(OSError):
                await _end(await self._spawning)

    # --- leases -----------------------------------------------------------------------------------------------------

    def opened(self, info: TopicInfo, stop: bytes, ramp: Ramp | None = None) -> int:
        """A command topic with a lease; returns what it is called in the calls below."""
        key, self._next_key = self._next_key, self._next_key + 1
        topic = self._topics[key] = _Topic(info, stop, ramp)
        self._say(_opening(key, topic))
        return key

    def commanded(self, key: int, due_s: float | None, command: bytes | None) -> None:
        """When the lease of a topic runs out now that a command comes. Call it before that is published. `command`: its
        body, where it can be slowed down."""
        topic = self._topics[key]
        topic.due_s, topic.command, topic.said_s, topic.since_s = due_s, command, clock.now(), None
        self._say(_commanded(key, topic) if topic.ramp is not None else {"lease": key, "due": due_s})

    def lease(self, key: int, due_s: float | None, *, since_s: float | None = None) -> None:
        """When the lease of a topic is due next. Call it after what was due is published. `since_s`: the robot is being
        slowed down since then."""
        topic = self._topics[key]
        topic.due_s, topic.since_s = due_s, since_s
        self._say(_leased(key, topic))

    def closed(self, key: int) -> None:
        del self._topics[key]
        self._say({"close": key})

    def _say(self, said: dict[str, object]) -> None:
        process = self._process
        if process is not None and process.stdin is not None and not process.stdin.is_closing():
            process.stdin.write(json.dumps(said).encode() + b"\n")

    # --- the process ------------------------------------------------------------------------------------------------

    async def _keep(self) -> None:
        pause_s = AGAIN_S[0]
        while True:
            try:
                code = await self._run()
            except Exception as error:  # noqa: BLE001  an error of ours must not leave the leases without a guard
                _log.exception("the guard of the command topics is killed, because what it says could not be heard")
                code = type(error).__name__
                await self._kill()
            if self.ready:
                pause_s = AGAIN_S[0]
            self.ready = False
            self._process = None
            self.restarts += 1
            if self._ended_s is None:
                self._ended_s = clock.now()
            _log.error(
                "the guard of the command topics has ended (%s); started again in %g s; until then a held-up client "
                "stops nothing",
                code, pause_s,
            )  # fmt: skip
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, AGAIN_S[1])

    async def _run(self) -> str:
        """Run it from its start to its end, and tell how it ended."""
        command = (sys.executable, "-P", "-m", "sern_client.guard_process", str(os.getpid()))
        try:
            self._spawning = asyncio.create_task(_spawn(*command), name="guard-spawn")
            process = await asyncio.shield(self._spawning)  # an end in the middle of it must not lose the process
        except OSError as error:
            return error.strerror or str(error)
        self._process = process
        self._say(self._hello)
        for key, topic in self._topics.items():
            self._say(_opening(key, topic))
            if topic.due_s is not None:
                if topic.ramp is not None:
                    self._say(_commanded(key, topic))
                self._say(_leased(key, topic))
        self._unanswered = 0
        silence = asyncio.create_task(self._listen_for_silence(process), name="guard-silence")
        try:
            assert process.stdout is not None
            await self._listen(process.stdout)
            return f"exit code {await process.wait()}"
        finally:
            await end_tasks([silence])

    async def _listen(self, answers: asyncio.StreamReader) -> None:
        """Hear its answers until their end. Other text among them is the word of some library, before the guard has
        taken standard output away from it."""
        while True:
            try:
                line = await answers.readline()
            except ValueError as error:  # longer than the reader keeps: what it has of it is gone
                self._notice(str(error))
                continue
            if not line:
                return
            said = _answer(line)
            if said is None:
                self._notice(line.decode(errors="replace"))
            else:
                self._unanswered = 0
                self._answered(said)

    def _notice(self, text: str) -> None:
        if not self._noticed:
            self._noticed = True
            shown = " ".join(text.split())[:SHOWN_CHARS]
            _log.warning("the guard of the command topics says what is no answer, here and from now on: %s", shown)

    async def _kill(self) -> None:
        """The one that runs shall not live on beside the next one."""
        process = self._process
        if process is None or process.returncode is not None:
            return
        with suppress(ProcessLookupError):
            process.kill()
        with suppress(TimeoutError):
            async with asyncio.timeout(END_S):
                await process.wait()

    async def _listen_for_silence(self, process: Process) -> None:
        number = 0
        while self._unanswered < SILENT_S / PING_S:
            await asyncio.sleep(PING_S)
            number += 1
            self._unanswered += 1
            self._say({"ping": number})
        _log.error("the guard of the command topics has not answered for %g s; it is killed", SILENT_S)
        process.kill()

    def _answered(self, said: dict[str, object]) -> None:
        if "ready" in said:
            self.ready = True
            process = self._process.pid if self._process else 0
            ended_s, self._ended_s = self._ended_s, None
            if ended_s is None:
                _log.info("the guard of the command topics runs as process %d", process)
            else:
                after_s = clock.now() - ended_s
                _log.error("the guard of the command topics runs again as process %d, after %.0f s", process, after_s)
        elif "stopped" in said:
            self.stopped += 1


def _answer(line: bytes) -> dict[str, object] | None:
    """What a line of its standard output says; None for what is no answer of a guard."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return said if isinstance(said, dict) and not ANSWERS.isdisjoint(said) else None


def _services_only(section: DrivesRobots) -> bool:
    """Whether it publishes nothing, and so no command that could be stopped."""
    return isinstance(section, sections.RclpyEndpoint) and section.services_only


def _opening(key: int, topic: _Topic) -> dict[str, object]:
    said: dict[str, object] = {
        "open": key,
        "info": asdict(topic.info),
        "stop": base64.b64encode(topic.stop).decode(),
    }
    return said if topic.ramp is None else {**said, "ramp": asdict(topic.ramp)}


def _commanded(key: int, topic: _Topic) -> dict[str, object]:
    command = None if topic.command is None else base64.b64encode(topic.command).decode()
    return {"lease": key, "due": topic.due_s, "command": command, "said": topic.said_s}


def _leased(key: int, topic: _Topic) -> dict[str, object]:
    said: dict[str, object] = {"lease": key, "due": topic.due_s}
    return said if topic.since_s is None else {**said, "since": topic.since_s}


async def _spawn(*command: str) -> Process:
    return await asyncio.create_subprocess_exec(*command, stdin=PIPE, stdout=PIPE)


async def _end(process: Process) -> None:
    """Close its standard input and wait for its end, or make one."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        async with asyncio.timeout(END_S):
            await _over(process)
    except TimeoutError:
        _log.error("the guard of the command topics does not end; it is killed")
        with suppress(ProcessLookupError):
            process.kill()
        await _over(process)


async def _over(process: Process) -> None:
    """Wait for its end. What it still says is read: a pipe that nobody reads holds back the news of the end."""
    while process.stdout is not None and await process.stdout.read(READ_BYTES):
        pass
    await process.wait()
