from collections.abc import AsyncIterator

import pytest

from tests.sern_client.endpoints.ros1.fakes import FakeMaster


@pytest.fixture
async def master() -> AsyncIterator[FakeMaster]:
    fake = FakeMaster()
    await fake.start()
    yield fake
    await fake.stop()
