"""Places to drive through: a wall with two narrow ways, buildings that are dead ends, cars and logs; and what the twin
knows of it, which may be wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

import numpy as np

from sern_navigation.costmap.layered import CostmapOptions, LayeredCostmap
from sern_navigation.global_plan import PlannerOptions, plan
from sern_sim.world import World
from sern_twin.world.grid import Grid
from sern_twin.world.patches import FREE, OCCUPIED, Cells

HALF_M: Final = 13.0
GRID: Final = Grid(-HALF_M - 0.4, -HALF_M - 0.4, 0.1, 268, 268)
WAY_M: Final = 1.3
"""How wide the two ways through the wall are: a robot of 0.66 m and its margins."""
BUILDING_M: Final = 3.0
CAR_M: Final = 1.4
LOG_M: Final = 0.25
"""Heights."""


class Thing(NamedTuple):
    """A box on the ground, by its sides [m] and its height [m]."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float
    height_m: float

    def walls(self) -> list[tuple[float, float, float, float, float]]:
        west_m, south_m, east_m, north_m, height_m = self
        return [
            (west_m, south_m, east_m, south_m, height_m),
            (east_m, south_m, east_m, north_m, height_m),
            (east_m, north_m, west_m, north_m, height_m),
            (west_m, north_m, west_m, south_m, height_m),
        ]

    def near(self, place_m: tuple[float, float], margin_m: float) -> bool:
        x_m, y_m = place_m
        return (
            self.west_m - margin_m < x_m < self.east_m + margin_m
            and self.south_m - margin_m < y_m < self.north_m + margin_m
        )


YARD: Final = (
    Thing(-HALF_M - 0.2, -HALF_M - 0.2, HALF_M + 0.2, -HALF_M, BUILDING_M),
    Thing(-HALF_M - 0.2, HALF_M, HALF_M + 0.2, HALF_M + 0.2, BUILDING_M),
    Thing(-HALF_M - 0.2, -HALF_M, -HALF_M, HALF_M, BUILDING_M),
    Thing(HALF_M, -HALF_M, HALF_M + 0.2, HALF_M, BUILDING_M),
)


@dataclass(frozen=True, slots=True)
class Campus:
    """`real`: what stands there. `phantoms`: what a twin may have that does not, best first. `order`: in which a twin
    that knows less forgets what is real. `shortest_m`: the way from start to goal for who knows everything."""

    start_m: tuple[float, float]
    goal_m: tuple[float, float]
    real: tuple[Thing, ...]
    phantoms: tuple[Thing, ...]
    order: tuple[int, ...]
    shortest_m: float

    def world(self) -> World:
        walls = [wall for thing in (*YARD, *self.real) for wall in thing.walls()]
        return World(np.array(walls), np.zeros((0, 4)), HALF_M + 1.0)

    def twin(self, accuracy: float) -> Cells:
        """The cells of a twin of which this share is right: it misses the other things, and has as many phantoms as
        makes up for them, all of `phantoms` at 0."""
        missing = round((1.0 - accuracy) * len(self.real))
        phantoms = round((1.0 - accuracy) * len(self.phantoms))
        known = [thing for number, thing in enumerate(self.real) if number not in self.order[:missing]]
        return cells_of((*YARD, *known, *self.phantoms[:phantoms]))


def cells_of(things: Sequence[Thing]) -> Cells:
    cells = np.full(GRID.shape, FREE, np.int8)
    places = GRID.all_centres()
    for thing in things:
        inside = (places[..., 0] > thing.west_m) & (places[..., 0] < thing.east_m)
        inside &= (places[..., 1] > thing.south_m) & (places[..., 1] < thing.north_m)
        cells[inside] = OCCUPIED
    return cells


def campus(seed: int) -> Campus:
    """The campus of a seed: drawn until a way leads from start to goal."""
    random = Random(seed)
    while True:
        found = _drawn(random)
        if found is not None:
            return found


def _drawn(random: Random) -> Campus | None:
    start_m = (-HALF_M + 1.5, random.uniform(-8.0, 8.0))
    goal_m = (HALF_M - 1.5, random.uniform(-8.0, 8.0))
    wall_m = random.uniform(-1.5, 1.5)
    ways_m = (random.uniform(-10.5, -3.0), random.uniform(3.0, 10.5))
    real: list[Thing] = []
    south_m = -HALF_M
    for way_m in ways_m:
        real.append(Thing(wall_m, south_m, wall_m + 0.6, way_m - WAY_M / 2, BUILDING_M))
        south_m = way_m + WAY_M / 2
    real.append(Thing(wall_m, south_m, wall_m + 0.6, HALF_M, BUILDING_M))
    parked = random.random() < 0.5
    blocked = random.choice(ways_m)
    if parked:  # in one of the ways stands a car
        real.append(Thing(wall_m - 1.2, blocked - 0.9, wall_m + 1.8, blocked + 0.9, CAR_M))
    for middle_m, from_m in ((-HALF_M / 2 + wall_m / 2, start_m[1]), (HALF_M / 2 + wall_m / 2, goal_m[1])):
        real += _dead_end(random, middle_m, from_m + random.uniform(-1.0, 1.0))
    for _ in range(random.randint(3, 6)):
        real.append(_scattered(random))
    free = [way_m for way_m in ways_m if not (parked and way_m == blocked)]
    phantoms = [Thing(wall_m - 0.3, way_m - 0.6, wall_m + 0.9, way_m + 0.6, LOG_M) for way_m in free]
    phantoms += [_scattered(random) for _ in range(4)]
    if any(thing.near(place, 0.8) for thing in (*real, *phantoms) for place in (start_m, goal_m)):
        return None
    costmap = LayeredCostmap(GRID, CostmapOptions())
    costmap.static.take(GRID, cells_of((*YARD, *real)))
    made = plan(costmap.everywhere(0.0), start_m, goal_m, PlannerOptions())
    if not made.found:
        return None
    shortest_m = float(np.hypot(*np.diff(made.path_m, axis=0).T).sum())
    order = list(range(len(real)))
    random.shuffle(order)
    return Campus(start_m, goal_m, tuple(real), tuple(phantoms), tuple(order), shortest_m)


def _dead_end(random: Random, x_m: float, y_m: float) -> list[Thing]:
    """A building in the shape of a U, open to the west."""
    half_m, deep_m = random.uniform(1.8, 2.6), random.uniform(2.2, 3.2)
    return [
        Thing(x_m - deep_m / 2, y_m + half_m, x_m + deep_m / 2, y_m + half_m + 0.4, BUILDING_M),
        Thing(x_m - deep_m / 2, y_m - half_m - 0.4, x_m + deep_m / 2, y_m - half_m, BUILDING_M),
        Thing(x_m + deep_m / 2, y_m - half_m - 0.4, x_m + deep_m / 2 + 0.4, y_m + half_m + 0.4, BUILDING_M),
    ]


def _scattered(random: Random) -> Thing:
    x_m, y_m = random.uniform(-HALF_M + 3, HALF_M - 3), random.uniform(-HALF_M + 1, HALF_M - 1)
    if random.random() < 0.5:
        return Thing(x_m - 1.0, y_m - 0.6, x_m + 1.0, y_m + 0.6, CAR_M)
    return Thing(x_m - 0.15, y_m - 0.9, x_m + 0.15, y_m + 0.9, LOG_M)
