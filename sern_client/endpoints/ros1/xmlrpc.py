"""XML-RPC over asyncio: the client and the server of a ROS node. Encoding and decoding are the standard library's."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, cast
from urllib.parse import urlsplit
from xmlrpc.client import Fault, dumps, loads

from sern_client.endpoints.ros1.http import HttpMessage, HttpReader
from sern_client.endpoints.ros1.listener import Listener
from sern_core.vocabulary.errors import RemoteError, WireError
from sern_runtime.ros_types import one_line

CALL_TIMEOUT_S: Final = 5.0
MAX_ANSWER_BYTES: Final = 32 * 2**20
"""The state of a master with ten thousand topics is about 5 MB."""
MAX_REQUEST_BYTES: Final = 64 * 2**10
"""What a node is asked and answers: the longest is a list of some hundred publishers. It is decoded on the loop."""
MAX_CONNECTIONS: Final = 256
IDLE_S: Final = 20.0
"""How long a begun request may take to arrive."""

Dispatch = Callable[[str, tuple[Any, ...]], Any]
"""`dispatch(method, params)` gives what `dumps` takes; it raises LookupError for an unknown method."""

_log = logging.getLogger(__name__)


class CallError(RemoteError):
    """A call was answered with no, or with nonsense."""


class UnreachableError(CallError):
    """Nobody answers there."""


MAX_HOST: Final = 253
"""Characters of the longest name that DNS has (RFC 1035)."""
MAX_URI: Final = 2_000


def check_host(host: str) -> None:
    """CallError for a host that no resolver can be asked for. An event loop would raise UnicodeError, of another kind
    than all else that ends a connection: for an empty label (`.local`), one of more than 63 characters and the like."""
    try:
        if len(host) > MAX_HOST:
            raise UnicodeError  # and its encoding would take seconds
        host.encode("idna")
    except UnicodeError:
        raise CallError(f"{host[:200]!r} is no name of a host") from None


def split_uri(uri: str, scheme: str = "http") -> tuple[str, int]:
    """Host and port of `http://host:port/` or `rosrpc://host:port`. CallError for anything else."""
    try:
        if len(uri) > MAX_URI:
            raise ValueError
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.scheme != scheme:
        raise CallError(f"{uri[:200]!r} is not {scheme}://host:port")
    check_host(host)
    return host, port


def decode_call(body: bytes) -> tuple[tuple[Any, ...], str | None]:
    """Parameters and method name of a request or an answer. WireError when it is none; Fault when it is one."""
    if b"<!" in body:  # no peer needs declarations, and entities are how XML is made to blow up
        raise WireError("XML-RPC with declarations in it")
    try:
        return loads(body, use_builtin_types=True)
    except Fault:
        raise
    except Exception as error:  # the parsers raise almost anything at bytes that are no XML-RPC
        raise WireError(f"not XML-RPC: {one_line(error)}") from error


class _Exchange(asyncio.Protocol):
    """The client's end of one connection: one request at a time."""

    def __init__(self, max_answer_bytes: int) -> None:
        self.transport: asyncio.Transport | None = None
        self.reusable = False
        self._reader = HttpReader(max_body_bytes=max_answer_bytes, answers=True)
        self._answer: asyncio.Future[HttpMessage] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)  # uvloop's is no subclass of it

    def data_received(self, data: bytes) -> None:
        try:
            message = self._reader.feed(data)
        except WireError as error:
            self._fail(error)
            self.close()
            return
        if message is not None:
            self._done(message)

    def _done(self, message: HttpMessage) -> None:
        self.reusable = message.keep_alive and not self._reader.pending and self.transport is not None
        if self._answer is not None and not self._answer.done():
            self._answer.set_result(message)

    def _fail(self, error: Exception) -> None:
        self.reusable = False
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(error)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        if (message := self._reader.finish()) is not None:
            self._done(message)
        self._fail(exc or ConnectionResetError("the connection was closed"))

    async def ask(self, request: bytes) -> HttpMessage:
        if self.transport is None:
            raise ConnectionResetError("the connection was closed")
        self.reusable = False
        self._answer = asyncio.get_running_loop().create_future()
        self.transport.write(request)
        try:
            return await self._answer
        finally:
            self._answer = None

    def close(self) -> None:
        if self.transport is not None:
            self.transport.abort()
            self.transport = None


