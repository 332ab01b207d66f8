"""Keys of clients that were revoked at any relay of the fabric: each relay tells the others. Pure.

What travels is that somebody revoked a key, not that a relay does not have it: directories may differ. A revocation is
told at once to the peers that are reached, and all of them are told to each peer whose session begins, so it does not
matter which relay was away, or is gone since. What is new goes on to the other peers.

A peer is believed: it can revoke any key that it knows (docs/fabric.md). What it cannot do is fill this relay's memory.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.key_news import KeyRevocation
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

MAX_TOLD: Final = 24
"""Revocations in one message: an envelope holds 4 KiB."""
MAX_UNKNOWN: Final = 4096
"""Revoked keys that peers have told of and that are not in this relay's directory. With more the rest is left out, and
counted: such a key lets nobody in here anyway, and once it is in the directory it is taken when it is told again."""
MAX_AT_S: Final = 2.0**40
KEY_US: Final = 20
"""What a peer is charged with, in microseconds, for each revocation that it tells."""
_Z85: Final = {
    sign: value
    for value, sign in enumerate(
        "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
    )
}
KEY_CHARS: Final = 40


class Revocations:
    """`reached` gives the links of the peers with a session."""

    def __init__(self, clients: Clients, events: GuardedEvents, reached: Callable[[], Iterator[Link]]) -> None:
        self.known: Callable[[str], bool] = lambda _key: False
        """Whether a key is in this relay's own directory; set by the shell."""
        self.left_out = 0
        """Revocations that were not taken because there were too many."""
        self._clients = clients
        self._events = events
        self._reached = reached
        self._keys: dict[str, KeyRevocation] = {}
        self._unknown: set[str] = set()

    def __len__(self) -> int:
        return len(self._keys)

    def put(self, revocations: Iterable[KeyRevocation], *, now: float) -> None:
        """Keys that were revoked at this relay; those that it knows already are not told again."""
        new = [each for each in revocations if each.key not in self._keys or each.key in self._unknown]
        for each in new:
            self._unknown.discard(each.key)
        self._spread(self._take(new), now)

    def up(self, link: Link, *, now: float) -> None:
        """The session with a peer has begun."""
        self._say(link, list(self._keys.values()), now)

    def told(self, link: Link, envelope: framing.Envelope, *, now: float) -> None:
        """A peer says which keys are revoked. Raises WireError."""
        told = _revocations(envelope)
        link.reassembly.work_us += KEY_US * len(told)
        new = []
        for each in told:
            if each.key in self._keys:
                continue
            if not self.known(each.key):
                if len(self._unknown) >= MAX_UNKNOWN:
                    self.left_out += 1
                    continue
                self._unknown.add(each.key)
            new.append(each)
        new = self._take(new)
        if new:
            self._events.revoked(link.peer, new)
            self._spread(new, now, but=link.peer)

    def _take(self, revocations: list[KeyRevocation]) -> list[KeyRevocation]:
        """Each key once."""
        taken = {each.key: each for each in revocations}
        self._keys.update(taken)
        return list(taken.values())

    def _spread(self, revocations: list[KeyRevocation], now: float, *, but: ClientName | None = None) -> None:
        for link in self._reached() if revocations else ():
            if link.peer != but:
                self._say(link, revocations, now)

    def _say(self, link: Link, revocations: list[KeyRevocation], now: float) -> None:
        for start in range(0, len(revocations), MAX_TOLD):
            told = [list(each) for each in revocations[start : start + MAX_TOLD]]
            self._clients.tell(link.peer, {"t": "revoked", "keys": told}, now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._unknown <= self._keys.keys(), "keys are counted that are not kept"
        assert len(self._unknown) <= MAX_UNKNOWN, "too many are kept"


def is_key(text: str) -> bool:
    """Whether this is the Z85 text of 32 bytes: five characters stand for four."""
    if len(text) != KEY_CHARS:
        return False
    for start in range(0, KEY_CHARS, 5):
        value = 0
        for sign in text[start : start + 5]:
            if sign not in _Z85:
                return False
            value = 85 * value + _Z85[sign]
        if value >= 1 << 32:
            return False
    return True


def _revocations(envelope: framing.Envelope) -> list[KeyRevocation]:
    """Raises WireError."""
    told = envelope.get("keys")
    if not isinstance(told, list):
        raise WireError("revoked without keys")
    return [_revocation(each) for each in told]


def _revocation(each: Any) -> KeyRevocation:
    if not (isinstance(each, list) and len(each) == 4 and isinstance(each[0], str) and isinstance(each[1], str)):
        raise WireError("revoked with something that is no key")
    name, key, at_s, last = each
    if not is_client_name(name) or not is_key(key):
        raise WireError(f"revoked with {key[:64]!r} of {name[:64]!r}")
    if type(at_s) is not float or not 0.0 <= at_s <= MAX_AT_S or type(last) is not bool:
        raise WireError(f"revoked with the time {str(at_s)[:64]}")
    return KeyRevocation(ClientName(name), key, at_s, last)
