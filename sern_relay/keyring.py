"""The relay's keys while it runs: its own, the one to come, what clients know of them, and new keys of clients.

NAME.next.key beside NAME.key is the pair to come. Clients that ask are told of it inside their sessions, and
say that they accept it. Once it is NAME.key (`sern keys rotate`), a reload has the listeners prove themselves with it.

A client may ask inside its session that a further key of its own is taken, if `relay.rotate_keys` says so: it proves by
its present key whose name it is, and gets nothing that it had not.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import ConfigError, RefusedError
from sern_core.vocabulary.key_news import ClientKeys, RelayKeys
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission
from sern_runtime import clock
from sern_runtime.config.key_changes import check_new, take_in
from sern_runtime.config.keys import NEXT_SUFFIX, KeyDirectory, KeyStatus, SecretKey, fingerprint, is_key, load_secret

MAX_TOLD: Final = 8
"""Keys of the relay's that a client may name."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OwnKeys:
    """The relay's pair, and the one to come."""

    now: SecretKey
    next: SecretKey | None = None

    @classmethod
    def read(cls, path: Path) -> "OwnKeys":
        """Raises ConfigError."""
        coming = path.with_suffix(NEXT_SUFFIX)
        return cls(load_secret(path), load_secret(coming) if coming.exists() else None)

    @property
    def public(self) -> tuple[str, ...]:
        """The public halves, the present one first."""
        return tuple(dict.fromkeys(pair.public_key for pair in (self.now, self.next) if pair is not None))


class RelayKeyring:
    """`session_key(client)`: the key with which the client's session is held, None if that is not known.

    `overlap_s` None: keys of clients are not taken. `after` is called when there is something to send. `relays` says of
    each other relay whether it is reached.
    """

    def __init__(
        self,
        hub: Hub,
        admission: Admission,
        own: OwnKeys,
        *,
        overlap_s: float | None,
        session_key: Callable[[ClientName], str | None],
        after: Callable[[], None],
        relays: Callable[[], Mapping[ClientName, bool]] = dict,
    ) -> None:
        self.own = own
        self.overlap_s = overlap_s
        self.taken = 0
        self.refused = 0
        self.generation = 0
        """Goes up whenever a reload has put another directory in force."""
        self._hub = hub
        self._admission = admission
        self._session_key = session_key
        self._after = after
        self._relays = relays
        self._asked: set[ClientName] = set()
        self._known: dict[ClientName, ClientKeys] = {}
        self._offers: dict[ClientName, str] = {}
        self._taking: asyncio.Task[None] | None = None

    def use(self, own: OwnKeys, *, overlap_s: float | None) -> None:
        """A reload has read these: tell those who asked."""
        changed = (own, overlap_s) != (self.own, self.overlap_s)
        self.own, self.overlap_s = own, overlap_s
        self.generation += 1
        if changed:
            for client in sorted(self._asked):
                self._say(client)

    def asked(self, client: ClientName) -> None:
        """A client wants to be told, until it leaves."""
        self._asked.add(client)
        self._say(client)

    def left(self, client: ClientName) -> None:
        """Its session has ended."""
        self._asked.discard(client)
        self._known.pop(client, None)
        self._offers.pop(client, None)

    def told(self, client: ClientName, keys: ClientKeys) -> None:
        """A client says which keys of ours it accepts, and offers one of its own."""
        if client not in self._asked:
            return
        self._known[client] = ClientKeys(keys.relay[:MAX_TOLD], keys.kept)
        if keys.key:
            self._offers[client] = keys.key
            if self._taking is None:
                self._taking = asyncio.get_running_loop().create_task(self._take_all(), name="relay-new-keys")

    def _say(self, client: ClientName, key: str = "", code: str = "", why: str = "") -> None:
        link = self._hub.links.get(client)
        if link is not None and link.established:
            said = RelayKeys(self.own.public, self.overlap_s is not None, key, code, why)
            self._hub.tell_keys(client, said, now=clock.now())
            self._after()

    async def _take_all(self) -> None:
        """One after the other, so that what clients offer holds one thread at most."""
        try:
            while self._offers:
                client = next(iter(self._offers))
                key = self._offers.pop(client)
                try:
                    await self._take(client, key)
                except RefusedError as refusal:
                    self.refused += 1
                    self._say(client, key, refusal.code, str(refusal))
                except ConfigError as error:
                    self.refused += 1
                    _log.error("a new key of %s is not taken: %s", client, error)
                    self._say(client, key, "internal_error", "the relay could not write the key; see its log")
        finally:
            self._taking = None

    async def _take(self, client: ClientName, key: str) -> None:
        directory = self._admission.directory
        asking = self._session_key(client)
        if directory is None or asking is None:
            raise RefusedError("old_key", "the connection that the session began with is gone; ask again")
        if self._admission.status(client, key) is KeyStatus.VALID:  # its operator has added it
            self._say(client, key)
            return
        if self.overlap_s is None:
            why = "this relay takes no keys over the link (relay.rotate_keys); have its operator add it: sern keys add"
            raise RefusedError("forbidden", why)
        # By what is in force, so that a client that asks again and again has no file read.
        if not is_key(key):
            raise RefusedError("bad_key", "what was offered is no CURVE key")
        check_new(directory, client, asking, key, at_s=time.time())
        took = await asyncio.to_thread(
            take_in, directory.path, client, asking, key, at_s=time.time(), overlap_s=self.overlap_s
        )
        await self._put_in_force(directory.path)
        self.taken += 1
        _log.warning(
            "%s has a new key %s beside %s, which ends in %.0f s",
            client, fingerprint(took.key), fingerprint(asking), self.overlap_s,
        )  # fmt: skip
        self._say(client, key)

    async def _put_in_force(self, path: Path) -> None:
        """Read the directory beside the loop; again if a reload came in between, which may have read less or more."""
        generation = -1
        while generation != self.generation:
            generation = self.generation
            directory = await asyncio.to_thread(KeyDirectory, path)
        self._admission.replace(directory)

    async def close(self) -> None:
        """Wait for what is being written."""
        self._offers.clear()
        if self._taking is not None:
            await asyncio.gather(self._taking, return_exceptions=True)

    def to_json(self) -> dict[str, object]:
        """What `sern keys` asks a running relay. No secrets, and no whole keys."""
        valid = self._admission.valid()
        names = {*valid, *self._known}
        return {
            "pid": os.getpid(),
            "relay": {
                "in_use": fingerprint(self.own.now.public_key),
                "next": None if self.own.next is None else fingerprint(self.own.next.public_key),
            },
            "relays": dict(self._relays()),
            "clients": {name: self._client(name, valid.get(name, frozenset())) for name in sorted(names)},
        }

    def _client(self, name: ClientName, valid: frozenset[str]) -> dict[str, object]:
        link, known, key = self._hub.links.get(name), self._known.get(name), self._session_key(name)
        return {
            "valid": sorted(map(fingerprint, valid)),
            "connected": link is not None and link.established,
            "in_use": None if key is None else fingerprint(key),
            "accepts": [] if known is None else [fingerprint(text) for text in known.relay if is_key(text)],
            "kept": known is not None and known.kept,
        }
