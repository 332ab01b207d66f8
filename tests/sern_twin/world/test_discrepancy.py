"""Where the twin and what a robot sees do not agree."""

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.discrepancy import MOST, RANGE_M, RIM_M, Discrepancies, Discrepancy, DiscrepancyKind
from sern_twin.world.grid import Grid
from sern_twin.world.patches import FREE, LASTING, OCCUPIED, UNKNOWN, Cells

GRID = Grid(0.0, 0.0, 0.1, 100, 80)
PHANTOM, UNKNOWN_OBSTACLE = DiscrepancyKind.PHANTOM, DiscrepancyKind.UNKNOWN_OBSTACLE


def twin(value: int = FREE, **boxes: tuple[slice, slice]) -> Cells:
    cells = np.full(GRID.shape, value, np.int8)
    for where in boxes.values():
        cells[where] = OCCUPIED
    return cells


def scans(world: Discrepancies, count: int, *occupied: tuple[slice, slice]) -> None:
    """Scans that see all of the world, and in which there is this."""
    ends = np.zeros(GRID.shape, np.bool_)
    for where in occupied:
        ends[where] = True
    for _ in range(count):
        world.saw(~ends, ends)


CAR = (slice(20, 30), slice(40, 60))


def test_what_the_twin_has_and_scans_see_through_is_a_phantom_after_three() -> None:
    world = Discrepancies(GRID)
    scans(world, 2)
    assert world.compare(twin(car=CAR), now_s=1.0) == ()
    assert world.unobserved(twin(car=CAR)).sum() == 200
    scans(world, 1)
    (found,) = world.compare(twin(car=CAR), now_s=2.0)
    assert (found.kind, found.cells, found.since_s, found.number) == (PHANTOM, 200, 2.0, 1)
    assert (found.east_m, found.north_m) == pytest.approx((5.0, 2.5))
    assert found.radius_m == pytest.approx(np.hypot(0.95, 0.45) + 0.05)
    assert np.array_equal(world.cells(PHANTOM), twin(car=CAR) == OCCUPIED)
    assert not world.unobserved(twin(car=CAR)).any()


def test_what_scans_see_and_the_twin_does_not_have_is_an_unknown_obstacle_after_three() -> None:
    world = Discrepancies(GRID)
    scans(world, 2, CAR)
    assert world.compare(twin(), now_s=1.0) == ()
    scans(world, 1, CAR)
    (found,) = world.compare(twin(), now_s=2.0)
    assert (found.kind, found.cells) == (UNKNOWN_OBSTACLE, 200)
    assert world.compare(twin(car=CAR), now_s=3.0) == (), "it was added to the twin"


def test_of_what_the_twin_knows_nothing_nothing_is_wrong() -> None:
    world = Discrepancies(GRID)
    scans(world, 5, CAR)
    assert world.compare(twin(UNKNOWN), now_s=1.0) == ()


def test_what_no_scan_saw_is_neither() -> None:
    world = Discrepancies(GRID)
    nothing = np.zeros(GRID.shape, np.bool_)
    for _ in range(5):
        world.saw(nothing, nothing)
    assert world.compare(twin(car=CAR), now_s=1.0) == ()
    assert world.unobserved(twin(car=CAR)).sum() == 200


def test_what_is_off_by_the_match_radius_is_the_same_thing() -> None:
    """A wall of the map, two cells from where it is seen; three are too many, unless the pose is so far off."""
    two, three = (slice(22, 24), slice(0, 100)), (slice(23, 25), slice(0, 100))
    wall = twin(wall=(slice(20, 21), slice(0, 100)))
    world = Discrepancies(GRID)
    scans(world, 5, two)
    assert [each.kind for each in world.compare(wall, now_s=1.0)] == [UNKNOWN_OBSTACLE], "its far side is three off"
    assert np.unique(np.argwhere(world.cells(UNKNOWN_OBSTACLE))[:, 0]).tolist() == [23]
    assert world.compare(wall, now_s=1.0, pose_error_m=0.16) == ()
    scans(world, 5, three)
    assert {each.kind for each in world.compare(wall, now_s=2.0)} == {PHANTOM, UNKNOWN_OBSTACLE}
    assert world.compare(wall, now_s=2.0, pose_error_m=0.2) == ()


