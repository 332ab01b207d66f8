"""Which cases tests with random input draw, and how many.

The same ones in every run: a failure is one of the change at hand, and is there again in the next run. With
SERN_EXPLORE set to a seed (`make explore`) other ones, and more of them. What is found that way becomes an example of
its own.
"""

import os
from random import Random
from typing import Final

from hypothesis import HealthCheck, settings

SEED: Final = os.environ.get("SERN_EXPLORE", "")
TIMES: Final = 10
"""So many times the cases of a usual run."""


def cases(count: int) -> int:
    """How many examples to draw where a usual run draws `count`."""
    return TIMES * count if SEED else count


def seeds(count: int) -> list[int]:
    """Seeds of a test's worlds: 0 to `count` in a usual run. They are the same in every process of one run."""
    if not SEED:
        return list(range(count))
    random = Random(SEED)
    return [random.randrange(2**32) for _ in range(cases(count))]


def load_profile() -> None:
    """For all property tests. A busy machine, which draws and runs examples slowly, is no failure."""
    settings.register_profile(
        "sern",
        derandomize=not SEED,
        database=None,
        deadline=None,
        print_blob=bool(SEED),
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("sern")
