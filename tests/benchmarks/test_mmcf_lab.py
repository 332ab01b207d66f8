"""What the adaptation's benchmark in the lab reckons and writes, without a lab."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("psutil")

from benchmarks import recordings
from benchmarks.common import Report, half_width_95
from benchmarks.mmcf_lab import LINK, ROBOT, THIN_BPS, Edge, intervals, rates_bps, robot_file, site_file, staged
from benchmarks.mmcf_replay import EVERY_NTH_POINT, POLICIES, PROFILES, recorded, tabulate
from sern_client.endpoints.clouds import read_ply
from sern_core.adaptation.adapter import AdapterParams
from sern_core.adaptation.model import Terms
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import PriorityClass
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.client import load_client
from sern_tools.keygen import make_keys
from sern_tools.message_log import Delivery, Offer, TopicLog
from tests.daemons import recording

S = 1_000_000_000
POSE, CLOUD = "/robot/odom", "/robot/points"
PARAMS = AdapterParams()
LINK_BPS = 4e6


def log(topic: str, priority: str, messages: list[tuple[float, float | None]]) -> TopicLog:
    """Messages as (offered at, latency or None for one that never came), in seconds."""
    found = TopicLog(topic, priority, ROBOT)
    for seq, (at_s, latency_s) in enumerate(messages, start=1):
        at_ns = int(at_s * S)
        found.offers[seq] = Offer(at_ns, seq, 1000, 0)
        if latency_s is not None:
            found.deliveries.append(Delivery(at_ns + int(latency_s * S), seq, 1000, 0, at_ns, None))
    return found


def edges(*left_out: int, wire_bytes: int = 100_000, cpu_s: float = 0.05) -> list[Edge]:
    """One a second; by each, so many clouds had been left out."""
    return [Edge(n * S, n * wire_bytes, n * cpu_s, {CLOUD: count}) for n, count in enumerate(left_out)]


def test_terms_are_by_what_arrived_and_by_what_was_used() -> None:
    poses = log(POSE, "control", [(0.1, 0.05), (0.3, 0.15), (0.5, 0.4), (0.7, None), (2.5, 0.1)])
    (terms,) = intervals({POSE: poses}, edges(0, 0)[:2], PARAMS, [LINK_BPS])
    assert terms.latency == pytest.approx(0.2 / 0.5)
    assert terms.unreliability == pytest.approx(0.5), "one never came, one came after its deadline of 0.3 s"
    assert terms.compute == pytest.approx(0.05 / 0.25)
    assert terms.bandwidth == pytest.approx(8e5 / LINK_BPS)
    (thin,) = intervals({POSE: poses}, edges(0, 0)[:2], PARAMS, [1e6])
    assert thin.bandwidth == pytest.approx(0.8), "of what the link was set to carry then"
    assert thin[:3] == terms[:3]


def test_a_message_belongs_to_the_interval_in_which_it_was_offered() -> None:
    poses = log(POSE, "control", [(0.9, 0.25), (1.1, 0.05), (2.0, None), (-0.1, None)])
    first, second = intervals({POSE: poses}, edges(0, 0, 0), PARAMS, [LINK_BPS] * 2)
    assert [first.latency, second.latency] == pytest.approx([0.5, 0.1])
    assert first.unreliability == second.unreliability == 0.0, "what was offered before and after does not count"


def test_what_was_left_out_is_unreliable_and_what_was_lost_is_late_as_well() -> None:
    poses = log(POSE, "control", [(0.5, 0.0), (1.5, 0.0)])
    clouds = log(CLOUD, "bulk", [(0.5, None), (1.5, None)])
    logs = {POSE: poses, CLOUD: clouds}
    share = 0.1 / 0.7  # of class bulk beside control
    out, lost = intervals(logs, edges(0, 1, 1), PARAMS, [LINK_BPS] * 2)
    assert [out.latency, out.unreliability] == pytest.approx([0.0, share])
    assert [lost.latency, lost.unreliability] == pytest.approx([share, share])


def test_a_share_of_the_clouds_is_enough_and_a_second_copy_counts_once() -> None:
    clouds = log(CLOUD, "bulk", [(0.1, 0.1), (0.3, 0.1), (0.5, None), (0.7, None), (0.9, None)])
    (terms,) = intervals({CLOUD: clouds}, edges(0, 3), PARAMS, [LINK_BPS])
    assert terms.unreliability == 0.0
    clouds.deliveries.append(clouds.deliveries[0]._replace(wall_ns=5 * S))
    assert intervals({CLOUD: clouds}, edges(0, 3), PARAMS, [LINK_BPS]) == [terms]


def test_a_run_without_messages_is_an_error() -> None:
    with pytest.raises(SernError, match="nothing was offered"):
        intervals({POSE: log(POSE, "control", [(9.0, 0.1)])}, edges(0, 0), PARAMS, [LINK_BPS])


def test_the_link_is_thin_in_the_second_third() -> None:
    assert rates_bps(9) == [LINK.rate_bps] * 3 + [THIN_BPS] * 3 + [LINK.rate_bps] * 3


def test_runs_are_in_mixed_order_and_both_orders_are_reported_as_they_are() -> None:
    """A machine that gets slower: 1 % of the cost with every run that came before."""
    asked: list[tuple[str, str, int]] = []

    def drifting(section: AdaptationSection, number: int) -> list[Terms]:
        asked.append((section.profile, section.policy, number))
        slow = 0.01 * len(asked)
        return [Terms(slow, slow, slow, slow), Terms(0.5 + slow, 0.5 + slow, 0.5 + slow, 0.5 + slow)]

    report = Report("mmcf_lab")
    tabulate(report, drifting, 4)
    cases = [(profile, policy) for profile in PROFILES for policy in POLICIES]
    assert [case[:2] for case in asked] == [*cases, *reversed(cases), *cases, *reversed(cases)]
    assert [number for *_, number in asked] == [number for number in range(4) for _ in cases]
    assert [(row.case, row.system) for row in report.rows] == cases
    for row in report.rows:
        costs = [0.25 + 0.01 * (1 + i) for i, case in enumerate(asked) if case[:2] == (row.case, row.system)]
        assert row.metrics["cost_1"] == pytest.approx(sum(costs) / 4)
        assert row.metrics["forward_1"] == pytest.approx((costs[0] + costs[2]) / 2)
        assert row.metrics["backward_1"] == pytest.approx((costs[1] + costs[3]) / 2)
        assert row.metrics["plusminus_1"] == pytest.approx(half_width_95(costs))
    means = {row.metrics["cost_1"] for row in report.rows}
    assert max(means) == pytest.approx(min(means)), "the drift falls on all alike"


def test_confidence_intervals_are_students() -> None:
    assert half_width_95([1.0]) == float("inf")
    assert half_width_95([1.0, 1.0, 1.0]) == 0.0
    assert half_width_95([0.0, 2.0]) == pytest.approx(12.71)
    assert half_width_95([0.0, 1.0] * 10) == pytest.approx(2.093 * (5 / 19) ** 0.5 / 20**0.5, rel=5e-3)
    assert half_width_95([0.0, 1.0] * 200) == pytest.approx(1.966 * (100 / 399) ** 0.5 / 20.0, rel=5e-3)


@pytest.mark.parametrize("columns", [3, 4])
def test_a_scan_is_written_as_it_is_read(tmp_path: Path, columns: int) -> None:
    points = np.arange(10 * columns, dtype=np.float32).reshape(10, columns)
    recordings.write_scan(points, tmp_path / "scan.ply")
    assert read_ply(tmp_path / "scan.ply").tolist() == points.tolist()


@pytest.fixture(params=["recorded", "made up"])
def data(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Where the recordings are; and a folder that has none."""
    if request.param == "made up":
        return tmp_path / "nothing"
    for name in (recordings.DRIVE, *recordings.SCANS):
        recording(name)
    return recordings.DATA


