"""One zenoh session as rmw_zenoh has it: a peer that finds others through the router it connects to.

Everything that zenoh does in threads of its own arrives on the event loop through a `Handover`; everything that may
block (opening, closing, putting into a full transmission queue) is done off the loop.
"""

import asyncio
import json
import logging
import re
import secrets
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from types import ModuleType
from typing import Any, Final

from sern_client.endpoints.common.handover import Handover
from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.endpoints import installing
from sern_runtime.ros_types import one_line

DEFAULT_CONNECT: Final = ("tcp/localhost:7447",)
DEFAULT_LISTEN: Final = ("tcp/localhost:0",)
MAX_WAITING_BYTES: Final = 64 * 2**20
"""Messages that may wait for zenoh's transmission queue; beyond, the oldest are dropped and counted."""

_WITH_PORT: Final = re.compile(r"((?:tcp|udp|tls|quic|ws)/)([^?#]*):([0-9]+)((?:[?#].*)?)")
_ON_THIS_HOST: Final = re.compile(r"(?:unixsock-stream|unixpipe)/.*")
_EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""Addresses to listen on that are none to connect to, and what leads there on this host."""

_log = logging.getLogger(__name__)


def load_zenoh() -> ModuleType:
    """The zenoh module; ConfigError naming the command that installs it."""
    try:
        import zenoh
        import zenoh.ext
    except ImportError:
        raise ConfigError(f"needs the zenoh library: {installing('eclipse-zenoh')}") from None
    return zenoh


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """`config_file` (zenoh's own JSON5) replaces the defaults of rmw_zenoh; `connect` and `listen` go on top, None: as
    the file has it, else as rmw_zenoh has it. `listen` empty: a free port of loopback.

    `second`: another process has a session of the same options already, and this one is to reach whom that one reaches.
    """

    connect: tuple[str, ...] | None = None
    listen: tuple[str, ...] | None = None
    config_file: Path | None = None
    second: bool = False


def make_config(zenoh: ModuleType, options: SessionOptions) -> Any:
    """ConfigError for a file or locator that zenoh does not accept."""
    connect, listen = options.connect, options.listen
    if options.config_file is None:
        connect, listen = DEFAULT_CONNECT if connect is None else connect, listen or DEFAULT_LISTEN
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
        if connect is not None:
            config.insert_json5("connect/endpoints", json.dumps(list(connect)))
        if listen is not None:
            config.insert_json5("listen/endpoints", json.dumps(list(listen or DEFAULT_LISTEN)))
        if options.second:
            _step_aside(config)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh does not accept this: {one_line(error)}") from None
    return config


def _step_aside(config: Any) -> None:
    """Make of the configuration of a session that of a second one beside it.

    Peers do not pass on what others publish, so the second session needs links of its own to whoever is linked to the
    first. Those that come to a locator of the first learn there of the second one, which therefore comes there as well,
    and listens at the same addresses, at ports that are free.
    """
    connect, listen = _locators(config, "connect/endpoints"), _locators(config, "listen/endpoints")
    if json.loads(config.get_json("mode")) != "client":  # which has one link, to its router
        connect += [there for locator in listen if (there := _reached_at(locator)) is not None]
    config.insert_json5("connect/endpoints", json.dumps(list(dict.fromkeys(connect))))
    matches = [match for locator in listen if (match := _WITH_PORT.fullmatch(locator))]
    free = (f"{match[1]}{match[2]}:0{match[4]}" for match in matches)
    config.insert_json5("listen/endpoints", json.dumps(list(dict.fromkeys(free))))
    if json.loads(config.get_json("id")) is not None:  # no two sessions have one
        config.insert_json5("id", json.dumps(f"{1 << 127 | secrets.randbits(127):x}"))


def _locators(config: Any, key: str) -> list[str]:
    """What the configuration has at `key`, where there are locators, or locators for each mode."""
    found, mode = json.loads(config.get_json(key)), json.loads(config.get_json("mode")) or "peer"
    return list(found.get(mode, ()) if isinstance(found, dict) else found)


def _reached_at(locator: str) -> str | None:
    """Where a process of this host reaches one that listens there; None: nobody can tell, or only one can."""
    if match := _WITH_PORT.fullmatch(locator):
        return f"{match[1]}{_EVERYWHERE.get(match[2], match[2])}:{match[3]}{match[4]}" if int(match[3]) else None
    return locator if _ON_THIS_HOST.fullmatch(locator) else None


class ZenohSession:
    """`open` once, `close` once. `zid` is what the graph calls the session."""

    def __init__(self, options: SessionOptions) -> None:
        self.zenoh = load_zenoh()
        self.put_dropped = 0
        """Messages dropped because zenoh did not take them in time."""
        self.put_failed = 0
        """Messages that zenoh refused: its session has ended."""
        self._config = make_config(self.zenoh, options)
        self.connect = tuple(_locators(self._config, "connect/endpoints"))
        """Where it looks for others."""
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
        """Drop the oldest messages, under the lock. What has no bytes is an end of something, and must be told."""
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
