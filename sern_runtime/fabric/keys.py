"""The keys under which relays write to each other, and back. Pure.

    sern/R/h/DST/SRC/CLASS                        a datagram of relay SRC for relay DST; CLASS as the wire numbers it
    sern/R/relay/RELAY/BOOT/LOW/HIGH/RULES        token: the relay is there, and speaks wire versions LOW to HIGH

R is the release of these keys and of what is in them. Names of relays are lower-case letters, digits and
`_` (`sern_core.vocabulary.names`): none of the signs that mean something in a key expression (`/ * $ # ?`), so they
stand in a key as they are. They are checked in both directions, since what comes may be anybody's.
"""

import re
from typing import Final

from sern_core.vocabulary.names import client_name, is_client_name
from sern_core.vocabulary.types import CLASSES, ClientName, PriorityClass
from sern_core.wire.framing import HANDSHAKE_VERSION
from sern_runtime.fabric.port import PeerRelay

ROOT: Final = f"sern/{HANDSHAKE_VERSION}"
"""R is the version of the handshake, which never changes: two relays of other wire versions meet under it, and agree
on one at hello or say that there is none."""
NO_RULES: Final = "-"
"""In the place of the hash of rules: the relay does not say. No part of a key may be empty."""
_NUMBER: Final = re.compile(r"0|[1-9][0-9]{0,19}")
_RULES: Final = re.compile(r"[0-9a-f]{1,128}")
_ALL: Final = f"{ROOT}/"
_HOPS: Final = f"{ROOT}/h/"
RELAY_TOKENS: Final = f"{ROOT}/relay/**"


def hop_key(destination: ClientName, source: ClientName, priority: PriorityClass) -> str:
    """UsageError for what is no name."""
    return f"{ROOT}/h/{client_name(destination)}/{client_name(source)}/{int(priority)}"


def inbox(relay: ClientName) -> str:
    """All that is for this relay."""
    return f"{ROOT}/h/{client_name(relay)}/**"


def relay_token(relay: PeerRelay) -> str:
    low, high = relay.wire_versions
    rules = relay.rules or NO_RULES
    return f"{ROOT}/relay/{client_name(relay.name)}/{relay.boot}/{low}/{high}/{rules}"


def parse_source(key: str, own: ClientName) -> ClientName | None:
    """Who wrote a datagram for us; None: it is not such a key."""
    parts = key.removeprefix(_HOPS).split("/") if key.startswith(_HOPS) else ()
    if len(parts) != 3 or parts[0] != own or not is_client_name(parts[1]) or parts[2] not in _CLASSES:
        return None
    return ClientName(parts[1])


def parse_token(key: str) -> PeerRelay | None:
    """None: it is no token of ours."""
    if not key.startswith(_ALL):
        return None
    kind, _, rest = key.removeprefix(_ALL).partition("/")
    parts = rest.split("/")
    if kind == "relay" and len(parts) == 5:
        name, boot, low, high, rules = parts
        numbers = [_number(text) for text in (boot, low, high)]
        if is_client_name(name) and None not in numbers and (rules == NO_RULES or _RULES.fullmatch(rules)):
            return PeerRelay(ClientName(name), int(boot), (int(low), int(high)), "" if rules == NO_RULES else rules)
    return None


def _number(text: str) -> int | None:
    """One spelling for each number, so that a token has one meaning and a meaning one token."""
    return int(text) if _NUMBER.fullmatch(text) else None


_CLASSES: Final = frozenset(str(int(priority)) for priority in CLASSES)
