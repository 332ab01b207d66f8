"""A process of a run that fails is named, with its status and its own words; all are found from a bare checkout."""

import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks.child import cpu_s
from benchmarks.link import runs
from benchmarks.link.children import Running, environment
from benchmarks.link.peers import send_datagram
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import last_words
from tests.support import Patience

Start = Callable[[str, str], "subprocess.Popen[bytes]"]
WAIT = "import sys; sys.stdin.read()"
FAIL = "import sys; print('of no use', file=sys.stderr); {}['the key']"


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    made = Running(tmp_path, "floor")
    yield made
    made.stop()


@pytest.fixture
def start(running: Running) -> Start:
    """Run Python text as one process of the run."""

    def begin(role: str, text: str) -> "subprocess.Popen[bytes]":
        with (running.directory / f"{role}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log
            )
        running.ends[role] = process
        return process

    return begin


def test_one_that_fails_is_named_with_its_status_and_its_exception(running: Running, start: Start) -> None:
    start("site", WAIT)
    running.check()
    start("robot", FAIL).wait()
    with pytest.raises(SernError) as raised:
        running.check()
    assert str(raised.value) == "floor, robot ended with exit status 1: of no use | KeyError: 'the key'"
    with pytest.raises(SernError, match=r"^floor, robot ended with exit status 1: of no use \| KeyError: 'the key'$"):
        running.await_end("robot")
    running.await_end("robot", any_status=True)


def test_one_that_was_killed_is_told_by_its_signal(running: Running, start: Start) -> None:
    start("relay", WAIT).kill()
    with pytest.raises(SernError, match=r"^floor, relay was killed by SIGKILL: it said nothing$"):
        running.await_end("relay")


def test_one_that_ends_well_but_too_early_is_told_as_well(running: Running, start: Start) -> None:
    start("relay", "").wait()
    with pytest.raises(SernError, match=r"^floor, relay ended with exit status 0: it said nothing$"):
        running.check()
    running.await_end("relay")


def test_who_waits_for_one_hears_at_once_that_another_has_ended(running: Running, start: Start) -> None:
    start("site", WAIT)
    start("robot", FAIL)
    with pytest.raises(SernError, match=r"floor, robot ended with exit status 1: .*KeyError"):
        runs._await_ready(running, "site")


def test_who_waits_in_vain_says_what_the_others_said(
    running: Running, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    start("relay", f"import sys; print('no way', file=sys.stderr, flush=True); print(flush=True); {WAIT}")
    stdout = running.ends["relay"].stdout
    assert stdout is not None
    stdout.readline()
    start("site", WAIT)
    monkeypatch.setattr(runs, "START_S", 0.0)
    with pytest.raises(SernError, match=r"^floor, site: nothing got through within 0 s; .*\? \(relay said: no way\)$"):
        runs._await_ready(running, "site")


def test_one_that_is_ready_is_heard_and_told(running: Running, start: Start) -> None:
    process = start("robot", "import sys; print('ready', flush=True); sys.exit(int(sys.stdin.readline()))")
    runs._await_ready(running, "robot")
    runs._say(running, "robot", "3\n")
    assert process.wait() == 3
    with pytest.raises(SernError, match="floor, robot ended with exit status 3"):
        runs._say(running, "robot", "go\n" * 100_000)


def test_the_last_words_leave_the_frames_of_a_traceback_out(tmp_path: Path) -> None:
    log = tmp_path / "robot.log"
    assert last_words(log) == ""
    log.write_text("1\n2\nTraceback (most recent call last):\n  File x\n    f()\nOSError: no\n\n  indented\n4\n5\n")
    assert last_words(log) == "OSError: no | indented | 4 | 5"


def test_children_find_the_checkout_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    command = [sys.executable, "-c", "import sys, benchmarks.common; print(sys.path[1])"]
    found = subprocess.run(command, env=environment(), cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "/nowhere"


def test_the_processor_time_of_another_is_counted_until_it_is_waited_for(start: Start) -> None:
    process = start("robot", f"sum(range(10**6)); print(flush=True); {WAIT}")
    assert process.stdout is not None
    process.stdout.readline()
    spent_s = cpu_s(process.pid)
    assert 0.005 < spent_s <= cpu_s(process.pid)


def send_until_told(sender: socket.socket) -> None:
    """Send until an error tells of a datagram before, which may come a moment later."""
    patience = Patience()
    while not patience.over():
        sender.send(b"nobody is there")


def test_the_sender_of_bare_datagrams_outlives_a_receiver_that_is_not_there() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", 0))
            address = receiver.getsockname()
            sender.connect(address)
        with pytest.raises(ConnectionRefusedError):
            send_until_told(sender)
        for _ in range(4):
            send_datagram(sender, b"nobody is there")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(address)
            patience = Patience()
            while not select.select([receiver], [], [], 0.01)[0]:
                assert not patience.over(), "a receiver that is there again is heard of"
                send_datagram(sender, b"heard")
            assert receiver.recv(100) == b"heard"
