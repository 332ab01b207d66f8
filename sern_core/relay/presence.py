"""Whether the clients whose streams a client takes can be reached now: the relay's half. Pure.

A client that asked (`peers` in its `subscribe`) is told of each of these, its *peers*: whether it is connected and
answers, for how long that has been so, over which lane, and how long a round trip takes between it and the relay.
`sern_core/site/peers.py` is the client's half. Of who takes its own streams a client is not told: a robot on a thin
link would pay for every curious onlooker.

A peer whose last stream has ended is one no more. The client is told whether it is *here*, which is whether it has a
session: a robot that is gone is given up, one that is here has nothing for the client any more. Of those that were not
here it is told once they are, and it may ask of those that it knows from an earlier session.

Another relay asks as a client does, and is told of the clients that are here. What it says of those that are there goes
on to whoever asked here, with the round trip between the two relays added.

What is told travels as control messages, so that bulk cannot hold it up, and is bounded by what there is to know: of
each peer only its latest state waits, and nothing is said before the client has acknowledged what was said last.
"""

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping
from functools import partial
from math import ceil
from typing import Final, NamedTuple, Protocol

from sern_core.link.view import LinkView
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_ASKED
from sern_core.wire.peer_states import PeerState, peer_states

MAX_TOLD: Final = 24
"""Peers in one message: an envelope holds 4 KiB."""
BACK_PAUSE_S: Final = 5.0
"""A client that is here again has so long to say what it has, before a client that looks for it is told that it has
nothing there: that one would end what it shows of it, and begin again."""
RTT_CHANGE: Final = 0.25
RTT_CHANGE_S: Final = 0.005
RTT_PAUSE_S: Final = 2.0
"""A round trip is told anew when it has changed by more than this share and so many seconds, and no sooner than after
this pause: for people, who do not read milliseconds."""


