"""How every SERN socket over ZeroMQ is set up: its options, where it listens or connects, and its keys."""

import errno
import ipaddress
from collections.abc import Callable, Sequence
from typing import Final, Protocol

import zmq

from sern_core.vocabulary.errors import ConfigError, UsageError

HEARTBEAT_IVL_MS: Final = 500
"""A ZMTP ping twice a second: keeps NAT bindings, and finds a dead TCP connection within the timeout."""
HEARTBEAT_TIMEOUT_MS: Final = 5000
"""Default for how long a silent connection is believed; to be derived from the path's RTT where that is known. Loss
of the *link* is decided by the core's stall rule, which is faster; this only clears away the connection."""
CONNECT_TIMEOUT_MS: Final = 3000
"""A SYN that is lost in a blackout would else wait for the kernel's minutes of backoff."""
HANDSHAKE_IVL_MS: Final = 10_000
"""The first message of CURVE needs about 4 RTT: 2 s never connects over 600 ms RTT. Half-open connections are bounded
by `sern_runtime.monitor.ConnectionTable` instead of by haste."""
RECONNECT_IVL_MS: Final = 100
RECONNECT_IVL_MAX_MS: Final = 500
"""Short: after an outage the first fresh pose waits for this. A storm of clients is spread by CURVE's cost."""
SNDHWM: Final = 32
"""Messages that may wait in a pipe: few, because what waits there can no longer be overtaken, and enough for the moment
until an emptied pipe is filled again (of 64 kB each, 16 kept a lane below 700 MB/s). The window is what bounds them."""
RCVHWM: Final = 256
"""Messages of one peer that may wait for us: with MAX_MESSAGE_BYTES it bounds what a peer can make us hold."""
MAX_MESSAGE_BYTES: Final = 64 * 1024
"""Frames above it close the connection. Without it eight unauthenticated connections cost 479 MB (measured)."""
BACKLOG: Final = 512


class CurvePair(Protocol):
    """A CURVE key pair, Z85 text."""

    @property
    def public_key(self) -> str: ...

    @property
    def secret_key(self) -> str: ...


def apply_common_options(
    socket: "zmq.Socket[bytes]",
    *,
    heartbeat_timeout_ms: int = HEARTBEAT_TIMEOUT_MS,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
    sndhwm: int = SNDHWM,
    rcvhwm: int = RCVHWM,
    handshake_ivl_ms: int = HANDSHAKE_IVL_MS,
    tos: int = 0,
) -> None:
    """The options that every SERN socket over TCP has; see the constants for the reasons."""
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.IMMEDIATE, 1)  # nothing queues for a connection that does not exist yet
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_IVL_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, heartbeat_timeout_ms)
    socket.setsockopt(zmq.HEARTBEAT_TTL, heartbeat_timeout_ms)
    socket.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_TIMEOUT_MS)
    socket.setsockopt(zmq.HANDSHAKE_IVL, handshake_ivl_ms)
    socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_IVL_MS)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_IVL_MAX_MS)
    socket.setsockopt(zmq.SNDHWM, sndhwm)
    socket.setsockopt(zmq.RCVHWM, rcvhwm)
    socket.setsockopt(zmq.MAXMSGSIZE, max_message_bytes)
    if tos:
        socket.setsockopt(zmq.TOS, tos)


def is_local(endpoint: str) -> bool:
    """Does this endpoint stay on this machine? ipc, inproc, or tcp on a loopback address."""
    if endpoint.startswith(("ipc://", "inproc://")):
        return True
    host = endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bind_all(socket: "zmq.Socket[bytes]", endpoints: Sequence[str]) -> tuple[str, ...]:
    """Bind one socket to several endpoints; returns them as bound (a port `*` resolved).

    Raises ConfigError of one line for the first that cannot be had; the caller closes the socket.
    """
    bound = []
    for endpoint in endpoints:
        if "[" in endpoint or endpoint.startswith("tcp://*:"):
            socket.setsockopt(zmq.IPV6, 1)
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            raise ConfigError(f"cannot listen on {endpoint}: {_bind_problem(error)}") from error
        bound.append(socket.getsockopt_string(zmq.LAST_ENDPOINT))
    return tuple(bound)


def unbind(socket: "zmq.Socket[bytes]", endpoint: str) -> None:
    """Let go of an endpoint, as it was given to `bind_all`: libzmq knows a wildcard under another name by then."""
    socket.unbind(endpoint.replace("tcp://*:", "tcp://[::]:"))


def _bind_problem(error: zmq.ZMQError) -> str:
    match error.errno:
        case zmq.EADDRINUSE:
            return "the port is in use; stop the other process or choose another port"
        case errno.ENODEV | zmq.EADDRNOTAVAIL:
            return "this machine has no such interface or address; see `ip address`, or listen on tcp://0.0.0.0:PORT"
        case errno.EACCES:
            return "not permitted; choose a port above 1023 or a directory that this user may write"
        case errno.ENOENT:
            return "no such directory; create it first"
        case errno.EINVAL | errno.EPROTONOSUPPORT | zmq.ENOCOMPATPROTO:
            return "not an endpoint; write for example tcp://0.0.0.0:5555"
        case _:
            return (error.strerror or str(error)).lower()


