"""When class 0 will want the link again, and how what leaves before is cut to end just then."""

import random

import pytest

from sern_core.path.period import AFTER_S, MAX_TOPICS, SETTLED, Cadence, Cadences
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec

PERIOD_S = 0.02
DATAGRAM_S = 0.0025


def fed(cadence: Cadence, times: list[float]) -> Cadence:
    for at_s in times:
        cadence.arrived(at_s)
    return cadence


def every(period_s: float, count: int, start_s: float = 10.0) -> list[float]:
    return [start_s + n * period_s for n in range(1, count + 1)]


def test_a_periodic_topic_is_foreseen() -> None:
    cadence = fed(Cadence(10.0), every(PERIOD_S, 2 * SETTLED))
    last_s = 10.0 + 2 * SETTLED * PERIOD_S
    assert cadence.due_after(last_s + 0.001) == pytest.approx(last_s + PERIOD_S)
    assert cadence.due_after(last_s + 1.5 * PERIOD_S) == pytest.approx(last_s + 2 * PERIOD_S)
    assert cadence.due_after(last_s + 10 * PERIOD_S) is None, "it has ended, for all one knows"


def test_nothing_is_foreseen_of_the_first_messages_or_of_a_topic_without_a_rhythm() -> None:
    assert fed(Cadence(10.0), every(PERIOD_S, SETTLED - 1)).due_after(10.1) is None
    chance = random.Random(1)
    at_s, times = 10.0, []
    for _ in range(200):
        at_s += chance.expovariate(1 / PERIOD_S)
        times.append(at_s)
    assert fed(Cadence(10.0), times).due_after(at_s) is None


def test_jitter_and_missing_messages_do_not_move_the_rhythm() -> None:
    chance = random.Random(2)
    times = [at_s + chance.uniform(-3e-4, 3e-4) for at_s in every(PERIOD_S, 200) if chance.random() > 0.1]
    due_s = fed(Cadence(10.0), times).due_after(14.001)
    assert due_s == pytest.approx(14.02, abs=4e-4)


def test_another_period_is_learned_anew() -> None:
    cadence = fed(Cadence(10.0), every(PERIOD_S, 50))
    fed(cadence, every(0.05, 3, start_s=11.0))
    assert cadence.due_after(11.151) is None
    fed(cadence, every(0.05, 20, start_s=11.15))
    assert cadence.due_after(12.151) == pytest.approx(12.2)


def test_what_leaves_before_a_message_ends_just_behind_it() -> None:
    cadences = Cadences()
    for at_s in every(PERIOD_S, 20):
        cadences.arrived(1, now=at_s)
    now = 10.0 + 20 * PERIOD_S + 0.0007
    due_s = 10.0 + 21 * PERIOD_S
    sent = 0
    while (share := cadences.share(now, DATAGRAM_S)) < 1.0:
        assert share > 0.8, "spread over all, so that none is small"
        now = cadences.hold(now + share * DATAGRAM_S, DATAGRAM_S)
        sent += 1
    assert sent == 8
    assert now == pytest.approx(due_s + AFTER_S)


def test_nothing_leaves_right_ahead_of_a_message() -> None:
    cadences = Cadences()
    for at_s in every(PERIOD_S, 20):
        cadences.arrived(1, now=at_s)
    due_s = 10.0 + 21 * PERIOD_S
    assert cadences.hold(due_s - 0.0002, DATAGRAM_S) == pytest.approx(due_s + AFTER_S)
    assert cadences.hold(due_s - 0.002, DATAGRAM_S) == due_s - 0.002
    cadences.forget(1)
    assert cadences.hold(due_s - 0.0002, DATAGRAM_S) == due_s - 0.0002


def test_a_topic_that_leaves_no_room_holds_nothing_back() -> None:
    cadences = Cadences()
    for at_s in every(PERIOD_S, 20):
        cadences.arrived(1, now=at_s)
    due_s = 10.0 + 21 * PERIOD_S
    assert cadences.hold(due_s - 0.0002, PERIOD_S) == due_s - 0.0002
    cadences.arrived(1, now=due_s)
    assert cadences.share(due_s + 0.001, PERIOD_S / 2) == 1.0


def test_topics_that_leave_no_room_together_hold_nothing_back() -> None:
    """Five at 50 Hz, 4 ms apart: what is sent between them would be cut to a datagram and a half."""

    def share(datagram_s: float) -> float:
        cadences = Cadences()
        for channel_id in range(5):
            for at_s in every(PERIOD_S, 20):
                cadences.arrived(channel_id, now=at_s + 0.004 * channel_id)
        return cadences.share(10.0 + 20 * PERIOD_S + 0.0167, datagram_s)

    assert share(DATAGRAM_S) == 1.0
    assert share(DATAGRAM_S / 2) < 1.0, "of a faster link"


def test_among_many_topics_there_is_no_gap() -> None:
    cadences = Cadences()
    for at_s in every(PERIOD_S, 20):
        for channel_id in range(MAX_TOPICS + 1):
            cadences.arrived(channel_id, now=at_s)
    assert cadences.share(10.0 + 20 * PERIOD_S + 0.0007, DATAGRAM_S) == 1.0


@pytest.mark.interpreted
def test_poses_meet_less_than_they_would_if_nothing_were_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    def mean_late_s() -> float:
        world = World()
        robot = world.client("robot", LinkModel(rate_bps=4e6, delay_s=0.025))
        site = world.client("site", patterns=["/robot/.*"])
        pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
        cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
        world.network.every(0.02, lambda now: robot.core.send(pose, b"p" * 100, 0, now=now), node=robot)
        world.network.every(0.1, lambda now: robot.core.send(cloud, b"c" * 100_000, 0, now=now), node=robot)
        world.run(8.0)
        ages = [got.age_s for got in site.got if got.topic == "/robot/pose"][100:]
        assert len(ages) > 200
        return sum(ages) / len(ages)

    cut_s = mean_late_s()
    monkeypatch.setattr(Cadences, "share", lambda _self, _now, _datagram_s: 1.0)
    monkeypatch.setattr(Cadences, "hold", lambda _self, at_s, _datagram_s: at_s)
    assert cut_s < mean_late_s() - 0.0004
