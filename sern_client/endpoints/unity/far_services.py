"""Services of other sites, for the scenes that call them.

A scene registers a service, then says `__request` with a number and sends the request as the next message; what it is
answered has the same number. Between the two it may send keep-alives and other topics' messages, which is not taken for
the request. A call that fails is told in words, and answered with nothing: the connector then ends the call with an
error, where it would wait for ever. Where an answer has no fields that would look like success, so there is none.
"""

import asyncio
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import ServiceHandler, ServiceInfo
from sern_client.endpoints.unity import commands, names
from sern_client.endpoints.unity.commands import Command, shown
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.frames import frame
from sern_client.endpoints.unity.scene import Scene
from sern_client.endpoints.unity.types import SceneTypes
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, TopicName

MAX_CALLS: Final = 256
"""Calls of one scene that may be under way."""
MAX_REGISTERED: Final = 1000
"""Services of one scene, of either kind."""


class Served:
    """A `ServiceServer`: a service of another site, as scenes call it."""

    def __init__(self, owner: "FarServices", info: ServiceInfo, handler: ServiceHandler) -> None:
        self.info = info
        self.handler = handler
        self.closed = False
        self.calls: set[asyncio.Task[None]] = set()
        self._owner = owner

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._owner.withdraw(self)
            # A call that has just been told that it fails may still have that to say.
            asyncio.get_running_loop().call_soon(self._end)

    def _end(self) -> None:
        for task in self.calls:
            task.cancel()


@dataclass(slots=True)
class _Caller:
    """A scene that calls: its services as it spells them, and the number of the request that comes next."""

    registered: dict[str, TopicName] = field(default_factory=dict)
    asked: int | None = None
    calls: set[asyncio.Task[None]] = field(default_factory=set)


class FarServices:
    """Those of one endpoint."""

    def __init__(self, types: SceneTypes, faults: Faults, drops: Counter[DropReason]) -> None:
        self._types = types
        self._faults = faults
        self._drops = drops
        self._served: dict[TopicName, Served] = {}
        self._callers: dict[Scene, _Caller] = {}
        self._calls: set[asyncio.Task[None]] = set()

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Served:
        """ConfigError when its bodies are of the other ROS, or there is one of that name."""
        if info.encoding is not self._types.encoding:
            raise ConfigError(f"{info.name}: a {info.encoding} service is none for scenes of {self._types.encoding}")
        if info.name in self._served:
            raise ConfigError(f"{info.name}: another service of that name is served here already")
        served = self._served[info.name] = Served(self, info, handler)
        return served

    def withdraw(self, served: Served) -> None:
        if self._served.get(served.info.name) is served:
            del self._served[served.info.name]

    # --- of scenes --------------------------------------------------------------------------------------------------

    def register(self, scene: Scene, command: Command) -> None:
        caller = self._callers.setdefault(scene, _Caller())
        try:
            name, type_name = names.local_name(command.topic), names.our_type(command.type_name, "srv")
        except ConfigError as error:
            self._faults(Fault.NAME, f"cannot use a service: {error}", scene)
            return
        served = self._served.get(name)
        if served is not None and not names.same_type(served.info.type_name, type_name):
            text = (
                f"{name}: the scene calls {shown(command.type_name)}, the service is "
                f"{names.their_type(served.info.type_name)}; it cannot be called"
            )
            self._faults(Fault.OTHER_TYPE, text, scene)
            return
        if len(caller.registered) >= MAX_REGISTERED:
            self._faults(Fault.TOO_MANY, f"cannot use more than {MAX_REGISTERED} services", scene)
            return
        if served is None and self._types.service_definition(type_name, self._types.encoding) is None:
            text = (
                f"{name}: the service type {shown(names.their_type(type_name))} is not known here, and no site offers "
                "the service yet; it can be called when one does"
            )
            self._faults(Fault.UNKNOWN_TYPE, text, scene)
        caller.registered[command.topic] = name

    def remove(self, scene: Scene, spelling: str) -> None:
        if scene in self._callers:
            self._callers[scene].registered.pop(spelling, None)

    def asks(self, scene: Scene, srv_id: int) -> None:
        """The next message of the scene to a service is the request of this number."""
        caller = self._callers.setdefault(scene, _Caller())
        if caller.asked is not None:
            self._faults(Fault.CALL, "a call was announced (__request), and its request did not come", scene)
        caller.asked = srv_id

    def expects(self, scene: Scene, spelling: str | None = None) -> bool:
        """Whether a request is what comes next, of this service where it is named."""
        caller = self._callers.get(scene)
        return caller is not None and caller.asked is not None and (spelling is None or spelling in caller.registered)

    def request(self, scene: Scene, spelling: str, body: bytes) -> None:
        """The request of the number that the scene has said."""
        caller = self._callers[scene]
        assert caller.asked is not None
        srv_id, caller.asked = caller.asked, None
        name = caller.registered.get(spelling)
        served = None if name is None else self._served.get(name)
        if name is None:
            problem, fault = (
                f"{shown(spelling)} was not registered (__ros_service)",
                Fault.NOT_REGISTERED,
            )
        elif served is None:
            problem, fault = f"no site offers the service {name}", Fault.CALL
        elif not self._types.is_body(body):
            problem, fault = f"{name}: a request of {len(body)} bytes is no body of {self._types.encoding}", Fault.BODY
        elif len(caller.calls) >= MAX_CALLS:
            problem, fault = f"{MAX_CALLS} calls are under way already", Fault.TOO_MANY
        else:
            call = asyncio.create_task(self._call(scene, served, spelling, srv_id, body), name=f"call of {name}")
            for calls in (self._calls, caller.calls, served.calls):
                calls.add(call)
                call.add_done_callback(calls.discard)
            return
        self._failed(scene, spelling, srv_id, served, fault, problem)

    def gone(self, scene: Scene) -> None:
        caller = self._callers.pop(scene, None)
        if caller is not None:
            for call in caller.calls:
                call.cancel()

    async def stop(self) -> None:
        """Nothing is called any more. All scenes have gone."""
        await asyncio.gather(*self._calls, return_exceptions=True)

    async def _call(self, scene: Scene, served: Served, spelling: str, srv_id: int, body: bytes) -> None:
        try:
            response = await served.handler(body)
        except ServiceError as error:
            self._failed(scene, spelling, srv_id, served, Fault.CALL, str(error))
        except asyncio.CancelledError:
            if served.closed and scene in self._callers:
                self._failed(scene, spelling, srv_id, served, Fault.CALL, f"the service {served.info.name} has gone")
            raise
        else:
            self._answer(scene, spelling, srv_id, response)

    def _answer(self, scene: Scene, spelling: str, srv_id: int, response: bytes) -> None:
        pieces = (commands.command(commands.RESPONSE, srv_id=srv_id), *frame(spelling, response))
        if not scene.outbox.service(pieces):
            self._drops[DropReason.QUEUE_FULL] += 1
            self._faults(Fault.CALL, f"{shown(spelling)}: too much waits for the scene; its answer is dropped", scene)
            return
        scene.wake()

    def _failed(
        self, scene: Scene, spelling: str, srv_id: int, served: Served | None, fault: Fault, problem: str
    ) -> None:
        self._faults(fault, f"a call failed: {problem}", scene)
        if served is None or not self._types.answers_nothing(served.info.type_name, served.info.definition):
            self._answer(scene, spelling, srv_id, b"")