def test_the_far_side_of_a_thing_that_no_ray_reaches_is_no_phantom() -> None:
    world = Discrepancies(GRID)
    ends, free = np.zeros(GRID.shape, np.bool_), np.zeros(GRID.shape, np.bool_)
    ends[20, 40:60], free[:20] = True, True
    for _ in range(5):
        world.saw(free, ends)
    assert world.compare(twin(car=CAR), now_s=1.0) == ()


def test_a_number_stays_while_a_thing_does_and_is_not_used_again() -> None:
    world = Discrepancies(GRID)
    first, second = (slice(10, 14), slice(10, 14)), (slice(50, 54), slice(50, 56))
    scans(world, 3, first)
    assert [(each.number, each.since_s) for each in world.compare(twin(), now_s=1.0)] == [(1, 1.0)]
    scans(world, 3, first, second)
    now = {each.number: each for each in world.compare(twin(), now_s=2.0)}
    assert (now[1].since_s, now[2].since_s) == (1.0, 2.0) and now[2].cells == 24
    scans(world, 3, (slice(11, 15), slice(10, 14)))
    (left,) = world.compare(twin(), now_s=3.0)
    assert (left.number, left.since_s, left.cells) == (1, 1.0, 16), "it has moved by a cell"
    scans(world, 3)
    assert world.compare(twin(), now_s=4.0) == ()
    scans(world, 3, first)
    assert [(each.number, each.since_s) for each in world.compare(twin(), now_s=5.0)] == [(1, 1.0)], "it flickered"
    scans(world, 3)
    assert world.compare(twin(), now_s=6.0) == ()
    scans(world, 3, first)
    assert [(each.number, each.since_s) for each in world.compare(twin(), now_s=9.0)] == [(3, 9.0)]


def test_a_cell_changes_its_mind_with_three_of_the_last_five_scans() -> None:
    world = Discrepancies(GRID)
    scans(world, 50, CAR)
    scans(world, 2)
    assert len(world.compare(twin(), now_s=1.0)) == 1
    scans(world, 1)
    assert world.compare(twin(), now_s=2.0) == ()


def test_one_cell_alone_is_not_said_and_the_largest_are_where_there_are_many() -> None:
    world = Discrepancies(GRID)
    scans(world, 3, (slice(3, 4), slice(3, 4)))
    assert world.compare(twin(), now_s=1.0) == () and world.cells(UNKNOWN_OBSTACLE).sum() == 1
    many = [
        (slice(6 * row, 6 * row + 1), slice(6 * column, 6 * column + (3 if row == column == 7 else 2)))
        for row in range(10)
        for column in range(12)
    ]
    scans(world, 3, *many)
    found = world.compare(twin(), now_s=2.0)
    assert len(found) == MOST and world.left_out == 120 - MOST
    assert found[0].cells == 3 and len({each.number for each in found}) == MOST


