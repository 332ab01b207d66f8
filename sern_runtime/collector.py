"""Python's garbage collector, kept from holding up the event loop; and how long it does.

A full pass looks at every object there is: 70 ms for what a daemon has imported and built when it has started, before
any peer came. So the programs start without passes, and `settle` takes all that out of their sight. They are rare from
then on: the data path makes no cycles, so there is next to nothing to be found. They go on, as sessions and streams
that end do leave some, and look at what has come since the start.
"""

import gc
from collections.abc import Callable
from typing import Final

from sern_runtime.clock import now
from sern_runtime.metrics import Labels, Metrics

THRESHOLDS: Final = (2_000, 20, 50)
"""New objects before a young pass; young passes before a middle one, and middle ones before a full one, which Python
leaves out until what it would look at has grown by a quarter. A middle pass sees 40,000 objects: some 10 ms."""
GENERATIONS: Final = ("0", "1", "2")


class CollectorWatch:
    """Passes of the collector and their time, by generation. `watch`, then `settle` once the daemon has started;
    `close` puts everything back."""

    def __init__(self, clock: Callable[[], float] = now) -> None:
        self.passes = [0] * len(GENERATIONS)
        self.seconds = [0.0] * len(GENERATIONS)
        self.longest_s = [0.0] * len(GENERATIONS)
        self._clock = clock
        self._since_s: float | None = None
        self._settling = False
        self._thresholds: tuple[int, int, int] | None = None  # as they were; None: nothing is settled

    def watch(self) -> None:
        """Count from now on. Idempotent."""
        if self._pass not in gc.callbacks:
            gc.callbacks.append(self._pass)

    def settle(self) -> None:
        """What is there now stays: it is not looked at again, and passes become rare. Takes one full pass, which
        is not counted. It holds for the process, so it is not for a daemon that shares one."""
        if self._thresholds is None:
            self._thresholds = gc.get_threshold()
        gc.set_threshold(*THRESHOLDS)
        self._settling = True
        gc.collect()
        self._settling = False
        gc.freeze()
        gc.enable()

    def close(self) -> None:
        """Idempotent."""
        if self._pass in gc.callbacks:
            gc.callbacks.remove(self._pass)
        self._since_s = None
        if self._thresholds is not None:
            gc.set_threshold(*self._thresholds)
            self._thresholds = None
            gc.unfreeze()

    def _pass(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._since_s = None if self._settling else self._clock()
        elif self._since_s is not None:
            spent_s, self._since_s = self._clock() - self._since_s, None
            generation = info["generation"]
            self.passes[generation] += 1
            self.seconds[generation] += spent_s
            self.longest_s[generation] = max(self.longest_s[generation], spent_s)

    def register(self, metrics: Metrics) -> None:
        def rows(values: list[float] | list[int]) -> list[tuple[Labels, float]]:
            return [((generation,), float(value)) for generation, value in zip(GENERATIONS, values, strict=True)]

        label = ("generation",)
        metrics.counter("sern_gc_passes_total", "Passes of the garbage collector, by generation.", label,
                        lambda: rows(self.passes))  # fmt: skip
        metrics.counter("sern_gc_pause_seconds_total", "Time the garbage collector took, all of it in the loop's way.",
                        label, lambda: rows(self.seconds))  # fmt: skip
        metrics.gauge("sern_gc_pause_longest_seconds", "The longest pass of the garbage collector so far.", label,
                      lambda: rows(self.longest_s))  # fmt: skip