class XmlRpcClient:
    """Calls one server over one connection, which is kept. Calls wait for each other."""

    def __init__(
        self, uri: str, *, timeout_s: float = CALL_TIMEOUT_S, max_answer_bytes: int = MAX_ANSWER_BYTES
    ) -> None:
        """CallError for a URI that is not http://host:port."""
        self.uri = uri
        self.timeout_s = timeout_s
        self._max_answer_bytes = max_answer_bytes
        self._host, self._port = split_uri(uri)
        self._exchange: _Exchange | None = None
        self._lock = asyncio.Lock()

    async def request(self, method: str, *params: Any) -> bytes:
        """The undecoded answer. UnreachableError when none comes in time."""
        body = dumps(params, method).encode()
        head = (
            f"POST / HTTP/1.1\r\nHost: {self._host}:{self._port}\r\nUser-Agent: sern\r\n"
            f"Content-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        async with self._lock:
            try:
                async with asyncio.timeout(self.timeout_s):
                    answer = await self._ask(head.encode() + body)
            except TimeoutError:
                raise UnreachableError(f"{self.uri}: no answer within {self.timeout_s:g} s") from None
            except (OSError, WireError) as error:
                raise UnreachableError(f"{self.uri}: {reason(error)}") from error
            finally:
                if self._exchange is not None and not self._exchange.reusable:
                    self.close()
        status = answer.start.split(" ")
        if len(status) < 2 or status[1] != "200":
            raise CallError(f"{self.uri}: HTTP {' '.join(status[1:])[:100]}")
        return answer.body

    async def _ask(self, request: bytes) -> HttpMessage:
        if self._exchange is not None:
            # The server may have closed an idle connection; what a node asks can be asked twice.
            with suppress(OSError):
                return await self._exchange.ask(request)
            self.close()
        loop = asyncio.get_running_loop()
        _, self._exchange = await loop.create_connection(
            lambda: _Exchange(self._max_answer_bytes), self._host, self._port
        )
        return await self._exchange.ask(request)

    async def call(self, method: str, *params: Any) -> Any:
        """The value of a ROS API call, which answers (code, text, value). CallError unless the code is 1."""
        return value_of(await self.request(method, *params), self.uri, method)

    def close(self) -> None:
        if self._exchange is not None:
            self._exchange.close()
            self._exchange = None


def value_of(answer: bytes, uri: str, method: str) -> Any:
    """The value in an undecoded ROS API answer. CallError unless its code is 1."""
    try:
        params, _ = decode_call(answer)
    except Fault as fault:
        raise CallError(f"{uri}: {method}: {str(fault.faultString)[:200]}") from None
    except WireError as error:
        raise CallError(f"{uri}: {method}: {error}") from None
    triple = params[0] if len(params) == 1 else None
    if not isinstance(triple, list) or len(triple) != 3 or not isinstance(triple[0], int):
        raise CallError(f"{uri}: {method}: the answer is not (code, text, value)")
    if triple[0] != 1:
        raise CallError(f"{uri}: {method}: {str(triple[1])[:200]}")
    return triple[2]


def reason(error: BaseException) -> str:
    """Why a connection failed, in a few words."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return one_line(error)


class _Server(asyncio.Protocol):
    """The server's end of one connection."""

    def __init__(self, owner: "XmlRpcServer") -> None:
        self._owner = owner
        self._reader = HttpReader(max_body_bytes=MAX_REQUEST_BYTES, answers=False)
        self._transport: asyncio.Transport | None = None
        self._patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        if len(self._owner.connections) >= MAX_CONNECTIONS:
            self.close()
            return
        self._owner.connections.add(self)
        self._wait(True)

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self._owner.connections.discard(self)
        self._wait(False)
        self._transport = None

    def _wait(self, on: bool) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None
        if on:
            self._patience = asyncio.get_running_loop().call_later(IDLE_S, self._impatient)

    def _impatient(self) -> None:
        # An idle connection is fine, half a request is not.
        if self._reader.pending:
            self.close()

    def data_received(self, data: bytes) -> None:
        try:
            message = self._reader.feed(data)
            while message is not None and self._transport is not None:
                self._answer(message)
                message = self._reader.feed(b"")
        except WireError as error:
            self._write("400 Bad Request", str(error).encode(), "text/plain", keep=False)
        self._wait(self._reader.pending)

    def _answer(self, message: HttpMessage) -> None:
        if not message.start.startswith("POST "):
            self._write("501 Not Implemented", b"XML-RPC only: POST", "text/plain", keep=False)
            return
        self._write("200 OK", self._owner.answer(message.body), "text/xml", keep=message.keep_alive)

    def _write(self, status: str, body: bytes, kind: str, *, keep: bool) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        end = "" if keep else "Connection: close\r\n"
        head = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n{end}\r\n"
        self._transport.write(head.encode() + body)
        if not keep:
            self._transport.close()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.abort()


class XmlRpcServer(Listener):
    """Serves calls from `start` to `stop`; every call is answered at once, on the loop's thread."""

    def __init__(self, dispatch: Dispatch) -> None:
        super().__init__(lambda: _Server(self))
        self.connections: set[_Server] = set()
        self._dispatch = dispatch

    async def end_connections(self) -> None:
        for connection in list(self.connections):
            connection.close()

    def answer(self, body: bytes) -> bytes:
        """The answer to one request, a fault when it cannot be carried out."""
        try:
            params, method = decode_call(body)
            if method is None:
                raise WireError("not a call")
            result: Sequence[Any] = (self._dispatch(method, params),)
            return dumps((result[0],), methodresponse=True).encode()
        except (WireError, Fault) as error:
            return _fault(str(error))
        except LookupError:
            return _fault("no such method")
        except Exception:  # noqa: BLE001  a fault of one call; its caller is told
            _log.exception("a call of the node API failed")
            return _fault("internal error")


def _fault(text: str) -> bytes:
    return dumps(Fault(1, text), methodresponse=True).encode()
