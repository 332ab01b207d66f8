"""Scenes that hear each other's patches: what changed, what is merged, and that all agree whatever the link did."""

import struct
import zlib
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid
from sern_twin.world.patches import LAYERS, MOST_VERSION, BlockKey, encode
from sern_twin.world.scene import MOST_LEAP, MOST_WRITERS, Outcome, Scene

GRID = Grid(0.0, 0.0, 0.1, 100, 70)
LARGE = Grid(-20.0, -20.0, 0.1, 400, 400)
"""A site of 40 m."""


def square(east_m: float, north_m: float, side_m: float = 1.0) -> list[tuple[float, float]]:
    return [
        (east_m, north_m), (east_m + side_m, north_m), (east_m + side_m, north_m + side_m), (east_m, north_m + side_m),
    ]  # fmt: skip


def told(sender: Scene) -> list[bytes]:
    return [sender.encode_block(key) for key in sender.publish()]


def test_an_obstacle_of_a_metre_takes_a_few_bytes() -> None:
    """The design allows 8 kB; the whole scene of a site of 40 m has 160,000 cells."""
    twin, robot = Scene(LARGE, "operator"), Scene(LARGE, "robot1")
    twin.set_cells("twin_only", np.zeros(LARGE.shape, np.int8))
    whole = told(twin)
    assert len(whole) == LARGE.blocks
    sizes = []
    for step in range(16):
        assert twin.paint("twin_only", square(3.0 + step * 0.1, -7.0 + step * 0.1), 100) == 100
        patches = told(twin)
        sizes.append(sum(map(len, patches)))
        assert len(patches) <= 4
        assert {robot.apply(patch) for patch in patches} == {Outcome.TAKEN}
        twin.paint("twin_only", square(3.0 + step * 0.1, -7.0 + step * 0.1), 0)
        assert {robot.apply(patch) for patch in told(twin)} == {Outcome.TAKEN}
    assert max(sizes) < 300
    assert max(sizes) < sum(map(len, whole)) / 50


def test_a_cell_that_flickers_and_is_back_makes_no_patch() -> None:
    scene = Scene(GRID, "robot1")
    assert scene.publish() == ()
    scene.paint("live", square(1, 1), 100)
    first = scene.publish()
    assert first
    before = scene.version
    scene.paint("live", square(1, 1), 0)
    scene.paint("live", square(1, 1), 100)
    assert scene.publish() == ()
    assert scene.version == before
    scene.paint("live", square(1, 1), -1)
    assert scene.publish() == first, "what is unknown again is said"


def test_what_changed_since_is_asked_by_version() -> None:
    scene = Scene(GRID, "robot1")
    scene.paint("live", square(0.1, 0.1), 100)
    first = scene.publish()
    then = scene.version
    scene.paint("base", square(5.1, 5.1), 100)
    second = scene.publish()
    assert {*first} & {*second} == set()
    assert {*scene.changed(0)} == {*first, *second}
    assert {*scene.changed(then)} == {*second}
    assert scene.changed(scene.version) == ()


def test_a_polygon_has_the_cells_whose_middles_it_holds() -> None:
    scene = Scene(GRID, "operator")
    assert scene.paint("twin_only", [(1.0, 1.0), (2.0, 1.0), (1.0, 2.0)], 100) == 45
    cells = scene.cells("twin_only")
    centres = GRID.all_centres()
    inside = (centres > 1.0).all(axis=2) & (centres.sum(axis=2) < 3.0 - 1e-9)
    assert ((cells == 100) == inside).all()
    assert scene.paint("twin_only", square(-50, -50), 100) == 0
    assert scene.paint("twin_only", square(-50, -50, 100), 7) == GRID.rows * GRID.columns
    assert (scene.cells("twin_only") == 7).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_polygon_may_cross_itself(seed: int) -> None:
    """By the even-odd rule, which is written out here for each cell."""
    random = Random(seed)
    corners = [(random.uniform(-2, 12), random.uniform(-2, 9)) for _ in range(random.randint(3, 12))]
    scene = Scene(GRID, "operator")
    count = scene.paint("twin_only", corners, 100)
    wanted = np.zeros(GRID.shape, np.bool_)
    for row, column in np.ndindex(GRID.shape):
        east, north = GRID.centres(row, column).tolist()
        for (x, y), (to_x, to_y) in zip(corners, corners[1:] + corners[:1], strict=True):
            if (y <= north) != (to_y <= north) and east < x + (north - y) / (to_y - y) * (to_x - x):
                wanted[row, column] ^= True
    assert ((scene.cells("twin_only") == 100) == wanted).all()
    assert count == np.count_nonzero(wanted) > 0


