"""What the tests of the endpoint `foxglove` share."""

import pytest

pytest.importorskip("foxglove", reason="the foxglove endpoint needs foxglove-sdk: pip install foxglove-sdk")
pytest.importorskip("websockets", reason="viewers of the tests need websockets: pip install websockets")

from tests.viewers import start_runtime


@pytest.fixture(autouse=True, scope="session")
def runtime(nothing_left_behind: None) -> None:
    """What the SDK keeps to the end of the process is started here, and not held against a test."""
    start_runtime()
