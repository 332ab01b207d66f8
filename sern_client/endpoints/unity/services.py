"""Services between scenes and other sites, both ways.

A call is `__request` with a number and the request, and then `__response` with that number and the response, whichever
side calls. The protocol has no word for a call that fails: a scene is told so as an error.
"""

import itertools
import logging
from collections.abc import Sequence
from typing import Final, NamedTuple

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo
from sern_client.endpoints.common.calls import PendingCalls, Tasks, within
from sern_client.endpoints.unity import framing
from sern_client.endpoints.unity.scene import Scene
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services
from sern_runtime.ros_files import TypeFiles

MAX_CALLS: Final = 64
"""Calls of all scenes at a time."""
MAX_OFFERED: Final = 200
_NUMBERS: Final = 2**31

_log = logging.getLogger(__name__)


class Services:
    """`files` have the definitions that do not come with a service."""

    def __init__(self, encoding: Encoding, files: Sequence[TypeFiles]) -> None:
        self._encoding = encoding
        self._files = files
        self._events: ServiceEvents | None = None
        self._served: dict[TopicName, Served] = {}
        self._offered: dict[TopicName, _Offered] = {}
        self._pending: dict[Scene, PendingCalls] = {}
        self._numbers = itertools.count(1)
        self._tasks = Tasks(MAX_CALLS)

    def watch(self, events: ServiceEvents) -> None:
        self._events = events
        for offered in self._offered.values():
            events.service_added(offered.info)

    def definition(self, type_name: str, encoding: Encoding) -> str | None:
        """As `KnowsServiceTypes` has it."""
        return next(filter(None, (files.service(type_name, encoding) for files in self._files)), None)

    def message_definition(self, type_name: str) -> str:
        """The text of a message type in the files; empty: it is in none of them."""
        return next(filter(None, (files.message(type_name, self._encoding) for files in self._files)), "")

    async def close(self) -> None:
        for scene in list(self._pending):
            self.gone(scene)
        for served in list(self._served.values()):
            served.close()
        self._tasks.cancel()
        await self._tasks.ended()

    # Services of other sites, which scenes call

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> "Served":
        if info.encoding is not self._encoding:
            raise ConfigError(f"service {info.name}: {info.encoding} bodies cannot be served to scenes here")
        if info.name in self._served:
            raise UsageError(f"service {info.name} is served already")
        if info.name in self._offered:
            raise ConfigError(f"service {info.name}: a scene here has it already")
        served = self._served[info.name] = Served(info, handler, self._served)
        return served

    def uses(self, scene: Scene, name: TopicName, type_name: str) -> None:
        """A scene is going to call a service."""
        served = self._served.get(name)
        if served is None:
            _log.info("a scene wants to call %s (%s), which no site offers yet", name, type_name)
        elif served.info.type_name != type_name:
            scene.error(f"{name} is {served.info.type_name}, not {type_name}")

    def asked(self, scene: Scene, number: int, name: TopicName, spelled: str, request: bytes) -> None:
        """A scene calls."""
        served = self._served.get(name)
        if served is None:
            scene.error(f"{name}: no site offers this service")
        elif self._tasks.full:
            scene.error(f"{name}: {MAX_CALLS} calls are under way; this one fails")
        else:
            self._tasks.begin(self._answer(scene, number, served, spelled, request), name="unity-call")

    async def _answer(self, scene: Scene, number: int, served: "Served", spelled: str, request: bytes) -> None:
        try:
            response = await served.handler(request)
        except ServiceError as error:
            scene.error(f"{served.info.name}: the call fails: {error}")
        else:
            scene.answer(framing.command("response", srv_id=number) + framing.frame(spelled, response))

    # Services of scenes, which other sites call

    def offers(self, scene: Scene, name: TopicName, spelled: str, type_name: str) -> None:
        """A scene has a service. ConfigError: it cannot be offered to others."""
        if name in self._served:
            raise ConfigError(f"{name} is a service of another site: a scene cannot have it too")
        other = self._offered.get(name)
        if other is not None and other.scene is not scene:
            raise ConfigError(f"{name} is a service of another scene")
        if other is None and len(self._offered) >= MAX_OFFERED:
            raise ConfigError(f"{name}: scenes have {MAX_OFFERED} services already")
        text = ros_services.resolve(type_name, self.definition(type_name, self._encoding) or "", self._encoding).text
        info = ServiceInfo(name, type_name, self._encoding, text.type_hash, text.definition)
        self.withdrawn(scene, name)
        self._offered[name] = _Offered(scene, info, spelled)
        self._pending.setdefault(scene, PendingCalls())
        if self._events is not None:
            self._events.service_added(info)

    def withdrawn(self, scene: Scene, name: TopicName) -> None:
        offered = self._offered.get(name)
        if offered is not None and offered.scene is scene:
            del self._offered[name]
            if self._events is not None:
                self._events.service_removed(name)

    def gone(self, scene: Scene) -> None:
        """A scene is not there any more: what it offered is not either."""
        for name in [name for name, offered in self._offered.items() if offered.scene is scene]:
            self.withdrawn(scene, name)
        pending = self._pending.pop(scene, None)
        if pending is not None:
            pending.fail_all("the scene that has the service has gone")

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        """ServiceError when no scene has it, it goes, or does not answer in time."""
        offered = self._offered.get(name)
        if offered is None:
            raise ServiceError(f"{name}: no scene here has such a service")
        scene = offered.scene
        pending = self._pending[scene]
        number = next(each % _NUMBERS for each in self._numbers if each % _NUMBERS not in pending)
        with pending.call(number) as answer:
            scene.answer(framing.command("request", srv_id=number) + framing.frame(offered.spelled, request))
            async with within(timeout_s, f"{name}: the scene did not answer within {timeout_s:g} s"):
                return await answer

    def answered(self, scene: Scene, number: int, response: bytes) -> bool:
        """A scene has answered. False: nobody waits for that any more."""
        pending = self._pending.get(scene)
        if pending is None or number not in list(pending):
            return False
        pending.answer(number, response)
        return True


class _Offered(NamedTuple):
    """A service of a scene, and how the scene writes its name."""

    scene: Scene
    info: ServiceInfo
    spelled: str


class Served:
    """A `ServiceServer`."""

    def __init__(self, info: ServiceInfo, handler: ServiceHandler, table: "dict[TopicName, Served]") -> None:
        self.info = info
        self.handler = handler
        self._table = table

    def close(self) -> None:
        if self._table.get(self.info.name) is self:
            del self._table[self.info.name]
