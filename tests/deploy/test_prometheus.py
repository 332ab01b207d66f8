"""Dashboards and alerts in a real Prometheus over real daemons: what is asked is answered, alerts fire and clear.

Here a robot, its link and its operator are gone, a reload fails, and strangers come. What needs a site that stands
still is in test_prometheus_queues, and what needs a bad network or a part that fails in test_prometheus_network.
"""

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import pytest
import zmq

from sern_runtime.config.keys import load_public
from sern_sim.models import LinkModel
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Json, Lab, Process
from tests.deploy import test_prometheus_fabric as fabric
from tests.deploy import test_prometheus_failover as failover
from tests.deploy import test_prometheus_network as network
from tests.deploy import test_prometheus_queues as queues
from tests.deploy.prometheus import Jobs, Prometheus, missing, prometheus, scaled
from tests.deploy.test_metrics import DASHBOARDS, RULES, alerts, expressions_of

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
ALERTS: Final = ("SernDown", "SernLinkDown", "SernPeerGone", "SernReloadFailed", "SernCommandLease", "SernAuthRefused")
FAR_HOST: Final = "127.0.0.2"
"""Where the far end of that link is."""


def test_every_alert_is_fired_by_daemons() -> None:
    fired = (*ALERTS, *fabric.ALERTS, *failover.ALERTS, *network.ALERTS, *queues.ALERTS)
    assert sorted(fired) == sorted(rule["alert"] for rule in alerts())


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

    def start(self, name: str) -> Process:
        process = self.running[name] = self.lab.process(self.files[name])
        return process

    def target(self, name: str) -> str:
        return Prometheus.target(self.running[name])

    def jobs(self) -> Jobs:
        return {"sern-relay": [self.running["relay"]], "sern-client": [self.running["robot1"], self.running["site"]]}


async def test_every_panel_has_data_and_alerts_fire_and_clear(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "robot1", "site")
    route = Route((FAR_HOST, lab.port), (HOST, lab.port))
    async with lab, ShapingProxy(LINK, LINK, [route], seed=1, datagrams=True) as proxy:
        proxy.start()
        site = Site(lab)
        for name in site.files:
            site.start(name)
        with prometheus(tmp_path, scaled(RULES), site.jobs()) as server:
            await server.until_up()
            await every_panel_has_data(server)
            await an_operator_that_is_killed_a_reload_that_fails_and_strangers(site, server)
            await a_robot_that_is_killed(site, server)
            await server.until_clear(*ALERTS)


async def every_panel_has_data(server: Prometheus) -> None:
    for expression in (text for name in DASHBOARDS for text in expressions_of(name)):
        if not fabric.of_relays(expression):  # there is one here
            await server.until_asked(expression)


async def an_operator_that_is_killed_a_reload_that_fails_and_strangers(site: Site, server: Prometheus) -> None:
    site.running["site"].kill()  # its commands cease, and the robot's client stops it
    file = site.files["relay"]
    good = file.read_text()
    file.write_text("{}")
    site.running["relay"].signal(signal.SIGHUP)
    with strangers_at_the_door(site.lab):
        await server.until_fired("SernAuthRefused", instance=site.target("relay"), result="unknown_key")
    await server.until_fired("SernReloadFailed", instance=site.target("relay"))
    await server.until_fired("SernCommandLease", instance=site.target("robot1"))
    file.write_text(good)
    site.running["relay"].signal(signal.SIGHUP)
    await site.start("site").ready()


async def a_robot_that_is_killed(site: Site, server: Prometheus) -> None:
    site.running["robot1"].kill()
    await server.until_fired("SernDown", instance=site.target("robot1"))
    await server.until_fired("SernLinkDown", instance=site.target("relay"), peer="robot1")
    await server.until_fired("SernPeerGone", instance=site.target("site"), peer="robot1")
    await site.start("robot1").ready()


@contextmanager
def strangers_at_the_door(lab: Lab) -> Iterator[None]:
    """Many knock with keys that the relay does not know, again and again while the block runs."""
    relay_key = load_public(lab.directory / "relay.pub").keys[0].key.encode()
    with zmq.Context() as context, ExitStack() as stack:
        for _ in range(KNOCKS):
            stranger = context.socket(zmq.DEALER)
            stack.callback(stranger.close, linger=0)
            stranger.curve_publickey, stranger.curve_secretkey = zmq.curve_keypair()
            stranger.curve_serverkey = relay_key
            stranger.connect(lab.endpoint)
        yield