def test_random_worlds_agree_with_a_slow_reading_of_the_rule() -> None:
    draw = np.random.default_rng(5)
    small = Grid(0.0, 0.0, 0.1, 24, 20)
    cells_of = [(row, column) for row in range(20) for column in range(24)]
    for _ in range(30):
        world = Discrepancies(small)
        said: dict[tuple[int, int], list[str]] = {cell: [] for cell in cells_of}
        state = dict.fromkeys(cells_of, "")
        for _scan in range(int(draw.integers(1, 12))):
            seen, ends = draw.random(small.shape) < 0.8, draw.random(small.shape) < 0.3
            world.saw(seen & ~ends, seen & ends)
            for cell in cells_of:
                said[cell].append(("end" if ends[cell] else "pass") if seen[cell] else "")
                last = said[cell][-5:]
                if last.count("end") >= 3:
                    state[cell] = "end"
                elif last.count("pass") >= 3:
                    state[cell] = "pass"
        cells = draw.choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), small.shape, p=[0.2, 0.7, 0.1])
        found: list[Discrepancy] = list(world.compare(cells, now_s=1.0))
        ended, passed = (
            np.array([[state[row, column] == what for column in range(24)] for row in range(20)])
            for what in ("end", "pass")
        )
        assert np.array_equal(world.occupied, ended) and np.array_equal(world.clear, passed)
        lately = np.array([["end" in said[row, column][-5:] for column in range(24)] for row in range(20)])
        for kind, mine, others in (
            (PHANTOM, (cells == OCCUPIED) & passed, ended | lately | ((cells == OCCUPIED) & ~passed)),
            (UNKNOWN_OBSTACLE, (cells == FREE) & ended, cells == OCCUPIED),
        ):
            places = np.argwhere(others)
            expected = np.array(
                [
                    [
                        bool(mine[row, column])
                        and not (len(places) and np.hypot(*(places - (row, column)).T).min() <= 2)
                        for column in range(24)
                    ]
                    for row in range(20)
                ]
            )
            assert np.array_equal(world.cells(kind), expected)
            assert sum(each.cells for each in found if each.kind is kind) <= expected.sum()


def test_what_is_far_from_the_scanner_says_nothing_and_keeps_what_it_was() -> None:
    world = Discrepancies(GRID)
    here, there = (slice(20, 24), slice(2, 6)), (slice(20, 24), slice(94, 98))
    ends = np.zeros(GRID.shape, np.bool_)
    ends[here] = ends[there] = True
    for _ in range(3):
        world.saw(~ends, ends, (0.5, 2.0))
    assert [round(each.east_m, 1) for each in world.compare(twin(), now_s=1.0)] == [0.4], "9 m are too far"
    for _ in range(5):
        world.saw(np.ones(GRID.shape, np.bool_), np.zeros(GRID.shape, np.bool_), (9.5, 2.0))
    assert len(world.compare(twin(), now_s=2.0)) == 1, "the scanner has left"
    for place_m in ((-50.0, 2.0), (5.0, 70.0)):
        world.saw(~ends, ends, place_m)
    assert len(world.compare(twin(), now_s=3.0)) == 1


def test_the_face_of_a_wall_that_rays_graze_is_no_phantom() -> None:
    """They see through its outermost cells, and none of them ends there; what is behind them no ray reaches."""
    world = Discrepancies(GRID)
    free = np.zeros(GRID.shape, np.bool_)
    free[:21] = True
    for _ in range(20):
        world.saw(free, np.zeros(GRID.shape, np.bool_))
    assert world.compare(twin(wall=(slice(20, 24), slice(0, 100))), now_s=1.0) == ()
    fence = twin(fence=(slice(19, 20), slice(0, 100)))
    world.compare(fence, now_s=1.0)
    for _ in range(3):
        world.saw(free, np.zeros(GRID.shape, np.bool_))
    assert [each.kind for each in world.compare(fence, now_s=2.0)] == [PHANTOM], "a thin thing that they see through"


def test_what_only_the_scans_saw_that_were_off_is_nothing() -> None:
    """A cell behind a thin wall: one scan in five is off, and ends there; the others do not see it."""
    world = Discrepancies(GRID)
    wall, behind = np.zeros(GRID.shape, np.bool_), np.zeros(GRID.shape, np.bool_)
    wall[20], behind[24] = True, True
    free = np.zeros(GRID.shape, np.bool_)
    free[:20] = True
    for step in range(100):
        world.saw(free, behind if step % 5 == 0 else wall)
    assert world.compare(twin(wall=(slice(20, 21), slice(0, 100))), now_s=1.0) == ()


