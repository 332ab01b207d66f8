"""Durable streams at the relay: on disk until every client that is to get them has them. Pure.

The shell keeps what it is given (`Shelf`) and says later how far that is on disk (`stored`). Then the origin is told,
and may forget it. What an earlier run of the relay has kept goes into channels like those of streams that have ended
(`draining`): they wait for their client, and for their origin, which goes on with them.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol

from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import Relayed
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName

IDLE_S: Final = 3600.0
"""How long it is remembered how far a stream was stored that has no origin and waits for nobody: its origin may come
back, and send again what it does not know to be stored."""


class Shelf(Protocol):
    """What keeps messages on disk, in the order in which it is told."""

    def describe(self, stream: StreamInfo, definition: str, last: int) -> None:
        """What a stream is; it has had messages up to seq `last`."""

    def put(self, message: Message, *, now: float) -> bool:
        """Keep a message. False: there is no room."""

    def trim(self, stream: StreamId, upto: int) -> None:
        """Everybody has everything up to that seq."""

    def place(self, stream: StreamId, client: ClientName, seq: int) -> None:
        """That client has everything up to `seq`."""

    def forget(self, stream: StreamId) -> None:
        """The stream is gone, and nobody is to get anything of it."""


@dataclass(slots=True)
class _Held:
    """One stream. `stored`: on disk up to this seq. `put`: given to the shelf up to here. `left_out`: the last that had
    no room; nothing more is put until everybody has it. `text`: the hash of the definition that the shelf has."""

    stream: StreamInfo
    stored: int
    put: int
    left_out: int = 0
    trimmed: int = 0
    text: str = ""
    idle_since_s: float | None = None
    places: dict[ClientName, int] = field(default_factory=dict)


class Holding:
    """`text_of` has the text of a definition by its hash, "" while it is not known."""

    def __init__(self, clients: Clients, streams: RelayedStreams, text_of: Callable[[str], str]) -> None:
        self._clients = clients
        self._streams = streams
        self._text_of = text_of
        self._held: dict[StreamId, _Held] = {}
        self.shelf: Shelf | None = None
        """Where things are kept; set by the shell. None: durable streams are relayed as other reliable ones."""

    def __len__(self) -> int:
        return len(self._held)

    def position(self, stream: StreamId) -> int:
        """The seq up to which a stream is on disk; 0: nothing is."""
        held = self._held.get(stream)
        return 0 if held is None else held.stored

    def message(self, relayed: Relayed, message: Message, now: float) -> None:
        """A message of a durable stream has gone to all who are to get it: keep it."""
        shelf = self.shelf
        if shelf is None or not relayed.outs:
            return
        stream = relayed.stream.stream
        held = self._held.get(stream.id)
        if held is None:
            held = self._held[stream.id] = _Held(stream, message.seq - 1, message.seq - 1)
        if held.text != stream.definition_hash or held.stream is not stream:
            self._describe(shelf, held, stream)
        if held.left_out:
            behind = min(channel.watermark for _link, channel in relayed.outs.values())
            if behind < held.left_out:
                held.left_out = message.seq
                return
            held.left_out = 0
        for client, (_link, channel) in relayed.outs.items():
            if client not in held.places:
                held.places[client] = min(channel.watermark, message.seq - 1)
                shelf.place(stream.id, client, held.places[client])
        if shelf.put(message, now=now):
            held.put = message.seq
        else:
            held.left_out = message.seq

    def _describe(self, shelf: Shelf, held: _Held, stream: StreamInfo) -> None:
        text = self._text_of(stream.definition_hash)
        held.stream = stream
        held.text = stream.definition_hash if text else ""
        shelf.describe(stream, text, held.put)

    def stored(self, stream: StreamId, seq: int) -> None:
        """Messages up to `seq` are on disk: the origin may forget them."""
        held = self._held.get(stream)
        if held is None:
            return
        held.stored = max(held.stored, seq)
        relayed = self._streams.by_id.get(stream)
        if relayed is not None:
            self._streams.confirm(relayed)

    def owes(self, client: ClientName) -> bool:
        """Whether something durable waits for the client: it is not given up."""
        link = self._clients.links.get(client)
        channels: Iterable[OutChannel] = () if link is None else link.sender.channels.values()
        return any(channel.spec.durable and channel.retained for channel in channels)

    def went(self, client: ClientName) -> None:
        """A client has gone: have it on disk how far it is, so that it gets nothing twice if this relay ends, too."""
        if self.shelf is None:
            return
        for identity, held in self._held.items():
            channel = self._channels(identity).get(client)
            if channel is not None:
                self._place(self.shelf, identity, held, client, channel)

    def _channels(self, identity: StreamId) -> dict[ClientName, OutChannel]:
        """Those of the clients that are to get a stream."""
        channels = self._streams.draining.channels(identity)
        relayed = self._streams.by_id.get(identity)
        if relayed is not None:
            channels |= {client: channel for client, (_link, channel) in relayed.outs.items()}
        return channels

    @staticmethod
    def _place(shelf: Shelf, identity: StreamId, held: _Held, client: ClientName, channel: OutChannel) -> None:
        if held.places.get(client) != channel.watermark:
            held.places[client] = channel.watermark
            shelf.place(identity, client, channel.watermark)

    def look(self, *, now: float) -> None:
        """Let go of what everybody has. Call about once a second."""
        shelf = self.shelf
        if shelf is None:
            return
        for identity, held in list(self._held.items()):
            relayed = self._streams.by_id.get(identity)
            channels = self._channels(identity)
            for client, channel in channels.items():
                self._place(shelf, identity, held, client, channel)
            for client in held.places.keys() - channels.keys():
                del held.places[client]
            upto = min(held.places.values(), default=held.put)
            if upto > held.trimmed:
                held.trimmed = upto
                shelf.trim(identity, upto)
            if relayed is not None or channels:
                held.idle_since_s = None
            elif held.idle_since_s is None:
                held.idle_since_s = now
            elif now - held.idle_since_s > IDLE_S:
                del self._held[identity]
                shelf.forget(identity)

    def restore(
        self,
        stream: StreamInfo,
        definition: str,
        last: int,
        messages: Sequence[Message],
        places: dict[ClientName, int],
        *,
        now: float,
    ) -> int:
        """Take in what an earlier run has kept of a stream, which had messages up to seq `last`; before any client is
        there. `places`: how far each of the clients is that are to get it, and that there still are. Returns how many
        messages wait, each counted for each client."""
        held = self._held[stream.id] = _Held(stream, last, last, text=stream.definition_hash if definition else "")
        waiting = 0
        for client, place in places.items():
            mine = [message for message in messages if message.seq > place]
            if not mine:
                continue
            link = self._clients.link(client, now)
            told = replace(stream, info=replace(stream.info, definition=definition))
            try:
                channel = link.outgoing.open(told, first=mine[0].seq, now=now)
            except UsageError:
                continue  # there were too many streams for the client then, too
            channel.stream = stream  # as its origin will announce it
            for message in mine:
                if message.seq > channel.next_seq:
                    link.outgoing.skip(channel, message.seq, now=now)
                link.sender.submit(channel, message, now=now, forced=True)
            if last >= channel.next_seq:
                link.outgoing.skip(channel, last + 1, now=now)
            held.places[client] = place
            waiting += len(mine)
            self._streams.draining.add(client, link, channel, max_bytes=None, now=now)
        return waiting
