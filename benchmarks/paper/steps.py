"""What is run for the report, and what each run needs."""

import importlib.util
import os
import shutil
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

from benchmarks.common import MissingError
from benchmarks.endpoints import ros1
from benchmarks.paper import published
from sern_tools.checkout import code

EVERYTHING: Final = ("sern_*", "benchmarks", ":(exclude)benchmarks/paper", "constraints.txt")
"""The code that a step may run, as git's pathspecs."""
DRIVEN: Final = (
    "sern_core/__init__.py",
    "sern_core/vocabulary",
    "sern_navigation",
    "sern_sim",
    "sern_twin",
    "benchmarks/__init__.py",
    "benchmarks/navigation/__init__.py",
    "benchmarks/navigation/campus.py",
    "benchmarks/navigation/drives.py",
    "benchmarks/navigation/episode.py",
    "constraints.txt",
)
"""What a drive across a campus runs."""
SEEDS: Final = 400
LAB_PACKAGES: Final = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "ip": "iproute2"}


class Company(Enum):
    """What may run beside a step."""

    NONE = "nothing: it compares what takes processors"
    BACKGROUND = "what is in the background: it has real-time priority"
    ANY = "anything: it runs in virtual time, in the background, on what is left of the processors"


class Step(NamedTuple):
    """A benchmark that writes a result. `full` and `quick` are its arguments, with `{drives}` for the file of
    drives; `minutes` for each, on two cores; `missing` says what it lacks here and what to do, or nothing."""

    name: str
    title: str
    full: Sequence[str]
    quick: Sequence[str]
    minutes: tuple[int, int]
    missing: Callable[[], str] = str
    runs: Sequence[str] = EVERYTHING
    """The code that it runs: what was found holds until that changes."""
    part: str = ""
    """Which part of its benchmark this is, where that has several steps so that an interrupted run loses less."""
    company: Company = Company.NONE

    @property
    def key(self) -> str:
        """Its name among all steps, and in those of files."""
        return f"{self.name}_{self.part}" if self.part else self.name

    def arguments(self, folder: Path, *, quick: bool) -> list[str]:
        """Those of `python -m benchmarks.NAME`."""
        return [word.format(drives=drives(folder)) for word in (self.quick if quick else self.full)]


def drives(folder: Path) -> Path:
    """Where drives across campuses are kept, of the code of now: a run that was interrupted goes on where it was."""
    return folder / f"drives-{code(DRIVEN)}.jsonl"


def _modules(*names: str, extra: str) -> Callable[[], str]:
    def missing() -> str:
        absent = [name for name in names if importlib.util.find_spec(name) is None]
        return f"{', '.join(absent)} is not installed: pip install 'sern[{extra}]'" if absent else ""

    return missing


_TWIN: Final = _modules("numpy", "scipy", extra="twin")
_MEASURED: Final = _modules("psutil", extra="bench")
_COMPARED: Final = _modules("zenoh", extra="bench")


def lab() -> str:
    """Why the lab's link cannot be made here; empty: it can."""
    if os.geteuid() != 0:
        return "the lab's link needs root: sudo make paper"
    absent = [package for program, package in LAB_PACKAGES.items() if shutil.which(program) is None]
    return f"the lab's link needs the Debian packages {' '.join(absent)}" if absent else _MEASURED()


def masters() -> str:
    """Why there are no ROS masters here; empty: there are."""
    try:
        ros1.need(ros1.ROSMASTER, *ros1.NEEDS[ros1.ROSPY])
    except MissingError as error:
        return f"it {error}"
    return ""


def scaling_needs() -> str:
    """What the levels of load lack here; empty: nothing."""
    return lab() or masters() or _COMPARED()


STEPS: Final = (
    *(
        Step(
            "scaling",
            f"more and more robots over the lab's link, {size} clouds",
            ("--sizes", size),
            ("--quick", "--sizes", size),
            (32, 2),
            scaling_needs,
            part=size,
        )
        for size in ("small", "large")
    ),
    Step("sync", "the twin in virtual time", (), ("--quick",), (6, 1), _TWIN, company=Company.ANY),
    Step("sync_lab", "the twin over the lab's link", (), ("--quick",), (16, 2), lab, company=Company.BACKGROUND),
    Step(
        "reconfiguration",
        "a stream that comes and goes",
        (),
        ("--quick",),
        (8, 1),
        masters,
        company=Company.BACKGROUND,
    ),
    Step(
        "navigation",
        "three modes of navigation",
        ("modes", "--seeds", str(SEEDS), "--resume", "{drives}"),
        ("modes", "--seeds", "4", "--resume", "{drives}"),
        (75, 3),
        _TWIN,
        ("benchmarks/navigation", *DRIVEN),
        company=Company.ANY,
    ),
    Step("mmcf", "policies in virtual time", ("--seeds", "20"), ("--quick",), (30, 1), company=Company.ANY),
    *(
        Step(
            "mmcf_lab",
            f"policies over the lab's link, {profile}",
            ("--runs", "20", "--seconds", "18", "--profiles", profile),
            ("--quick", "--profiles", profile),
            (28, 2),
            lab,
            part=profile,
            company=Company.BACKGROUND,
        )
        for profile in published.BREAKDOWN
    ),
)
