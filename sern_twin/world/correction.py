"""What becomes of the layers of a scene where the twin and the scans differ: the scans are right.

What is added lies over what is seen, and that over what the map says: people know of things that no scan shows yet. But
where the scans see through something that was added, or that the map has, it is cleared: the robot's live layer says
CLEARED there, and a patch carries it to all sites like anything else that is seen. Of two robots' blocks the newer one
counts, cell by cell, as always. What was added stays in its own layer, and is on the map again once its cells are no
longer cleared. LASTING is never cleared: a hole is seen by no planar scanner, nor is water.
"""

import numpy as np

from sern_twin.world.patches import CLEARED, FREE, LASTING, OCCUPIED, UNKNOWN, Cells


def corrected(seen: Cells, correction: Cells) -> Cells:
    """The live layer of a robot, (rows, columns): what its scans say (-1, 0, 100), and what they correct in the twin.

    `correction`: free where the twin has something that is not there, occupied where it lacks something, else unknown
    (`Discrepancies.correction`).
    """
    found = seen.copy()
    found[correction == FREE] = CLEARED
    found[correction == OCCUPIED] = OCCUPIED
    return found


def twin_cells(base: Cells, twin_only: Cells) -> Cells:
    """What the twin has by itself, (rows, columns): what is added over what the map says. LASTING stays what it is."""
    found: Cells = np.where(twin_only != UNKNOWN, twin_only, base)
    return found


def map_cells(base: Cells, live: Cells, twin_only: Cells) -> Cells:
    """The map of all layers, (rows, columns), in which nothing is LASTING or CLEARED any more."""
    found: Cells = np.where((live != UNKNOWN) & (base != LASTING), live, base)
    added = (twin_only != UNKNOWN) & ((live != CLEARED) | (twin_only == LASTING))
    found[added] = twin_only[added]
    found[found == CLEARED] = FREE
    found[found == LASTING] = OCCUPIED
    return found
