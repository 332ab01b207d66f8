"""What the ends of a hop tell each other of keys, inside the session that the present ones made."""

from dataclasses import dataclass
from typing import NamedTuple

from sern_core.vocabulary.types import ClientName


@dataclass(frozen=True, slots=True)
class RelayKeys:
    """What a relay says to a client. Keys are Z85 text, and not checked yet.

    `relay`: its public keys, those that it has and those that it will have. `takes`: it takes a new key of the client.
    `key`: the one that it was offered, with a `code` and a line `why` if it was not taken; empty: none was.
    """

    relay: tuple[str, ...]
    takes: bool
    key: str = ""
    code: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """What a client says to its relay.

    `relay`: keys of the relay's that it accepts from now on. `kept`: also when it is started again. `key`: a new key of
    its own, which the relay is to take beside the present one; empty: there is none.
    """

    relay: tuple[str, ...]
    kept: bool
    key: str = ""


class KeyRevocation(NamedTuple):
    """A client's key was revoked at a relay, at `at_s` by the wall clock, Unix seconds. `last`: with it the client lost
    the last key that it had there."""

    name: ClientName
    key: str
    at_s: float
    last: bool
