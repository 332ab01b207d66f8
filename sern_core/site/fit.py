"""Whether the messages of a topic fit the link, or their summary goes in their place. Pure.

What became of the last messages decides: several in a row that were too large to arrive within their lifespan, and none
that arrived. One that waits for its turn until a newer one takes its place says nothing, unless it was far too large
for what the link carries. Summaries do not fill a link, so nobody would see that it has become a better one: now and
then a message goes as it came, to see. When two of them in a row have arrived, all go so again. The pause between them
grows while they are in vain and show no faster link, and where a topic has just gone back and forth, so that it does
not go on doing so.
"""

from collections.abc import Iterator
from math import inf
from typing import Final

from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.types import DropReason

MISSES: Final = 3
"""Messages in a row that could not arrive, after which summaries go in their place."""
ARRIVALS: Final = 2
"""Messages in a row that did arrive, after which all go whole again."""
MIN_PAUSE_S, MAX_PAUSE_S = 2.0, 30.0
"""After the first message that was in vain, and after many: the pause doubles each time."""
SETTLED_S: Final = 30.0
"""A link that has carried whole messages for so long is a better one, and no accident."""
MAX_WATCHED: Final = 64
"""Messages whose fate is not known yet; of more, the oldest are not watched."""
GROWS: Final = 1.1
"""The link is a faster one when it is known to carry so many times what it was before the last that was in vain."""
FAR_TOO_LARGE: Final = 4.0
"""A message is far too large if it takes so many of its lifespans with the link to itself: a codec seldom makes so
little of it that it arrives."""
TOO_LARGE: Final = frozenset({DropReason.TOO_SLOW, DropReason.LIFESPAN})
"""What the fate of a message is called that the link could not carry in time."""


class Fit:
    """What one topic is sent as. `channel` is the one that its messages go to as they come, best effort.

    `choose` for each message, and `sent` with its seq where it goes as it came.
    """

    __slots__ = (
        "_arrivals",
        "_back_s",
        "_carries_bps",
        "_channel",
        "_counted",
        "_due_s",
        "_misses",
        "_pause_s",
        "_probing",
        "_rate_bps",
        "_watched",
        "changed_s",
        "level",
        "switches",
    )

    def __init__(self, channel: OutChannel) -> None:
        self.level = SummaryLevel.RAW
        """What is in force; a message that goes to see does not change it."""
        self.switches = 0
        """How often it has changed."""
        self.changed_s: float | None = None
        self._channel = channel
        self._counted = channel.drops.on_count  # who else is told of what is dropped
        channel.drops.on_count = self._dropped
        self._watched: dict[int, int] = {}  # sizes by seqs of messages that went as they came, of unknown fate
        self._carries_bps: float | None = None
        self._misses = 0
        self._arrivals = 0
        self._probing = False  # a message that is to see has been chosen, and its fate is not known yet
        self._pause_s = MIN_PAUSE_S
        self._rate_bps = inf  # what the link was known to carry when the last one went to see
        self._due_s = inf  # when the next one goes to see
        self._back_s = -inf  # when whole messages went again last

    @property
    def watched(self) -> int:
        """Messages that went as they came, and whose fate is not known yet."""
        return len(self._watched)

    def choose(self, now: float, rate_bps: float | None) -> SummaryLevel:
        """What the message that comes now is sent as, while the link is known to carry `rate_bps`."""
        self._carries_bps = rate_bps
        for seq in list(self._arrived()):
            del self._watched[seq]
            self._misses = 0
            if self.level is SummaryLevel.SUMMARY:
                self._came_through(now)
        if self.level is SummaryLevel.RAW:
            if self._misses >= MISSES:
                self._switch(SummaryLevel.SUMMARY, now)
                self._pause_s = MIN_PAUSE_S if now > self._back_s + SETTLED_S else min(2 * self._pause_s, MAX_PAUSE_S)
                self._due_s = now + self._pause_s
            return self.level
        if self._misses:
            self._in_vain(now, rate_bps or 0.0)
        if self._probing and not self._watched and now > self._due_s + MIN_PAUSE_S:
            self._probing = False  # it never came to the channel
        if self._probing or now < self._due_s:
            return self.level
        self._probing, self._due_s, self._rate_bps = True, now, rate_bps or inf
        return SummaryLevel.RAW

    def sent(self, seq: int, nbytes: int) -> None:
        """A message of `nbytes` went to the channel as it came."""
        if len(self._watched) >= MAX_WATCHED:
            del self._watched[next(iter(self._watched))]
        self._watched[seq] = nbytes
        if self._probing:
            self._channel.probe_from_seq = seq

    def _dropped(self, seq: int, reason: DropReason) -> None:
        """The channel counts a message as dropped, whichever."""
        if self._counted is not None:
            self._counted(seq, reason)
        nbytes = self._watched.pop(seq, None)
        if nbytes is None:
            return
        if reason in TOO_LARGE or (reason is DropReason.SUPERSEDED and self._far_too_large(nbytes)):
            self._misses += 1
        elif self.level is SummaryLevel.SUMMARY:
            self._probing = False  # it says nothing: another one has its turn
            self._due_s += MIN_PAUSE_S

    def _far_too_large(self, nbytes: int) -> bool:
        lifespan_s = self._channel.spec.lifespan_s
        if lifespan_s is None or self._carries_bps is None:
            return False
        return 8 * nbytes > FAR_TOO_LARGE * lifespan_s * self._carries_bps

    def _arrived(self) -> Iterator[int]:
        """Those of which the other end has said that it has them whole."""
        channel = self._channel
        newest = channel.newest
        waiting = {out.seq for out in channel.queue}
        for seq in self._watched:
            if seq not in channel.flying and seq not in waiting and (newest is None or newest.seq != seq):
                yield seq

    def _came_through(self, now: float) -> None:
        self._probing = False
        self._arrivals += 1
        self._due_s = now
        if self._arrivals >= ARRIVALS:
            self._switch(SummaryLevel.RAW, now)
            self._back_s = now

    def _in_vain(self, now: float, rate_bps: float) -> None:
        """One that was to see has not arrived in time."""
        self._misses = self._arrivals = 0
        self._probing = False
        if rate_bps > GROWS * self._rate_bps:
            self._due_s = now + MIN_PAUSE_S
            return
        self._pause_s = min(2 * self._pause_s, MAX_PAUSE_S)
        self._due_s = now + self._pause_s

    def _switch(self, level: SummaryLevel, now: float) -> None:
        self.level = level
        self.switches += 1
        self.changed_s = now
        self._misses = self._arrivals = 0
        self._probing = False
        self._due_s = inf
        self._watched.clear()
