"""Two relays in a real Prometheus: what dashboards ask of relays has data, and one that is gone is told of."""

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import pytest

from tests.daemons import Json, Lab
from tests.deploy.prometheus import Prometheus, missing, prometheus, scaled
from tests.deploy.test_metrics import DASHBOARDS, RULES, expressions_of
from tests.two_relays import RELAYS, TwoRelays

pytestmark = [
    pytest.mark.skipif(missing() is not None, reason=missing() or ""),
    pytest.mark.skipif(find_spec("zenoh") is None, reason="zenoh is not installed: pip install 'sern[zenoh]'"),
]

ALERTS: Final = ("SernRelayPeerLost",)
ROBOT: Final[Json] = {"kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered"]}
_OF_RELAYS: Final = re.compile(r'sern_fabric_|peer=~"@')


def of_relays(expression: str) -> bool:
    """Whether it asks for something that only a relay with others has."""
    return _OF_RELAYS.search(expression) is not None


async def test_panels_of_relays_have_data_and_one_that_is_gone_is_told(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        relays = {name: await two.relay(name).ready() for name in RELAYS}
        first = relays["relay1"]
        robot = await lab.process(lab.client_file("robot1", ROBOT, relay=two.at("relay1"))).ready()
        site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
        jobs = {"sern-relay": list(relays.values()), "sern-client": [robot, site]}
        asked = [text for name in DASHBOARDS for text in expressions_of(name) if of_relays(text)]
        assert len(asked) > 5
        with prometheus(tmp_path, scaled(RULES), jobs) as server:
            await server.until_up()
            for expression in asked:
                await server.until_asked(expression)
            relays["relay2"].kill()
            await server.until_fired("SernRelayPeerLost", instance=Prometheus.target(first), relay="relay2")
            assert not server.asked('count_over_time(ALERTS{alertname="SernLinkDown",peer=~"@.*"}[1h])')
            relays["relay2"] = two.relay("relay2")
            await server.until_clear(*ALERTS)
        for process in (site, robot, *relays.values()):
            await process.stop()
