"""The alert of a client that leaves a relay which does not answer, in a real Prometheus over real daemons."""

from pathlib import Path
from typing import Final

import pytest

from tests.daemons import Lab
from tests.deploy.prometheus import Prometheus, missing, prometheus, scaled
from tests.deploy.test_metrics import RULES
from tests.loopback.test_failover import A, B, TwoRelays

pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

ALERTS: Final = ("SernFailover",)


async def test_a_client_whose_relay_is_killed_says_that_it_went_over(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab, tmp_path, failover_s=1.0)
        first, _second = await two.start(A), await two.start(B)
        site = await lab.process(two.site_file()).ready()
        with prometheus(tmp_path, scaled(RULES), {"sern-client": [site]}) as server:
            await server.until_up()
            first.kill()
            await server.until_fired("SernFailover", instance=Prometheus.target(site), relay=two.addresses[B])
            await server.until_clear(*ALERTS)
