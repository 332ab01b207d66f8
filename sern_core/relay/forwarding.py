"""Messages through the relay: from one link, unchanged, to those of all subscribers. Pure."""

from collections.abc import Callable
from typing import Final

from sern_core.link.link import Link
from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents, Relayed
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.fates import Fates
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import DROP_CODES, ClientName, DropReason

FORWARD_US: Final = 5
"""What its origin is charged with, in microseconds, for handing a message on to a subscriber."""


class Forwarding:
    """Counts what arrives in `received`."""

    def __init__(
        self,
        name: ClientName,
        clients: Clients,
        streams: RelayedStreams,
        objects: ObjectRegistry,
        events: GuardedEvents,
    ) -> None:
        self._name = name
        self._clients = clients
        self._streams = streams
        self._objects = objects
        self._events = events
        self.received = ReceiveLedger()
        self.fates: Fates | None = None
        """Told what becomes of each message here; set before the first client comes."""
        self.hold: Callable[[Relayed, Message, float], None] = lambda _relayed, _message, _now: None
        """Told of messages of durable streams; set by the owner."""

    def message(self, link: Link, stream: InStream, message: Message, now: float) -> None:
        """A message (or drop marker) of a client has its turn."""
        relayed = self._streams.by_id.get(stream.stream.id)
        if relayed is None:
            return
        if relayed.waiting:  # nothing is read before they were told, unless an error of ours came in between
            for client in list(relayed.waiting):
                self._streams.offer(client, stream.stream.id, now, first=message.seq)
        nbytes = len(message.body)
        link.reassembly.work_us += FORWARD_US * len(relayed.outs)
        if not self._clients.admits(link.peer, nbytes, now):
            self._discarded(link, stream, message.seq, DropReason.RATE_CAP)
            if not stream.reliable:
                return
            code = DROP_CODES[DropReason.RATE_CAP]
            message = Message(message.stream, message.seq, bytes([code]), message.stamp_ns, message.born_s, code)
            link.answers.report(stream, message.seq, DropReason.RATE_CAP, self._name)
        elif message.drop_marker:
            self._discarded(link, stream, message.seq, message.drop_reason)
        else:
            self.received.of(stream.stream).arrived(nbytes, now - message.born_s, now)
            if self.fates is not None:
                self.fates.received(stream.stream, message, link.peer)
            if not relayed.outs:
                self._taken_by_nobody(relayed, link, message.seq)
        if self.forward(relayed, message, now) and stream.reliable:
            self._streams.confirm(relayed)

    def _discarded(self, link: Link, stream: InStream, seq: int, reason: DropReason) -> None:
        self.received.of(stream.stream).drop_arrived(reason)
        if self.fates is not None:
            self.fates.discarded(stream.stream, seq, reason, link.peer)

    def _taken_by_nobody(self, relayed: Relayed, link: Link, seq: int) -> None:
        """Who wanted it has left while it was under way. It is dropped, unless it is kept, or read here."""
        stream = relayed.stream
        if relayed.cache is None and not self._streams.tap(stream.stream):
            self._discarded(link, stream, seq, DropReason.UNWANTED)
        elif self.fates is not None:
            self.fates.held(stream.stream, seq, ClientName(""), exposed=False)

    def forward(self, relayed: Relayed, message: Message, now: float) -> bool:
        """Offer a message to all who get it. True: with that, the stream may be delivered further than before."""
        stream = relayed.stream
        behind = not relayed.outs
        for client, (out_link, channel) in relayed.outs.items():
            try:
                if message.seq != channel.next_seq:
                    if message.seq < channel.next_seq:
                        self.received.of(stream.stream).drop_arrived(DropReason.DUPLICATE)  # it has gone that way
                        continue
                    if stream.reliable:  # what lies between was given up before that
                        out_link.outgoing.skip(channel, message.seq, now=now)
                bound = self._clients.bound(client)
                if bound is None:
                    out_link.sender.submit(channel, message, now=now, forced=True)
                else:
                    spent_us = bound.submit(out_link, channel, message, now=now)
                    if relayed.source is not None:
                        relayed.source.reassembly.work_us += spent_us
            except Exception as error:  # noqa: BLE001  (of that client's link: the others get theirs)
                self._not_taken(relayed, out_link, channel, message, error, now)
            behind = behind or channel.watermark >= message.seq
        if stream.reliable:
            self._streams.moves.message(stream.stream.id, message)
        if stream.stream.spec.durable:
            self.hold(relayed, message, now)
        if not message.drop_marker and (message.seq > relayed.kept_seq or relayed.source is None):
            relayed.kept_seq = max(relayed.kept_seq, message.seq)
            self._keep(relayed, message, now)
        return behind

    def _keep(self, relayed: Relayed, message: Message, now: float) -> None:
        """Whatever of the relay itself takes the message."""
        stream = relayed.stream.stream
        try:
            if relayed.cache is not None:
                self._streams.replays.add(relayed.cache, message)
            self._objects.observe(
                stream.id, message.seq, message.body, wall_ns=message.stamp_ns, now=now, codec=message.codec
            )
            self._events.shell.message(stream, message, now=now)
        except Exception as error:  # noqa: BLE001  (the subscribers have it: it must not be taken for lost)
            self._events.fault(stream.id.origin, error)

    def _not_taken(
        self, relayed: Relayed, link: Link, channel: OutChannel, message: Message, error: Exception, now: float
    ) -> None:
        """A client's link failed at a message: its session ends, and unless it has the message, the origin is told."""
        link.failed(error, now=now)
        if channel.next_seq > message.seq:
            return
        try:
            link.sender.reject(channel, message, DropReason.FAULT, now=now)
        except Exception as again:  # noqa: BLE001
            link.fault(again)
            if channel.reliable and relayed.source is not None:
                relayed.source.answers.report(relayed.stream, message.seq, DropReason.FAULT, link.peer)
