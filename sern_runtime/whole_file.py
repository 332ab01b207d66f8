"""Small files that are whole whatever happens: as they were, or as they are to be, also after a loss of power."""

import os
import secrets
from contextlib import suppress
from pathlib import Path


def write_whole(path: Path, text: str, *, mode: int = 0o600, replace: bool = True) -> None:
    """Write a file of this mode (less the process's umask). Raises OSError, and then it is as it was; FileExistsError
    where there is one that is not to be replaced."""
    # A name of its own: two processes may write the same file at the same time.
    target = path.with_name(f".{path.name}.{secrets.token_hex(8)}.new")
    try:
        # O_EXCL: neither an existing file nor a link that someone placed there is followed.
        descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        if replace:
            target.replace(path)
        else:
            path.hardlink_to(target)
            target.unlink()
        sync_directory(path.parent)
    finally:
        with suppress(OSError):  # of a folder that cannot be written, where it is not
            target.unlink(missing_ok=True)


def sync_directory(path: Path) -> None:
    """Have what was renamed and removed in a folder outlive a loss of power. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
