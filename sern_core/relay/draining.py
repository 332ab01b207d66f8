"""Channels of streams that have ended while a client was still to get reliable messages of them. Pure.

They go on until the client has confirmed everything, within bounds for each client. Whatever else would end them ends
them as well: the right to the stream, the interest in it, the client itself, and another stream of the same name.
"""

from collections.abc import Callable, Mapping
from typing import Final

from sern_core.link.link import Link
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason

MAX_DRAINING_BYTES: Final = 32 * 2**20
"""Bytes of one client that wait in them, overhead included."""

Close = Callable[[ClientName, Link, OutChannel, DropReason, float], None]


class Draining:
    """`close` ends a channel: its messages are dropped for a reason, and the client is told that the stream is gone."""

    def __init__(self, close: Close, limits: PeerLimits) -> None:
        self._close = close
        self._most = limits.draining
        self._by_client: dict[ClientName, dict[StreamId, tuple[Link, OutChannel]]] = {}  # the longest ended first

    def __len__(self) -> int:
        return sum(map(len, self._by_client.values()))

    def add(self, client: ClientName, link: Link, channel: OutChannel, *, max_bytes: int | None, now: float) -> None:
        """A stream has ended. `max_bytes`: what may wait for the client at all, None: no limit of its own."""
        self._by_client.setdefault(client, {})[channel.stream.id] = (link, channel)
        self.limit(client, max_bytes, now=now)

    def limit(self, client: ClientName, max_bytes: int | None, *, now: float) -> None:
        """Keep to the bounds, now that they or what waits have changed."""
        entries = self._by_client.get(client)
        if entries is None:
            return
        bound_bytes = MAX_DRAINING_BYTES if max_bytes is None else min(max_bytes, MAX_DRAINING_BYTES)
        held_bytes = sum(_held_bytes(channel) for _link, channel in entries.values())
        for identity, (_link, channel) in list(entries.items()):
            if len(entries) <= self._most and held_bytes <= bound_bytes:
                return
            held_bytes -= _held_bytes(channel)
            self._end(client, identity, DropReason.QUEUE_FULL, now)

    def take(self, client: ClientName, stream: StreamInfo, first: int, *, now: float) -> tuple[Link, OutChannel] | None:
        """The channel to go on with when a stream comes back before it is gone; its next message is seq `first` or
        later. With another type, other properties or another count it is another stream: what was left is given up."""
        held = self._by_client.get(client, {}).get(stream.id)
        if held is None:
            return None
        channel = held[1]
        if _same(channel.stream, stream) and channel.next_seq <= first:
            self._pop(client, stream.id)
            return held
        self._end(client, stream.id, DropReason.DISCONNECTED, now)
        return None

    def sweep(self, *, now: float) -> None:
        """Let go of what is delivered."""
        for client, entries in list(self._by_client.items()):
            for identity, (_link, channel) in list(entries.items()):
                if not channel.retained:
                    self._end(client, identity, DropReason.DISCONNECTED, now)

    def keep(self, rule: Callable[[ClientName, StreamId], bool], reason: DropReason, *, now: float) -> None:
        """Give up for `reason` what the rule does not keep."""
        for client, entries in list(self._by_client.items()):
            for identity in [identity for identity in entries if not rule(client, identity)]:
                self._end(client, identity, reason, now)

    def channels(self, stream: StreamId) -> dict[ClientName, OutChannel]:
        """The channels of an ended stream, by client."""
        return {client: entries[stream][1] for client, entries in self._by_client.items() if stream in entries}

    def has(self, client: ClientName) -> bool:
        return client in self._by_client

    def forget(self, client: ClientName) -> None:
        """The client's link is gone, and its channels with it."""
        self._by_client.pop(client, None)

    def _pop(self, client: ClientName, identity: StreamId) -> tuple[Link, OutChannel]:
        entries = self._by_client[client]
        held = entries.pop(identity)
        if not entries:
            del self._by_client[client]
        return held

    def _end(self, client: ClientName, identity: StreamId, reason: DropReason, now: float) -> None:
        link, channel = self._pop(client, identity)
        self._close(client, link, channel, reason, now)

    def validate(self, links: Mapping[ClientName, Link]) -> set[int]:
        """Internal consistency, for tests. Returns the identities of the channels."""
        channels = set()
        for client, entries in self._by_client.items():
            assert 0 < len(entries) <= self._most, f"{client}: {len(entries)} channels drain"
            assert sum(_held_bytes(channel) for _link, channel in entries.values()) <= MAX_DRAINING_BYTES, client
            for identity, (link, channel) in entries.items():
                assert links.get(client) is link, f"{identity.topic} drains towards a link that is gone"
                assert link.sender.channels.get(channel.channel_id) is channel, (
                    f"{identity.topic}: a closed channel drains"
                )
                assert channel.reliable and channel.stream.id == identity, f"{identity.topic} is not to be drained"
                channels.add(id(channel))
        return channels


def _held_bytes(channel: OutChannel) -> int:
    """What counts against the bound. What is on disk as well has a bound there, and was promised."""
    return 0 if channel.spec.durable else channel.retained_bytes + MESSAGE_OVERHEAD_BYTES * len(channel.retained)


def _same(one: StreamInfo, other: StreamInfo) -> bool:
    return (
        one.info == other.info
        and one.spec == other.spec
        and one.definition_hash == other.definition_hash
        and one.attributes == other.attributes
    )
