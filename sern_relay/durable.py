"""Keeps durable streams of the hub on disk (`sern_core/relay/holding.py`), and brings back what an earlier run kept."""

import logging
import time
from collections.abc import Callable, Sequence

from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName
from sern_core.wire.announce import Announcement, decode_announcement, encode_announcement
from sern_runtime.durable.disk import Disk
from sern_runtime.durable.keeper import Keeps
from sern_runtime.durable.store import Described, KeptStream, Place, Put, Row

_log = logging.getLogger(__name__)


class DurableHolding:
    """The `Shelf` of a hub. `known` says whether a client is in the directory of keys; `after` is called when something
    may have to be sent."""

    def __init__(
        self,
        disk: Disk,
        hub: Hub,
        *,
        known: Callable[[ClientName], bool],
        now: Callable[[], float],
        after: Callable[[], None],
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.disk = disk
        self._hub = hub
        self._wall_ns = wall_ns
        self._known = known
        self._now = now
        self._after = after
        self._closed = False

    def start(self) -> None:
        """Begin to write, and bring back what there is; before any client connects. Raises ConfigError as `Disk.open`
        does."""
        contents = self.disk.open(self._stored)
        if contents is None:
            return
        waiting = sum(map(self._restore, contents.streams.values()))
        if waiting:
            _log.warning("%d messages of durable topics of an earlier run wait for their clients", waiting)
        self._hub.holding.shelf = self

    def _restore(self, found: KeptStream) -> int:
        """Bring back one stream. Returns how many messages wait."""
        try:
            announcement = decode_announcement(found.announcement)
        except WireError as error:
            _log.error("%d messages of %s are lost: %s", len(found.rows), found.id.topic, error)
            self.forget(found.id)
            return 0
        stream = announcement.stream
        stream.definition_hash = announcement.definition_hash
        now, wall_ns = self._now(), self._wall_ns()
        messages = [
            Message(
                found.id,
                row.seq,
                row.body,
                row.stamp_ns,
                now - max(0, wall_ns - row.born_ns) * 1e-9,
                drop_marker=row.marker,
                codec=row.codec,
            )
            for row in found.rows
        ]
        clients = {client: seq for client, seq in found.places.items() if self._known(client)}
        return self._hub.holding.restore(stream, found.definition, found.last, messages, clients, now=now)

    # --- Shelf --------------------------------------------------------------------------------------------------------

    def describe(self, stream: StreamInfo, definition: str, last: int) -> None:
        said = encode_announcement(Announcement(1, stream, stream.definition_hash, 1))
        self._change(Described(stream.id, said, definition, (), last))

    def put(self, message: Message, *, now: float) -> bool:
        keeper = self._writes
        if keeper is None or not keeper.has_room(message.stream.origin, len(message.body)):
            return False
        born_ns = self._wall_ns() - int((now - message.born_s) * 1e9)
        row = Row(message.seq, born_ns, message.stamp_ns, message.body, int(message.codec), message.drop_marker)
        keeper.put(Put(message.stream, row))
        return True

    def trim(self, stream: StreamId, upto: int) -> None:
        if (keeper := self._writes) is not None:
            keeper.trim(stream, upto)

    def place(self, stream: StreamId, client: ClientName, seq: int) -> None:
        self._change(Place(stream, client, seq))

    def forget(self, stream: StreamId) -> None:
        if (keeper := self._writes) is not None:
            keeper.forget(stream)

    def _change(self, change: Described | Place) -> None:
        if (keeper := self._writes) is not None:
            keeper.change(change)

    @property
    def _writes(self) -> Keeps | None:
        return None if self._closed else self.disk.keeper

    # --- from the keeper ----------------------------------------------------------------------------------------------

    def _stored(self, puts: Sequence[Put]) -> None:
        if self._closed:
            return
        for stream, seq in {put.stream: put.row.seq for put in puts}.items():
            self._hub.holding.stored(stream, seq)
        self._after()

    def close(self) -> None:
        """Have everything on disk that was taken. Idempotent."""
        if self._writes is not None:
            self._hub.holding.look(now=self._now())
        self._closed = True
        self._hub.holding.shelf = None
        self.disk.close()