def test_the_load_is_the_same_with_recordings_and_without(data: Path) -> None:
    """Three topics of a robot and a LiDAR, as often and as large; what was made up is said."""
    load = recorded(40.0, data)
    kinds = {name: spec.priority for name, (_, spec) in load.specs.items()}
    assert sorted(kinds.values()) == [
        PriorityClass.CONTROL,
        PriorityClass.CONTROL,
        PriorityClass.STATE,
        PriorityClass.BULK,
    ]
    counts = {priority: sum(kinds[topic] is priority for _, topic, _ in load.messages) for priority in PriorityClass}
    assert counts[PriorityClass.CONTROL] == pytest.approx(1600, abs=10)
    assert counts[PriorityClass.STATE] == pytest.approx(100, abs=3)
    assert counts[PriorityClass.BULK] == 200
    sizes = {kinds[topic]: len(body) for _, topic, body in load.messages}
    assert sizes[PriorityClass.BULK] == pytest.approx(140_000, rel=0.05)
    assert [at_s for at_s, _, _ in load.messages] == sorted(at_s for at_s, _, _ in load.messages)
    assert ("made-up" in load.note) == (data != recordings.DATA)


def test_what_is_made_up_is_the_same_every_time(tmp_path: Path) -> None:
    first, second = recorded(2.0, tmp_path), recorded(2.0, tmp_path)
    assert first.messages == second.messages
    assert all(name in first.note for name in (recordings.DRIVE, *recordings.SCANS))


def test_a_scan_alone_that_is_missing_is_named(tmp_path: Path) -> None:
    (tmp_path / recordings.DRIVE).touch()
    (tmp_path / recordings.SCANS[0]).touch()
    assert recordings.absent(tmp_path) == [recordings.SCANS[1]]
    assert recordings.SCANS[1] in recordings.note(tmp_path) and recordings.DRIVE not in recordings.note(tmp_path)


def test_the_files_are_configurations_of_clients(tmp_path: Path, data: Path) -> None:
    make_keys(tmp_path, "relay", "robot", "site")
    played = staged(tmp_path, data)
    whole = recordings.scans(data)
    assert [read_ply(path).tolist() for path in played.scans] == [scan[::EVERY_NTH_POINT].tolist() for scan in whole]
    section = AdaptationSection.model_validate({"policy": "fixed_reliability", "profile": "mapping"})
    specs = {"/odom": TopicSpec(priority=PriorityClass.CONTROL), "/points": TopicSpec(lifespan_s=2.0)}
    robot = load_client(robot_file(tmp_path, "198.18.1.1", specs, section, played)).model
    assert robot.adaptation == section
    assert [(rule.match, rule.priority, rule.lifespan_s) for rule in robot.topics] == [
        ("/odom", "control", specs["/odom"].lifespan_s),
        ("/points", "bulk", 2.0),
    ]
    assert robot.all_relays[0].udp
    site = load_client(site_file(tmp_path, "198.18.1.1")).model
    assert site.adaptation is None and site.subscribe == (f"/{ROBOT}/.*",)
