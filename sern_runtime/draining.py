"""Whether a daemon that drains still gets anywhere."""

from typing import Final

STEP_S: Final = 0.25
"""The most that the time between two looks counts for."""


class Progress:
    """How long nothing has moved, in time that this process could use: a machine that stood still, or had no processor
    for us, has kept acknowledgements from us as well."""

    def __init__(self) -> None:
        self._still_s = 0.0
        self._before: tuple[int, ...] | None = None
        self._at_s = 0.0

    def still_s(self, left: tuple[int, ...], *, now: float) -> float:
        """Look again: `left` is what is still to be done."""
        if left == self._before:
            self._still_s += min(now - self._at_s, STEP_S)
        else:
            self._still_s = 0.0
        self._before, self._at_s = left, now
        return self._still_s
