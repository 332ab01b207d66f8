"""Whether data goes over the stream although datagrams get through: it does on a short, clean path while much is sent.

A datagram of 1200 bytes costs each end as much as a piece of 64 kB (measured: at 40 Mbit/s datagrams take half a core).
What a stream costs in exchange, that a lost segment keeps all behind it waiting, is little where nothing is lost and a
round trip is short. What datagrams have carried shows that the path is fat; whether the stream carries as much shows
only a try. Pure.
"""

from typing import Final

from sern_core.path.lanes import Lane

LOOK_S: Final = 1.0
"""What is carried is measured over so long."""
CLEAN_LOSS: Final = 0.003
"""The largest share of datagrams that are lost. Beyond it TCP carries less of such a path."""
SHORT_S: Final = 0.030
"""The longest round trip of the empty path: a lost segment costs the stream one or two of them."""
IDLE: Final = 0.25
"""Below this share of the rate at which the stream is tried datagrams cost little, and are the safer choice."""
LATE_S: Final = 0.250
"""What is in flight for longer than this and the empty path's round trip waits for a lost segment, or in a queue."""
REST_S: Final = 10.0
"""After a try that failed, before the next one; each that fails doubles it."""
MAX_REST_S: Final = 600.0
PROVEN_S: Final = 60.0
"""A stream that has carried the data for so long was no failure."""


class StreamChoice:
    """`stream` is the answer, as `look` found it last. Call that at acknowledgements, some twenty times a second.

    `from_bps`: what datagrams have to carry, bits per second; inf: data stays with them.
    """

    __slots__ = (
        "_begin_acked",
        "_begin_bytes",
        "_begin_lost",
        "_begin_s",
        "_expected_bps",
        "_from_bps",
        "_held",
        "_lane",
        "_looks",
        "_rest_s",
        "_since_s",
        "_until_s",
        "stream",
    )

    def __init__(self, from_bps: float) -> None:
        self.stream = False
        self._from_bps = from_bps
        self._lane: Lane | None = None
        """Which lane is measured, from `_begin_s` on; what it had by then."""
        self._begin_s = 0.0
        self._begin_bytes = self._begin_acked = self._begin_lost = 0
        self._looks = 0
        self._held = 0
        """Looks that found something waiting for the window."""
        self._since_s = 0.0
        """When the stream was chosen."""
        self._expected_bps = 0.0
        """What datagrams carried before."""
        self._rest_s = REST_S
        self._until_s = 0.0
        """No try before then."""

    def look(self, lane: Lane, *, now: float) -> None:
        """`lane` carries the data; another one would carry them as well."""
        if lane is not self._lane:
            self._lane = lane
            self._measure(lane, now)
        if self.stream is not lane.lossless:
            return  # the change is under way
        if self.stream and lane.flight.oldest_s < now - LATE_S - (lane.estimator.rtprop_s or 0.0):
            self._fail(now)
            return
        self._looks += 1
        self._held += lane.path.held
        elapsed_s = now - self._begin_s
        if elapsed_s < LOOK_S:
            return
        carried_bps = 8 * (lane.path.arrived_bytes - self._begin_bytes) / elapsed_s
        if not self.stream:
            self._consider(lane, carried_bps, now)
        elif carried_bps < self._expected_bps / 2 and 2 * self._held > self._looks:
            self._fail(now)
        elif carried_bps < IDLE * self._from_bps:
            self.stream = False
        elif now - self._since_s >= PROVEN_S:
            self._rest_s = REST_S
        self._measure(lane, now)

    def failed(self, now: float) -> None:
        """The stream does not get through any more."""
        if self.stream:
            self._fail(now)

    def _consider(self, lane: Lane, carried_bps: float, now: float) -> None:
        rtprop_s = lane.estimator.rtprop_s
        lost = lane.lost_packets - self._begin_lost
        if (
            carried_bps >= self._from_bps
            and lost <= CLEAN_LOSS * (lost + lane.acked_packets - self._begin_acked)
            and rtprop_s is not None
            and rtprop_s <= SHORT_S
            and now >= self._until_s
        ):
            self.stream = True
            self._since_s = now
            self._expected_bps = carried_bps

    def _fail(self, now: float) -> None:
        self.stream = False
        self._until_s = now + self._rest_s
        self._rest_s = min(2 * self._rest_s, MAX_REST_S)

    def _measure(self, lane: Lane, now: float) -> None:
        self._begin_s, self._begin_bytes = now, lane.path.arrived_bytes
        self._begin_acked, self._begin_lost = lane.acked_packets, lane.lost_packets
        self._looks = self._held = 0
