"""Streams that a peer has refused because it took their client to be elsewhere, and is offered again. Pure.

When two relays meet after one was started again, each tells of the clients that it has had last, and announces its
streams. A client that had come back before they met was at the other one with a greater epoch: its streams are refused,
its session ends, and with the next one this relay has the greatest epoch. From then on the peer would take them.
"""

from collections.abc import Callable, Iterable
from typing import Final, Protocol

from sern_core.relay.hub_events import Relayed
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName

NOT_THERE: Final = "origin"
"""The code of that refusal."""


class OfferedStreams(Protocol):
    """What is needed of `RelayedStreams`."""

    by_id: dict[StreamId, Relayed]

    def offer(self, client: ClientName, identity: StreamId, now: float) -> None:
        """Open a channel, in place of the one there may be."""


class OffersAgain:
    """`epoch` is that of a client that is here, and 0 of any other."""

    def __init__(self, streams: OfferedStreams, epoch: Callable[[ClientName], int]) -> None:
        self._streams = streams
        self._epoch = epoch

    def refused(self, peer: ClientName, channel: OutChannel, *, now: float) -> None:
        """A peer takes the client of a stream to be elsewhere. If it is here the peer may have been told so meanwhile:
        once in an epoch it is offered again at once."""
        identity = channel.stream.id
        relayed = self._streams.by_id.get(identity)
        if relayed is None or relayed.outs.get(peer, (None, None))[1] is not channel:
            return
        if relayed.offered_again.get(peer, 0) < self._epoch(identity.origin):
            self._offer(peer, relayed, now)
        else:
            relayed.refused_by.add(peer)

    def came(self, identities: Iterable[StreamId], *, now: float) -> None:
        """The client of these streams has begun a session here, and the peers have been told."""
        for identity in identities:
            relayed = self._streams.by_id[identity]
            for peer in sorted(relayed.refused_by & relayed.outs.keys()):
                self._offer(peer, relayed, now)
            relayed.refused_by.clear()

    def _offer(self, peer: ClientName, relayed: Relayed, now: float) -> None:
        identity = relayed.stream.stream.id
        relayed.offered_again[peer] = self._epoch(identity.origin)
        self._streams.offer(peer, identity, now)
