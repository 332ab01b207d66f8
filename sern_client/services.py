"""Services across the bridge: one site offers a service of its own, others use it as if it were theirs.

The streams are those of `sern_core.services`. Calls and answers are reliable and have the caller's timeout as their
lifespan: a call is executed at most once, never after its caller has given up, and whatever happens to the link the
caller hears within its timeout.
"""

import asyncio
import logging
import secrets
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from sern_client import conversion
from sern_client.endpoints.base import ServiceEndpoint, ServiceInfo, ServiceServer
from sern_core.client import ClientCore
from sern_core.errors import ConfigError, ServiceError, UsageError
from sern_core.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.queues import OutChannel
from sern_core.rules import to_global, to_local
from sern_core.services import (
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
from sern_core.types import DropReason, Durability, PriorityClass, Reliability, TopicName

MAX_ERROR_CHARS: Final = 512

_OFFER_SPEC: Final = TopicSpec(
    PriorityClass.STATE,
    reliability=Reliability.RELIABLE,
    durability=Durability.TRANSIENT_LOCAL,
    lifespan_s=None,
)

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Offered:
    """A service of this site."""

    info: ServiceInfo
    rule: ServiceRule
    channel: OutChannel


@dataclass(slots=True, eq=False)
class _Used:
    """A service of another site that is served here."""

    name: TopicName
    rule: ServiceRule
    channel: OutChannel
    server: ServiceServer | None = None
    waiting: dict[int, asyncio.Future[bytes]] = field(default_factory=dict)
    numbers: dict[int, int] = field(default_factory=dict)  # seq -> call

    def fail(self, problem: str) -> None:
        for future in self.waiting.values():
            if not future.done():
                future.set_exception(ServiceError(problem))


@dataclass(slots=True, eq=False)
class _Caller:
    """A site that calls a service of ours."""

    service: TopicName
    replies: OutChannel
    tasks: set[asyncio.Task[None]] = field(default_factory=set)


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
        """Calls that ended, by global service name and outcome (`ok`, `error`, `timeout`), as their caller saw them."""
        self._core = core
        self._endpoint = endpoint
        self._offer = offer
        self._use = use
        self._namespace = namespace
        self._kick = kick
        self._next = secrets.randbits(63)  # answers to an earlier process of ours must not fit a call of this one
        self._offered: dict[TopicName, _Offered] = {}  # by global name
        self._used: dict[StreamId, _Used] = {}  # by the stream that announced it
        self._callers: dict[StreamId, _Caller] = {}  # by the stream of its calls
        self._closed = False
        endpoint.watch_services(self)

    # --- ServiceEvents ----------------------------------------------------------------------------------------------

    def service_added(self, info: ServiceInfo) -> None:
        name = to_global(info.name, self._namespace)
        rule = find(self._offer, info.name)
        if rule is None or name in self._offered or self._closed:
            return
        topic = TopicInfo(
            offer_name(name), info.type_name, info.encoding, info.type_hash, info.definition, latched=True
        )
        try:
            channel = self._core.publish(topic, _OFFER_SPEC, now=time.monotonic())
        except UsageError as error:
            _log.error("service %s cannot be offered: %s", info.name, error)
            return
        self._offered[name] = _Offered(info, rule, channel)
        _log.info("offering service %s (%s) as %s", info.name, info.type_name, name)
        self._kick()

    def service_removed(self, name: TopicName) -> None:
        offered = self._offered.pop(to_global(name, self._namespace), None)
        if offered is not None:
            self._core.unpublish(offered.channel, now=time.monotonic())
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
            if parts.caller != stream.id.origin or parts.service not in self._offered:
                raise ConfigError(f"{stream.id.topic} from {stream.id.origin} calls nothing that is offered here")
            self._caller_appeared(parts.service, stream)
        elif parts.caller != self._core.name or find(self._use, parts.service) is None:
            raise ConfigError(f"{stream.id.topic} is for another site")

    def stream_closed(self, stream: StreamInfo) -> None:
        used = self._used.pop(stream.id, None)
        if used is not None:
            self._withdraw(used, f"service {used.name} is gone")
        caller = self._callers.pop(stream.id, None)
        if caller is not None:
            self._dismiss(caller)

    def message(self, stream: StreamInfo, message: Message) -> None:
        caller = self._callers.get(stream.id)
        if caller is not None:
            self._called(caller, stream, message)
            return
        parts = parse(stream.id.topic)
        if parts is not None and parts.kind == "reply":
            self._replied(parts.service, message.body)

    def send_dropped(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        """A message of ours was dropped, here or on its way: if it was a call, nobody will answer it."""
        for used in self._used.values():
            if used.channel.stream.id == stream.id:
                number = used.numbers.pop(seq, None)
                future = None if number is None else used.waiting.get(number)
                if future is not None and not future.done():
                    future.set_exception(ServiceError(f"the call of {used.name} was dropped on its way: {reason}"))

    async def stop(self) -> None:
        """Withdraw what is served here, end the calls that others have under way."""
        self._closed = True
        for used in self._used.values():
            self._withdraw(used, "this site stops", unpublish=False)
        self._used.clear()
        tasks = [task for caller in self._callers.values() for task in caller.tasks]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._callers.clear()
        self._offered.clear()

    # --- the caller's side ------------------------------------------------------------------------------------------

    def _remote_offered(self, service: TopicName, stream: StreamInfo) -> None:
        rule = find(self._use, service)
        if rule is None:
            raise ConfigError(f"service {service} is not in services.use")
        spec = TopicSpec(
            rule.priority,
            reliability=Reliability.RELIABLE,
            depth=MAX_CALLS,
            lifespan_s=rule.timeout_s,
            retention_s=rule.timeout_s,
        )
        info = stream.info
        calls = TopicInfo(call_name(service, self._core.name), info.type_name, info.encoding)
        local = to_local(service, self._namespace)
        try:
            channel = self._core.publish(calls, spec, now=time.monotonic())
        except UsageError as error:
            raise ConfigError(f"service {service} cannot be called from here: {error}") from None
        used = _Used(service, rule, channel)

        async def handler(request: bytes) -> bytes:
            return await self._call(used, request)

        try:
            used.server = conversion.serve(
                self._endpoint,
                ServiceInfo(local, info.type_name, info.encoding, info.type_hash, info.definition),
                handler,
            )
        except ConfigError as error:
            self._core.unpublish(channel, now=time.monotonic())
            _log.error("service %s of %s cannot be served here: %s", service, stream.id.origin, error)
            raise
        self._used[stream.id] = used
        _log.info("serving %s of %s as %s", service, stream.id.origin, local)
        self._kick()

    async def _call(self, used: _Used, request: bytes) -> bytes:
        """One call, from here to the far side and back. ServiceError in every case but an answer."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        number = self._next
        self._next = (self._next + 1) % (1 << 64)
        seq = used.channel.next_seq
        used.waiting[number] = future
        used.numbers[seq] = number
        try:
            if len(used.waiting) > MAX_CALLS:
                raise ServiceError(f"{MAX_CALLS} calls of {used.name} are under way already")
            body = CALL.pack(number) + request
            if not self._core.send(used.channel, body, time.time_ns(), now=time.monotonic()):
                raise ServiceError(f"{used.name}: too much waits for the link")
            self._kick()
            async with asyncio.timeout(used.rule.timeout_s):
                response = await future
        except TimeoutError:
            self.outcomes[used.name, "timeout"] += 1
            raise ServiceError(f"{used.name} did not answer within {used.rule.timeout_s:g} s") from None
        except ServiceError:
            self.outcomes[used.name, "error"] += 1
            raise
        finally:
            used.waiting.pop(number, None)
            used.numbers.pop(seq, None)
        self.outcomes[used.name, "ok"] += 1
        return response

    def _replied(self, service: TopicName, body: bytes) -> None:
        if len(body) < REPLY.size:
            _log.warning("an answer of %s is too short to be one", service)
            return
        number, failed = REPLY.unpack_from(body)
        for used in self._used.values():
            future = used.waiting.get(number)
            if used.name != service or future is None or future.done():
                continue
            rest = body[REPLY.size :]
            if failed:
                text = rest[: 4 * MAX_ERROR_CHARS].decode(errors="replace")
                future.set_exception(ServiceError(text))
            else:
                future.set_result(rest)

    def _withdraw(self, used: _Used, why: str, *, unpublish: bool = True) -> None:
        if used.server is not None:
            used.server.close()
        used.fail(why)
        if unpublish:
            self._core.unpublish(used.channel, now=time.monotonic())
            self._kick()

    # --- the side that has the service ------------------------------------------------------------------------------

    def _caller_appeared(self, service: TopicName, stream: StreamInfo) -> None:
        offered = self._offered[service]
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
            channel = self._core.publish(replies, spec, now=time.monotonic())
        except UsageError as error:
            raise ConfigError(f"{stream.id.origin} cannot be answered: {error}") from None
        self._callers[stream.id] = _Caller(service, channel)
        self._kick()

    def _release_name(self, replies: TopicName) -> None:
        """The same site as a new process: the stream of its earlier one ends only later."""
        for identity, caller in list(self._callers.items()):
            if caller.replies.stream.id.topic == replies:
                del self._callers[identity]
                self._dismiss(caller)

    def _dismiss(self, caller: _Caller) -> None:
        for task in caller.tasks:
            task.cancel()
        self._core.unpublish(caller.replies, now=time.monotonic())
        self._kick()

    def _called(self, caller: _Caller, stream: StreamInfo, message: Message) -> None:
        if len(message.body) < CALL.size:
            _log.warning("a call of %s from %s is too short to be one", caller.service, stream.id.origin)
            return
        (number,) = CALL.unpack_from(message.body)
        offered = self._offered.get(caller.service)
        if offered is None:
            self._answer(caller, number, f"service {caller.service} is gone".encode(), failed=True)
            return
        if len(caller.tasks) >= MAX_CALLS:
            self._answer(caller, number, f"{MAX_CALLS} calls are under way already".encode(), failed=True)
            return
        left_s = offered.rule.timeout_s
        if stream.spec.lifespan_s is not None:
            left_s = min(left_s, stream.spec.lifespan_s - message.age_s(time.monotonic()))
        task = asyncio.create_task(
            self._execute(caller, offered, number, message.body[CALL.size :], left_s), name=f"call-{number}"
        )
        caller.tasks.add(task)
        task.add_done_callback(caller.tasks.discard)

    async def _execute(self, caller: _Caller, offered: _Offered, number: int, request: bytes, left_s: float) -> None:
        failed = False
        try:
            response = await self._endpoint.call(offered.info.name, request, timeout_s=max(left_s, 0.001))
        except ServiceError as error:
            failed = True
            response = str(error)[:MAX_ERROR_CHARS].encode()
        except Exception as error:  # noqa: BLE001  (a fault of one service; its caller must hear of it all the same)
            _log.exception("service %s failed", offered.info.name)
            failed = True
            response = f"{offered.info.name} failed: {type(error).__name__}".encode()
        self._answer(caller, number, response, failed=failed)

    def _answer(self, caller: _Caller, number: int, response: bytes, *, failed: bool) -> None:
        body = REPLY.pack(number, failed) + response
        if not self._core.send(caller.replies, body, time.time_ns(), now=time.monotonic()):
            _log.warning("an answer of %s was lost: too much waits for the link", caller.service)
        self._kick()
