"""Asks a relay at which a client is not whether it answers, without a session and without disturbing one.

The question is a DATA datagram of a session that there is not, over a connection with the client's key: a relay answers
it with RESET, of whatever release it is, and remembers nothing. That says all that a return depends on: the way is
open, the keys of both sides hold, and the relay's loop runs, which is more than a connection that stays open or the
heartbeats of libzmq's own thread would say. It is some 50 bytes a second each way. When the client goes to that relay
the connection is there already, so that the return costs one round trip in place of six.

Without keys (`insecure`) a relay takes no such datagram: there the connection alone counts, for trials on one machine.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import Final

import zmq

from sern_client.transport import Dialer
from sern_core.link.end import microseconds
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.config.client import RelayConnection
from sern_runtime.config.shared import LinkSection
from sern_runtime.monitor import TcpHandle
from sern_runtime.transport_watch import NOT_YET
from sern_runtime.zmq_setup import CurvePair

ASK_S: Final = 1.0
"""How often it is asked; a relay answers at most twice a second."""


class RelayProbe:
    """`open` once, `tick` about twice a second, then `close` or `release`. `answered` is told of each answer, `refused`
    that the relay does not know our key. `tag` is that of a session which is not to be the next one's: an answer that
    comes late would end that."""

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        relay: RelayConnection,
        link: LinkSection,
        keys: CurvePair | None,
        server_keys: Sequence[str],
        *,
        tag: Callable[[], int],
        random: Random,
        answered: Callable[[], None],
        refused: Callable[[], None],
    ) -> None:
        self.why = NOT_YET
        """Why it does not answer, as far as it is known; empty: it does."""
        self._tag = tag
        self._answered = answered
        self._on_refused = refused
        self._plain = keys is None
        self._up = False
        self._ask_s = 0.0
        self.dialer = Dialer(
            ctx,
            relay.endpoint,
            keys,
            server_keys,
            self,
            heartbeat_timeout_s=link.heartbeat_timeout_s,
            handshake_interval_s=relay.handshake_interval_s,
            random=random,
            tos=link.dscp.marks().stream_tos,
        )

    def open(self) -> None:
        """Connect. Raises ConfigError."""
        self.dialer.open()

    def close(self) -> None:
        """It is asked no more."""
        self.dialer.close()

    def release(self) -> Dialer:
        """The connection, for whoever goes on with it. The probe is over."""
        return self.dialer

    def use(self, keys: CurvePair, server_keys: Sequence[str]) -> None:
        """Other keys, for connections that are made from now on."""
        self.dialer.use(keys, server_keys)

    def tick(self) -> None:
        """Ask, where there is a connection and it is time to."""
        now = clock.now()
        if not self._up or now < self._ask_s:
            return
        self._ask_s = now + ASK_S
        if self._plain:
            self._answered()
        else:
            self.dialer.send(framing.encode_header(framing.Kind.DATA, self._tag(), 0, microseconds(now)))

    # --- DialerEvents -------------------------------------------------------------------------------------------------

    def up(self, handle: TcpHandle | None) -> None:
        self._up = True
        self._ask_s = 0.0
        self.tick()

    def down(self, reason: str) -> None:
        self._up = False
        self.why = reason

    def refused(self, reason: str) -> None:
        self._up = False
        self.why = reason
        self._on_refused()

    def given_up(self, reason: str) -> None:
        self._up = False

    def received(self, data: framing.Datagram) -> None:
        if data[2:3] == bytes((framing.Kind.RESET,)):
            self.why = ""
            self._answered()

    def writable(self) -> None: ...
