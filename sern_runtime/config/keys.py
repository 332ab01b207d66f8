"""CURVE keys in files: one public and one secret file a name, and the relay's directory of client keys.

A public file holds one or more keys, each with an optional time window, so that an old and a new key overlap while a
site changes over; several files may carry the same name. A secret file holds one pair, and is nobody else's to read.
Keys are Z85 text (ZeroMQ RFC 32), 40 characters for 32 bytes. Wall time is handed in as `at_s`, Unix seconds.
What was revoked stands in the folder `revoked` of the directory, and holds no more, wherever else it stands.
Every problem is a ConfigError of one line that names the file and never shows a secret.
"""

import base64
import hashlib
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from struct import error as struct_error
from typing import Annotated, Final, Literal, TypeVar

import zmq
from pydantic import AfterValidator, Field, model_validator
from zmq.utils import z85

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.base import ClientText, FileModel, Section, fault
from sern_runtime.config.load import Loaded, check_document
from sern_runtime.config.yaml import read_document
from sern_runtime.whole_file import write_whole

PUBLIC_SUFFIX: Final = ".pub"
SECRET_SUFFIX: Final = ".key"
NEXT_SUFFIX: Final = ".next.key"
"""The end of the name of the pair that is to take the place of NAME.key, beside it."""
REVOKED_DIR: Final = "revoked"
SECRET_MODE: Final = 0o600
PUBLIC_MODE: Final = 0o644
MAX_KEYS: Final = 16
RAW_KEY_BYTES: Final = 32
FINGERPRINT_GROUPS: Final = 5
"""Groups of four characters of base32: 100 bits, which nobody finds another key for."""
_Z85: Final = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO

F = TypeVar("F", bound=FileModel)


def _check_z85(text: str) -> str:
    try:
        if _Z85.fullmatch(text) and len(z85.decode(text)) == RAW_KEY_BYTES:
            return text
    except (struct_error, ValueError):
        pass  # five characters may stand for more than 32 bits
    raise fault("is not a CURVE key: 40 characters of Z85 text, in quotes")


def _check_utc(text: str) -> str:
    _unix_s(text)
    return text


def _unix_s(text: str) -> float:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        time = None
    if time is None or time.tzinfo is None:
        raise fault(f"{text[:40]!r} is not a time with its zone, such as 2026-01-31T12:00:00Z")
    try:
        return time.timestamp()
    except (OverflowError, ValueError) as error:
        raise fault(f"{text[:40]!r} is out of range") from error


def _utc(at_s: float) -> str:
    return f"{datetime.fromtimestamp(at_s, UTC):%Y-%m-%dT%H:%M:%SZ}"


def fingerprint(public_key: str) -> str:
    """What people compare in place of a public key (Z85): the beginning of its SHA-256, in five groups of four."""
    text = base64.b32encode(hashlib.sha256(z85.decode(public_key)).digest()).decode().lower()
    return "-".join(text[start : start + 4] for start in range(0, 4 * FINGERPRINT_GROUPS, 4))


def is_key(text: str) -> bool:
    """Whether this is the Z85 text of a key."""
    try:
        _check_z85(text)
    except ValueError:
        return False
    return True


def utc(at_s: float) -> str:
    """A time for people."""
    return _utc(at_s)


def clock_says(at_s: float) -> str:
    """The time by which keys are judged, for whoever wonders whether it is right."""
    return f"this machine's clock says {_utc(at_s)}"


KeyText = Annotated[str, AfterValidator(_check_z85), Field(json_schema_extra={"pattern": _Z85.pattern})]
UtcText = Annotated[str, AfterValidator(_check_utc), Field(json_schema_extra={"format": "date-time"})]


class KeyEntry(Section):
    """One public key and when it holds."""

    public_key: KeyText
    """The public key, 40 characters of Z85 text."""
    not_before: UtcText | None = None
    """The key is refused before this time (ISO 8601 with zone); null: no limit."""
    not_after: UtcText | None = None
    """The key is refused after this time (ISO 8601 with zone); null: no limit."""

    @model_validator(mode="after")
    def _window(self) -> "KeyEntry":
        if self.not_before and self.not_after and _unix_s(self.not_before) >= _unix_s(self.not_after):
            raise fault("is not after not_before: the key would never be accepted", "not_after")
        return self


