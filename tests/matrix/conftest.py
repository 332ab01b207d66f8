"""The full product of the matrix is for `make lab`; `make test` runs the cells that `cells.in_every_run` names.

`--figures FILE` writes what came of the cells that are played, for `benchmarks.document`.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.matrix import figures
from tests.matrix.play import Play

FIGURES = "--figures"
PLAYED = pytest.StashKey[list[figures.Played]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(FIGURES, type=Path, metavar="FILE", help="write what came of the cells of the matrix to FILE")


@pytest.fixture
def told(request: pytest.FixtureRequest) -> Callable[[Play], Play]:
    """Notes a play that is over, for `--figures`."""

    def note(play: Play) -> Play:
        request.config.stash[PLAYED].append(figures.of(play))
        return play

    return note


def pytest_sessionfinish(session: pytest.Session) -> None:
    path, played = session.config.getoption(FIGURES, None), session.config.stash[PLAYED]
    if path is not None and played:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(figures.report(played).as_json(), indent=2) + "\n")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[PLAYED] = []
    if config.getoption(FIGURES, None) is not None and hasattr(config, "workerinput"):
        raise pytest.UsageError(f"{FIGURES} needs all cells in one process: leave out -n")
