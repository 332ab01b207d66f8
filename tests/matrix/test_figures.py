"""What is written of the cells that were played."""

from tests.matrix.cells import CELLS, Cell, Fault, Lanes, Load
from tests.matrix.figures import Played, of, report
from tests.matrix.play import Play


def cell(profile: str, load: Load, fault: Fault) -> Cell:
    return Cell(profile, load, fault, Lanes.BOTH)


def test_cells_are_counted_by_profile_and_load_and_a_broken_one_shows() -> None:
    found = report(
        [
            Played(cell("lan", Load.IDLE, Fault.NONE), True, [0.3, 0.1]),
            Played(cell("lan", Load.IDLE, Fault.FLAP), False, [0.2]),
            Played(cell("lan", Load.TWICE, Fault.NONE), True, []),
        ]
    )
    assert [(row.case, row.system, dict(row.metrics)) for row in found.rows] == [
        ("lan", "idle", {"cells_count": 2, "kept_count": 1, "pose_p50_ms": 200.0, "pose_p99_ms": 300.0}),
        ("lan", "2x", {"cells_count": 1, "kept_count": 1}),
    ]
    assert [(reach.value, reach.limit, reach.ok) for reach in found.reaches] == [
        (3, len(CELLS), False),
        (2 / 3, 1.0, False),
    ]


def test_ages_are_those_of_the_poses_that_arrived() -> None:
    play = Play(cell("lan", Load.IDLE, Fault.NONE)).play()
    played = of(play)
    assert played.kept and played.cell == play.cell
    assert len(played.ages_s) == len(play.site.on("/robot/pose")) > 50
    assert min(played.ages_s) > play.path.up.delay_s, "nothing is faster than the link"
