"""The local socket of a daemon: one request and one answer a connection, for whoever runs it and for root alone.

A line of JSON each way, the request first; an answer with `error` says in one line what is wrong. The socket has mode
0600 from the moment it is there. Where it is: `$RUNTIME_DIRECTORY` (a unit's `RuntimeDirectory=`), else
`$XDG_RUNTIME_DIR/sern`, else `/tmp/sern-UID`, which is used only if it is a directory of this user and of nobody else.
"""

import asyncio
import json
import logging
import os
import socket
import stat
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_runtime.entry import end_tasks

MAX_LINE_BYTES: Final = 64 * 1024
MAX_CONNECTIONS: Final = 16
REQUEST_S: Final = 5.0
"""Longest wait for a request on a connection that was made."""
PROBE_S: Final = 1.0
ANSWER_S: Final = 40.0
"""Longest wait of a tool for an answer: longer than a question to another site may take."""
MAX_PATH_BYTES: Final = 107
"""The longest name of a unix socket that the kernel takes."""
SUFFIX: Final = ".sock"

Json = dict[str, Any]
Handle = Callable[[Json], Awaitable[Json]]
"""Answers a request. UsageError and SernError become answers that say so."""

_log = logging.getLogger(__name__)


def socket_directory(environment: Mapping[str, str] = os.environ) -> Path:
    """The directory in which daemons of this user have their local sockets."""
    unit, session = environment.get("RUNTIME_DIRECTORY"), environment.get("XDG_RUNTIME_DIR")
    if unit:
        return Path(unit.split(":")[0])
    return Path(session) / "sern" if session else _directory_in_tmp()


def _directory_in_tmp() -> Path:
    return Path(f"/tmp/sern-{os.getuid()}")


def sockets(environment: Mapping[str, str] = os.environ) -> dict[str, Path]:
    """The local sockets that this user can see, by the name of their client: of units, and of this user's own. Left out
    is what a daemon has left that was killed, and what others could have put into a directory of this user's: that
    would answer in a daemon's place."""
    own = (socket_directory(environment), _directory_in_tmp())
    found: dict[str, Path] = {}
    for place in (*own, *sorted(Path("/run").glob("sern-*"))):  # of root's making alone
        with suppress(OSError):
            if place in own and not _is_own(place):
                continue
            for path in sorted(place.glob(f"*{SUFFIX}")):
                if not _is_left(path):
                    found.setdefault(path.name.removesuffix(SUFFIX), path)
    return found


def _is_left(path: Path) -> bool:
    """Whether nobody listens on a socket any more."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return True
        except OSError:  # such as one that is not ours to speak to: that is said when it is asked
            return False
    return False


def ask(path: Path, request: Json, *, timeout_s: float = ANSWER_S) -> Json:
    """The answer of the daemon at `path`. Raises SernError when there is none, and for what it says is wrong."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as answers:
                line = answers.readline(MAX_LINE_BYTES + 1)
        except PermissionError:
            raise SernError(f"{path}: not yours to speak to; run this as the daemon's user, or with sudo") from None
        except (FileNotFoundError, ConnectionRefusedError):
            raise SernError(f"{path}: no daemon is there; start the client, or name another with --client") from None
        except TimeoutError:
            raise SernError(f"{path}: no answer in {timeout_s:g} s; is the daemon held up? See its log") from None
        except OSError as error:
            raise SernError(f"{path}: {error.strerror or error}; see the daemon's log") from None
    try:
        answer = json.loads(line)
    except ValueError:
        raise SernError(f"{path}: what answers is no daemon of this release, or it ended; see its log") from None
    if not isinstance(answer, dict):
        raise SernError(f"{path}: what answers is no daemon of this release")
    if "error" in answer:
        kind = UsageError if answer.get("usage") else SernError
        raise kind(str(answer["error"]))
    return answer


class LocalServer:
    """Serves one daemon's socket. `start`, then `stop`."""

    def __init__(self, path: Path, handle: Handle) -> None:
        self.path = path
        self.refused = 0
        """Connections too many, and requests that were none."""
        self._handle = handle
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Raises ConfigError when it cannot be had."""
        made = _listener(self.path)
        self._server = await asyncio.start_unix_server(self._connected, sock=made, limit=MAX_LINE_BYTES)

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
            await end_tasks(list(self._tasks))
            await self._server.wait_closed()
            self._server = None
            with suppress(OSError):
                self.path.unlink()

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._tasks) >= MAX_CONNECTIONS:
            self.refused += 1
            writer.close()
            return
        task = asyncio.create_task(self._serve(reader, writer), name="local-socket")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(REQUEST_S):
                line = await reader.readline()
            answer = await self._answer(line)
            writer.write(json.dumps(answer).encode() + b"\n")
            await writer.drain()
        except (TimeoutError, ValueError, OSError):  # too slow, too long, or gone
            self.refused += 1
        finally:
            writer.close()

    async def _answer(self, line: bytes) -> Json:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise UsageError("a request is a JSON object")
            return await self._handle(request)
        except UsageError as error:
            return {"error": str(error), "usage": True}
        except SernError as error:
            return {"error": str(error)}
        except (ValueError, RecursionError):
            self.refused += 1
            return {"error": "a request is one line of JSON", "usage": True}
        except Exception:  # noqa: BLE001  (of one request; whoever asked is told)
            _log.exception("a request on %s failed", self.path)
            return {"error": "an error of the daemon; its log has the traceback"}


def _listener(path: Path) -> socket.socket:
    """A listening socket of mode 0600. What an earlier process has left there goes, another daemon's stays."""
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise ConfigError(f"{path}: a socket's name has at most {MAX_PATH_BYTES} bytes; name a shorter one")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        _own_directory(path.parent)
        if path.exists():
            _take_over(path)
        os.fchmod(listener.fileno(), 0o600)  # the file's mode from its first moment
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except ConfigError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def _is_own(directory: Path) -> bool:
    """Whether it is a directory of this user alone. Raises OSError where there is none."""
    seen = directory.lstat()
    return stat.S_ISDIR(seen.st_mode) and seen.st_uid == os.getuid() and not seen.st_mode & 0o022


def _own_directory(directory: Path) -> None:
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_own(directory):
        raise ConfigError(f"{directory}: is not a directory of this user alone; remove it, or set local.socket")


def _take_over(path: Path) -> None:
    """Raises ConfigError for a socket on which somebody listens."""
    if not _is_left(path):
        raise ConfigError(f"{path}: another daemon has it; remove it, or give one of the two local.socket")
    path.unlink(missing_ok=True)
