"""Which nodes there are and what they offer: the master's state, polled, and whether each node lives.

The master's word is not enough. A node that crashed stays registered, so every node that offers something is watched
by an idle connection to its API port: when that ends and the port refuses a new one, the node is dead, whatever the
master says. It is looked for again, because a node that comes back under its name may have another port.

The poll costs next to nothing while nothing changes: an answer that is the same in every byte is not read. While there
is no master, what is connected stays so.

What we are registered for is made to be what is desired, whatever happened on the way: one task does it, one call after
another, by comparing what the master lists with what is desired now. What it does not list (it was restarted) is
registered again, what it lists and nobody desires is unregistered, and once in `RECONCILE_S` all of it is looked at
anew.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Final, NamedTuple, Protocol

from sern_client.endpoints.common.saying import Trouble
from sern_client.endpoints.ros1.frames import keep_alive
from sern_client.endpoints.ros1.master import Master, SystemState
from sern_client.endpoints.ros1.xmlrpc import CallError, UnreachableError, split_uri
from sern_runtime import clock

CONNECT_S: Final = 2.0
LOOK_AGAIN_S: Final = (0.25, 1.0)
"""First and longest pause before a dead node is looked for again."""
SHORT_WATCH_S: Final = 1.0
"""A server that ends our idle connection sooner than this is asked again only after a pause."""
MASTER_AGAIN_S: Final = 0.5
GATHER_S: Final = 0.02
"""The master tells of one change several times (once a topic); one poll answers all."""
THREAD_BYTES: Final = 100_000
"""A longer state of the master is read in a thread: a thousand topics take 20 ms."""
RUN_ID_S: Final = 1.0
RECONCILE_S: Final = 60.0
"""How often a state that has not changed is read all the same, and what was refused is tried again."""

_log = logging.getLogger(__name__)


class Member(Protocol):
    """Something a node offers: a topic's source, or a service."""

    def up(self, uri: str) -> None:
        """The node lives; `uri` is its API. Said again when that changes."""

    def down(self) -> None:
        """The node is dead, or offers this no more."""


class Registration(NamedTuple):
    """One thing that we are registered for at the master. `kind`: publisher, subscriber or service."""

    kind: str
    name: str


class Registrar(Protocol):
    """What we are to be registered for, and how."""

    def desired(self) -> Mapping[Registration, str]:
        """Each with what it says besides its name (a type): where that changes, it is registered again."""
        ...

    def register(self, registration: Registration, detail: str) -> Awaitable[None]: ...

    def unregister(self, registration: Registration) -> Awaitable[None]: ...


