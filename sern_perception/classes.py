"""What a point may belong to. The numbers are those of the stand-in's labels (`sern_sim.terrain.Label`)."""

from enum import IntEnum
from typing import Final


class PointClass(IntEnum):
    NOTHING = 0
    """No return; no class that is learned."""
    GROUND = 1
    CAR = 2
    BRIDGE = 3
    LOG = 4
    OTHER = 5
    """Walls, crates and all else that stands on the ground."""


CLASSES: Final = tuple(each.name.lower() for each in PointClass)
OBSTACLES: Final = (PointClass.CAR, PointClass.LOG, PointClass.OTHER)
"""What a robot does not drive through; a bridge it drives on."""