def serve_curve(socket: "zmq.Socket[bytes]", keys: CurvePair | None, zap_domain: str) -> None:
    """Make a socket a CURVE server whose every connection is put to the ZAP handler. Before bind.

    Both halves matter: without a domain, or without ZAP_ENFORCE_DOMAIN, libzmq admits every key in silence when it
    finds no handler to ask (seen on 4.3.5).
    """
    if keys is None:
        return
    if not zap_domain:
        raise UsageError("zap_domain is empty: libzmq would let anyone in")
    socket.setsockopt(zmq.CURVE_SERVER, 1)
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret_key.encode())
    socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public_key.encode())
    socket.setsockopt(zmq.ZAP_DOMAIN, zap_domain.encode())
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)


def check_plain(endpoints: Sequence[str], keys: CurvePair | None) -> None:
    """Allow endpoints that stay on this machine only, where there are no keys. Raises ConfigError."""
    if keys is None:
        for endpoint in endpoints:
            if not is_local(endpoint):
                raise ConfigError(f"{endpoint} without keys would be open to the network; set keys or use 127.0.0.1")


def make_server(
    ctx: "zmq.Context[zmq.Socket[bytes]]",
    endpoints: Sequence[str],
    keys: CurvePair | None,
    zap_domain: str = "sern",
    *,
    heartbeat_timeout_ms: int = HEARTBEAT_TIMEOUT_MS,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
    sndhwm: int = SNDHWM,
    handshake_ivl_ms: int = HANDSHAKE_IVL_MS,
) -> "zmq.Socket[bytes]":
    """A ROUTER bound to all `endpoints`. Start the ZAP handler of the same context first.

    `keys` None means no CURVE, for ipc and loopback only. Raises ConfigError of one line naming the endpoint.
    """
    check_plain(endpoints, keys)
    socket = ctx.socket(zmq.ROUTER)
    try:
        apply_common_options(
            socket,
            heartbeat_timeout_ms=heartbeat_timeout_ms,
            max_message_bytes=max_message_bytes,
            sndhwm=sndhwm,
            handshake_ivl_ms=handshake_ivl_ms,
        )
        socket.setsockopt(zmq.BACKLOG, BACKLOG)
        socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # without it a full or lost peer is dropped silently
        socket.setsockopt(zmq.ROUTER_HANDOVER, 0)  # with it a claimed routing id takes over another's traffic
        serve_curve(socket, keys, zap_domain)
        bind_all(socket, endpoints)
    except BaseException:
        socket.close(linger=0)
        raise
    return socket


def make_client(
    ctx: "zmq.Context[zmq.Socket[bytes]]",
    endpoint: str,
    keys: CurvePair | None,
    server_key: str | None,
    *,
    heartbeat_timeout_ms: int = HEARTBEAT_TIMEOUT_MS,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
    sndhwm: int = SNDHWM,
    handshake_ivl_ms: int = HANDSHAKE_IVL_MS,
    tos: int = 0,
    before_connect: "Callable[[zmq.Socket[bytes]], None] | None" = None,
) -> "zmq.Socket[bytes]":
    """A DEALER, without routing id, connecting to `endpoint`; `server_key` is the relay's public key (Z85).

    `before_connect` is the place to attach a monitor, so that no event is missed. Raises ConfigError.
    """
    if (keys is None) != (server_key is None):
        raise UsageError("keys and server_key go together")
    check_plain([endpoint], keys)
    socket = ctx.socket(zmq.DEALER)
    try:
        apply_common_options(
            socket,
            heartbeat_timeout_ms=heartbeat_timeout_ms,
            max_message_bytes=max_message_bytes,
            sndhwm=sndhwm,
            handshake_ivl_ms=handshake_ivl_ms,
            tos=tos,
        )
        if "[" in endpoint:
            socket.setsockopt(zmq.IPV6, 1)
        connect_curve(socket, keys, server_key)
        if before_connect is not None:
            before_connect(socket)
        try:
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            raise ConfigError(f"cannot connect to {endpoint}: {_connect_problem(error)}") from error
    except BaseException:
        socket.close(linger=0)
        raise
    return socket


def connect_curve(socket: "zmq.Socket[bytes]", keys: CurvePair | None, server_key: str | None) -> None:
    """Make a socket a CURVE client that pins `server_key`. Before connect."""
    if keys is None or server_key is None:
        return
    socket.setsockopt(zmq.CURVE_SERVERKEY, server_key.encode())
    socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public_key.encode())
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret_key.encode())


def _connect_problem(error: zmq.ZMQError) -> str:
    if error.errno in (errno.EINVAL, errno.EPROTONOSUPPORT, zmq.ENOCOMPATPROTO):
        return "not an endpoint; write for example tcp://relay.example:5555"
    return (error.strerror or str(error)).lower()
