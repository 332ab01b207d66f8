"""What every test with a real ROS 1 shares."""

import pytest

from sern_client.endpoints.ros1 import first_messages, publication


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that a busy machine lets connect or read late misses nothing: endpoints of this process wait for it
    longer."""
    monkeypatch.setattr(first_messages, "FIRST_MESSAGES_S", 60.0)
    monkeypatch.setattr(publication, "LAST_READ_S", 10.0)
