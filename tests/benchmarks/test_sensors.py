"""The benchmark of sensors: what its messages survive, what a run amounts to, and the installed daemons on loopback."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("psutil")
pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")

from benchmarks import child
from benchmarks.link.runs import until_ready
from benchmarks.sensors import figures
from benchmarks.sensors.__main__ import EXAMPLE, robot_content, site_content
from benchmarks.sensors.bodies import TOPICS, Sensor, Tag, bodies, tag_of, tagged
from benchmarks.sensors.ends import SERN, Spec
from sern_core.bodies.lossy import missing
from sern_core.summaries.spec import STAND_IN, VoxelParams
from sern_core.summaries.voxel import thin_cloud
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.config.client import load_client
from sern_tools.harness.files import relay_content, write
from sern_tools.harness.processes import daemon, killed, python
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports
from tests import sensors
from tests.support import DEADLINE_S

MS = 10**6


@pytest.mark.parametrize("sensor", Sensor)
def test_a_message_says_which_it_is(sensor: Sensor) -> None:
    made = bodies(sensor)
    tag = Tag(1234, 567_890_123_456)
    body = tagged(made[0], tag)
    assert tag_of(body) == tag and len(body) == len(made[0])
    message = ros_types.deserialise(body, TOPICS[sensor].type_name, Encoding.CDR)
    assert message.header.frame_id == "00001234 00000000567890123456"


def test_a_summary_says_of_which_message_it_is() -> None:
    assert isinstance(STAND_IN.params, VoxelParams)
    body = tagged(bodies(Sensor.CLOUD)[0], Tag(7, 8))
    thin = thin_cloud(body, Encoding.CDR, STAND_IN.params.voxel_m)
    assert tag_of(thin) == Tag(7, 8) and len(thin) < figures.WHOLE_BYTES / 100
    assert abs(len(thin) / sensors.THIN_BYTES - 1) < 0.25, "as large as in virtual time"


def test_a_row_says_how_often_how_old_and_the_longest_gap() -> None:
    rows = [
        (sensor, number, at_ms * MS - 50 * MS, at_ms * MS, size)
        for sensor, number, at_ms, size in (
            (Sensor.SCAN, 1, 900, 9_000),  # before it counts
            (Sensor.SCAN, 2, 1_100, 9_000),
            (Sensor.SCAN, 3, 1_900, 9_000),
            (Sensor.CLOUD, 1, 1_500, figures.WHOLE_BYTES + 90),
            (Sensor.CLOUD, 2, 2_000, 40_000),
            (Sensor.CLOUD, 3, 3_000, 40_000),  # after it counts
        )
    ]
    offered = np.array([(Sensor.SCAN, 1, 2_000 * MS, 2_000 * MS, 9_000)], np.int64)
    outcome = figures.Outcome(SERN, offered, np.array(rows, np.int64), 1_000 * MS, 3_000 * MS, {})
    scan, cloud = (figures.metrics(outcome, sensor) for sensor in (Sensor.SCAN, Sensor.CLOUD))
    assert scan == pytest.approx(
        {"offered_hz": 0.5, "delivered_hz": 1.0, "age_p50_s": 0.05, "age_p99_s": 0.05, "longest_gap_s": 1.1}
    )
    assert cloud["delivered_hz"] == 1.0 and cloud["whole_hz"] == 0.5 and cloud["longest_gap_s"] == 1.0
    assert figures.metrics(outcome, Sensor.CAMERA) == {"offered_hz": 0.0, "delivered_hz": 0.0, "longest_gap_s": 2.0}
    for _, value, limit, at_least in figures.reaches(outcome):
        assert value < limit if at_least else value > limit


def test_the_configuration_is_ten_lines_that_the_document_shows() -> None:
    lines = [line for line in EXAMPLE.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    assert len(lines) <= 10
    document = (EXAMPLE.parents[2] / "docs" / "performance.md").read_text(encoding="utf-8")
    assert "```yaml\n" + "\n".join(lines) + "\n```" in document


def test_the_same_rates_are_played_in_virtual_time() -> None:
    assert {sensor.rate_hz for sensor in TOPICS.values()} == set(sensors.RATES_HZ.values())


async def test_installed_daemons_carry_the_sensors_with_the_example_as_it_is(tmp_path: Path) -> None:
    if problem := missing("jpeg"):
        pytest.skip(problem)
    directory = tmp_path / "run"
    directory.mkdir()
    make_keys(directory, "relay", "robot", "site")
    relay_port, *ports = free_ports(5)
    address = f"tcp://127.0.0.1:{relay_port}"
    contents = {
        "site-daemon": site_content(address, ports[0], ports[1]),
        "robot-daemon": robot_content(address, ports[2], ports[3]),
    }
    async with killed(directory) as children:
        relay = write(directory, "relay", relay_content(f"tcp://127.0.0.1:{relay_port}", http={"listen": None}))
        between = [await children.start("relay", daemon("relay", relay), environment=child.environment())]
        for name, content in contents.items():
            config = write(directory, name, content)
            load_client(config)
            between.append(await children.start(name, daemon("client", config), environment=child.environment()))
        ends = []
        for sends, (ours, theirs) in ((False, ports[:2]), (True, ports[2:])):
            spec = Spec(SERN, sends, "127.0.0.1", str(directory), 0.0, our_port=ours, their_port=theirs, whole=True)
            command = python("-m", "benchmarks.sensors.ends", json.dumps(asdict(spec)))
            ends.append(await children.start(spec.role, command, talks=True, environment=child.environment()))
        for end in reversed(ends):  # the site's says so when it has heard of all three sensors
            await children.within(until_ready(end), DEADLINE_S, f"{end.name}: not all sensors got through")
        await children.end(*ends, number=None, within_s=DEADLINE_S)
        await children.end(*between, within_s=DEADLINE_S)
