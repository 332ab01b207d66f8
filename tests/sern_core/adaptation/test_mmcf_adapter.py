"""The adaptation on real links in virtual time: what it measures, what it applies, and that it harms nothing."""

import itertools
from dataclasses import replace

import pytest

from sern_core.adaptation.adapter import LOSSY_MODE
from sern_core.adaptation.cost import Ranges
from sern_core.adaptation.model import Configuration
from sern_core.adaptation.policy import FixedPolicy, Mmcf
from sern_core.adaptation.report import adapter_json, step_json
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.params import LinkParams, Redundancy
from sern_core.vocabulary.types import DropReason
from sern_sim.models import LinkModel, RateStep
from tests.adapting import ALL_RAW, BULK, CONTROL, GRID, LEVELS, STATE, TEXT, WEIGHTS, Thinned, rig
from tests.world import spec


def test_it_measures_what_is_offered_and_foresees_what_comes_of_it() -> None:
    r = rig()
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    scan = r.robot.publish("/robot/scan", spec(STATE, lifespan_s=1.0))
    cloud = r.robot.publish("/robot/points", spec(BULK, lifespan_s=1.0))
    r.feed(pose, 50.0, 120)
    r.feed(scan, 10.0, 2200)
    r.feed(cloud, 5.0, 60_000)
    r.world.run(12.0)
    last = r.steps[-1]
    offered = {demand.priority: (demand.rate_hz, demand.mean_bytes) for demand in last.situation.classes}
    assert offered[CONTROL] == pytest.approx((50.0, 120.0), rel=0.05)
    assert offered[STATE] == pytest.approx((10.0, 2200.0), rel=0.05)
    assert offered[BULK] == pytest.approx((5.0, 60_000.0), rel=0.05)
    assert last.situation.link.rtt_s == pytest.approx(0.05, abs=0.03)
    assert last.measurement is not None and last.cost is not None
    assert last.measurement.unreliability < 0.05
    assert r.adapter.prediction_error == pytest.approx(0.0, abs=0.02)
    ratio = last.situation.classes[2].codec("zstd").ratio
    assert 0.5 < ratio < 0.7
    r.world.validate()


def test_a_drop_of_the_link_is_followed_and_nothing_reliable_is_lost_or_reordered() -> None:
    """Rates, queue limits and modes change under traffic: reliable messages arrive whole, once, in order; of the others
    each has one fate, and never goes back."""
    steps = (RateStep(8.0, 0.5e6), RateStep(16.0, 4e6))
    r = rig(model=LinkModel(rate_bps=4e6, delay_s=0.025, rate_steps=steps))
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    log = r.robot.publish("/robot/log", spec(STATE, reliable=True))
    cloud = r.robot.publish("/robot/points", spec(BULK, lifespan_s=1.0, depth=4))
    r.feed(pose, 50.0, 120, until_s=24.0)
    r.feed(log, 5.0, 800, until_s=24.0)
    r.feed(cloud, 5.0, 60_000, until_s=24.0)
    r.world.network.every(0.25, lambda _now: r.world.validate())
    r.world.run(30.0)
    assert {str(step.decision.chosen) for step in r.steps} > {str(r.steps[0].decision.chosen)}
    assert r.site.seqs("/robot/log") == list(range(1, log.next_seq))
    for topic in ("/robot/pose", "/robot/points"):
        seqs = r.site.seqs(topic)
        assert seqs == sorted(set(seqs))
    counters = cloud.counters
    assert counters.offered == counters.delivered + counters.dropped
    assert cloud.thinned == counters.by_reason[DropReason.RATE_CAP] > 0
    assert log.thinned == 0
    assert len(r.site.seqs("/robot/pose")) > 0.9 * (pose.next_seq - 1)


