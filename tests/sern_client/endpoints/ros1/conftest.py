from collections.abc import AsyncIterator

import pytest

from sern_client.endpoints.ros1 import endpoint
from tests.sern_client.endpoints.ros1.fakes import FakeMaster
from tests.support import DEADLINE_S


@pytest.fixture(autouse=True)
def time_to_unregister(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine must not make an endpoint leave a master that has not answered yet."""
    monkeypatch.setattr(endpoint, "UNREGISTER_S", DEADLINE_S)


@pytest.fixture
async def master() -> AsyncIterator[FakeMaster]:
    fake = FakeMaster()
    await fake.start()
    yield fake
    await fake.stop()
