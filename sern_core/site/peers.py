"""What a client knows of its peers, the clients whose streams it takes: are they there? Pure.

The relay tells of each peer whether it can be reached (`sern_core/relay/presence.py`), the streams tell when something
of it came last, and the client's own link says whether any of that is still to be believed: while it is down nobody
knows, and ages grow. A peer that is gone for longer than the relay waits is given up there, with its streams. Here it
stays as one that is gone, until it is back: nobody else would still say that it is missing. A new session asks the
relay whether its peers are here; one that was connected before, and is not, is given up after LET_GO_S. A peer is
forgotten when this site wants none of the topics any more that it had here, or when the relay does not say.
"""

from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple

from sern_core.topics.patterns import PatternError, PatternSet
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_ASKED
from sern_core.wire.peer_states import PeerState, peer_states

LET_GO_S: Final = 60.0
"""A peer of which the relay of a new session says nothing for so long, and that has no stream here, is forgotten."""
MAX_PEERS: Final = 4096
"""Peers that a relay may tell of; no honest one has as many. The one given up longest ago makes way for another."""
MAX_GIVEN_UP: Final = 64
"""Peers that are gone for good, as far as anybody knows, and are still shown. The relay is asked of them in each
session."""
MAX_ENDED: Final = 256
"""Topics of one peer that ended here while it was gone, and that are remembered."""


class PeerStatus(StrEnum):
    """`connected`: the relay reaches it; `gone`: the relay has lost it; `unknown`: our own link is down, or the relay
    does not say."""

    CONNECTED = "connected"
    GONE = "gone"
    UNKNOWN = "unknown"


class PeerView(NamedTuple):
    """A peer at one time. `age_s`: since the last message of it came here; None: none has. `since_s`: for how long its
    status has been so. `rtt_s`: round trip between it and the relay, and `lane` its lane there, as far as known.
    `given_up`: it was gone when the relay spoke of it last, and the relay waits for it no longer."""

    name: ClientName
    status: PeerStatus
    since_s: float
    age_s: float | None
    rtt_s: float | None
    lane: str
    given_up: bool = False


class PeerChange(NamedTuple):
    """A peer's status is another one, after `lasted_s` of the one before; or it is what it was, and the relay has given
    the peer up (`given_up`), or nothing of it is taken here any more (`forgotten`). `old` None: it is a new peer."""

    name: ClientName
    old: PeerStatus | None
    new: PeerStatus
    lasted_s: float
    given_up: bool = False
    forgotten: bool = False


class _Peer:
    __slots__ = ("absent", "absent_s", "given_up", "lane", "lost", "rtt_s", "since_s", "status", "up", "up_since_s")

    def __init__(self, since_s: float) -> None:
        self.status = PeerStatus.UNKNOWN
        self.since_s = since_s
        self.up: bool | None = None  # what the relay said last; None: nothing since the session began
        self.up_since_s = since_s
        self.lane = ""
        self.rtt_s: float | None = None
        self.lost = False  # what any relay said last is that it does not reach it
        self.absent = False  # nobody said so, but the relay that we have now does not have it
        self.absent_s: float | None = None  # since when, in whatever sessions, nothing else was said
        self.given_up = False