class _Watch(asyncio.Protocol):
    """An idle connection to a node's API port."""

    def __init__(self) -> None:
        self.closed = asyncio.get_running_loop().create_future()
        self.transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        keep_alive(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self.transport = None
        if not self.closed.done():
            self.closed.set_result(None)


class Node:
    """Another node of this master, from when it offers something until it offers nothing."""

    def __init__(self, name: str, master: Master) -> None:
        self.name = name
        self.uri = ""
        self.alive = False
        self.members: list[Member] = []
        self._master = master
        self._trouble = Trouble(_log, name)
        self._look = asyncio.Event()
        self._transport: asyncio.BaseTransport | None = None
        self._task = asyncio.create_task(self._run(), name=f"ros1 node {name}")

    def add(self, member: Member) -> None:
        self.members.append(member)
        if self.alive:
            member.up(self.uri)

    def remove(self, member: Member) -> None:
        self.members.remove(member)
        member.down()

    def look_again(self) -> None:
        """Something suggests that it changed: ask the master where it is now."""
        self._look.set()
        if self._transport is not None:
            self._transport.close()

    @property
    def ended(self) -> bool:
        """Whether nobody watches it any more, though it was not closed: an error of ours."""
        return self._task.done()

    def close(self) -> None:
        self._task.cancel()
        if self._transport is not None:
            self._transport.close()

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        pause_s = LOOK_AGAIN_S[0]
        while True:
            began_s = loop.time()
            try:
                # No master, or one that has not heard of it: where it was last is the best guess.
                with suppress(CallError):
                    self.uri = await self._master.node_uri(self.name)
                began_s = loop.time()
                await self._watch()
            except (CallError, OSError, TimeoutError):
                self._dead()
            except Exception as error:  # noqa: BLE001  an error of ours must not end the watching of a node
                self._failed(error)
            else:
                pause_s = LOOK_AGAIN_S[0]
                if loop.time() - began_s < SHORT_WATCH_S:
                    await self._pause(pause_s)
                else:
                    self._trouble.forget()
                continue
            await self._pause(pause_s)
            pause_s = min(pause_s * 2, LOOK_AGAIN_S[1])

    def _failed(self, error: Exception) -> None:
        """Log an error that nobody expected, once until it is another one; the node counts as dead."""
        try:
            self._dead()
        except Exception:  # noqa: BLE001  what a member does must not end the watching either
            _log.exception("%s: what it offers could not be withdrawn", self.name)
        if self._trouble.is_new(f"{type(error).__name__}: {error}"):
            _log.error("%s: the watching of this node failed; it is tried again", self.name, exc_info=error)

    async def _watch(self) -> None:
        try:
            host, port = split_uri(self.uri)
        except CallError as error:
            if self.uri and self._trouble.is_new(str(error)):
                _log.warning("%s: the master has %s; its ROS_HOSTNAME is to be another one", self.name, error)
            raise
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(CONNECT_S):
            _, watch = await loop.create_connection(_Watch, host, port)
        self._transport = watch.transport
        try:
            self.alive = True
            for member in list(self.members):
                member.up(self.uri)
            await watch.closed
        finally:
            self._transport = None
            if watch.transport is not None:
                watch.transport.close()

    def _dead(self) -> None:
        if self.alive:
            self.alive = False
            for member in list(self.members):
                member.down()

    async def _pause(self, pause_s: float) -> None:
        self._look.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                await self._look.wait()


class Graph:
    """Follows one master. `changed(state)` is called with every new state; it calls `attach` and `detach`.

    `start` and `stop` once each. Nothing here raises because of a master or a node: it is tried again for ever.
    """

    def __init__(
        self, master: Master, registrar: Registrar, changed: Callable[[SystemState], None], *, poll_s: float
    ) -> None:
        self.nodes: dict[str, Node] = {}
        self.connected = False
        """The master answered the last call."""
        self._master = master
        self._registrar = registrar
        self._changed = changed
        self._poll_s = poll_s
        self._registered: dict[Registration, str | None] = {}  # None: listed, but not known with what
        self._refused: dict[Registration, str] = {}
        self._listed: set[Registration] = set()
        self._reconcile_s = 0.0
        self._seen = b""
        self._lost_s: float | None = None  # since when there is no master, if that was said
        self._run_id: str | None = None
        self._run_id_s = -RUN_ID_S
        self._now = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        self._task = asyncio.create_task(self._run(), name=f"ros1 master {self._master.uri}")

    async def stop(self, patience_s: float) -> None:
        """Unregister as far as the master answers in time, and forget every node."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        for node in self.nodes.values():
            node.close()
        self.nodes.clear()
        if self.connected:
            with suppress(CallError, TimeoutError):
                async with asyncio.timeout(patience_s):
                    for registration in list(self._registered):
                        await self._registrar.unregister(registration)
        self._registered.clear()

    def poll_now(self) -> None:
        """Something changed, here or there."""
        self._now.set()

    def again(self, registration: Registration) -> None:
        """Register it once more even if it is listed: the master tells its subscribers then."""
        if registration in self._registered:
            self._registered[registration] = None
        self.poll_now()

    @property
    def unlisted(self) -> list[Registration]:
        """What is desired and the master, when it last answered, did not list; empty while there is no master."""
        return sorted(self._registrar.desired().keys() - self._listed) if self.connected else []

    def attach(self, node_name: str, member: Member) -> None:
        node = self.nodes.get(node_name)
        if node is None:
            node = self.nodes[node_name] = Node(node_name, self._master)
        node.add(member)

    def detach(self, node_name: str, member: Member) -> None:
        node = self.nodes[node_name]
        node.remove(member)
        if not node.members:
            node.close()
            del self.nodes[node_name]

    async def _run(self) -> None:
        while True:
            self._now.clear()
            try:
                await self._register()
                await self._poll()
                self._found()
                pause_s = self._poll_s
            except UnreachableError as error:
                self._lost(str(error))
                pause_s = MASTER_AGAIN_S
            except CallError as error:
                self._lost(f"does not answer like a ROS master: {error}")
                pause_s = MASTER_AGAIN_S
            except Exception:  # noqa: BLE001  an error of ours must not end the following of the master
                _log.exception("%s: a poll of the master failed", self._master.uri)
                pause_s = MASTER_AGAIN_S
            with suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._now.wait()
                    await asyncio.sleep(GATHER_S)

    def _found(self) -> None:
        if self.connected:
            return
        self.connected = True
        lost_s, self._lost_s = self._lost_s, None
        if lost_s is None:
            _log.info("connected to the ROS master at %s", self._master.uri)
        else:
            _log.warning(
                "connected to the ROS master at %s again, after %.0f s", self._master.uri, clock.now() - lost_s
            )

    def _lost(self, problem: str) -> None:
        if self._lost_s is None:
            self._lost_s = clock.now()
            _log.warning("ROS master: %s; trying again until it works", problem)
        self.connected = False
        self._seen = b""
        self._run_id_s = -RUN_ID_S

    async def _register(self) -> None:
        desired = dict(self._registrar.desired())
        for registration, detail in desired.items():
            if detail in (self._registered.get(registration), self._refused.get(registration)):
                continue
            self._seen = b""  # what the master lists is compared again after every change of ours
            self._registered[registration] = detail  # before the call: during it, it may be wanted `again`
            try:
                await self._registrar.register(registration, detail)
            except UnreachableError:
                self._registered.pop(registration, None)
                raise
            except CallError as error:
                self._registered.pop(registration, None)
                self._refused[registration] = detail
                _log.error("%s: cannot be registered as %s: %s", registration.name, registration.kind, error)
        for registration in self._registered.keys() - desired.keys():
            self._seen = b""
            try:
                await self._registrar.unregister(registration)
            except UnreachableError:
                raise  # it may come back, and list it still
            except CallError as error:  # it has lost us: there is nothing to unregister
                _log.debug("%s: was not registered as %s any more: %s", registration.name, registration.kind, error)
            del self._registered[registration]
        for registration in self._refused.keys() - desired.keys():
            del self._refused[registration]

    async def _poll(self) -> None:
        await self._check_run_id()
        now = asyncio.get_running_loop().time()
        if now - self._reconcile_s >= RECONCILE_S:
            self._reconcile_s = now
            self._seen = b""
            self._refused.clear()
        answer = await self._master.state()
        if answer == self._seen:
            return
        if len(answer) > THREAD_BYTES:
            state = await asyncio.to_thread(self._master.read_state, answer)
        else:
            state = self._master.read_state(answer)
        kinds = {"publisher": state.publishers, "subscriber": state.subscribers, "service": state.services}
        self._listed = {
            Registration(kind, name)
            for kind, table in kinds.items()
            for name, nodes in table.items()
            if self._master.caller in nodes
        }
        if self._listed != self._registered.keys():
            for registration in self._registered.keys() - self._listed:
                del self._registered[registration]
            # What else it lists is unregistered unless it is desired, and registered as it should be then.
            self._registered |= dict.fromkeys(self._listed - self._registered.keys())
            self._now.set()
        self._seen = answer
        self._changed(state)

    async def _check_run_id(self) -> None:
        """Another run of the master knows nothing of us, even if its state looks the same."""
        now = asyncio.get_running_loop().time()
        if now - self._run_id_s < RUN_ID_S:
            return
        self._run_id_s = now
        run_id = await self._master.run_id()
        if self._run_id is not None and run_id != self._run_id:
            _log.info("the ROS master at %s was restarted; registering again", self._master.uri)
            self._registered.clear()
            self._refused.clear()
            self._now.set()
            for node in self.nodes.values():
                node.look_again()
        self._run_id = run_id
