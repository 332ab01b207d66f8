"""Puts occupancy patches together again: where a site receives patches, it publishes whole grids.

The origin announces `<topic>` (whole grids, now and then) with the attribute `summary: patches`, and
`<topic>_updates` with what changed in between. Here every complete change is published as a whole
nav_msgs/OccupancyGrid on the topic itself, as if it had come that way; a site that takes the topic asks for the updates
by itself. They are published as well, under their own name, only if the site has asked for them.

A change of some bytes makes a whole grid of megabytes. So writing and publishing grids takes a share of the event loop
only: what is complete before its turn waits, and a newer grid takes its place.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sern_core.errors import BodyError
from sern_core.message import Message, StreamId, StreamInfo
from sern_core.summaries.grids import GRID_TYPE, UPDATE_TYPE
from sern_core.summaries.patches import GridRebuilder
from sern_core.summaries.spec import SummaryKind
from sern_core.types import Encoding, TopicName
from sern_runtime.clock import now as clock_now
from sern_runtime.loop import Timer

REST: Final = 4.0
"""After a grid the loop is left alone for this multiple of the time that the grid took."""
MAX_BYTES: Final = 256 * 2**20
"""What all grids of a site keep together; beyond, the one that is known longest is forgotten until it comes anew."""

Show = Callable[[bytes, int], None]
"""`show(body, stamp_ns)`: publish a whole grid."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Grid:
    rebuilder: GridRebuilder
    show: Show | None = None
    complained: bool = False
    stamp_ns: int = 0  # of the grid that is due


def _source(stream: StreamInfo) -> StreamId | None:
    """The stream of whole grids that a stream of patches belongs to; None: it is none."""
    if stream.attributes.get("summary") != SummaryKind.PATCHES or stream.info.encoding is Encoding.RAW:
        return None
    topic = stream.attributes.get("summary_of", "")
    if stream.info.type_name not in (GRID_TYPE, UPDATE_TYPE):
        return None
    if (stream.info.type_name == GRID_TYPE) != (topic == stream.id.topic):
        return None
    return StreamId(stream.id.origin, stream.id.boot, TopicName(topic))


class Rebuilds:
    """Every grid of patches that arrives here. `close` it at the end."""

    def __init__(self, *, clock: Callable[[], float] = clock_now, max_bytes: int = MAX_BYTES) -> None:
        self.undecodable = 0
        self._clock = clock
        self._max_bytes = max_bytes
        self._gaps = 0  # of grids that have ended
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
        if stream.id != source:
            return None
        grid.show = show
        return TopicName(source.topic + "_updates")

    def is_updates(self, stream: StreamInfo) -> bool:
        """Whether a stream is the updates of patches."""
        source = _source(stream)
        return source is not None and source != stream.id

    def closed(self, stream: StreamInfo) -> None:
        """The whole grids have ended: what was known of them is forgotten."""
        self._due.pop(stream.id, None)
        grid = self._grids.pop(stream.id, None)
        self._gaps += 0 if grid is None else grid.rebuilder.gaps

    def message(self, stream: StreamInfo, message: Message) -> bool:
        """A message of any stream. True: it was a whole grid, and is published from here if it is to be."""
        source = _source(stream)
        grid = self._grids.get(source) if source is not None else None
        if grid is None:
            return False
        whole = stream.id == source
        try:
            if whole:
                self._due.pop(stream.id, None)
                body = grid.rebuilder.keyframe(message.body, stamp_ns=message.stamp_ns)
                if body is not None and grid.show is not None:
                    grid.show(body, message.stamp_ns)
                self._bound(stream.id)
            else:
                grid.rebuilder.accept(message.body, seq=message.seq, stamp_ns=message.stamp_ns)
        except BodyError as error:
            self.undecodable += 1
            if not grid.complained:
                grid.complained = True
                _log.warning("%s from %s: a patch cannot be applied: %s", stream.id.topic, stream.id.origin, error)
            return False  # a whole grid that cannot be read here is published as it came
        if grid.rebuilder.due and source is not None:
            grid.stamp_ns = message.stamp_ns
            self._due[source] = grid
            self._show_due()
        return whole

    def _show_due(self) -> None:
        """Publish what is due and has its turn."""
        while self._due and self._clock() >= self._next_s:
            grid = self._due.pop(next(iter(self._due)))
            began_s = self._clock()
            body = grid.rebuilder.whole()
            if body is not None and grid.show is not None:
                grid.show(body, grid.stamp_ns)
            ended_s = self._clock()
            self._next_s = ended_s + REST * (ended_s - began_s)
        if self._due:
            self._timer = self._timer or Timer(self._show_due, clock=self._clock)
            self._timer.arm(self._next_s)

    def _bound(self, latest: StreamId) -> None:
        """Forget the grids that are known longest while all together keep too much."""
        self._grids[latest] = self._grids.pop(latest)
        kept_bytes = sum(grid.rebuilder.nbytes for grid in self._grids.values())
        for source, grid in self._grids.items():
            if kept_bytes <= self._max_bytes or source == latest:
                return
            nbytes = grid.rebuilder.nbytes
            if nbytes:
                grid.rebuilder.forget()
                self._due.pop(source, None)
                kept_bytes -= nbytes - grid.rebuilder.nbytes
                _log.warning(
                    "%s from %s: its grid is forgotten until it comes whole again: all grids that are put together "
                    "here take more than %d MiB", source.topic, source.origin, self._max_bytes // 2**20,
                )  # fmt: skip
