"""What the tests of the tools share."""

import pytest

from sern_tools import api
from tests.support import DEADLINE_S


@pytest.fixture(autouse=True)
def patient_http(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon on a busy machine may take longer to answer than somebody at a terminal wants to wait."""
    for name in ("TIMEOUT_S", "PROBE_S"):
        monkeypatch.setattr(api, name, DEADLINE_S)
