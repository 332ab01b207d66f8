"""Every alert fires when what it watches is broken, and clears when it is mended: over made-up series, by promtool.

The rules are as they are shipped, with their minutes. A real Prometheus over real daemons is in test_prometheus.
"""

import asyncio
import json
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.daemons import Lab

RULES: Final = Path(__file__).parents[2] / "deploy" / "prometheus" / "sern.rules.yml"
STEP_S: Final = 15
COUNTED: Final = "0x8 20x120"
"""A counter that rises once, after two minutes."""
LABELS: Final = 'instance="i",peer="p",topic="/t"'


class Case(NamedTuple):
    """`series` by name, as promtool writes values, one each `STEP_S`. The alert fires at one time, in minutes, and no
    more at the other."""

    series: dict[str, str]
    fires_min: int = 4
    clear_min: int = 25


def gauge(name: str, good: str, bad: str, **beside: str) -> Case:
    """Good for two minutes, bad for ten, and good again; `beside`: other series that stay as they are."""
    return Case(
        {name: f"{good}x8 {bad}x40 {good}x120"} | {other: f"{value}x200" for other, value in beside.items()}, 11
    )


def counter(name: str) -> Case:
    return Case({name: COUNTED})


UP: Final = {f"sern_link_up{{{LABELS}}}": "1"}
CASES: Final = {
    "SernDown": gauge('up{job="sern-relay",instance="i"}', "1", "0"),
    "SernLinkDown": gauge(f"sern_link_up{{{LABELS}}}", "1", "0"),
    "SernPeerGone": gauge(f"sern_peer_connected{{{LABELS}}}", "1", "0", **UP),
    "SernTwinOutside": gauge('sern_twin_outside_bound{instance="i",robot="r"}', "0", "1"),
    "SernNoDatagrams": gauge(f"sern_datagram_lane_up{{{LABELS}}}", "1", "0", **UP),
    "SernReliableLoss": counter(f'sern_messages_dropped_total{{{LABELS},reason="retention"}}'),
    "SernReliableUnconfirmed": counter(f"sern_reliable_unconfirmed_total{{{LABELS}}}"),
    "SernReliableRefused": counter(f"sern_messages_refused_total{{{LABELS}}}"),
    "SernControlLate": Case(
        {
            'sern_message_age_seconds_count{instance="i",class="control"}': "0+10x480",
            # Half of them late for 20 minutes.
            'sern_message_age_seconds_bucket{instance="i",class="control",le="0.3"}': "0+10x20 205+5x79 610+10x378",
        },
        15,
        60,
    ),
    "SernQueueGrows": Case({f"sern_link_queue_bytes{{{LABELS}}}": "0x8 9000000+100000x60 0x120"}, 13),
    "SernAuthRefused": counter('sern_relay_auth_total{instance="i",result="unknown_key"}'),
    "SernBadFrames": counter('sern_bad_frames_total{instance="i"}'),
    "SernClockUncertain": gauge(f"sern_link_clock_error_seconds{{{LABELS}}}", "0.1", "0.9"),
    "SernRelayPeerLost": gauge('sern_fabric_relay_up{instance="i",relay="r"}', "1", "0"),
    "SernFailover": counter('sern_client_failovers_total{instance="i",relay="r",reason="silent"}'),
    "SernReloadFailed": gauge('sern_relay_reload_failed{instance="i"}', "0", "1"),
    "SernCommandLease": counter('sern_command_lease_expired_total{instance="i"}'),
    "SernMetricBroken": counter('sern_metrics_failures_total{instance="i",metric="m"}'),
    "SernOptionalPart": counter('sern_optional_failures_total{instance="i",part="p"}'),
}


@pytest.fixture
def promtool() -> str:
    found = shutil.which("promtool")
    if found is None:
        pytest.skip("needs promtool: install Debian's prometheus")
    return found


def names() -> list[str]:
    return re.findall(r"^ +- alert: (\w+)$", RULES.read_text(), re.MULTILINE)


def test_every_alert_is_tried() -> None:
    assert sorted(CASES) == sorted(names())


@pytest.mark.parametrize("alert", CASES)
def test_it_fires_and_clears(promtool: str, tmp_path: Path, alert: str) -> None:
    case = CASES[alert]
    asked = f'count(ALERTS{{alertname="{alert}",alertstate="firing"}})'
    times = {0: [], case.fires_min: [{"labels": "{}", "value": 1}], case.clear_min: []}
    expected = [{"expr": asked, "eval_time": f"{at}m", "exp_samples": samples} for at, samples in times.items()]
    content = {
        "rule_files": [str(RULES)],
        "evaluation_interval": f"{STEP_S}s",
        "tests": [
            {
                "interval": f"{STEP_S}s",
                "input_series": [{"series": name, "values": values} for name, values in case.series.items()],
                "promql_expr_test": expected,
            }
        ],
    }
    file = tmp_path / "test.yml"
    file.write_text(json.dumps(content))
    done = subprocess.run([promtool, "test", "rules", file], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


OURS: Final = re.compile(r"sern_summar\w+ metric name should not include type 'summary'")
"""Summaries are things of their own here."""


async def test_promtool_has_nothing_to_say_of_the_metrics(promtool: str, tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", {"kind": "synthetic", "role": "robot"})).ready()
        for process in (relay, robot):
            _status, text = process.get("/metrics")
            assert "sern_link_up" in text
            asks = partial(subprocess.run, [promtool, "check", "metrics"], capture_output=True, text=True)
            done = await asyncio.to_thread(asks, input=text)
            said = (done.stdout + done.stderr).splitlines()
            assert [line for line in said if not OURS.fullmatch(line)] == []
        await robot.stop()
        await relay.stop()
