"""Services across the bridge: one site offers a service of its own, others use it as if it were theirs.

The streams are those of `sern_core.site.services`. Calls and answers are reliable and have the caller's timeout as
their lifespan: a call is executed at most once, never after its caller has given up, and whatever happens to the link
the caller hears within its timeout.
"""

import asyncio
import logging
import secrets
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from sern_client.actions import cancel_request, refusal
from sern_client.endpoints import conversion
from sern_client.endpoints.base import ServiceEndpoint, ServiceInfo, ServiceServer
from sern_client.endpoints.common.calls import PendingCalls, Tasks
from sern_core.site.client import ClientCore
from sern_core.site.services import (
    CALL,
    MAX_CALLS,
    REPLY,
    ServiceRule,
    call_name,
    find,
    offer_name,
    parse,
    reply_name,
)
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.ledger import MAX_TOPICS, OTHER_TOPIC
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.names import to_global, to_local
from sern_core.vocabulary.types import DropReason, Durability, PriorityClass, Reliability, TopicName
from sern_runtime import clock

MAX_ERROR_CHARS: Final = 512
MAX_SERVED: Final = 1000
"""Services of other sites that are served here at most: each site may offer what it likes."""

CANCEL_S: Final = 600.0
"""How long it is tried to cancel a goal that was lost on its way, in case it was not."""
CANCEL_AGAIN_S: Final = 1.0

_OFFER_SPEC: Final = TopicSpec(
    PriorityClass.STATE,
    reliability=Reliability.RELIABLE,
    durability=Durability.TRANSIENT_LOCAL,
    lifespan_s=None,
)

_log = logging.getLogger(__name__)


def one_line(text: str) -> str:
    """An error text as a caller may be shown it, whoever wrote it: one line, bounded, nothing that moves a cursor."""
    plain = "".join(character if character.isprintable() else " " for character in text[: 4 * MAX_ERROR_CHARS])
    return " ".join(plain.split())[:MAX_ERROR_CHARS]


@dataclass(slots=True, eq=False)
class _Offered:
    """A service of this site, since `since_s` on our monotonic clock."""

    info: ServiceInfo
    rule: ServiceRule
    channel: OutChannel
    since_s: float

    @property
    def refused(self) -> bool:
        """The relay does not let us offer it, usually because another site does: calls of it are not meant for us."""
        return self.channel.wanted is False  # a latched stream that a relay takes is always wanted


@dataclass(slots=True, eq=False)
class _Used:
    """A service of another site that is served here. The stream of our calls is opened with the first one: most of what
    is offered is never called, and every stream costs bytes in every session."""

    name: TopicName
    offer: StreamInfo
    rule: ServiceRule
    server: ServiceServer | None = None
    calls: OutChannel | None = None
    gone: str = ""  # why it is served no more
    waiting: PendingCalls = field(default_factory=PendingCalls)
    numbers: dict[int, int] = field(default_factory=dict)  # seq -> call


@dataclass(slots=True, eq=False)
class _Caller:
    """A site that calls a service of ours."""

    service: TopicName
    replies: OutChannel
    tasks: Tasks = field(default_factory=lambda: Tasks(MAX_CALLS))


