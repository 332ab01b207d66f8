"""Who may come in: the relay's directory of client keys, as it holds now.

Without a directory (`insecure: true`) everybody may.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import KeyDirectory, KeyStatus, PublicKey, clock_says, fingerprint, user_id
from sern_runtime.zap import Refusal, TemporaryRefusal

ZAP_DOMAIN: Final = "sern"


class Admission:
    """Answers for names, keys and connections by one directory; `replace` puts another in force."""

    def __init__(self, directory: KeyDirectory | None) -> None:
        self.directory = directory
        self.overruled: tuple[tuple[ClientName, PublicKey], ...] = ()
        """Keys of the directory that hold no more because they were revoked at another relay."""
        self._revoked: dict[str, tuple[ClientName, PublicKey]] = {}  # at other relays, as they were told
        self._valid = self._valid_keys()

    def replace(self, directory: KeyDirectory | None) -> None:
        """Put `directory` in force. What it takes away is told by the next `take_lapsed`."""
        self.directory = directory
        self.overruled = () if directory is None else directory.revoke(self._revoked)

    def own_revoked(self) -> list[tuple[ClientName, PublicKey]]:
        """What is revoked in the directory, without what other relays have told."""
        revoked = () if self.directory is None else self.directory.revoked()
        return [(name, key) for name, key in revoked if key.key not in self._revoked]

    def revoke(self, keys: Mapping[str, tuple[ClientName, PublicKey]]) -> tuple[tuple[ClientName, PublicKey], ...]:
        """Keys that were revoked at another relay hold no more, whatever directory is put in force. What that takes
        away is told by the next `take_lapsed`. Returns those that the directory had, with their names there."""
        self._revoked.update(keys)
        return () if self.directory is None else self.directory.revoke(keys)

    def has(self, public_key: str) -> bool:
        """Whether the directory has this key, revoked or not."""
        return self.directory is not None and self.directory.lookup(public_key, at_s=time.time()).name is not None

    def known(self, client: ClientName) -> bool:
        """Whether the name is in the directory."""
        return self.directory is None or client in self.directory.names

    @property
    def names(self) -> tuple[ClientName, ...]:
        """The names in the directory; none where there is none."""
        return () if self.directory is None else self.directory.names

    def named(self, client: ClientName) -> bool:
        """Whether there is a directory that has the name."""
        return self.directory is not None and client in self.directory.names

    def status(self, client: ClientName, public_key: str) -> KeyStatus:
        """Whether what comes over a connection that was made with this key is taken: if it is VALID."""
        if self.directory is None:
            return KeyStatus.VALID
        match = self.directory.lookup(public_key, at_s=time.time())
        return match.status if match.name == client else KeyStatus.UNKNOWN

    def lookup(self, public_key: str, _address: str) -> str | Refusal | TemporaryRefusal | None:
        """The user id for ZAP of who holds the key, a refusal with its reason, or None for a stranger."""
        assert self.directory is not None
        at_s = time.time()
        match = self.directory.lookup(public_key, at_s=at_s)
        if match.name is None or match.key is None:
            return None
        if match.status is KeyStatus.VALID:
            return user_id(match.name, public_key)
        if match.status is KeyStatus.REVOKED:
            return Refusal(f"the key {fingerprint(public_key)} of {match.name} is revoked")
        refusal = TemporaryRefusal if match.status is KeyStatus.NOT_YET else Refusal
        return refusal(
            f"the key {fingerprint(public_key)} of {match.name} {match.key.lapse(at_s)}, and {clock_says(at_s)}"
        )

    def take_lapsed(self) -> dict[ClientName, frozenset[str]]:
        """The keys that were taken away or have expired since this was last asked, by client."""
        before, self._valid = self._valid, self._valid_keys()
        lost = {client: keys - self._valid.get(client, frozenset()) for client, keys in before.items()}
        return {client: keys for client, keys in lost.items() if keys}

    def valid(self) -> dict[ClientName, frozenset[str]]:
        """The keys that held when it was last looked, by client."""
        return self._valid

    def _valid_keys(self) -> dict[ClientName, frozenset[str]]:
        """The keys that hold now, by client."""
        if self.directory is None:
            return {}
        now_s = time.time()
        return {
            name: frozenset(key.key for key in self.directory.keys_of(name) if key.status(now_s) is KeyStatus.VALID)
            for name in self.directory.names
        }


def read_directory(path: Path | None) -> KeyDirectory | None:
    """The keys in the folder; None where there is none. Raises ConfigError that names the file at fault."""
    return None if path is None else KeyDirectory(path)
