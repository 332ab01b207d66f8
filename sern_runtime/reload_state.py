"""What the last reload did not put in force, why, and since when."""

from typing import Final

PART_PREFIX: Final = "reload failed in part"


class ReloadState:
    """A failed reload stays beside the relay's state until a good one; it changes nothing of what the relay does.

    `failures` counts reloads that failed, whole or in part. `reading` begins one; then `failed` or `failed_in_part`
    any number of times; `settle` ends it.
    """

    def __init__(self) -> None:
        self.failures = 0
        self._problem: str | None = None
        self._part: str | None = None
        self._since_s: float | None = None

    @property
    def failing(self) -> bool:
        """Whether what the last reload read is not all in force."""
        return self._problem is not None

    def beside(self, state: str) -> str:
        """`state`, and after it what is not in force, if anything is not."""
        return state if self._problem is None else f"{state}; {self._problem}"

    def read(self) -> None:
        """The file is read, and right: only what a part of it says can still fail."""
        self._problem = self._part = None

    def failed(self, problem: str, *, now: float) -> None:
        """Nothing of the file is in force."""
        self._fail(f"reload failed, the old configuration stays: {problem}", now)

    def failed_in_part(self, what: str, problem: str, *, now: float) -> None:
        """All but `what` is in force."""
        self._part = f"{PART_PREFIX}, not all of {what} are in force: {problem}"
        self._fail(self._part, now)

    def part_in_force(self) -> None:
        """What had failed in part is in force by now; a whole reload that failed later stays failed."""
        if self._problem == self._part:
            self._problem = None
        self._part = None

    def take_recovery_s(self, *, now: float) -> float | None:
        """How long reloads had failed, once, when what had failed is in force; else None."""
        if self._problem is not None or self._since_s is None:
            return None
        failed_s, self._since_s = now - self._since_s, None
        return failed_s

    def _fail(self, problem: str, now: float) -> None:
        self.failures += 1
        if self._since_s is None:
            self._since_s = now
        self._problem = problem
