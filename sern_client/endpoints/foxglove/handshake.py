"""Who may come in: the HTTP request with which a viewer begins, and what is answered to those who may not."""

import hmac
import ipaddress
from collections.abc import Collection
from enum import StrEnum
from http import HTTPStatus
from typing import Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

MAX_HEAD_BYTES: Final = 16_384
_PASSED_ON: Final = ("sec-websocket-key", "sec-websocket-version")
SPOKEN: Final = "foxglove.sdk.v1"
"""The subprotocol of the SDK's server, which takes no other."""
PROTOCOLS: Final = (SPOKEN, "foxglove.websocket.v1")
"""What a viewer may call it: Lichtblick has the older name, and says and reads the same."""
_DESKTOP: Final = frozenset({"file", "app", "vscode-file"})
"""Schemes of the pages that applications bring along. No page of the web can have one of them."""
_END: Final = b"\r\n\r\n"


class Turned(StrEnum):
    """Why somebody does not get in. Closed: it is a metric label."""

    REQUEST = "request"  # no request of a viewer
    ORIGIN = "origin"  # a page of another place
    TOKEN = "token"
    FULL = "full"  # as many viewers as there may be


class RefusedError(Exception):
    """Somebody does not get in. `why` counts it, the text is what they and the log are told."""

    def __init__(self, why: Turned, status: HTTPStatus, problem: str) -> None:
        super().__init__(problem)
        self.why = why
        self.status = status

    def answer(self) -> bytes:
        """What is said to them over HTTP."""
        text = f"{self}\n".encode()
        upgrade = "Upgrade: websocket\r\n" if self.status is HTTPStatus.UPGRADE_REQUIRED else ""
        head = (
            f"HTTP/1.1 {self.status.value} {self.status.phrase}\r\n{upgrade}Content-Type: text/plain; charset=utf-8\r\n"
            f"Content-Length: {len(text)}\r\nConnection: close\r\n\r\n"
        )
        return head.encode() + text


class Rules(NamedTuple):
    """Who may come in. `origins`: pages that need no token."""

    token: str | None
    origins: Collection[str]


class Request(NamedTuple):
    """What was asked, and what came behind it."""

    target: str
    headers: dict[str, str]
    rest: bytes


def read(received: bytes) -> Request | None:
    """The request at the beginning of what came; None: not all of it has come. RefusedError: it is none."""
    head, end, rest = received.partition(_END)
    if len(head) > MAX_HEAD_BYTES:
        raise _bad(f"the request is longer than {MAX_HEAD_BYTES} bytes")
    if not end:
        if received and not b"GET ".startswith(received[:4]):
            raise _bad("this is no HTTP request; is it a viewer with wss:// where ws:// is spoken?")
        return None
    try:
        first, *lines = head.decode("ascii").split("\r\n")
    except UnicodeDecodeError:
        raise _bad("the request is not in ASCII") from None
    method, _, others = first.partition(" ")
    target, _, version = others.partition(" ")
    if method != "GET" or version != "HTTP/1.1" or not target.startswith("/"):
        raise _bad("the request is not GET /... HTTP/1.1")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if not colon or name != name.strip() or not name:
            raise _bad("the request has a line that is no header")
        if name.lower() in headers:
            raise _bad(f"the request has {name[:40]} twice")
        headers[name.lower()] = value.strip()
    return Request(target, headers, rest)


def check(request: Request, rules: Rules) -> None:
    """RefusedError for whoever may not come in."""
    headers = request.headers
    if headers.get("upgrade", "").lower() != "websocket" or "sec-websocket-key" not in headers:
        raise RefusedError(
            Turned.REQUEST,
            HTTPStatus.UPGRADE_REQUIRED,
            "this port speaks the Foxglove WebSocket protocol: open it in Foxglove or Lichtblick, not in a browser",
        )
    if not protocols_of(request):
        raise _bad(f"no protocol that is spoken here: {' or '.join(PROTOCOLS)}")
    given = parse_qs(request.target.partition("?")[2]).get("token", [""])[-1]
    if rules.token is not None:
        if not hmac.compare_digest(given.encode(), rules.token.encode()):
            told = "is wrong" if given else "is missing"
            raise RefusedError(
                Turned.TOKEN, HTTPStatus.UNAUTHORIZED, f"the token {told}: the address ends with /?token=TOKEN"
            )
        return
    origin = headers.get("origin")
    if origin is not None and not _may_come(origin, rules.origins):
        raise RefusedError(
            Turned.ORIGIN,
            HTTPStatus.FORBIDDEN,
            f"a page of {origin[:80]} may not connect here: name it in origins, or set a token",
        )


def protocols_of(request: Request) -> list[str]:
    """The names that a viewer has for the protocol."""
    offered = request.headers.get("sec-websocket-protocol", "").split(",")
    return [protocol for name in offered if (protocol := name.strip()) in PROTOCOLS]


def passed_on(request: Request, host: str) -> bytes:
    """The request as the server behind this gets it: what it needs and nothing else, no token above all."""
    lines = [f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade"]
    lines.append(f"sec-websocket-protocol: {SPOKEN}")
    lines += [f"{name}: {request.headers[name]}" for name in _PASSED_ON if name in request.headers]
    return "\r\n".join(lines).encode() + _END


def answered(received: bytes) -> tuple[bytes, bytes] | None:
    """The head of the server's answer and what came behind it; None: not all of it has come."""
    head, end, rest = received.partition(_END)
    return (head + end, rest) if end else None


def renamed(head: bytes, protocol: str) -> bytes:
    """The answer with the protocol called as the viewer calls it."""
    return head.replace(SPOKEN.encode(), protocol.encode())


def accepted(head: bytes) -> bool:
    return head.startswith(b"HTTP/1.1 101 ")


def _may_come(origin: str, origins: Collection[str]) -> bool:
    if origin.lower() in origins:
        return True
    try:
        parts = urlsplit(origin.lower())
        host = parts.hostname or ""
        if parts.scheme in _DESKTOP:
            return True
        return parts.scheme in ("http", "https") and (host == "localhost" or ipaddress.ip_address(host).is_loopback)
    except ValueError:
        return False


def _bad(problem: str) -> RefusedError:
    return RefusedError(Turned.REQUEST, HTTPStatus.BAD_REQUEST, problem)
