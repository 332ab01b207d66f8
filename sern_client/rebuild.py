"""Puts occupancy patches together again: where a site receives patches, it publishes whole grids.

The origin announces `<topic>` (whole grids, now and then) with the attribute `summary: patches`, and
`<topic>_updates` with what changed in between. Here every complete change is published as a whole
nav_msgs/OccupancyGrid on the topic itself, as if it had come that way; a site that takes the topic asks for the updates
by itself. They are published as well, under their own name, only if the site has asked for them.

A change of some bytes makes a whole grid of megabytes. So writing and publishing grids takes a share of the event loop
only: what is complete before its turn waits, and a newer grid takes its place.
"""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sern_core.summaries.grids import GRID_TYPE, UPDATE_TYPE
from sern_core.summaries.patches import GridRebuilder
from sern_core.summaries.spec import SummaryKind
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime.clock import now as clock_now
from sern_runtime.loop import Timer

REST: Final = 4.0
"""After a grid the loop is left alone for this multiple of the time that the grid took."""
MAX_BYTES: Final = 256 * 2**20
"""What all grids of a site keep together. Beyond, a grid of the origin that has most is forgotten: it comes anew with
its next whole one."""
MAX_OWED: Final = 4_096
"""Updates of a grid that are confirmed only when it has been published."""

Show = Callable[[bytes, int], None]
"""`show(body, stamp_ns)`: publish a whole grid."""

