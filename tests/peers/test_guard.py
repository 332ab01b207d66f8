"""The publishers of the guard in ROS 2: what a node gets while the client is silent, and what the client sees."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from sern_client.endpoints.base import GUARD_SUFFIX, Endpoint
from sern_client.guard import Guard
from sern_client.sections import make_section
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.config import endpoints as sections
from sern_runtime.config.shared import LogSection
from sern_tools.ports import free_ports
from tests.support import Events, until

TWIST = "geometry_msgs/msg/Twist"
STOP = ros_types.zero_message(TWIST, Encoding.CDR) or b""
COMMANDS = TopicName("/cmd_vel")


def dds() -> tuple[sections.DdsEndpoint, sections.DdsEndpoint]:
    """The guards of the client, and of another node at the same place that takes what SERN endpoints publish."""
    pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")
    from tests.peers.dds.peer import free_domain

    where: dict[str, Any] = {"kind": "dds", "domain": free_domain(), "localhost_only": True}
    return sections.DdsEndpoint(**where), sections.DdsEndpoint(**where, node_name="driver", accept_bridged=True)


def zenoh() -> tuple[sections.ZenohEndpoint, sections.ZenohEndpoint]:
    pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")
    port, nobody = free_ports(2)
    nowhere = f"tcp/127.0.0.1:{nobody}"
    here: dict[str, Any] = {"kind": "zenoh", "connect": (nowhere,), "listen": (f"tcp/127.0.0.1:{port}",)}
    there: dict[str, Any] = {"kind": "zenoh", "connect": (f"tcp/127.0.0.1:{port}",), "listen": ("tcp/127.0.0.1:0",)}
    return sections.ZenohEndpoint(**there), sections.ZenohEndpoint(**here, node_name="driver", accept_bridged=True)


def zenoh_listening() -> tuple[sections.ZenohEndpoint, sections.ZenohEndpoint]:
    """The client listens at a port of its own choice, which no other process can take, and the node comes there."""
    pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")
    port, nobody = free_ports(2)
    fixed, free = f"tcp/0.0.0.0:{port}", "tcp/127.0.0.1:0"
    nowhere, here = f"tcp/127.0.0.1:{nobody}", f"tcp/127.0.0.1:{port}"
    own = sections.ZenohEndpoint(kind="zenoh", connect=(nowhere,), listen=(fixed,))
    driver = sections.ZenohEndpoint(
        kind="zenoh", connect=(here,), listen=(free,), node_name="driver", accept_bridged=True
    )
    return own, driver


@asynccontextmanager
async def started(section: Any) -> AsyncIterator[tuple[Endpoint, Events]]:
    endpoint, events = make_section(section, Path), Events()
    await endpoint.start(events)
    try:
        yield endpoint, events
    finally:
        await endpoint.stop()


@pytest.mark.parametrize("kind", [dds, zenoh, zenoh_listening])
async def test_a_node_of_ros2_is_told_to_stand_by_the_guard(kind: Any, tmp_path: Path) -> None:
    own, other = kind()
    got: list[bytes] = []

    def sink(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    async with started(other) as (driver, seen), started(own) as (_client, heard):
        joins = own.model_copy(update={"node_name": own.node_name + GUARD_SUFFIX})
        guard = Guard([joins], tmp_path, LogSection())
        guard.start()
        try:
            key = guard.opened(ros_types.topic_info(COMMANDS, TWIST, Encoding.CDR), STOP)
            await until(lambda: COMMANDS in seen.infos)
            driver.subscribe(COMMANDS, sink)

            def armed() -> bool:
                """Until the two have met, what is published is for nobody: again and again."""
                guard.lease(key, clock.now() - 1.0)
                return bool(got)

            await until(armed, "the stop command arrives")
            assert set(got) == {STOP}
            await until(lambda: guard.stopped > 0, "the guard has said so")
            assert guard.ready and guard.restarts == 0
            assert COMMANDS not in heard.infos, "to its own client the guard is no node of this site"
            guard.lease(key, None)
            guard.closed(key)
        finally:
            await guard.stop()
        await until(lambda: COMMANDS not in seen.infos, "it has left")


async def test_a_trace_on_standard_output_does_not_disturb_the_guard(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tracing = "<Tracing><Verbosity>config</Verbosity><OutputFile>stdout</OutputFile></Tracing>"
    monkeypatch.setenv("CYCLONEDDS_URI", f"<CycloneDDS><Domain>{tracing}</Domain></CycloneDDS>")
    own, _ = dds()
    guard = Guard([own], tmp_path, LogSection())
    guard.start()
    try:
        key = guard.opened(ros_types.topic_info(COMMANDS, TWIST, Encoding.CDR), STOP)
        await until(lambda: guard.ready)
        guard.lease(key, clock.now() - 1.0)
        await until(lambda: guard.stopped == 1)
        assert guard.ready and guard.restarts == 0
    finally:
        await guard.stop()
    assert "what is no answer" not in caplog.text, "it goes to standard error"
