"""A file system of apsw that writes down what is asked of the disk, and what a power cut may leave of it.

Until a file is synced, any of the writes to it since its last sync may be on the disk or not, in any order, and each of
them in part: that is what a disk with a write cache does.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import apsw

SECTOR_BYTES: Final = 512


@dataclass(frozen=True, slots=True)
class Op:
    """Something that was asked of the disk: `write`, `truncate`, `sync`, `delete`."""

    what: str
    name: str
    offset: int = 0
    data: bytes = b""


class Recorder(apsw.VFS):
    """The usual file system, of which `ops` has everything in order. `before` is called before each of them."""

    def __init__(self, name: str, *, before: Callable[[Op], None] = lambda _op: None) -> None:
        self.ops: list[Op] = []
        self.before = before
        super().__init__(name, base="")

    def note(self, op: Op) -> None:
        self.before(op)
        self.ops.append(op)

    def xOpen(self, name: Any, flags: list[int]) -> "_File":  # noqa: N802  (SQLite's names)
        return _File(self, name, flags)

    def xDelete(self, filename: str, syncdir: bool) -> None:  # noqa: N802
        self.note(Op("delete", Path(filename).name))
        super().xDelete(filename, syncdir)


class _File(apsw.VFSFile):
    def __init__(self, vfs: Recorder, name: Any, flags: list[int]) -> None:
        self._vfs = vfs
        self._name = Path(name.filename() if isinstance(name, apsw.URIFilename) else str(name)).name
        super().__init__("", name, flags)

    def xWrite(self, data: Any, offset: int) -> None:  # noqa: N802
        self._vfs.note(Op("write", self._name, offset, bytes(data)))
        super().xWrite(data, offset)

    def xTruncate(self, newsize: int) -> None:  # noqa: N802
        self._vfs.note(Op("truncate", self._name, newsize))
        super().xTruncate(newsize)

    def xSync(self, flags: int) -> None:  # noqa: N802
        self._vfs.note(Op("sync", self._name))
        super().xSync(flags)


def left(ops: list[Op], rng: random.Random, *, survives: float) -> dict[str, bytes]:
    """The files as a cut after `ops` may leave them. `survives`: how likely each write is that was not synced."""
    files: dict[str, bytearray] = {}
    unsynced: dict[str, list[Op]] = {}
    for op in ops:
        if op.what == "sync":
            for done in unsynced.pop(op.name, []):
                _apply(files, done)
        elif op.what == "delete":
            unsynced.pop(op.name, None)
            files.pop(op.name, None)
        else:
            unsynced.setdefault(op.name, []).append(op)
    for waiting in unsynced.values():
        rng.shuffle(waiting)
        for op in waiting:
            if rng.random() < survives:
                torn = op.what == "write" and rng.random() < 0.3
                size = SECTOR_BYTES * rng.randrange(1 + len(op.data) // SECTOR_BYTES) if torn else len(op.data)
                _apply(files, Op(op.what, op.name, op.offset, op.data[:size]))
    return {name: bytes(content) for name, content in files.items()}


def _apply(files: dict[str, bytearray], op: Op) -> None:
    content = files.setdefault(op.name, bytearray())
    if op.what == "truncate":
        del content[op.offset :]
        return
    if len(content) < op.offset:
        content.extend(bytes(op.offset - len(content)))
    content[op.offset : op.offset + len(op.data)] = op.data
