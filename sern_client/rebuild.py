"""Puts occupancy patches together again: where a site receives patches, it publishes whole grids.

The origin announces `<topic>` (whole grids, now and then) with the attribute `summary: patches`, and
`<topic>_updates` with what changed in between. Here every complete change is published as a whole
nav_msgs/OccupancyGrid on the topic itself, as if it had come that way; a site that takes the topic asks for the updates
by itself. They are published as well, under their own name, only if the site has asked for them.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

from sern_core.errors import BodyError
from sern_core.message import Message, StreamId, StreamInfo
from sern_core.summaries.grids import GRID_TYPE, UPDATE_TYPE
from sern_core.summaries.patches import GridRebuilder
from sern_core.summaries.spec import SummaryKind
from sern_core.types import Encoding, TopicName

Show = Callable[[bytes, int], None]
"""`show(body, stamp_ns)`: publish a whole grid."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Grid:
    rebuilder: GridRebuilder
    show: Show | None = None
    complained: bool = False


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
    """Every grid of patches that arrives here."""

    def __init__(self) -> None:
        self.undecodable = 0
        self._gaps = 0  # of grids that have ended
        self._grids: dict[StreamId, _Grid] = {}

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
                body = grid.rebuilder.keyframe(message.body, stamp_ns=message.stamp_ns)
            else:
                body = grid.rebuilder.update(message.body, seq=message.seq, stamp_ns=message.stamp_ns)
        except BodyError as error:
            self.undecodable += 1
            if not grid.complained:
                grid.complained = True
                _log.warning("%s from %s: a patch cannot be applied: %s", stream.id.topic, stream.id.origin, error)
            return False  # a whole grid that cannot be read here is published as it came
        if body is not None and grid.show is not None:
            grid.show(body, message.stamp_ns)
        return whole
