"""Dashboards and alerts in a real Prometheus over real daemons: what is asked is answered, alerts fire and clear.

Of the alerts those are here whose cause can be made and undone within seconds: a robot, its link and its operator are
gone, a reload fails, strangers come. The others' expressions are parsed and their metrics looked for in test_metrics.
"""

import signal
from functools import partial
from pathlib import Path
from typing import Final

import pytest
import zmq

from sern_runtime.config.keys import load_public
from sern_sim.models import LinkModel
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Json, Lab, Process
from tests.deploy.prometheus import Prometheus, missing, prometheus, scaled
from tests.deploy.test_metrics import DASHBOARDS, RULES, expressions_of
from tests.support import until

pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

ROBOT: Final[Json] = {
    "kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered", "/points", "/scan"], "cloud_bytes": 30_000,
    "cloud_rate_hz": 10.0,
}  # fmt: skip
ROBOT_RULES: Final[list[Json]] = [
    {"match": "/cmd_vel", "class": "control", "direction": "receive", "lifespan_s": 5.0,
     "on_link_loss": {"publish": "zero", "after_s": 2.0}},
    {"match": ".*odometry.*", "class": "control", "depth": 1},
    {"match": ".*scan", "class": "bulk", "deadline_s": 0.001},
    {"match": ".*points", "class": "bulk", "max_rate_hz": 8, "summary": [{"kind": "voxel", "adapt": True}]},
]  # fmt: skip
SITE_RULES: Final[list[Json]] = [
    {"match": "/robot1/cmd_vel", "class": "control", "direction": "send", "lifespan_s": 5.0},
]
OPERATOR: Final[Json] = {"kind": "synthetic", "role": "operator", "command_topic": "/robot1/cmd_vel", "goal_rate_hz": 0}
LINK: Final = LinkModel(rate_bps=4e5, delay_s=0.01, loss=0.05, overhead_bytes=28)
"""The robot's, which carries less than there is, so that it is full, and loses some of it."""
KNOCKS: Final = 20
FAR_HOST: Final = "127.0.0.2"
"""Where the far end of that link is."""


class Site:
    """Relay, robot and operator, which a Prometheus scrapes."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.files: dict[str, Path] = {
            "relay": lab.relay_file(adaptation={"interval_s": 0.5}, replay={"resume_s": 600}),
            "robot1": lab.client_file(
                "robot1",
                ROBOT,
                topics=ROBOT_RULES,
                adaptation={"interval_s": 0.5},
                relay={"endpoint": f"tcp://{FAR_HOST}:{lab.port}"},
            ),
            "site": lab.client_file(
                "site", OPERATOR, client={"namespace": "/"}, topics=SITE_RULES, subscribe=["/robot1/.*"]
            ),
        }
        self.running: dict[str, Process] = {}

    async def start(self, name: str) -> None:
        self.running[name] = await self.lab.process(self.files[name]).ready()

    def target(self, name: str) -> str:
        return f"{HOST}:{self.running[name].port}"

    def jobs(self) -> dict[str, list[str]]:
        return {"sern-relay": [self.target("relay")], "sern-client": [self.target("robot1"), self.target("site")]}


async def test_every_panel_has_data_and_alerts_fire_and_clear(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "robot1", "site")
    route = Route((FAR_HOST, lab.port), (HOST, lab.port))
    async with lab, ShapingProxy(LINK, LINK, [route], seed=1, datagrams=True) as proxy:
        proxy.start()
        site = Site(lab)
        for name in site.files:
            await site.start(name)
        with prometheus(tmp_path, scaled(RULES), site.jobs()) as server:
            await until(server.up, "every daemon is scraped")
            await every_panel_has_data(server)
            await a_robot_that_is_killed(site, server)
            await a_reload_that_fails(site, server)
            await strangers_at_the_door(lab, server)


async def every_panel_has_data(server: Prometheus) -> None:
    for expression in (text for name in DASHBOARDS for text in expressions_of(name)):
        await until(partial(server.asked, expression), f"{expression} has data")


async def a_robot_that_is_killed(site: Site, server: Prometheus) -> None:
    site.running["robot1"].kill()
    for name in ("SernDown", "SernLinkDown", "SernPeerGone"):
        await server.until_firing(name)
    await site.start("robot1")
    for name in ("SernDown", "SernLinkDown", "SernPeerGone"):
        await server.until_clear(name)
    await server.until_clear("SernCommandLease")
    site.running["site"].kill()  # its commands cease, and the robot's client stops it
    await server.until_firing("SernCommandLease")
    await site.start("site")
    await server.until_clear("SernCommandLease")


async def a_reload_that_fails(site: Site, server: Prometheus) -> None:
    file = site.files["relay"]
    good = file.read_text()
    file.write_text("{}")
    site.running["relay"].signal(signal.SIGHUP)
    await server.until_firing("SernReloadFailed")
    file.write_text(good)
    site.running["relay"].signal(signal.SIGHUP)
    await server.until_clear("SernReloadFailed")


async def strangers_at_the_door(lab: Lab, server: Prometheus) -> None:
    relay_key = load_public(lab.directory / "relay.pub").keys[0].key.encode()
    with zmq.Context() as context:
        sockets = []
        for _ in range(KNOCKS):
            stranger = context.socket(zmq.DEALER)
            stranger.linger = 0
            stranger.curve_publickey, stranger.curve_secretkey = zmq.curve_keypair()
            stranger.curve_serverkey = relay_key
            stranger.connect(lab.endpoint)
            sockets.append(stranger)
        try:
            await server.until_firing("SernAuthRefused")
        finally:
            for stranger in sockets:
                stranger.close()
    await server.until_clear("SernAuthRefused")
