"""The adaptation in the daemons: it runs in a client and for each downlink of a relay, and tells what it does."""

import re
from functools import partial
from pathlib import Path

from tests.daemons import Lab, Process
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
            _, metrics = process.get("/metrics")
            for name in ("cost", 'term{peer="[^"]+",term="bandwidth"}', "predicted_cost", "prediction_error"):
                assert re.search(f"^sern_mmcf_{name}", metrics, re.MULTILINE), name
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