class Peers:
    """`on_change` is told of every peer whose status changes, that comes, that is given up, and that is forgotten. Of
    one that makes way for another nothing is said: it is still gone."""

    def __init__(self) -> None:
        self.on_change: Callable[[PeerChange], None] = lambda _change: None
        self.moved: set[ClientName] = set()
        """Those that have gone from our relay to another one, and said so."""
        self._peers: dict[ClientName, _Peer] = {}
        self._streams: Counter[ClientName] = Counter()  # open here, by origin
        self._ended: dict[ClientName, dict[TopicName, None]] = {}  # its topics that ended while it was gone
        self._patterns: tuple[str, ...] | None = None  # what this site wants; None: nobody has said
        self._wants: PatternSet | None = None  # the same, once somebody asked
        self._heard_s: dict[ClientName, float] = {}
        self._session_s = 0.0
        self._session = False
        self._believed = False  # the relay answers, so what it said last holds

    def session_began(self, *, now: float) -> None:
        """The relay will tell of each peer anew."""
        self._session = self._believed = True
        self._session_s = now

    def session_ended(self, *, now: float) -> None:
        """Nobody knows of any peer any more."""
        self._session = False
        self.moved.clear()
        for peer in self._peers.values():
            peer.up, peer.absent = None, False
        self.reached(False, now=now)

    def reached(self, answers: bool, *, now: float) -> None:
        """Whether the relay answers. While it does not, what it said last may not hold any more."""
        self._believed = answers
        for name, peer in self._peers.items():
            self._settle(name, peer, now)

    def opened(self, origin: ClientName, *, now: float) -> None:
        """A stream of `origin` is open here."""
        self._streams[origin] += 1
        self._known(origin, now)

    def closed(self, origin: ClientName, topic: TopicName, *, now: float) -> None:
        """A stream of `origin` has ended here."""
        self._streams[origin] -= 1
        if not self._streams[origin]:
            del self._streams[origin]
        peer = self._peers.get(origin)
        if peer is not None and not peer.up:
            ended = self._ended.setdefault(origin, {})
            while len(ended) >= MAX_ENDED:
                del ended[next(iter(ended))]
            ended[topic] = None
            self._unwanted(origin, peer, now)

    def subscribed(self, patterns: tuple[str, ...], *, now: float) -> None:
        """This site wants the topics that these match, and none of what it wanted before: a peer that is given up and
        had nothing else here is forgotten."""
        self._patterns, self._wants = patterns, None
        for name, peer in list(self._peers.items()):
            self._unwanted(name, peer, now)

    def _unwanted(self, name: ClientName, peer: _Peer, now: float) -> None:
        if peer.given_up and name not in self._streams and not self._wanted(name):
            self._forget(name, now)

    def _wanted(self, name: ClientName) -> bool:
        """Whether this site still wants a topic that a lost peer had here; True where it is not known what it had."""
        if self._patterns is None:
            return True
        topics = self._ended.get(name)
        if not topics or not self._patterns:
            return bool(self._patterns)
        if self._wants is None:
            try:
                self._wants = PatternSet(self._patterns)
            except PatternError:  # nor does the relay take them: what was wanted before stays
                return True
        return any(map(self._wants.fullmatch, topics))

    def asked(self) -> list[ClientName]:
        """Those of whom a new session asks. At most MAX_ASKED: before others those that were gone when any relay spoke
        of them last, and of these the ones that were given up last."""
        names = [name for name, peer in self._peers.items() if not peer.lost]
        names += [name for name, peer in self._peers.items() if peer.lost]
        return names[-MAX_ASKED:]

    def arrived(self, origin: ClientName, *, now: float) -> None:
        """A message of `origin` came."""
        self._heard_s[origin] = now

    def told(self, envelope: framing.Envelope, *, now: float) -> None:
        """The relay's `peers` message. Raises WireError for one that no honest relay sends."""
        for state in peer_states(envelope):
            self._told(state, now)

    def _told(self, state: PeerState, now: float) -> None:
        name, up = state.name, state.up
        if up is None:  # we take nothing of it any more
            self.moved.discard(name)
            if name in self._peers:
                self._let_go(name, self._peers[name], state.here, now)
            return
        if name not in self._peers and len(self._peers) >= MAX_PEERS and not self._make_way():
            raise WireError(f"the relay tells of more than {MAX_PEERS} peers")
        peer = self._known(name, now)
        if peer.up is not up:
            peer.up, peer.up_since_s = up, now - state.for_s
        peer.lost, peer.absent, peer.absent_s, peer.given_up = not up, False, None, False
        if up:
            self._ended.pop(name, None)
        peer.rtt_s, peer.lane = state.rtt_s, state.lane
        if state.moved and not up:
            self.moved.add(name)
        else:
            self.moved.discard(name)
        self._settle(name, peer, now)

    def _known(self, name: ClientName, now: float) -> _Peer:
        peer = self._peers.get(name)
        if peer is None:
            peer = self._peers[name] = _Peer(now)
            self.on_change(PeerChange(name, None, PeerStatus.UNKNOWN, 0.0))
        return peer

    def _settle(self, name: ClientName, peer: _Peer, now: float) -> None:
        """Give a peer the status that follows from what is known."""
        if peer.up is None or not self._believed:
            status, since_s = PeerStatus.UNKNOWN, now
        else:
            status, since_s = PeerStatus.CONNECTED if peer.up else PeerStatus.GONE, peer.up_since_s
        if status is not peer.status:
            old, lasted_s = peer.status, now - peer.since_s
            peer.status, peer.since_s = status, since_s
            self.on_change(PeerChange(name, old, status, lasted_s))

    def _let_go(self, name: ClientName, peer: _Peer, here: bool | None, now: float) -> None:
        """We take nothing of it at the relay, where it is or is not. None: an older one does not say; who was gone is
        gone as far as we know."""
        if peer.lost and not here and self._wanted(name):
            self._give_up(name, peer, now)
            return
        if peer.lost and here:  # that it is back is said before it is forgotten
            peer.up, peer.up_since_s = True, now
            peer.lost = peer.given_up = False
            self._ended.pop(name, None)
            self._settle(name, peer, now)
        if here is False and peer.up is None:  # a relay that has just begun may hear of it yet: see `look`
            peer.absent_s = now if peer.absent_s is None else peer.absent_s
            peer.absent, peer.up_since_s = True, peer.absent_s
            return
        peer.up, peer.absent, peer.absent_s = None, False, None
        if name not in self._streams:
            self._forget(name, now)

    def _give_up(self, name: ClientName, peer: _Peer, now: float) -> None:
        peer.up = False
        if peer.given_up:
            self._settle(name, peer, now)
            return
        peer.lost = peer.given_up = True
        self._peers[name] = self._peers.pop(name)  # last: the one given up longest ago is the first of them
        if sum(other.given_up for other in self._peers.values()) > MAX_GIVEN_UP:
            self._make_way()
        self._settle(name, peer, now)
        self.on_change(PeerChange(name, peer.status, peer.status, now - peer.up_since_s, given_up=True))

    def _make_way(self) -> bool:
        """Forget the peer that was given up longest ago; whether there was one."""
        for name, peer in self._peers.items():
            if peer.given_up and name not in self._streams:
                self._drop(name)
                return True
        return False

    def _forget(self, name: ClientName, now: float) -> None:
        peer = self._peers[name]
        self._drop(name)
        self.on_change(PeerChange(name, peer.status, peer.status, now - peer.since_s, forgotten=True))

    def _drop(self, name: ClientName) -> None:
        del self._peers[name]
        self._heard_s.pop(name, None)
        self._ended.pop(name, None)

    def look(self, *, now: float) -> list[PeerView]:
        """All peers by name. Lets go of those that nothing speaks of any more."""
        for name in list(self._peers) if self._session else ():
            peer = self._peers.get(name)  # None: it has made way for one before it
            if peer is None or peer.up is not None:
                continue
            since_s = peer.up_since_s if peer.absent else self._session_s
            if now - since_s <= LET_GO_S:
                continue
            if peer.absent and self._wanted(name):
                self._give_up(name, peer, now)
            elif name not in self._streams:
                self._forget(name, now)
        return [self._view(name, peer, now) for name, peer in sorted(self._peers.items())]

    def _view(self, name: ClientName, peer: _Peer, now: float) -> PeerView:
        heard_s = self._heard_s.get(name)
        age_s = None if heard_s is None else max(0.0, now - heard_s)
        return PeerView(name, peer.status, max(0.0, now - peer.since_s), age_s, peer.rtt_s, peer.lane, peer.given_up)