class PublicKeyFile(FileModel):
    """The public keys of one relay or client; made by `sern keygen`, copied to the other side."""

    sern_key: Literal["public"]
    """The word `public`: what kind of file this is."""
    name: ClientText
    """The relay or client that these keys belong to."""
    keys: Annotated[tuple[KeyEntry, ...], Field(min_length=1, max_length=MAX_KEYS)]
    """Its keys; more than one while an old and a new one overlap."""


class SecretKeyFile(FileModel):
    """The key pair of one relay or client; stays on its machine, mode 0600."""

    sern_key: Literal["secret"]
    """The word `secret`: what kind of file this is."""
    name: ClientText
    """The relay or client that this pair belongs to."""
    public_key: KeyText
    """The public half, for reference: it must belong to the secret half."""
    secret_key: KeyText
    """The secret half. Whoever has it is this relay or client."""

    @model_validator(mode="after")
    def _pair(self) -> "SecretKeyFile":
        if zmq.curve_public(self.secret_key.encode()).decode() != self.public_key:
            raise fault("does not belong to secret_key; make a new pair with sern keygen", "public_key")
        return self


@dataclass(frozen=True, slots=True)
class PublicKey:
    """A public key (Z85) and its window of Unix time, s; None: no limit on that side."""

    key: str
    not_before_s: float | None = None
    not_after_s: float | None = None

    def status(self, at_s: float) -> "KeyStatus":
        if self.not_before_s is not None and at_s < self.not_before_s:
            return KeyStatus.NOT_YET
        if self.not_after_s is not None and at_s > self.not_after_s:
            return KeyStatus.EXPIRED
        return KeyStatus.VALID

    def lapse(self, at_s: float) -> str:
        """Why it does not hold at that time; empty if it does."""
        match self.status(at_s):
            case KeyStatus.NOT_YET if self.not_before_s is not None:
                return f"is not valid before {_utc(self.not_before_s)}"
            case KeyStatus.EXPIRED if self.not_after_s is not None:
                return f"expired at {_utc(self.not_after_s)}"
            case _:
                return ""


@dataclass(frozen=True, slots=True)
class PublicKeys:
    """What a public key file says: the keys of `name`, in the order of the file."""

    name: ClientName
    keys: tuple[PublicKey, ...]

    def valid_at(self, at_s: float) -> tuple[PublicKey, ...]:
        return tuple(key for key in self.keys if key.status(at_s) is KeyStatus.VALID)

    def lapse(self, at_s: float) -> str | None:
        """A phrase when none of them holds at that time: which comes next or was the last, and what the clock says,
        because that may be what is wrong. Else None."""
        if self.valid_at(at_s):
            return None
        coming = [key for key in self.keys if key.status(at_s) is KeyStatus.NOT_YET]
        if coming:
            why = f"the next one {min(coming, key=lambda key: key.not_before_s or 0.0).lapse(at_s)}"
        else:
            why = f"the last one {max(self.keys, key=lambda key: key.not_after_s or 0.0).lapse(at_s)}"
        return f"has no key that is valid now: {why}, and {clock_says(at_s)}"


@dataclass(frozen=True, slots=True)
class SecretKey:
    """A key pair (Z85). The secret half is kept out of `repr`."""

    name: ClientName
    public_key: str
    secret_key: str = field(repr=False)


class KeyStatus(StrEnum):
    VALID = "valid"
    UNKNOWN = "unknown"
    NOT_YET = "not_yet"
    EXPIRED = "expired"
    REVOKED = "revoked"


@dataclass(frozen=True, slots=True)
class KeyMatch:
    """The answer of a directory about one key. `name` and `key` are None when the key is unknown."""

    status: KeyStatus
    name: ClientName | None = None
    key: PublicKey | None = None


def generate(name: ClientName) -> SecretKey:
    """A new CURVE pair from libzmq's random generator."""
    public, secret = zmq.curve_keypair()
    return SecretKey(name, public.decode(), secret.decode())


def _document_of(path: Path, model: type[F], kind: Literal["public", "secret"]) -> Loaded[F]:
    document = read_document(path)
    found = document.data.get("sern_key") if isinstance(document.data, dict) else None
    if found in ("public", "secret") and found != kind:
        suffix = PUBLIC_SUFFIX if kind == "public" else SECRET_SUFFIX
        raise document.error((), f"is a {found} key file; the {kind} one is needed here (NAME{suffix})")
    if "sern_key" not in (document.data if isinstance(document.data, dict) else {}):
        raise document.error((), f"is not a SERN key file; make one with sern keygen (a {kind} key is needed here)")
    checked = check_document(document, path, model, files=False)
    if checked.loaded is None:
        raise checked.errors[0]
    return checked.loaded