def test_the_newest_writer_is_believed_and_unknown_says_nothing() -> None:
    robot, other = Scene(GRID, "robot1"), Scene(GRID, "robot2")
    robot.paint("live", square(1, 1), 100)
    first = told(robot)
    for patch in first:
        other.apply(patch)
    other.paint("live", square(1.5, 1), 0)
    for patch in told(other):
        robot.apply(patch)
    for scene in (robot, other):
        merged = scene.merged("live")
        assert (merged[10:20, 10:15] == 100).all(), "of this robot2 said nothing"
        assert (merged[10:20, 15:25] == 0).all()
        assert (merged[:10] == -1).all()
    assert (robot.cells("live")[10:20, 10:20] == 100).all(), "robot1's own cells are its own"
    robot.forget("robot2")
    assert (robot.merged("live")[10:20, 10:20] == 100).all()
    assert (robot.merged("live")[:, 20:] == -1).all()
    robot.forget("nobody")
    with pytest.raises(UsageError, match="that of robot1"):
        robot.forget("robot1")


def test_writers_of_one_version_are_ordered_by_name_not_by_arrival() -> None:
    first, second = Scene(GRID, "a"), Scene(GRID, "b")
    first.paint("live", square(1, 1), 20)
    second.paint("live", square(1, 1), 30)
    patches = told(first) + told(second)
    one, two = Scene(GRID, "x"), Scene(GRID, "y")
    for patch in patches:
        one.apply(patch)
    for patch in reversed(patches):
        two.apply(patch)
    assert (one.merged("live") == two.merged("live")).all()
    assert one.merged("live")[15, 15] == 30


@pytest.mark.parametrize("seed", range(8))
def test_scenes_agree_after_loss_doubles_and_reordering(seed: int) -> None:
    """Each loses 5 % of the patches and gets a tenth twice, in any order; then the missing blocks are sent again."""
    random = Random(seed)
    scenes = [Scene(GRID, name) for name in ("robot1", "robot2", "operator")]
    waiting: list[tuple[Scene, bytes]] = []
    lost = 0
    for _step in range(40):
        for scene in scenes:
            layer = random.choice(LAYERS)
            east_m, north_m = random.uniform(-1, 10), random.uniform(-1, 7)
            scene.paint(layer, square(east_m, north_m, random.uniform(0.1, 2)), random.choice([-1, 0, 50, 100]))
            for patch in told(scene):
                for reader in scenes:
                    if reader is scene:
                        continue
                    copies = 0 if random.random() < 0.05 else 2 if random.random() < 0.1 else 1
                    lost += copies == 0
                    waiting += [(reader, patch)] * copies
        random.shuffle(waiting)
        while len(waiting) > 30:
            reader, patch = waiting.pop()
            assert reader.apply(patch) in (Outcome.TAKEN, Outcome.OLD)
    for reader, patch in waiting:
        assert reader.apply(patch) in (Outcome.TAKEN, Outcome.OLD)
    assert lost > 0
    assert len({tuple(map(scene.digest, LAYERS)) for scene in scenes}) > 1, "something was missed for good"

    for reader in scenes:
        for other in scenes:
            for key in other.missing(reader.versions()):
                assert reader.apply(other.encode_block(key)) is Outcome.TAKEN
    for layer in LAYERS:
        assert len({scene.digest(layer) for scene in scenes}) == 1
        assert len({scene.merged(layer).tobytes() for scene in scenes}) == 1
    assert all(scene.counts[Outcome.OLD] > 0 for scene in scenes), "doubles and late ones came"
    assert all(scenes[0].missing(scene.versions()) == () for scene in scenes)


def test_a_writer_that_begins_anew_is_heard() -> None:
    before, reader = Scene(GRID, "robot1", first_version=1000), Scene(GRID, "site")
    before.paint("live", square(1, 1), 100)
    for patch in told(before):
        reader.apply(patch)
    later = Scene(GRID, "robot1", first_version=5000)
    later.paint("live", square(1, 1), 50)
    assert {reader.apply(patch) for patch in told(later)} == {Outcome.TAKEN}
    assert reader.merged("live")[15, 15] == 50


def test_a_writer_without_a_clock_learns_what_it_said_before() -> None:
    before, reader = Scene(GRID, "robot1"), Scene(GRID, "site")
    for value in (100, 80, 60):
        before.paint("live", square(1, 1), value)
        for patch in told(before):
            reader.apply(patch)
    later = Scene(GRID, "robot1")
    later.paint("live", square(1, 1), 50)
    assert {reader.apply(patch) for patch in told(later)} == {Outcome.OLD}
    for key in reader.missing(later.versions()):
        assert later.apply(reader.encode_block(key)) is Outcome.OWN
    assert {reader.apply(patch) for patch in told(later)} == {Outcome.TAKEN}
    assert reader.merged("live")[15, 15] == 50
    assert reader.digest("live") == later.digest("live")


def test_a_patch_for_another_grid_does_nothing() -> None:
    sender, reader = Scene(Grid(0.0, 0.0, 0.1, 100, 71), "robot1"), Scene(GRID, "site")
    sender.paint("live", square(1, 1), 100)
    assert {reader.apply(patch) for patch in told(sender)} == {Outcome.OTHER_GRID}
    assert reader.versions() == {}
    assert (reader.merged("live") == -1).all()


