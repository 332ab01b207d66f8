"""A robot that touches something gets away from it: the costs that it goes by then."""

from dataclasses import replace

import numpy as np

from sern_navigation.costmap.costs import (
    INSCRIBED_INFLATED_OBSTACLE,
    LETHAL_OBSTACLE,
    MAX_NON_OBSTACLE,
    Costmap,
)
from sern_navigation.costmap.inflation import squared_cells
from sern_twin.world.grid import NOWHERE
from sern_twin.world.occupancy import Pose


def escaping(costmap: Costmap, pose: Pose) -> Costmap:
    """The same costs, if the robot touches nothing where it is. Else cells where it would touch something too are not
    blocked if they are no nearer to what is lethal than it is now: so it never gets any nearer.
    """
    here = int(costmap.grid.flat(np.array(pose[:2])))
    if here == NOWHERE or costmap.costs.reshape(-1)[here] != INSCRIBED_INFLATED_OBSTACLE:
        return costmap
    squares = squared_cells(costmap.costs == LETHAL_OBSTACLE)
    if squares is None:  # what it touches lies beyond the window
        return costmap
    away = (costmap.costs == INSCRIBED_INFLATED_OBSTACLE) & (squares >= squares.reshape(-1)[here])
    return replace(costmap, costs=np.where(away, np.uint8(MAX_NON_OBSTACLE), costmap.costs))
