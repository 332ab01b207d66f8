"""One zenoh session as rmw_zenoh has it: a peer that finds others through the router it connects to.

Everything that zenoh does in threads of its own arrives on the event loop through a `Handover`; everything that may
block (opening, closing, putting into a full transmission queue) is done off the loop.
"""

import asyncio
import json
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from types import ModuleType
from typing import Any, Final

from sern_client.endpoints.handover import Handover
from sern_core.errors import ConfigError
from sern_runtime.ros_types import one_line

DEFAULT_CONNECT: Final = ("tcp/localhost:7447",)
MAX_WAITING_BYTES: Final = 64 * 2**20
"""Messages that may wait for zenoh's transmission queue; beyond, the oldest are dropped and counted."""

_log = logging.getLogger(__name__)


def load_zenoh() -> ModuleType:
    """The zenoh module; ConfigError naming the extra that brings it."""
    try:
        import zenoh
        import zenoh.ext
    except ImportError:
        raise ConfigError("needs the zenoh library: pip install eclipse-zenoh") from None
    return zenoh


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """`config_file` (zenoh's own JSON5) replaces the defaults of rmw_zenoh; `connect` and `listen` go on top."""

    connect: tuple[str, ...] = DEFAULT_CONNECT
    listen: tuple[str, ...] = ()
    config_file: Path | None = None


def make_config(zenoh: ModuleType, options: SessionOptions) -> Any:
    """ConfigError for a file or locator that zenoh does not accept."""
    try:
        if options.config_file is not None:
            config = zenoh.Config.from_file(str(options.config_file))
        else:
            config = zenoh.Config()
            settings: dict[str, Any] = {
                "mode": "peer",
                # The router may come later than we do, and go.
                "connect/timeout_ms": -1,
                "connect/exit_on_failure": False,
                "scouting/multicast/enabled": False,
                "scouting/gossip/enabled": True,
                "timestamping/enabled": True,  # what publishers with a cache need
                "transport/shared_memory/enabled": False,
            }
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
        config.insert_json5("connect/endpoints", json.dumps(list(options.connect)))
        config.insert_json5("listen/endpoints", json.dumps(list(options.listen or ("tcp/localhost:0",))))
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh does not accept this: {one_line(error)}") from None
    return config


class ZenohSession:
    """`open` once, `close` once. `zid` is what the graph calls the session."""

    def __init__(self, options: SessionOptions) -> None:
        self.zenoh = load_zenoh()
        self.put_dropped = 0
        """Messages dropped because zenoh did not take them in time."""
        self.put_failed = 0
        """Messages that zenoh refused: its session has ended."""
        self._config = make_config(self.zenoh, options)
        self._session: Any = None
        self._handover: Handover | None = None
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._waiting_bytes = 0
        self._wake = Condition()
        self._stopping = False
        self._faulty = False
        self._writer = Thread(target=self._write, name="zenoh-writer", daemon=True)

    async def open(self) -> None:
        """ConfigError when zenoh cannot listen where it should."""
        self._handover = Handover(asyncio.get_running_loop())
        try:
            self._session = await asyncio.to_thread(self.zenoh.open, self._config)
        except self.zenoh.ZError as error:
            raise ConfigError(f"zenoh: {one_line(error)}") from None
        self._writer.start()

    async def close(self) -> None:
        """Everything declared in the session goes with it. Idempotent."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._writer.is_alive():
            await asyncio.to_thread(self._writer.join)
        if self._handover is not None:
            self._handover.close()
        session, self._session = self._session, None
        if session is not None:
            await asyncio.to_thread(session.close)

    @property
    def opened(self) -> Any:
        """The session of the library."""
        assert self._session is not None, "the session is open between `open` and `close`"
        return self._session

    @property
    def zid(self) -> str:
        return str(self.opened.info.zid())

    @property
    def handover(self) -> Handover:
        assert self._handover is not None, "the session is open between `open` and `close`"
        return self._handover

    @property
    def problem(self) -> str | None:
        """Why nothing is published any more, in one line; None while all is well."""
        if self._session is not None and not self._stopping and not self._writer.is_alive():
            return "the thread that writes to zenoh has ended; start the client again"
        return None

    def refused(self) -> None:
        """Count a message that zenoh cannot take."""
        with self._wake:
            self.put_failed += 1

    def put(self, put: Callable[[], None], nbytes: int) -> None:
        """Do `put` in the writer's thread, in order: zenoh blocks the one who puts while its queue is full."""
        with self._wake:
            self._waiting.append((put, nbytes))
            self._waiting_bytes += nbytes
            if self._waiting_bytes > MAX_WAITING_BYTES:
                self._shed()
            self._wake.notify()

    def _shed(self) -> None:
        """Under the lock: the oldest messages go. What has no bytes is an end of something, and must be told."""
        kept: deque[tuple[Callable[[], None], int]] = deque()
        while self._waiting_bytes > MAX_WAITING_BYTES and len(self._waiting) > 1:
            item = self._waiting.popleft()
            if item[1]:
                self._waiting_bytes -= item[1]
                self.put_dropped += 1
            else:
                kept.append(item)
        self._waiting.extendleft(reversed(kept))

    def _write(self) -> None:
        while True:
            with self._wake:
                while not self._waiting and not self._stopping:
                    self._wake.wait()
                if not self._waiting:
                    return
                put, nbytes = self._waiting.popleft()
                self._waiting_bytes -= nbytes
            try:
                put()
            except Exception as error:  # noqa: BLE001  whatever a library raises: the next message must go on
                if nbytes:
                    self.refused()
                if isinstance(error, self.zenoh.ZError):
                    _log.debug("zenoh did not take a message: %s", error)
                elif not self._faulty:
                    self._faulty = True
                    _log.exception("a fault in writing to zenoh")
