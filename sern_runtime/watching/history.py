"""How each link was in the last ten minutes: what the page's small pictures are drawn from. Pure, bounded.

Time is cut into steps of `STEP_S`, numbered on the daemon's own clock; of each step and link one point is kept, that
tells of its worst: the longest round trip, the highest loss, and whether the link was down at any look.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

from sern_core.link.link import Link

STEP_S: Final = 5.0
POINTS: Final = 120
"""Points that are kept of each link."""
MAX_LINKS: Final = 256
"""Links of which points are kept: of others there are no pictures."""


class Look(NamedTuple):
    """A link when it was looked at. Bytes are totals; None: not known."""

    peer: str
    up: bool
    capacity_bps: float | None
    round_trip_s: float | None
    loss: float
    sent_bytes: int
    received_bytes: int

    @classmethod
    def of(cls, link: Link, now: float) -> Self:
        """A link as it is."""
        seen = link.observe(now=now)
        up = seen.up
        return cls(
            link.peer,
            up,
            seen.rate_bps if up else None,
            seen.srtt_s or None if up else None,
            seen.loss if up else 0.0,
            seen.wire_bytes,
            link.heard_bytes,
        )


class Point(NamedTuple):
    """A link in one step. `number` of the step; rates in bit/s; None: not known."""

    number: int
    up: bool
    capacity_bps: float | None
    round_trip_s: float | None
    loss: float
    sent_bps: float
    received_bps: float


@dataclass(slots=True)
class _Track:
    """One link. The step that runs, its totals at its beginning, and what is over."""

    points: deque[Point]
    number: int
    began_s: float
    first: Look
    last: Look
    at_s: float
    up: bool
    round_trip_s: float | None
    loss: float


class LinkHistory:
    """Feed it with `note` about once a second, and `advance` after that."""

    def __init__(self, *, step_s: float = STEP_S, max_links: int = MAX_LINKS) -> None:
        self.step_s = step_s
        self.number = -1
        """The newest step that is over."""
        self.left_out = 0
        """Links without a history, as there are too many: at the last look."""
        self._max_links = max_links
        self._tracks: dict[str, _Track] = {}
        self._left_out = 0

    def note(self, look: Look, *, now: float) -> None:
        """How a link is now."""
        number = int(now // self.step_s)
        track = self._tracks.get(look.peer)
        if track is None:
            if len(self._tracks) >= self._max_links:
                self._left_out += 1
                return
            self._tracks[look.peer] = _begun(deque(maxlen=POINTS), number, look, now)
            return
        if number != track.number:
            track.points.append(_ended(track))
            begun = _begun(track.points, number, look, now)
            if number == track.number + 1:  # rates are from the end of the step before on
                begun.began_s, begun.first = track.at_s, track.last
            self._tracks[look.peer] = begun
            return
        track.last, track.at_s = look, now
        track.up = track.up and look.up
        track.loss = max(track.loss, look.loss)
        if look.round_trip_s is not None:
            track.round_trip_s = max(track.round_trip_s or 0.0, look.round_trip_s)

    def advance(self, *, now: float) -> None:
        """All links were noted: end the steps of those that are not there any more, and forget what is too old."""
        current = int(now // self.step_s)
        self.number = current - 1
        self.left_out, self._left_out = self._left_out, 0
        for peer, track in list(self._tracks.items()):
            if track.number < current - POINTS:
                del self._tracks[peer]

    def since(self, number: int) -> Iterator[tuple[str, list[Point]]]:
        """The points of each link, of steps after `number` that are over, oldest first."""
        for peer, track in list(self._tracks.items()):
            points = [point for point in track.points if number < point.number <= self.number]
            if number < track.number <= self.number:  # nothing has ended it: the link is not noted any more
                points.append(_ended(track))
            if points:
                yield peer, points


def _begun(points: deque[Point], number: int, look: Look, now: float) -> _Track:
    return _Track(points, number, now, look, look, now, look.up, look.round_trip_s, look.loss)


def _ended(track: _Track) -> Point:
    first, last = track.first, track.last
    span_s = track.at_s - track.began_s
    return Point(
        track.number,
        track.up,
        last.capacity_bps,
        track.round_trip_s,
        track.loss,
        _rate_bps(last.sent_bytes - first.sent_bytes, span_s),
        _rate_bps(last.received_bytes - first.received_bytes, span_s),
    )


def _rate_bps(nbytes: int, span_s: float) -> float:
    """0 for totals that began anew, and where no time has passed."""
    return 8 * nbytes / span_s if nbytes > 0 and span_s > 0 else 0.0
