"""The guard: a small process beside the client that publishes stop commands when the client does not.

The client's event loop may be held up, the process stopped or killed; its command leases run out all the same. The
guard has endpoints of its own at the same masters and domains, as a node of its own (`NAME_guard`), and publishers of
the command topics that are connected before they are needed. `sern_client/guard.py` starts it.

What the client says, a line of JSON each, on standard input:

    {"endpoints": [...], "folder": "...", "log": {...}}              first: what to join
    {"open": 1, "info": {...}, "stop": "base64", "ramp": {...}}      a command topic with a lease, its stop command, and
                                                                     how its robot is slowed down, if it is
    {"lease": 1, "due": 1234.5}                                      its deadline (sern_runtime.clock), null: not armed
    {"lease": 1, "due": 1234.5, "command": "base64", "said": 1234.0} the same, for this command; null: it has no ramp
    {"lease": 1, "due": 1234.5, "since": 1234.4}                     the same, while the robot is being slowed down
    {"close": 1}                                                     the client has said what there was to say
    {"ping": 7}

What it answers, on what was standard output when it began: {"ready": true}, {"stopped": 1} for each lease that ran out
here, {"pong": 7}. Libraries that write to standard output (a trace of DDS, the log of rclpy) are given standard error.
When standard input ends, or its parent does, whatever is armed is due at once; then it ends. Signals do not end it:
those to a whole group come while the client still has to say its own stop commands.
"""

import asyncio
import base64
import json
import logging
import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import uvloop
from pydantic import TypeAdapter

from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.conversion import Converter
from sern_client.sections import make_section
from sern_core.bodies.twist import TwistBody
from sern_core.site.lease import GuardLease
from sern_core.topics.rules import Ramp
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, logs
from sern_runtime.config.base import resolve
from sern_runtime.config.endpoints import EndpointSection
from sern_runtime.fine_timer import fine_timer

READ_BYTES: Final = 64 * 1024
STDOUT: Final = 1
STDERR: Final = 2

_log = logging.getLogger("sern_client.guard_process")


class _Nothing:
    """`TopicEvents` of an endpoint that only publishes."""

    def topic_added(self, info: TopicInfo) -> None: ...

    def topic_removed(self, name: TopicName) -> None: ...


@dataclass(slots=True)
class _Guarded:
    """A command topic. `publisher` None: it cannot be published here."""

    name: TopicName
    publisher: Publisher | None
    info: TopicInfo
    stop: bytes
    lease: GuardLease


