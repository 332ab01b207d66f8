"""The adaptation's benchmark: its model of the link is deterministic, can be cloned, and loses no message."""

import pytest

from benchmarks.mmcf import settled_s
from benchmarks.mmcf_queue import Path, Queues, arrivals
from benchmarks.mmcf_replay import reconfigure
from benchmarks.mmcf_run import Interval, Observer, Run, controlled, fixed, oracle, run, start
from benchmarks.mmcf_traces import CODECS, GRID, Trace, robot, traces
from sern_core.adaptation.cost import Ranges, profile
from sern_core.adaptation.model import Configuration, Measurement, Terms
from sern_core.adaptation.playback import CapacityPath
from sern_core.adaptation.policy import Mmcf, fixed_reliability, fixed_throughput
from sern_core.adaptation.predict import Predictor

RANGES = Ranges()
WEIGHTS = profile("teleoperation")
SHORT = Trace("short", robot(), Path(((0.0, 4e6), (5.0, 0.6e6))), 12.0)


def queues(path: Path = SHORT.path) -> Queues:
    return Queues(robot(), path, arrivals(robot(), 12.0, 1), seed=1)


def told(model: Queues) -> list[object]:
    return [*model.outcomes(), model.cpu_s, model.idle_s, model.packets]


def test_the_model_is_deterministic_and_a_clone_leaves_it_alone() -> None:
    one, two = queues(), queues()
    for model in (one, two):
        model.apply(Configuration(queues=(1, 1, 3), codec="zstd"))
        model.run(3.0)
    assert told(one) == told(two)
    copy = one.clone()
    copy.apply(Configuration(rates=(1.0, 0.5, 0.1), codec="none", redundancy=1))
    copy.run(6.0)
    before = told(one)
    assert told(one) == before
    one.run(6.0)
    two.run(6.0)
    assert told(one) == told(two) != told(copy)


def test_on_an_idle_link_everything_arrives_in_time() -> None:
    model = queues(Path(((0.0, 1e9),)))
    model.run(5.0)
    for outcome in model.outcomes():
        assert outcome.offered > 0
        assert outcome.offered - outcome.delivered <= 1  # one may be on its way
        assert outcome.on_time == outcome.delivered


def test_loss_hits_what_cannot_be_repaired_and_copies_help() -> None:
    path = Path(((0.0, 8e6),), loss=lambda _t: 0.2, rtt_s=lambda _t: 0.2)
    shares = []
    for redundancy in (0, 1):
        model = queues(path)
        model.apply(Configuration(queues=(1, 1, 1), codec="draco", redundancy=redundancy))
        model.run(8.0)
        control = model.outcomes()[0]
        shares.append(control.delivered / control.offered)
    assert shares[0] < 0.87 and shares[1] > 0.93


def cost(policy: str) -> Run:
    choose = {
        "throughput": fixed(fixed_throughput(CODECS)),
        "reliability": fixed(fixed_reliability(CODECS)),
        "mmcf": controlled(Mmcf(GRID, weights=WEIGHTS, ranges=RANGES), SHORT, seed=1),
        "oracle": oracle(GRID.configurations[::4], ranges=RANGES, weights=WEIGHTS),
    }[policy]
    return run(SHORT, policy, choose, seed=1, ranges=RANGES, weights=WEIGHTS)


def test_mmcf_costs_less_than_the_papers_fixed_policies() -> None:
    mmcf = cost("mmcf")
    assert mmcf.cost < cost("throughput").cost < cost("reliability").cost
    assert cost("oracle").cost < 1.1 * mmcf.cost
    assert mmcf.switches_per_minute <= 20


def test_what_was_played_is_what_the_model_does_on_a_wave() -> None:
    """Costs of fixed configurations over a minute of a wave, as the predictor plays them, and as they came."""
    trace = next(trace for trace in traces(1) if trace.name == "wave")
    predictor = Predictor(GRID, weights=WEIGHTS, ranges=RANGES)
    path = CapacityPath.of(9.0, [trace.path.rate_bps(0.1 * tenth) for tenth in range(90)], 9)
    observer = Observer(trace, seed=1)
    model = start(trace, 1)
    model.run(1.0)
    found = predictor.predict(observer.situation(model), None, path)
    for share in (0.1, 0.25, 0.4, 1.0):
        configuration = Configuration((1.0, 1.0, share), (1, 1, 1), "draco")
        came = run(trace, "fixed", fixed(configuration), seed=1, ranges=RANGES, weights=WEIGHTS).cost
        # Bandwidth is foreseen as a share of the mean capacity and comes as the mean of the intervals' shares.
        assert abs(float(found.cost[GRID.index[configuration]]) / came - 1.0) < 0.2


def test_what_a_link_could_carry_is_the_mean_over_its_steps() -> None:
    path = Path(((0.0, 4e6), (2.0, 1e6), (5.0, 0.0)))
    assert path.mean_rate_bps(0.0, 2.0) == 4e6
    assert path.mean_rate_bps(1.0, 3.0) == pytest.approx(2.5e6)
    assert path.mean_rate_bps(-1.0, 1.0) == 4e6, "nothing was before the beginning"
    assert path.mean_rate_bps(6.0, 7.0) == 0.0


def delivered(*levels_mbps: float) -> Run:
    """A run with so much traffic, second by second."""
    terms = Terms(0.0, 0.0, 0.0, 0.0)
    intervals = [
        Interval(t, Configuration(), switched=False, cost=0.0, terms=terms, measurement=measured)
        for t, level in enumerate(levels_mbps)
        for measured in [Measurement(0.0, 0.0, 0.0, 1e6 * level, saturated=False)]
    ]
    return Run("stepped", "mmcf", intervals)


@pytest.mark.parametrize(
    ("levels_mbps", "down_s", "up_s"),
    [
        ([4.0] * 10 + [1.0] * 10 + [4.0] * 10, 0.0, 0.0),
        ([4.0] * 10 + [3.0, 2.0] + [1.0] * 8 + [1.0] * 4 + [4.0] * 6, 2.0, 4.0),
        ([2.0] * 30, 10.0, 10.0),
        ([4.0] * 10 + [1.0] * 20, 0.0, 10.0),
    ],
    ids=["at once", "after a while", "never moved", "stayed down"],
)
def test_settled_is_when_delivered_traffic_is_near_its_final_level(
    levels_mbps: list[float], down_s: float, up_s: float
) -> None:
    trace = Trace("stepped", robot(), Path(((0.0, 4e6),)), 30.0, ((10.0, False), (20.0, True)))
    result = delivered(*levels_mbps)
    assert settled_s(result, trace, rises=False) == down_s
    assert settled_s(result, trace, rises=True) == up_s


def test_a_robot_that_appears_is_taken_in_within_an_interval_and_disturbs_nobody() -> None:
    found = reconfigure()
    assert found.first_s < 1.0
    assert found.known_s <= 1.0 and found.gone_s <= 1.0
    assert found.gap_s < 0.15
