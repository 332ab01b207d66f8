"""How figures of several relays are reckoned, and what is left out where something is missing."""

import importlib.util
from argparse import Namespace
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks.common import Report
from benchmarks.document import render
from benchmarks.fabric import __main__ as fabric
from benchmarks.fabric import path
from benchmarks.fabric.robots import RELAYS, robots_of, takes
from benchmarks.fabric.world import LOG, POSE, Fate, Flow, ages_s, fate, pause, write_bag
from benchmarks.link.figures import NEVER_S
from sern_core.topics.patterns import PatternSet
from sern_tools.lab.host import LabError
from sern_tools.message_log import Delivery, Offer, TopicLog
from tests.daemons import bodies

MS = 1_000_000


def log_of(offered: int, came_ms: dict[int, int] | list[tuple[int, int]], period_ms: int = 20) -> TopicLog:
    """A message each period from 0 on, seq from 1; `came_ms`: (seq, when)."""
    log = TopicLog("/robot1/pose", "control")
    for number in range(offered):
        log.offers[number + 1] = Offer(number * period_ms * MS, number + 1, 100, 0)
    for seq, at_ms in came_ms.items() if isinstance(came_ms, dict) else came_ms:
        log.deliveries.append(Delivery(at_ms * MS, seq, 100, 0, 0, None))
    return log


def test_a_pause_ends_with_the_first_fresh_pose() -> None:
    came = {seq: (seq - 1) * 20 + 5 for seq in range(1, 101)}
    for seq in range(51, 70):
        came[seq] = 1500  # held back, and old when they came
    took_s, after_s = pause(log_of(100, came), 1000 * MS, 2000 * MS)
    assert took_s == pytest.approx(1.385 - 0.985, abs=0.001)  # of 50 and 70
    assert after_s == pytest.approx(0.385, abs=0.001)


def test_what_comes_no_more_never_comes() -> None:
    came = {seq: (seq - 1) * 20 + 5 for seq in range(1, 41)}
    assert pause(log_of(200, came), 500 * MS, 4000 * MS) == (NEVER_S, NEVER_S)


def test_lost_doubled_and_swapped_are_told_apart() -> None:
    log = log_of(6, [(1, 1), (2, 2), (2, 3), (5, 4), (4, 5)])
    log.refused.add(6)
    assert fate(log) == Fate(lost=1, doubled=1, swapped=1)


def test_ages_are_of_what_was_offered_meanwhile() -> None:
    log = log_of(4, {1: 50, 2: 30, 3: 41, 4: 300})
    assert ages_s(log, 20 * MS, 60 * MS) == pytest.approx([0.001, 0.010])


def test_every_robot_is_heard_by_one_site_and_one_in_five_at_another_relay() -> None:
    patterns = [PatternSet(tuple(takes(place))) for place in range(len(RELAYS))]
    crossing = 0
    for place, relay in enumerate(RELAYS):
        for robot in robots_of(relay):
            sites = [other for other, each in enumerate(patterns) if each.fullmatch(f"/{robot}/topic0")]
            assert len(sites) == 1
            crossing += sites[0] != place
    assert crossing == len(RELAYS) * 5


def test_what_is_missing_is_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_lab(_lab: str) -> None:
        raise LabError("the lab needs root")

    def measured(_options: Namespace, report: Report) -> None:
        report.row("one of them fails", "router killed", gap_s=0.052, fresh_s=0.051, lost_count=0)
        report.row("one of them fails", "relay killed", gap_s=2.1, fresh_s=2.05, lost_count=0)

    monkeypatch.setattr(path, "choose", no_lab)
    monkeypatch.setattr(fabric, "PARTS", {"path": path.bench, "failover": measured})
    monkeypatch.setattr(fabric, "try_realtime", lambda: "no real-time priority")
    report = Report("fabric")
    fabric.bench(Namespace(only=None, systems=None, cases=None, quick=True, rounds=None, seconds=None), report)
    assert "no path: the lab needs root" in report.notes
    assert "| router killed | 0.052 | 0.051 | 0 |" in render(report.as_json())
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    alone = Report("fabric")
    fabric.bench(Namespace(only=None), alone)
    assert alone.notes == ["nothing is measured: zenoh is not installed (pip install eclipse-zenoh)"]


def test_a_recording_has_a_second_of_each_flow(tmp_path: Path) -> None:
    found = bodies(write_bag(tmp_path / "x.bag", (POSE, LOG, Flow("/bulk", 1000, 7, {}))))
    assert {topic: len(each) for topic, each in found.items()} == {"/pose": 50, "/log": 50, "/bulk": 7}
    assert {len(body) for body in found["/bulk"]} == {1004}
