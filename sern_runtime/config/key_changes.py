"""Changes of the folder of client keys, each by one renamed or removed file at a time: one that is ended in the middle
leaves keys that hold as before or as they are to, and is done again from its beginning."""

import fcntl
import os
import pwd
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import ConfigError, RefusedError, UsageError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import (
    MAX_KEYS,
    PUBLIC_SUFFIX,
    REVOKED_DIR,
    KeyDirectory,
    KeyStatus,
    PublicKey,
    PublicKeys,
    is_key,
    load_public,
    utc,
    write_public,
)
from sern_runtime.whole_file import sync_directory

MAX_VALID: Final = 4
"""Keys of one client that hold at a time, as far as it adds them itself."""
REVOKED_DIR_MODE: Final = 0o700


def check_owner(path: Path) -> None:
    """What another user than the owner of a file or folder writes there the daemon may not be able to read: UsageError
    that says as whom to do it. What is not there belongs to nobody."""
    try:
        owner = path.stat().st_uid
    except OSError:
        return
    if owner != os.geteuid():
        try:
            name = pwd.getpwuid(owner).pw_name
        except KeyError:
            name = f"'#{owner}'"
        raise UsageError(f"{path} belongs to {name}: give the command as that user, with sudo -u {name}")


@contextmanager
def _changing(directory: Path) -> Iterator[None]:
    """One change at a time, of all processes: what one reads another does not change before it has written."""
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise ConfigError(f"can not be read: {error.strerror or error}", file=str(directory)) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def take_in(directory: Path, name: ClientName, asking: str, new: str, *, at_s: float, overlap_s: float) -> PublicKey:
    """Add the key `new` of a client beside `asking`, which ends `overlap_s` later. What it says of the new one.

    The new one holds as long as the other would have. Done before: nothing changes. RefusedError with a code and a line
    for the client where it may not be; ConfigError where a file cannot be read or written.
    """
    if not is_key(new):
        raise RefusedError("bad_key", "what was offered is no CURVE key")
    with _changing(directory):
        return _take_in(directory, name, asking, new, at_s, overlap_s)


def check_new(known: KeyDirectory, name: ClientName, asking: str, new: str, *, at_s: float) -> PublicKey:
    """The entry of the key that asks, where `new` may come beside it. RefusedError otherwise."""
    if known.lookup(new, at_s=at_s).status is not KeyStatus.UNKNOWN:
        raise RefusedError("bad_key", "the relay knows that key, and it is none that can be taken; make another")
    old = known.lookup(asking, at_s=at_s)
    if old.status is not KeyStatus.VALID or old.name != name or old.key is None:
        raise RefusedError("old_key", "the key that asks does not hold any more")
    if len([key for key in known.keys_of(name) if key.status(at_s) is KeyStatus.VALID]) >= MAX_VALID:
        raise RefusedError("too_many_keys", f"{name} has {MAX_VALID} keys that hold; wait until the oldest have ended")
    return old.key


def _take_in(directory: Path, name: ClientName, asking: str, new: str, at_s: float, overlap_s: float) -> PublicKey:
    known = KeyDirectory(directory)
    match = known.lookup(new, at_s=at_s)
    if match.status is KeyStatus.VALID and match.name == name and match.key is not None:
        return match.key
    old, file = check_new(known, name, asking, new, at_s=at_s), known.file_of(asking)
    assert file is not None
    added = PublicKey(new, not_after_s=old.not_after_s)
    ends_s = min(at_s + overlap_s, old.not_after_s or float("inf"))
    entries = [
        replace(key, not_after_s=ends_s) if key.key == asking else key
        for key in load_public(file).keys
        if key.status(at_s) is not KeyStatus.EXPIRED
    ]
    if len(entries) >= MAX_KEYS:
        raise RefusedError("too_many_keys", f"{file.name} holds {MAX_KEYS} keys at most")
    write_public(file, PublicKeys(name, (*entries, added)), replace=True)
    return added


class Revoked(NamedTuple):
    """What a revocation took out: the keys, and where they stand now (None: there was nothing left to take out)."""

    keys: tuple[PublicKey, ...]
    file: Path | None


def revoke(directory: Path, name: ClientName, *, at_s: float) -> Revoked:
    """Take every key of a client out, into a file of the folder `revoked`. ConfigError where a file cannot be read or
    written.

    The revoked ones are written first: from then on they let nobody in, whatever becomes of the rest.
    """
    with _changing(directory):
        return _revoke(directory, name, at_s)


