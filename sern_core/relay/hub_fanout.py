"""When the relay tells subscribers that a stream came or went: in slices, so that it holds nobody up. Pure.

Every subscriber gets a channel of its own, so one small announcement may cost as much as thousands of messages. What it
costs is charged to who announced it (`Reassembly.work_us`). Beyond a slice, subscribers wait: nothing more is read from
that peer until they have been told, so that every one of them gets the stream from its first message on, and in the
order in which the peer announced its streams. The first announcement of a process that was started anew ends all that
the one before had: those channels are closed in slices too, and first.
"""

from collections.abc import Callable, Sequence

from sern_core.link.link import Link
from sern_core.relay.hub_events import Relayed
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName

Ending = tuple[Link, OutChannel]


class Fanout:
    """Streams that some subscribers are still to be told of, by who announced them: a client its own, another relay
    those of its clients. Who they are is in `Relayed.waiting`, and only
    there: whoever leaves, or wants the stream no more, is taken out of it.

    `offer` opens a channel, in place of the one there may be; `told` is called after the last subscriber of a stream;
    `end` closes the channel of a stream that has ended.
    """

    def __init__(
        self,
        offer: Callable[[ClientName, StreamId, float], None],
        told: Callable[[Relayed, float], None],
        end: Callable[[ClientName, Link, OutChannel, float], None],
    ) -> None:
        self._offer = offer
        self._told = told
        self._end = end
        self._ending: dict[ClientName, dict[StreamId, dict[ClientName, Ending]]] = {}  # by who announced it
        self._beginning: dict[ClientName, dict[StreamId, Relayed]] = {}
        self._ended_by: dict[StreamId, ClientName] = {}  # whose `_ending` a stream is in
        self._begun_by: dict[StreamId, ClientName] = {}  # and whose `_beginning`

    def begin(self, relayed: Relayed, clients: Sequence[ClientName], announcer: ClientName) -> None:
        """These subscribers are to be told of the stream; `go_on` for the announcer's link does it."""
        if clients:
            identity = relayed.stream.stream.id
            if self._begun_by.get(identity, announcer) != announcer:
                self._drop(identity)
            relayed.waiting.update(dict.fromkeys(clients))
            self._beginning.setdefault(announcer, {})[identity] = relayed
            self._begun_by[identity] = announcer

    def _drop(self, identity: StreamId) -> None:
        """The stream has no turn any more."""
        announcer = self._begun_by.pop(identity, None)
        if announcer is not None:
            streams = self._beginning[announcer]
            del streams[identity]
            if not streams:
                del self._beginning[announcer]

    def go_on(self, link: Link, *, now: float) -> bool:
        """One slice for the streams of a peer, as far as its account allows. True: nobody waits any more."""
        reassembly, limits = link.reassembly, link.reassembly.limits
        ending = self._ending.get(link.peer)
        while ending:
            if reassembly.work_us > reassembly.slice_us:
                return False
            reassembly.work_us += limits.close_us
            identity, outs = next(iter(ending.items()))
            self.close(next(iter(outs)), identity, now=now)
        while streams := self._beginning.get(link.peer):
            identity, relayed = next(iter(streams.items()))
            while relayed.waiting:
                if reassembly.work_us > reassembly.slice_us:
                    return False
                reassembly.work_us += limits.channel_us
                client = next(iter(relayed.waiting))
                del relayed.waiting[client]
                self._offer(client, identity, now)
            self._drop(identity)
            self._told(relayed, now)
        return True

    def close_later(self, relayed: Relayed, announcer: ClientName) -> None:
        """The stream has ended, as who announced it says: its channels are closed in their turn, before anything that
        begins after it."""
        identity = relayed.stream.stream.id
        if relayed.outs:
            announcer = self._ended_by.setdefault(identity, announcer)
            self._ending.setdefault(announcer, {}).setdefault(identity, {}).update(relayed.outs)

    def close(self, client: ClientName, identity: StreamId, *, now: float) -> None:
        """Close the channel of an ended stream now, if it waits for that."""
        announcer = self._ended_by.get(identity)
        if announcer is None:
            return
        ending = self._ending[announcer]
        pair = ending[identity].pop(client, None)
        if not ending[identity]:
            del ending[identity], self._ended_by[identity]
            if not ending:
                del self._ending[announcer]
        if pair is None:
            return
        link, channel = pair
        if link.sender.channels.get(channel.channel_id) is channel:  # else the client has gone meanwhile
            self._end(client, link, channel, now)

    def forget(self, announcer: ClientName, *, now: float) -> None:
        """It is gone for good, and nothing more is read from it: close now what waits."""
        for identity, outs in list(self._ending.get(announcer, {}).items()):
            for client in list(outs):
                self.close(client, identity, now=now)

    def end(self, relayed: Relayed) -> None:
        """The stream has ended: nobody is told of it any more."""
        relayed.waiting.clear()
        self._drop(relayed.stream.stream.id)

    def announcers(self) -> list[ClientName]:
        return list(self._beginning | self._ending)

    def closing(self) -> set[int]:
        """The identities of channels that wait to be closed; for tests."""
        streams = [outs for ending in self._ending.values() for outs in ending.values()]
        return {id(channel) for outs in streams for _link, channel in outs.values()}

    def holds(self, relayed: Relayed) -> bool:
        """Whether the stream has a turn; for tests."""
        return relayed.stream.stream.id in self._begun_by
