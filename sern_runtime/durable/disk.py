"""A daemon's store, opened, and what writes to it: what client and relay do alike."""

import asyncio
import logging
import secrets
from collections.abc import Callable
from pathlib import Path

from sern_runtime.durable.keeper import Keeper, Keeps, OpensStore, Stored
from sern_runtime.durable.store import Contents, Store, StoreError

_log = logging.getLogger(__name__)


class Disk:
    """`make_keeper` makes what writes to the store; its `Stored` is given to `open`."""

    def __init__(self, store: OpensStore, make_keeper: Callable[[Stored], Keeps]) -> None:
        self._store = store
        self._make_keeper = make_keeper
        self._problem: str | None = None
        self._looks = 0
        self.keeper: Keeps | None = None
        """What writes; None: nothing is kept by this process."""
        self.damaged = 0
        """Messages, and other things, that could not be read when the store was opened."""

    @classmethod
    def within(cls, directory: Path, *, max_bytes: int, shared: bool = False) -> "Disk":
        """The files in this directory; to be opened in a running loop."""
        store = Store(directory)

        def keeper(stored: Stored) -> Keeper:
            call_soon = asyncio.get_running_loop().call_soon_threadsafe
            return Keeper(store, call_soon=call_soon, stored=stored, max_bytes=max_bytes, shared=shared)

        return cls(store, keeper)

    @property
    def problem(self) -> str | None:
        """Why nothing is kept at the moment; None: it is."""
        return self._problem or (None if self.keeper is None else self.keeper.problem)

    def progress(self, *, now: float) -> int:
        """What the watchdog looks at, as `Keeper.progress`: where nothing is kept nothing can be stuck."""
        if self.keeper is not None:
            return self.keeper.progress(now=now)
        self._looks += 1
        return self._looks

    def open(self, stored: Stored) -> Contents | None:
        """Begin to write, and return what earlier processes have left. `stored` is told what is on disk.

        Raises ConfigError for a directory that cannot be used. None: the disk is full or fails; the log and `problem`
        say so, and durable topics are for this process what reliable ones are.
        """
        try:
            contents = self._store.open(new_boot=secrets.randbits(63))
        except StoreError as error:
            self._problem = str(error)
            _log.error("durable topics are not kept by this process: %s; make room and start it again", error)
            return None
        self.damaged = len(contents.damage)
        for line in contents.damage:
            _log.error("durable topics: %s", line)
        keeper = self.keeper = self._make_keeper(stored)
        for stream, found in contents.streams.items():
            for row in found.rows:
                keeper.found(stream, row.seq, len(row.body))
        keeper.start()
        return contents

    def close(self) -> None:
        """Have everything on disk that was taken. Idempotent."""
        if self.keeper is not None:
            self.keeper.close()
        else:
            self._store.close()
