"""One lab for the whole session, as its guest takes seconds to boot; every test gets it unshaped and empty."""

from collections.abc import Iterator

import pytest

from sern_tools.lab.backends import choose
from sern_tools.lab.host import LabError
from sern_tools.lab.lab import Lab
from sern_tools.lab.removal import pids_within

LONG = "lab_long"


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", f"{LONG}: longer runs of the lab; only when asked for by -m (make lab)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if LONG not in config.getoption("markexpr", ""):
        long = [item for item in items if item.get_closest_marker(LONG)]
        if long:
            config.hook.pytest_deselected(items=long)
            items[:] = [item for item in items if item not in long]


@pytest.fixture(scope="session")
def possible() -> None:
    """Skips where no lab can be made, and says what is missing."""
    try:
        choose("1.1")
    except LabError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def session_lab(possible: None) -> Iterator[Lab]:
    with Lab(a=["robot"], b=["base", "other"]) as lab:
        yield lab


@pytest.fixture
def lab(session_lab: Lab) -> Iterator[Lab]:
    """A robot on side a, base and other on side b. What a test starts in it, it stops."""
    session_lab.reset()
    yield session_lab
    left = pids_within([node.namespace for node in session_lab.nodes])
    session_lab.stop_processes()
    assert not left, f"processes left in the lab: {left}"
