"""A small flat world: walls as line segments, pillars as circles. What the simulated robot's sensors look at.

Frame: x east, y north, metres. Pure: the same `Random` gives the same world.
"""

import math
from dataclasses import dataclass
from random import Random

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Hit:
    """Rays that were cast: `range_m` (n,), inf where nothing was hit, and the `height_m` (n,) of what was hit."""

    range_m: Floats
    height_m: Floats


class World:
    """`walls` (n, 5): x0, y0, x1, y1, height; `pillars` (m, 4): x, y, radius, height; all metres."""

    def __init__(self, walls: Floats, pillars: Floats, half_size_m: float) -> None:
        self.walls = np.asarray(walls, dtype=np.float64).reshape(-1, 5)
        self.pillars = np.asarray(pillars, dtype=np.float64).reshape(-1, 4)
        self.half_size_m = half_size_m
        self._known_m = 0.0, 0.0, -math.inf
        """A place, and the clearance there: that of places near it is not much less."""

    @classmethod
    def yard(cls, random: Random, *, half_size_m: float = 10.0, boxes: int = 8, pillars: int = 8) -> "World":
        """A walled yard with boxes and pillars; a disc of 4.5 m around the origin stays free for driving."""
        size = half_size_m
        corners = [(-size, -size), (size, -size), (size, size), (-size, size)]
        walls = [(*corners[i], *corners[(i + 1) % 4], 3.0) for i in range(4)]

        def place() -> tuple[float, float]:
            while True:
                x, y = random.uniform(-size + 1, size - 1), random.uniform(-size + 1, size - 1)
                if math.hypot(x, y) > 6.0:
                    return x, y

        for _ in range(boxes):
            x, y = place()
            half, height = random.uniform(0.3, 0.9), random.uniform(0.5, 2.5)
            box = [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
            walls += [(*box[i], *box[(i + 1) % 4], height) for i in range(4)]
        posts = [(*place(), random.uniform(0.1, 0.3), random.uniform(1.0, 3.0)) for _ in range(pillars)]
        return cls(np.array(walls), np.array(posts), half_size_m)

    def cast(self, x_m: float, y_m: float, bearings_rad: Floats) -> Hit:
        """Horizontal rays from one point; `bearings_rad` (n,) in the world frame."""
        count = len(bearings_rad)
        range_m, height_m = np.full(count, np.inf), np.zeros(count)
        dx, dy = np.cos(bearings_rad)[:, None], np.sin(bearings_rad)[:, None]
        for distance, heights in (self._to_walls(x_m, y_m, dx, dy), self._to_pillars(x_m, y_m, dx, dy)):
            if distance.shape[1] == 0:
                continue
            nearest = np.argmin(distance, axis=1)
            found = distance[np.arange(count), nearest]
            closer = found < range_m
            range_m[closer] = found[closer]
            height_m[closer] = heights[nearest[closer]]
        return Hit(range_m, height_m)

    def _to_walls(self, x: float, y: float, dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        """Ray p + t d against segment a + u (b - a): distances (rays, walls)."""
        ax, ay = self.walls[:, 0] - x, self.walls[:, 1] - y
        ex, ey = self.walls[:, 2] - self.walls[:, 0], self.walls[:, 3] - self.walls[:, 1]
        cross = dx * ey - dy * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (ax * ey - ay * ex) / cross
            u = (ax * dy - ay * dx) / cross
        return np.where((np.abs(cross) > 1e-12) & (t > 0) & (u >= 0) & (u <= 1), t, np.inf), self.walls[:, 4]

    def _to_pillars(self, x: float, y: float, dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        """Nearer root of |p + t d - c| = r: distances (rays, pillars)."""
        cx, cy, radius = self.pillars[:, 0] - x, self.pillars[:, 1] - y, self.pillars[:, 2]
        along = cx * dx + cy * dy
        inside = radius**2 - (cx**2 + cy**2 - along**2)
        t = along - np.sqrt(np.maximum(inside, 0.0))
        return np.where((inside > 0) & (t > 0), t, np.inf), self.pillars[:, 3]

    def clearance_m(self, x_m: float, y_m: float) -> float:
        """Distance from a point to the nearest obstacle; negative inside a pillar."""
        best = math.inf
        if len(self.walls):
            ax, ay = self.walls[:, 0], self.walls[:, 1]
            ex, ey = self.walls[:, 2] - ax, self.walls[:, 3] - ay
            u = np.clip(((x_m - ax) * ex + (y_m - ay) * ey) / (ex**2 + ey**2), 0.0, 1.0)
            best = float(np.min(np.hypot(ax + u * ex - x_m, ay + u * ey - y_m)))
        if len(self.pillars):
            centres = np.hypot(self.pillars[:, 0] - x_m, self.pillars[:, 1] - y_m)
            best = min(best, float(np.min(centres - self.pillars[:, 2])))
        return best

    def touches(self, x_m: float, y_m: float, radius_m: float) -> bool:
        """Whether a disc around a point meets an obstacle. It is quick for discs that move in small steps."""
        at_x_m, at_y_m, clearance_m = self._known_m
        if clearance_m - math.hypot(x_m - at_x_m, y_m - at_y_m) >= radius_m:
            return False
        clearance_m = self.clearance_m(x_m, y_m)
        self._known_m = x_m, y_m, clearance_m
        return clearance_m < radius_m

    def occupancy(self, cells: int) -> NDArray[np.int8]:
        """(cells, cells) grid over the whole world, row 0 at the south: 100 occupied, 0 free."""
        grid = np.zeros((cells, cells), dtype=np.int8)
        resolution_m = 2 * self.half_size_m / cells

        def mark(x: Floats, y: Floats) -> None:
            column = np.clip(((x + self.half_size_m) / resolution_m).astype(int), 0, cells - 1)
            row = np.clip(((y + self.half_size_m) / resolution_m).astype(int), 0, cells - 1)
            grid[row, column] = 100

        for x0, y0, x1, y1, _ in self.walls:
            steps = np.linspace(0.0, 1.0, 2 + int(2 * math.hypot(x1 - x0, y1 - y0) / resolution_m))
            mark(x0 + steps * (x1 - x0), y0 + steps * (y1 - y0))
        angles = np.linspace(0.0, 2 * math.pi, 64)
        for x, y, radius, _ in self.pillars:
            for part in (0.0, 0.5, 1.0):
                mark(x + part * radius * np.cos(angles), y + part * radius * np.sin(angles))
        return grid
