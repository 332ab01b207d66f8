"""Alerts about reliable messages in a real Prometheus: they fire while a site stands still, and clear again."""

import signal
from pathlib import Path
from typing import Final

import pytest

from tests.daemons import Json, Lab
from tests.deploy.prometheus import Jobs, missing, prometheus, scaled
from tests.deploy.test_metrics import RULES

pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

ROBOT: Final[Json] = {
    "kind": "synthetic", "role": "robot", "topics": ["/points"], "cloud_bytes": 200_000, "cloud_rate_hz": 15.0,
    "counter_topics": ["/short", "/full"],
}  # fmt: skip
ROBOT_RULES: Final[list[Json]] = [
    {"match": "/short", "class": "state", "reliability": "reliable", "retention_s": 2.0},
    {"match": "/full", "class": "state", "reliability": "reliable", "max_queue_bytes": 12_000},
    {"match": "/points", "class": "bulk", "reliability": "reliable", "max_queue_bytes": 200_000_000},
]
"""What each may keep: of `/short` two seconds, of `/full` three, of `/points` more than it has here."""
ALERTS: Final = ("SernReliableLoss", "SernReliableUnconfirmed", "SernReliableRefused", "SernQueueGrows")
SITE: Final[Json] = {"kind": "synthetic", "role": "operator", "command_rate_hz": 0, "goal_rate_hz": 0}


async def test_a_site_that_stands_still_and_one_that_stays_away(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site", "other") as lab:
        relay = lab.process(lab.relay_file(replay={"resume_s": 3}))
        whole = {"client": {"namespace": "/"}}
        site = lab.process(lab.client_file("site", SITE, subscribe=["/robot1/.*"], **whole))
        other = lab.process(lab.client_file("other", SITE, subscribe=["/robot1/full"], **whole))
        robot = lab.process(lab.client_file("robot1", ROBOT, topics=ROBOT_RULES))
        jobs: Jobs = {"sern-relay": [relay], "sern-client": [robot]}
        with prometheus(tmp_path, scaled(RULES), jobs) as server:
            await server.until_up()
            for name in ("site", "other"):
                await server.until_asked(f'sern_messages_delivered_total{{job="sern-relay",peer="{name}"}} > 0')
            site.signal(signal.SIGSTOP)
            other.kill()
            await server.until_fired("SernReliableLoss", topic="/robot1/short", reason="retention")
            await server.until_fired("SernReliableUnconfirmed", topic="/robot1/short")
            await server.until_fired("SernReliableRefused", topic="/robot1/full")
            await server.until_fired("SernQueueGrows", instance=server.target(relay), peer="site")
            # Nobody waits for the other one any more: at the relay, where its link has ended, the alert tells of it.
            loss = {"topic": "/robot1/full", "reason": "disconnected"}
            await server.until_fired("SernReliableLoss", instance=server.target(relay), peer="other", **loss)
            site.signal(signal.SIGCONT)
            await server.until_clear(*ALERTS)