def test_the_configuration_reaches_channels_lanes_and_codecs() -> None:
    asked = Configuration((1.0, 0.5, 0.25), (10, 2, 3), "zstd", 1)
    r = rig(FixedPolicy(asked), lossless=False)
    scan = r.robot.publish("/robot/scan", spec(STATE, lifespan_s=1.0, depth=5))
    cloud = r.robot.publish("/robot/points", spec(BULK, lifespan_s=1.0, depth=2))
    raw = r.robot.publish("/robot/raw", spec(BULK, lifespan_s=1.0, compression=Compression.NONE))
    latched = r.robot.publish("/robot/map", spec(STATE, reliable=True, latched=True, depth=5))
    r.feed(scan, 10.0, 1000)
    r.feed(cloud, 8.0, 5000)
    r.feed(raw, 8.0, 5000)
    r.world.run(6.0)
    assert (scan.share, scan.depth) == (0.5, 2)
    assert (cloud.share, cloud.depth) == (0.25, 2)  # its own depth is less
    assert (latched.share, latched.depth) == (1.0, 5)
    assert scan.codec is not None and scan.codec.setting is Compression.ZSTD
    assert raw.codec is not None and raw.codec.setting is Compression.NONE  # its rule says so
    assert r.robot.core.link.lane.redundant
    assert cloud.thinned == pytest.approx(0.75 * 8.0 * 5.0, abs=6)
    r.adapter.close(now=r.world.now)
    assert (cloud.share, cloud.depth) == (1.0, 2) and scan.depth == 5
    assert not r.robot.core.link.lane.redundant


def test_lossy_means_what_each_topic_allows() -> None:
    r = rig(FixedPolicy(Configuration(codec=LOSSY_MODE)))
    cloud = r.robot.publish(
        "/robot/points",
        replace(spec(BULK), lossy=(Compression.VOXEL_DRACO,)),
        type_name="sensor_msgs/msg/PointCloud2",
    )
    grid = r.robot.publish("/robot/grid", spec(STATE))
    r.world.run(3.0)
    assert cloud.codec is not None and cloud.codec.setting is Compression.VOXEL_DRACO
    assert grid.codec is not None and grid.codec.setting is Compression.ZSTD


def test_redundancy_is_left_to_the_configuration_file_where_it_decides() -> None:
    r = rig(FixedPolicy(Configuration(redundancy=1)), lossless=False, link=LinkParams(redundancy=Redundancy.OFF))
    r.world.run(3.0)
    assert not r.robot.core.link.lane.redundant
    r = rig(FixedPolicy(Configuration(redundancy=0)), lossless=False, link=LinkParams(redundancy=Redundancy.ALWAYS))
    r.world.run(3.0)
    assert r.robot.core.link.lane.redundant


def test_a_class_that_appears_is_taken_in_within_one_interval_and_nothing_else_is_disturbed() -> None:
    r = rig(model=LinkModel(rate_bps=3e6, delay_s=0.025))
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    r.feed(pose, 50.0, 120)
    r.world.run(6.0)
    assert [demand.priority for demand in r.steps[-1].situation.classes] == [CONTROL]
    cloud = r.robot.publish("/robot2/points", spec(BULK, lifespan_s=1.0))
    r.site.subscribe("/robot.*/.*")
    began_s = r.world.network.elapsed_s
    r.feed(cloud, 5.0, 60_000)
    r.world.until(lambda: r.site.on("/robot2/points"), within_s=2.0)
    assert r.world.network.elapsed_s - began_s < 1.0
    r.world.run(1.2)
    known = [
        step.now - r.world.network.start_s
        for step in r.steps
        if any(demand.priority is BULK for demand in step.situation.classes)
    ]
    assert known and known[0] - began_s <= 1.1
    r.world.run(4.0)
    assert cloud.share == r.adapter.policy.active.rates[BULK]
    gone_s = r.world.network.elapsed_s
    r.robot.core.unpublish(cloud, now=r.robot.now)
    r.world.run(2.2)
    assert [demand.priority for demand in r.at(gone_s + 2.0).situation.classes] == [CONTROL]
    poses = [got for got in r.site.on("/robot/pose") if got.at_s - r.world.network.start_s > 1.0]
    gaps = [b.at_s - a.at_s for a, b in itertools.pairwise(poses)]
    assert max(gaps) < 0.2  # the first cloud finds a link that has never been full
    r.world.validate()