Owed = tuple[StreamId, int]
"""An update by its stream and seq."""
Shown = Callable[[Callable[[], None], Sequence[Owed]], None]
"""`shown(publish, owed)`: call `publish`; these updates are in what it published."""
Settle = Callable[[Sequence[Owed]], None]
"""`settle(owed)`: these updates will be in nothing that is published."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Grid:
    rebuilder: GridRebuilder
    show: Show | None = None
    complained: bool = False
    streams: set[StreamId] = field(default_factory=set)  # that are open
    owed: list[Owed] = field(default_factory=list)  # what was taken, and is in no grid that was published yet


def _source(stream: StreamInfo) -> StreamId | None:
    """The stream of whole grids that a stream of patches belongs to; None: it is none."""
    if stream.attributes.get("summary") != SummaryKind.PATCHES or stream.info.encoding is Encoding.RAW:
        return None
    topic = stream.attributes.get("summary_of", "")
    if stream.info.type_name not in (GRID_TYPE, UPDATE_TYPE):
        return None
    if stream.id.topic != (topic if stream.info.type_name == GRID_TYPE else f"{topic}_updates"):
        return None
    return StreamId(stream.id.origin, stream.id.boot, TopicName(topic))


class Rebuilds:
    """Every grid of patches that arrives here. `close` it at the end.

    Updates that somebody waits to have confirmed are owed: `shown` and `settle` are told what became of them.
    """

    def __init__(
        self, shown: Shown, settle: Settle, *, clock: Callable[[], float] = clock_now, max_bytes: int = MAX_BYTES
    ) -> None:
        self.undecodable = 0
        self._shown = shown
        self._settle = settle
        self._clock = clock
        self._max_bytes = max_bytes
        self._gaps = 0  # of grids that have ended
        self._kept_bytes = 0
        self._grids: dict[StreamId, _Grid] = {}
        self._due: dict[StreamId, _Grid] = {}
        self._next_s = 0.0  # when the loop has rested
        self._timer: Timer | None = None

    def close(self) -> None:
        """Publish nothing more."""
        self._due.clear()
        if self._timer is not None:
            self._timer.cancel()

    @property
    def gaps(self) -> int:
        """How often a grid could not go on because something was missing."""
        return self._gaps + sum(grid.rebuilder.gaps for grid in self._grids.values())

    def opened(self, stream: StreamInfo, show: Show | None) -> TopicName | None:
        """A stream has begun; `show` if it is published here. Returns the topic of the updates to ask for, if any."""
        source = _source(stream)
        if source is None:
            return None
        grid = self._grids.setdefault(source, _Grid(GridRebuilder(stream.info.encoding)))
        grid.streams.add(stream.id)
        if stream.id != source:
            return None
        grid.show = show
        return TopicName(source.topic + "_updates")

    def is_updates(self, stream: StreamInfo) -> bool:
        """Whether a stream is the updates of patches."""
        source = _source(stream)
        return source is not None and source != stream.id

    def closed(self, stream: StreamInfo) -> None:
        """A stream has ended: what was known by it is forgotten."""
        source = _source(stream)
        grid = self._grids.get(source) if source is not None else None
        if grid is None or source is None:
            return
        self._kept_bytes -= grid.rebuilder.nbytes
        if stream.id == source:
            gaps = grid.rebuilder.gaps
            grid.show = None
            grid.rebuilder.forget()
            grid.rebuilder.gaps = gaps  # to end is no gap
            self._due.pop(source, None)
        else:
            grid.rebuilder.updates_ended()
        self._give_up(grid)
        self._kept_bytes += grid.rebuilder.nbytes
        grid.streams.discard(stream.id)
        if not grid.streams:
            self._gaps += grid.rebuilder.gaps
            del self._grids[source]

    def message(self, stream: StreamInfo, message: Message, *, owed: bool = False) -> bool:
        """A message of any stream. True: it was a whole grid, and is published from here if it is to be.

        `owed`: it is an update that may be confirmed only when it has been published; `owes` tells whether it waits.
        """
        source = _source(stream)
        grid = self._grids.get(source) if source is not None else None
        if grid is None or source is None:
            return False
        whole = stream.id == source
        before_bytes = grid.rebuilder.nbytes
        try:
            if whole:
                self._keyframe(source, grid, message)
            else:
                grid.rebuilder.accept(message.body, seq=message.seq, stamp_ns=message.stamp_ns)
                if owed and grid.show is not None:
                    grid.owed.append((stream.id, message.seq))
                    if len(grid.owed) > MAX_OWED:
                        self._give_up(grid, keep=MAX_OWED // 2)
        except BodyError as error:
            self.undecodable += 1
            if not grid.complained:
                grid.complained = True
                _log.warning("%s from %s: a patch cannot be applied: %s", stream.id.topic, stream.id.origin, error)
            return False  # a whole grid that cannot be read here is published as it came
        finally:
            self._kept_bytes += grid.rebuilder.nbytes - before_bytes
            if self._kept_bytes > self._max_bytes:
                self._make_room()
        if grid.rebuilder.due:
            self._due[source] = grid
            self._show_due()
        return whole

    def _keyframe(self, source: StreamId, grid: _Grid, message: Message) -> None:
        """Publish a whole grid at once. One that is late changes nothing, neither what is due nor what is owed."""
        body = grid.rebuilder.keyframe(message.body, stamp_ns=message.stamp_ns)
        if body is None:
            return
        self._due.pop(source, None)
        self._grids[source] = self._grids.pop(source)  # the first of an origin makes room first
        self._publish(grid, body)  # it has what is owed, or is newer

    def _show_due(self) -> None:
        """Publish what is due and has its turn."""
        while self._due and self._clock() >= self._next_s:
            grid = self._due.pop(next(iter(self._due)))
            began_s = self._clock()
            self._publish(grid, grid.rebuilder.whole())
            ended_s = self._clock()
            self._next_s = ended_s + REST * (ended_s - began_s)
        if self._due:
            self._timer = self._timer or Timer(self._show_due, clock=self._clock)
            self._timer.arm(self._next_s)

    def _publish(self, grid: _Grid, body: bytes | None) -> None:
        owed, grid.owed = grid.owed, []
        if body is None or grid.show is None:
            self._settle(owed)
            return
        self._shown(partial(grid.show, body, grid.rebuilder.stamp_ns), owed)

    def _give_up(self, grid: _Grid, *, keep: int = 0) -> None:
        """All owed updates but the latest `keep` wait for nothing any more."""
        count = len(grid.owed) - keep
        if count > 0:
            owed, grid.owed = grid.owed[:count], grid.owed[count:]
            self._settle(owed)

    def owes(self, stream: StreamInfo, seq: int) -> bool:
        """Whether an update waits for the grid that it is part of to be published."""
        source = _source(stream)
        grid = self._grids.get(source) if source is not None else None
        return grid is not None and bool(grid.owed) and grid.owed[-1] == (stream.id, seq)

    def _make_room(self) -> None:
        """Forget grids, each time the first of the origin that has most, until the others keep no more than allowed."""
        while self._kept_bytes > self._max_bytes:
            kept_bytes: Counter[ClientName] = Counter()
            for source, grid in self._grids.items():
                kept_bytes[source.origin] += grid.rebuilder.nbytes
            ((most, _),) = kept_bytes.most_common(1)
            source, grid = next(
                (source, grid)
                for source, grid in self._grids.items()
                if source.origin == most and grid.rebuilder.nbytes
            )
            self._kept_bytes -= grid.rebuilder.nbytes
            grid.rebuilder.forget()
            self._due.pop(source, None)
            self._give_up(grid)
            if not grid.complained:
                grid.complained = True
                _log.warning(
                    "%s from %s: its grid is forgotten until it comes whole again: all grids that are put together "
                    "here take more than %d MiB", source.topic, source.origin, self._max_bytes // 2**20,
                )  # fmt: skip
