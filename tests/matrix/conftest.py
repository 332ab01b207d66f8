"""The full product of the matrix is for `make lab`; `make test` runs the cells that `cells.in_every_run` names."""

import pytest

LONG = "lab_long"


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", f"{LONG}: longer runs; only when asked for by -m (make lab)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if LONG in config.getoption("markexpr", ""):
        return
    long = [item for item in items if item.get_closest_marker(LONG)]
    if long:
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in long]
