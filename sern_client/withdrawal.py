"""Ends the topics of an origin that is not there, at the endpoint alone: its streams, leases and counters go on.

A message that comes all the same brings them back, and so does the origin. What is latched in them is kept meanwhile
and published again, for those who join later.
"""

import logging
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from sern_client.endpoints.base import Publisher
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock

MAX_KEPT: Final = 10
"""Latched messages of one stream that are kept for the time after: what a late joiner gets at most."""

_log = logging.getLogger(__name__)

Kept = deque[tuple[bytes, int]]
"""Bodies and stamps, oldest first."""


class Withdrawable(Protocol):
    """A stream that is published here. `kept`: its latched messages, if it has any; `withdrawn`: its origin, while it
    is not published for this reason."""

    info: TopicInfo
    publisher: Publisher | None
    kept: Kept | None
    withdrawn: ClientName | None

    def use(self, publisher: Publisher | None) -> None: ...


class Withdrawal:
    """`streams` is the table of what is published here; `advertise` raises ConfigError alone, `close` nothing. `used`
    False: nothing is ever withdrawn, so nothing is kept."""

    def __init__(
        self,
        streams: Mapping[StreamId, Withdrawable],
        advertise: Callable[[TopicInfo], Publisher],
        close: Callable[[Withdrawable], None],
        *,
        used: bool,
    ) -> None:
        self._used = used
        self._streams = streams
        self._advertise = advertise
        self._close = close
        self._since_s: dict[ClientName, float] = {}  # of origins whose topics were said to end here

    def kept(self, stream: StreamInfo) -> Kept | None:
        """Where the latched messages of a stream are to be kept; None: nowhere."""
        if not (self._used and stream.spec.latched):
            return None
        return deque(maxlen=min(stream.spec.depth, MAX_KEPT))

    def withdraw(self, origin: ClientName) -> None:
        """End its topics here."""
        names = []
        for stream, incoming in self._streams.items():
            if stream.origin == origin and incoming.publisher is not None:
                self._close(incoming)
                incoming.use(None)
                incoming.withdrawn = origin
                names.append(incoming.info.name)
        if names:
            self._since_s.setdefault(origin, clock.now())
            _log.warning("%s is not there: %d of its topics end here until it is", origin, len(names))

    def restore(self, origin: ClientName) -> None:
        """Publish its topics again, with what is latched in them."""
        for stream, incoming in self._streams.items():
            if stream.origin == origin and incoming.withdrawn is not None:
                self._restore(incoming)
        self._restored(origin)

    def restore_one(self, incoming: Withdrawable) -> None:
        """Publish one again that was withdrawn: a message of it came."""
        origin = incoming.withdrawn
        self._restore(incoming)
        if origin is not None:
            self._restored(origin)

    def _restored(self, origin: ClientName) -> None:
        """Say so once nothing of it is withdrawn any more."""
        since_s = self._since_s.get(origin)
        if since_s is None or any(incoming.withdrawn == origin for incoming in self._streams.values()):
            return
        del self._since_s[origin]
        _log.warning("%s is there again: its topics are published here, after %.0f s", origin, clock.now() - since_s)

    def _restore(self, incoming: Withdrawable) -> None:
        try:
            publisher = self._advertise(incoming.info)
        except ConfigError as error:
            _log.error("%s cannot be published again: %s", incoming.info.name, error)
            return
        incoming.withdrawn = None
        incoming.use(publisher)
        for body, stamp_ns in incoming.kept or ():
            publisher.publish(body, stamp_ns)
