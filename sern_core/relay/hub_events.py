"""What the relay's core tells its shell, and what it keeps of each stream."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import ParamSpec, Protocol

from sern_core.link.link import Link
from sern_core.stream.in_stream import InStream
from sern_core.stream.latched import MAX_REPLAY_MESSAGES, LatchedCache, ReplayStore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.key_news import ClientKeys, KeyRevocation
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName


class HubEvents(Protocol):
    """What the relay's shell is told."""

    def client_up(self, client: ClientName, *, resumed: bool) -> None: ...

    def client_down(self, client: ClientName, reason: str) -> None: ...

    def peer_up(self, peer: ClientName) -> None:
        """The session with another relay (`peers.peer_name`) has begun."""

    def peer_down(self, peer: ClientName, reason: str) -> None:
        """It has ended."""

    def went_over(self, client: ClientName, peer: ClientName, *, came: bool) -> None:
        """A client has begun a session here after one at that peer (`came`), or there after one here."""

    def revoked(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        """A peer tells of keys that are to let nobody in any more: have it so, and remember them."""

    def rules_compared(self, peer: ClientName, *, same: bool) -> None:
        """Whether a peer has the access rules of this relay, told when that changes."""

    def stream_added(self, stream: StreamInfo) -> None: ...

    def stream_removed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        """A message passed; the plain feed takes it. Drop markers are not reported."""

    def refused(self, client: ClientName, code: str, text: str) -> None: ...

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None:
        """A client would use a datagram lane: open a session for it and call `Hub.offer_lane`, or do nothing."""

    def lane_closed(self, client: ClientName) -> None:
        """The client's datagram lane ended with its session."""

    def keys_asked(self, client: ClientName) -> None:
        """A client would be told of the relay's keys: call `Hub.tell_keys`, or do nothing."""

    def keys_told(self, client: ClientName, keys: ClientKeys) -> None:
        """A client tells which of them it accepts, and which new one of its own it has."""

    def fault(self, client: ClientName | None, error: Exception) -> None:
        """Something raised what nobody expects, in the core or in one of these methods: log it with its traceback and
        count it. What it was about is given up, everything else goes on. `client`: on whose link, if on one's."""


P = ParamSpec("P")


class GuardedEvents:
    """`HubEvents` whose errors do not come back: what the shell does with news stops nothing in the core."""

    def __init__(self, shell: HubEvents) -> None:
        self.shell = shell
        self.faults = 0

    def fault(self, client: ClientName | None, error: Exception) -> None:
        self.faults += 1
        with suppress(Exception):  # counted above; there is nobody left to tell
            self.shell.fault(client, error)

    def _tell(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> None:
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001  (the shell's, and no reason to leave our own work half done)
            self.fault(None, error)

    def client_up(self, client: ClientName, *, resumed: bool) -> None:
        self._tell(self.shell.client_up, client, resumed=resumed)

    def client_down(self, client: ClientName, reason: str) -> None:
        self._tell(self.shell.client_down, client, reason)

    def peer_up(self, peer: ClientName) -> None:
        self._tell(self.shell.peer_up, peer)

    def peer_down(self, peer: ClientName, reason: str) -> None:
        self._tell(self.shell.peer_down, peer, reason)

    def went_over(self, client: ClientName, peer: ClientName, *, came: bool) -> None:
        self._tell(self.shell.went_over, client, peer, came=came)

    def revoked(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        self._tell(self.shell.revoked, peer, revocations)

    def rules_compared(self, peer: ClientName, *, same: bool) -> None:
        self._tell(self.shell.rules_compared, peer, same=same)

    def stream_added(self, stream: StreamInfo) -> None:
        self._tell(self.shell.stream_added, stream)

    def stream_removed(self, stream: StreamInfo) -> None:
        self._tell(self.shell.stream_removed, stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self._tell(self.shell.message, stream, message, now=now)

    def refused(self, client: ClientName, code: str, text: str) -> None:
        self._tell(self.shell.refused, client, code, text)

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None:
        self._tell(self.shell.lane_asked, client, ciphers)

    def lane_closed(self, client: ClientName) -> None:
        self._tell(self.shell.lane_closed, client)

    def keys_asked(self, client: ClientName) -> None:
        self._tell(self.shell.keys_asked, client)

    def keys_told(self, client: ClientName, keys: ClientKeys) -> None:
        self._tell(self.shell.keys_told, client, keys)


class Relayed:
    """One stream at the relay: where it comes from (None: the relay itself), where it goes, what is kept of it."""

    __slots__ = (
        "cache", "kept_seq", "offered_again", "outs", "refused_by", "source", "stream", "unopened", "waiting",
    )  # fmt: skip

    def __init__(self, source: Link | None, stream: InStream, replays: ReplayStore) -> None:
        self.source = source
        self.stream = stream
        self.outs: dict[ClientName, tuple[Link, OutChannel]] = {}
        self.waiting: dict[ClientName, None] = {}  # subscribers that are still to be told of it, in their order
        self.unopened: set[ClientName] = set()  # subscribers towards whom no channel could be opened; they were told
        self.refused_by: set[ClientName] = set()  # peers that take its client to be elsewhere (`offers_again`)
        self.offered_again: dict[ClientName, int] = {}  # peers that were offered it again, in which epoch of its client
        self.kept_seq = 0  # of the newest message that was looked at for what the relay keeps
        self.cache: LatchedCache | None = None
        self.keep_latched(replays)

    def required(self) -> tuple[ClientName, ...]:
        """Who gets the stream, and who is about to; of a peer those behind it who do."""
        if not any(map(is_peer, self.outs)):
            return tuple(name for name in dict.fromkeys((*self.outs, *self.waiting)) if not is_peer(name))
        names: dict[ClientName, None] = {}
        for name, (_link, channel) in self.outs.items():
            names |= dict.fromkeys(map(ClientName, channel.required) if is_peer(name) else (name,))
        return tuple(names | dict.fromkeys(name for name in self.waiting if not is_peer(name)))

    def keep_latched(self, replays: ReplayStore) -> None:
        """Keep as many messages for late joiners as the stream's properties say by now."""
        spec, old = self.stream.stream.spec, self.cache
        if old is not None and spec.latched and old.depth == min(spec.depth, MAX_REPLAY_MESSAGES):
            return
        self.cache = replays.open(spec.depth) if spec.latched else None
        if old is not None:
            if self.cache is not None:
                for message in old.replay():
                    replays.add(self.cache, message)
            replays.close(old)
