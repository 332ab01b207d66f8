"""Runs the steps, and keeps what each of them found."""

import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple

from benchmarks.child import environment
from benchmarks.paper.steps import Company, Step
from sern_core.vocabulary.errors import ConfigError
from sern_tools.checkout import ROOT, code, commit
from sern_tools.harness.processes import last_words

TOLD_S: Final = 60.0
"""How often a step that goes on is told of where nobody sees a line change."""
LOOK_S: Final = 0.5
END_S: Final = 20.0
"""Time to take down a lab."""


class Result(NamedTuple):
    """What came of a step. `found`: what the benchmark wrote. `why`: it was left out (`failed` False), or failed."""

    step: Step
    found: dict[str, Any] | None = None
    why: str = ""
    failed: bool = False
    command: str = ""
    took_s: float = 0.0
    commit: str = ""
    machine: str = ""


def machine() -> str:
    """What this is measured on, without its name."""
    model = next(
        (line.partition(":")[2].strip() for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name")),
        platform.machine(),
    )
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    system = f"Linux {platform.release()}, Python {platform.python_version()}"
    return f"{os.cpu_count()} cores ({model}), {memory_gb:.0f} GB, {system}"


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def command(step: Step, folder: Path, *, quick: bool) -> list[str]:
    """What is typed in the checkout."""
    below = folder.relative_to(ROOT) if folder.is_relative_to(ROOT) else folder
    return ["python", "-m", f"benchmarks.{step.name}", *step.arguments(below, quick=quick)]


def kept(step: Step, folder: Path, *, quick: bool) -> Result | None:
    """What an earlier run of the same code by the same command has found; None: nothing. ConfigError for a file that
    is none of ours."""
    path = folder / f"{step.key}.json"
    if not path.exists():
        return None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["code"] != code(step.runs) or told["command"] != " ".join(command(step, folder, quick=quick)):
            return None
        return Result(**{name: told[name] for name in Result._fields} | {"step": step})
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no result of a step ({error}): remove it, or give another --out") from error


def keep(result: Result, folder: Path) -> None:
    told = {**result._asdict(), "step": result.step.key, "code": code(result.step.runs)}
    path = folder / f"{result.step.key}.json"
    part = path.with_suffix(".part")
    part.write_text(json.dumps(told) + "\n", encoding="utf-8")
    part.replace(path)  # whole, or not at all


def run(step: Step, folder: Path, *, quick: bool, ends: Event | None = None) -> Result:
    """Run a step; KeyboardInterrupt, or that `ends` is set, ends it. With `ends` it is in the background: it has what
    others leave of the processors, and says nothing while it goes on."""
    if why := step.missing():
        return Result(step, why=why)
    words = command(step, folder, quick=quick)
    wrote, log = folder / f"{step.key}.found.json", folder / f"{step.key}.log"
    wrote.unlink(missing_ok=True)
    of, began_s = commit(), time.monotonic()
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            [sys.executable, *words[1:], "--json", str(wrote)],
            stdout=stream, stderr=stream, stdin=subprocess.DEVNULL, cwd=ROOT, env={**os.environ, **environment()},
            start_new_session=True,
        )  # fmt: skip
        try:
            if ends is None:
                _wait(process, step.title, began_s)
            else:
                os.sched_setscheduler(process.pid, os.SCHED_IDLE, os.sched_param(0))
                while process.poll() is None and not ends.wait(LOOK_S):
                    pass
        finally:
            if process.poll() is None:
                end(process)
    how = (" ".join(words), time.monotonic() - began_s, of, machine())
    if process.returncode != 0 or not wrote.exists():
        words_left = last_words(log, from_traceback=True) or "it said nothing"
        return Result(step, None, f"exit status {process.returncode}: {words_left}", True, *how)
    found = json.loads(wrote.read_text(encoding="utf-8"))
    wrote.unlink()
    return Result(step, found, "" if found["rows"] else " ".join(found["notes"]), False, *how)


def end(process: "subprocess.Popen[bytes]") -> None:
    """End the leader of a session as Ctrl-C does, so that it takes down what it set up, and then what is left of it."""
    os.killpg(process.pid, signal.SIGINT)
    with suppress(subprocess.TimeoutExpired):
        process.wait(END_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _wait(process: "subprocess.Popen[bytes]", title: str, began_s: float) -> None:
    told_s = began_s
    while process.poll() is None:
        time.sleep(LOOK_S)
        now_s = time.monotonic()
        if sys.stderr.isatty():
            print(f"\r  {title}: {(now_s - began_s) / 60:.1f} minutes so far ", end="", file=sys.stderr, flush=True)
        elif now_s - told_s >= TOLD_S:
            told_s = now_s
            print(f"  {title}: {(now_s - began_s) / 60:.0f} minutes so far", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def run_all(steps: Sequence[Step], folder: Path, *, quick: bool) -> list[Result]:
    """All of them; those that an earlier run of the same code has are taken as they are, but for what failed or was
    left out, which is tried again. What needs no processor of its own runs in the background, beside what may have
    company."""
    folder.mkdir(parents=True, exist_ok=True)
    known = {step.key: kept(step, folder, quick=quick) for step in steps}  # all of it first: one may be none of ours
    heads = {step.key: f"[{number}/{len(steps)}] {step.title}" for number, step in enumerate(steps, 1)}
    found: dict[str, Result] = {}

    def have(company: Company, ends: Event | None = None) -> None:
        for step in steps:
            if step.company is company and not (ends is not None and ends.is_set()):
                result = _have(step, known[step.key], heads[step.key], folder, quick=quick, ends=ends)
                if result is not None:
                    found[step.key] = result

    have(Company.NONE)
    ends = Event()
    with ThreadPoolExecutor(1) as pool:
        try:
            background = pool.submit(have, Company.ANY, ends)
            have(Company.BACKGROUND)
            background.result()
        finally:
            ends.set()  # it is over, or was interrupted
    return [found[step.key] for step in steps]


def _have(
    step: Step, known: Result | None, head: str, folder: Path, *, quick: bool, ends: Event | None
) -> Result | None:
    """What an earlier run has of a step, or what comes of it now; None: it was ended."""
    if known is not None and known.found is not None:
        print(f"{head}: from an earlier run, of commit {known.commit}", file=sys.stderr)
        return known
    beside = "" if ends is None else ", in the background"
    print(f"{head}: about {step.minutes[quick]} minutes{beside}", file=sys.stderr, flush=True)
    result = run(step, folder, quick=quick, ends=ends)
    if ends is not None and ends.is_set():
        return None
    if result.why:
        print(f"{head}: {'failed' if result.failed else 'left out'}: {result.why}", file=sys.stderr)
    elif ends is not None:
        print(f"{head}: done, {result.took_s / 60:.0f} minutes", file=sys.stderr)
    keep(result, folder)
    return result
