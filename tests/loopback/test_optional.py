"""Each part that a daemon can do without is broken in running daemons: messages go on, and the failure is counted."""

from pathlib import Path
from typing import NoReturn

import aiohttp
import pytest

from sern_client.daemon import ClientDaemon
from sern_core.adaptation.adapter import HopAdapter
from sern_relay.daemon import RelayDaemon
from sern_relay.feed import RelayFeed
from sern_relay.transforms import TransformObjects
from sern_runtime.adaptation import Adaptation
from sern_runtime.link_metrics import AgeHistograms
from sern_runtime.message_log import MessageLog
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, delivered
from tests.support import until

ROBOT = {"kind": "synthetic", "role": "robot", "topics": 3}
QUICK = {"interval_s": 0.2}


def broken(*_: object, **__: object) -> NoReturn:
    raise ZeroDivisionError("injected")


async def get(url: str) -> tuple[int, str]:
    async with aiohttp.ClientSession() as session, session.get(url) as answer:
        return answer.status, await answer.text()


@pytest.mark.parametrize(
    ("kind", "method", "part", "where"),
    [
        (HopAdapter, "sample", "adaptation", ("relay", "robot")),
        (HopAdapter, "step", "adaptation", ("relay", "robot")),
        (HopAdapter, "note_arrival", "adaptation", ("relay", "robot")),
        (Adaptation, "tick", "adaptation", ("relay", "robot")),
        (AgeHistograms, "observe", "metrics", ("relay", "site")),
        (TransformObjects, "message", "objects", ("relay",)),
        (RelayFeed, "publish", "feed", ("relay",)),
        (RelayFeed, "sweep", "feed", ("relay",)),
        (MessageLog, "delivered", "message_log", ("site",)),
        (MessageLog, "flush", "message_log", ("site",)),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
async def test_forwarding_goes_on(
    kind: type, method: str, part: str, where: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    role = {"name": "unity", "publish_endpoint": f"tcp://{HOST}:{free_ports(1)[0]}", "subscribe": [".*"]}
    more = {"feed": {"roles": [role]}} if kind is RelayFeed else {}
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay(lab.relay_file(adaptation=QUICK, **more))
        site = await lab.connected(lab.recorder_file("site", "/.*", message_log="site.csv"))
        robot = await lab.connected(lab.client_file("robot1", ROBOT, adaptation=QUICK))
        await until(lambda: delivered(site) > 20, "messages flow")
        daemons: dict[str, RelayDaemon | ClientDaemon] = {"relay": relay, "site": site, "robot": robot}
        with monkeypatch.context() as patch:
            patch.setattr(kind, method, broken)
            for name in where:
                await until(lambda name=name: daemons[name].parts.failures[part] > 0, f"{name} has counted it")  # type: ignore[misc]
            before = delivered(site)
            await until(lambda: delivered(site) > before + 50, "messages still flow")
        for daemon in daemons.values():
            assert not any(task.done() for task in daemon.tasks)
        assert robot.core.link.established and site.core.link.established
        site.core.link.validate()
        relay.hub.validate()
        for name in where:
            listen = daemons[name].loaded.model.http.listen
            await until(lambda name=name: daemons[name].readiness().ok, f"{name} is ready")  # type: ignore[misc]
            assert (await get(f"http://{listen}/readyz"))[0] == 200
            _, text = await get(f"http://{listen}/metrics")
            (line,) = [
                row for row in text.splitlines() if row.startswith(f'sern_optional_failures_total{{part="{part}"}}')
            ]
            assert float(line.split()[-1]) > 0
