"""What paired runs of modes say: success with its interval, and whether one is better than another."""

from collections.abc import Sequence
from math import sqrt
from typing import Final

Z_95: Final = 1.96


def wilson(met: int, of: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson, 1927), low and high."""
    if not of:
        return 0.0, 1.0
    share, square = met / of, Z_95**2
    middle = (share + square / (2 * of)) / (1 + square / of)
    half = Z_95 * sqrt(share * (1 - share) / of + square / (4 * of**2)) / (1 + square / of)
    return max(0.0, middle - half), min(1.0, middle + half)


def mcnemar(one: Sequence[bool], other: Sequence[bool]) -> float:
    """How likely pairs differ so much or more if both are as good (McNemar, 1947; exact, two-sided)."""
    from scipy.stats import binomtest  # of the extra twin: what needs no scipy goes without

    better = sum(a and not b for a, b in zip(one, other, strict=True))
    worse = sum(b and not a for a, b in zip(one, other, strict=True))
    return float(binomtest(better, better + worse, 0.5).pvalue) if better + worse else 1.0