def test_a_thing_at_the_rim_of_what_is_compared_is_told_when_two_of_its_cells_are_within() -> None:
    """What is beyond is known to be clear by then, so that what is within is no edge of something that may be there."""
    world, car = Discrepancies(GRID), twin(car=(slice(20, 30), slice(85, 98)))
    free, nothing = np.ones(GRID.shape, np.bool_), np.zeros(GRID.shape, np.bool_)
    for _ in range(5):
        world.saw(free, nothing, (0.25, 2.5))
    assert world.compare(car, now_s=1.0) == (), "its next cells are 8.3 m away"
    for step in range(3):
        world.saw(free, nothing, (0.57, 2.5))
        found = world.compare(car, now_s=1.1 + 0.1 * step)
    assert [each.kind for each in found] == [PHANTOM] and found[0].east_m < 8.6
    assert RANGE_M < 8.5 <= RANGE_M + RIM_M


def test_scans_say_nothing_of_what_the_twin_has_since() -> None:
    """A robot has seen a place and left it; later somebody says that a car stands there."""
    world = Discrepancies(GRID)
    scans(world, 20)
    assert world.compare(twin(), now_s=1.0) == ()
    assert world.compare(twin(car=CAR), now_s=60.0) == () and world.unobserved(twin(car=CAR)).sum() == 200
    scans(world, 2)
    assert world.compare(twin(car=CAR), now_s=60.2) == ()
    scans(world, 1)
    assert [each.kind for each in world.compare(twin(car=CAR), now_s=60.3)] == [PHANTOM], "it was seen through since"


def test_a_phantom_stays_one_until_three_of_five_scans_end_there() -> None:
    world = Discrepancies(GRID)
    scans(world, 3)
    assert len(world.compare(twin(car=CAR), now_s=1.0)) == 1
    for step in range(20):
        scans(world, 2, CAR) if step % 4 == 0 else scans(world, 1)
        assert [each.cells for each in world.compare(twin(car=CAR), now_s=2.0)] == [200]
    scans(world, 3, CAR)
    assert world.compare(twin(car=CAR), now_s=3.0) == ()


def test_what_the_twin_is_to_have_is_what_scans_say_of_what_was_told() -> None:
    world, alone = Discrepancies(GRID), (slice(70, 71), slice(70, 71))
    new = (slice(50, 54), slice(10, 20))
    assert (world.correction() == UNKNOWN).all()
    scans(world, 3, new)
    world.compare(twin(car=CAR, alone=alone), now_s=1.0)
    expected = np.full(GRID.shape, UNKNOWN, np.int8)
    expected[CAR], expected[new] = FREE, OCCUPIED
    assert np.array_equal(world.correction(), expected), "a cell alone is not told"
    scans(world, 3, CAR)
    world.compare(twin(car=CAR, alone=alone), now_s=2.0)
    assert (world.correction() == UNKNOWN).all(), "the scans say otherwise"
    scans(world, 5)
    world.compare(twin(car=CAR), now_s=3.0)
    assert (world.correction()[CAR] == FREE).all()
    world.compare(twin(), now_s=4.0)
    assert (world.correction() == UNKNOWN).all(), "it was taken back"


def test_what_scans_cannot_see_is_no_phantom_and_makes_nothing_unknown() -> None:
    world, hole = Discrepancies(GRID), twin()
    hole[CAR] = LASTING
    scans(world, 5)
    assert world.compare(hole, now_s=1.0) == ()
    scans(world, 5, CAR)
    assert world.compare(hole, now_s=2.0) == () and (world.correction() == UNKNOWN).all()


def test_what_is_of_another_grid_is_refused() -> None:
    world = Discrepancies(GRID)
    with pytest.raises(UsageError):
        world.saw(np.zeros((3, 3), np.bool_), np.zeros((3, 3), np.bool_))
    with pytest.raises(UsageError):
        world.compare(np.zeros((3, 3), np.int8), now_s=0.0)
    for error_m in (-1.0, np.nan, np.inf):
        with pytest.raises(UsageError):
            world.compare(twin(), now_s=0.0, pose_error_m=error_m)
