"""The limit of files that a process may have open, and the reserve of it."""

import resource
from collections.abc import Iterator

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.open_files import (
    OPEN_FILES,
    RESERVED_FILES,
    close_reserve,
    open_reserve,
    raise_open_files,
    require_open_files,
)

INFINITY = resource.RLIM_INFINITY
Limits = tuple[int, int]


class Process:
    """The limits of a process that is none."""

    limits: Limits = (1024, 4096)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    process = Process()
    monkeypatch.setattr(resource, "getrlimit", lambda _which: process.limits)
    monkeypatch.setattr(resource, "setrlimit", lambda _which, both: setattr(process, "limits", both))
    yield process
    process.limits = (INFINITY, INFINITY)
    close_reserve()
    raise_open_files()


@pytest.mark.parametrize(
    ("limits", "usual", "reserve"),
    [
        ((1024, 4096), 4096 - RESERVED_FILES, True),
        ((1024, 10**6), OPEN_FILES, True),
        ((1024, INFINITY), OPEN_FILES, True),
        ((OPEN_FILES, OPEN_FILES), OPEN_FILES - RESERVED_FILES, True),
        ((10**5, 10**6), 10**5, True),
        ((512, 512), 512, False),
    ],
)
def test_a_daemon_may_open_more_files_than_a_shell_gives_and_keeps_a_reserve(
    process: Process, limits: Limits, usual: int, reserve: bool
) -> None:
    process.limits = limits
    assert raise_open_files() == usual
    assert process.limits == (usual, limits[1])
    assert open_reserve() is reserve
    assert process.limits == (usual + RESERVED_FILES * reserve, limits[1])
    assert open_reserve() is False, "it has it already"
    close_reserve()
    close_reserve()
    assert process.limits == (usual, limits[1])


def test_where_there_is_no_limit_there_is_no_reserve(process: Process) -> None:
    process.limits = (INFINITY, INFINITY)
    assert raise_open_files() == float("inf")
    require_open_files(10**6)
    assert process.limits == (INFINITY, INFINITY)


def test_too_few_files_are_said_in_one_line(process: Process) -> None:
    process.limits = (512, 1024)
    require_open_files(424)
    assert process.limits == (512, 1024)
    with pytest.raises(ConfigError, match=r"may open 1024 files and connections, and needs 1025 for so many; allow it"):
        require_open_files(425)


def test_more_than_usual_is_taken_where_it_may_be(process: Process) -> None:
    process.limits = (OPEN_FILES, 10**6)
    require_open_files(20_000)
    assert process.limits == (20_000, 10**6)
