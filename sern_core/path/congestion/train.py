"""What arrives in a round of start-up, and what its dispersion says of the bottleneck (packet trains: Dovrolis,
Ramanathan and Moore, 2004)."""

from collections import deque
from itertools import pairwise
from math import inf
from typing import Final, NamedTuple

from sern_core.path.capacity import AckSample

TRAIN_BYTES: Final = 8 * 1200
TRAIN_SPREAD: Final = 1.1
"""A train was spread by the path if it takes so many times as long to arrive as it took to leave."""
EVEN: Final[tuple[float, ...]] = (0.0, 0.0, 0.0, 0.0, 0.05, 0.10, 0.16)
"""Packets come evenly if the share of them that has come is nowhere off by more from the share of the time. Behind a
bottleneck they do. Where jitter alone spreads them they come in clumps, since who is held up holds up those behind:
nine packets are off by .2 at least, 99 times of 100. Fewer acknowledgements, by whose number this is, are even by
chance, and two always."""
EVEN_ARRIVALS: Final = 6
"""From so many on it is the last of these."""
UNEVEN_ARRIVALS: Final = 9
"""Where packets came unevenly before, it takes so many."""
PAUSE_RTTS: Final = 0.25
"""A sender that has nothing to send for so many round trips pauses: what comes then is another train."""
NO_TIME_S: Final = 1e-5
STALL_S: Final = 0.1


class Arrival(NamedTuple):
    """An acknowledgement: by the receiver's clock, bytes by then, and when its packet left, by ours."""

    at_s: float
    cum_bytes: int
    sent_s: float | None
    overtook: bool


class Train:
    """The dispersion of `TRAIN_BYTES` shows the bottleneck's rate at once. Where jitter moves the first packet and the
    last, packets come unevenly, and all of the round show the rate better."""

    __slots__ = (
        "_idle_since_s",
        "_last",
        "_left_s",
        "_packets",
        "even",
        "even_rate",
        "nbytes",
        "rate",
        "span_s",
        "spread",
        "tells",
        "took_s",
        "whole_bytes",
    )

    def __init__(self) -> None:
        self.nbytes = 0
        """What was acknowledged in the round."""
        self.rate = self.even_rate = 0.0
        """Bytes/s, the greatest of the round; and the greatest by packets that came evenly."""
        self.even = False
        """Whether the latest packets came evenly."""
        self.took_s = 0.0
        """How long they took to arrive."""
        self.tells = False
        """Whether the latest packets are enough to tell whether they came evenly."""
        self.spread = True
        """Whether they arrived farther apart than they left: by the bottleneck, not by our sending."""
        self._packets: deque[Arrival] = deque()
        self._idle_since_s = inf  # when a packet left behind which there was nothing more; inf: there was
        self._begin_whole()

    def _begin_whole(self) -> None:
        self.whole_bytes = 0
        """What came in the round while there was more to send..."""
        self.span_s = 0.0
        """... and the time that it took..."""
        self._left_s: float | None = 0.0  # ... and to leave; None: not known
        self._last: Arrival | None = None

    @property
    def whole_rate(self) -> float:
        """Bytes/s of all of the round; 0: nothing came yet."""
        if not self.whole_bytes:
            return 0.0
        return self.whole_bytes / self.span_s if self.span_s > NO_TIME_S else inf

    @property
    def whole_spread(self) -> bool:
        """Whether the path spread it."""
        return self._left_s is None or self.span_s > TRAIN_SPREAD * self._left_s

    def nothing_more(self, left_s: float) -> None:
        """There was nothing more to send behind a packet that left then."""
        self._idle_since_s = left_s

    def note(self, sample: AckSample, left_s: float, rtt_s: float, *, jittery: bool = False) -> bool:
        """Whether it was enough to tell a rate by. The packet left at `left_s`. `jittery`: packets came unevenly
        before."""
        many = UNEVEN_ARRIVALS if jittery else EVEN_ARRIVALS
        packet = Arrival(sample.receiver_s, sample.cum_bytes, sample.sent_s, sample.overtook)
        packets = self._packets
        if left_s - self._idle_since_s > PAUSE_RTTS * rtt_s:
            packets.clear()  # the time since then is the sender's
            self._last = None
        self._idle_since_s = inf
        packets.append(packet)
        self.nbytes += sample.acked_bytes
        self._note_whole(packet)
        while len(packets) > many and packet.cum_bytes - packets[1].cum_bytes >= TRAIN_BYTES:
            packets.popleft()
        first = packets[0]
        nbytes, span_s = packet.cum_bytes - first.cum_bytes, packet.at_s - first.at_s
        if nbytes < TRAIN_BYTES:
            return False
        if span_s > STALL_S and any(later.at_s - earlier.at_s > 0.6 * span_s for earlier, later in pairwise(packets)):
            packets.clear()  # a stream stood still for a lost segment: that says nothing about its rate
            self._begin_whole()
            return False
        self.took_s = span_s
        rate = nbytes / span_s if span_s > NO_TIME_S else inf
        self.rate = max(self.rate, rate)
        off = max(abs((by.at_s - first.at_s) * nbytes - (by.cum_bytes - first.cum_bytes) * span_s) for by in packets)
        in_order = not any(by.overtook for by in packets)
        tolerance = 0.0 if jittery and len(packets) < many else EVEN[min(len(packets), EVEN_ARRIVALS)]
        self.tells = tolerance > 0.0
        self.even = self.tells and in_order and span_s > NO_TIME_S and off <= tolerance * nbytes * span_s
        if self.even:
            self.even_rate = max(self.even_rate, rate)
        last_s, first_s = packet.sent_s, first.sent_s
        self.spread = last_s is None or first_s is None or span_s > TRAIN_SPREAD * (last_s - first_s)
        return True

    def _note_whole(self, packet: Arrival) -> None:
        last, self._last = self._last, packet
        if last is None:
            return
        self.whole_bytes += packet.cum_bytes - last.cum_bytes
        self.span_s += packet.at_s - last.at_s
        if self._left_s is None or packet.sent_s is None or last.sent_s is None:
            self._left_s = None
        else:
            self._left_s += packet.sent_s - last.sent_s
