"""The client's keys while it runs: its own, the one that is to come, and those of its relay that it accepts.

NAME.next.key beside NAME.key is the pair to come: its public half is offered to the relay inside the session, and
once the relay has it the connection is made anew with it. Nothing is lost meanwhile: what is reliable outlives
connections and sessions. Whoever put the file there makes it NAME.key (`sern keys rotate`); until then both are tried.

The relay tells which keys it has and will have. They are accepted in place of older ones in server_key_file, and
written there if this process may.
"""

import asyncio
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import ClientKeys, RelayKeys
from sern_runtime.config.keys import (
    NEXT_SUFFIX,
    PublicKey,
    PublicKeys,
    SecretKey,
    fingerprint,
    is_key,
    load_public,
    load_secret,
    load_server_keys,
    write_public,
)

OFFER_AGAIN_S: Final = 10.0
"""A key that the relay did not take is offered again: its operator may have added it by then."""
MAX_RELAY_KEYS: Final = 4

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeyFiles:
    """Where they are."""

    secret: Path
    server: Path

    @property
    def next(self) -> Path:
        """The pair to come."""
        return self.secret.with_suffix(NEXT_SUFFIX)


class ClientKeyring:
    """`read` first. `use(redial)` is called when other keys are to be used, `tell` with what the relay is to know."""

    def __init__(
        self,
        files: KeyFiles,
        *,
        use: Callable[[bool], None],
        tell: Callable[[ClientKeys], None],
        at_s: Callable[[], float],
    ) -> None:
        self.files = files
        self.server_keys: tuple[str, ...] = ()
        self.problem = ""
        """Why the pair to come is not taken by the relay; empty: it was not refused."""
        self.reloads = 0
        """How often it was told to read them again."""
        self._use = use
        self._tell = tell
        self._at_s = at_s
        self._pairs: tuple[SecretKey, ...] = ()
        self._told: RelayKeys | None = None
        self._kept = True
        self._offer_due_s: float | None = None
        self._writing: asyncio.Task[None] | None = None

    def read(self) -> None:
        """Read all files. Raises ConfigError; then what was read before stays."""
        pairs = [load_secret(self.files.secret)]
        if self.files.next.exists():
            pairs.append(load_secret(self.files.next))
        server_keys = load_server_keys(self.files.server, at_s=self._at_s())
        # The one in use stays in use while it stands in a file.
        in_use = self._pairs[0].public_key if self._pairs else ""
        self._pairs = tuple(sorted(pairs, key=lambda pair: pair.public_key != in_use))
        self.server_keys, self._kept = server_keys, True

    @property
    def keys(self) -> SecretKey:
        """The pair in use."""
        return self._pairs[0]

    @property
    def other(self) -> SecretKey | None:
        """The pair that is not in use: that to come, or the one before it."""
        return self._pairs[1] if len(self._pairs) > 1 else None

    def reload(self) -> None:
        """Read the files again, and have in force what is new in them. A bad one leaves everything as it was."""
        before, server_before = self.keys, self.server_keys
        self.reloads += 1
        self.problem = ""  # what was refused before is offered again
        try:
            self.read()
        except ConfigError as error:
            _log.error("reload failed, the old keys stay: %s", error)
            return
        if self.keys != before or self.server_keys != server_before:
            self._use(self.keys != before)
        _log.info("reloaded keys")
        self._answer()

    def refused(self) -> None:
        """The relay does not know the pair in use: try the other one, and whatever stands in the files by now."""
        before = self.keys
        try:
            self.read()
        except ConfigError as error:
            _log.warning("the keys cannot be read again: %s", error)
        if self.keys == before and self.other is not None:
            self._pairs = self._pairs[::-1]
        if self.keys != before:
            _log.warning("trying the key %s in place of %s", *(fingerprint(k.public_key) for k in (self.keys, before)))
            self._use(False)

    def session_ended(self) -> None:
        """What the relay said held for that session."""
        self._told = self._offer_due_s = None

    def told(self, said: RelayKeys) -> None:
        """The relay says which keys it has, and what became of the one that it was offered."""
        self._told = said
        relay = self._merged(tuple(dict.fromkeys(said.relay)))
        if set(relay) != set(self.server_keys):
            _log.warning(
                "the relay has told of its keys; from now on accepted: %s (was: %s)",
                *(", ".join(map(fingerprint, keys)) for keys in (relay, self.server_keys)),
            )
            self.server_keys = relay
            self._use(False)
            self._keep(relay)
        other = self.other
        if said.key and other is not None and said.key == other.public_key:
            self._offered(other, said)
        elif not said.key:
            self._answer()

    def _merged(self, told: tuple[str, ...]) -> tuple[str, ...]:
        """The relay's keys, of which it has told some, the oldest first: those before them are over, and those behind
        them were put there by hand for a change that the relay does not speak of yet."""
        if not told or len(told) > MAX_RELAY_KEYS or not all(map(is_key, told)):
            return self.server_keys
        known = self.server_keys
        first = min((known.index(key) for key in told if key in known), default=0)
        return (*told, *(key for key in known[first:] if key not in told))

    def _offered(self, other: SecretKey, said: RelayKeys) -> None:
        if said.code:
            if said.why != self.problem:
                _log.error("the relay does not take our new key (%s): %s", said.code, said.why)
            self.problem, self._offer_due_s = said.why, self._at_s() + OFFER_AGAIN_S
            return
        _log.warning("the relay has our new key %s; going over to it", fingerprint(other.public_key))
        self.problem, self._offer_due_s = "", None
        self._pairs = (other, self.keys)
        self._use(True)

    def _keep(self, relay: tuple[str, ...]) -> None:
        """Write the relay's keys where they are read at the next start, beside the loop."""
        self._kept = False
        if self._writing is not None:
            self._writing.cancel()
        self._writing = asyncio.get_running_loop().create_task(self._write(relay), name="relay-keys")

    async def _write(self, relay: tuple[str, ...]) -> None:
        try:
            await asyncio.to_thread(self._write_now, relay)
        except ConfigError as error:
            _log.error("%s; the relay's new keys hold until this process ends", error)
        else:
            self._kept = True
        self._answer()

    def _write_now(self, relay: tuple[str, ...]) -> None:
        path = self.files.server
        if not os.access(path.parent, os.W_OK):
            raise ConfigError("can not be written: this process may not write its folder", file=str(path))
        name = load_public(path).name
        write_public(path, PublicKeys(name, tuple(map(PublicKey, relay))), replace=True)

    def look(self) -> None:
        """Offer again what was not taken. Call about twice a second."""
        if self._offer_due_s is not None and self._at_s() >= self._offer_due_s:
            self._offer_due_s = None
            self._answer()

    def _answer(self) -> None:
        """Tell the relay what we accept and offer, if it is one that wants to know."""
        if self._told is None:
            return
        other = self.other
        offered = "" if other is None or not self._is_next(other) else other.public_key
        self._tell(ClientKeys(self.server_keys, self._kept, offered))

    def _is_next(self, pair: SecretKey) -> bool:
        try:
            return load_secret(self.files.next) == pair
        except ConfigError:
            return False

    async def close(self) -> None:
        """Wait for what is being written."""
        if self._writing is not None:
            await asyncio.gather(self._writing, return_exceptions=True)

    def to_json(self) -> dict[str, object]:
        """What `sern keys` asks a running client."""
        other = self.other
        return {
            "pid": os.getpid(),
            "in_use": fingerprint(self.keys.public_key),
            "other": None if other is None else fingerprint(other.public_key),
            "problem": self.problem,
            "reloads": self.reloads,
            "told": self._told is not None,
            "takes": self._told is not None and self._told.takes,
            "relay": [fingerprint(key) for key in self.server_keys],
            "relay_kept": self._kept,
        }
