"""The analysis of a run: statistics, and every promise broken once."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sern_tools.counters import Counters
from sern_tools.message_log import Event, Offer
from sern_tools.summary import Verdict, judge
from tests.sern_tools.logs import CLOUD, COMMAND, FACTS, FLOOR_S, MAP, MS, ORIGIN_NS, POSE, Run, good_run, with_counter

LIMITS = {"control": 0.01, "state": 0.10}
PROMISES = {
    "reliable_faults",
    "corrupted_messages",
    "control_overtaken_share",
    "state_overtaken_share",
    "expired_commands",
    "uncounted_messages",
    "control_p99_s",
    "first_fresh_pose_s",
}


def verdicts(run: Run) -> dict[str, Verdict]:
    baseline = good_run(latency_ms=2000)
    baseline.counters.clear()
    judged = judge(run.analyse(), baseline.analyse("plain ZMQ"), overtaken_share_limits=LIMITS)
    return {verdict.name: verdict for verdict in judged}


def test_a_good_run_keeps_every_promise() -> None:
    judged = verdicts(good_run())
    assert judged.keys() == PROMISES
    assert [v for v in judged.values() if not v.ok] == []


@pytest.mark.parametrize(("share", "kept"), [(None, None), (0.0, False), (0.5, False), (0.51, True)])
def test_a_run_without_datagrams_breaks_a_promise(share: float | None, kept: bool | None) -> None:
    judged = judge(good_run().analyse(), None, overtaken_share_limits=LIMITS, datagram_share=share)
    assert {v.name: v.ok for v in judged}.get("datagram_share") is kept


def test_statistics_of_a_good_run() -> None:
    result = good_run().analyse()
    control, state, bulk = (result.classes[label] for label in ("control", "state", "bulk"))
    assert (control.offered, control.delivered, control.undelivered) == (1000, 800, 200)
    assert control.dropped == {"lifespan": 200}
    assert control.quantile_s(0.5) == pytest.approx(0.030)
    assert np.median(control.above_floor_s) == pytest.approx(0.030 - FLOOR_S)
    assert (state.offered, state.delivered, state.undelivered, state.dropped) == (9, 9, 0, {})
    assert state.quantile_s(1.0) == pytest.approx(2.114)
    assert bulk.delivered_share == pytest.approx(39 / 49)
    assert bulk.delivered_bytes == 39 * 50_000
    assert result.first_fresh_pose_s == [pytest.approx(0.030)]
    assert result.accounting_gap == 0


def test_series_for_the_plots() -> None:
    result = good_run().analyse()
    times, latencies = result.arrivals("control")
    assert len(times) == 800
    assert list(times) == sorted(times)
    assert latencies[0] == pytest.approx(0.030)
    times, ages = result.pose_age(step_s=0.5)
    assert np.isnan(ages[0])
    assert ages[2] == pytest.approx(0.040)
    assert ages[11] == pytest.approx(5.5 - 3.98)


def test_a_class_without_messages_has_no_quantiles() -> None:
    run = good_run()
    del run.logs[CLOUD]
    result = run.analyse()
    assert math.isnan(result.classes["bulk"].quantile_s(0.99))
    assert math.isnan(result.classes["bulk"].delivered_share)
    assert np.isnan(replace(result, logs={}).pose_age()[1]).all()


def _lose_a_map(run: Run) -> None:
    run.lose(MAP, 4, received=False)
    run.drop(MAP, 4, "shutdown")


def _repeat_a_map(run: Run) -> None:
    run.deliver(MAP, 2, 9500)
    with_counter(run, MAP, 2, delivered=10)
    with_counter(run, MAP, 0, refused=1)
    run.logs[MAP].refused.add(99)


def _swap_maps(run: Run) -> None:
    deliveries = run.logs[MAP].deliveries
    deliveries[0], deliveries[1] = deliveries[1], deliveries[0]


def _no_map_at_all(run: Run) -> None:
    del run.logs[MAP]


def _flip_a_bit(run: Run) -> None:
    deliveries = run.logs[CLOUD].deliveries
    deliveries[5] = deliveries[5]._replace(crc32=1)


def _invent_a_message(run: Run) -> None:
    deliveries = run.logs[CLOUD].deliveries
    deliveries[5] = deliveries[5]._replace(seq=4000)


def _clouds_first(run: Run) -> None:
    for i, delivery in enumerate(run.logs[POSE].deliveries[:100]):
        run.logs[POSE].deliveries[i] = delivery._replace(wall_ns=delivery.wall_ns + 900 * MS)


def _clouds_before_maps(run: Run) -> None:
    for i, delivery in enumerate(run.logs[MAP].deliveries[:2]):
        run.logs[MAP].deliveries[i] = delivery._replace(wall_ns=delivery.wall_ns + 900 * MS)


def _a_late_command(run: Run) -> None:
    delivery = run.logs[COMMAND].deliveries[50]
    run.logs[COMMAND].deliveries[50] = delivery._replace(wall_ns=delivery.stamp_ns + 400 * MS)


def _no_commands(run: Run) -> None:
    run.logs[COMMAND].deliveries.clear()
    run.count()


def _forget_a_drop(run: Run) -> None:
    run.counters[POSE][0] = replace(run.counters[POSE][0], dropped={"lifespan": 99})


def _count_a_delivery_that_was_none(run: Run) -> None:
    with_counter(run, CLOUD, 2, delivered=40)
    run.counters[CLOUD][0] = replace(run.counters[CLOUD][0], dropped={"lifespan": 9})


def _lose_one_that_was_acknowledged(run: Run) -> None:
    run.lose(POSE, 7, received=False)


def _lose_one_at_the_relay(run: Run) -> None:
    run.lose(POSE, 7, received=True)


def _lose_one_among_many_unconfirmed(run: Run) -> None:
    for seq in range(10, 20):
        run.drop(POSE, seq, "unconfirmed")
    run.lose(POSE, 7, received=False)


def _drop_one_that_arrived(run: Run) -> None:
    run.drop(POSE, 7, "superseded")


def _drop_one_twice(run: Run) -> None:
    run.drop(CLOUD, 7, "lifespan", at="onward")


def _slow_poses(run: Run) -> None:
    for topic in (POSE, COMMAND):
        log = run.logs[topic]
        log.deliveries = [d._replace(wall_ns=d.stamp_ns + 210 * MS) for d in log.deliveries]


def _poses_stay_away(run: Run) -> None:
    log = run.logs[POSE]
    late_ns = ORIGIN_NS + 9500 * MS
    log.deliveries = [
        d._replace(wall_ns=max(d.wall_ns, late_ns) if d.wall_ns > ORIGIN_NS + 6000 * MS else d.wall_ns)
        for d in log.deliveries
    ]


@pytest.mark.parametrize(
    ("spoil", "broken"),
    [
        (_lose_a_map, {"reliable_faults"}),
        (_repeat_a_map, {"reliable_faults"}),
        (_swap_maps, {"reliable_faults"}),
        (_no_map_at_all, {"reliable_faults"}),
        (_flip_a_bit, {"corrupted_messages"}),
        (_invent_a_message, {"corrupted_messages", "uncounted_messages"}),
        (_lose_one_that_was_acknowledged, {"uncounted_messages"}),
        (_lose_one_at_the_relay, {"uncounted_messages"}),
        (_lose_one_among_many_unconfirmed, {"uncounted_messages"}),
        (_drop_one_that_arrived, {"uncounted_messages"}),
        (_drop_one_twice, {"uncounted_messages"}),
        (_clouds_first, {"control_overtaken_share", "control_p99_s"}),
        (_clouds_before_maps, {"state_overtaken_share"}),
        (_a_late_command, {"expired_commands"}),
        (_no_commands, {"expired_commands"}),
        (_forget_a_drop, {"uncounted_messages"}),
        (_count_a_delivery_that_was_none, {"uncounted_messages"}),
        (_slow_poses, {"control_p99_s", "control_overtaken_share"}),
        (_poses_stay_away, {"first_fresh_pose_s", "control_p99_s", "control_overtaken_share"}),
    ],
)
def test_a_broken_promise_is_seen(spoil: Callable[[Run], None], broken: set[str]) -> None:
    run = good_run()
    spoil(run)
    assert {name for name, verdict in verdicts(run).items() if not verdict.ok} == broken


def test_no_pose_after_the_blackout_is_infinitely_late() -> None:
    run = good_run()
    log = run.logs[POSE]
    log.deliveries = [d for d in log.deliveries if d.wall_ns < ORIGIN_NS + 5000 * MS]
    assert run.analyse().first_fresh_pose_s == [math.inf]


def test_an_old_pose_after_the_blackout_is_not_fresh() -> None:
    run = good_run()
    log = run.logs[POSE]
    stale = next(d for d in log.deliveries if d.wall_ns > ORIGIN_NS + 3900 * MS)
    log.deliveries.append(stale._replace(wall_ns=ORIGIN_NS + 6001 * MS, seq=199))
    assert run.analyse().first_fresh_pose_s == [pytest.approx(0.030)]


def test_a_reported_or_refused_message_is_not_missing() -> None:
    run = good_run()
    log = run.logs[MAP]
    del log.deliveries[3:5]
    log.expired[4] = "retention"
    log.refused.add(5)
    result = run.analyse()
    assert result.topics[MAP].undelivered == 0
    assert result.topics[MAP].refused == 1
    assert verdicts(run)["reliable_faults"].ok


def test_what_was_not_tested_is_not_promised() -> None:
    run = good_run()
    run.counters.clear()
    facts = replace(FACTS, blackouts=((9.0, 12.0),), command_lifespans_s={})
    names = {v.name for v in judge(run.analyse(facts=facts), None, overtaken_share_limits={"control": 0.01})}
    assert names == {"reliable_faults", "corrupted_messages", "control_overtaken_share"}


def test_counters_that_are_missing_leave_a_gap() -> None:
    run = good_run()
    run.counters[POSE] = [Counters("robot", "send", offered=500)]
    result = run.analyse()
    assert result.accounting_gap == 100 + 400
    assert "400 delivered in the logs, 0 in the counters" in " ".join(result.accounting_notes)


def test_what_the_sender_could_not_know_the_next_place_does() -> None:
    run = good_run()
    run.drop(POSE, 1, "unconfirmed")  # it was delivered
    run.lose(POSE, 2, received=True)
    run.drop(POSE, 2, "unconfirmed")
    run.drop(POSE, 2, "superseded", at="onward")
    run.lose(POSE, 3, received=False)
    run.drop(POSE, 3, "unconfirmed")
    run.drop(POSE, 3, "lost", at="inward")  # a part of it
    run.lose(POSE, 4, received=False)
    run.drop(POSE, 4, "unconfirmed")
    run.lose(POSE, 5, received=True)
    run.drop(POSE, 5, "unconfirmed", at="onward")
    run.drop(POSE, 5, "lifespan", at="subscriber")
    run.drop(POSE, 6, "unconfirmed", at="onward")  # it was delivered
    result = run.analyse()
    assert (result.accounting_gap, result.accounting_notes) == (0, [])
    fates = result.fates[POSE].by_seq
    assert [fates[seq] for seq in range(1, 7)] == [
        ("site", "delivered"),
        ("relay", "superseded"),
        ("relay", "lost"),
        ("robot", "unconfirmed"),
        ("site", "lifespan"),
        ("site", "delivered"),
    ]
    statistics = result.topics[POSE]
    assert statistics.dropped == {"lifespan": 101, "superseded": 1, "lost": 1, "unconfirmed": 1}
    assert statistics.offered == statistics.delivered + statistics.dropped.total() == 500
    detail = verdicts(run)["uncounted_messages"].detail
    assert "6 given up unconfirmed, of which the next place knows 5" in detail
    assert detail.startswith("1058 offered = ")


def test_a_part_that_arrived_is_dropped_once_where_its_sender_gave_it_up() -> None:
    run = good_run()
    dropped = run.logs[CLOUD].dropped["robot", "relay"]
    for seq in list(dropped)[:5]:
        run.drop(CLOUD, seq, "lost", at="inward")
    result = run.analyse()
    assert result.accounting_gap == 0 and result.topics[CLOUD].dropped == {"lifespan": 10}


@pytest.mark.parametrize(("at", "direction"), [("origin", "send"), ("onward", "onward"), ("subscriber", "receive")])
def test_a_line_that_no_counter_has_counted_is_seen(at: str, direction: str) -> None:
    run = good_run()
    run.lose(CLOUD, 1, received=at != "origin")
    run.drop(CLOUD, 1, "fault", at=at, counted=False)
    result = run.analyse()
    assert result.accounting_gap == 1
    assert f"1 dropped ({direction}, fault) in the logs, 0 in the counters" in result.accounting_notes[0]


def test_of_a_reliable_stream_the_origin_knows_every_drop() -> None:
    run = good_run()
    run.lose(MAP, 4, received=True)
    run.logs[MAP].expired[4] = "queue_full"
    run.logs[MAP].lines[Event.EXPIRED] = Counter({("site", "queue_full"): 1})
    run.counters[MAP][2] = replace(run.counters[MAP][2], dropped={"queue_full": 1})
    run.drop(MAP, 4, "queue_full")
    run.drop(MAP, 4, "queue_full", at="onward")
    result = run.analyse()
    assert result.accounting_gap == 0 and verdicts(run)["reliable_faults"].ok
    assert result.topics[MAP].dropped == {"queue_full": 1}


@pytest.mark.parametrize(("reason", "gap"), [("retention", 0), ("unconfirmed", 0), ("queue_full", 1)])
def test_a_reliable_message_may_arrive_after_its_origin_gave_up_waiting(reason: str, gap: int) -> None:
    run = good_run()
    run.drop(MAP, 4, reason)
    assert run.analyse().accounting_gap == gap


def test_what_still_waits_at_the_end_is_under_way_and_not_lost() -> None:
    run = good_run()
    run.lose(CLOUD, 1, received=True)
    run.lose(CLOUD, 2, received=True)
    run.logs[CLOUD].held = {("relay", "site"): {1: "", 2: "unconfirmed"}}
    result = run.analyse()
    statistics = result.topics[CLOUD]
    assert result.accounting_gap == 0
    assert (statistics.under_way, statistics.unseen, statistics.undelivered) == (2, 0, 12)


def test_drop_reasons_of_the_log_serve_when_there_are_no_counters() -> None:
    run = good_run()
    run.counters.clear()
    run.logs[POSE].offers[501] = Offer(ORIGIN_NS, 501, 1, 1)
    run.logs[POSE].expired[501] = "lifespan"
    assert run.analyse().topics[POSE].dropped == {"lifespan": 1}
