"""Who may ask the HTTP server: whoever knows the token; without one, whoever is on this machine.

A page that somebody has open in a browser on this machine reaches loopback too. It sees no answer of another origin,
unless its own name is made to stand for 127.0.0.1 (DNS rebinding). So where there is no token, the name in the request
(`Host`) must be an address or localhost: neither is a name that a stranger can give a new meaning.
"""

import hmac
import ipaddress
from typing import Final, NamedTuple

SCHEME: Final = "bearer"
_LOCAL: Final = frozenset({"localhost", "ip6-localhost"})
TOKEN: Final = "token"
HOST: Final = "host"


class Refusal(NamedTuple):
    """An answer in place of what was asked for. `text` is one line."""

    status: int
    text: str


class HttpAccess:
    """Judges requests. `token`: what must be in `Authorization: Bearer TOKEN`; None: nothing must."""

    def __init__(self, token: str | None = None) -> None:
        self._token = None if token is None else token.encode()
        self._free: frozenset[str] = frozenset()
        self.refused = {TOKEN: 0, HOST: 0}
        """Requests that were refused so far, by what was wrong with them."""

    def let_in(self, *paths: str) -> None:
        """Let everybody ask for these paths."""
        self._free |= frozenset(paths)

    def refusal(self, path: str, host: str | None, authorization: str | None) -> Refusal | None:
        """Why a request is refused, by its path and two of its headers (None: it has none such); None: it is not."""
        if path in self._free:
            return None
        if self._token is None:
            if host is None or _is_fixed(host):
                return None
            self.refused[HOST] += 1
            return Refusal(421, "ask by address or as localhost; for other names http.token_file must be set")
        scheme, _, given = (authorization or "").partition(" ")
        # Compared in a time that does not depend on how much of it is right.
        known = hmac.compare_digest(given.strip().encode("utf-8", "surrogateescape"), self._token)
        if known and scheme.lower() == SCHEME:
            return None
        self.refused[TOKEN] += 1
        what = "a token is needed" if authorization is None else "this is not the token"
        return Refusal(401, f"{what}; send Authorization: Bearer TOKEN, as http.token_file has it")


def _is_fixed(host: str) -> bool:
    """Whether the value of a Host header is an address or localhost, with a port or without."""
    name, separator, port = host.rpartition(":")
    if not separator or not port.isdecimal() or host.endswith("]"):
        name = host
    name = name.removeprefix("[").removesuffix("]").lower()
    if name in _LOCAL or name.endswith(".localhost"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
