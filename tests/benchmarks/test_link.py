"""What the link benchmark offers and how it reckons, without a link."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("psutil")

from benchmarks.link import figures
from benchmarks.link.load import Kind, Load, Log, Records, read_log
from benchmarks.link.runs import Outcome
from benchmarks.link.sern import SAMPLE_COLUMNS, TOPICS
from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel

S = 1_000_000_000
START_NS = 100 * S
FLOOR_S = 0.026


def outcome(
    arrived: list[tuple[float, ...]], offered: list[tuple[float, ...]] | None = None, **changes: Any
) -> Outcome:
    """A run of 10 s over 4 Mbit/s; rows are (kind, number, stamp, time, size), times in seconds since its start."""

    def rows(given: list[tuple[float, ...]]) -> Records:
        table = np.array(given, dtype=np.float64).reshape(-1, 5)
        table[:, 2:4] = START_NS + table[:, 2:4] * S
        return table.astype(np.int64)

    fields: dict[str, Any] = {
        "system": "sern-udp",
        "model": LinkModel(rate_bps=4e6, delay_s=0.025),
        "load": Load(100_000),
        "start_ns": START_NS,
        "duration_s": 10.0,
        "offered": rows(offered if offered is not None else arrived),
        "arrived": rows(arrived),
        "robot": {},
        "site": {},
        "relay": {},
        "events": {},
        "wire_packets": 4_000,
        "wire_bytes": 5_000_000,
        "cpu_percent": {},
        "busy": 0.5,
    }
    return Outcome(**(fields | changes))


def test_the_load_is_what_it_says_and_always_the_same() -> None:
    load = Load(100_000)
    messages = list(load.schedule(10.0))
    assert [sum(flow.kind is kind for _, flow, _ in messages) for kind in Kind] == [500, 50, 100, 0]
    assert messages == sorted(messages, key=lambda item: item[0])
    assert messages == list(load.schedule(10.0)) != list(replace(load, seed=2).schedule(10.0))
    assert sum(flow.size_bytes for _, flow, _ in messages if flow.kind is Kind.BULK) * 8 / 10 == 8e6
    assert {flow.kind for _, flow, _ in Load().schedule(1.0)} == {Kind.POSE}


def test_a_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    log = Log()
    flow = Load().flows[0]
    log.sent(flow, 1, 5, 4)
    log.save(tmp_path / "log.npy")
    assert read_log(tmp_path / "log.npy").tolist() == [[flow.kind, 1, 5, 4, flow.size_bytes]]
    Log().save(tmp_path / "empty.npy")
    assert read_log(tmp_path / "empty.npy").shape == (0, len(Log.COLUMNS))


def test_latencies_leave_the_warm_up_out() -> None:
    run = outcome([(0, 1, 0.5, 1.5, 100), (0, 2, 3.0, 3.030, 100), (2, 1, 3.0, 3.5, 100_000)], warm_s=2.0)
    assert figures.latencies_ms(run).tolist() == [30.0]
    assert figures.latencies_ms(run, Kind.BULK).tolist() == [500.0]


def test_goodput_is_of_whole_messages_and_never_more_than_the_link() -> None:
    clouds: list[tuple[float, ...]] = [(2, n, 1.0 * n, 1.0 * n + 0.3, 100_000) for n in range(1, 9)]
    assert figures.goodput_bps(outcome(clouds, warm_s=2.0)) == 8 * 7 * 100_000 / 8
    with pytest.raises(SernError, match=r"sern-udp: 8\.\d* Mbit/s of a link of 4 Mbit/s"):
        figures.goodput_bps(outcome([(2, n, 0.1 * n, 0.1 * n, 100_000) for n in range(100)]))


def test_poses_that_gave_way_are_forgiven_at_both_hops() -> None:
    offered: list[tuple[float, ...]] = [(0, n, 0.02 * n, 0.02 * n, 100) for n in range(1, 11)]
    gone = {TOPICS[Kind.POSE]: {"dropped": {"superseded": 1}}}
    run = outcome(offered[:7], offered, robot={"topics": gone}, relay={"links": {"site": gone}})
    assert figures.delivered_share(run) == pytest.approx(0.7)
    assert figures.delivered_share(run, forgive_superseded=True) == pytest.approx(7 / 8)


def test_the_first_fresh_pose_is_no_old_one() -> None:
    events = {"back": (START_NS + 5 * S, START_NS + 5 * S)}
    run = outcome([(0, 1, 1.0, 5.1, 100), (0, 2, 5.2, 5.24, 100), (0, 3, 5.3, 5.33, 100)], events=events)
    assert figures.first_fresh_s(run, "back", FLOOR_S) == pytest.approx(0.24)
    assert figures.first_fresh_s(outcome([], events=events), "back", FLOOR_S) == figures.NEVER_S


def test_an_estimate_has_settled_when_it_stays_near() -> None:
    def samples(rates_bps: list[float]) -> dict[str, Any]:
        rest = [0.0] * (len(SAMPLE_COLUMNS) - 2)
        return {"samples": [[START_NS + 0.1 * n * S, rate, *rest] for n, rate in enumerate(rates_bps)]}

    events = {"down": (START_NS, START_NS)}
    rates_bps = [8e6, 1.1e6, 3e6, 1.2e6, 0.9e6, 1e6, 1e6, 1e6]
    run = outcome([], events=events, robot=samples(rates_bps))
    assert figures.settled_s(run, "down", 1e6, None) == pytest.approx(0.3)
    assert figures.settled_s(outcome([], events=events, robot=samples([8e6] * 9)), "down", 1e6, None) == figures.NEVER_S


def test_what_a_link_can_carry_is_less_than_its_rate() -> None:
    whole = figures.ceiling_bps(outcome([]))
    assert 3.5e6 < whole < 3.8e6
    lossy = figures.ceiling_bps(outcome([], model=LinkModel(rate_bps=4e6, loss=0.02)))
    assert lossy == pytest.approx(0.98 * whole)