class PeerControl(Protocol):
    """The control messages to a client."""

    @property
    def acked_seq(self) -> int:
        """The number of the last one up to which the client has acknowledged all."""

    def send(self, envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int: ...


class PeerLink(Protocol):
    """What is looked at of a client's link, and how the client is told."""

    def observe(self, *, now: float) -> LinkView: ...

    @property
    def established(self) -> bool: ...

    @property
    def moved(self) -> bool: ...

    @property
    def control(self) -> PeerControl: ...


class _State(NamedTuple):
    """A client as the relay sees it; `rtt_s` is the one that was told last, and when."""

    up: bool
    since_s: float
    lane: str
    rtt_s: float | None
    rtt_at_s: float
    moved: bool
    """It has gone to another relay, and said so."""


class _There(NamedTuple):
    """What a peer relay says of a client of its own: `since_s` by our clock."""

    relay: ClientName
    state: PeerState
    since_s: float


class _Watcher:
    """A client that asked, and the peers of which it is still to be told something. `seq`: of what it was told last.
    `missing`: who was not here when it looked for it, the latest last; `back`: who of them is, and since when."""

    __slots__ = ("back", "due", "missing", "seq")

    def __init__(self) -> None:
        self.due: set[ClientName] = set()
        self.missing: dict[ClientName, None] = {}
        self.back: dict[ClientName, float] = {}
        self.seq = 0

    def miss(self, peer: ClientName) -> None:
        while len(self.missing) >= MAX_ASKED:
            self.found(next(iter(self.missing)))
        self.missing[peer] = None

    def found(self, peer: ClientName) -> None:
        self.missing.pop(peer, None)
        self.back.pop(peer, None)


class Presence:
    """`links` is the relay's table, `local` the names under which the relay itself publishes, which are nobody's peers.
    `matching` has the clients of whom it is not known yet what they take. `attempt` does something about a client so
    that its failure is that client's; `after` is called when something was said; `home` names the peer that a client is
    at, who is as well reached as that."""

    def __init__(
        self,
        links: Mapping[ClientName, PeerLink],
        local: Container[ClientName],
        matching: Container[ClientName],
        attempt: Callable[[ClientName, float, Callable[[], object]], None],
        after: Callable[[], None],
        limits: PeerLimits,
        *,
        home: Callable[[ClientName], ClientName | None],
    ) -> None:
        self._links = links
        self._local = local
        self._matching = matching
        self._attempt = attempt
        self._after = after
        self._home = home
        self._told_at_once = limits.told_at_once
        self._taken: dict[ClientName, Counter[ClientName]] = {}  # streams that a client takes, by origin
        self._subscribers: dict[ClientName, set[ClientName]] = {}  # the same the other way round
        self._states: dict[ClientName, _State] = {}  # of those in `_subscribers`, as they were looked at last
        self._watchers: dict[ClientName, _Watcher] = {}
        self._there: dict[ClientName, _There] = {}  # clients of other relays, as far as those say
        self._asked: dict[ClientName, set[ClientName]] = {}  # of whom a client asked, until it is known what it takes

    # --- who takes whose streams ----------------------------------------------------------------------------------

    def joined(self, origin: ClientName, subscriber: ClientName) -> None:
        """One more stream of `origin` goes to `subscriber`."""
        if origin in self._local:
            return
        origins = self._taken.setdefault(subscriber, Counter())
        origins[origin] += 1
        if origins[origin] == 1:
            self._subscribers.setdefault(origin, set()).add(subscriber)
            self._due(subscriber, origin)

    def parted(self, origin: ClientName, subscriber: ClientName) -> None:
        """One stream less."""
        if origin in self._local:
            return
        origins = self._taken[subscriber]
        origins[origin] -= 1
        if origins[origin]:
            return
        del origins[origin]
        if not origins:
            del self._taken[subscriber]
        subscribers = self._subscribers[origin]
        subscribers.remove(subscriber)
        if not subscribers:
            del self._subscribers[origin]
            self._states.pop(origin, None)
            self._there.pop(origin, None)
        self._due(subscriber, origin)

    def _due(self, watcher: ClientName, peer: ClientName) -> None:
        watching = self._watchers.get(watcher)
        if watching is not None:
            watching.due.add(peer)

    # --- who is told ----------------------------------------------------------------------------------------------

    def watch(self, client: ClientName, *, now: float) -> None:
        """A client asked, in the session it has: it is told everything, and then what changes."""
        if client not in self._watchers:
            watching = self._watchers[client] = _Watcher()
            watching.due.update(self._taken.get(client, ()))
            self._tell(client, now)

    def ask(self, client: ClientName, names: Iterable[ClientName]) -> None:
        """A client asks whether these are here, its peers or not. Those above MAX_ASKED are left out, and the relay's
        own names: it has no session with itself."""
        asked = self._asked.setdefault(client, set())
        asked.update([name for name in names if name not in self._local][: MAX_ASKED - len(asked)])

    def changed(self, client: ClientName, *, now: float) -> None:
        """The client's session has begun or ended, here or at another relay: nobody waits for `sweep`."""
        self._watchers.pop(client, None)  # what it was told was of the session before
        self._asked.pop(client, None)
        for watching in self._watchers.values():
            if client in watching.missing:
                if self._here(client):
                    watching.back[client] = now
                else:
                    watching.back.pop(client, None)
        there = self._there.get(client)
        if there is not None and there.relay != self._home(client):
            del self._there[client]
        for subscriber in self._subscribers.get(client, ()):
            if is_peer(subscriber):  # it may have been told by another relay until now
                self._due(subscriber, client)
        self._look_now([client], now)

    def relay_changed(self, relay: ClientName, *, now: float) -> None:
        """The session with another relay has begun or ended."""
        self._watchers.pop(relay, None)
        for client in [client for client, there in self._there.items() if there.relay == relay]:
            del self._there[client]
        self._look_now([client for client in self._subscribers if self._home(client) == relay], now)

    def told(self, relay: ClientName, envelope: framing.Envelope, *, now: float) -> None:
        """Another relay says how clients of its own are reached: of others it is not believed. Raises WireError."""
        clients = []
        for state in peer_states(envelope):
            if self._home(state.name) != relay:
                continue
            if state.up is None or state.name not in self._subscribers:
                self._there.pop(state.name, None)
            else:
                self._there[state.name] = _There(relay, state, now - state.for_s)
                clients.append(state.name)
        self._look_now(clients, now)

    def _look_now(self, clients: Iterable[ClientName], now: float) -> None:
        """See how these are, and tell whom it concerns."""
        concerned: dict[ClientName, None] = {}
        for client in clients:
            if client in self._subscribers:
                self._look(client, now)
                concerned.update(dict.fromkeys(self._subscribers[client]))
        for subscriber in concerned:
            self._tell(subscriber, now)

    def sweep(self, *, now: float) -> None:
        """See whose path has fallen silent or answers again, and say what is due. Call about once a second, and then
        `tell`."""
        for client in self._subscribers:
            self._look(client, now)
        self.tell(now=now)

    def tell(self, *, now: float) -> bool:
        """Say what is due. True: there may be more; call again in another turn."""
        room = self._told_at_once
        for client, watching in list(self._watchers.items()):
            if client in self._asked and client not in self._matching:
                self._look_for(client, watching, now)
            for peer in [peer for peer, since_s in watching.back.items() if now - since_s >= BACK_PAUSE_S]:
                watching.found(peer)
                watching.due.add(peer)
            room -= self._tell(client, now)
            if room <= 0:
                return True
        return False

    def _look_for(self, client: ClientName, watching: _Watcher, now: float) -> None:
        """It is known what a client takes: see of whom it asked."""
        taken = self._taken.get(client, ())
        for peer in self._asked.pop(client):
            if peer in taken or not self._here(peer):
                watching.due.add(peer)
            else:
                watching.miss(peer)
                watching.back[peer] = now

    def _look(self, client: ClientName, now: float) -> None:
        home = self._home(client)
        link = self._links.get(home or client)
        view = None if link is None else link.observe(now=now)
        there = self._there.get(client)
        said = None if there is None else there.state
        old = self._states.get(client)
        up = view is not None and view.up and (said is None or said.up is True)
        since_s = now if old is None or old.up != up else old.since_s
        if there is not None and said is not None and not said.up:
            since_s = min(since_s, there.since_s)
        lane, rtt_s, rtt_at_s = ("", None, now) if old is None else (old.lane, old.rtt_s, old.rtt_at_s)
        if view is not None and up:
            lane, new_rtt_s = view.lane, view.srtt_s
            if said is not None:
                lane, new_rtt_s = said.lane, view.srtt_s + said.rtt_s if view.srtt_s and said.rtt_s else 0.0
            if new_rtt_s and _differs(rtt_s, new_rtt_s) and (rtt_s is None or now - rtt_at_s >= RTT_PAUSE_S):
                rtt_s, rtt_at_s = new_rtt_s, now
        here_moved = link is not None and not link.established and link.moved
        moved = here_moved if said is None else said.moved
        state = _State(up, since_s, lane, rtt_s, rtt_at_s, moved)
        if state != old:
            self._states[client] = state
            for subscriber in self._subscribers[client]:
                self._due(subscriber, client)

    def _tell(self, client: ClientName, now: float) -> int:
        """Returns how many messages it took."""
        watching, link = self._watchers.get(client), self._links.get(client)
        if watching is None or link is None or not watching.due or not link.established:
            return 0
        if link.control.acked_seq < watching.seq:
            return 0  # it is told the latest once it has heard of what was said before
        count = ceil(len(watching.due) / MAX_TOLD)
        self._attempt(client, now, partial(self._say, client, watching, link, now))
        return count

    def _say(self, client: ClientName, watching: _Watcher, link: PeerLink, now: float) -> None:
        due = sorted(watching.due)
        if is_peer(client):  # of those at yet another relay that one tells it itself
            due = [each for each in due if self._home(each) is None]
        for start in range(0, len(due), MAX_TOLD):
            items = [self._item(client, watching, peer, now) for peer in due[start : start + MAX_TOLD]]
            watching.seq = link.control.send({"t": "peers", "peers": items}, now=now)
        watching.due.clear()
        self._after()

    def _here(self, client: ClientName) -> bool:
        link = self._links.get(self._home(client) or client)
        return link is not None and link.established

    def _item(self, client: ClientName, watching: _Watcher, peer: ClientName, now: float) -> framing.Envelope:
        watching.found(peer)
        if peer not in self._taken.get(client, ()):
            here = self._here(peer)
            if not here:
                watching.miss(peer)
            return {"name": peer, "here": here}
        if peer not in self._states:
            self._look(peer, now)
        state = self._states[peer]
        item: framing.Envelope = {"name": peer, "up": state.up, "for": max(0.0, now - state.since_s)}
        if state.lane:
            item["lane"] = state.lane
        if state.rtt_s is not None:
            item["rtt"] = state.rtt_s
        if state.moved:
            item["moved"] = True
        return item

    def validate(self, taken: Mapping[ClientName, Counter[ClientName]]) -> None:
        """Internal consistency, for tests: `taken` is how many streams each client takes of each, counted anew."""
        assert self._taken == taken, f"streams are taken {self._taken} but routes say {taken}"
        subscribers = {(origin, subscriber) for origin, some in self._subscribers.items() for subscriber in some}
        assert subscribers == {(origin, subscriber) for subscriber, origins in taken.items() for origin in origins}
        assert self._states.keys() <= self._subscribers.keys(), "states of clients of whom nobody takes anything"
        assert self._there.keys() <= self._subscribers.keys(), "told of clients of whom nobody takes anything"
        assert self._watchers.keys() <= self._links.keys(), "clients are told that are gone"
        assert self._asked.keys() <= self._links.keys(), "clients ask that are gone"


def _differs(told_s: float | None, rtt_s: float) -> bool:
    return told_s is None or abs(rtt_s - told_s) > max(RTT_CHANGE * told_s, RTT_CHANGE_S)