class ServiceBridge:
    """`ServiceEvents` on one side; the bridge hands over what concerns services on the other."""

    def __init__(
        self,
        core: ClientCore,
        endpoint: ServiceEndpoint,
        *,
        offer: tuple[ServiceRule, ...],
        use: tuple[ServiceRule, ...],
        namespace: str,
        kick: Callable[[], None],
    ) -> None:
        self.outcomes: dict[tuple[TopicName, str], int] = defaultdict(int)
        """Calls that ended, by global service name and outcome (`ok`, `error`, `timeout`, `cancelled`), as their caller
        saw them."""
        self._core = core
        self._endpoint = endpoint
        self._offer = offer
        self._use = use
        self._namespace = namespace
        self._kick = kick
        self._next = secrets.randbits(63)  # answers to an earlier process of ours must not fit a call of this one
        self.offered: dict[TopicName, _Offered] = {}  # by global name
        self.used: dict[TopicName, _Used] = {}  # by global name, which has one owner at the relay
        self._calling: dict[StreamId, _Used] = {}  # by the stream of our calls
        self.callers: dict[StreamId, _Caller] = {}  # by the stream of its calls
        self._cancelling = Tasks(MAX_CALLS)
        self._said_full = False
        self._closed = False
        endpoint.watch_services(self)

    # --- ServiceEvents ----------------------------------------------------------------------------------------------

    def service_added(self, info: ServiceInfo) -> None:
        name = to_global(info.name, self._namespace)
        rule = find(self._offer, info.name)
        if rule is None or name in self.offered or self._closed:
            return
        topic = TopicInfo(
            offer_name(name), info.type_name, info.encoding, info.type_hash, info.definition, latched=True
        )
        try:
            channel = self._core.publish(topic, _OFFER_SPEC, now=clock.now())
        except UsageError as error:
            _log.error("service %s cannot be offered: %s", info.name, error)
            return
        self.offered[name] = _Offered(info, rule, channel, clock.now())
        _log.info("offering service %s (%s) as %s", info.name, info.type_name, name)
        self._kick()

    def wants_service(self, name: TopicName) -> bool:
        return find(self._offer, name) is not None

    def service_removed(self, name: TopicName) -> None:
        offered = self.offered.pop(to_global(name, self._namespace), None)
        if offered is not None:
            self._core.unpublish(offered.channel, now=clock.now())
            _log.info("service %s has ended", name)
            self._kick()

    # --- from the link ----------------------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo) -> None:
        """A stream of the table appeared. ConfigError where it is nothing for this site."""
        parts = parse(stream.id.topic)
        if parts is None:
            raise UsageError(f"{stream.id.topic} is not of a service")
        if parts.kind == "service":
            self._remote_offered(parts.service, stream)
        elif parts.kind == "call":
            offered = self.offered.get(parts.service)
            if parts.caller != stream.id.origin or offered is None or offered.refused:
                raise ConfigError(f"{stream.id.topic} from {stream.id.origin} calls nothing that is offered here")
            self._caller_appeared(parts.service, stream)
        elif parts.caller != self._core.name or find(self._use, parts.service) is None:
            raise ConfigError(f"{stream.id.topic} is for another site")

    def stream_closed(self, stream: StreamInfo) -> None:
        parts = parse(stream.id.topic)
        used = None if parts is None else self.used.get(parts.service)
        if used is not None and used.offer.id == stream.id:
            self._withdraw(used, f"service {used.name} is gone")
        caller = self.callers.pop(stream.id, None)
        if caller is not None:
            self._dismiss(caller)

    def message(self, stream: StreamInfo, message: Message) -> None:
        caller = self.callers.get(stream.id)
        if caller is not None:
            self._called(caller, stream, message)
            return
        parts = parse(stream.id.topic)
        used = None if parts is None else self.used.get(parts.service)
        if used is not None and used.offer.id.origin == stream.id.origin:  # nobody else answers for it
            self._replied(used, message.body)

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason) -> None:
        """Messages of ours, `count` from seq `first` on, were dropped, here or on their way: what was a call, nobody
        will answer."""
        used = self._calling.get(stream.id)
        if used is None:
            return
        numbers = used.numbers
        if count <= len(numbers):
            dropped = [seq for seq in range(first, first + count) if seq in numbers]
        else:
            dropped = [seq for seq in numbers if first <= seq < first + count]
        for seq in dropped:
            number = numbers.pop(seq)
            if reason is not DropReason.UNWANTED:  # by another site of that name than the one that will answer
                used.waiting.fail(number, f"the call of {used.name} was dropped on its way: {reason}")

    async def stop(self) -> None:
        """Withdraw what is served here, end the calls that others have under way."""
        self._closed = True
        for used in list(self.used.values()):
            self._withdraw(used, "this site stops", unpublish=False)
        working = [self._cancelling, *(caller.tasks for caller in self.callers.values())]
        for tasks in working:
            tasks.cancel()
        for tasks in working:
            await tasks.ended()
        self.callers.clear()
        self.offered.clear()

    # --- the caller's side ------------------------------------------------------------------------------------------

    def _remote_offered(self, service: TopicName, stream: StreamInfo) -> None:
        rule = find(self._use, service)
        if rule is None:
            raise ConfigError(f"service {service} is not in services.use")
        earlier = self.used.get(service)
        if earlier is not None:
            # The relay lets one site own a name: whoever announced it before is gone, though we may hear of it later.
            self._withdraw(earlier, f"service {service} is gone")
        if len(self.used) >= MAX_SERVED:
            self._complain_full(service, stream)
            raise ConfigError(f"{MAX_SERVED} services are served here already; name those that are needed in use")
        info = stream.info
        local = to_local(service, self._namespace)
        used = _Used(service, stream, rule)

        offered = ServiceInfo(local, info.type_name, info.encoding, info.type_hash, info.definition)
        otherwise = refusal(offered)

        async def handler(request: bytes) -> bytes:
            try:
                return await self._call(used, request)
            except ServiceError as error:
                if otherwise is None:
                    raise
                _log.warning("%s: refused in its server's place: %s", local, error)
                self._cancel_lost(service, request)
                return otherwise

        try:
            used.server = conversion.serve(self._endpoint, offered, handler)
        except ConfigError as error:
            _log.error("service %s of %s cannot be served here: %s", service, stream.id.origin, error)
            raise
        self.used[service] = used
        _log.info("serving %s of %s as %s", service, stream.id.origin, local)

    def _complain_full(self, service: TopicName, stream: StreamInfo) -> None:
        if not self._said_full:
            self._said_full = True
            _log.error(
                "%s of %s and others are not served here: %d services are; name those that are needed in services.use",
                service, stream.id.origin, MAX_SERVED,
            )  # fmt: skip

    def _open(self, used: _Used) -> OutChannel:
        """The stream of our calls of a service. ServiceError when there cannot be one."""
        if used.gone:
            raise ServiceError(used.gone)
        if used.calls is None:
            spec = TopicSpec(
                used.rule.priority,
                reliability=Reliability.RELIABLE,
                depth=MAX_CALLS,
                lifespan_s=used.rule.timeout_s,
                retention_s=used.rule.timeout_s,
            )
            info = used.offer.info
            calls = TopicInfo(call_name(used.name, self._core.name), info.type_name, info.encoding)
            try:
                used.calls = self._core.publish(calls, spec, required=(used.offer.id.origin,), now=clock.now())
            except UsageError as error:
                raise ServiceError(f"{used.name} cannot be called from here: {error}") from None
            self._calling[used.calls.stream.id] = used
        return used.calls

    async def _call(self, used: _Used, request: bytes) -> bytes:
        """One call, from here to the far side and back. ServiceError in every case but an answer."""
        outcome = "cancelled"
        try:
            response = await self._ask(used, request)
            outcome = "ok"
        except TimeoutError:
            outcome = "timeout"
            raise ServiceError(f"{used.name} did not answer within {used.rule.timeout_s:g} s") from None
        except ServiceError:
            outcome = "error"
            raise
        finally:
            known = (used.name, outcome) in self.outcomes or len(self.outcomes) < MAX_TOPICS
            self.outcomes[used.name if known else OTHER_TOPIC, outcome] += 1
        return response

    async def _ask(self, used: _Used, request: bytes) -> bytes:
        """TimeoutError when there is no answer in time."""
        calls = self._open(used)
        if len(used.waiting) >= MAX_CALLS:
            raise ServiceError(f"{MAX_CALLS} calls of {used.name} are under way already")
        number = self._next
        self._next = (self._next + 1) % (1 << 64)
        seq = calls.next_seq
        used.numbers[seq] = number
        try:
            with used.waiting.call(number) as answer:
                if not self._core.send(calls, CALL.pack(number) + request, time.time_ns(), now=clock.now()):
                    raise ServiceError(f"{used.name}: too much waits for the link")
                self._kick()
                async with asyncio.timeout(used.rule.timeout_s):
                    return await answer
        except asyncio.CancelledError:
            if not used.gone:  # its caller is gone: if the call still waits here, it is not made
                used.numbers.pop(seq, None)
                self._core.link.sender.abandon(calls, seq, DropReason.UNWANTED, now=clock.now())
            raise
        finally:
            used.numbers.pop(seq, None)

    def _cancel_lost(self, service: TopicName, request: bytes) -> None:
        """A goal of ROS 2 whose client is told that it is refused may have been accepted, unknown to us: end it."""
        action = service.removesuffix("/_action/send_goal")
        body = cancel_request(request)
        if action != service and body is not None and not self._cancelling.full:
            self._cancelling.begin(self._cancel(TopicName(f"{action}/_action/cancel_goal"), body))

    async def _cancel(self, service: TopicName, request: bytes) -> None:
        """Ask until it has been answered: the link may be away."""
        until_s = clock.now() + CANCEL_S
        while clock.now() < until_s:
            used = self.used.get(service)
            if used is not None:
                with suppress(ServiceError):
                    await self._call(used, request)
                    return
            await asyncio.sleep(CANCEL_AGAIN_S)

    def _replied(self, used: _Used, body: bytes) -> None:
        if len(body) < REPLY.size:
            _log.warning("an answer of %s is too short to be one", used.name)
            return
        number, failed = REPLY.unpack_from(body)
        rest = body[REPLY.size :]
        if failed:
            text = one_line(rest[: 4 * MAX_ERROR_CHARS].decode(errors="replace"))
            used.waiting.fail(number, text or f"{used.name} failed, without saying why")
        else:
            used.waiting.answer(number, rest)

    def _withdraw(self, used: _Used, why: str, *, unpublish: bool = True) -> None:
        del self.used[used.name]
        used.gone = why
        used.waiting.fail_all(why)  # before the endpoint ends its calls: they shall hear why
        if used.server is not None:
            used.server.close()
        if used.calls is not None:
            del self._calling[used.calls.stream.id]
            if unpublish:
                self._core.unpublish(used.calls, now=clock.now())
                self._kick()

    # --- the side that has the service ------------------------------------------------------------------------------

    def _caller_appeared(self, service: TopicName, stream: StreamInfo) -> None:
        offered = self.offered[service]
        lifespan_s = min(offered.rule.timeout_s, stream.spec.lifespan_s or offered.rule.timeout_s)
        spec = TopicSpec(
            offered.rule.priority,
            reliability=Reliability.RELIABLE,
            depth=MAX_CALLS,
            lifespan_s=lifespan_s,
            retention_s=lifespan_s,
        )
        name = reply_name(service, stream.id.origin)
        self._release_name(name)
        replies = TopicInfo(name, offered.info.type_name, offered.info.encoding)
        try:
            channel = self._core.publish(replies, spec, now=clock.now())
        except UsageError as error:
            raise ConfigError(f"{stream.id.origin} cannot be answered: {error}") from None
        self.callers[stream.id] = _Caller(service, channel)
        self._kick()

    def _release_name(self, replies: TopicName) -> None:
        """The same site as a new process: the stream of its earlier one ends only later."""
        for identity, caller in list(self.callers.items()):
            if caller.replies.stream.id.topic == replies:
                del self.callers[identity]
                self._dismiss(caller)

    def _dismiss(self, caller: _Caller) -> None:
        caller.tasks.cancel()
        self._core.unpublish(caller.replies, now=clock.now())
        self._kick()

    def _called(self, caller: _Caller, stream: StreamInfo, message: Message) -> None:
        if len(message.body) < CALL.size:
            _log.warning("a call of %s from %s is too short to be one", caller.service, stream.id.origin)
            return
        (number,) = CALL.unpack_from(message.body)
        offered = self.offered.get(caller.service)
        if offered is None:
            self._answer(caller, number, f"service {caller.service} is gone".encode(), failed=True)
            return
        if offered.refused:
            return
        if message.born_s + message.error_s < offered.since_s:
            # It was meant for an earlier process of ours, which may have executed it.
            self._answer(caller, number, f"{caller.service} has started anew; call again".encode(), failed=True)
            return
        if caller.tasks.full:
            self._answer(caller, number, f"{MAX_CALLS} calls are under way already".encode(), failed=True)
            return
        left_s = offered.rule.timeout_s
        if stream.spec.lifespan_s is not None:
            left_s = min(left_s, stream.spec.lifespan_s - message.age_s(clock.now()))
        work = self._execute(caller, offered, number, message.body[CALL.size :], left_s)
        caller.tasks.begin(work, name=f"call-{number}")

    async def _execute(self, caller: _Caller, offered: _Offered, number: int, request: bytes, left_s: float) -> None:
        failed = False
        try:
            response = await self._endpoint.call(offered.info.name, request, timeout_s=max(left_s, 0.001))
        except ServiceError as error:
            failed = True
            response = one_line(str(error)).encode(errors="replace")
        except Exception as error:  # noqa: BLE001  (a fault of one service; its caller must hear of it all the same)
            _log.exception("service %s failed", offered.info.name)
            failed = True
            response = f"{offered.info.name} failed: {type(error).__name__}".encode()
        self._answer(caller, number, response, failed=failed)

    def _answer(self, caller: _Caller, number: int, response: bytes, *, failed: bool) -> None:
        limit_bytes = self._core.link.end.params.max_message_bytes - REPLY.size
        if len(response) > limit_bytes:
            failed = True
            response = (
                f"the response of {caller.service} has {len(response)} bytes, above link.max_message_bytes of the "
                f"site that has it ({limit_bytes + REPLY.size})"
            ).encode()
        body = REPLY.pack(number, failed) + response
        if not self._core.send(caller.replies, body, time.time_ns(), now=clock.now()):
            _log.warning("an answer of %s was lost: too much waits for the link", caller.service)
        self._kick()
