"""Which cases tests with random input draw, and how many.

The same ones in every run: a failure is one of the change at hand, and is there again in the next run. With
SERN_EXPLORE set to a seed (`make explore`, which gives hypothesis the same one) other ones, and more of them. What is
found that way becomes an example of its own.
"""

import os
from random import Random
from typing import Final, TypeVar

from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

Case = TypeVar("Case")
SEED: Final = os.environ.get("SERN_EXPLORE", "")
TIMES: Final = 10
"""How many times the cases of a usual run are tried."""
USUAL: Final = 60
"""Cases of a test that asks for no number."""


def cases(count: int) -> int:
    """How many examples to draw where a usual run draws `count`."""
    return TIMES * count if SEED else count


def seeds(count: int) -> list[int]:
    """Seeds of a test's worlds: 0 to `count` in a usual run. They are the same in every process of one run."""
    if not SEED:
        return list(range(count))
    random = Random(SEED)
    return [random.randrange(2**32) for _ in range(cases(count))]


def also(*more: Case) -> tuple[Case, ...]:
    """Cases of a table that only `make explore` tries: next to those of a usual run they have another draw, not
    another promise."""
    return more if SEED else ()


def load_profile() -> None:
    """Set what all property tests go by. A busy machine, which draws and runs examples slowly, is no failure, and
    neither is what the draws of a seed happen to look like: large, or many that a filter takes away."""
    settings.register_profile(
        "sern",
        derandomize=not SEED,
        database=None,
        deadline=None,
        max_examples=cases(USUAL),
        print_blob=bool(SEED),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
    )
    settings.load_profile("sern")
    _draw_no_constants_of_modules()


def _draw_no_constants_of_modules() -> None:
    """Hypothesis draws some values from the constants of whatever local modules are imported: that depends on which
    tests the process has run before. It keeps its own constants. There is no setting for it; versions of hypothesis
    that have no such pool need none."""
    kind = getattr(providers, "HypothesisProvider", None)
    constants = getattr(providers, "Constants", None)
    if kind is not None and constants is not None and hasattr(kind, "_local_constants"):
        none = constants()
        kind._local_constants = property(lambda self: none)
