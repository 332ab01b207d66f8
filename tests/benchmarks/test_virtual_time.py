"""Minutes of the real core on a thin link in virtual time: all is accounted for, and an hour costs as much a minute."""

import pytest

from benchmarks.virtual_time import POSE_PERIOD_S, POSES, THIN, simulate
from sern_core.vocabulary.errors import SernError

SHORT_S = 100.0
LONG_S = 300.0


def test_minutes_are_simulated_whole_and_cost_alike() -> None:
    short, long = simulate(SHORT_S, clouds=False), simulate(LONG_S, clouds=False)
    for run, seconds in ((short, SHORT_S), (long, LONG_S)):
        run.check()
        run.world.validate()
        (pose,) = run.channels
        assert pose.counters.offered == seconds / POSE_PERIOD_S + 1
        assert run.world.network.elapsed_s >= seconds
        got = run.site.on(POSES)
        assert len(got) > 0.99 * pose.counters.offered, "the link loses 1 %, and copies make that good"
        assert min(item.age_s for item in got) > THIN.delay_s
    before = short.world.network.event_count / SHORT_S
    later = (long.world.network.event_count - short.world.network.event_count) / (LONG_S - SHORT_S)
    assert later < 1.2 * before, "events a virtual second do not grow with what came before"


def test_a_message_without_a_fate_is_told() -> None:
    run = simulate(2.0, clouds=True)
    run.check()
    pose, cloud = run.channels
    cloud.counters.offered += 1
    with pytest.raises(SernError, match=r"/robot/points: 1 of 4 messages are not accounted for"):
        run.check()
    cloud.counters.offered -= 1
    run.site.got.remove(run.site.on(POSES)[-1])
    told = rf"/robot/odom: \d+ arrived, {pose.counters.delivered} were delivered, of 0 more nobody knows"
    with pytest.raises(SernError, match=told):
        run.check()
