"""When second copies of class control rest: where they make a queue, each pose waits for the others' copies.

On a link that has room they cost nothing. On one that poses fill by more than a half, copies of all of them are more
than it takes. What a link takes is not known before something fills it, so it is tried: where the path queues and
copies are a good part of what is sent, they rest for a while, longer each time.
"""

from math import inf
from typing import Final

SHARE: Final = 0.15
"""Copies that are less than this share of what is sent make no queue."""
GAIN: Final = 0.02
"""The share is over about the last fifty datagrams."""
FIRST_REST_S: Final = 5.0
LONGEST_REST_S: Final = 120.0


class CopyRest:
    """`sent` for each datagram, and `may` where one could have a copy."""

    __slots__ = ("_rest_s", "_resting_until_s", "share")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """The path is another."""
        self.share = 0.0
        """What copies are of the datagrams that are sent."""
        self._rest_s = FIRST_REST_S
        self._resting_until_s = -inf

    def sent(self, *, copy: bool) -> None:
        self.share += GAIN * (float(copy) - self.share)

    def may(self, now: float, *, queues: bool) -> bool:
        """Whether a copy may be sent. `queues`: what is sent waits on the path for too long."""
        if now < self._resting_until_s:
            return False
        if not queues or self.share < SHARE:
            return True
        if now > self._resting_until_s + 4 * self._rest_s:
            self._rest_s = FIRST_REST_S  # it went well for long: the link was another then
        self._resting_until_s = now + self._rest_s
        self._rest_s = min(2 * self._rest_s, LONGEST_REST_S)
        return False