def test_a_version_far_above_all_others_is_refused() -> None:
    reader = Scene(GRID, "site", first_version=10)
    cells = np.zeros((16, 16), np.int8)
    key = BlockKey("liar", "live", 0)
    assert reader.apply(encode(GRID, key, 11 + MOST_LEAP, cells)) is Outcome.LEAP
    assert reader.apply(encode(GRID, key, MOST_VERSION, cells)) is Outcome.LEAP
    assert reader.apply(encode(GRID, key, 10 + MOST_LEAP, cells)) is Outcome.TAKEN
    reader.paint("live", square(0, 0), 100)
    assert reader.publish()
    assert reader.merged("live")[5, 5] == 100


def test_a_scene_without_versions_says_so() -> None:
    scene = Scene(GRID, "site", first_version=MOST_VERSION - 1)
    scene.paint("live", square(1, 1), 100)
    assert scene.publish()
    scene.paint("live", square(1, 1), 0)
    with pytest.raises(UsageError, match="no versions left"):
        scene.publish()


def test_many_names_take_no_memory() -> None:
    reader = Scene(GRID, "site")
    cells = np.zeros((16, 16), np.int8)
    outcomes = [reader.apply(encode(GRID, BlockKey(f"w{one}", "live", 0), 1, cells)) for one in range(100)]
    assert outcomes.count(Outcome.TAKEN) == MOST_WRITERS - 1
    assert outcomes.count(Outcome.TOO_MANY_WRITERS) == 101 - MOST_WRITERS
    assert reader.apply(encode(GRID, BlockKey("w0", "base", 0), 1, cells)) is Outcome.TAKEN, "one that is known"
    reader.forget("w0")
    assert reader.apply(encode(GRID, BlockKey("w99", "live", 0), 1, cells)) is Outcome.TAKEN


@given(st.lists(st.binary(max_size=120), max_size=8), st.integers(0, 10**6), st.integers(0, 255))
def test_no_bytes_do_harm(junk: list[bytes], place: int, value: int) -> None:
    reader = Scene(GRID, "site")
    good = bytearray(encode(GRID, BlockKey("robot1", "live", 3), 1, np.full((16, 16), 50, np.int8)))
    good[place % len(good)] = value
    for data in [*junk, bytes(good)]:
        outcome = reader.apply(data)
        assert outcome in (Outcome.TAKEN, Outcome.CORRUPT)
        assert (outcome is Outcome.TAKEN) == (reader.versions() != {})
    assert sum(reader.counts.values()) == len(junk) + 1


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=6), st.binary(max_size=40))
def test_no_lie_under_a_right_checksum_does_harm(changes: list[tuple[int, int]], more: bytes) -> None:
    reader = Scene(GRID, "site")
    patch = bytearray(encode(GRID, BlockKey("robot1", "live", 3), 5, np.full((16, 16), 50, np.int8))[:-4] + more)
    for place, value in changes:
        patch[place % len(patch)] = value
    outcome = reader.apply(bytes(patch) + struct.pack("<I", zlib.crc32(patch)))
    assert (outcome in (Outcome.TAKEN, Outcome.OWN)) == (reader.version > 0)
    for layer in LAYERS:
        merged = reader.merged(layer)
        assert merged.min() >= -1 and merged.max() <= 100
    reader.paint("live", square(0, 0, 5), 100)
    reader.publish()
    assert reader.merged("live")[0, 0] == 100, "what the liar says is not above what comes later"


def test_misuse_is_refused() -> None:
    scene = Scene(GRID, "site")
    zeros = np.zeros((4, 4), np.int8)
    with pytest.raises(UsageError, match="no layer 'sky'"):
        scene.set_cells("sky", zeros)
    with pytest.raises(UsageError, match="do not fit"):
        scene.set_cells("live", zeros, row=67)
    with pytest.raises(UsageError, match="do not fit"):
        scene.set_cells("live", zeros, column=-1)
    with pytest.raises(UsageError, match="from 0 to 101"):
        scene.set_cells("live", np.array([[0, 101]], np.int8))
    with pytest.raises(UsageError, match="1 dimensions"):
        scene.set_cells("live", zeros[0])
    for polygon in ([(0, 0), (1, 1)], [(0, 0, 0)] * 3, [(0, 0)] * 2000):
        with pytest.raises(UsageError, match="give 3 to 1000 corners"):
            scene.paint("live", polygon, 0)
    for corner in (np.nan, np.inf, 1e308):
        with pytest.raises(UsageError, match="give metres"):
            scene.paint("live", [(0, 0), (1, 1), (corner, 0)], 0)
    with pytest.raises(UsageError, match="a value of 101"):
        scene.paint("live", square(0, 0), 101)
    with pytest.raises(UsageError, match="nothing was published of block 0 of live by site"):
        scene.encode_block(BlockKey("site", "live", 0))
    for method in (scene.merged, scene.digest, scene.cells):
        with pytest.raises(UsageError, match="no layer 'sky'"):
            method("sky")
    with pytest.raises(UsageError, match="a writer's name of 0 bytes"):
        Scene(GRID, "")
    with pytest.raises(UsageError, match="the first version is -1"):
        Scene(GRID, "site", first_version=-1)
