"""The account of single messages over real sockets: daemons with message logs, a link offered twice what it carries,
and connections that are cut while messages are under way."""

from pathlib import Path

from sern_core.vocabulary.types import ClientName
from sern_runtime.profiles import load_profile
from sern_sim.models import LinkModel
from sern_tools.counters import read_counters
from sern_tools.demo_scenario import (
    COMMAND_TOPIC,
    FAR_HOST,
    POSE_TOPIC,
    RELAY,
    ROBOT,
    SITE,
    Ports,
    Scenario,
    write_files,
)
from sern_tools.message_log import read_logs
from sern_tools.ports import free_ports
from sern_tools.proxy import Route, ShapingProxy
from sern_tools.summary import Result, RunFacts, analyse, judge
from tests.daemons import HOST, Lab, delivered
from tests.support import until

NAMES = (ROBOT, RELAY, SITE)


def read(directory: Path) -> Result:
    logs = read_logs([(name, directory / f"{name}.csv") for name in NAMES])
    counters = read_counters([directory / f"{name}.summary.json" for name in NAMES])
    reliable = frozenset(name for name, log in logs.items() if log.priority == "state")
    subscribers = {ROBOT: SITE, SITE: ROBOT}
    return analyse("SERN", logs, RunFacts(0, 1.0, {}, reliable_topics=reliable, subscribers=subscribers), counters)


async def test_every_message_has_one_fate_whatever_is_cut(tmp_path: Path) -> None:
    scenario = Scenario(load_profile("demo"), 10.0)
    relay_port, *more = free_ports(4)
    thin = LinkModel(rate_bps=scenario.usual_bps, delay_s=0.01)
    routes = [Route((FAR_HOST, relay_port), (HOST, relay_port))]
    async with ShapingProxy(thin, thin, routes, seed=1, datagrams=True) as proxy, Lab(tmp_path) as lab:
        proxy.start()
        directory = tmp_path / "config"
        files = write_files(directory, scenario, Ports(relay_port, *more))
        relay = await lab.relay(files[RELAY])
        site = await lab.connected(files[SITE])
        robot = await lab.connected(files[ROBOT])
        assert relay.transports.server is not None
        for client in (ROBOT, SITE, ROBOT):
            poses, commands = delivered(site, POSE_TOPIC), delivered(robot, COMMAND_TOPIC)
            await until(lambda poses=poses: delivered(site, POSE_TOPIC) > poses + 20, "poses arrive")  # type: ignore[misc]
            await until(
                lambda commands=commands: delivered(robot, COMMAND_TOPIC) > commands,  # type: ignore[misc]
                "commands arrive",
            )
            relay.transports.server.cut_client(ClientName(client))
        poses = delivered(site, POSE_TOPIC)
        await until(lambda: delivered(site, POSE_TOPIC) > poses + 20, "poses arrive")
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    result = read(directory)
    assert (result.accounting_gap, result.accounting_notes) == (0, [])
    assert sum(topic.dropped.total() for topic in result.topics.values()), "the link was offered more than it carries"
    for topic in result.topics.values():
        assert topic.offered == topic.delivered + topic.refused + topic.dropped.total() + topic.under_way
    verdict = {each.name: each for each in judge(result, None, overtaken_share_limits={})}["uncounted_messages"]
    assert verdict.ok and " offered = " in verdict.detail

    # One line less anywhere, and the sum is broken.
    for name in NAMES:
        path = directory / f"{name}.csv"
        text = path.read_text()
        lines = text.splitlines(keepends=True)
        word = {ROBOT: "dropped,", RELAY: "received,", SITE: "delivered,"}[name]
        index = next(i for i, line in enumerate(lines) if line.startswith(word))
        path.write_text("".join(lines[:index] + lines[index + 1 :]))
        assert read(directory).accounting_gap, name
        path.write_text(text)
