"""Children are started, asked, stopped in order, and never left behind."""

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import SernError
from sern_tools.harness import launcher, processes
from sern_tools.harness.processes import Child, Children, cpu_s, last_words, program, python
from tests.support import DEADLINE_S, Patience, ended, until

ECHO = 'import sys\nfor line in sys.stdin: print(\'{"word": "%s"}\' % line.strip(), flush=True)'
STUBBORN = (
    "import signal, sys\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    "print('{}', flush=True)\nwhile True: signal.pause()"
)
PATIENT = "import signal\nprint('{}', flush=True)\nsignal.pause()"


def gone(child: Child) -> bool:
    try:
        os.kill(child.process.pid, 0)
    except ProcessLookupError:
        return True
    return False


async def test_a_child_answers_and_ends_with_its_input(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        child = await children.start("echo", python("-c", ECHO), talks=True)
        assert await child.ask("floor") == {"word": "floor"}
        assert await child.ask("go") == {"word": "go"}
        children.check()
        await children.stop([child])
        assert child.process.returncode in (0, -signal.SIGTERM)
        children.check()  # it was told to
    assert gone(child)


async def test_children_are_sessions_of_their_own(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        child = await children.start("patient", python("-c", PATIENT), talks=True)
        assert os.getsid(child.process.pid) == child.process.pid != os.getsid(0)


async def test_a_child_that_ignores_sigterm_is_killed(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        child = await children.start("stubborn", python("-c", STUBBORN), talks=True)
        await child.read_object()
        await children.stop([child], within_s=0.2)
        assert child.process.returncode == -signal.SIGKILL


async def test_whoever_is_left_at_the_end_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "ABORT_S", 0.2)
    async with Children(tmp_path) as children:
        left = [await children.start(name, python("-c", PATIENT), talks=True) for name in ("a", "b")]
        left.append(await children.start("stubborn", python("-c", STUBBORN), talks=True))
        for child in left:
            await child.read_object()
    assert all(gone(child) for child in left)


async def test_cancelling_twice_kills_and_leaves_nothing(tmp_path: Path) -> None:
    started: list[Child] = []
    stubborn = asyncio.Event()

    async def work() -> None:
        async with Children(tmp_path) as children:
            started.append(await children.start("stubborn", python("-c", STUBBORN), talks=True))
            await started[0].read_object()
            stubborn.set()
            await asyncio.Event().wait()

    task = asyncio.create_task(work())
    await until(stubborn.is_set, "the child ignores SIGTERM")
    task.cancel()  # SIGTERM, which the child ignores
    await until(lambda: started[0].stopping)
    task.cancel()  # SIGKILL
    with pytest.raises(asyncio.CancelledError):
        await task
    assert started[0].process.returncode == -signal.SIGKILL
    assert gone(started[0])


async def test_a_child_that_ends_by_itself_is_an_error_with_its_last_words(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        code = "import sys; print('one', file=sys.stderr); print('no such link', file=sys.stderr); sys.exit(3)"
        child = await children.start("relay", python("-c", code))
        await child.process.wait()
        with pytest.raises(SernError, match=r"relay ended \(exit status 3\): one \| no such link"):
            children.check()
        talker = await children.start("talker", python("-c", "import sys; sys.exit(3)"), talks=True)
        with pytest.raises(SernError, match="exit status 3"):
            await talker.ask("go")
        with pytest.raises(SernError, match="exit status 3"):  # also when its end was noticed before
            await talker.ask("go")


def test_a_signal_at_the_moment_of_its_end_does_not_hide_its_exit_status(tmp_path: Path) -> None:
    """On asyncio's own loop, which the tools run on."""

    async def work() -> int:
        async with Children(tmp_path) as children:
            child = await children.start(
                "quick", python("-c", "import sys; sys.stdin.readline(); sys.exit(3)"), talks=True
            )
            assert child.process.stdin is not None
            child.process.stdin.write(b"\n")
            await child.process.stdin.drain()
            patience = Patience()
            while not ended(child.process.pid):  # the loop does not turn meanwhile, and knows nothing of it
                assert not patience.over()
            child.signal(signal.SIGTERM)
            return await child.process.wait()

    assert asyncio.run(work()) == 3


async def test_a_child_that_ends_is_the_error_of_the_work_beside_it(tmp_path: Path) -> None:
    cancelled = asyncio.Event()

    async def forever() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    async with Children(tmp_path) as children:
        await children.start("bridge", python("-c", "raise SystemExit('no such master')"))
        with pytest.raises(SernError, match=r"^bridge ended \(exit status 1\): no such master$"):
            await children.beside(forever())
        assert cancelled.is_set()


async def test_work_beside_children_comes_to_what_it_comes_to(tmp_path: Path) -> None:
    async def fails() -> None:
        raise SernError("nothing arrived")

    async def works() -> int:
        return 3

    async with Children(tmp_path) as children:
        process = await children.start("echo", python("-c", "input()"), talks=True)
        assert await children.beside(works()) == 3
        with pytest.raises(SernError, match=r"^nothing arrived$"):
            await children.beside(fails())
        assert process.running


async def test_who_waits_in_vain_says_what_all_have_said(tmp_path: Path) -> None:
    async def never() -> bool:
        return False

    async with Children(tmp_path) as children:
        program = "import sys; print('no way', file=sys.stderr, flush=True); print('{}', flush=True); input()"
        relay = await children.start("relay", python("-c", program), talks=True)
        await children.start("site", python("-c", "input()"), talks=True)
        await relay.read_object()
        with pytest.raises(SernError, match=r"^nothing got through within 0 s \(relay said: no way\)$"):
            await children.until(never, 0.0, "nothing got through")


async def test_who_waits_asks_until_it_is_so(tmp_path: Path) -> None:
    answers = iter([False, False, True])

    async def met() -> bool:
        return next(answers)

    await Children(tmp_path).until(met, DEADLINE_S, "it was not so", every_s=0.0)
    assert next(answers, None) is None


async def test_what_has_done_its_work_must_end_well(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        robot = await children.start("robot", python("-c", "import sys; sys.stdin.read()"), talks=True)
        await children.end(robot, number=None)
        assert robot.process.returncode == 0
        site = await children.start("site", python("-c", PATIENT), talks=True)
        await site.read_object()
        with pytest.raises(SernError, match=r"^site ended \(signal SIGTERM\) and said nothing$"):
            await children.end(site)
        relay = await children.start("relay", python("-c", STUBBORN), talks=True)
        await relay.read_object()
        with pytest.raises(SernError, match=r"^relay does not end within 0.2 s$"):
            await children.end(relay, within_s=0.2)
        assert gone(relay)


def test_the_last_words_leave_the_frames_of_a_traceback_out(tmp_path: Path) -> None:
    log = tmp_path / "robot.log"
    assert last_words(log) == ""
    log.write_text("1\n2\nTraceback (most recent call last):\n  File x\n    f()\nOSError: no\n\n  indented\n4\n5\n")
    assert last_words(log) == "OSError: no | indented | 4 | 5"


async def test_the_cpu_time_of_a_thread_that_has_ended_counts(tmp_path: Path) -> None:
    program = """
import json, threading, time
def work():
    while time.thread_time() < 0.05:
        pass
thread = threading.Thread(target=work)
thread.start()
thread.join()
print(json.dumps({"used_s": time.process_time()}), flush=True)
input()
"""
    async with Children(tmp_path) as children:
        first, second = [await children.start(name, python("-c", program), talks=True) for name in ("a", "b")]
        used_s = [(await process.read_object())["used_s"] for process in (first, second)]
        found_s = cpu_s(first.process.pid, second.process.pid)
    assert min(used_s) >= 0.05
    assert found_s >= sum(used_s)


async def test_processor_time_is_told_by_name(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        robot = await children.start(
            "robot", python("-c", "sum(range(10**6)); print('{}', flush=True); input()"), talks=True
        )
        await robot.read_object()
        assert 0.005 < children.cpu_s()["robot"] <= cpu_s(robot.process.pid)


async def test_of_a_traceback_the_error_remains(tmp_path: Path) -> None:
    code = """
import sys
print("a warning", file=sys.stderr)
try:
    raise KeyError("first")
except KeyError:
    raise ValueError("no such link")
"""
    async with Children(tmp_path) as children:
        child = await children.start("relay", python("-c", code))
        await child.process.wait()
        with pytest.raises(SernError) as caught:
            children.check()
    assert str(caught.value) == "relay ended (exit status 1): ValueError: no such link"


async def test_the_environment_is_ours_with_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SERN_NEW", raising=False)
    for name in ("SERN_KEPT", "SERN_TAKEN", "SERN_CHANGED", "SERN_ABSENT"):
        monkeypatch.setenv(name, "ours")
    changes = {"SERN_TAKEN": None, "SERN_CHANGED": "theirs", "SERN_NEW": "theirs", "SERN_ABSENT": None}
    asked = ["SERN_KEPT", *changes]
    code = f"import json, os; print(json.dumps({{k: v for k, v in os.environ.items() if k in {asked}}}))"
    async with Children(tmp_path) as children:
        child = await children.start("child", python("-c", code), talks=True, environment=changes)
        found = await child.read_object()
    assert found == {"SERN_KEPT": "ours", "SERN_CHANGED": "theirs", "SERN_NEW": "theirs"}


async def test_a_child_that_dies_silently(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        child = await children.start("relay", python("-c", "import os; os.kill(os.getpid(), 9)"))
        await child.process.wait()
        with pytest.raises(SernError, match=r"signal SIGKILL\) and said nothing"):
            children.check()


async def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    async with Children(tmp_path) as children:
        with pytest.raises(SernError, match="cannot start relay: /nowhere/relay"):
            await children.start("relay", ["/nowhere/relay"])
    with pytest.raises(SernError, match="sern-nothing is not installed"):
        program("sern-nothing")


PARENT = """
import asyncio, sys
from pathlib import Path
from sern_tools.harness.processes import Children

async def main():
    async with Children(Path(sys.argv[1])) as children:
        child = await children.start("patient", [sys.executable, "-c", sys.argv[2]], talks=True)
        await child.read_object()
        print(child.process.pid, flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


async def test_children_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", PARENT, str(tmp_path), STUBBORN), stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    child = int(await process.stdout.readline())
    os.kill(child, 0)  # it runs
    process.kill()
    await process.wait()
    await until(lambda: ended(child), "the child is gone")


def launched(parent: int, *command: str) -> subprocess.CompletedProcess[str]:
    """What becomes of a command that is bound to the process `parent`."""
    line = [sys.executable, "-I", "-S", launcher.__file__, str(parent), *command]
    return subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)


def test_a_child_whose_parent_ended_before_it_asked_does_not_start() -> None:
    """Then no signal would come any more: whoever is its parent now is not the one that it was started for."""
    assert launched(os.getpid(), "echo", "here").stdout == "here\n"
    orphan = launched(os.getppid(), "echo", "here")
    assert (orphan.returncode, orphan.stdout) == (1, "")
    missing = launched(os.getpid(), "/nowhere/relay")
    assert (missing.returncode, missing.stderr) == (127, "/nowhere/relay: No such file or directory\n")
