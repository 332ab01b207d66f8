"""Second copies of class control: they rest where they make a queue, and only there."""

from sern_core.path.copies import FIRST_REST_S, LONGEST_REST_S, CopyRest
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec


def sent(rest: CopyRest, copies: int, others: int) -> None:
    for _ in range(copies):
        rest.sent(copy=True)
    for _ in range(others):
        rest.sent(copy=False)


def test_copies_that_are_few_go_on_whatever_queues() -> None:
    rest = CopyRest()
    for _ in range(20):
        sent(rest, 1, 19)
    assert all(rest.may(now, queues=True) for now in range(10))


def test_copies_that_are_many_go_on_while_nothing_queues() -> None:
    rest = CopyRest()
    for _ in range(100):
        sent(rest, 1, 1)
    assert all(rest.may(now, queues=False) for now in range(10))


def test_where_they_make_a_queue_they_rest_longer_each_time_and_begin_anew_after_a_long_good_time() -> None:
    rest = CopyRest()
    now, rests = 0.0, []
    for _ in range(8):
        for _ in range(100):
            sent(rest, 1, 1)
        assert not rest.may(now, queues=True)
        began_s = now
        while not rest.may(now, queues=False):
            now += 0.5
        rests.append(now - began_s)
    assert rests == [min(FIRST_REST_S * 2**number, LONGEST_REST_S) for number in range(8)]
    now += 5 * LONGEST_REST_S
    assert not rest.may(now, queues=True)
    assert rest.may(now + FIRST_REST_S, queues=False)
    rest.restart()
    assert rest.may(now, queues=True)


def test_poses_of_half_a_lossy_link_do_not_wait_for_their_copies() -> None:
    """256 kbit/s: 134 of poses, and 45 of something else. With copies of all poses it would be 310."""
    world = World(lossless=False)
    link = LinkModel(rate_bps=256_000.0, delay_s=0.05, loss=0.05)
    robot, site = world.client("robot", link), world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    other = robot.publish("/robot/other", spec(PriorityClass.STATE, reliable=True, lifespan_s=None))
    robot.every(0.05, pose, bytes(724))
    robot.every(0.1, other, bytes(450))
    world.run(40.0)
    since = len(site.on("/robot/pose"))
    world.run(30.0)
    ages_s = sorted(got.age_s for got in site.on("/robot/pose")[since:])
    assert ages_s[len(ages_s) // 2] < 0.09
    assert len(ages_s) > 0.92 * 600
    world.check_faults()
