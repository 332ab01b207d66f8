"""One lab for the whole session, as its guest takes seconds to boot; every test gets it unshaped and empty."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from sern_tools.lab.backends import choose
from sern_tools.lab.host import LabError
from sern_tools.lab.lab import Lab
from sern_tools.lab.removal import pids_within

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # Tests that do without the session's lab come first, when its namespaces are not there yet.
    places = [place for place, item in enumerate(items) if item.path.parent == HERE]
    ours = sorted((items[place] for place in places), key=_uses_the_lab)
    for place, item in zip(places, ours, strict=True):
        items[place] = item


def _uses_the_lab(item: pytest.Item) -> bool:
    return isinstance(item, pytest.Function) and "session_lab" in item.fixturenames


@pytest.fixture(scope="session")
def possible() -> None:
    """Skips where no lab can be made, and says what is missing."""
    try:
        choose("1.1")
    except LabError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def session_lab(possible: None) -> Iterator[Lab]:
    with Lab(a=["rover"], b=["base", "other"]) as lab:
        yield lab


@pytest.fixture
def lab(session_lab: Lab) -> Iterator[Lab]:
    """A rover on side a, base and other on side b. What a test starts in it, it stops."""
    session_lab.reset()
    yield session_lab
    left = pids_within([node.namespace for node in session_lab.nodes])
    session_lab.stop_processes()
    assert not left, f"processes left in the lab: {left}"