class GuardProcess:
    """What the guard does with the lines it is told; `over` is set once the client is gone and all is said."""

    def __init__(self, endpoint: Endpoint, source: int, answers: int) -> None:
        self.over = asyncio.Event()
        self._endpoint = endpoint
        self._source = source
        self._answers = answers
        self._rest = b""
        self._topics: dict[int, _Guarded] = {}
        self._gone = False
        self._timer = fine_timer(self._due)
        os.set_blocking(source, False)
        os.set_blocking(answers, False)
        asyncio.get_running_loop().add_reader(source, self._readable)

    def say(self, answer: dict[str, object]) -> None:
        """One that does not listen is not waited for."""
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(self._answers, json.dumps(answer).encode() + b"\n")

    def parent_gone(self) -> None:
        """The client ended: what is armed is due now, also by its last word, which may still be in the pipe."""
        if self._gone:
            return
        try:
            self._take()
        finally:  # what is wrong with it, too, keeps nothing from being stopped
            self._end()

    def _end(self) -> None:
        self._gone = True
        asyncio.get_running_loop().remove_reader(self._source)
        now = clock.now()
        for topic in self._topics.values():
            topic.lease.abandoned(now=now)
        self._due()

    def close(self) -> None:
        self._timer.close()
        for topic in self._topics.values():
            if topic.publisher is not None:
                topic.publisher.close()

    def _readable(self) -> None:
        self._read()
        self._arm()

    def _read(self) -> None:
        if not self._gone and not self._take():
            self.parent_gone()

    def _take(self) -> bool:
        """Take what the client has said so far. False: that was its last word."""
        while True:
            try:
                chunk = os.read(self._source, READ_BYTES)
            except BlockingIOError:
                return True
            if not chunk:
                return False
            *lines, self._rest = (self._rest + chunk).split(b"\n")
            for line in lines:
                self._told(json.loads(line))

    def _told(self, said: dict[str, Any]) -> None:
        if "lease" in said:
            topic = self._topics[said["lease"]]
            if "command" in said:
                topic.lease.commanded(_command(topic.info, said["command"]), said_s=said["said"])
            topic.lease.told(said["due"], since_s=said.get("since"))
        elif "open" in said:
            ramp = Ramp(**said["ramp"]) if "ramp" in said else None
            self._open(said["open"], _info(said["info"]), base64.b64decode(said["stop"]), ramp)
        elif "close" in said:
            topic = self._topics.pop(said["close"])
            if topic.publisher is not None:
                topic.publisher.close()
        elif "ping" in said:
            self.say({"pong": said["ping"]})

    def _open(self, key: int, info: TopicInfo, stop: bytes, ramp: Ramp | None) -> None:
        publisher = None
        try:
            publisher = Converter().advertise(self._endpoint, info)
        except ConfigError as error:
            _log.error("%s: the guard cannot publish its stop command: %s", info.name, error)
        self._topics[key] = _Guarded(info.name, publisher, info, stop, GuardLease(ramp))

    def _due(self) -> None:
        self._read()  # the last word of the client, if there is one, comes first
        now = clock.now()
        for key, topic in self._topics.items():
            first = not topic.lease.expired
            if not topic.lease.due(now=now):
                continue
            slowed = topic.lease.slowed(now=now)
            self._publish(topic, topic.stop if slowed is None else slowed)
            if first:
                why = "the client has ended" if self._gone else "the client does not answer"
                what = "publishing the stop command" if slowed is None else "slowing the robot down"
                _log.warning("%s: %s; %s", topic.name, why, what)
                self.say({"stopped": key})
        self._arm()

    def _publish(self, topic: _Guarded, body: bytes) -> None:
        if topic.publisher is None:
            return
        try:
            topic.publisher.publish(body, time.time_ns())
        except Exception:  # noqa: BLE001  (a fault of one topic; the others are to be stopped all the same)
            _log.exception("%s: the stop command could not be published", topic.name)

    def _arm(self) -> None:
        deadlines_s = [due_s for topic in self._topics.values() if (due_s := topic.lease.deadline()) is not None]
        self._timer.arm(min(deadlines_s) if deadlines_s else None)
        if self._gone and not deadlines_s:
            self.over.set()


def _command(info: TopicInfo, said: str | None) -> TwistBody | None:
    return None if said is None else TwistBody.read(info.type_name, info.encoding, base64.b64decode(said))


def _info(said: dict[str, Any]) -> TopicInfo:
    return TopicInfo(**{**said, "encoding": Encoding(said["encoding"])})


def _make_endpoint(said: dict[str, Any]) -> Endpoint:
    folder = Path(said["folder"])
    sections = TypeAdapter(list[EndpointSection]).validate_json(json.dumps(said["endpoints"]))
    made = [make_section(section, lambda text: resolve(folder, text), second=True) for section in sections]
    return made[0] if len(made) == 1 else CompositeEndpoint(made)


def _watch(parent: int) -> int | None:
    """A descriptor that tells of the client's end; None where the kernel has none (before 5.3), or it has ended."""
    try:
        return os.pidfd_open(parent)
    except OSError:
        return None


async def guard(parent: int, answers: int) -> None:
    """Runs until the client is gone. `answers`: the descriptor to answer at. Raises ConfigError when an endpoint cannot
    be started."""
    source = sys.stdin.fileno()
    head = b""
    while not head.endswith(b"\n"):  # byte by byte: what follows is for the reader
        byte = os.read(source, 1)
        if not byte:
            return
        head += byte
    said = json.loads(head)
    logs.configure(log_format=said["log"]["format"], level=said["log"]["level"].upper())
    loop = asyncio.get_running_loop()
    endpoint = _make_endpoint(said)
    await endpoint.start(_Nothing())
    try:
        process = GuardProcess(endpoint, source, answers)
        watch = _watch(parent)  # a child of the client may hold its end of the pipe after it
        try:
            if watch is not None:
                loop.add_reader(watch, process.parent_gone)
            if os.getppid() != parent:
                process.parent_gone()
            process.say({"ready": True})
            await process.over.wait()
        finally:
            if watch is not None:
                loop.remove_reader(watch)
                os.close(watch)
            process.close()
    finally:
        await endpoint.stop()


def main() -> int:
    answers = os.dup(STDOUT)
    os.dup2(STDERR, STDOUT)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    parent = int(sys.argv[1])
    try:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(guard(parent, answers))
    except ConfigError as error:
        print(f"sern-client guard: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
