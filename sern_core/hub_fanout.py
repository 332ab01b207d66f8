"""When the relay tells subscribers of a stream: in slices, so that one announcement for many holds nobody up. Pure.

Every subscriber gets a channel of its own, so one small announcement may cost as much as thousands of messages. What it
costs is charged to who announced it (`Reassembly.work_us`). Beyond a slice, subscribers wait: nothing more is read from
that peer until they have been told, so that every one of them gets the stream from its first message on, and in the
order in which the peer announced its streams.
"""

from collections.abc import Callable, Sequence
from typing import Final

from sern_core.fragments import SLICE_US
from sern_core.hub_events import Relayed
from sern_core.link import Link
from sern_core.message import StreamId
from sern_core.types import ClientName

CHANNEL_US: Final = 80
"""What a peer is charged with for each channel that is opened or closed for it, in microseconds."""


class Fanout:
    """Streams that some subscribers are still to be told of, by origin. Who they are is in `Relayed.waiting`, and only
    there: whoever leaves, or wants the stream no more, is taken out of it.

    `offer` opens a channel, in place of the one there may be; `told` is called after the last subscriber of a stream.
    """

    def __init__(
        self, offer: Callable[[ClientName, StreamId, float], None], told: Callable[[Relayed, float], None]
    ) -> None:
        self._offer = offer
        self._told = told
        self._by_origin: dict[ClientName, dict[StreamId, Relayed]] = {}

    def __len__(self) -> int:
        return sum(map(len, self._by_origin.values()))

    def begin(self, relayed: Relayed, clients: Sequence[ClientName]) -> None:
        """These subscribers are to be told of the stream; `go_on` does it."""
        if clients:
            relayed.waiting.update(dict.fromkeys(clients))
            identity = relayed.stream.stream.id
            self._by_origin.setdefault(identity.origin, {})[identity] = relayed

    def go_on(self, link: Link, *, now: float) -> bool:
        """One slice for the streams of a peer, as far as its account allows. True: nobody waits any more."""
        reassembly = link.reassembly
        streams = self._by_origin.get(link.peer)
        while streams:
            identity, relayed = next(iter(streams.items()))
            while relayed.waiting:
                if reassembly.work_us > SLICE_US:
                    return False
                reassembly.work_us += CHANNEL_US
                client = next(iter(relayed.waiting))
                del relayed.waiting[client]
                self._offer(client, identity, now)
            del streams[identity]
            self._told(relayed, now)
        self._by_origin.pop(link.peer, None)
        return True

    def end(self, relayed: Relayed) -> None:
        """The stream has ended: nobody is told of it any more."""
        relayed.waiting.clear()
        identity = relayed.stream.stream.id
        streams = self._by_origin.get(identity.origin, {})
        if streams.get(identity) is relayed:
            del streams[identity]
            if not streams:
                del self._by_origin[identity.origin]

    def origins(self) -> list[ClientName]:
        return list(self._by_origin)

    def holds(self, relayed: Relayed) -> bool:
        """Whether the stream has a turn; for tests."""
        identity = relayed.stream.stream.id
        return self._by_origin.get(identity.origin, {}).get(identity) is relayed
