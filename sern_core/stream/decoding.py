"""Decoding on the way in: small bodies on the spot, large ones in other threads, and the order of each stream kept.

While a body of a stream is decoded elsewhere, what follows it in the same stream waits here; other streams go on, so
that a command never waits for a cloud.
"""

from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

from sern_core.bodies.codecs import Coder, Work, raw_size
from sern_core.vocabulary.codec_names import Codec
from sern_core.vocabulary.errors import CodecError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import DropReason

MAX_WAITING_BYTES: Final = 64 * 2**20
"""Bodies that wait in all, as they came."""

Context = TypeVar("Context")
Deliver = Callable[[Context, Message, float], None]
Failed = Callable[[Context, Message, DropReason, str, float], None]


class DecodeRequest(Work, Generic[Context]):
    """One body that another thread is to decode."""

    __slots__ = ("context", "decoder", "elapsed_s", "message", "priority", "problem", "raw", "waiting")

    def __init__(
        self, decoder: "Decoder[Context]", context: Context, message: Message, waiting: deque[tuple[Context, Message]]
    ) -> None:
        self.decoder = decoder
        self.context = context
        self.message = message
        self.waiting = waiting
        self.priority = int(decoder.stream_of(context).spec.priority)
        self.raw: bytes | None = None
        self.elapsed_s = 0.0
        self.problem = "its decoder has failed"

    def run(self) -> None:
        try:
            self.raw, self.elapsed_s = self.decoder.coder.decode(self.message.codec, self.message.body)
        except CodecError as error:
            self.problem = str(error)

    def done(self, *, now: float) -> None:
        self.decoder.decoded(self, now=now)


