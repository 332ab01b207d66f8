"""Keys that are revoked at one relay of a fabric hold at none: told to the others, and taken from them.

What a peer tells holds at once, in memory: connections and sessions that were made with such a key end, and nobody is
let in with it, whatever a reload reads. Then it is written to this relay's own folder of client keys, so that it holds
after a restart as well. Where the folder cannot be written that is said in one line, and the peers tell it again after
a restart. What this relay's folder does not have lets nobody in here, and is not written.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import KeyRevocation
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission
from sern_runtime import clock
from sern_runtime.config.key_changes import keep_revoked
from sern_runtime.config.keys import KeyDirectory, PublicKey, fingerprint
from sern_runtime.events import EventLog

REVOKED: Final = "revoked"
"""The kind of events."""

_log = logging.getLogger(__name__)


class FabricRevocations:
    """Call `read` after the directory was read, and `told` with what a peer says. `enforce` ends what was made with
    keys that hold no more."""

    def __init__(self, hub: Hub, admission: Admission, events: EventLog, *, enforce: Callable[[], None]) -> None:
        self.taken = 0
        """Keys that were revoked here because a peer said so."""
        self._hub = hub
        self._admission = admission
        self._events = events
        self._enforce = enforce
        self._to_keep: dict[str, tuple[str, ClientName, PublicKey]] = {}  # key: who told of it, whose, until when
        self._by: dict[str, str] = {}  # who told of a key
        self._keeping: asyncio.Task[None] | None = None
        self._said = ""
        hub.revocations.known = admission.has

    @property
    def unkept(self) -> int:
        """Keys that a peer has revoked and that are not written down."""
        return len(self._to_keep)

    def read(self) -> None:
        """The directory was read: what was revoked there is for all relays. The folder may be writable by now."""
        directory = self._admission.directory
        if directory is None:
            return
        names = set(directory.names)
        revoked = [
            KeyRevocation(name, key.key, max(0.0, key.not_after_s or 0.0), name not in names)
            for name, key in self._admission.own_revoked()
        ]
        self._hub.revocations.put(revoked, now=clock.now())
        for name, key in self._admission.overruled:  # it has come to the directory since it was told
            self._to_keep[key.key] = (self._by[key.key], name, key)
        self._said = ""
        self._keep()

    def told(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        """A peer tells of keys that were revoked."""
        relay, directory = peer[1:], self._admission.directory
        if directory is None:
            return
        now_s = time.time()
        ended = {each.key: (each.name, PublicKey(each.key, not_after_s=min(each.at_s, now_s))) for each in revocations}
        self._by |= dict.fromkeys(ended, relay)
        found = list(self._admission.revoke(ended))
        # With its last key a name is out. That it has another here does not let it in: unless none of its keys is known
        # here, which is another client of that name.
        out = {each.name for each in revocations if each.last} & {name for name, _key in found}
        others = {
            key.key: (name, PublicKey(key.key, not_after_s=now_s)) for name in out for key in directory.keys_of(name)
        }
        self._by |= dict.fromkeys(others, relay)
        found += self._admission.revoke(others)
        if others:
            own = [KeyRevocation(name, key.key, now_s, True) for name, key in others.values()]
            self._hub.revocations.put(own, now=clock.now())
        for name, key in found:
            self.taken += 1
            self._to_keep[key.key] = (relay, name, key)
            self._events.say(
                _log, logging.WARNING, REVOKED, name, "the relay %s has revoked the key %s of %s",
                relay, fingerprint(key.key), name, relay=relay,
            )  # fmt: skip
        if found:
            # In a turn of its own: a client's session is not to end while another link is being read.
            asyncio.get_running_loop().call_soon(self._enforce)
            self._keep()

    def _keep(self) -> None:
        if self._keeping is None and self._to_keep:
            self._keeping = asyncio.get_running_loop().create_task(self._write(), name="relay-revocations")

    async def _write(self) -> None:
        """One relay's after the other, so that files hold one thread at most."""
        try:
            while self._to_keep:
                directory = self._admission.directory
                relay = next(iter(self._to_keep.values()))[0]
                some = {key: (name, entry) for key, (by, name, entry) in self._to_keep.items() if by == relay}
                if directory is not None:
                    await asyncio.to_thread(self._put_down, directory, some, relay)
                for key in some:
                    self._to_keep.pop(key, None)
        except ConfigError as error:
            if str(error) != self._said:
                self._said = str(error)
                _log.error(
                    "revoked at another relay, and not written down here: %s; until that is mended the other relays "
                    "tell it again after each restart of this one", error,
                )  # fmt: skip
        finally:
            self._keeping = None

    @staticmethod
    def _put_down(directory: KeyDirectory, keys: Mapping[str, tuple[ClientName, PublicKey]], relay: str) -> None:
        keep_revoked(directory.path, tuple(keys.values()), by=relay, at_s=time.time())

    async def close(self) -> None:
        """Wait for what is being written."""
        if self._keeping is not None:
            await asyncio.gather(self._keeping, return_exceptions=True)
