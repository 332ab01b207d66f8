"""The client's end of its guard: when a guard that says nothing is given up. Processes that answer as a test wants."""

import asyncio
import base64
import json
import os
import sys
from asyncio.subprocess import Process
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import uvloop

from sern_client import guard
from sern_client.guard import Guard
from sern_client.guard_process import GuardProcess
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import clock, ros_types
from sern_runtime.config.endpoints import Ros1Endpoint
from sern_runtime.config.shared import LogSection
from tests.support import ended, until

ANSWERS = """
import json, sys
for line in sys.stdin:
    said = json.loads(line)
    if "ping" in said:
        print(json.dumps({"pong": said["ping"]}), json.dumps({"stopped": 1}), sep="\\n", flush=True)
"""
"""What it says has stopped counts its answers."""
NOISY = (
    """
import sys
noises = b"1790000.123 [0] tev: a trace", b"x" * 200_000, b"5", b"[1]", b'{"pang": 1}', b"\\xff\\xfe", b"[" * 60_000
sys.stdout.buffer.write(b"\\n".join(noises) + b"\\n")
"""
    + ANSWERS
)
CHATTER = """
import os, threading, time
os.write(1, b"chatter at the start\\n")

def chatter():
    while True:
        os.write(1, b"chatter of a library\\n")
        time.sleep(0.01)

threading.Thread(target=chatter, daemon=True).start()
"""
SILENT = "import sys; sys.stdin.read()"


class Skipping(uvloop.Loop):
    """Its time may jump, as it does for a process that stood still."""

    skipped_s = 0.0

    def time(self) -> float:
        return super().time() + self.skipped_s


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], Guard]:
    """A guard that is pinged often and whose process is a script."""
    monkeypatch.setattr(guard, "PING_S", 0.01)
    spawn = guard._spawn

    def made(script: str) -> Guard:
        async def spawned(*_: str) -> Process:
            return await spawn(sys.executable, "-c", script)

        monkeypatch.setattr(guard, "_spawn", spawned)
        return Guard([], tmp_path, LogSection())

    return made


def test_a_client_that_stood_still_keeps_its_guard(runs: Callable[[str], Guard]) -> None:
    async def stand_still() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, Skipping)
        watched = runs(ANSWERS)
        watched.start()
        try:
            await until(lambda: watched.stopped >= 3)
            loop.skipped_s += 10 * guard.SILENT_S
            before = watched.stopped
            await until(lambda: watched.stopped >= before + 5 or watched.restarts)
            assert watched.restarts == 0
        finally:
            await watched.stop()

    with asyncio.Runner(loop_factory=Skipping) as runner:
        runner.run(stand_still())


class Stops:
    """An endpoint that notes what is published; `TopicEvents` are not asked of it."""

    encoding = None

    def __init__(self) -> None:
        self.published: list[bytes] = []

    def advertise(self, _info: TopicInfo) -> "Stops":
        return self

    def publish(self, body: bytes, _stamp_ns: int) -> None:
        self.published.append(body)

    def close(self) -> None: ...


@pytest.mark.parametrize("behind", [b"", b'{"lease": 1, "du', b"no line of a client\n"])
async def test_the_last_word_of_a_client_counts_also_when_its_end_is_seen_first(behind: bytes) -> None:
    """It armed a lease, published the command and was killed: the command is the last that the robot has heard."""
    told, telling = os.pipe()
    heard, answering = os.pipe()
    endpoint = Stops()
    process = GuardProcess(endpoint, told, answering)  # type: ignore[arg-type]
    info = {"name": "/cmd_vel", "type_name": "geometry_msgs/msg/Twist", "encoding": "cdr"}
    opened = {"open": 1, "info": info, "stop": base64.b64encode(b"stop").decode()}
    for said in (opened, {"lease": 1, "due": clock.now() + 3600.0}):
        os.write(telling, json.dumps(said).encode() + b"\n")
    os.write(telling, behind)
    os.close(telling)
    with suppress(json.JSONDecodeError):  # a fault; nothing less is stopped for it
        process.parent_gone()
    assert endpoint.published == [b"stop"]
    assert json.loads(os.read(heard, 100)) == {"stopped": 1}
    process.close()
    for descriptor in (told, heard, answering):
        os.close(descriptor)


async def test_a_guard_that_answers_no_ping_is_started_again(
    runs: Callable[[str], Guard], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(guard, "SILENT_S", 0.05)
    watched = runs(SILENT)
    watched.start()
    await until(lambda: watched.restarts == 1)
    await watched.stop()
    assert "has not answered for 0.05 s; it is killed" in caplog.text
    assert "has ended (exit code -9)" in caplog.text


async def test_text_among_its_answers_is_said_once_and_skipped(
    runs: Callable[[str], Guard], caplog: pytest.LogCaptureFixture
) -> None:
    watched = runs(NOISY)
    watched.start()
    try:
        await until(lambda: watched.stopped >= 3)
        assert watched.restarts == 0
    finally:
        await watched.stop()
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert said.endswith("says what is no answer, here and from now on: 1790000.123 [0] tev: a trace")


async def test_text_is_no_sign_of_life(runs: Callable[[str], Guard], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "SILENT_S", 0.05)
    watched = runs("import sys\nfor line in sys.stdin: print('I am not well', flush=True)")
    watched.start()
    await until(lambda: watched.restarts == 1)
    await watched.stop()


async def test_an_error_of_ours_ends_the_guard_and_starts_another(
    runs: Callable[[str], Guard], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(guard, "AGAIN_S", (0.01, 0.01))
    watched = runs(ANSWERS)
    original, pids = Guard._answered, list[int]()

    def failing(self: Guard, said: dict[str, object]) -> None:
        if not pids:
            assert self._process is not None
            pids.append(self._process.pid)
            raise KeyError("nobody expected this")
        original(self, said)

    monkeypatch.setattr(Guard, "_answered", failing)
    watched.start()
    try:
        await until(lambda: watched.stopped >= 3)
        assert watched.restarts == 1
        assert ended(pids[0]), "it does not live on beside the new one"
    finally:
        await watched.stop()
    assert "nobody expected this" in caplog.text and "has ended (KeyError); started again" in caplog.text


async def test_a_library_that_writes_to_standard_output_does_not_disturb_the_guard(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """The real process, in which something writes to descriptor 1 from its first moment to its last."""
    (tmp_path / "sitecustomize.py").write_text(CHATTER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    section = Ros1Endpoint(kind="ros1", master_uri="http://127.0.0.1:1", host="127.0.0.1")
    watched = Guard([section], tmp_path, LogSection())
    watched.start()
    try:
        key = watched.opened(ros_types.topic_info("/cmd_vel", "geometry_msgs/msg/Twist", Encoding.ROS1), b"")
        await until(lambda: watched.ready)
        chattered: list[str] = []

        def heard() -> bool:
            chattered.append(capfd.readouterr().err)
            return "chatter of a library" in "".join(chattered)

        await until(heard)
        watched.lease(key, clock.now() - 1.0)
        await until(lambda: watched.stopped == 1)
        assert watched.restarts == 0 and watched.ready
    finally:
        await watched.stop()
    assert caplog.text.count("what is no answer, here and from now on: chatter at the start") == 1


async def test_a_guard_that_writes_without_end_is_ended_with_its_client(
    runs: Callable[[str], Guard], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What nobody reads any more holds back the news of its end."""
    monkeypatch.setattr(guard, "END_S", 0.05)
    watched = runs("while True: print('I am not well')")
    watched.start()
    await until(lambda: watched._process is not None)
    process = watched._process
    assert process is not None
    await watched.stop()
    assert process.returncode == -9