class Decoder(Generic[Context]):
    """Hands every message on, decoded and in the order of its stream. `Context` is whatever the owner knows a stream
    by; `stream_of` tells which stream that is.

    `failed` is told of what cannot be handed on: `undecodable`, or `superseded` and `reassembly` where more waits than
    a best-effort topic keeps, or than fits. `settled` is told when work of other threads was handed on. `fault` is told
    of errors that nobody expects, of `deliver` too: the message is then dropped for that reason.
    """

    def __init__(
        self,
        coder: Coder,
        stream_of: Callable[[Context], StreamInfo],
        deliver: Deliver[Context],
        failed: Failed[Context],
        settled: Callable[[Context], None] = lambda _context: None,
        *,
        fault: Callable[[Exception], None],
        max_waiting_bytes: int = MAX_WAITING_BYTES,
    ) -> None:
        self.coder = coder
        self.stream_of = stream_of
        self.waiting_bytes = 0
        self._deliver = deliver
        self._failed = failed
        self._settled = settled
        self._fault = fault
        self._max_waiting_bytes = max_waiting_bytes
        self._waiting: dict[StreamId, deque[tuple[Context, Message]]] = {}  # of streams with a body at work elsewhere
        self.running: dict[StreamId, int] = {}
        """The seq that another thread works on, by stream: the oldest that has not been handed on."""

    def message(self, context: Context, message: Message, *, now: float) -> None:
        """One message in its turn, encoded or not."""
        waiting = self._waiting.get(message.stream) if self._waiting else None
        if waiting is None:
            if message.codec:
                self._begin(context, message, now)
                return
            try:
                self._deliver(context, message, now)
            except Exception as error:  # noqa: BLE001  (as in `_hand_on`)
                self._fault(error)
                self._failed(context, message, DropReason.FAULT, "", now)
            return
        spec = self.stream_of(context).spec
        if not spec.reliable and len(waiting) >= spec.depth:
            oldest_context, oldest = waiting.popleft()
            self.waiting_bytes -= len(oldest.body)
            self._failed(oldest_context, oldest, DropReason.SUPERSEDED, "a newer one came", now)
        if self.waiting_bytes + len(message.body) > self._max_waiting_bytes:
            if not spec.reliable:
                self._failed(context, message, DropReason.REASSEMBLY, "too much waits to be decoded", now)
                return
            message = _unkept(message)  # takes its turn, and is reported then
        waiting.append((context, message))
        self.waiting_bytes += len(message.body)

    def oldest(self, stream: StreamId) -> int:
        """The seq of the oldest message of a stream that has not been handed on, 0 when there is none."""
        return self.running.get(stream, 0)

    def forget(self, stream: StreamId, *, now: float) -> None:
        """The stream has ended: what still waits of it is dropped."""
        self.running.pop(stream, None)
        for context, message in self._waiting.pop(stream, ()):
            self.waiting_bytes -= len(message.body)
            self._failed(context, message, DropReason.DISCONNECTED, "the stream has ended", now)

    def _begin(self, context: Context, message: Message, now: float) -> bool:
        """Decode a message and hand it on. False: elsewhere, later."""
        coder = self.coder
        try:
            size = raw_size(message.codec, message.body)
            if coder.offload is None or size <= coder.inline_bytes or size > coder.max_bytes:
                raw, elapsed_s = coder.decode(message.codec, message.body)
                self._decoded(context, message, raw, elapsed_s, now)
                return True
        except CodecError as undecodable:
            coder.undecodable += 1
            self._failed(context, message, DropReason.UNDECODABLE, str(undecodable), now)
            return True
        except Exception as error:  # noqa: BLE001  (of one body, whatever a library makes of it)
            self._fault(error)
            self._failed(context, message, DropReason.FAULT, "", now)
            return True
        waiting = self._waiting.setdefault(message.stream, deque())
        self.running[message.stream] = message.seq
        try:
            coder.offload(DecodeRequest(self, context, message, waiting))
        except Exception as error:  # noqa: BLE001  (no thread can be had, for example)
            self._fault(error)
            self._failed(context, message, DropReason.FAULT, "", now)
            if not waiting:
                del self._waiting[message.stream]
                del self.running[message.stream]
            return True
        return False

    def _decoded(self, context: Context, message: Message, raw: bytes, elapsed_s: float, now: float) -> None:
        codec = Codec(message.codec)
        self.coder.decoded[codec].add(len(raw), len(message.body), elapsed_s)
        plain = Message(
            message.stream,
            message.seq,
            raw,
            message.stamp_ns,
            message.born_s,
            0,
            message.replay,
            message.error_s,
        )
        self._hand_on(context, plain, now)

    def _hand_on(self, context: Context, message: Message, now: float) -> None:
        try:
            self._deliver(context, message, now)
        except Exception as error:  # noqa: BLE001  (of one message: what waits behind it must not wait for ever)
            self._fault(error)
            self._failed(context, message, DropReason.FAULT, "", now)

    def decoded(self, request: DecodeRequest[Context], *, now: float) -> None:
        """Another thread is through with a body: hand it on, and what waited behind it."""
        message, waiting = request.message, request.waiting
        stream = message.stream
        if self._waiting.get(stream) is not waiting:
            self._failed(request.context, message, DropReason.DISCONNECTED, "the stream has ended", now)
            return
        if request.raw is None:
            self.coder.undecodable += 1
            self._failed(request.context, message, DropReason.UNDECODABLE, request.problem, now)
        else:
            try:
                self._decoded(request.context, message, request.raw, request.elapsed_s, now)
            except Exception as error:
                problem = f"it could not be handed on ({type(error).__name__})"
                self._failed(request.context, message, DropReason.UNDECODABLE, problem, now)
                self._advance(stream, waiting, now)
                self._settled(request.context)
                raise
        self._advance(stream, waiting, now)
        self._settled(request.context)

    def _advance(self, stream: StreamId, waiting: deque[tuple[Context, Message]], now: float) -> None:
        """What waited behind a body has its turn."""
        while waiting:
            context, message = waiting.popleft()
            self.waiting_bytes -= len(message.body)
            if message.codec == _UNKEPT:
                self._failed(context, message, DropReason.REASSEMBLY, "too much waits to be decoded", now)
            elif not message.codec:
                self._hand_on(context, message, now)
            elif not self._begin(context, message, now):
                return
        if self._waiting.get(stream) is waiting:
            del self._waiting[stream]
            del self.running[stream]


_UNKEPT: Final = -1


def _unkept(message: Message) -> Message:
    return Message(message.stream, message.seq, b"", message.stamp_ns, message.born_s, codec=_UNKEPT)