def _revoke(directory: Path, name: ClientName, at_s: float) -> Revoked:
    directory_now = KeyDirectory(directory)
    files = [file for file in _files_of(directory) if load_public(file).name == name]
    keys = directory_now.keys_of(name)
    target = None
    if keys:
        ended = tuple(replace(key, not_before_s=None, not_after_s=min(at_s, key.not_after_s or at_s)) for key in keys)
        target = _write_revoked(directory, name, ended, at_s)[0]
    for file in files:
        _remove(file)
    return Revoked(keys, target)


def _write_revoked(
    directory: Path, name: ClientName, keys: Sequence[PublicKey], at_s: float, *, suffix: str = ""
) -> list[Path]:
    """The files in the folder `revoked` that have these keys of a client now."""
    folder = directory / REVOKED_DIR
    stem = f"{name}-{datetime.fromtimestamp(at_s, UTC):%Y%m%dT%H%M%S%fZ}"
    try:
        folder.mkdir(mode=REVOKED_DIR_MODE, exist_ok=True)
        sync_directory(directory)
    except OSError as error:
        raise ConfigError(f"can not be made: {error.strerror or error}", file=str(folder)) from error
    written = []
    # A file holds MAX_KEYS; several files of one name may hold more.
    for start in range(0, len(keys), MAX_KEYS):
        part = f".{start}" if start else ""
        path = folder / f"{stem}{suffix}{part}{PUBLIC_SUFFIX}"
        write_public(path, PublicKeys(name, tuple(keys[start : start + MAX_KEYS])))
        written.append(path)
    return written


def _remove(file: Path) -> None:
    try:
        file.unlink()
        sync_directory(file.parent)
    except OSError as error:
        raise ConfigError(f"can not be removed: {error.strerror or error}", file=str(file)) from error


def keep_revoked(
    directory: Path, revoked: Sequence[tuple[ClientName, PublicKey]], *, by: str, at_s: float
) -> tuple[Path, ...]:
    """Write down keys that the relay `by` revoked, into files of the folder `revoked` that have its name, and take them
    out of the other files; each key ends when it was revoked. Returns the new files. Done before: nothing changes.
    ConfigError where a file cannot be read or written."""
    with _changing(directory):
        known = {key.key for _name, key in KeyDirectory(directory).revoked()}
        by_name: dict[ClientName, list[PublicKey]] = {}
        for name, key in revoked:
            if key.key not in known:
                by_name.setdefault(name, []).append(key)
        written = [
            path
            for name, keys in by_name.items()
            for path in _write_revoked(directory, name, keys, at_s, suffix=f".told-by-{by}")
        ]
        gone = {key.key for _name, key in revoked}
        for file in _files_of(directory):
            held = load_public(file)
            left = tuple(key for key in held.keys if key.key not in gone)
            if not left:
                _remove(file)
            elif left != held.keys:
                write_public(file, PublicKeys(held.name, left), replace=True)
        return tuple(written)


def add_client(directory: Path, keys: PublicKeys, *, replacing: bool, at_s: float) -> Path:
    """Write the first key of a client, `NAME.pub`. With `replacing` what it had is revoked, and the new one takes its
    place. ConfigError where it has one without it, or the key is known already."""
    with _changing(directory):
        known = KeyDirectory(directory)
        for key in keys.keys:
            if known.lookup(key.key, at_s=at_s).status is not KeyStatus.UNKNOWN:
                raise ConfigError("holds that key already, or held it once; make another", file=str(directory))
        path = directory / f"{keys.name}{PUBLIC_SUFFIX}"
        if (path.exists() or known.keys_of(keys.name)) and not replacing:
            raise ConfigError(f"{keys.name} has a key already; --replace revokes it", file=str(path))
        if replacing:
            _revoke(directory, keys.name, at_s)
        write_public(path, keys)
        return path


def revoked_at(directory: KeyDirectory, name: ClientName) -> str | None:
    """When the last key of a client was revoked, for people; None: none was."""
    times = [key.not_after_s or 0.0 for owner, key in directory.revoked() if owner == name]
    return utc(max(times)) if times else None


def _files_of(directory: Path) -> list[Path]:
    return [file for file in sorted(directory.glob(f"*{PUBLIC_SUFFIX}")) if not file.name.startswith(".")]
