"""The adaptation in the daemons: it runs in a client and for each downlink of a relay, and tells what it does."""

import re
from functools import partial
from pathlib import Path

from prometheus_client import CollectorRegistry

from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.metrics import Metrics
from sern_sim.models import LinkModel, RateStep
from sern_tools.proxy import Route, ShapingProxy
from sern_tools.shaping import RateSchedule
from tests.daemons import HOST, Lab, Process, bodies
from tests.sern_core.summaries import scenes
from tests.support import until

ROBOT = {"kind": "synthetic", "role": "robot", "topics": 3}
SITE = {"kind": "record", "path": "site", "overwrite": True}
QUICK = {"interval_s": 0.2}


def told(process: Process) -> list[dict[str, object]]:
    """The intervals that were measured, of all links."""
    status, _ = process.get("/healthz")
    if status != 200:
        return []
    history = [step for link in process.json("/api/mmcf")["links"] for step in link["history"]]
    return [step for step in history if step["measured"] is not None and step["predicted"] is not None]


def decided(process: Process) -> bool:
    return len(told(process)) >= 2


def shown(process: Process) -> bool:
    """Whether the metrics have a cost, its terms and what was predicted. An interval in which nothing came to be sent
    has none of them."""
    _, metrics = process.get("/metrics")
    names = ("cost", 'term{peer="[^"]+",term="bandwidth"}', "predicted_cost", "prediction_error")
    return all(re.search(f"^sern_mmcf_{name}", metrics, re.MULTILINE) for name in names)


async def test_client_and_relay_adapt_and_tell_of_it(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file(adaptation=QUICK)).ready()
        sections = {"client": {"namespace": "/"}, "subscribe": ["/.*"]}
        await lab.process(lab.client_file("site", SITE, **sections)).ready()
        robot = await lab.process(lab.client_file("robot1", ROBOT, adaptation={"profile": "mapping", **QUICK})).ready()
        for process in (robot, relay):
            await until(partial(decided, process), f"{process.name} has decided")
            step = told(process)[-1]
            for part in ("measured", "predicted"):
                terms = step[part]["terms"]  # type: ignore[index]
                assert set(terms) == {"latency", "unreliability", "compute", "bandwidth"}
                assert all(0.0 <= value <= 1.0 for value in terms.values())
            assert step["reason"] and step["candidates"]
            await until(partial(shown, process), f"{process.name} has it in its metrics")
        assert robot.json("/api/mmcf")["profile"] == "mapping"
        modes = {line for line in robot.get("/metrics")[1].splitlines() if line.startswith("sern_mmcf_codec{")}
        assert len(modes) == 5  # the robot encodes
        modes = {line for line in relay.get("/metrics")[1].splitlines() if line.startswith("sern_mmcf_codec{")}
        assert all('mode="none"' in line for line in modes)  # the relay forwards


async def test_without_the_section_nothing_is_adapted(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        assert robot.adaptation is None


THIN = {"control": False, "state": False, "bulk": True}
RAW = dict.fromkeys(THIN, False)


async def test_a_cloud_goes_to_its_summary_when_the_link_gets_thin_and_comes_back(tmp_path: Path) -> None:
    """Through the shaping proxy: 40 Mbit/s, 0.3 until thin clouds go, then 40 again. Nothing overtakes, as the clouds'
    own counts show."""
    good = LinkModel(rate_bps=40e6, delay_s=0.005)
    thin = LinkModel(rate_bps=40e6, delay_s=0.005, rate_steps=(RateStep(0.5, 0.3e6),))
    endpoint = {"kind": "synthetic", "role": "robot", "topics": ["/points"], "encoding": "ros1"}
    clouds = {"cloud_rate_hz": 10.0, "cloud_bytes": 100_000}
    summary = {"kind": "voxel", "voxel_m": 2.0, "in_place": True, "adapt": True, "level": "raw"}
    rule = {"match": "/points", "class": "bulk", "compression": "none", "summary": summary}
    topic = TopicName("/robot1/points")
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", topic))
        async with ShapingProxy(thin, good, [Route((HOST, 0), (HOST, lab.port))], seed=1) as proxy:
            host, port = proxy.addresses[0]
            file = lab.client_file(
                "robot1",
                endpoint | clouds,
                topics=[rule],
                adaptation=QUICK,
                relay={"endpoint": f"tcp://{host}:{port}", "udp": False},
            )
            robot = await lab.connected(file)
            adaptation = robot.adaptation
            assert adaptation is not None

            def chosen() -> object:
                (link,) = adaptation.to_json()["links"]
                return link["history"][-1]["chosen"]["summaries"] if link["history"] else None

            (item,) = robot.bridge.outbound.summaries.topics
            await until(lambda: chosen() == RAW and item.profile.messages, "raw clouds go, and their summary is known")
            proxy.start()
            await until(lambda: chosen() == THIN and item.profile.messages > 5, "thin clouds go")
            registry = CollectorRegistry()
            adaptation.register(Metrics(registry, process=False))
            peer = {"peer": robot.core.link.peer, "class": "bulk"}
            assert registry.get_sample_value("sern_mmcf_summarised", peer) == 1.0
            before = site.core.received.topics[topic].delivered
            await until(lambda: site.core.received.topics[topic].delivered > before + 5, "and arrive")
            proxy._directions["up"].shaper.schedule = RateSchedule.of(good)
            # A raw message is sent every 5 to 30 intervals to see whether the link got better.
            await until(lambda: chosen() == RAW, "raw clouds go again", deadline_s=90)
            before = site.core.received.topics[topic].delivered
            await until(lambda: site.core.received.topics[topic].delivered > before + 3, "they arrive")
            for daemon in (robot, site, relay):
                await lab.end(daemon)
    found = bodies(tmp_path / "site.bag")[topic]
    clouds_got = [scenes.read(body, scenes.CLOUD, Encoding.ROS1) for body in found]
    numbers = [cloud.header.seq for cloud in clouds_got]
    assert numbers == sorted(set(numbers))
    assert {len(cloud.data) > 50_000 for cloud in clouds_got} == {True, False}