def load_public(path: Path) -> PublicKeys:
    """The keys in a public key file. ConfigError otherwise."""
    model = _document_of(path, PublicKeyFile, "public").model
    keys = tuple(
        PublicKey(
            entry.public_key,
            None if entry.not_before is None else _unix_s(entry.not_before),
            None if entry.not_after is None else _unix_s(entry.not_after),
        )
        for entry in model.keys
    )
    return PublicKeys(ClientName(model.name), keys)


def load_server_keys(path: Path, *, at_s: float) -> tuple[str, ...]:
    """The keys (Z85) in the relay's public key file that hold at `at_s`, in the order in which they are tried.
    ConfigError when none does."""
    public = load_public(path)
    lapse = public.lapse(at_s)
    if lapse is not None:
        raise ConfigError(f"{lapse}; set the clock, or ask for the relay's new public key", file=str(path))
    return tuple(key.key for key in public.valid_at(at_s))


def load_secret(path: Path) -> SecretKey:
    """The pair in a secret key file. ConfigError otherwise. See also `secret_warning`."""
    model = _document_of(path, SecretKeyFile, "secret").model
    return SecretKey(ClientName(model.name), model.public_key, model.secret_key)


def secret_warning(path: Path) -> str | None:
    """A phrase when others than the owner may read (or change) a secret file, else None."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return None
    if mode & _OTHERS:
        return f"{path} is open to others than its owner (mode {mode:04o}); run: chmod 600 {path}"
    return None


def misnamed(path: Path, name: ClientName) -> str | None:
    """A phrase when a key file has another's name: it should begin with `name`, then end or go on with another sign, as
    jackal1.pub and jackal1-2030.pub do for jackal1."""
    if re.match(re.escape(name) + r"(?![a-z0-9_])", path.stem + " "):
        return None
    return f"{path} holds the key of {name}, and by its name that of {path.stem}: who has it connects as {name}"


def public_text(keys: PublicKeys) -> str:
    """The content of a public key file."""
    lines = [f"# Public key of {keys.name}: not a secret.", "sern_key: public", f"name: {keys.name}", "keys:"]
    for key in keys.keys:
        lines.append(f'  - public_key: "{key.key}"')
        for label, at_s in (("not_before", key.not_before_s), ("not_after", key.not_after_s)):
            if at_s is not None:
                lines.append(f'    {label}: "{datetime.fromtimestamp(at_s, UTC).isoformat()}"')
    return "\n".join(lines) + "\n"


def secret_text(key: SecretKey) -> str:
    """The content of a secret key file."""
    return (
        f"# Secret key of {key.name}: keep it on its machine, readable by its owner alone (mode 0600).\n"
        f'sern_key: secret\nname: {key.name}\npublic_key: "{key.public_key}"\nsecret_key: "{key.secret_key}"\n'
    )


def write_public(path: Path, keys: PublicKeys, *, replace: bool = False) -> None:
    """Write a public key file (mode 0644). ConfigError when it exists and `replace` is not given."""
    _write(path, public_text(keys), PUBLIC_MODE, replace=replace)


def write_secret(path: Path, key: SecretKey, *, replace: bool = False) -> None:
    """Write a secret key file (mode 0600 from its first byte). ConfigError when it exists without `replace`."""
    _write(path, secret_text(key), SECRET_MODE, replace=replace)


def _write(path: Path, text: str, mode: int, *, replace: bool) -> None:
    try:
        write_whole(path, text, mode=mode, replace=replace)
    except FileExistsError as error:
        raise ConfigError("exists already; --force replaces it", file=str(path)) from error
    except OSError as error:
        raise ConfigError(f"can not be written: {error.strerror or error}", file=str(path)) from error


def user_id(name: ClientName, public_key: str) -> str:
    """What the ZAP handler attaches to every frame of a connection: whose it is, and the key (Z85) it was made with."""
    return f"{name} {public_key}"


def parse_user_id(user: str) -> tuple[ClientName, str]:
    """Name and key of a User-Id. UsageError when it is none."""
    name, _, public_key = user.partition(" ")
    if not _Z85.fullmatch(public_key):
        raise UsageError("a connection without the name of a key")
    return client_name(name), public_key


class KeyDirectory:
    """The relay's clients: every `*.pub` file in one directory, read once. A reload makes a new one.

    Raises ConfigError for a missing directory, for a bad file (by its name), and for a key that stands in two places.
    `warnings` names what lies there and is no public key file, or has the name of another client's, or is revoked.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: tuple[str, ...] = ()
        self._by_key: dict[str, tuple[ClientName, PublicKey, str]] = {}
        self._revoked: dict[str, tuple[ClientName, PublicKey]] = {}
        revoked = path / REVOKED_DIR
        if revoked.is_dir():
            for file in self._files(revoked):
                found = load_public(file)
                self._revoked.update({key.key: (found.name, key) for key in found.keys})
        for file in self._files(path):
            self._add(file)

    def _files(self, path: Path) -> list[Path]:
        try:
            entries = sorted(path.iterdir())
        except FileNotFoundError as error:
            raise ConfigError("no such directory", file=str(path)) from error
        except NotADirectoryError as error:
            raise ConfigError("is not a directory", file=str(path)) from error
        except OSError as error:
            raise ConfigError(f"can not be read: {error.strerror or error}", file=str(path)) from error
        shown = [e for e in entries if not e.name.startswith(".")]
        others = [e for e in shown if e.suffix != PUBLIC_SUFFIX and e.name != REVOKED_DIR]
        self.warnings += tuple(f"{e}: is not read, its name does not end in {PUBLIC_SUFFIX}" for e in others)
        return [e for e in shown if e.suffix == PUBLIC_SUFFIX]

    def _add(self, file: Path) -> None:
        keys = load_public(file)
        odd = misnamed(file, keys.name)
        if odd is not None:
            self.warnings = (*self.warnings, odd)
        for key in keys.keys:
            if key.key in self._revoked:
                problem = f"{file}: the key {fingerprint(key.key)} of {keys.name} is revoked, and lets nobody in"
                self.warnings = (*self.warnings, problem)
                continue
            known = self._by_key.get(key.key)
            if known is not None:
                problem = f"this key of {keys.name} stands also in {known[2]} as one of {known[0]}; remove one"
                raise ConfigError(problem, file=str(file), key="keys")
            self._by_key[key.key] = (keys.name, key, file.name)

    @property
    def names(self) -> tuple[ClientName, ...]:
        """Every client with a key, sorted; expired ones too."""
        return tuple(sorted({name for name, _, _ in self._by_key.values()}))

    def keys_of(self, name: ClientName) -> tuple[PublicKey, ...]:
        return tuple(key for owner, key, _ in self._by_key.values() if owner == name)

    def file_of(self, public_key: str) -> Path | None:
        """The file in which a key stands that is not revoked."""
        found = self._by_key.get(public_key)
        return None if found is None else self.path / found[2]

    def revoked(self) -> tuple[tuple[ClientName, PublicKey], ...]:
        """The keys that were revoked, and whose they were; each ends when it was revoked, if not before."""
        return tuple(self._revoked.values())

    def revoke(self, keys: Mapping[str, tuple[ClientName, PublicKey]]) -> tuple[tuple[ClientName, PublicKey], ...]:
        """Have these let nobody in either, which were revoked elsewhere. Returns those of them that stood here as keys
        that are not revoked, with the names that they had here."""
        found = []
        for text, (name, key) in keys.items():
            if text in self._revoked:
                continue
            held = self._by_key.pop(text, None)
            self._revoked[text] = (name if held is None else held[0], key)
            if held is not None:
                found.append((held[0], key))
        return tuple(found)

    def lapsed(self, *, at_s: float) -> tuple[str, ...]:
        """A phrase for each client of which no key holds at `at_s`."""
        found = ((name, PublicKeys(name, self.keys_of(name)).lapse(at_s)) for name in self.names)
        return tuple(f"{name} {lapse}: it cannot connect" for name, lapse in found if lapse is not None)

    def lookup(self, public_key: str | bytes, *, at_s: float) -> KeyMatch:
        """Whose key this is and whether it holds now. `public_key` is Z85 text, or 32 raw bytes as ZAP hands over."""
        text = _as_z85(public_key)
        found = self._by_key.get(text)
        if found is None:
            revoked = self._revoked.get(text)
            return KeyMatch(KeyStatus.UNKNOWN) if revoked is None else KeyMatch(KeyStatus.REVOKED, *revoked)
        return KeyMatch(found[1].status(at_s), found[0], found[1])


def _as_z85(key: str | bytes) -> str:
    if isinstance(key, str):
        return key
    if len(key) == RAW_KEY_BYTES:
        return z85.encode(key).decode()
    return key.decode("ascii", "replace")