def test_while_the_link_is_down_nothing_is_decided() -> None:
    r = rig()
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    r.feed(pose, 50.0, 120)
    r.world.run(5.0)
    r.world.hops["robot"].break_connection(reconnect_s=4.0)
    before = r.adapter.policy.active
    r.world.run(3.0)
    assert r.steps[-1].measurement is None
    assert "not known" in r.steps[-1].decision.reason
    assert r.adapter.policy.active == before
    r.world.run(8.0)
    assert r.steps[-1].measurement is not None


def test_the_report_has_every_term_the_candidates_and_the_reason() -> None:
    r = rig()
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    r.feed(pose, 50.0, 120)
    r.world.run(6.0)
    told = step_json(r.steps[-1])
    assert set(told["measured"]["terms"]) == {"latency", "unreliability", "compute", "bandwidth"}
    assert told["predicted"]["classes"][0]["class"] == "control"
    assert told["weighed"] == len(GRID) + (Configuration(queues=(10, 10, 10)) not in GRID.index)
    costs = [candidate["cost"] for candidate in told["candidates"] if not candidate["obstacle"]]
    assert len(costs) >= 2 and costs[0] == min(costs)
    assert told["reason"]
    state = adapter_json(r.adapter)
    assert state["policy"] == "mmcf" and state["configuration"]["text"] == str(r.adapter.policy.active)
    assert any(name.startswith("latency/") for name in state["corrections"])


@pytest.mark.parametrize(("in_place", "lossless"), [(False, False), (True, True)])
def test_a_cloud_goes_to_its_summary_while_the_link_is_thin_and_comes_back(*, in_place: bool, lossless: bool) -> None:
    steps = (RateStep(5.0, 0.3e6), RateStep(35.0, 6e6))
    items: list[Thinned] = []
    initial = Configuration(queues=(10, 10, 10), summaries=ALL_RAW)
    policy = Mmcf(LEVELS, weights=WEIGHTS, ranges=Ranges(), initial=initial)
    model = LinkModel(rate_bps=6e6, delay_s=0.025, rate_steps=steps)
    r = rig(policy, model, lossless=lossless, summaries=items)
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    cloud = r.robot.publish("/robot/points", spec(BULK, depth=4))
    thin = cloud if in_place else r.robot.publish("/robot/points/thin", spec(BULK, depth=4))
    item = Thinned(r.robot, cloud, thin)
    items.append(item)
    r.feed(pose, 50.0, 120)

    def send(now: float) -> None:
        if r.world.network.elapsed_s < 50.0:
            item.offer(TEXT, now)

    r.world.network.after(0.05, lambda _now: r.world.network.every(0.2, send, node=r.robot))
    r.world.network.every(0.5, lambda _now: r.world.validate())
    r.world.run(55.0)
    levels = [step.decision.chosen.summaries for step in r.steps]
    changed = [(r.steps[i + 1].now, level) for i, (old, level) in enumerate(itertools.pairwise(levels)) if level != old]
    assert [level for _, level in changed] == [(False, False, True), ALL_RAW]
    thin_s, back_s = (at_s - r.world.network.start_s for at_s, _ in changed)
    assert 5.0 < thin_s <= 8.0 and 35.0 < back_s <= 50.0
    # To see that the link is better a whole one is sent now and then, which takes a tenth of it at most.
    probes = [at_s for at_s, level in item.changes if level is SummaryLevel.RAW and thin_s < at_s < 35.0]
    assert 1 <= len(probes) <= 3
    for topic in {"/robot/points", thin.stream.id.topic}:
        seqs = r.site.seqs(topic)
        assert seqs == sorted(set(seqs))
    for channel in {cloud, thin}:
        assert channel.counters.offered == channel.counters.delivered + channel.counters.dropped
    told = step_json(r.at(25.0))
    assert told["chosen"]["summaries"] == {"control": False, "state": False, "bulk": True}
    assert "s bulk" in told["chosen"]["text"]
    r.adapter.close(now=r.world.now)
    assert item.level is SummaryLevel.RAW


