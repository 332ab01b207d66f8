"""Keeps durable streams of the hub on disk (`sern_core/relay/holding.py`), and brings back what an earlier run kept."""

import logging
import secrets
import time
from collections.abc import Callable, Sequence

from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName
from sern_core.wire.announce import Announcement, decode_announcement, encode_announcement
from sern_runtime.durable.keeper import Keeps, OpensStore, Stored
from sern_runtime.durable.store import Described, Forget, KeptStream, Place, Put, Row, StoreError

_log = logging.getLogger(__name__)


class DurableHolding:
    """The `Shelf` of a hub. `make_keeper` makes what writes to the store. `known` says whether a client is in the
    directory of keys; `after` is called when something may have to be sent."""

    def __init__(
        self,
        store: OpensStore,
        make_keeper: Callable[[Stored], Keeps],
        hub: Hub,
        *,
        known: Callable[[ClientName], bool],
        now: Callable[[], float],
        after: Callable[[], None],
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._store = store
        self._make_keeper = make_keeper
        self._hub = hub
        self._wall_ns = wall_ns
        self._known = known
        self._now = now
        self._after = after
        self._problem: str | None = None
        self._closed = False
        self.keeper: Keeps | None = None
        """What writes; None: nothing is kept by this process."""
        self.damaged = 0
        """Messages, and other things, that could not be read when the store was opened."""

    @property
    def problem(self) -> str | None:
        """Why nothing is kept at the moment; None: it is."""
        return self._problem or (None if self.keeper is None else self.keeper.problem)

    def start(self) -> None:
        """Begin to write, and bring back what there is; before any client connects. Raises ConfigError. Where the disk
        is full or fails, `problem` says so, and durable topics are for this process what reliable ones are."""
        try:
            contents = self._store.open(new_boot=secrets.randbits(63))
        except StoreError as error:
            self._problem = str(error)
            _log.error("durable topics are not kept by this process: %s; make room and start it again", error)
            return
        self.damaged = len(contents.damage)
        for line in contents.damage:
            _log.error("durable topics: %s", line)
        keeper = self.keeper = self._make_keeper(self._stored)
        waiting = 0
        for found in contents.streams.values():
            for row in found.rows:
                keeper.found(found.id, row.seq, len(row.body))
            waiting += self._restore(found)
        if waiting:
            _log.warning("%d messages of durable topics of an earlier run wait for their clients", waiting)
        self._hub.holding.shelf = self
        keeper.start()

    def _restore(self, found: KeptStream) -> int:
        """Bring back one stream. Returns how many messages wait."""
        try:
            announcement = decode_announcement(found.announcement)
        except WireError as error:
            _log.error("%d messages of %s are lost: %s", len(found.rows), found.id.topic, error)
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
        keeper = self.keeper
        if keeper is None or self._closed or not keeper.has_room(len(message.body)):
            return False
        born_ns = self._wall_ns() - int((now - message.born_s) * 1e9)
        row = Row(message.seq, born_ns, message.stamp_ns, message.body, int(message.codec), message.drop_marker)
        keeper.put(Put(message.stream, row))
        return True

    def trim(self, stream: StreamId, upto: int) -> None:
        if self.keeper is not None and not self._closed:
            self.keeper.trim(stream, upto)

    def place(self, stream: StreamId, client: ClientName, seq: int) -> None:
        self._change(Place(stream, client, seq))

    def forget(self, stream: StreamId) -> None:
        self._change(Forget(stream))

    def _change(self, change: Described | Place | Forget) -> None:
        if self.keeper is not None and not self._closed:
            self.keeper.change(change)

    # --- from the keeper ----------------------------------------------------------------------------------------------

    def _stored(self, puts: Sequence[Put]) -> None:
        if self._closed:
            return
        for stream, seq in {put.stream: put.row.seq for put in puts}.items():
            self._hub.holding.stored(stream, seq)
        self._after()

    def close(self) -> None:
        """Have everything on disk that was taken. Idempotent."""
        if not self._closed and self.keeper is not None:
            self._hub.holding.look(now=self._now())
        self._closed = True
        self._hub.holding.shelf = None
        if self.keeper is not None:
            self.keeper.close()
        else:
            self._store.close()