@pytest.mark.parametrize("lossless", [False, True])
def test_a_probe_that_finds_a_better_link_goes_on_until_the_link_is_known(*, lossless: bool) -> None:
    """A message of 100 kB takes 20 ms at 40 Mbit/s: alone it shows less than what raw messages need."""
    steps = (RateStep(5.0, 0.3e6), RateStep(15.0, 40e6))
    items: list[Thinned] = []
    initial = Configuration(queues=(10, 10, 10), summaries=ALL_RAW)
    policy = Mmcf(LEVELS, weights=WEIGHTS, ranges=Ranges(), initial=initial)
    model = LinkModel(rate_bps=40e6, delay_s=0.005, rate_steps=steps)
    r = rig(policy, model, lossless=lossless, summaries=items)
    cloud = r.robot.publish("/robot/points", spec(BULK, depth=4))
    item = Thinned(r.robot, cloud, cloud, part=0.05)
    items.append(item)
    body = (TEXT + TEXT)[:100_000]
    r.world.network.after(
        0.05, lambda _now: r.world.network.every(0.1, lambda now: item.offer(body, now), node=r.robot)
    )
    r.world.run(45.0)
    summarised = [
        step.now - r.world.network.start_s for step in r.steps if step.decision.chosen.summaries == (False, False, True)
    ]
    assert 5.0 < summarised[0] <= 8.0
    probed_s = next(at_s for at_s, level in item.changes if level is SummaryLevel.RAW and at_s > 15.0)
    # The first probe after the change, two or three whole intervals of raw messages, and raw it stays.
    assert summarised[-1] < probed_s + 4.0
    r.world.validate()


def test_a_topic_of_which_only_the_summary_is_wanted_stays_as_its_rule_says() -> None:
    items: list[Thinned] = []
    initial = Configuration(queues=(10, 10, 10), summaries=ALL_RAW)
    r = rig(Mmcf(LEVELS, weights=WEIGHTS, ranges=Ranges(), initial=initial), summaries=items)
    cloud, thin = r.robot.publish("/other/points", spec(BULK)), r.robot.publish("/robot/thin", spec(BULK))
    summary = SummaryLevel.SUMMARY
    item = Thinned(r.robot, cloud, thin, level=summary, level_by_rule=summary)
    items.append(item)
    r.world.network.after(
        0.05, lambda _now: r.world.network.every(0.2, lambda now: item.offer(TEXT, now), node=r.robot)
    )
    r.world.run(8.0)
    assert item.changes == [] and len(r.site.on("/robot/thin")) > 10
    assert r.steps[-1].situation.levels == {}
    assert r.steps[-1].decision.chosen.summaries == ALL_RAW


def test_policies_that_choose_no_level_leave_them_alone() -> None:
    items: list[Thinned] = []
    r = rig(FixedPolicy(Configuration(), None), summaries=items)
    cloud, thin = r.robot.publish("/robot/points", spec(BULK)), r.robot.publish("/robot/thin", spec(BULK))
    summary = SummaryLevel.SUMMARY
    items.append(Thinned(r.robot, cloud, thin, level=summary, level_by_rule=summary))
    r.world.network.every(0.2, lambda now: items[0].offer(TEXT, now), node=r.robot)
    r.world.run(5.0)
    assert items[0].changes == []
    assert step_json(r.steps[-1])["chosen"]["summaries"] is None


def test_what_is_in_the_background_is_no_reason_to_thin_anything() -> None:
    """It fills whatever the others leave of the link; they are treated as if it were not there."""
    chosen = []
    for fills in (False, True):
        r = rig(model=LinkModel(rate_bps=4e6, delay_s=0.025))
        pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
        cloud = r.robot.publish("/robot/points", spec(BULK, lifespan_s=1.0))
        fetched = replace(spec(BULK, reliable=True, depth=1000, max_queue_bytes=2**30), background=True)
        kept = r.robot.publish("/robot/kept", fetched)
        r.feed(pose, 50.0, 120)
        r.feed(cloud, 5.0, 20_000)
        if fills:
            r.feed(kept, 20.0, 30_000)  # 4.8 Mbit/s
        r.world.run(20.0)
        last = r.steps[-1]
        chosen.append((last.decision.chosen, cloud.thinned))
        offered = {demand.priority: demand.rate_hz for demand in last.situation.classes}
        assert offered[BULK] == pytest.approx(5.0, rel=0.05)
        assert last.measurement is not None and not last.measurement.saturated
        assert bool(r.site.on("/robot/kept")) is fills
        r.world.validate()
    assert chosen[0] == chosen[1]
